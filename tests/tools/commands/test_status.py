"""`atalante status`: report of the observer, tables, JSON object, exit codes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_dbc import Network, wire_time
from atalante_hal.bus import BusDown
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import FRAME, Frames, new_frames
from atalante_tools.cli import cli
from atalante_tools.commands import observer as observer_module
from atalante_tools.commands import status
from atalante_tools.commands.observer import NodeReport, Observer, Report, as_json
from atalante_tools.commands.status import render
from atalante_tools.console.options import Target
from atalante_tools.session import listening
from atalante_tools.session import rig as rig_module
from tests.tools.commands.recorder import Tap

TARGET = Target("pcan", "test", lockstep=False)


@pytest.fixture(scope="module")
def traffic(network: Network, robot: Robot, urdf_text: str) -> list[Frames]:
    """Return all frames of half a second from power-on to ACTIVE, one block per cycle."""
    from atalante_emulator.bodies.pybullet_body import PyBulletBody
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator
    from atalante_hal.bus.pair import lockstep_pair
    from atalante_hal.hal import Hal
    from atalante_tools.session.pose_hold import PoseHold

    ours, theirs = lockstep_pair()
    body = PyBulletBody(urdf_text)
    emulator = Emulator(network, robot, body, theirs, operator=Operator(0.25))
    ours.step = emulator.poll
    tap = Tap()
    hal = Hal(network, robot, ours, tap=tap)
    controller = PoseHold(robot)
    for _ in range(510):
        state = hal.read()
        if state.supervisor.name == "ACTIVE":
            if not controller.elapsed:
                controller.reset(state)
            hal.write(controller.update(state))
        else:
            hal.hold()
    body.close()
    assert hal.state.supervisor.name == "ACTIVE"
    return tap.cycles(network.message("SYNC_LEFT_LEG").frame_id)[:500]


def observe(network: Network, robot: Robot, cycles: list[Frames], start: float = 10.0) -> tuple[Observer, float]:
    """Return an observer that has received these cycles, and its time afterwards."""
    observer = Observer(network, robot, start)
    block = new_frames(64)
    for number, frames in enumerate(cycles, 1):
        block[: len(frames)] = frames
        observer.accept(block, len(frames), start + number * 1e-3)
    return observer, start + len(cycles) * 1e-3


def node(report: Report, name: str) -> NodeReport:
    return next(n for n in report.nodes if n.node == name)


def test_the_report_contains_the_state_of_every_node(network: Network, robot: Robot, traffic: list[Frames]) -> None:
    observer, now = observe(network, robot, traffic)
    report = observer.report(now)
    assert report.supervisor == "ACTIVE"
    assert report.assistance_factor == pytest.approx(0.25)
    assert report.dead_man is True
    assert report.cycle is not None
    assert abs(report.cycle - 500) <= 1
    assert report.crc_errors == 0
    assert report.foreign == 0
    assert report.diagnostic is None
    assert [n.node for n in report.nodes] == [n.name for n in network.nodes]
    for n in report.nodes:
        assert n.age_ms is not None
        assert n.age_ms <= (10 if n.kind == "haptics" else 1), n
        assert (n.late, n.dbc_ok) == (False, True), n
        assert n.kind == "master" or n.supply_v == pytest.approx(48.0)
    assert node(report, "LEFT_SK").state == "OPERATION_ENABLED"
    assert node(report, "LEFT_SK").temperature_degc == pytest.approx(25.0)
    assert node(report, "IMU_TORSO").state == "OK"
    assert node(report, "PENDANT").state == "OPERATIONAL"
    assert [j.drive_state for j in report.joints] == ["OPERATION_ENABLED"] * 12


def test_joint_values_are_in_degrees_on_the_output_side(network: Network, robot: Robot) -> None:
    from dataclasses import replace

    from atalante_hal.wire.process_image import TransmitImage

    turned = replace(robot, polarity=np.full(12, -1.0))
    image = TransmitImage([network.message(f"{joint.upper()}_STATE") for joint in JOINTS])
    codec = image.codec
    image.values[codec.slice("DriveState")] = DriveState.FAULT
    image.values[codec.slice("Position")] = np.radians(30.0) * robot.gear
    image.values[codec.slice("Velocity")] = np.radians(-5.0) * robot.gear
    image.values[codec.slice("Torque")] = 12.5
    for robot_, sign in ((robot, 1.0), (turned, -1.0)):
        observer = Observer(network, robot_, 0.0)
        observer.accept(image.seal(), 12, 0.001)
        for joint in observer.report(0.002).joints:
            assert joint.position_deg == pytest.approx(sign * 30.0, abs=1e-3)
            assert joint.velocity_deg_s == pytest.approx(sign * -5.0, abs=0.02)
            assert joint.torque_nm == pytest.approx(sign * 12.5)
            assert joint.drive_state == "FAULT"


def test_the_age_of_a_lost_node_increases(network: Network, robot: Robot, traffic: list[Frames]) -> None:
    ids = {m.frame_id for m in network.sent_by("LEFT_SK")}
    silent = [frames[[i not in ids for i in frames["can_id"].tolist()]] for frames in traffic[400:]]
    observer, now = observe(network, robot, traffic[:400] + silent)
    report = observer.report(now)
    lost = node(report, "LEFT_SK")
    assert lost.late
    assert lost.age_ms == pytest.approx(100, abs=1)
    assert [n.node for n in report.nodes if n.late] == ["LEFT_SK"]
    assert f"LEFT_SK          {lost.age_ms} ms ago" in render(report, TARGET)


def test_node_that_sends_only_status_messages_is_not_shown_as_never_received(network: Network, robot: Robot) -> None:
    from atalante_hal.wire.process_image import TransmitImage

    image = TransmitImage([network.message("LEFT_SK_STATUS")])
    observer = Observer(network, robot, 0.0)
    observer.accept(image.seal(), 1, 0.001)
    observer.accept(new_frames(0), 0, 0.101)
    report = observer.report(0.101)
    sk = node(report, "LEFT_SK")
    assert (sk.age_ms, sk.status_late) == (None, False)
    assert sk.status_age_ms == pytest.approx(100, abs=1)
    assert [n.node for n in report.nodes if n.status_age_ms is not None] == ["LEFT_SK"]
    table = render(report, TARGET)
    assert "LEFT_SK          status only" in table
    assert "LEFT_SA          never" in table
    observer.accept(new_frames(0), 0, 1.001)
    report = observer.report(1.001)
    sk = node(report, "LEFT_SK")
    assert sk.status_age_ms == pytest.approx(1000, abs=1)
    assert f"LEFT_SK          status {sk.status_age_ms} ms ago" in render(report, TARGET)


def test_a_lost_hal_is_reported_in_the_first_line(network: Network, robot: Robot, traffic: list[Frames]) -> None:
    observer, now = observe(network, robot, [*traffic, *[new_frames(0)] * 600])
    assert render(observer.report(now), TARGET).startswith(
        "pcan test: no SYNC of the HAL for 600 ms; it was ACTIVE in cycle 5"
    )


def test_values_never_received_are_none(network: Network, robot: Robot) -> None:
    report = Observer(network, robot, 0.0).report(1.0)
    assert report.supervisor is None
    assert all(n.age_ms is None and n.late and n.state is None and n.dbc_ok is None for n in report.nodes)
    assert all(j.position_deg is None for j in report.joints)
    assert "no HAL (no SYNC received)" in render(report, TARGET)


def test_a_different_dbc_and_damaged_frames_are_reported(network: Network, robot: Robot, traffic: list[Frames]) -> None:
    from dataclasses import replace

    observer, now = observe(replace(network, hash32=network.hash32 ^ 1), robot, traffic)
    other = observer.report(now)
    assert all(n.dbc_ok is False for n in other.nodes)
    assert "OTHER" in render(other, TARGET)

    damaged = [frames.copy() for frames in traffic[:100]]
    for frames in damaged:
        frames["data"][0, 5] ^= 0x10
    observer, now = observe(network, robot, damaged)
    first, second = observer.report(now, 7), observer.report(now + 1.0, 9)
    assert (first.crc_errors, first.dropped) == (100, 7)
    assert (second.crc_errors, second.dropped) == (0, 2)


def test_the_bus_load_is_the_wire_time_of_the_received_frames(
    network: Network, robot: Robot, traffic: list[Frames]
) -> None:
    observer, now = observe(network, robot, traffic)
    load = observer.report(now).load
    bus_of = {m.frame_id: m.bus for m in network.messages}
    for bus, (measured, worst) in load.items():
        frames = np.concatenate(traffic)
        lengths = [
            n for i, n in zip(frames["can_id"].tolist(), frames["len"].tolist(), strict=True) if bus_of[i] == bus
        ]
        assert measured == pytest.approx(sum(map(wire_time, lengths)) / 0.5)
        assert worst == pytest.approx(network.bus_load()[bus])
        assert 0.3 < measured <= worst
    assert observer.report(now + 1.0).load["left_leg"][0] == 0.0


def test_foreign_frames_are_counted(network: Network, robot: Robot) -> None:
    observer = Observer(network, robot, 0.0)
    frames = new_frames(3)
    frames["can_id"] = 0x7FE
    observer.accept(frames, 3, 0.001)
    report = observer.report(0.01)
    assert (report.frames, report.foreign) == (3, 3)
    assert "3 with an identifier that is not in the DBC" in render(report, TARGET)


def test_emergency_is_reported_with_code_and_register(network: Network, robot: Robot) -> None:
    from atalante_hal.wire.process_image import TransmitImage

    image = TransmitImage([network.message("LEFT_SK_EMCY")])
    image.values[image.codec.index("LEFT_SK_EMCY", "ErrorRegister")] = 0x09
    image.values[image.codec.index("LEFT_SK_EMCY", "ErrorCode")] = 0x4310
    observer = Observer(network, robot, 0.0)
    observer.accept(image.seal(), 1, 0.001)
    assert node(observer.report(0.002), "LEFT_SK").emergency == "0x4310 (register 0x09)"


def test_the_json_object_contains_the_whole_report(network: Network, robot: Robot, traffic: list[Frames]) -> None:
    observer, now = observe(network, robot, traffic)
    value = json.loads(json.dumps(as_json(observer.report(now))))
    assert value["supervisor"] == "ACTIVE"
    assert set(value["load"]["left_leg"]) == {"measured", "worst_case"}
    assert value["joints"][3]["joint"] == "left_SK"
    assert len(value["nodes"]) == len(network.nodes)


# -- the command -----------------------------------------------------------------------------------------------------


class Recorded:
    """Bus that delivers one cycle per `receive` and rejects every `send`.

    Two frames were dropped before the first cycle, and one frame is dropped in every 100th cycle. As in SocketCAN, `dropped`
    counts them as soon as the next cycle is received.
    """

    name = "recorded"
    stamps = np.zeros(256, np.int64)

    def __init__(self, cycles: list[Frames], clock: Callable[[], None]) -> None:
        self._cycles, self._clock = iter(cycles), clock
        self._calls = 0
        self.closed = False

    @property
    def dropped(self) -> int:
        return 2 + self._calls // 100 if self._calls else 0

    def send(self, frames: Frames) -> None:
        raise AssertionError("status sends nothing")

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        self._clock()
        self._calls += 1
        cycle = next(self._cycles, np.zeros(0, FRAME))
        frames[: len(cycle)] = cycle
        return len(cycle)

    def close(self) -> None:
        self.closed = True


class Clock:
    """Simulated clock."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


