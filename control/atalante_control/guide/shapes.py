"""Shapes of the virtual guide: width of the guide along a step, above and below the desired trajectory.

`shape, assistance factor -> bounds over the phase`. The guide filter, the certificate and the plots use the bounds. The paper
does not define the shape. It defines only a half-width, 0.5 + 7 (1 - Xi) degrees. A shape multiplies this half-width by
fractions. The paper is Gurriet et al., 2019.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from atalante_hal.types import Vector

#: Final half-width of the shape `pinched` [rad]. If the half-width at the start is smaller, it stays constant.
PINCH_WIDTH = math.radians(1.0)
SNAP_WIDTH = math.radians(0.1)  # rad, half-width of the shape `snap` in the narrow part of the step
#: Smallest valid distance from the desired trajectory to a bound of a guide [rad], about two encoder counts at the joint.
#: The guide filter divides by the distance, so a much smaller distance would make its safety value h overflow.
NARROWEST = 1e-6
JOINTS = ("SH", "SK")  # joints with a guide, in the order of the bounds
#: Phases and assistance factors at which a shape is checked on construction.
_CHECKED_PHASES = np.linspace(0.0, 1.0, 2001)
_CHECKED_FACTORS = np.linspace(0.0, 1.0, 21).tolist()
#: Increase of a bound [rad] that counts as rounding error.
_ROUNDING = 1e-9


def half_width(xi: float) -> float:
    """Return the guide half-width that the paper defines [rad]: 0.5 + 7 (1 - Xi) degrees.

    A guide shape multiplies this half-width by a fraction at each phase of the step.

    Args:
        xi: assistance factor in [0, 1].

    Raises:
        ValueError: If Xi is outside [0, 1].
    """
    if not 0.0 <= xi <= 1.0:
        raise ValueError(f"assistance factor must be between 0 and 1, got {xi!r}")
    return math.radians(0.5 + 7.0 * (1.0 - xi))


@dataclass(frozen=True)
class GuideShape:
    """Named shape of the guide.

    A shape is checked on construction, at 2001 phases and 21 assistance factors. `GuideFilter` checks the shape again at every
    cycle of the step, and `bounds` checks every result.

    Attributes:
        name: name of the shape, for options and messages.
        summary: one line that describes the shape.
        fractions: function of phases (n,) and the half-width [rad]. It returns two arrays: the width above and the width below
            the desired trajectory, as fractions of the half-width. Each array has the shape (2, n) for SH and SK, or (n,) if
            SH and SK have the same fractions.

    Raises:
        ValueError: If a bound is not finite or is below `NARROWEST`, or if `fractions` returns other array shapes.
    """

    name: str
    summary: str
    fractions: Callable[[Vector, float], tuple[Vector, Vector]]

    def __post_init__(self) -> None:
        self.check(_CHECKED_PHASES)

    def check(self, phase: Vector) -> None:
        """Check the bounds at the given phases, for assistance factors from 0 to 1.

        Args:
            phase: (t - t_i) / T, shape (n,).

        Raises:
            ValueError: If a bound is invalid, as for `bounds`, or larger at a larger assistance factor. The guide of a step is
                certified for the next larger hundredth, see `StepGuides.at`.
        """
        before: Vector | float = math.inf
        for xi in _CHECKED_FACTORS:
            bounds = self.bounds(phase, xi)
            if (bounds > before + _ROUNDING).any():
                raise ValueError(
                    f"bounds of the guide shape {self.name!r} must not become larger with the assistance factor, "
                    f"got larger bounds at Xi {xi:g}"
                )
            before = bounds

    def bounds(self, phase: Vector, xi: float) -> Vector:
        """Return the distances from the desired trajectory to the guide.

        Args:
            phase: (t - t_i) / T, shape (n,); a phase above 1 gets the width at phase 1.
            xi: assistance factor in [0, 1].

        Returns:
            Upper and lower distance of SH and SK, shape (2, n, 2) [rad], finite and at least `NARROWEST`.

        Raises:
            ValueError: If a bound is not finite or too small, if `fractions` does not return two arrays of shape (n,) or (2, n),
                or if Xi is outside [0, 1].
        """
        width, phase = half_width(xi), np.clip(phase, 0.0, 1.0)
        sides = [np.asarray(side, dtype=np.float64) for side in self.fractions(phase, width)]
        of_both, of_each = phase.shape, (len(JOINTS), *phase.shape)
        if len(sides) != 2 or any(side.shape not in (of_both, of_each) for side in sides):
            raise ValueError(
                f"function `fractions` of the guide shape {self.name!r} must return 2 arrays, the upper and the lower side, "
                f"each of the shape {of_both} (the same for both joints) or {of_each} (one row for each joint), "
                f"got {[side.shape for side in sides]}"
            )
        bounds: Vector = width * np.stack([np.broadcast_to(side, of_each) for side in sides], axis=2)
        valid = (bounds >= NARROWEST) & (bounds < math.inf)
        if not valid.all():
            joint, at, side = np.unravel_index(int(valid.argmin()), valid.shape)
            raise ValueError(
                f"bounds of the guide shape {self.name!r} must be finite and at least {NARROWEST:g} rad, got "
                f"{bounds[joint, at, side]:g} rad ({JOINTS[joint]}, {('upper', 'lower')[side]}) at phase {phase[at]:.4g} "
                f"and Xi {xi:g}"
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
    """Return a half cosine that rises from 0 at phase `start` to 1 at phase `end`."""
    x = np.clip((phase - start) / (end - start), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(math.pi * x))


CONSTANT = GuideShape("constant", "constant width along the step", _constant)
WIDENING = GuideShape("widening", "half width at the start, full at the end", _widening)
NARROWING = GuideShape("narrowing", "full width at the start, half at the end", _narrowing)
PINCHED = GuideShape("pinched", "full width until 0.4 T, closing to 1 degree by 0.8 T", _pinched)
ASYMMETRIC = GuideShape("asymmetric", "full width above, 0.6 of it below", _asymmetric)
SNAP = GuideShape("snap", "closes to 0.1 degrees within 0.02 T, too fast for any backup policy", _snap)

#: Shapes of this package, by name. `snap` is an example of a guide that cannot be certified.
SHAPES = {shape.name: shape for shape in (CONSTANT, WIDENING, NARROWING, PINCHED, ASYMMETRIC, SNAP)}
