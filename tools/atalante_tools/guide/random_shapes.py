"""Random guide shapes: smooth, notched and piecewise constant. `seed, index -> GuideShape, assistance factor`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from atalante_control.guide.shapes import GuideShape
from atalante_hal.types import Vector

KINDS: Final = ("smooth", "notched", "piecewise")
#: Range of the random distances from the desired trajectory to an edge of the guide, as fractions of `half_width(xi)`.
#: `_NARROW` is also the smallest width inside a notch, as a fraction of the width beside the notch.
_NARROW, _WIDE = 0.15, 1.0
#: Largest assistance factor of a random guide.
_LARGEST_FACTOR: Final = 0.95


class RandomGuide(NamedTuple):
    """Random shape and the assistance factor at which it is checked."""

    shape: GuideShape
    xi: float


def random_guide(seed: int, number: int) -> RandomGuide:
    """Return the random guide with a given index: a shape and an assistance factor. Consecutive shapes differ in kind.

    Args:
        seed: seed that all guides share.
        number: index of the guide, 0 or larger. The index selects the kind of the shape, and the random numbers together with
            the seed.
    """
    generator, kind = np.random.default_rng([seed, number]), KINDS[number % len(KINDS)]
    make: Callable[[np.random.Generator], Callable[[Vector], Vector]] = {
        "smooth": _smooth, "notched": _notched, "piecewise": _piecewise,
    }[kind]  # fmt: skip
    sides = [make(generator) for _ in range(4)]
    if generator.random() < 0.5:  # symmetric guide: both edges have the same distance from the desired angle
        sides[1], sides[3] = sides[0], sides[2]
    xi = float(generator.uniform(0.0, _LARGEST_FACTOR))

    def fractions(phase: Vector, width: float) -> tuple[Vector, Vector]:
        upper, lower = (np.stack([sides[side](phase), sides[2 + side](phase)]) for side in (0, 1))
        return upper, lower

    return RandomGuide(GuideShape(f"{kind}-{number}", f"random shape {number} of seed {seed}", fractions), xi)


def _smooth(generator: np.random.Generator) -> Callable[[Vector], Vector]:
    """Return a smooth guide width as a function of the phase: a sum of four sine waves, scaled to a random range of widths."""
    waves = generator.normal(size=4) / np.arange(1, 5), 2.0 * math.pi * generator.random(4)
    low, high = np.sort(generator.uniform(_NARROW, _WIDE, 2))
    samples = _waves(np.linspace(0.0, 1.0, 801), *waves)
    bottom, span = samples.min(), np.ptp(samples)
    return lambda phase: np.asarray(low + (high - low) * np.clip((_waves(phase, *waves) - bottom) / span, 0.0, 1.0))


def _waves(phase: Vector, sizes: Vector, shifts: Vector) -> Vector:
    return np.asarray(np.sin(2.0 * math.pi * np.outer(phase, np.arange(1, 5)) + shifts) @ sizes)


def _notched(generator: np.random.Generator) -> Callable[[Vector], Vector]:
    """Return a guide width as a function of the phase: constant, with one to four notches of 0.2 to 5 % of the step each."""
    width, count = float(generator.uniform(0.5, _WIDE)), int(generator.integers(1, 5))
    centres, lengths = generator.random(count), 0.5 * 10.0 ** generator.uniform(-2.7, -1.3, count)
    depths = generator.uniform(_NARROW, 0.9, count)

    def fraction(phase: Vector) -> Vector:
        inside = np.abs(phase[:, None] - centres) <= lengths
        return np.asarray(width * np.where(inside, depths, 1.0).min(axis=1))

    return fraction


def _piecewise(generator: np.random.Generator) -> Callable[[Vector], Vector]:
    """Return a guide width as a function of the phase, with three to twelve constant pieces."""
    edges = np.sort(generator.random(int(generator.integers(2, 12))))
    widths = generator.uniform(_NARROW, _WIDE, len(edges) + 1)
    return lambda phase: np.asarray(widths[np.searchsorted(edges, phase, side="right")])