def invoke(
    monkeypatch: pytest.MonkeyPatch,
    cycles: list[Frames],
    *arguments: str,
    clock: Clock | None = None,
    opens: Callable[[], None] = lambda: None,
) -> Result:
    clock = clock or Clock()

    def tick() -> None:
        clock.now += 1e-3

    def open_buses(network: Network, target: Target) -> dict[str, Recorded]:
        opens()
        return dict.fromkeys(network.buses, bus)

    bus = Recorded(cycles, tick)
    for module in (status, listening):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(rig_module, "open_buses", open_buses)
    result = CliRunner().invoke(cli, ["status", "-i", "pcan", "-c", "test", *arguments])
    assert bus.closed
    return result


def test_table_shows_hal_state_joints_and_bus_load(monkeypatch: pytest.MonkeyPatch, traffic: list[Frames]) -> None:
    result = invoke(monkeypatch, traffic, "--for", "0.4")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("pcan test: HAL ACTIVE, cycle ")
    assert "assistance factor 0.25" in result.stdout
    assert "dead-man switch pressed" in result.stdout
    assert "4 lost" in result.stdout  # without the frames that were lost before the measurement
    assert "left_SK" in result.stdout
    assert "measured load %  computed worst case %" in result.stdout
    assert result.stderr == ""


