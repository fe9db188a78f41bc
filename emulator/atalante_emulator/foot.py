"""Emulated force cells of the two feet: compute the force on each cell, in foot coordinates, from the forces on the soles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from atalante_emulator.bodies.soles import Soles
from atalante_hal.compiled import specialised
from atalante_hal.robot import FEET
from atalante_hal.types import Vector


@dataclass(frozen=True)
class FootParameters:
    """Noise and temperature of the emulated force cells. The sample rate is 1 kHz."""

    noise: tuple[float, float, float] = (3.0, 3.0, 10.0)  # noise of each force cell along x, y, z [N rms]
    temperature: float = 28.0  # constant temperature of all force cells [degC]


def _share(plate: Vector, sole_force: Vector, force: Vector) -> None:
    """Compute the force on each force cell from the forces of the floor on the sole corners.

    Args:
        plate: matrix for each foot: cell forces = matrix times corner forces, shape (2, 12, 12).
        sole_force: forces on the corners, shape (2, 4, 3) [N].
        force: output for the forces of the cells, shape (2, 4, 3) [N].
    """
    for foot in range(len(plate)):
        corners, cells = sole_force[foot].reshape(-1), force[foot].reshape(-1)
        for row in range(len(cells)):
            total = 0.0
            for column in range(len(corners)):
                total += plate[foot, row, column] * corners[column]
            cells[row] = total


class Feet:
    """Force cells of both feet. `sample` writes the force on each cell to the array given to the constructor.

    The array has the shape (2, 4, 3) [N]. Its indices count the foot, the cell and the axis.
    """

    def __init__(self, parameters: FootParameters, soles: Soles, force: Vector) -> None:
        self._force = force
        self._scale = np.tile(np.array(parameters.noise), force.size // 3)
        both, count = soles.plate(), force.size // len(FEET)
        self._plate = np.array([both[first : first + count, first : first + count] for first in (0, count)])
        self._corners = np.zeros_like(force)
        self._share = specialised(_share, self._plate, self._corners, force)
        self._loaded = True

    def sample(self, sole_force: Vector, touching: bool) -> None:
        """Sample all force cells. The caller must call this method once in each cycle of 1 ms (`PERIOD`).

        Args:
            sole_force: forces on the corners of the soles in the last time step, in foot axes, shape (2, 4, 3) [N].
            touching: whether a corner touched the floor. If False, `sole_force` must be zero.
        """
        if touching:
            self._corners[:] = sole_force
            self._share(self._plate, self._corners, self._force)
        elif self._loaded:
            self._force.fill(0.0)
        self._loaded = touching

    def draw_noise(self, generator: np.random.Generator, out: Vector) -> None:
        """Draw the noise of the force cells for many cycles.

        Args:
            generator: source of the random numbers.
            out: output for the noise, shape (cycles, 24) [N]. The columns are in the order of the forces.
        """
        np.multiply(generator.standard_normal(out.shape), self._scale, out=out)
