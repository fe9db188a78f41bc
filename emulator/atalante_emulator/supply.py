"""Drive supply after a loss of the battery: the capacitors of the DC link discharge into the drives."""

from __future__ import annotations

import math

import numpy as np

from atalante_hal.robot import Robot
from atalante_hal.types import PERIOD, Vector

#: Power of the electronics of all twelve drives [W].
IDLE = 40.0
#: Copper loss of one motor at its torque limit [W].
COPPER = 250.0


class HoldUp:
    """DC link without a battery. Its energy E = C V^2 / 2 decreases by the energy that the drives draw."""

    def __init__(self, robot: Robot, capacity: float, voltage: float) -> None:
        """Charge the DC link to a voltage.

        Args:
            robot: torque limits of the joints, at which the copper loss of a motor is `COPPER`.
            capacity: capacitance of the DC link [F].
            voltage: voltage at the start [V].
        """
        self._per_torque_squared = COPPER / robot.torque_max**2
        self._capacity = capacity
        self._energy = 0.5 * capacity * voltage**2

    def draw(self, torque: Vector, speed: Vector) -> float:
        """Take the energy of one control cycle (`PERIOD`, 1 ms) out of the DC link, and return the voltage of the DC link [V].

        Braking motors return no energy.

        Args:
            torque: motor torques, shape (12,) [Nm at the joint].
            speed: joint velocities, shape (12,) [rad/s].
        """
        work = float(np.maximum(torque * speed, 0.0).sum())
        heat = float(self._per_torque_squared @ torque**2)
        self._energy = max(0.0, self._energy - (IDLE + work + heat) * PERIOD)
        return math.sqrt(2.0 * self._energy / self._capacity)
