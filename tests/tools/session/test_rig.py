"""Tests of the rig: a HAL on any bus, its closing, and how a run ends."""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.faults import Fault
from atalante_emulator.pendant import Operator
from atalante_hal.bus import BusAbsent, BusDown
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import Command, State, SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed, FaultLatched
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session.body import open_body
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import (
    LOCKSTEP_PATIENCE,
    PATIENCE,
    UNCONFIRMED,
    Rig,
    Watch,
    final_state,
    join,
    open_buses,
    open_hal,
    waiting_for,
)

EMBEDDED = Target("embedded", "", lockstep=True)
ACTIVE, HOLD, FAULT = SupervisorState.ACTIVE, SupervisorState.HOLD, SupervisorState.FAULT


class Tap:
    def __init__(self) -> None:
        self.frames = bytearray()

    def sent(self, frames: Frames) -> None:
        self.frames += frames.tobytes()

    def received(self, frames: Frames, count: int) -> None:
        self.frames += frames[:count].tobytes()


def embedded(network: Network, robot: Robot, **options: Any) -> AbstractContextManager[Rig]:
    """Open a rig for `PoseHold`."""
    return open_hal(EMBEDDED, network=network, robot=robot, controller_fields=PoseHold.telemetry_fields, **options)


def watched(
    rig: Rig,
    *,
    seconds: float = 0.05,
    each: Callable[[State], None] = lambda state: None,
    stop: StopRequest | None = None,
) -> Watch:
    """Run a pose hold for `seconds` in ACTIVE and return its watch; `each` is called before every check of the end condition."""
    controller = PoseHold(rig.hal.robot)
    watch = Watch(rig, stop or StopRequest(), lambda state: controller.elapsed >= seconds, lambda state: "moving")

    def until(state: State) -> bool:
        each(state)
        return watch(state) or state.cycle > 2000

    rig.run(controller, until=until)
    return watch


def test_the_embedded_rig_becomes_active_and_ends_in_hold(network: Network, robot: Robot) -> None:
    with embedded(network, robot) as rig:
        assert rig.emulator is not None
        assert rig.operator is not None
        watched(rig).conclude()
        assert rig.hal.state.supervisor is HOLD
        assert rig.emulator.drives.state == [DriveState.QUICK_STOP_ACTIVE] * 12
        bus = rig.hal.bus
    with pytest.raises(BusDown):
        bus.receive(new_frames(1))


def test_equal_seeds_give_equal_bytes_on_the_bus(network: Network, robot: Robot) -> None:
    def run(seed: int) -> bytes:
        tap = Tap()
        with embedded(network, robot, seed=seed, tap=tap) as rig:
            watched(rig)
        return bytes(tap.frames)

    first = run(3)
    assert run(3) == first
    assert run(4) != first


def test_pose_operator_and_record_of_the_caller_are_used(network: Network, robot: Robot) -> None:
    pose = [0.0] * 12
    pose[JOINTS.index("left_SK")] = 0.5
    mine = Operator(0.25, starts=False)
    fields = [("height", 3)]
    with open_hal(
        EMBEDDED, network=network, robot=robot, pose=pose, operator=mine, controller_fields=fields, gait_hash=7
    ) as rig:
        state = rig.hal.read()
        assert state.position[JOINTS.index("left_SK")] == pytest.approx(0.5, abs=1e-4)
        for _ in range(400):
            rig.hal.hold()
            rig.hal.read()
        assert state.supervisor is SupervisorState.READY
        assert state.assistance_factor == pytest.approx(0.25, abs=1e-4)
        assert rig.hal.layout["controller.height"].stop - rig.hal.layout["controller.height"].start == 3
        assert rig.operator is mine


