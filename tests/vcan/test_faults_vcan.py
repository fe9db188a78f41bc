"""Communication faults on real SocketCAN: a flood by another process, a second HAL, an interface that goes down."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.transceiver import RECEIVE_BUDGET
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import new_frames
from tests.vcan.conftest import PATIENCE, Loop, as_root, create, remove, repeated
from tests.vcan.terminal import Terminal

S = SupervisorState

#: Disturbance of the interface -> arguments of `tc qdisc ... netem`, and states of the HAL that the disturbance may cause.
NETEM = {
    "loss": (("loss", "1%"), {S.ACTIVE, S.HOLD}),
    "delay": (("delay", "2ms", "1ms"), {S.ACTIVE}),
    "reorder": (("delay", "1ms", "reorder", "75%", "50%"), {S.ACTIVE, S.HOLD}),
    "duplicate": (("duplicate", "5%"), {S.ACTIVE}),
}


def opened(network: Network, channels: Sequence[str]) -> Bus:
    """Open one channel for all buses of the robot, or one channel for each bus."""
    if len(channels) == 1:
        return SocketCanBus(channels[0])
    return JoinedBus(network, dict(zip(network.buses, map(SocketCanBus, channels), strict=True)))


@dataclass
class Line:
    """HAL and emulated robot, each with its own socket. The robot runs in another thread."""

    hal: Hal
    loop: Loop
    emulator: Emulator
    operator: Operator
    stack: ExitStack  # closes sockets, body and thread at the end

    def socket(self) -> SocketCanBus:
        """Open one more socket on the same interface."""
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
        """Press START, and check that the HAL becomes ACTIVE."""
        self.operator.start()
        assert self.loop.cycles(ENABLE_CYCLES, S.ACTIVE) is S.ACTIVE, self.hal.reason

    def codes(self) -> list[str]:
        return [event.code for event in self.hal.events]


@pytest.fixture
def walking(network: Network, robot: Robot, urdf_text: str) -> Iterator[type]:
    """Return a context manager `walking(channel, ...)`, which yields a `Line` whose HAL is ACTIVE.

    With four channels, each bus of the robot has its own channel.
    """

    @contextmanager
    def on(*channels: str, patience: float = PATIENCE) -> Iterator[Line]:
        with ExitStack() as stack:
            buses = [opened(network, channels) for _ in range(2)]
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

            hal = Hal(network, robot, buses[1], patience=patience)
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
            while heard < 10 * RECEIVE_BUDGET:  # the HAL has the same number of frames in its receive buffer
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
        # The number of frames that a cycle reads is limited, so the flood delays no cycle.
        assert line.hal.state.cycle == before + 35
        assert max(after - before for before, after in pairwise(received)) <= RECEIVE_BUDGET
        assert line.loop.cycles(200) is S.HOLD  # the HAL stays in HOLD after the flood
        assert line.drives_hold
        line.start()


@pytest.mark.usefixtures("loaded_commands")
def test_f14_a_second_hal_refuses_to_start_and_does_not_disturb_the_first(vcan: str, walking, tmp_path: Path) -> None:
    with walking(vcan) as line:
        arguments = ("jog", "left_SK", "--to", "3", "-i", "socketcan", "-c", vcan, "--lockstep")
        second = Terminal(tmp_path / "jog.log", *arguments)
        try:
            while second.running:
                assert line.loop.cycles(1) is S.ACTIVE, line.hal.reason
        finally:
            second.end()
        assert "another HAL is active on vcan0" in second.text()
        assert second.exit_code == 1


def test_f14_a_running_hal_holds_in_the_cycle_in_which_it_receives_another(
    vcan: str, walking, network: Network, robot: Robot
) -> None:
    with walking(vcan) as line:
        line.loop.cycles(20)
        heard = line.hal.state.cycle + 1
        Hal(network, robot, line.socket(), patience=0.0).read()  # a HAL that did not listen before its first SYNC
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
        line.operator.start()  # the HAL does not receive this START
        assert line.loop.cycles(30) is S.HOLD
        assert line.hal.state.cycle == before + 35
        assert line.drives_hold  # without a command of the HAL

        as_root("ip", "link", "set", spare_vcan, "up")
        assert line.loop.cycles(60) is S.HOLD  # the START that was pressed without a link has no effect
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


def test_f16_one_of_four_interfaces_is_removed_and_comes_back(four_vcans: list[str], walking) -> None:
    with walking(*four_vcans) as line:
        line.loop.cycles(20)
        lost = four_vcans[1]
        remove(lost)
        assert line.loop.cycles(2) is S.HOLD
        line.loop.cycles(30)
        assert f"{lost} was removed" in line.hal.reason
        bus = line.hal.network.buses[1]
        assert set(line.hal.missing()) == {m.sender for m in line.hal.network.messages if m.bus == bus} - {"HAL"}
        assert line.drives_hold
        create(lost)
        line.reconnect()
        line.start()
        assert line.loop.cycles(20) is S.ACTIVE, line.hal.reason


def test_a_second_robot_on_the_bus_ends_in_hold_and_refuses_start(
    vcan: str, walking, network: Network, robot: Robot, urdf_text: str
) -> None:
    with walking(vcan) as line:
        body = PyBulletBody(urdf_text)
        line.stack.callback(body.close)
        second = Emulator(network, robot, body, line.socket(), seed=1)
        with repeated(lambda: second.poll(0.05)):
            assert line.loop.cycles(20, S.HOLD) is S.HOLD
            assert "NODE_DUPLICATE" in line.codes()
            line.operator.start()
            assert line.loop.cycles(60) is S.HOLD
        line.reconnect()
        line.loop.cycles(3000)  # the means of the inertial checks forget the values of the second robot
        line.start()


@pytest.mark.parametrize("disturbance", NETEM)
def test_a_disturbed_wire_ends_in_a_safe_state_and_the_robot_starts_again(
    spare_vcan: str, walking, disturbance: str
) -> None:
    arguments, allowed = NETEM[disturbance]
    netem = ("tc", "qdisc", "replace", "dev", spare_vcan, "root", "netem", *arguments)
    with walking(spare_vcan, patience=0.05) as line:
        line.loop.cycles(20)
        as_root(*netem, "limit", "10000")
        for _ in range(10):
            assert line.loop.cycles(30) in allowed, line.hal.reason
        assert line.hal.crc_errors == 0
        as_root("tc", "qdisc", "del", "dev", spare_vcan, "root")
        line.loop.cycles(30)
        line.reconnect()
        if line.hal.state.supervisor is not S.ACTIVE:
            line.start()
        assert line.loop.cycles(50) is S.ACTIVE, line.hal.reason
