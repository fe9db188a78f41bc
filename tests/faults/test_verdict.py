"""Tests of the verdict: each of its four conditions can fail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.events import Event
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.faults.command_check import Commands, SentFrames
from atalante_tools.faults.matrix import Row
from atalante_tools.faults.observation import RESTARTED, Observation
from atalante_tools.faults.scenario import Case
from atalante_tools.faults.verdict import Expectation, Verdict, automatic_improvements, evaluate

S = SupervisorState
FIRST, PRESSED = 11, 41
ROW = Row("F99", "", "", "2 / 5", "", S.HOLD, "NODE_TIMEOUT", ())
#: ACTIVE, HOLD from the fifth faulty cycle, ACTIVE again after START.
IMPROVED = "the state must not improve without the operator, but it became ACTIVE in cycle 31"
STEP = [S.ACTIVE] * RESTARTED
HELD = [S.ACTIVE] * 14 + [S.HOLD] * 28 + STEP
EXPECTED_EVENTS = (Event(12, "NODE_TIMEOUT", "", node="LEFT_SK"),)


@pytest.fixture
def make_observation(network: Network, robot: Robot) -> Any:
    def make(
        states: Sequence[S] = HELD,
        events: Sequence[Event] = EXPECTED_EVENTS,
        *,
        held: int | None = None,
        pressed: int | None = PRESSED,
        **arrays: Any,
    ) -> Observation:
        """Return an observation with these states. HOLD frames begin in cycle `held`, or when the state is HOLD or worse."""
        sent = SentFrames()
        tx = TransmitImage([network.message(f"COMMAND_{side}_LEG") for side in ("LEFT", "RIGHT")])
        for cycle, state in enumerate(states, 1):
            holds = state >= S.HOLD or (held is not None and held <= cycle < PRESSED)
            tx.values[tx.codec.slice("Controlword")] = Controlword.QUICK_STOP if holds else Controlword.ENABLE_OPERATION
            sent.cycle = cycle
            sent.sent(tx.seal())
        joints = np.zeros((len(states), 12))
        rows = dict.fromkeys(("drive_state", "torque", "position", "velocity", "temperature"), joints)
        return Observation(
            network=network, robot=robot, first=FIRST, over=None, pressed=pressed, states=tuple(states), events=tuple(events),
            commands=Commands(network, *sent.frames()), age=np.zeros((len(states), 18), np.int64),
            guide_exit=np.zeros(len(states)), messages=(), **{**rows, **arrays},
        )  # fmt: skip

    return make


def verdict(observation: Observation, **case: Any) -> Verdict:
    return evaluate(ROW, Case("a case", (), **case), observation)


def test_expected_reaction_passes(make_observation: Any) -> None:
    assert verdict(make_observation(), node="LEFT_SK") == Verdict("F99", "a case", "HOLD", 5, 5, "NODE_TIMEOUT", ())


def test_reaction_time_is_measured_to_the_first_hold_frame(make_observation: Any) -> None:
    assert verdict(make_observation(held=12)).cycles == 2


@pytest.mark.parametrize(
    ("states", "improved"),
    [
        ([S.HOLD] * 20 + [S.ACTIVE] * 20, None),
        ([S.FAULT] * 9 + [S.HOLD] * 20, None),  # in the cycle of START
        ([S.HOLD] * (9 + ENABLE_CYCLES) + [S.ACTIVE] * 20, None),
        ([S.HOLD] * (10 + ENABLE_CYCLES) + [S.ACTIVE] * 20, ("ACTIVE", 11 + ENABLE_CYCLES)),
        ([S.HOLD] * 20 + [S.ACTIVE] * 5 + [S.FULL_ASSIST] * 5 + [S.ACTIVE] * 5, ("ACTIVE", 31)),
        ([S.HOLD] * 20 + [S.LOWER] * 5 + [S.HOLD] * 5, ("HOLD", 26)),
        ([S.FAULT] * 9 + [S.HOLD] * 5 + [S.ACTIVE] * 5, ("ACTIVE", 15)),
        ([S.READY] * 20 + [S.OFF] * 5 + [S.READY] * 5, None),
    ],
)
def test_a_start_may_improve_the_state_only_once_and_in_time(
    make_observation: Any, states: list[S], improved: tuple[str, int] | None
) -> None:
    run = make_observation(states)
    expected = [] if improved is None else [IMPROVED.replace("ACTIVE in cycle 31", "{} in cycle {}".format(*improved))]
    assert automatic_improvements(run, run.last, (FIRST - 1,)) == expected


@pytest.mark.parametrize(
    ("states", "case", "expected"),
    [
        ([S.ACTIVE] * 15 + [S.HOLD] * 27 + STEP, {}, ["HOLD must come within 5 cycles of the fault, got 6"]),
        ([S.ACTIVE] * 42 + STEP, {}, ["no HOLD within 30 cycles"]),
        ([S.HOLD] * 40 + STEP, {}, ["the robot must be ACTIVE before the fault, got HOLD"]),
        ([S.ACTIVE] * 14 + [S.FAULT] * 30 + STEP, {}, ["the final state must be HOLD, got FAULT"]),
        (HELD, {"state": S.ACTIVE}, ["the robot must stay ACTIVE, got HOLD after 5 cycles"]),
        ([*HELD[:30], *[S.ACTIVE] * 5, *[S.HOLD] * 10, *STEP], {}, [IMPROVED]),
        (HELD[:42], {}, ["the operator's START must lead to 800 cycles in ACTIVE, got 0, then HOLD"]),
        (HELD[:-1], {}, ["the operator's START must lead to 800 cycles in ACTIVE, got 799, then ACTIVE"]),
        (HELD, {"recovers": False}, ["the robot must not be ACTIVE after START, because the fault persists"]),
    ],
)  # fmt: skip
def test_wrong_state_fails_with_its_reason(
    make_observation: Any, states: list[S], case: dict[str, Any], expected: list[str]
) -> None:
    assert list(verdict(make_observation(states), **case).failures) == expected


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        (Event(12, "BUS_DOWN", "", node="LEFT_SK"), "no NODE_TIMEOUT; reported codes: BUS_DOWN"),
        (Event(10, "NODE_TIMEOUT", "", node="LEFT_SK"), "no NODE_TIMEOUT; reported codes: none"),
        (Event(13, "NODE_TIMEOUT", "", node="LEFT_SK"), "NODE_TIMEOUT must come within 2 cycles of the fault, got 3"),
        (Event(12, "NODE_TIMEOUT", "", node="LEFT_SH"), "NODE_TIMEOUT must name LEFT_SK, got LEFT_SH"),
    ],
)
def test_wrong_diagnostic_fails_with_its_reason(make_observation: Any, event: Event, expected: str) -> None:
    assert verdict(make_observation(events=[event]), node="LEFT_SK").failures == (expected,)


def test_one_of_several_accepted_diagnostics_passes(make_observation: Any) -> None:
    assert verdict(make_observation(), dtc="E2E_LOSS_RATE|NODE_TIMEOUT").dtc == "NODE_TIMEOUT"
    assert verdict(make_observation(), dtc="").passed


@pytest.mark.parametrize(
    ("quantity", "value", "expected"),
    [
        ("torque", 400.0, "a motor's torque was above its limit: left_FH in cycle 3"),
        ("position", 1.0, "a joint was outside its position range: left_FH in cycle 3"),
        ("position", -1.0, "a joint was outside its position range: left_FH in cycle 3"),
        ("velocity", -6.0, "a joint was above its velocity limit: left_FH in cycle 3"),
    ],
)
def test_violated_limit_fails_with_joint_and_cycle(
    make_observation: Any, quantity: str, value: float, expected: str
) -> None:
    array = np.zeros((len(HELD), 12))
    array[2, 0] = value
    assert verdict(make_observation(**{quantity: array})).failures == (expected,)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("quantity", "factor", "overshoot"), [("torque", 1.0, 0.0), ("position", 1.0, 0.05), ("velocity", 1.2, 0.0)]
)
def test_joint_at_its_bound_passes_and_beyond_it_fails(
    make_observation: Any, robot: Robot, quantity: str, factor: float, overshoot: float, sign: float
) -> None:
    limit = robot.position_min if quantity == "position" and sign < 0.0 else sign * getattr(robot, f"{quantity}_max")
    bound = factor * limit + sign * overshoot
    assert verdict(make_observation(**{quantity: np.tile(bound, (len(HELD), 1))})).passed
    for joint, name in enumerate(JOINTS):
        array = np.tile(bound, (len(HELD), 1))
        array[2, joint] += sign * 1e-6
        (failure,) = verdict(make_observation(**{quantity: array})).failures
        assert failure.endswith(f": {name} in cycle 3")


def test_failed_check_of_the_case_fails_the_verdict(make_observation: Any) -> None:
    assert verdict(
        make_observation(), checks=(lambda observation: f"failed in cycle {observation.first}",)
    ).failures == ("failed in cycle 11",)


def test_detection_time_is_measured_when_the_robot_stays_active(make_observation: Any) -> None:
    result = verdict(make_observation([S.ACTIVE] * 30, pressed=None), state=S.ACTIVE)
    assert (result.passed, result.state, result.cycles, result.bound) == (True, "ACTIVE", 2, 2)


def test_case_without_any_bound_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"F99 x: the time limit .* must be a number of cycles, got '1 step'; define"):
        Expectation.of(Case("x", ()), Row("F99", "", "", "1 step", "", S.HOLD, "", ()))
