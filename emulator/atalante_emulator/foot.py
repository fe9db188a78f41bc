"""The two feet: what each of their four three-axis force cells feels, in the foot's own frame, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import Vector3

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FootParameters:
    """Noise of the emulated force cells at 1 kHz."""

    noise: tuple[float, float, float] = (3.0, 3.0, 10.0)  # N rms along x, y, z of a cell
    temperature: float = 28.0  # degC


class Feet:
    """Eight force cells. `force` is shape (2, 4, 3) [N], on the foot, and rewritten by `sample`."""

    def __init__(self, parameters: FootParameters, force: Vector) -> None:
        self._force = force
        self._scale = np.tile(np.array(parameters.noise), force.size // 3)
        self._loaded = True

    def sample(self, contact: Sequence[tuple[int, int, Vector3]], rotation: Sequence[tuple[float, ...]]) -> None:
        """Read the cells.

        Args:
            contact: foot, cell and world force on the foot [N] of every contact of the last step.
            rotation: quaternion xyzw of each foot, foot frame to world.
        """
        if not contact:
            if self._loaded:
                self._force.fill(0.0)
                self._loaded = False
            return
        self._force.fill(0.0)
        self._loaded = True
        for foot, cell, force in contact:
            self._force[foot, cell] += into_frame(rotation[foot], force)

    def draw_noise(self, generator: np.random.Generator, out: Vector) -> None:
        """Noise of many cycles. Shape (cycles, 24) [N], order of `force`."""
        np.multiply(generator.standard_normal(out.shape), self._scale, out=out)


def into_frame(rotation: tuple[float, ...], vector: Vector3) -> Vector3:
    """A world vector in the axes of a frame whose quaternion xyzw (frame to world) is `rotation`."""
    x, y, z, w = rotation
    vx, vy, vz = vector
    # v' = v - 2 w (u x v) + 2 u x (u x v), the inverse rotation.
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    return (
        vx - 2.0 * (w * cx - (y * cz - z * cy)),
        vy - 2.0 * (w * cy - (z * cx - x * cz)),
        vz - 2.0 * (w * cz - (x * cy - y * cx)),
    )
