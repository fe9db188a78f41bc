"""End condition of a walk on the ground: what happens after the motion has ended."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.start import PROGRAM_ENDS, stop_text
from atalante_hal.types import SupervisorState
from atalante_tools.console.outcome import Failed, FaultLatched
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.session.rig import UNCONFIRMED
from atalante_tools.session.walk_observation import AFTERMATH, Observation
from atalante_tools.session.walk_watch import WalkWatch

HOLD, ACTIVE = SimpleNamespace(supervisor=SupervisorState.HOLD), SimpleNamespace(supervisor=SupervisorState.ACTIVE)


class Walk:
    """Walk whose HAL and controller a test sets by hand."""

    def __init__(self) -> None:
        self.ended, self.stop, self.fallen = 0, StopRequest(), False
        self.hal = SimpleNamespace(
            moving=True, reason="READY -> ACTIVE", end=self._end, conditions=SimpleNamespace(diagnostics=frozenset()),
            state=ACTIVE,
        )  # fmt: skip
        self.controller = SimpleNamespace(
            done=False, walking=True, stop=lambda: None, statistics=SimpleNamespace(steps=2)
        )
        rig: Any = SimpleNamespace(hal=self.hal, target="embedded")
        observation: Any = SimpleNamespace(check=lambda: self.fallen)
        controller: Any = self.controller
        self.watch = WalkWatch(rig, controller, observation, self.stop, 5)

    def _end(self) -> None:
        self.ended += 1

    def cycle(self, state: Any) -> bool:
        return self.watch(state)

    def halt(self, reason: str) -> None:
        """Walk for a cycle, then leave ACTIVE for the reason."""
        assert not self.cycle(ACTIVE)
        self.leave(reason)

    def leave(self, reason: str) -> None:
        self.hal.moving, self.hal.reason, self.hal.state = False, reason, HOLD


@pytest.fixture
def walk(monkeypatch: pytest.MonkeyPatch) -> Walk:
    monkeypatch.setattr("atalante_tools.console.terminal.Progress.due", lambda _progress: False)
    return Walk()


def test_robot_in_hold_is_observed_for_some_time_without_a_second_walk(walk: Walk) -> None:
    walk.halt("left_SK: implausible")
    assert [walk.cycle(HOLD) for _ in range(AFTERMATH + 1)] == [False] * AFTERMATH + [True]
    assert walk.ended == 1
    with pytest.raises(Failed, match="the robot went to HOLD: left_SK: implausible"):
        walk.watch.conclude()


@pytest.mark.parametrize(("before", "after"), [(0, 1), (1, 1), (2, 0)])
def test_stop_signal_ends_the_observation(walk: Walk, before: int, after: int) -> None:
    for _ in range(before):
        walk.stop.ask(2)
    walk.halt(PROGRAM_ENDS)
    if after:
        assert not any(walk.cycle(HOLD) for _ in range(10))
        walk.stop.ask(2)
    assert walk.cycle(HOLD)


@pytest.mark.parametrize("before", [0, 1])
def test_signals_before_and_in_hold_do_not_replace_the_reason_of_the_hold(walk: Walk, before: int) -> None:
    assert not walk.cycle(ACTIVE)
    for _ in range(before):
        walk.stop.ask(2)
    walk.leave("left_SK: implausible")
    assert not walk.cycle(HOLD)
    walk.stop.ask(2)
    assert walk.cycle(HOLD)
    with pytest.raises(Failed, match="the robot went to HOLD: left_SK: implausible"):
        walk.watch.conclude()


def test_fault_state_after_a_signal_is_reported_as_latched(walk: Walk) -> None:
    walk.halt("left_SK: too hot")
    walk.stop.ask(2)
    assert not walk.cycle(SimpleNamespace(supervisor=SupervisorState.FAULT))
    walk.stop.ask(2)
    assert walk.cycle(SimpleNamespace(supervisor=SupervisorState.FAULT))
    with pytest.raises(FaultLatched, match="the robot is in FAULT: left_SK: too hot"):
        walk.watch.conclude()


def test_second_signal_in_a_step_ends_with_the_exit_code_of_the_signal(
    walk: Walk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not walk.cycle(ACTIVE)
    walk.stop.ask(2)
    walk.stop.ask(2)
    walk.leave(PROGRAM_ENDS)
    assert walk.cycle(HOLD)
    with pytest.raises(SystemExit) as end:
        walk.watch.conclude()
    assert end.value.code == 130
    assert "stopped, the robot is in HOLD" in capsys.readouterr().err


def test_signal_before_the_start_reports_the_state_of_the_robot(walk: Walk, capsys: pytest.CaptureFixture[str]) -> None:
    ready = SimpleNamespace(supervisor=SupervisorState.READY)
    walk.hal.moving, walk.hal.state = False, ready
    assert not walk.cycle(ready)
    walk.stop.ask(2)
    assert walk.cycle(ready)
    with pytest.raises(SystemExit) as end:
        walk.watch.conclude()
    assert end.value.code == 130
    assert "stopped, the robot is in READY" in capsys.readouterr().err


class TestObservationWithoutEmulator:
    """The robot is real, so its attitude is only known from the controller and the pelvis IMU."""

    @staticmethod
    def leaning(degrees: float) -> list[float]:
        half = math.radians(degrees) / 2.0
        return [math.cos(half), 0.0, math.sin(half), 0.0]

    @pytest.fixture
    def hal(self) -> Any:
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
        return SimpleNamespace(moving=False, state=SimpleNamespace(cycle=0, imu_quaternion=quaternions))

    @pytest.fixture
    def observation(self, hal: Any) -> Observation:
        rig: Any = SimpleNamespace(hal=hal, access=None)
        controller: Any = SimpleNamespace(vertical=np.array([0.0, 0.0, 1.0]))
        return Observation(rig, controller, None)

    def test_robot_that_leans_before_the_start_has_not_fallen(self, hal: Any, observation: Observation) -> None:
        hal.state.imu_quaternion[1] = self.leaning(80.0)
        assert not observation.check()

    @pytest.mark.parametrize(("degrees", "fell"), [(34.0, False), (36.0, True), (-36.0, True)])
    def test_fall_after_the_motion_is_detected_by_the_pelvis_imu(
        self, hal: Any, observation: Observation, degrees: float, fell: bool
    ) -> None:
        hal.moving = True
        assert not observation.check()
        hal.moving = False
        hal.state.imu_quaternion[1] = self.leaning(degrees)
        assert observation.check() is fell


def test_bus_that_is_down_ends_the_observation(walk: Walk) -> None:
    walk.halt("the bus is down")
    walk.hal.conditions.diagnostics = frozenset({Dtc.BUS_DOWN})
    assert walk.cycle(HOLD)
    with pytest.raises(Failed, match=f"the HAL went to HOLD: the bus is down; {UNCONFIRMED}"):
        walk.watch.conclude()


def test_stop_of_the_operator_before_the_weight_shift_is_no_failure(
    walk: Walk, capsys: pytest.CaptureFixture[str]
) -> None:
    walk.controller.walking = False
    walk.halt(stop_text(stop_requested=True))
    assert walk.cycle(HOLD)
    assert walk.watch.outcome == "stopped"
    walk.watch.conclude()
    assert "stopped by the operator, the robot stands in HOLD" in capsys.readouterr().err


def test_stop_of_the_operator_in_a_step_is_observed(walk: Walk) -> None:
    walk.halt(stop_text(stop_requested=True))
    assert not walk.cycle(HOLD)


def test_fall_in_active_has_no_reason(walk: Walk) -> None:
    assert not walk.cycle(ACTIVE)
    walk.fallen = True
    assert walk.cycle(ACTIVE)
    with pytest.raises(Failed, match=r"the robot fell in step 2$"):
        walk.watch.conclude()


def test_stop_request_that_came_before_the_start_of_the_walk_is_passed_on_again(walk: Walk) -> None:
    stops: list[None] = []
    walk.controller.stop = lambda: stops.append(None)
    assert not walk.cycle(ACTIVE)
    walk.stop.ask(2)
    assert not walk.cycle(ACTIVE)
    assert stops == [None]
