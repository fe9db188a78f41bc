"""Rollouts at the torque limit against the same loop integrated finely."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.backup import BackupPolicy, forced_response, free_drift
from atalante_control.deadbeat import Deadbeat
from atalante_control.gait import HANG_GAIT, PERIOD, load_gait
from atalante_control.limited import LimitedRollouts, combine
from atalante_hal.robot import load_robot

GAIT = load_gait(HANG_GAIT, load_robot())
DEADBEAT = Deadbeat(GAIT.duration, 0.4)
POLICIES = (BackupPolicy(6300.0, 473.0, 8.0, 160.0), BackupPolicy(3600.0, 173.0, 1.9, 120.0))
LIMITS = (150.0, 110.0)
DISTURBANCE = ((-30.0, 25.0), (-20.0, 15.0))
HORIZON = 896
TIME = np.arange(HORIZON + 1) * PERIOD
BOUNDS = np.stack([np.linspace(0.07, 0.03, HORIZON + 1), np.full(HORIZON + 1, 0.05)], axis=1)
DEVIATION, RATE = (0.03, -0.02), (0.2, -0.4)
ARGUMENTS = [
    (policy, DEADBEAT, nominal, following, TIME)
    for policy, nominal, following in zip(
        POLICIES, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4], strict=True
    )
]
DRIFTS = [free_drift(*arguments) for arguments in ARGUMENTS]


def table(parts: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    result = np.empty((HORIZON + 1, 4))
    combine(tuple(np.hstack(columns) for columns in zip(*parts, strict=True)), DEVIATION, RATE, result)
    return result


SOLUTION, DRIFT = table([forced_response(*arguments) for arguments in ARGUMENTS]), table(DRIFTS)


def march(
    joint: int, side: int, cycle: int, e: float, ed: float, limit: float, substeps: int = 4
) -> tuple[float, float]:
    """Largest ratio and torque by small steps; the known drift is added exactly."""
    policy, external, sign = POLICIES[joint], DISTURBANCE[joint][1 - side], -1.0 if side else 1.0
    drift, h = DRIFT[:, 2 * joint : 2 * joint + 2], PERIOD / substeps
    ratio, torque = -math.inf, 0.0
    for i in range(cycle, HORIZON):
        pushed = (drift[i + 1, 1] - drift[i, 1]) / PERIOD  # constant within a cycle
        for _ in range(substeps):
            asked = -policy.kp * e - policy.kd * ed
            torque = max(torque, -sign * asked)
            a = (max(-limit, min(limit, asked)) + external) / policy.inertia + pushed
            # second order: the torque of the middle of the step
            middle, middle_rate = e + 0.5 * h * ed, ed + 0.5 * h * a
            asked = -policy.kp * middle - policy.kd * middle_rate
            a = (max(-limit, min(limit, asked)) + external) / policy.inertia + pushed
            e, ed = e + h * middle_rate, ed + h * a
        ratio = max(ratio, sign * e / BOUNDS[i + 1, side])
    return ratio, torque


def rollouts() -> LimitedRollouts:
    def linear(joint: int, side: int, cycle: int, e: float, ed: float) -> tuple[float, float]:
        ratio, torque = march(joint, side, cycle, e, ed, math.inf, 2)
        return ratio, torque / LIMITS[joint]

    result = LimitedRollouts(POLICIES, LIMITS, DISTURBANCE, DRIFTS, SOLUTION, BOUNDS, 8, linear)
    result.start_step(DEVIATION, RATE)
    return result


LIMITED = rollouts()


@given(st.integers(0, 1), st.integers(0, 1), st.integers(0, 800), st.floats(0.0, 0.08), st.floats(-1.5, 1.5))
@settings(max_examples=40)
def test_ratio_is_that_of_the_loop_with_its_limit(joint: int, side: int, cycle: int, away: float, rate: float):
    """From any state on the side that is asked for: that is where the guide asks."""
    e, ed = (-away, -rate) if side else (away, rate)
    now = away / BOUNDS[cycle, side]  # the guide's to add
    expected = max(march(joint, side, cycle, e, ed, LIMITS[joint])[0], now)
    found = max(LIMITED.ratio(joint, side, cycle, e, ed), now)
    if expected > 1.9:
        assert found > 1.0
    else:
        assert found == pytest.approx(expected, abs=0.02)


def test_the_limit_matters_and_the_linear_flow_would_not_see_it():
    state = (0, 0, 100, 0.06, 0.5)
    linear, torque = march(*state, math.inf)
    assert torque > LIMITS[0]
    assert LIMITED.ratio(*state) > linear + 0.05


def test_a_hopeless_rollout_is_left_early_and_told_as_such():
    assert LIMITED.ratio(0, 0, 0, 0.3, 4.0) > 2.0


def test_counts_its_rollouts():
    before = LIMITED.stepped
    LIMITED.ratio(1, 0, 400, 0.06, 0.0)
    assert LIMITED.stepped == before + 1


def test_combine_is_linear_in_the_deviations():
    rng = np.random.default_rng(0)
    parts, out = tuple(rng.normal(size=(3, 5, 4))), np.empty((5, 4))
    combine(parts, (1.0, 2.0), (3.0, 4.0), out)
    np.testing.assert_allclose(out, parts[0] + parts[1] * [1, 1, 2, 2] + parts[2] * [3, 3, 4, 4])
