"""Disturbances: the bound of their effect against brute force, and the budget of the model errors."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from atalante_control.guide.disturbance import Effect, Grid, HandOver, Mismatch, spread
from atalante_control.guide.prediction import Prediction
from tests.control.guide.ideal_leg import controller

LEG = controller("constant").guides[0].prediction.leg


def test_spread_is_the_worst_of_all_sign_patterns():
    rng = np.random.default_rng(0)
    n = 5
    pushed = rng.normal(size=(n + 1, 2, 2))
    pushed[0] = 0.0
    left, inverse = rng.normal(size=(n, 2, 2)), rng.normal(size=(n, 1, 2, 2))
    bounds = np.abs(rng.normal(size=(n, 2, 2)))
    ahead = np.zeros((n, n + 1, 4))
    since_start = spread(
        Effect(pushed, np.zeros_like(pushed), left), inverse, bounds, Grid(n, 1, np.arange(n + 1)), ahead
    )
    start, end = 1, 4
    for column in (0, 1):
        worst = np.zeros(2)
        for signs in itertools.product((-1.0, 1.0), repeat=2 * (end - start)):
            pattern = np.reshape(signs, (-1, 2)) * bounds[start:end, :, column]
            effect = sum(left[end] @ pushed[end - i] @ inverse[i, 0] @ pattern[i - start] for i in range(start, end))
            worst = np.maximum(worst, np.abs(effect))
        np.testing.assert_allclose(ahead[start, end - start, 2 * column : 2 * column + 2], worst)
    np.testing.assert_array_equal(since_start, [ahead[0, lag] for lag in range(n)])


def test_spread_raises_each_block_to_the_worst_of_its_start_cycles():
    rng = np.random.default_rng(1)
    n, lags = 7, np.array([1, 3])
    effect = Effect(*rng.normal(size=(2, n, 2, 2)), left=rng.normal(size=(n, 2, 2)))
    inverse, bounds = rng.normal(size=(n, 2, 2, 2)), np.abs(rng.normal(size=(n, 2, 2)))
    single, blocks = np.zeros((6, n, 4)), np.full((2, 2, 4), 9.0)
    spread(effect, inverse, bounds, Grid(6, 1, np.arange(n)), single)
    spread(effect, inverse, bounds, Grid(6, 3, lags), blocks)
    worst = single.reshape(2, 3, n, 4).max(axis=1)[:, lags]
    np.testing.assert_array_equal(blocks, np.maximum(worst, 9.0))
    assert (worst > 9.0).any()
    assert (worst < 9.0).any()


def test_spread_takes_the_worst_posture_and_the_hidden_part():
    pushed = np.ones((3, 2, 2))
    hidden = np.full((3, 2, 2), 0.5)
    inverse = np.stack([np.eye(2), 3.0 * np.eye(2)])[None].repeat(3, axis=0)
    same = np.eye(2)[None].repeat(3, axis=0)
    ahead = np.zeros((1, 1, 4))
    spread(Effect(pushed, hidden, same), inverse, np.ones((3, 2, 2)), Grid(1, 1, np.array([2])), ahead)
    np.testing.assert_allclose(ahead[0, 0], 2 * 2 * 3.0 + 6.0 + 3.0)  # three lags add 6 each, the hidden part adds 3


def test_budget_contains_friction_inertia_residual_and_the_torque_jump():
    box, jump = HandOver(0.0, 0.0), np.array([[10.0, 5.0], [5.0, 2.5]])
    none = LEG.budget(Mismatch(0.0, 0.0, (0.0, 0.0)), box, jump)
    np.testing.assert_array_equal(none[:2], jump)
    assert not none[2:].any()
    light = LEG.budget(Mismatch(0.0, 0.1, (0.0, 0.0)), box, jump) - none
    np.testing.assert_allclose(light, 0.1 * np.abs(LEG.torque()))
    rough = LEG.budget(Mismatch(0.2, 0.0, (1.0, 2.0)), box, jump) - none
    assert (rough >= 0.2 * np.abs(LEG.friction_torque()) + [1.0, 2.0]).all()


def test_jump_decreases_with_the_limiter_down_to_the_added_torque():
    box, blend = HandOver(torque=(50.0, 9.0), carried=(25.0, 13.0)), np.array([1.0, 0.75, 0.25])
    decrease = np.array([[20.0, 20.0], [18.0, 18.0], [10.0, 10.0], [5.0, 5.0], [-1.0, -1.0]])
    expected = [[30.0, 9.0], [18.75, 6.75], [6.25, 2.25], [0.0, 0.0], [0.0, 0.0]]
    np.testing.assert_allclose(box.remaining(blend, decrease), expected)
    none = HandOver(torque=(50.0, 9.0), carried=(0.0, 0.0)).remaining(blend, decrease)
    np.testing.assert_allclose(none[:, 0], [30.0, 12.0, 2.0, 0.0, 0.0])


def test_budget_of_the_prediction_contains_the_whole_jump_until_the_first_command_can_act():
    guide = controller("constant").guides[0]
    leg, assumptions = guide.prediction.leg, guide.prediction.assumptions
    box, late = assumptions.hand_over, assumptions.delays[1]
    assert late == 2
    small = replace(assumptions, hand_over=replace(box, torque=(0.0, 0.0)))
    reach = [
        Prediction(guide.prediction.policy, leg, one, guide.blend, 0.1).start.error[1 : late + 1, :2]
        for one in (assumptions, small)
    ]
    inverse = np.linalg.inv(leg.masses(leg.q[:1, 1])[0])
    whole = 0.5e-6 * np.abs(inverse) @ box.torque  # rad, a constant torque for 1 ms, and four times as much for 2 ms
    moved = reach[0] - reach[1]
    assert (moved[0] >= whole).all()
    assert (moved[1] >= 3.9 * whole).all()


INSIDE = (0.04, -0.04), (-0.2, 0.2), (-19.0, 19.0), (64.0, -34.0)


@pytest.mark.parametrize("argument", range(4))
@pytest.mark.parametrize("joint", range(2))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_box_contains_no_value_above_its_limit(argument: int, joint: int, sign: float):
    box, values = HandOver(), [list(pair) for pair in INSIDE]
    assert box.contains(*INSIDE)
    limit = (box.deviation, box.rate, box.acceleration, box.torque[joint])[argument]
    values[argument][joint] = sign * limit
    assert box.contains(*values)  # type: ignore[arg-type]
    values[argument][joint] = sign * limit * 1.001
    assert not box.contains(*values)  # type: ignore[arg-type]


def test_mobilities_cover_the_guide():
    box = HandOver()
    knee = LEG.q[400, 1]
    found = LEG.mobilities(box, 0.05)[400]
    np.testing.assert_allclose(found[1], np.linalg.inv(LEG.masses(np.array([knee]))[0]))
    assert found[0, 0, 0] > found[1, 0, 0] > found[2, 0, 0]


def test_masses_are_those_of_the_assisted_inertia():
    for angle in (0.2, 0.9):
        m11, m12, m22 = LEG.inertia.block(angle)
        np.testing.assert_allclose(LEG.masses(np.array(angle)), [[m11, m12], [m12, m22]])


@pytest.mark.parametrize("bad", [{"friction": 1.0}, {"inertia": -0.1}, {"residual": (math.inf, 0.0)}])
def test_an_invalid_mismatch_is_rejected(bad: dict[str, object]):
    with pytest.raises(ValueError, match="mismatch"):
        Mismatch(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "bad", [{"deviation": -1.0}, {"rate": math.nan}, {"torque": (-1.0, 0.0)}, {"carried": (0.0, math.inf)}]
)
def test_an_invalid_hand_over_box_is_rejected(bad: dict[str, object]):
    with pytest.raises(ValueError, match="hand-over"):
        HandOver(**bad)  # type: ignore[arg-type]
