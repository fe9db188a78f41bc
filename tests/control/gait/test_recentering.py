"""Re-centring (the paper's deadbeat): the four conditions of the paper, and linearity in the deviations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.gait.recentering import Deadbeat

ALPHAS = st.floats(0.02, 1.0)
DURATIONS = st.floats(0.3, 3.0)


@given(ALPHAS, DURATIONS, st.floats(-1.0, 1.0), st.floats(-4.0, 4.0))
def test_re_centring_starts_at_the_deviation_and_ends_at_zero(
    alpha: float, duration: float, deviation: float, rate: float
):
    deadbeat = Deadbeat(duration, alpha)
    value, slope, _ = deadbeat.basis(np.array([0.0, deadbeat.end * (1 - 1e-12)]))
    weights = np.array([deviation, rate])
    np.testing.assert_allclose(weights @ value, [deviation, 0.0], atol=1e-9)
    np.testing.assert_allclose(weights @ slope, [rate, 0.0], atol=1e-8)


@given(ALPHAS, DURATIONS)
def test_re_centring_is_exactly_zero_after_alpha_times_the_step(alpha: float, duration: float):
    deadbeat = Deadbeat(duration, alpha)
    late = deadbeat.end + np.linspace(0.0, duration, 5)
    assert all(not part.any() for part in deadbeat.basis(late))
    assert not deadbeat.s(late, np.ones(3), np.ones(3)).any()


def test_re_centring_derivatives_match_finite_differences():
    deadbeat = Deadbeat(0.8, 0.4)
    time = np.linspace(0.0, deadbeat.end, 400, endpoint=False)
    value, slope, curvature = deadbeat.basis(time)
    step = time[1] - time[0]
    np.testing.assert_allclose(np.gradient(value, step, axis=1)[:, 1:-1], slope[:, 1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(slope, step, axis=1)[:, 1:-1], curvature[:, 1:-1], atol=1e-3)
    np.testing.assert_allclose(np.diff(curvature, 2), 0.0, atol=1e-9)  # a cubic's second derivative is a line


def test_re_centring_is_linear_in_the_deviations():
    deadbeat, time = Deadbeat(0.8), np.linspace(0.0, 0.8, 9)
    a, b = np.array([0.1, -0.2]), np.array([1.0, 3.0])
    zero = np.zeros(2)
    np.testing.assert_allclose(
        deadbeat.s(time, a, b), deadbeat.s(time, a, zero) + deadbeat.s(time, zero, b), atol=1e-15
    )
    assert deadbeat.s(time, a, b).shape == (9, 2)


@pytest.mark.parametrize(("duration", "alpha"), [(0.0, 0.3), (-1.0, 0.3), (float("nan"), 0.3), (0.8, 0.0), (0.8, 1.1)])
def test_invalid_duration_or_alpha_is_rejected(duration: float, alpha: float):
    with pytest.raises(ValueError, match=r"step|alpha"):
        Deadbeat(duration, alpha)