@pytest.mark.sample(2)
@pytest.mark.parametrize(("lost_at", "code"), [(300, 0), (100, 1)])
def test_lost_link_is_in_the_first_line_of_the_table(
    monkeypatch: pytest.MonkeyPatch, traffic: list[Frames], lost_at: int, code: int
) -> None:
    def receive(self: Recorded, frames: Frames, timeout: float = 0.0) -> int:
        if self._calls < lost_at:
            return received(self, frames, timeout)
        self._clock()
        raise BusDown("test is down: plug the adapter in")

    received = Recorded.receive
    monkeypatch.setattr(Recorded, "receive", receive)
    result = invoke(monkeypatch, traffic, "--for", "0.4")
    assert result.stdout.startswith("the link is lost: test is down: plug the adapter in\n\npcan test: ")
    assert result.exit_code == code
    assert result.stderr.endswith("atalante: test is down: plug the adapter in\n") == (code == 1)
    (line,) = invoke(monkeypatch, traffic, "--for", "0.4", "--json").stdout.splitlines()
    assert json.loads(line)["link"] == "test is down: plug the adapter in"


def test_json_output_is_one_object(monkeypatch: pytest.MonkeyPatch, traffic: list[Frames]) -> None:
    result = invoke(monkeypatch, traffic, "--for", "0.5", "--json")
    assert result.exit_code == 0
    (line,) = result.stdout.splitlines()
    assert json.loads(line)["supervisor"] == "ACTIVE"


