"""Backup policy: gains, modes, and the sampled loop against a simulation cycle by cycle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.guide.backup_policy import BackupPolicy, SampledLoop, responses

MASS = (7.8, 3.5, 1.87)
POLICY = BackupPolicy((2800.0, 2900.0), (1.3, 0.85), MASS)
LOOP = SampledLoop()
DT = 1e-3


def matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    m11, m12, m22 = MASS
    return np.array([[m11, m12], [m12, m22]]), *POLICY.gains()


def test_stiffness_is_that_of_the_joints():
    mass, kv, _ = matrices()
    np.testing.assert_allclose(mass @ kv, np.diag(POLICY.stiffness), atol=1e-9)


def test_modes_have_the_damping_ratios():
    kappa, delta, shapes = POLICY.modes()
    assert kappa[0] < kappa[1]
    np.testing.assert_allclose(delta / (2.0 * np.sqrt(kappa)), POLICY.damping)
    _, kv, dv = matrices()
    np.testing.assert_allclose(kv @ shapes, shapes * kappa)
    np.testing.assert_allclose(dv @ shapes, shapes * delta)


def simulated(x: np.ndarray, cycles: int, mobility: float, delay: int, push: np.ndarray) -> np.ndarray:
    """Return e of both joints, shape (cycles + 1, 2); `push` is an acceleration in the first cycle."""
    _, kv, dv = matrices()
    e, ed, v, motor, last = (part.copy() for part in x.reshape(5, 2))
    pending, errors = [last.copy() for _ in range(delay)], [e.copy()]
    for cycle in range(cycles):
        pending.append(-kv @ e - dv @ v)
        motor = motor + LOOP.tracking * (pending.pop(0) - motor)
        a = mobility * (motor + (push if cycle == 0 else 0.0))
        moved = ed * DT + 0.5 * a * DT**2
        e, ed = e + moved, ed + a * DT
        v = LOOP.keep * v + (1.0 - LOOP.keep) * moved / DT
        errors.append(e.copy())
    return np.array(errors)


@pytest.mark.parametrize(("mobility", "delay"), [(1.0, 1), (1.1, 2), (0.9, 3)])
def test_responses_match_a_simulation_of_the_loop(mobility: float, delay: int):
    x = np.random.default_rng(0).normal(size=10) * np.repeat([0.05, 1.0, 1.0, 50.0, 50.0], 2)
    found = responses(POLICY, LOOP, mobility, 200, delay)
    still = np.zeros(2)
    np.testing.assert_allclose(found.error @ x, simulated(x, 200, mobility, delay, still), atol=1e-10)
    push = np.array([30.0, -20.0])
    np.testing.assert_allclose(
        found.pushed_error @ push, simulated(np.zeros(10), 200, mobility, delay, push), atol=1e-10
    )


def test_feedback_and_rate_belong_to_the_same_motion():
    x = np.random.default_rng(1).normal(size=10)
    found = responses(POLICY, LOOP, 1.0, 50)
    _, kv, dv = matrices()
    np.testing.assert_allclose(found.feedback[0] @ x, -kv @ x[:2] - dv @ x[4:6])
    np.testing.assert_allclose(found.rate[0] @ x, x[2:4])


def test_lags_are_those_of_a_constant_acceleration():
    velocity, lagging = 0.0, 0.0
    for _ in range(200):
        before, velocity = velocity, velocity + 3.0 * DT
        lagging = LOOP.keep * lagging + (1.0 - LOOP.keep) * 0.5 * (before + velocity)
    assert velocity - lagging == pytest.approx(3.0 * LOOP.velocity_lag)
    assert LOOP.command_lag == pytest.approx(DT * (0.5 + 1.0 / (1.0 - math.exp(-2.0))))


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"stiffness": (0.0, 1.0)}, "stiffness"),
        ({"damping": (1.0, math.nan)}, "damping"),
        ({"mass": (1.0, 2.0, 1.0)}, "mass"),
    ],
)
def test_an_invalid_policy_is_rejected(bad: dict[str, tuple[float, ...]], name: str):
    with pytest.raises(ValueError, match=name):
        BackupPolicy(**{"stiffness": (1.0, 1.0), "damping": (1.0, 1.0), "mass": MASS} | bad)  # type: ignore[arg-type]


def test_an_invalid_loop_is_rejected():
    with pytest.raises(ValueError, match="torque_lag"):
        SampledLoop(torque_lag=0.0)
