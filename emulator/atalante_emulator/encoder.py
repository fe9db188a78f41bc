"""Twelve emulated motor encoders: joint positions in, counts and the position and velocity of the state frames out."""

from __future__ import annotations

import math

import numpy as np

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import PERIOD, Vector

COUNTS = 131072  # encoder counts per motor turn, 17 bits
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
    """Compute the counts of all encoders and the position and velocity of the state frames. Shape (12,) each."""
    for i in range(len(joint)):
        count = np.rint(joint[i] * counts_per_rad[i])
        before[i] = count if math.isnan(counts[i]) else counts[i]
        counts[i] = count
        position[i] = count * LSB
        velocity[i] = keep * velocity[i] + (1.0 - keep) * ((count - before[i]) * LSB / PERIOD)


class Encoders:
    """Encoders of all joints; `sample` rewrites the given arrays of position and velocity."""

    def __init__(self, robot: Robot, bandwidth: float, position: Vector, velocity: Vector) -> None:
        """Connect the encoders to the signals of the state frames.

        Args:
            robot: gear ratio and polarity of each joint.
            bandwidth: cut-off frequency of the velocity low-pass [Hz].
            position: array that receives the motor positions, shape (12,) [rad].
            velocity: array that receives the motor velocities, shape (12,) [rad/s].
        """
        self._counts_per_rad = robot.gear * robot.polarity * (COUNTS / (2.0 * math.pi))
        self._keep = math.exp(-2.0 * math.pi * bandwidth * PERIOD)
        self._counts, self._before = np.zeros((2, len(JOINTS)))
        self._position, self._velocity = position, velocity
        self._sample = compiled(_sample)
        self.sample(np.zeros(len(JOINTS)))  # the first call compiles the kernel, which would be too slow within a cycle
        self._counts.fill(math.nan)  # no sample yet

    def sample(self, position: Vector) -> None:
        """Read the encoders; call once per `PERIOD`.

        Args:
            position: true joint positions, shape (12,) [rad].
        """
        self._sample(
            position, self._counts_per_rad, self._keep, self._counts, self._before, self._position, self._velocity
        )

    @property
    def angle(self) -> Vector:
        """Joint position with the resolution of the counts, shape (12,) [rad]."""
        angle: Vector = self._counts / self._counts_per_rad
        return angle

    @property
    def speed(self) -> Vector:
        """Joint velocity as unfiltered difference of counts, shape (12,) [rad/s]; for the control loop inside the drive."""
        speed: Vector = (self._counts - self._before) / (self._counts_per_rad * PERIOD)
        return speed
