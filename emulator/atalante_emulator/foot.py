"""Emulated force cells of the two feet: compute the forces of all cells in the foot frame from the contacts of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from atalante_emulator.body import Vector3
from atalante_hal.types import Vector


@dataclass(frozen=True)
class FootParameters:
    """Noise and temperature of the emulated force cells. The sample rate is 1 kHz."""

    noise: tuple[float, float, float] = (3.0, 3.0, 10.0)  # noise of a cell along x, y, z [N rms]
    temperature: float = 28.0  # constant temperature of all cells [degC]


class Feet:
    """Force cells of two feet, four cells per foot. `sample` updates the array of forces, shape (2, 4, 3) [N]."""

    def __init__(self, parameters: FootParameters, force: Vector) -> None:
        self._force = force
        self._scale = np.tile(np.array(parameters.noise), force.size // 3)
        self._loaded = True

    def sample(self, contact: Sequence[tuple[int, int, Vector3]], rotation: Sequence[tuple[float, ...]]) -> None:
        """Sample all force cells. Must be called once per `PERIOD`.

        Args:
            contact: per contact of the last time step: index of the foot, index of the cell, force on the foot in world axes [N].
            rotation: attitude of each foot, quaternion xyzw from the foot frame to the world.
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
        """Draw the noise of the force cells for many cycles.

        Args:
            generator: source of the random numbers.
            out: array that receives the noise, shape (cycles, 24) [N], in the order of the forces.
        """
        np.multiply(generator.standard_normal(out.shape), self._scale, out=out)


def into_frame(rotation: tuple[float, ...], vector: Vector3) -> Vector3:
    """Transform a vector from world axes into the axes of a frame.

    Args:
        rotation: attitude of the frame, quaternion xyzw from the frame to the world.
        vector: vector in world axes.
    """
    x, y, z, w = rotation
    vx, vy, vz = vector
    # Inverse rotation by the quaternion (w, u): v' = v - 2 w (u x v) + 2 u x (u x v).
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    return (
        vx - 2.0 * (w * cx - (y * cz - z * cy)),
        vy - 2.0 * (w * cy - (z * cx - x * cz)),
        vz - 2.0 * (w * cz - (x * cy - y * cx)),
    )
