"""HAL and emulator as two processes on a real SocketCAN bus, with candump as the second witness."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cantools
import pytest

from atalante_dbc import DBC_FILE, Network
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus, open_bus
from atalante_hal.robot import Robot
from atalante_hal.wire.cia402 import DriveState
from tests.closed_loop.test_closed_loop import ClosedLoop
from tests.vcan.conftest import PATIENCE, Candump

ATALANTE = [str(Path(sys.executable).with_name("atalante"))]


@pytest.fixture
def emulator_process(vcan: str) -> Iterator[subprocess.Popen[str]]:
    """`atalante emulator` in lock-step with an operator; ready when its first line is out."""
    command = [*ATALANTE, "emulator", "-i", "socketcan", "-c", vcan, "--lockstep", "--operator", "--xi", "0.5"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline()
        yield process
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 143


class TestSocketCan(ClosedLoop):
    """The same closed loop as on the embedded bus, a short walk of it: the lane's kernel is slow."""

    patience = PATIENCE
    until_phase = 1.01

    @pytest.fixture
    def bus(self, vcan: str, emulator_process: subprocess.Popen[str]) -> Iterator[Bus]:
        bus = open_bus("socketcan", vcan)
        yield bus
        bus.close()


def test_what_candump_saw_decodes_with_plain_cantools(
    vcan: str, emulator_process: subprocess.Popen[str], tmp_path: Path
) -> None:
    log = tmp_path / "candump.log"
    with Candump(vcan, log):
        command = [*ATALANTE, "jog", "left_SK", "--to", "3", "-i", "socketcan", "-c", vcan, "--lockstep", "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10 * PATIENCE)
    assert done.returncode == 0, done.stderr
    assert abs(json.loads(done.stdout)["error_deg"]) < 1.0
    oracle = cantools.database.load_file(str(DBC_FILE))
    seen: set[str] = set()
    for line in log.read_text().splitlines():
        identifier, payload = line.split()[2].split("##")
        message = oracle.get_message_by_frame_id(int(identifier, 16))
        data = bytes.fromhex(payload[1:])
        assert len(data) == message.length
        message.decode(data)
        seen.add(message.name)
    assert {"SYNC_LEFT_LEG", "COMMAND_RIGHT_LEG", "LEFT_SK_STATE", "IMU_PELVIS_STATE", "FOOT_LEFT_STATE"} <= seen
    assert {"PENDANT_STATE", "HAPTICS_STATE", "LEFT_SK_STATUS", "HAL_STATUS"} <= seen


def test_sigkill_of_the_hal_leaves_every_drive_in_latched_hold_within_five_cycles(
    vcan: str, network: Network, robot: Robot, urdf_text: str
) -> None:
    bus = open_bus("socketcan", vcan)
    body = PyBulletBody(urdf_text)
    emulator = Emulator(network, robot, body, bus, operator=Operator(0.5))
    command = [*ATALANTE, "jog", "left_SK", "--to", "20", "-i", "socketcan", "-c", vcan, "--lockstep"]
    hal = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 5 * PATIENCE
        while set(emulator.drives.state) != {DriveState.OPERATION_ENABLED}:
            emulator.poll(0.1)
            assert time.monotonic() < deadline, "the HAL never enabled the drives"
        for _ in range(20):
            emulator.poll(0.1)
    finally:
        os.kill(hal.pid, signal.SIGKILL)
        hal.wait()
    while emulator.poll(0.0):  # what it had sent before it died
        pass
    assert set(emulator.drives.state) == {DriveState.OPERATION_ENABLED}
    # On its own clock now: the watchdog counts five milliseconds without SYNC, then the drives hold by themselves.
    alone = emulator.cycle
    emulator.run(lambda: emulator.cycle > alone)
    assert emulator.cycle - alone <= 5
    assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
    held = body.position.copy()
    emulator.run(lambda: emulator.cycle > alone + 200)
    assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
    assert abs(body.position - held).max() < 0.02
    body.close()
    bus.close()
