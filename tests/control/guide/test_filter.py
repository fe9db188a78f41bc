"""Guide filter: its prediction against the sampled loop, the reference of a step, and the guide."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from atalante_control.guide.filter import GuideFilter, tail
from atalante_control.guide.kernel import BASE, FLOOR, INVERSE, REFERENCE, SPEED, TAIL, VELOCITY, largest_ratio
from atalante_control.guide.shapes import SHAPES
from tests.control.guide.ideal_leg import controller

BUILT = controller("constant").guides[0]
GUIDE = GuideFilter(BUILT.config, SHAPES["asymmetric"], BUILT.prediction, np.ones(3))
XI = 0.5


def test_compressed_rows_differ_from_the_exact_ones_by_less_than_the_uncertainty():
    GUIDE.start_step(XI, (0.0, 0.0), (0.0, 0.0))
    rng = np.random.default_rng(0)
    for _ in range(20):
        GUIDE.tables.guards[0].state[:] = rng.normal(size=10) * np.repeat([0.07, 1.0, 1.0, 140.0, 140.0], 2)
        exact = GUIDE.prediction.nominal.error[:301] @ GUIDE.state
        found = GUIDE.errors_ahead()
        assert (np.abs(found - exact) <= GUIDE.uncertainty() + 1e-12).all()
        assert (found != exact).any()


def test_largest_ratio_is_the_worst_row_of_the_prediction():
    GUIDE.start_step(XI, (0.0, 0.0), (0.0, 0.0), promise=0.5)
    guard, cycle = GUIDE.tables.guards[0], 200
    guard.torque_limit = guard.speed_limit = guard.worst_speed_limit = 1e6
    guard.state[:] = np.array([0.05, -0.04, 0.5, 0.2, 0.5, 0.2, 5.0, 5.0, 5.0, 5.0])
    x, prediction = guard.state, GUIDE.prediction
    size = np.abs(np.concatenate([x[:2], x[2:4] - x[4:6], x[4:]]))
    e = prediction.ahead @ (prediction.compress @ x)
    d = np.repeat(prediction.slack @ size, 10, axis=0)[:301]
    reach = prediction.reach[cycle // 4]
    d = d + reach[:, :2] + 0.5 * reach[:, 2:]
    bounds = GUIDE.shape.bounds(np.minimum(np.arange(901) / 800, 1.0), XI)[:, cycle : cycle + 301]
    worst = max(((d + e) / bounds[:, :, 0].T).max(), ((d - e) / bounds[:, :, 1].T).max())
    assert largest_ratio(GUIDE.tables, cycle) == pytest.approx(worst, rel=1e-9)
    guard.torque_limit, guard.speed_limit = GUIDE.config.torque_limit, GUIDE.config.speed_limit
    guard.worst_speed_limit = GUIDE.config.worst_speed_limit
    assert largest_ratio(GUIDE.tables, cycle) > worst  # the backup torque would exceed its limit


def test_reference_of_a_step_follows_q_des():
    deviation, rate = np.array([0.03, -0.02]), np.array([0.2, 0.1])
    GUIDE.start_step(XI, (0.03, -0.02), (0.2, 0.1))
    leg, step = GUIDE.prediction.leg, GUIDE.tables.step
    values, slopes, curvatures = leg.deadbeat.basis(leg.time)
    q = leg.q + np.outer(values[0], deviation) + np.outer(values[1], rate)
    speed = leg.qd + np.outer(slopes[0], deviation) + np.outer(slopes[1], rate)
    np.testing.assert_allclose(step[:, SPEED : SPEED + 2], speed, atol=1e-12)
    acceleration = np.outer(curvatures[0], deviation) + np.outer(curvatures[1], rate)
    needed = np.einsum("nij,nj->ni", leg.masses(leg.q[:, 1]), acceleration)
    np.testing.assert_allclose(step[:, BASE : BASE + 2] - GUIDE.prediction.torque, needed, atol=1e-9)
    # The low-pass of the drives would measure this velocity on q_des.
    measured, keep = speed[0].copy(), GUIDE.prediction.assumptions.loop.keep
    for i in range(1, 100):
        measured = keep * measured + (1.0 - keep) * (q[i] - q[i - 1]) / 1e-3
        np.testing.assert_allclose(step[i, VELOCITY : VELOCITY + 2], measured, atol=1e-9)
    inner = slice(10, 300)  # the mean of 11 cycles does not change a line
    ahead = np.interp(
        leg.time[inner] + GUIDE.prediction.assumptions.loop.command_lag, leg.time, (leg.qdd + acceleration)[:, 0]
    )
    np.testing.assert_allclose(step[inner, REFERENCE], ahead, atol=0.02)


def test_guide_of_a_step_has_the_bounds_of_the_shape():
    GUIDE.start_step(0.25, (0.0, 0.0), (0.0, 0.0))
    bounds = GUIDE.shape.bounds(np.array([0.5]), 0.25)[:, 0]
    np.testing.assert_allclose(1.0 / GUIDE.tables.step[400, INVERSE : INVERSE + 4], bounds.ravel())
    np.testing.assert_allclose(GUIDE.widths(0.25)[400], bounds.min(axis=1))
    assert GUIDE.tables.step[:4, FLOOR].tolist() == [1.0, 1.0, 1.0, 0.0]


def test_tail_is_the_narrowest_guide_of_the_next_cycles():
    inverse = np.array([[1.0], [2.0], [5.0], [3.0]] + [[3.0]] * 100)
    found = tail(inverse)
    assert found[0, 0] == pytest.approx(1.03 * 5.0)
    assert found[3, 0] == pytest.approx(1.03 * 3.0)
    assert (GUIDE.tables.step[:, TAIL : TAIL + 4] >= GUIDE.tables.step[:, INVERSE : INVERSE + 4]).all()


@pytest.mark.parametrize(
    "bad",
    [
        {"torque_limit": 0.0}, {"speed_limit": math.nan}, {"rate_limit": -1.0}, {"release": 0.0}, {"zeta": -1.0},
        {"derivative_time": math.inf}, {"idealization": 1.1}, {"feedforward": -0.1},
    ],
)  # fmt: skip
def test_an_invalid_configuration_is_rejected(bad: dict[str, float]):
    with pytest.raises(ValueError, match="must be"):
        replace(BUILT.config, **bad)
