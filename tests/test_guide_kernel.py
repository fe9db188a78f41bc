"""Rollouts at the torque limit against the same loop integrated finely, and the machine code against its source."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.backup import BackupPolicy, ForcedResponse, forced_response, free_drift
from atalante_control.deadbeat import Deadbeat
from atalante_control.gait import HANG_GAIT, PERIOD, load_gait
from atalante_control.guide import GuideConfig, GuideFilter
from atalante_control.guide_kernel import limited, tick
from atalante_control.guide_shapes import GuideShape, half_width
from atalante_hal.robot import load_robot

GAIT = load_gait(HANG_GAIT, load_robot())
DEADBEAT = Deadbeat(GAIT.duration, 0.4)
LIMITS = (150.0, 110.0)
RESERVE = 0.1
POLICIES = (
    BackupPolicy(6300.0, 473.0, 8.0, LIMITS[0] / (1.0 - RESERVE)),
    BackupPolicy(3600.0, 173.0, 1.9, LIMITS[1] / (1.0 - RESERVE)),
)
RINGING = (BackupPolicy(6300.0, 150.0, 8.0, POLICIES[0].torque_limit), POLICIES[1])
DISTURBANCE = ((-30.0, 25.0), (-20.0, 15.0))
XI = 0.5
#: Closes from 0.07 to 0.03 rad above, 0.05 rad below.
SHAPE = GuideShape(
    "closing", "", lambda phase, width: ((0.07 - 0.04 * phase) / width, np.full_like(phase, 0.05 / width))
)
DEVIATION, RATE = (0.03, -0.02), (0.2, -0.4)
CURVES = list(zip(POLICIES, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4], strict=True))


def guide(policies: tuple[BackupPolicy, BackupPolicy] = POLICIES) -> GuideFilter:
    config = GuideConfig(policies, DISTURBANCE, reserve=RESERVE)
    result = GuideFilter(config, SHAPE, DEADBEAT, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4])
    result.start_step(XI, DEVIATION, RATE)
    return result


GUIDE = guide()
BOUNDS = SHAPE.bounds(GUIDE.time / GAIT.duration, XI)


def table(responses: Sequence[ForcedResponse]) -> np.ndarray:
    return np.hstack(
        [r.nominal + d * r.deviation + v * r.rate for r, d, v in zip(responses, DEVIATION, RATE, strict=True)]
    )


DRIFT = table([free_drift(p, DEADBEAT, q, after, GUIDE.time) for p, q, after in CURVES])


def march(
    joint: int, side: int, cycle: int, e: float, ed: float, limit: float, substeps: int = 4
) -> tuple[float, float]:
    """Largest ratio and torque by small steps; the known drift is added exactly."""
    policy, external, sign = POLICIES[joint], DISTURBANCE[joint][1 - side], -1.0 if side else 1.0
    drift, h = DRIFT[:, 2 * joint : 2 * joint + 2], PERIOD / substeps
    ratio, torque = -math.inf, 0.0
    for i in range(cycle, GUIDE.horizon):
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


def found(joint: int, side: int, cycle: int, e: float, ed: float) -> float:
    return limited(GUIDE.joints[joint], GUIDE.flow[joint], GUIDE.step[joint], side, cycle, e, ed)


@given(st.integers(0, 1), st.integers(0, 1), st.integers(0, 800), st.floats(0.0, 0.08), st.floats(-1.5, 1.5))
@settings(max_examples=40, deadline=None)
def test_ratio_is_that_of_the_loop_with_its_limit(joint: int, side: int, cycle: int, away: float, rate: float):
    """From any state on the side that is asked for: that is where the guide asks."""
    e, ed = (-away, -rate) if side else (away, rate)
    now = away / BOUNDS[cycle, side]  # the guide's to add
    expected = max(march(joint, side, cycle, e, ed, LIMITS[joint])[0], now)
    ratio = max(found(joint, side, cycle, e, ed), now)
    if expected > 1.9:
        assert ratio > 1.0
    else:
        assert ratio == pytest.approx(expected, abs=0.02)


def test_the_limit_matters_and_the_linear_flow_would_not_see_it():
    state = (0, 0, 100, 0.06, 0.5)
    linear, torque = march(*state, math.inf)
    assert torque > LIMITS[0]
    assert found(*state) > linear + 0.05


def test_a_hopeless_rollout_is_left_early_and_told_as_such():
    assert found(0, 0, 0, 0.3, 4.0) > 2.0


def test_rollouts_that_saturate_are_counted():
    f = guide()
    f.tick(400, 0.0, 0.0, 0.0, 0.0)
    assert f.joints["stepped"].tolist() == [0, 0]
    f.tick(400, 0.06, 0.5, -0.06, -0.5)
    assert f.joints["stepped"].tolist() == [1, 1]
    assert f.stepped == 2


def test_p_and_drift_are_linear_in_the_deviations():
    p = table([forced_response(p, DEADBEAT, q, after, GUIDE.time) for p, q, after in CURVES])
    np.testing.assert_allclose(GUIDE.solution(), p, atol=1e-12)
    np.testing.assert_allclose(np.hstack(list(GUIDE.step[:, :, 2:4])), DRIFT, atol=1e-12)


def test_the_width_is_that_of_the_assistance_factor():
    assert SHAPE.bounds(np.zeros(1), XI)[0] == pytest.approx((0.07, 0.05))
    f = guide()
    f.start_step(0.9, DEVIATION, RATE)
    f.tick(0, 0.0, 0.0, 0.0, 0.0)
    assert f.bounds == pytest.approx((0.07, 0.05))
    constant = GuideShape("constant", "", lambda phase, width: (np.ones_like(phase), np.ones_like(phase)))
    f = GuideFilter(GuideConfig(POLICIES, DISTURBANCE), constant, DEADBEAT, *(GAIT.coefficients[2:4],) * 2)
    for xi in (0.9, 0.2):
        f.start_step(xi, DEVIATION, RATE)
        f.tick(0, 0.0, 0.0, 0.0, 0.0)
        assert f.bounds == [half_width(xi)] * 2


@pytest.mark.parametrize("policies", [POLICIES, RINGING], ids=["monotone", "ringing"])
def test_the_machine_code_does_what_its_source_does(policies: tuple[BackupPolicy, BackupPolicy]):
    rng = np.random.default_rng(4)
    machine, source = guide(policies), guide(policies)
    for cycle in np.sort(rng.integers(0, 801, 40)).tolist():
        state = (rng.uniform(-1.0, 1.0, 4) * [0.08, 1.0, 0.08, 1.0]).tolist()
        u = tick(source.joints, source.flow, source.step, cycle, *state)
        np.testing.assert_allclose(machine.tick(cycle, *state), u, rtol=1e-12, atol=1e-12)
        for name in ("h", "rate", "gate", "upper", "lower"):
            np.testing.assert_allclose(machine.joints[name], source.joints[name], rtol=1e-12, atol=1e-9)
    assert machine.stepped == source.stepped > 0


def test_a_state_that_is_no_number_gives_a_torque_that_is_none():
    """The limiter turns it into HOLD; a limit that swallowed it would not."""
    f = guide()
    assert all(math.isnan(u) for u in f.tick(100, math.nan, 0.0, 0.0, math.nan))