@pytest.mark.parametrize(("lockstep", "patience"), [(False, PATIENCE), (True, LOCKSTEP_PATIENCE)])
def test_wait_for_the_nodes_depends_on_the_clock_of_the_bus(
    network: Network, robot: Robot, lockstep: bool, patience: float
) -> None:
    with open_hal(Target("virtual", "rig-clock", lockstep), network=network, robot=robot) as rig:
        assert rig.hal.patience == patience
        assert rig.emulator is None
        assert rig.operator is None


def test_several_channels_are_joined_and_one_channel_is_not(network: Network) -> None:
    channels = "left_leg=rig-a,right_leg=rig-b,left_sense=rig-a,right_sense=rig-b"
    buses = open_buses(network, Target("virtual", channels, lockstep=False))
    joined = join(network, buses)
    assert isinstance(joined, JoinedBus)
    assert joined.name == "virtual:rig-a + virtual:rig-b"
    joined.close()
    buses = open_buses(network, Target("virtual", "rig-c", lockstep=False))
    assert join(network, buses) is buses["left_leg"]
    buses["left_leg"].close()


def test_a_missing_bus_is_rejected(network: Network, robot: Robot) -> None:
    with pytest.raises(BusAbsent, match="pigeon"), open_hal(Target("pigeon", "x", False), network=network, robot=robot):
        raise AssertionError("opened")


def test_missing_pybullet_fails_with_the_installation_command(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "atalante_emulator.bodies.pybullet_body", raising=False)
    with pytest.raises(Failed, match=r"pip install 'atalante-hal\[emulator\]' \(Python 3\.11\)$"), open_body(robot):
        raise AssertionError("opened")


