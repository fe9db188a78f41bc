"""The twelve motor encoders: joint positions in, counts, and what the state frames say of position and velocity."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.robot import JOINTS, Robot

Vector = npt.NDArray[np.float64]

COUNTS = 131072  # encoder counts a motor turn, 17 bits


class Encoders:
    """Encoders of all joints; `position` [rad] and `velocity` [rad/s] at the motor, shape (12,), rewritten by `sample`."""

    def __init__(self, robot: Robot, bandwidth: float, position: Vector, velocity: Vector) -> None:
        """`bandwidth` of the velocity estimate [Hz]."""
        counts = COUNTS / (2.0 * math.pi)
        self._counts_per_rad = robot.gear * robot.polarity * counts
        self._lsb = np.full(len(JOINTS), 1.0 / counts)
        # Velocity estimate v' = keep v + gain (counts - counts before). The two rows of counts take turns.
        keep = math.exp(-2.0 * math.pi * bandwidth * PERIOD)
        gain = (1.0 - keep) / (counts * PERIOD)
        self._encoder = np.zeros((3, len(JOINTS)))
        self._estimate, self._counts, self._counts_before = self._encoder
        self._filter, self._filter_next = np.array([keep, gain, -gain]), np.array([keep, -gain, gain])
        self._first_sample = True
        self._position, self._velocity = position, velocity

    def sample(self, position: Vector) -> None:
        """Read the encoders. Joint position [rad], shape (12,)."""
        counts = self._counts_before
        # Results as positional arguments: a fifth faster than `out=`.
        np.multiply(position, self._counts_per_rad, counts)
        np.rint(counts, counts)
        if self._first_sample:
            self._counts[:] = counts
            self._first_sample = False
        self._counts_before, self._counts = self._counts, counts
        self._filter, self._filter_next = self._filter_next, self._filter
        np.multiply(counts, self._lsb, self._position)
        self._filter.dot(self._encoder, self._velocity)
        self._estimate[:] = self._velocity

    @property
    def angle(self) -> Vector:
        """Joint position as counted, shape (12,) [rad]."""
        angle: Vector = self._counts / self._counts_per_rad
        return angle

    @property
    def speed(self) -> Vector:
        """Joint velocity, the bare difference of counts: for a loop inside the drive, which the filter would be too late for."""
        speed: Vector = (self._counts - self._counts_before) / (self._counts_per_rad * PERIOD)
        return speed