def test_first_table_measures_only_the_time_of_listening(
    monkeypatch: pytest.MonkeyPatch, traffic: list[Frames]
) -> None:
    clock = Clock()
    order: list[str] = []

    class SlowObserver(Observer):
        def __init__(self, network: Network, robot: Robot, now: float) -> None:
            super().__init__(network, robot, now)
            order.append("observer created")
            clock.now += 1.3

    def open_slowly() -> None:
        order.append("bus opened")
        clock.now += 0.2

    monkeypatch.setattr(observer_module, "Observer", SlowObserver)
    result = invoke(monkeypatch, traffic, "--for", "0.5", "--json", clock=clock, opens=open_slowly)
    assert json.loads(result.stdout)["seconds"] == pytest.approx(0.5)
    assert order == ["observer created", "bus opened"]


def test_a_bus_without_frames_fails_with_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    result = invoke(monkeypatch, [], "--for", "0.1", "--json")
    assert result.exit_code == 1
    assert (
        "no frame received on pcan test for 0.1 s: start a robot (atalante emulator -i pcan -c test)" in result.stderr
    )
    assert json.loads(result.stdout)["frames"] == 0


def test_latched_fault_exits_with_code_4(
    monkeypatch: pytest.MonkeyPatch, network: Network, robot: Robot, traffic: list[Any]
) -> None:
    from atalante_hal.wire.process_image import TransmitImage

    image = TransmitImage([network.message("LEFT_SK_STATE")])
    image.values[image.codec.index("LEFT_SK_STATE", "DriveState")] = DriveState.FAULT
    result = invoke(monkeypatch, [image.seal()] * 150, "--for", "0.1")
    assert result.exit_code == 4
    assert result.stderr == "atalante: a fault is latched: left_SK\n"