@pytest.mark.parametrize("python", [(3, 12), (3, 13), (4, 0)])
def test_missing_pybullet_error_on_newer_python_names_version_3_11(
    robot: Robot, python: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.setattr(sys, "version_info", (*python, 0))
    with pytest.raises(Failed) as refused, open_body(robot):
        raise AssertionError("opened")
    assert str(refused.value) == (
        "the emulated robot needs PyBullet; type: pip install 'atalante-hal[mujoco]' and add --engine mujoco, "
        "or python3.11 -m pip install 'atalante-hal[emulator]'"
        f" (PyBullet has no wheel for Python above 3.11, got {python[0]}.{python[1]})"
    )


# -- how a run ends --------------------------------------------------------------------------------------------------


def test_signal_ends_the_run_in_hold_with_its_exit_code(network: Network, robot: Robot) -> None:
    stop = StopRequest()
    with embedded(network, robot) as rig:
        watch = watched(
            rig, seconds=1.0, stop=stop, each=lambda state: stop.ask(15) if state.supervisor is ACTIVE else None
        )
        assert rig.hal.state.supervisor is HOLD
    with pytest.raises(SystemExit) as end:
        watch.conclude()
    assert end.value.code == 143


@pytest.mark.parametrize("signals", [1, 2])
def test_signal_ends_a_run_whose_end_condition_never_becomes_true(network: Network, robot: Robot, signals: int) -> None:
    """The first signal leads to HOLD. With `on_stop`, the first signal calls this function, and the second leads to HOLD."""
    sent = 0
    stops: list[int] = []

    def until(state: State) -> bool:
        nonlocal sent
        assert state.cycle < 2000, "the run does not end"
        if state.supervisor is ACTIVE and sent < signals:
            sent += 1
            signal.raise_signal(signal.SIGINT)
        return False

    with embedded(network, robot) as rig:
        rig.run(PoseHold(robot), until=until, on_stop=(lambda: stops.append(sent)) if signals == 2 else None)
        assert rig.hal.state.supervisor is HOLD
    assert (sent, stops) == (signals, [1] if signals == 2 else [])


class LosableBus(WrappedBus):
    """Bus whose link is lost for ever as soon as `lost` is set."""

    lost = False

    def send(self, frames: Frames) -> None:
        if self.lost:
            raise BusDown(f"{self.name} is down: gone")
        super().send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        if self.lost:
            raise BusDown(f"{self.name} is down: gone")
        return super().receive(frames, timeout)


@pytest.mark.parametrize("resumes", [False, True])
def test_no_hold_is_reported_as_confirmed_after_the_link_was_lost(
    network: Network, robot: Robot, capsys: pytest.CaptureFixture[str], resumes: bool
) -> None:
    stop = StopRequest()
    with embedded(network, robot) as rig:
        rig.hal.bus = bus = LosableBus(rig.hal.bus)
        watch = Watch(rig, stop, lambda state: False, lambda state: "moving", resumes=resumes)

        def until(state: State) -> bool:
            bus.lost = bus.lost or state.supervisor is ACTIVE
            if state.supervisor is HOLD:
                stop.ask(2)  # with `resumes`, the run waits in HOLD until Ctrl-C
            return watch(state) or state.cycle > 2000

        rig.run(PoseHold(robot), until=until)
        assert final_state(rig) == UNCONFIRMED
        with pytest.raises(SystemExit) as end:
            watch.conclude()
    assert end.value.code == 130
    error = capsys.readouterr().err
    assert error.endswith(f"stopped, {UNCONFIRMED}\n")
    assert "the robot is in HOLD" not in error


def test_lost_link_ends_the_run_without_a_confirmed_hold(network: Network, robot: Robot) -> None:
    with embedded(network, robot) as rig:
        rig.hal.bus = bus = LosableBus(rig.hal.bus)

        def lose(state: State) -> None:
            bus.lost = bus.lost or state.supervisor is ACTIVE

        watch = watched(rig, seconds=1.0, each=lose)
        with pytest.raises(Failed, match=f"the HAL went to HOLD: .* is down: gone; {UNCONFIRMED}"):
            watch.conclude()


def test_stop_of_the_operator_ends_the_run_as_failed(network: Network, robot: Robot) -> None:
    with embedded(network, robot) as rig:
        assert rig.operator is not None
        watch = watched(rig, seconds=1.0, each=lambda state: rig.operator.stop() if state.cycle == 400 else None)  # type: ignore[union-attr]
        assert rig.hal.state.cycle < 430
    with pytest.raises(Failed, match="went to HOLD: the operator asked to stop") as end:
        watch.conclude()
    assert end.value.exit_code == 1


@pytest.mark.parametrize("cycle", [150, 400])  # before and in ACTIVE
def test_drive_fault_ends_the_run_with_exit_code_4(network: Network, robot: Robot, cycle: int) -> None:
    with embedded(network, robot) as rig:
        assert rig.emulator is not None
        index = rig.emulator.signals.index("LEFT_SK_STATE", "DriveState")

        def break_drive(now: int, values: Any) -> None:
            if now >= cycle:
                values[index] = DriveState.FAULT

        rig.emulator.before_send.append(break_drive)
        watch = watched(rig, seconds=1.0)
    with pytest.raises(FaultLatched, match="FAULT: LEFT_SK: a drive is in FAULT") as end:
        watch.conclude()
    assert end.value.exit_code == 4


def test_controller_exception_ends_the_run_as_failed(network: Network, robot: Robot) -> None:
    class Broken(PoseHold):
        def update(self, state: State) -> Command:
            if self.elapsed > 0.01:
                raise ZeroDivisionError("no")
            return super().update(state)

    with embedded(network, robot) as rig:
        watch = Watch(rig, StopRequest(), lambda state: False, lambda state: "")
        rig.run(Broken(robot), until=watch)
    with pytest.raises(Failed, match="the controller raised ZeroDivisionError: no"):
        watch.conclude()


def test_a_waiting_run_prints_the_command_to_type(network: Network, robot: Robot) -> None:
    target = Target("virtual", "rig-alone", lockstep=False)
    with open_hal(target, network=network, robot=robot) as rig:
        rig.hal.read()
        assert waiting_for(rig) == (
            "no node answers on virtual rig-alone; to start an emulated robot, type `atalante emulator -i virtual -c rig-alone`"
        )
    with embedded(network, robot, operator=Operator(starts=False)) as rig:
        rig.hal.read()
        assert waiting_for(rig).startswith("waiting for LEFT_")
        for _ in range(150):
            rig.hal.hold()
            rig.hal.read()
        assert waiting_for(rig) == "READY: waiting for START of the emulated operator"
        rig.target = target
        assert waiting_for(rig) == ("READY: waiting for START; type `atalante pendant start -i virtual -c rig-alone`")


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (
            Fault("encoder_jump", "LEFT_SA", by=1.0),
            "OFF: left_SA is at 58.0 degrees, outside its range of -16.0 to 9.0",
        ),
        (
            Fault("value", "RIGHT_FH_STATE", Torque=-400.0),
            "READY: START refused: the drive of right_FH reports -400 Nm in SWITCH_ON_DISABLED",
        ),
    ],
)
def test_the_reason_of_a_refused_start_is_printed(network: Network, robot: Robot, fault: Fault, reason: str) -> None:
    with embedded(network, robot, operator=Operator(), faults=[fault]) as rig:
        for _ in range(400):
            rig.hal.read()
            rig.hal.hold()
        assert waiting_for(rig).startswith(reason)


