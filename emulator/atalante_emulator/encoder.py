"""Twelve emulated motor encoders: compute counts, motor position and motor velocity from the joint positions."""

from __future__ import annotations

import math

import numpy as np

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import PERIOD, Vector

COUNTS = 131072  # encoder counts per motor turn, 17 bits
LSB = 2.0 * math.pi / COUNTS  # angle of the motor for one count [rad]


def _sample(
    joint: Vector,
    counts_per_rad: Vector,
    keep: float,
    counts: Vector,
    before: Vector,
    position: Vector,
    velocity: Vector,
) -> None:
    """Compute counts, motor position [rad] and motor velocity [rad/s] of all encoders.

    Args:
        joint: joint positions, shape (12,) [rad].
        counts_per_rad: encoder counts for each rad of the joint, with sign, shape (12,).
        keep: factor of the previous velocity in the low-pass, 0 to 1.
        counts: counts of the previous sample, shape (12,); NaN before the first sample. Updated here.
        before: output for the counts of the previous sample, shape (12,).
        position: output for the motor positions, shape (12,) [rad].
        velocity: motor velocities after the low-pass, shape (12,) [rad/s]. Updated here.
    """
    for i in range(len(joint)):
        count = np.rint(joint[i] * counts_per_rad[i])
        before[i] = count if math.isnan(counts[i]) else counts[i]
        counts[i] = count
        position[i] = count * LSB
        velocity[i] = keep * velocity[i] + (1.0 - keep) * ((count - before[i]) * LSB / PERIOD)


class Encoders:
    """Encoders of the twelve motors. `sample` writes motor positions and velocities to the arrays given to the constructor."""

    def __init__(self, robot: Robot, bandwidth: float, position: Vector, velocity: Vector) -> None:
        """Store the arrays to which `sample` writes.

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
        # Compile `_sample` now. A compilation in the first cycle would delay this cycle by more than 1 ms.
        self.sample(np.zeros(len(JOINTS)))
        self._counts.fill(math.nan)  # no sample yet

    def sample(self, position: Vector) -> None:
        """Sample all encoders. The caller must call this method once in each cycle of 1 ms (`PERIOD`).

        Args:
            position: joint positions, shape (12,) [rad]. An injected encoder fault is already included.
        """
        self._sample(
            position, self._counts_per_rad, self._keep, self._counts, self._before, self._position, self._velocity
        )

    @property
    def angle(self) -> Vector:
        """Joint positions computed from the last counts, shape (12,) [rad]."""
        angle: Vector = self._counts / self._counts_per_rad
        return angle

    @property
    def speed(self) -> Vector:
        """Joint velocities computed from the last two samples, without a low-pass, shape (12,) [rad/s]."""
        speed: Vector = (self._counts - self._before) / (self._counts_per_rad * PERIOD)
        return speed
