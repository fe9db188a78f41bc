"""Shapes of the virtual guide: how wide the tube is along a step, above and below the desired trajectory.

`shape, assistance factor -> bounds over the phase -> guide filter, certificate, plots`. The shape is free in the paper;
its full half-width is the paper's 0.5 + 7 (1 - Xi) degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]

PINCH_WIDTH = math.radians(1.0)  # rad, what the pinched guide closes to
SNAP_WIDTH = math.radians(0.1)  # rad, what the snapping guide closes to
#: Smallest bound of a shape [rad], about two encoder counts at the joint. A positive bound far below it overflows the filter's h.
NARROWEST = 1e-6
#: Phases and assistance factors at which a shape is checked when it is made.
_CHECKED_PHASES = np.linspace(0.0, 1.0, 2001)
_CHECKED_FACTORS = np.linspace(0.0, 1.0, 21).tolist()


def half_width(xi: float) -> float:
    """Full half-width of the guide [rad] for an assistance factor: 0.5 + 7 (1 - Xi) degrees.

    Raises:
        ValueError: Xi outside [0, 1].
    """
    if not 0.0 <= xi <= 1.0:
        raise ValueError(f"the assistance factor is between 0 and 1, not {xi!r}")
    return math.radians(0.5 + 7.0 * (1.0 - xi))


@dataclass(frozen=True)
class GuideShape:
    """A named shape. `fractions(phase, half_width)` gives the parts of the half-width, upper and lower, each (n,).

    A shape is evaluated when it is made, at 2001 phases and 21 assistance factors. `GuideFilter` evaluates it again at every
    cycle of its step, and `bounds` checks whatever it returns.

    Raises:
        ValueError: a bound is not finite or is smaller than `NARROWEST`, or `fractions` returns other array shapes.
    """

    name: str
    summary: str
    fractions: Callable[[Vector, float], tuple[Vector, Vector]]

    def __post_init__(self) -> None:
        self.check(_CHECKED_PHASES)

    def check(self, phase: Vector) -> None:
        """Evaluate the bounds at the phases, for assistance factors from 0 to 1.

        Args:
            phase: (t - t_i) / T, shape (n,).

        Raises:
            ValueError: as for `bounds`.
        """
        for xi in _CHECKED_FACTORS:
            self.bounds(phase, xi)

    def bounds(self, phase: Vector, xi: float) -> Vector:
        """Distances from the desired trajectory to the guide.

        Args:
            phase: (t - t_i) / T, shape (n,); what is past 1 gets the width at 1.
            xi: assistance factor in [0, 1].

        Returns:
            Shape (n, 2) [rad], upper and lower, finite and at least `NARROWEST`.

        Raises:
            ValueError: a bound is not finite or is too small; `fractions` returns other than two arrays of shape (n,); Xi is
                outside [0, 1].
        """
        width, phase = half_width(xi), np.clip(phase, 0.0, 1.0)
        sides = [np.asarray(side, dtype=np.float64) for side in self.fractions(phase, width)]
        if [side.shape for side in sides] != [phase.shape] * 2:
            raise ValueError(
                f"fractions of the guide shape {self.name!r} must return 2 arrays of shape {phase.shape}, "
                f"got {[side.shape for side in sides]}"
            )
        bounds: Vector = width * np.stack(sides, axis=1)
        valid = (bounds >= NARROWEST) & (bounds < math.inf)
        if not valid.all():
            at, side = divmod(int(valid.argmin()), 2)
            raise ValueError(
                f"bounds of the guide shape {self.name!r} must be finite and at least {NARROWEST:g} rad, got "
                f"{bounds[at, side]:g} rad ({('upper', 'lower')[side]}) at phase {phase[at]:.4g} and Xi {xi:g}"
            )
        return bounds


def _constant(phase: Vector, width: float) -> tuple[Vector, Vector]:
    return np.ones_like(phase), np.ones_like(phase)


def _widening(phase: Vector, width: float) -> tuple[Vector, Vector]:
    fraction = 0.5 + 0.5 * _rise(phase, 0.1, 0.9)
    return fraction, fraction


def _narrowing(phase: Vector, width: float) -> tuple[Vector, Vector]:
    fraction = 1.0 - 0.5 * _rise(phase, 0.1, 0.9)
    return fraction, fraction


def _pinched(phase: Vector, width: float) -> tuple[Vector, Vector]:
    closed = min(1.0, PINCH_WIDTH / width)
    fraction = 1.0 - (1.0 - closed) * _rise(phase, 0.4, 0.8)
    return fraction, fraction


def _asymmetric(phase: Vector, width: float) -> tuple[Vector, Vector]:
    return np.ones_like(phase), 0.6 * np.ones_like(phase)


def _snap(phase: Vector, width: float) -> tuple[Vector, Vector]:
    closed = min(1.0, SNAP_WIDTH / width)
    fraction = 1.0 - (1.0 - closed) * (_rise(phase, 0.35, 0.37) - _rise(phase, 0.7, 0.72))
    return fraction, fraction


def _rise(phase: Vector, start: float, end: float) -> Vector:
    """From 0 at `start` to 1 at `end`, half a cosine."""
    x = np.clip((phase - start) / (end - start), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(math.pi * x))


CONSTANT = GuideShape("constant", "the same width all along the step", _constant)
WIDENING = GuideShape("widening", "half width at the start, full at the end", _widening)
NARROWING = GuideShape("narrowing", "full width at the start, half at the end", _narrowing)
PINCHED = GuideShape("pinched", "full width until 0.4 T, closing to 1 degree by 0.8 T", _pinched)
ASYMMETRIC = GuideShape("asymmetric", "full width above, 0.6 of it below", _asymmetric)
SNAP = GuideShape("snap", "closes to 0.1 degrees in 0.02 T: what no backup policy follows", _snap)

#: The shapes that ship, by name. `snap` cannot be certified; it shows how that is announced.
SHAPES = {shape.name: shape for shape in (CONSTANT, WIDENING, NARROWING, PINCHED, ASYMMETRIC, SNAP)}
