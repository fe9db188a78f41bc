"""Guide kernel: rollouts at the torque limit compared with fine integration, and compiled code with its source."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.gait.gait import AIRWALK_GAIT, PERIOD, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy, Curve, ForcedResponse, forced_response, free_drift
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.kernel import damped_gate, gate, limited, tick
from atalante_control.guide.shapes import GuideShape, half_width
from atalante_hal.robot import load_robot

GAIT = load_gait(AIRWALK_GAIT, load_robot())
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
#: Upper bound closes from 0.07 to 0.03 rad; lower bound is 0.05 rad.
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


DRIFT = table([free_drift(p, Curve(DEADBEAT, q, after, GUIDE.time)) for p, q, after in CURVES])


def march(
    joint: int, side: int, cycle: int, e: float, ed: float, limit: float, substeps: int = 4
) -> tuple[float, float]:
    """Return the largest ratio and torque, integrated in small steps; the drift is added exactly."""
    policy, external, sign = POLICIES[joint], DISTURBANCE[joint][1 - side], -1.0 if side else 1.0
    drift, h = DRIFT[:, 2 * joint : 2 * joint + 2], PERIOD / substeps
    ratio, torque = -math.inf, 0.0
    for i in range(cycle, GUIDE.horizon):
        pushed = (drift[i + 1, 1] - drift[i, 1]) / PERIOD  # constant within a cycle
        for _ in range(substeps):
            asked = -policy.kp * e - policy.kd * ed
            torque = max(torque, -sign * asked)
            a = (max(-limit, min(limit, asked)) + external) / policy.inertia + pushed
            # midpoint method: torque at the middle of the step
            middle, middle_rate = e + 0.5 * h * ed, ed + 0.5 * h * a
            asked = -policy.kp * middle - policy.kd * middle_rate
            a = (max(-limit, min(limit, asked)) + external) / policy.inertia + pushed
            e, ed = e + h * middle_rate, ed + h * a
        ratio = max(ratio, sign * e / BOUNDS[i + 1, side])
    return ratio, torque


def found(joint: int, side: int, cycle: int, e: float, ed: float) -> float:
    return limited(*of(GUIDE, joint), side, cycle, e, ed)


@given(st.integers(0, 1), st.integers(0, 1), st.integers(0, 800), st.floats(0.0, 0.08), st.floats(-1.5, 1.5))
@settings(max_examples=40, deadline=None)
def test_ratio_matches_the_integrated_loop_with_its_limit(joint: int, side: int, cycle: int, away: float, rate: float):
    """The state is on the checked side, as in the guide filter."""
    e, ed = (-away, -rate) if side else (away, rate)
    now = away / BOUNDS[cycle, side]  # ratio of the present state; the guide filter adds it
    expected = max(march(joint, side, cycle, e, ed, LIMITS[joint])[0], now)
    ratio = max(found(joint, side, cycle, e, ed), now)
    if expected > 1.9:
        assert ratio > 1.0
    else:
        assert ratio == pytest.approx(expected, abs=0.02)


def test_torque_limit_increases_the_ratio():
    state = (0, 0, 100, 0.06, 0.5)
    linear, torque = march(*state, math.inf)
    assert torque > LIMITS[0]
    assert found(*state) > linear + 0.05


def test_rollout_far_outside_the_guide_has_a_large_ratio():
    assert found(0, 0, 0, 0.3, 4.0) > 2.0


def test_saturated_rollouts_are_counted():
    f = guide()
    f.tick(400, 0.0, 0.0, 0.0, 0.0)
    assert f.tables.joints["stepped"].tolist() == [0, 0]
    f.tick(400, 0.06, 0.5, -0.06, -0.5)
    assert f.tables.joints["stepped"].tolist() == [1, 1]
    assert f.stepped == 2


def test_p_and_drift_are_linear_in_the_deviations():
    p = table([forced_response(p, Curve(DEADBEAT, q, after, GUIDE.time)) for p, q, after in CURVES])
    np.testing.assert_allclose(GUIDE.solution(), p, atol=1e-12)
    np.testing.assert_allclose(np.hstack(list(GUIDE.tables.step[:, :, 2:4])), DRIFT, atol=1e-12)


def test_new_filter_has_a_step_without_assistance_and_deviation():
    f, started = (
        GuideFilter(GuideConfig(POLICIES, DISTURBANCE), SHAPE, DEADBEAT, *(GAIT.coefficients[2:4],) * 2) for _ in "ab"
    )
    assert (f.h, f.gates, f.stepped) == ([1.0, 1.0], [0.0, 0.0], 0)
    started.start_step(0.0, (0.0, 0.0), (0.0, 0.0))
    assert np.array_equal(f.tables.step, started.tables.step)
    assert f.tables.joints["xi"].tolist() == [0.0, 0.0]


def test_p_and_drift_include_the_feedforward():
    uf = np.random.default_rng(6).normal(size=(2, 8)) * 10.0
    f = GuideFilter(
        GuideConfig(POLICIES, DISTURBANCE),
        SHAPE,
        DEADBEAT,
        GAIT.coefficients[2:4],
        GAIT.mirrored().coefficients[2:4],
        uf,
    )
    f.start_step(XI, DEVIATION, RATE)
    pushed = [(*curve, f.time, u) for curve, u in zip(CURVES, uf, strict=True)]
    for first, respond in ((0, forced_response), (2, free_drift)):
        expected = table([respond(p, Curve(DEADBEAT, q, after, time, u)) for p, q, after, time, u in pushed])
        np.testing.assert_allclose(np.hstack(list(f.tables.step[:, :, first : first + 2])), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "stride", "first", "horizon"),
    [(100, 8, 0, 904), (300, 3, 2, 902), (800, 1, 0, 900), (5000, 1, 0, 900), (2, 400, 0, 1200)],
)
def test_grid_extends_beyond_the_end_of_the_step(points: int, stride: int, first: int, horizon: int):
    f = tube(points=points)
    assert (f.cycles, f.stride, f.horizon) == (800, stride, horizon)
    assert f.grid.tolist() == list(range(first, horizon + 1, stride))
    assert f.time.tolist() == [cycle * PERIOD for cycle in range(horizon + 1)]
    assert f.tables.joints["first"].tolist() == [first] * 2
    assert f.tables.joints["stride"].tolist() == [stride] * 2


def test_width_follows_the_assistance_factor():
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
def test_compiled_filter_matches_its_source(policies: tuple[BackupPolicy, BackupPolicy]):
    rng = np.random.default_rng(4)
    machine, source = guide(policies), guide(policies)
    for cycle in np.sort(rng.integers(0, 801, 40)).tolist():
        state = (rng.uniform(-1.0, 1.0, 4) * [0.08, 1.0, 0.08, 1.0]).tolist()
        u = tick(source.tables, cycle, *state)
        np.testing.assert_allclose(machine.tick(cycle, *state), u, rtol=1e-12, atol=1e-12)
        for name in ("h", "rate", "gate", "upper", "lower"):
            np.testing.assert_allclose(machine.tables.joints[name], source.tables.joints[name], rtol=1e-12, atol=1e-9)
    assert machine.stepped == source.stepped > 0


def test_state_of_nan_gives_a_torque_of_nan():
    """NaN must reach the torque limiter, which changes to HOLD."""
    f = guide()
    assert all(math.isnan(u) for u in f.tick(100, math.nan, 0.0, 0.0, math.nan))


# -- a rollout cycle by cycle ------------------------------------------------------------------------------------------


#: Upper bound 0.06 rad and lower bound 0.05 rad, for every assistance factor.
TUBE = GuideShape(
    "tube", "", lambda phase, width: (np.full_like(phase, 0.06 / width), np.full_like(phase, 0.05 / width))
)


def tube(
    policies: tuple[BackupPolicy, BackupPolicy] = POLICIES,
    points: int = 100,
    zeta: float = 0.01,
    derivative_time: float = 0.005,
) -> GuideFilter:
    config = GuideConfig(policies, DISTURBANCE, points, zeta=zeta, derivative_time=derivative_time, reserve=RESERVE)
    result = GuideFilter(config, TUBE, DEADBEAT, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4])
    result.start_step(XI, DEVIATION, RATE)
    return result


def of(f: GuideFilter, joint: int) -> tuple[np.void, np.ndarray, np.ndarray]:
    joints, flow, step = f.tables
    return joints[joint], flow[joint], step[joint]


def cycle_by_cycle(
    f: GuideFilter, joint: int, side: int, cycle: int, e: float, ed: float
) -> tuple[list[float], list[bool]]:
    """Return the error towards the side and whether the drive saturates, for each cycle from `cycle` to the horizon."""
    policy, (low, high) = f.config.policies[joint], f.config.disturbance[joint]
    (external, sign), limit = ((low, -1.0) if side else (high, 1.0)), (1.0 - RESERVE) * policy.torque_limit
    (phi,), (s,) = policy.transition(np.array([PERIOD])), policy.step_response(np.array([PERIOD]))
    p, drift = f.tables.step[joint][:, :2], f.tables.step[joint][:, 2:4]
    x, errors, saturated = np.array([e, ed]), [sign * e], []
    for k in range(cycle, f.horizon):
        u = -policy.kp * x[0] - policy.kd * x[1]
        saturated.append(abs(u) > limit)
        if saturated[-1]:
            a = (math.copysign(limit, u) + external) / policy.inertia
            pushed = x - drift[k]
            x = drift[k + 1] + [pushed[0] + pushed[1] * PERIOD + 0.5 * a * PERIOD**2, pushed[1] + a * PERIOD]
        else:
            x = p[k + 1] + phi @ (x - p[k]) + external * s
        errors.append(sign * x[0])
    return errors, saturated


STATES = np.random.default_rng(8).uniform(-1.0, 1.0, (60, 2)) * [0.06, 1.2]


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("limits", [LIMITS, (60.0, 40.0)], ids=["strong", "weak"])
def test_limited_rollout_matches_the_loop_cycle_by_cycle(limits: tuple[float, float], joint: int, side: int):
    """Weak drives saturate, leave their limit and saturate again."""
    hip, knee = (replace(p, torque_limit=limit / (1.0 - RESERVE)) for p, limit in zip(POLICIES, limits, strict=True))
    f, bound, again = tube((hip, knee), points=800), (0.06, 0.05)[side], 0
    for cycle in (0, 350, 600, f.horizon - 1):
        for away, rate in STATES[:16].tolist():
            e = abs(away) * (-1.0 if side else 1.0)
            errors, saturated = cycle_by_cycle(f, joint, side, cycle, e, rate)
            again += np.count_nonzero(np.diff(np.array(saturated, int)) == 1) > 0
            expected, now = max(errors) / bound, errors[0] / bound
            ratio = max(limited(*of(f, joint), side, cycle, e, rate), now)
            if expected >= 2.0:
                assert ratio >= 2.0
            else:
                assert ratio == pytest.approx(expected, abs=1e-9)
    if limits is not LIMITS:
        assert again > 0


@pytest.mark.parametrize("side", [0, 1])
def test_ringing_loop_includes_the_worst_disturbance_from_the_start(side: int):
    weak = replace(RINGING[0], torque_limit=15.0)
    f, sign, bound, (low, high) = tube((weak, POLICIES[1])), (1.0, -1.0)[side], (0.06, 0.05)[side], DISTURBANCE[0]
    state = sign * 0.02, 0.0
    for cycles in (1, 20, 160):
        start, tau = f.horizon - cycles, np.arange(cycles + 1) * PERIOD
        errors, saturated = cycle_by_cycle(f, 0, side, start, *state)
        assert all(saturated)
        most = sign * weak.disturbance(tau, low, high)[side]
        allowance = most - (-low if side else high) * weak.step_response(tau)[:, 0]
        assert bool(allowance.max() > 1e-3) is (cycles == 160)
        expected = (errors + allowance)[1:].max() / bound
        assert expected < 2.0
        assert limited(*of(f, 0), side, start, *state) == pytest.approx(expected, abs=1e-12)


WEAK = tuple(replace(p, torque_limit=limit) for p, limit in zip(POLICIES, (75.0, 50.0), strict=True))


def expected_tick(f: GuideFilter, joint: int, cycle: int, e: float, ed: float) -> tuple[float, int]:
    """Return the ratio of one joint, and the number of rollouts that are integrated step by step."""
    policy, (low, high) = f.config.policies[joint], f.config.disturbance[joint]
    limit = (1.0 - RESERVE) * policy.torque_limit
    points = f.grid[f.grid >= cycle]
    tau = (points - cycle) * PERIOD
    p = f.tables.step[joint][:, :2]
    (largest, smallest), s = policy.disturbance(tau, low, high), policy.step_response(tau)
    x = p[points] + policy.transition(tau) @ (np.array([e, ed]) - p[cycle])
    torque = policy.kp * x[:, 0] + policy.kd * x[:, 1]
    errors = x[:, 0] + largest, -(x[:, 0] + smallest)
    torques = (
        torque + policy.kp * largest + policy.kd * high * s[:, 1],
        -(torque + policy.kp * smallest + policy.kd * low * s[:, 1]),
    )
    monotone = all(p.monotone for p in f.config.policies)
    asked, worst, stepped = policy.kp * e + policy.kd * ed, max(e / 0.06, -e / 0.05), 0
    for side, bound in enumerate((0.06, 0.05)):
        against = abs(asked) if not monotone else -asked if side else asked
        most = np.abs(torques[side]).max() if not monotone else torques[side].max()
        if against > limit or most > limit:
            stepped += 1
            ratio = limited(*of(f, joint), side, cycle, e, ed)
        else:
            ratio = (errors[side] / bound).max()
        worst = max(worst, ratio)
    return worst, stepped


@pytest.mark.parametrize("policies", [POLICIES, WEAK, RINGING], ids=["monotone", "weak", "ringing"])
def test_tick_applies_the_law_of_the_paper_to_the_largest_ratio(policies):
    f = tube(policies, zeta=0.02, derivative_time=0.004)
    h, rate, fresh, steps = [1.0, 1.0], [0.0, 0.0], True, [0, 0]
    for i, states in enumerate(np.random.default_rng(2).uniform(-1.0, 1.0, (24, 4)) * [0.03, 0.7, 0.03, 0.7]):
        cycle = 37 * i
        if i == 12:
            f.start_step(0.8, DEVIATION, RATE)
            fresh = True
        states = states.tolist()
        u = tick(f.tables, min(cycle, 800), *states)
        for joint, (e, ed) in enumerate((states[:2], states[2:])):
            policy = policies[joint]
            ratio, stepped = expected_tick(f, joint, min(cycle, 800), e, ed)
            now = 1.0 - ratio**2
            rate[joint] = 0.0 if fresh else rate[joint] + 0.2 * ((now - h[joint]) / PERIOD - rate[joint])
            h[joint], steps[joint] = now, steps[joint] + stepped
            weight = damped_gate(gate(now, 0.8 if i >= 12 else 0.5), rate[joint], 0.02)
            backup = -policy.kp * e - policy.kd * ed
            assert f.h[joint] == pytest.approx(now, abs=1e-9)
            assert f.tables.joints["rate"][joint] == pytest.approx(rate[joint], abs=1e-6)
            assert f.gates[joint] == pytest.approx(weight, abs=1e-9)
            assert u[joint] == pytest.approx(
                weight * max(-policy.torque_limit, min(policy.torque_limit, backup)), abs=1e-6
            )
        assert f.tables.joints["stepped"].tolist() == steps
        assert f.bounds == pytest.approx([0.06, 0.05])
        assert not f.tables.joints["fresh"].any()
        fresh = False
    assert min(steps) >= 3


@pytest.mark.parametrize(
    ("weight", "rate", "zeta", "damped"),
    [
        (0.5, 3.0, 0.125, 0.5),
        (0.5, 0.0, 0.125, 0.5),
        (0.5, -2.0, 0.125, 0.625),
        (0.5, -7.0, 0.125, 0.9375),
        (0.5, -8.0, 0.125, 1.0),
        (0.5, -12.0, 0.125, 1.0),
        (0.5, -800.0, 0.125, 1.0),
        (0.0, -4.0, 0.125, 0.5),
        (1.0, -4.0, 0.125, 1.0),
        (0.25, -4.0, 0.0, 0.25),
    ],
)
def test_falling_h_increases_the_gate_in_proportion(weight: float, rate: float, zeta: float, damped: float):
    assert damped_gate(weight, rate, zeta) == damped


@pytest.mark.parametrize(
    ("h", "xi", "weight"),
    [(-1.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.5, 0.0, 0.125), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.5, 0.0, 0.0)],
)
def test_gate_has_the_values_of_the_paper(h: float, xi: float, weight: float):
    assert gate(h, xi) == weight
