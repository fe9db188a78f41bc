"""What is left in the DC link when the battery is gone: capacitors that feed the drives until they are empty."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.robot import Robot

Vector = npt.NDArray[np.float64]

IDLE = 40.0  # W, electronics of twelve drives
#: Copper loss of a motor at its torque limit [W].
COPPER = 250.0


class HoldUp:
    """Energy of the DC link without a battery: E = C V^2 / 2, less what the drives take."""

    def __init__(self, robot: Robot, capacity: float, voltage: float) -> None:
        """A link of some capacity [F], charged to a voltage [V]."""
        self._per_torque_squared = COPPER / robot.torque_max**2
        self._capacity = capacity
        self._energy = 0.5 * capacity * voltage**2

    def draw(self, torque: Vector, speed: Vector) -> float:
        """Voltage [V] after one `PERIOD`; what a motor gives back while it brakes is not used.

        Args:
            torque: of the motors, shape (12,) [Nm at the joint].
            speed: of the joints, shape (12,) [rad/s].
        """
        work = float(np.maximum(torque * speed, 0.0).sum())
        heat = float(self._per_torque_squared @ torque**2)
        self._energy = max(0.0, self._energy - (IDLE + work + heat) * PERIOD)
        return math.sqrt(2.0 * self._energy / self._capacity)
