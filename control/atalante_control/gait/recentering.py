"""Re-centring, the paper's deadbeat: the cubic that joins the measured pose at a step change to the nominal trajectory.

`step change -> (q - q_nom, q' - q_nom') -> s(t) -> q_des(t) = q_nom(t) + s(t)`. The tracking error is exactly zero at
the change and the nominal trajectory is met, with its velocity, alpha T later. s is linear in the two deviations:
s(t) = s(0) c0(t) + s'(0) c1(t), and the guide filter uses the basis cubics c0 and c1 to prepare every response once.

The paper names the polynomial a deadbeat. It is a reference trajectory, not a finite-time (deadbeat) control law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Deadbeat:
    """Deadbeat of one gait.

    Raises:
        ValueError: alpha outside (0, 1], or a duration that is not positive.
    """

    duration: float  # s, nominal duration of a step, T
    alpha: float = 0.3  # fraction of T after which the nominal trajectory is met

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration) and self.duration > 0.0):
            raise ValueError(f"the step duration is positive and finite, in s, not {self.duration!r}")
        if not 0.0 < self.alpha <= 1.0:
            raise ValueError(f"the deadbeat's alpha is a fraction of a step in (0, 1], not {self.alpha!r}")

    @property
    def end(self) -> float:
        """Time at which s and s' have become zero [s], alpha T."""
        return self.alpha * self.duration

    def polynomials(self) -> Vector:
        """Basis cubics in powers of x = t / (alpha T): row 0 is c0, row 1 is c1 [s]. Shape (2, 4).

        c0(0) = 1, c0'(0) = 0 and c1(0) = 0, c1'(0) = 1; both end at x = 1 with value and slope zero.
        """
        return np.array([[1.0, 0.0, -3.0, 2.0], [0.0, self.end, -2.0 * self.end, self.end]])

    def basis(self, time: Vector) -> tuple[Vector, Vector, Vector]:
        """Values, first and second time derivatives of c0 and c1, zero from alpha T on.

        Args:
            time: since the step change, shape (n,) [s], not negative.

        Returns:
            Three arrays of shape (2, n): of c0 [1, 1/s, 1/s2] and c1 [s, 1, 1/s].
        """
        x = time / self.end
        inside = x < 1.0
        c = self.polynomials()
        first, second = _differentiate(c) / self.end, _differentiate(_differentiate(c)) / self.end**2
        return tuple(np.where(inside, _values(p, x), 0.0) for p in (c, first, second))  # type: ignore[return-value]

    def s(self, time: Vector, deviation: Vector, rate: Vector) -> Vector:
        """The cubic of the paper for deviations at the step change.

        Args:
            time: since the change, shape (n,) [s].
            deviation: q(t_i) - q_nom(0), shape (m,) [rad].
            rate: q'(t_i) - q_nom'(0), shape (m,) [rad/s].

        Returns:
            s, shape (n, m) [rad].
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
