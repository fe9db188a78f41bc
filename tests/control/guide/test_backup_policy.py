"""Backup policy: its flow compared with the differential equation; overdamped, underdamped and critically damped."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.gait.gait import bezier, derivative
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy, Curve, forced_response, free_drift

OVERDAMPED = BackupPolicy(6300.0, 473.0, 8.0)
CRITICAL = BackupPolicy(8.0 * 28.0**2, 2 * 8.0 * 28.0, 8.0)
UNDERDAMPED = BackupPolicy(6300.0, 60.0, 8.0)
POLICIES = [OVERDAMPED, CRITICAL, UNDERDAMPED]
NAMES = ["overdamped", "critical", "underdamped"]
TAU = np.linspace(0.0, 0.9, 901)


def system(policy: BackupPolicy) -> np.ndarray:
    return np.array([[0.0, 1.0], [-policy.kp / policy.inertia, -policy.kd / policy.inertia]])


def exponential(matrix: np.ndarray) -> np.ndarray:
    """Return the matrix exponential by scaling and squaring of the series."""
    small, result, term = matrix / 2**12, np.eye(2), np.eye(2)
    for i in range(1, 12):
        term = term @ small / i
        result = result + term
    for _ in range(12):
        result = result @ result
    return result


@pytest.mark.parametrize("policy", POLICIES, ids=NAMES)
def test_transition_is_the_matrix_exponential(policy: BackupPolicy):
    for tau in (0.0, 1e-3, 0.02, 0.3, 0.9):
        expected = exponential(system(policy) * tau)
        np.testing.assert_allclose(policy.transition(np.array([tau]))[0], expected, atol=1e-9 * max(1.0, policy.kp / 8))


@given(st.floats(0.2, 3.0), st.floats(5.0, 80.0), st.floats(0.5, 20.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_transitions_of_consecutive_times_multiply(damping: float, rate: float, inertia: float, a: float, b: float):
    policy = BackupPolicy(inertia * rate**2, 2 * damping * inertia * rate, inertia)
    one, other, both = policy.transition(np.array([a, b, a + b]))
    np.testing.assert_allclose(one @ other, both, atol=1e-9 * rate)


@given(st.floats(-1e-6, 1e-6))
def test_flow_is_continuous_through_critical_damping(nudge: float):
    near = BackupPolicy(CRITICAL.kp, CRITICAL.kd * (1.0 + nudge), CRITICAL.inertia)
    np.testing.assert_allclose(near.transition(TAU), CRITICAL.transition(TAU), atol=1e-3)
    np.testing.assert_allclose(near.step_response(TAU), CRITICAL.step_response(TAU), atol=1e-8)


def test_only_damped_loops_are_monotone():
    assert [p.monotone for p in POLICIES] == [True, True, False]


@pytest.mark.parametrize("policy", POLICIES, ids=NAMES)
def test_step_response_solves_the_loop_and_settles_at_the_stiffness(policy: BackupPolicy):
    s = policy.step_response(TAU)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (s[1:, 0] + s[:-1, 0]) * 1e-3)])
    # J e'' + Kd e' + Kp e = 1, integrated once
    np.testing.assert_allclose(policy.inertia * s[:, 1] + policy.kd * s[:, 0] + policy.kp * area, TAU, atol=1e-4)
    np.testing.assert_allclose(np.diff(s[:, 0]), 0.5 * (s[1:, 1] + s[:-1, 1]) * 1e-3, atol=1e-8)
    assert policy.step_response(np.array([20.0]))[0, 0] == pytest.approx(1.0 / policy.kp, rel=1e-6)


def test_peak_response_of_a_monotone_loop_is_its_step_response():
    np.testing.assert_array_equal(OVERDAMPED.peak_response(TAU), OVERDAMPED.step_response(TAU)[:, 0])


def test_peak_response_is_the_l1_norm_of_the_impulse_response():
    fine = np.linspace(0.0, 0.9, 900_001)
    impulse = np.abs(UNDERDAMPED.step_response(fine)[:, 1])
    summed = np.concatenate([[0.0], np.cumsum(0.5 * (impulse[1:] + impulse[:-1]) * np.diff(fine))])
    np.testing.assert_allclose(UNDERDAMPED.peak_response(TAU), summed[::1000], atol=1e-10)
    assert UNDERDAMPED.peak_response(TAU)[-1] > 1.5 * UNDERDAMPED.step_response(TAU)[:, 0].max()


@pytest.mark.parametrize("policy", POLICIES, ids=NAMES)
def test_disturbance_bounds_every_signal_and_is_reached(policy: BackupPolicy):
    low, high = -10.0, 25.0
    largest, smallest = policy.disturbance(TAU, low, high)
    phi, step = policy.transition(np.array([1e-3]))[0], policy.step_response(np.array([1e-3]))[0]

    def response(signal: np.ndarray) -> np.ndarray:
        x, errors = np.zeros(2), [0.0]
        for u in signal:
            x = phi @ x + step * u
            errors.append(float(x[0]))
        return np.array(errors)

    rng = np.random.default_rng(2)
    signals = [np.full(900, high), np.full(900, low)]
    signals += [rng.choice([low, high], size=90).repeat(10) for _ in range(20)]
    # The worst disturbance at the end has the sign of the time-reversed impulse response.
    backwards = policy.step_response(TAU[1:] - 5e-4)[::-1, 1]
    signals.append(np.where(backwards > 0.0, high, low))
    for signal in signals:
        errors = response(signal)
        assert (errors <= largest + 1e-12).all()
        assert (errors >= smallest - 1e-12).all()
    assert errors[-1] == pytest.approx(largest[-1], rel=1e-3)


@pytest.mark.parametrize("policy", POLICIES, ids=NAMES)
def test_particular_solution_solves_the_loop(policy: BackupPolicy):
    forcing = np.array([3.0, -20.0, 55.0, 7.0, -90.0, 40.0])
    solution = np.polynomial.Polynomial(policy.particular(forcing, 0.8))
    x = np.linspace(0.0, 1.0, 11)
    value, slope, curvature = solution(x), solution.deriv()(x) / 0.8, solution.deriv(2)(x) / 0.64
    left = curvature + policy.kd / policy.inertia * slope + policy.kp / policy.inertia * value
    np.testing.assert_allclose(left, np.polynomial.polynomial.polyval(x, forcing), atol=1e-9)


RNG = np.random.default_rng(4)
NOW, THEN, UF = RNG.normal(size=8) * 0.3, RNG.normal(size=8) * 0.3, RNG.normal(size=8) * 20.0
DEADBEAT = Deadbeat(0.8, 0.4)


def forcing(policy: BackupPolicy, time: np.ndarray, part: int) -> np.ndarray:
    """Return u_f / J - q_des'' of one part: nominal motion with feedforward, or one of the two re-centring cubics."""
    if part:
        return -DEADBEAT.basis(time)[2][part - 1]
    late, second = time > 0.8, derivative(derivative(np.stack([NOW, THEN]))) / 0.64
    now, then = (
        bezier(second, np.clip(time, 0, 0.8) / 0.8)[:, 0],
        bezier(second, np.clip(time - 0.8, 0, 0.8) / 0.8)[:, 1],
    )
    uf = bezier(UF[None, :], np.clip(time, 0, 0.8) / 0.8)[:, 0] / policy.inertia
    return np.where(late, -then, uf - now)


@pytest.mark.parametrize("policy", POLICIES, ids=NAMES)
@pytest.mark.parametrize("part", [0, 1, 2], ids=["nominal", "deviation", "rate"])
def test_forced_response_is_integrated_by_runge_kutta(policy: BackupPolicy, part: int):
    time = np.arange(901) * 1e-3
    response = forced_response(policy, Curve(DEADBEAT, NOW, THEN, time, UF))[part]
    a, h, x = system(policy), 2.5e-4, response[0].copy()
    # Just inside each interval, because the forcing jumps at T and at the end of the re-centring.
    start = np.arange(3600) * h
    stages = np.stack([forcing(policy, start + inside, part) for inside in (1e-9, h / 2, h - 1e-9)], axis=1)
    worst = 0.0
    for i, (f0, f1, f2) in enumerate(stages):
        push = [np.array([0.0, f]) for f in (f0, f1, f2)]
        k1 = a @ x + push[0]
        k2 = a @ (x + h / 2 * k1) + push[1]
        k3 = a @ (x + h / 2 * k2) + push[1]
        k4 = a @ (x + h * k3) + push[2]
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if (i + 1) % 4 == 0:
            worst = max(worst, abs(x[0] - response[(i + 1) // 4, 0]))
    assert worst < 1e-6


@pytest.mark.parametrize("part", [0, 1, 2], ids=["nominal", "deviation", "rate"])
def test_free_drift_is_the_twice_integrated_forcing(part: int):
    time = np.arange(901) * 1e-3
    drift = free_drift(OVERDAMPED, Curve(DEADBEAT, NOW, THEN, time, UF))[part]
    np.testing.assert_allclose(np.diff(drift[:, 0]), 0.5 * (drift[1:, 1] + drift[:-1, 1]) * 1e-3, atol=1e-6)
    middle = 0.5 * (time[1:] + time[:-1])
    np.testing.assert_allclose(np.diff(drift[:, 1]) / 1e-3, forcing(OVERDAMPED, middle, part), atol=0.2)
    assert np.abs(np.diff(drift[:, 0])).max() < 0.05  # no jump where the next step begins


@pytest.mark.parametrize("bad", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, float("nan"))])
def test_invalid_gains_are_rejected(bad: tuple[float, float, float]):
    with pytest.raises(ValueError, match="positive and finite"):
        BackupPolicy(*bad)
    with pytest.raises(ValueError, match="torque_limit"):
        BackupPolicy(1.0, 1.0, 1.0, 0.0)


def test_late_error_decays_with_the_slowest_mode():
    late = np.array([0.5, 0.6])
    error = OVERDAMPED.transition(late)[:, 0, 0]
    slowest = -np.roots([OVERDAMPED.inertia, OVERDAMPED.kd, OVERDAMPED.kp]).max()
    assert math.log(error[0] / error[1]) / 0.1 == pytest.approx(slowest, rel=1e-3)
