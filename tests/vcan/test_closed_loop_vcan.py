"""HAL and emulator as two processes on a real SocketCAN bus. candump records the frames independently."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import cantools
import pytest

from atalante_dbc import DBC_FILE, Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus, open_bus
from atalante_hal.robot import Robot
from atalante_hal.wire.cia402 import DriveState
from tests.closed_loop.test_closed_loop import ClosedLoop
from tests.vcan.conftest import PATIENCE, Candump
from tests.vcan.terminal import Terminal, wait_until


@pytest.fixture
def emulator_process(vcan: str, loaded_commands: None, tmp_path: Path) -> Iterator[Terminal]:
    """Start `atalante emulator` in lock-step with an operator, and wait until it is on the bus."""
    bus = ("-i", "socketcan", "-c", vcan)
    emulator = Terminal(tmp_path / "emulator.log", "emulator", *bus, "--lockstep", "--operator", "--xi", "0.5")
    emulator.wait_for("the emulated robot is on")
    yield emulator
    assert emulator.end() == 143


class TestSocketCan(ClosedLoop):
    """Same closed-loop tests as on the embedded bus, but with a shorter walk, because a guest kernel is slow."""

    patience = PATIENCE
    until_phase = 1.01

    @pytest.fixture
    def bus(self, vcan: str, emulator_process: Terminal) -> Iterator[Bus]:
        bus = open_bus("socketcan", vcan)
        yield bus
        bus.close()


def test_log_of_candump_decodes_with_cantools(vcan: str, emulator_process: Terminal, tmp_path: Path) -> None:
    log = tmp_path / "candump.log"
    with Candump(vcan, log):
        bus = ("-i", "socketcan", "-c", vcan)
        jog = Terminal(tmp_path / "jog.log", "jog", "left_SK", "--to", "3", *bus, "--lockstep", "--json")
        wait_until(lambda: not jog.running, jog.text)
    assert jog.exit_code == 0, jog.text()
    (result,) = [json.loads(line) for line in jog.text().splitlines() if line.startswith("{")]
    assert abs(result["error_deg"]) < 1.0
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


@pytest.mark.usefixtures("loaded_commands")
def test_sigkill_of_the_hal_leaves_every_drive_in_latched_hold(
    vcan: str, network: Network, robot: Robot, urdf_text: str, tmp_path: Path
) -> None:
    bus = open_bus("socketcan", vcan)
    body = PyBulletBody(urdf_text)
    emulator = Emulator(network, robot, body, bus, operator=Operator(0.5))
    line = ("-i", "socketcan", "-c", vcan, "--lockstep")
    hal = Terminal(tmp_path / "jog.log", "jog", "left_SK", "--to", "20", *line)
    try:
        deadline = time.monotonic() + 5 * PATIENCE
        while set(emulator.drives.state) != {DriveState.OPERATION_ENABLED}:
            emulator.poll(0.1)
            assert time.monotonic() < deadline, "the HAL never enabled the drives"
        for _ in range(20):
            emulator.poll(0.1)
    finally:
        hal.end(signal.SIGKILL)
    while emulator.poll(0.0):  # frames that the HAL sent before it was killed
        pass
    assert set(emulator.drives.state) == {DriveState.OPERATION_ENABLED}
    # The emulator now runs in real time. It starts alone after five cycles without SYNC, so its first cycle is a hold.
    alone = emulator.cycle
    emulator.run(lambda: emulator.cycle > alone)
    assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
    held = body.position.copy()
    emulator.run(lambda: emulator.cycle > alone + 200)
    assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
    assert abs(body.position - held).max() < 0.02
    body.close()
    bus.close()
