"""The twelve motor encoders: joint positions in, counts, and what the state frames say of position and velocity."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, Robot

Vector = npt.NDArray[np.float64]

COUNTS = 131072  # encoder counts a motor turn, 17 bits
LSB = 2.0 * math.pi / COUNTS  # rad at the motor


def _sample(
    joint: Vector,
    counts_per_rad: Vector,
    keep: float,
    counts: Vector,
    before: Vector,
    position: Vector,
    velocity: Vector,
) -> None:
    """Counts of all encoders, and position and velocity as the state frames say them. Shape (12,) each."""
    for i in range(len(joint)):
        count = np.rint(joint[i] * counts_per_rad[i])
        before[i] = count if math.isnan(counts[i]) else counts[i]
        counts[i] = count
        position[i] = count * LSB
        velocity[i] = keep * velocity[i] + (1.0 - keep) * ((count - before[i]) * LSB / PERIOD)


class Encoders:
    """Encoders of all joints; `position` [rad] and `velocity` [rad/s] at the motor, shape (12,), rewritten by `sample`."""

    def __init__(self, robot: Robot, bandwidth: float, position: Vector, velocity: Vector) -> None:
        """`bandwidth` of the velocity estimate [Hz]."""
        self._counts_per_rad = robot.gear * robot.polarity * (COUNTS / (2.0 * math.pi))
        self._keep = math.exp(-2.0 * math.pi * bandwidth * PERIOD)
        self._counts, self._before = np.zeros((2, len(JOINTS)))
        self._position, self._velocity = position, velocity
        self._sample = compiled(_sample)
        self.sample(np.zeros(len(JOINTS)))  # is compiled now, not in the first cycle
        self._counts.fill(math.nan)  # there was no sample yet

    def sample(self, position: Vector) -> None:
        """Read the encoders. Joint position [rad], shape (12,)."""
        self._sample(
            position, self._counts_per_rad, self._keep, self._counts, self._before, self._position, self._velocity
        )

    @property
    def angle(self) -> Vector:
        """Joint position as counted, shape (12,) [rad]."""
        angle: Vector = self._counts / self._counts_per_rad
        return angle

    @property
    def speed(self) -> Vector:
        """Joint velocity, the bare difference of counts: for a loop inside the drive, which the filter would be too late for."""
        speed: Vector = (self._counts - self._before) / (self._counts_per_rad * PERIOD)
        return speed
