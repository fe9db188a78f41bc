"""Faults of the wire on real SocketCAN: a flood by another process, a second HAL, an interface that goes down."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from atalante_dbc import Network
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.transceiver import RECEIVE_BUDGET
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import new_frames
from tests.vcan.conftest import PATIENCE, Loop, as_root, create, remove, repeated

S = SupervisorState
ATALANTE = str(Path(sys.executable).with_name("atalante"))


@dataclass
class Line:
    """A HAL and a robot, each on a socket of its own, the robot in a thread of its own."""

    hal: Hal
    loop: Loop
    emulator: Emulator
    operator: Operator
    stack: ExitStack  # ends what belongs to it

    def socket(self) -> SocketCanBus:
        """One more socket on the same wire."""
        bus = SocketCanBus(self.hal.bus.name)
        self.stack.callback(bus.close)
        return bus

    @property
    def drives_hold(self) -> bool:
        return set(self.emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}

    def reconnect(self) -> None:
        """Run until every node answers again."""
        deadline = time.monotonic() + PATIENCE
        while self.hal.missing():
            self.loop.cycles(1)
            assert time.monotonic() < deadline, self.hal.missing()

    def start(self) -> None:
        """To ACTIVE, on the operator's word."""
        self.operator.start()
        assert self.loop.cycles(100, S.ACTIVE) is S.ACTIVE, self.hal.reason

    def codes(self) -> list[str]:
        return [event.code for event in self.hal.events]


@pytest.fixture
def walking(network: Network, robot: Robot, urdf_text: str) -> Iterator[type]:
    """`with walking(channel) as line`: ACTIVE."""

    @contextmanager
    def on(channel: str) -> Iterator[Line]:
        with ExitStack() as stack:
            buses = [SocketCanBus(channel) for _ in range(2)]
            for bus in buses:
                stack.callback(bus.close)
            body = PyBulletBody(urdf_text)
            stack.callback(body.close)
            operator = Operator(0.5, starts=False)
            wire = ResilientBus(buses[0])
            emulator = Emulator(network, robot, body, wire, operator=operator)

            def answer() -> None:
                if not emulator.poll(0.02 if wire.down else 0.05) and wire.down:
                    emulator.idle()  # a millisecond without SYNC

            hal = Hal(network, robot, buses[1], patience=PATIENCE)
            line = Line(hal, Loop(hal), emulator, operator, stack)
            stack.enter_context(repeated(answer))
            assert line.loop.cycles(400, S.READY) is S.READY, hal.missing()
            line.start()
            yield line

    return on


def test_f13_a_flood_of_another_process_ends_in_hold_within_five_cycles(vcan: str, walking) -> None:
    with walking(vcan) as line:
        listening, block = line.socket(), new_frames(256)
        flood = subprocess.Popen(["cangen", vcan, "-g", "0", "-i", "-I", "000", "-L", "8", "-D", "00", "-f"])
        try:
            heard = 0
            while heard < 10 * RECEIVE_BUDGET:  # so much waits for the HAL, too
                heard += listening.receive(block, PATIENCE)
                assert flood.poll() is None
            before, frames = line.hal.state.cycle, line.hal.layout["frames"]
            received = [float(line.hal.record[frames][0])]
            for _ in range(5):
                line.loop.cycles(1)
                received.append(float(line.hal.record[frames][0]))
            assert line.hal.state.supervisor is S.HOLD
            assert "BUS_FLOOD" in line.codes()
            line.loop.cycles(30)
        finally:
            flood.kill()
            flood.wait()
        # What a cycle reads is bounded, so it ends: no cycle was lost to the flood.
        assert line.hal.state.cycle == before + 35
        assert max(after - before for before, after in pairwise(received)) <= RECEIVE_BUDGET
        assert line.loop.cycles(200) is S.HOLD  # and stays there when the wire is quiet again
        assert line.drives_hold
        line.start()


def test_f14_a_second_hal_refuses_to_start_and_leaves_the_first_alone(vcan: str, walking) -> None:
    with walking(vcan) as line:
        command = [ATALANTE, "jog", "left_SK", "--to", "3", "-i", "socketcan", "-c", vcan, "--lockstep"]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as second:
            while second.poll() is None:
                assert line.loop.cycles(1) is S.ACTIVE, line.hal.reason
            assert second.stderr is not None
            assert "another HAL is active on vcan0" in second.stderr.read()
        assert second.returncode == 1


def test_f14_a_running_hal_holds_in_the_cycle_in_which_it_hears_another(
    vcan: str, walking, network: Network, robot: Robot
) -> None:
    with walking(vcan) as line:
        line.loop.cycles(20)
        heard = line.hal.state.cycle + 1
        Hal(network, robot, line.socket(), patience=0.0).read()  # one that did not listen
        assert line.loop.cycles(1) is S.HOLD
        assert [(e.cycle, e.code) for e in line.hal.events if e.code == "HAL_DUPLICATE"] == [(heard, "HAL_DUPLICATE")]
        assert line.loop.cycles(100) is S.HOLD
        assert line.drives_hold
        line.start()


def test_f16_an_interface_that_goes_down_ends_in_hold_until_the_operator_starts_again(spare_vcan: str, walking) -> None:
    with walking(spare_vcan) as line:
        line.loop.cycles(20)
        before = line.hal.state.cycle
        as_root("ip", "link", "set", spare_vcan, "down")
        assert line.loop.cycles(5) is S.HOLD
        assert "BUS_DOWN" in line.codes()
        assert f"type `ip link set {spare_vcan} up`" in line.hal.reason
        line.operator.start()  # which nobody hears
        assert line.loop.cycles(30) is S.HOLD
        assert line.hal.state.cycle == before + 35
        assert line.drives_hold  # by themselves

        as_root("ip", "link", "set", spare_vcan, "up")
        assert line.loop.cycles(60) is S.HOLD  # what was pressed meanwhile does not count
        assert line.hal.missing() == []
        assert line.drives_hold
        line.start()
        assert line.loop.cycles(20) is S.ACTIVE, line.hal.reason


def test_f16_a_removed_interface_ends_in_hold_and_is_used_again_when_it_is_back(spare_vcan: str, walking) -> None:
    with walking(spare_vcan) as line:
        for _ in range(2):
            line.loop.cycles(20)
            remove(spare_vcan)
            assert line.loop.cycles(2) is S.HOLD
            assert "BUS_DOWN" in line.codes()
            assert f"{spare_vcan} was removed: plug the adapter in again" in line.hal.reason
            assert line.loop.cycles(30) is S.HOLD
            assert line.drives_hold
            create(spare_vcan)
            line.reconnect()
            assert line.loop.cycles(60) is S.HOLD
            line.start()
        assert line.loop.cycles(20) is S.ACTIVE, line.hal.reason