def test_a_run_on_the_wall_clock_requests_real_time_priority(
    network: Network, robot: Robot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("atalante_tools.session.rig.realtime", lambda: ["memory is not locked"])
    wall, fields = Target("embedded", "", lockstep=False), PoseHold.telemetry_fields
    with open_hal(wall, network=network, robot=robot, controller_fields=fields) as rig:
        statistics = rig.run(PoseHold(robot), until=lambda state: state.cycle >= 5)
    assert statistics.cycles == 5
    assert "memory is not locked" in capsys.readouterr().err


# -- the controller --------------------------------------------------------------------------------------------------


def test_pose_hold_keeps_every_joint_at_its_measured_angle(network: Network, robot: Robot) -> None:
    with embedded(network, robot) as rig:
        # The joints are free until ACTIVE, so the legs move when the hold begins.
        watched(rig, seconds=0.5).conclude()
        target = rig.hal.record[rig.hal.layout["controller.reference"]]
        assert np.abs(rig.hal.state.position - target).max() < math.radians(0.1)


def test_run_after_the_end_of_the_program_ends_after_one_cycle(network: Network, robot: Robot) -> None:
    with embedded(network, robot) as rig:
        rig.run(PoseHold(robot), until=lambda state: state.supervisor is ACTIVE)
        assert rig.hal.ending
        assert rig.run(PoseHold(robot), until=lambda state: state.cycle > 10_000).cycles == 1


@pytest.mark.parametrize("resumes", [False, True])
def test_hold_ends_the_run_unless_it_resumes_at_start(
    network: Network, robot: Robot, capsys: pytest.CaptureFixture[str], resumes: bool
) -> None:
    with embedded(network, robot) as rig:
        assert rig.operator is not None
        operator, controller = rig.operator, PoseHold(rig.hal.robot)
        watch = Watch(
            rig, StopRequest(), lambda state: controller.elapsed >= 0.05, lambda state: "moving", resumes=resumes
        )
        held: list[int] = []

        def until(state: State) -> bool:
            if state.supervisor is ACTIVE and not held and controller.elapsed >= 0.02:
                operator.hold()
            if state.supervisor is HOLD:
                held.append(state.cycle)
                if len(held) == 50:
                    operator.start()
            return watch(state) or state.cycle > 2000

        rig.run(controller, until=until)
        assert len(held) >= 50 if resumes else len(held) == 1
        if resumes:
            watch.conclude()
            assert "HOLD: the operator asked" in capsys.readouterr().err
        else:
            with pytest.raises(Failed, match="the robot went to HOLD: the operator asked"):
                watch.conclude()
