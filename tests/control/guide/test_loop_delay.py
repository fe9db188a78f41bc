"""Delay of the control loop that a guide covers: delay at START, ages of hip and knee, confirmation."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.guide.loop_delay import COVERED, LoopDelay
from atalante_hal.robot import JOINTS
from tests.control.airwalk.test_controller import blank_state

ROWS = tuple(range(2, 2 + len(JOINTS)))


def state_with(delay: int, ages: dict[str, int]):
    state = blank_state(0.5)
    state.delay, state.joint_rows, state.age = delay, ROWS, np.zeros(24, int)
    for joint, age in ages.items():
        state.age[ROWS[JOINTS.index(joint)]] = age
    return state


def test_one_more_cycle_is_covered() -> None:
    assert COVERED == 1


@pytest.mark.parametrize(
    ("at_start", "now", "covered"),
    [
        ((0, {}), {}, True),
        ((0, {}), {"left_SH": 1}, True),
        ((0, {}), {"left_SH": 2}, False),
        ((0, {}), {"right_SK": 4}, False),
        ((0, {}), {"left_SA": 4, "right_FH": 4}, True),  # no joints with a guide
        ((1, {}), {}, True),
        ((1, {}), {"left_SK": 1}, False),
        ((2, {}), {}, False),
        ((1, {"left_SK": 1}), {"left_SK": 1}, True),  # the delay at START contains the age
        ((2, {"left_SK": 1}), {}, True),
        ((0, {"left_SK": 3}), {"left_SK": 2}, False),  # a lost frame at START hides nothing
    ],
)
def test_delay_is_the_delay_at_start_plus_the_age_of_hip_and_knee(
    at_start: tuple[int, dict[str, int]], now: dict[str, int], covered: bool
) -> None:
    loop = LoopDelay()
    loop.reset(state_with(*at_start))
    assert loop.is_covered(state_with(at_start[0], now)) is covered


def test_five_consecutive_cycles_confirm_the_delay() -> None:
    loop, late, intact = LoopDelay(), state_with(0, {"left_SK": 2}), state_with(0, {})
    assert [loop.update(late) for _ in range(4)] == [False] * 4
    assert not loop.update(intact)
    assert [loop.update(late) for _ in range(6)] == [False] * 4 + [True] * 2
    loop.reset(intact)
    assert not loop.update(late)


def test_state_without_rows_of_the_joints_counts_as_new() -> None:
    state = state_with(0, {"left_SK": 4})
    state.joint_rows = ()
    assert LoopDelay().is_covered(state)


def test_delay_that_is_uncovered_at_start_needs_no_further_cycles() -> None:
    loop, slow = LoopDelay(), state_with(2, {})
    loop.reset(slow)
    assert loop.confirmed
    assert loop.update(slow)
    loop.reset(state_with(1, {}))
    assert not loop.confirmed


@pytest.mark.parametrize(("delay", "loss"), [(0, 0.1), (1, 0.01)])
def test_lost_frames_that_the_hal_tolerates_do_not_confirm_a_delay(delay: int, loss: float) -> None:
    """Two frames of a joint in a row, or one frame in a loop that is 1 ms slower, are often lost at the start of a step."""
    loop, state, rng = LoopDelay(), state_with(delay, {}), np.random.default_rng(0)
    loop.reset(state)
    rows, uncovered, confirmed = np.array(ROWS), 0, 0
    for _ in range(20000):
        state.age[rows] = np.where(rng.random(len(rows)) < loss, state.age[rows] + 1, 0)
        uncovered += not loop.is_covered(state)
        confirmed += loop.update(state)
    assert uncovered > 500
    assert confirmed < 10
