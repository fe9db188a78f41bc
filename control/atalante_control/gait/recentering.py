"""Re-centring ("deadbeat" in the paper): a cubic that leads from the pose at a stance change to the nominal trajectory.

`stance change -> (q - q_nom, q' - q_nom') -> s(t) -> q_des(t) = q_nom(t) + s(t)`. The tracking error is exactly zero at the
stance change. At the time alpha T after the stance change, the desired trajectory reaches the nominal trajectory (T is the
step duration). s is linear in the deviations: `s(t) = s(0) c0(t) + s'(0) c1(t)`. The guide filter can therefore compute
the responses to the basis cubics c0 and c1 in advance.

The paper calls this polynomial a deadbeat. It is a reference trajectory, not a finite-time (deadbeat) control law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from atalante_hal.types import Vector


@dataclass(frozen=True)
class Deadbeat:
    """Re-centring ("deadbeat" in the paper) of one gait: an offset s(t) added to q_nom after a stance change.

    Raises:
        ValueError: If alpha is outside (0, 1], or the duration is not positive.
    """

    duration: float  # s, nominal duration of a step, T
    alpha: float = 0.3  # fraction of T after which the offset is zero

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration) and self.duration > 0.0):
            raise ValueError(f"step duration must be finite and above 0 s, got {self.duration!r}")
        if not 0.0 < self.alpha <= 1.0:
            raise ValueError(
                f"alpha of the re-centring must be above 0 and at most 1 (fraction of the step duration), got {self.alpha!r}"
            )

    @property
    def end(self) -> float:
        """Return alpha T [s], the time from the stance change to the end of the re-centring."""
        return self.alpha * self.duration

    def polynomials(self) -> Vector:
        """Return the coefficients of the basis cubics c0 and c1 in powers of x = t / (alpha T), shape (2, 4).

        c0(0) = 1, c0'(0) = 0 and c1(0) = 0, c1'(0) = 1. At x = 1 the values and slopes are zero. c0 has no unit, c1 is in s.
        """
        return np.array([[1.0, 0.0, -3.0, 2.0], [0.0, self.end, -2.0 * self.end, self.end]])

    def basis(self, time: Vector) -> tuple[Vector, Vector, Vector]:
        """Return c0 and c1 with their first and second time derivatives. After the time alpha T all values are zero.

        Args:
            time: time since the stance change, shape (n,) [s], at least 0.

        Returns:
            Values, first derivatives and second derivatives, each of shape (2, n). Row 0 is for c0 [1, 1/s, 1/s2], row
            1 for c1 [s, 1, 1/s].
        """
        x = time / self.end
        inside = x < 1.0
        c = self.polynomials()
        first, second = _differentiate(c) / self.end, _differentiate(_differentiate(c)) / self.end**2
        return tuple(np.where(inside, _values(p, x), 0.0) for p in (c, first, second))  # type: ignore[return-value]

    def s(self, time: Vector, deviation: Vector, rate: Vector) -> Vector:
        """Return the offset s of the re-centring for given deviations at the stance change.

        Args:
            time: time since the stance change, shape (n,) [s].
            deviation: deviation of the joint angles at the stance change, q(t_i) - q_nom(0), shape (m,) [rad].
            rate: deviation of the joint speeds at the stance change, q'(t_i) - q_nom'(0), shape (m,) [rad/s].

        Returns:
            Values of s, shape (n, m) [rad].
        """
        c0, c1 = self.basis(time)[0]
        return np.outer(c0, deviation) + np.outer(c1, rate)


def _values(coefficients: Vector, x: Vector) -> Vector:
    result = np.zeros((len(coefficients), len(x)))
    for column in coefficients.T[::-1]:
        result = result * x + column[:, None]
    return result


def _differentiate(coefficients: Vector) -> Vector:
    return coefficients[:, 1:] * np.arange(1, coefficients.shape[1])
