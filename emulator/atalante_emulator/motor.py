"""Twelve emulated motors with current loop, friction, brake and winding temperature: compute the torques on the joints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, SIDES, Robot
from atalante_hal.types import PERIOD, Vector


@dataclass(frozen=True)
class MotorParameters:
    """True parameters of the emulated motors. A tuple has one value per leg joint: FH, TH, SH, SK, SA, HA."""

    coulomb: tuple[float, ...] = (4.1, 3.1, 5.15, 4.9, 2.06, 0.97)  # dry friction at the joint [Nm]
    viscous: tuple[float, ...] = (6.2, 3.9, 5.9, 4.1, 1.03, 0.49)  # viscous friction at the joint [Nm s/rad]
    friction_speed: float = 0.05  # joint speed at which dry friction reaches 76 % of its full value [rad/s]
    # While the power stage is off, a relay shorts the windings, and the motor brakes the joint.
    brake: tuple[float, ...] = (150.0, 40.0, 125.0, 80.0, 20.0, 8.0)  # damping of the brake [Nm s/rad]
    current_loop: float = 0.5e-3  # time constant of the torque [s]
    ambient: float = 25.0  # ambient temperature [degC]
    heating: float = 70.0  # final temperature rise at half the torque limit [K]
    thermal_time: float = 300.0  # time constant of the winding temperature [s]


#: Rows of the motor array: torque setpoint, torque ratio, dry friction, damping, external torque, joint torque.
_WANTED, _STRENGTH, _DRY, _DAMPING, _PUSH, _JOINT = range(6)


def _advance(velocity: Vector, motors: Vector, tracking: float, friction_speed: float, torque: Vector) -> None:
    """Advance all motors by one `PERIOD`.

    Args:
        velocity: true joint velocities, shape (12,) [rad/s].
        motors: motor array, shape (6, 12). Its joint torques are updated.
        tracking: share of the torque deviation that the current loop removes per `PERIOD`.
        friction_speed: joint speed at which dry friction reaches 76 % of its full value [rad/s].
        torque: motor torques, shape (12,) [Nm]. Updated here.
    """
    for i in range(len(torque)):
        torque[i] += tracking * (motors[_WANTED, i] - torque[i])
        friction = motors[_DRY, i] * math.tanh(velocity[i] / friction_speed) + motors[_DAMPING, i] * velocity[i]
        motors[_JOINT, i] = motors[_STRENGTH, i] * torque[i] - friction + motors[_PUSH, i]


class Motors:
    """Motors of all joints. They update the arrays of measured torque [Nm at the joint] and winding temperature [degC]."""

    def __init__(self, robot: Robot, parameters: MotorParameters, torque: Vector, temperature: Vector) -> None:
        both = len(SIDES)
        self._parameters, self._torque, self.temperature = parameters, torque, temperature
        self._tracking = 1.0 - math.exp(-PERIOD / parameters.current_loop)
        self._motors = np.zeros((6, len(JOINTS)))
        self.wanted, self._joint = self._motors[_WANTED], self._motors[_JOINT]
        self._viscous = np.array(parameters.viscous * both)
        self._braked = self._viscous + parameters.brake * both
        self._motors[_STRENGTH] = 1.0
        self._motors[_DRY] = parameters.coulomb * both
        self._motors[_DAMPING] = self._braked
        self._heat = parameters.heating / (0.5 * robot.torque_max) ** 2
        temperature.fill(parameters.ambient)
        self._advance = compiled(_advance)
        self.advance(np.zeros(len(JOINTS)))  # compiles the kernel now, because compilation takes longer than a cycle

    def power(self, powered: npt.NDArray[np.bool_]) -> None:
        """Switch the power stage of each motor on or off. A motor without power brakes its joint.

        Args:
            powered: whether each power stage is on, shape (12,).
        """
        self._motors[_DAMPING] = np.where(powered, self._viscous, self._braked)

    def weaken(self, motor: int, strength: float) -> None:
        """Set the ratio of true torque to measured torque of a motor.

        Args:
            motor: index of the motor.
            strength: ratio, 0 to 1. A motor without fault has 1.
        """
        self._motors[_STRENGTH, motor] = strength

    def push(self, joint: int, torque: float) -> None:
        """Set an external torque on a joint. It is added to the motor torque.

        Args:
            joint: index of the joint.
            torque: external torque [Nm], 0 for none.
        """
        self._motors[_PUSH, joint] = torque

    def advance(self, velocity: Vector) -> list[float]:
        """Advance the motors by one `PERIOD` and return the torques on the joints.

        The motor torque follows the setpoint `wanted`. The joint torque is the motor torque minus friction and brake torque,
        plus the external torque.

        Args:
            velocity: true joint velocities, shape (12,) [rad/s]. The friction depends on them.

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        self._advance(velocity, self._motors, self._tracking, self._parameters.friction_speed, self._torque)
        torque: list[float] = self._joint.tolist()
        return torque

    def warm(self, seconds: float) -> None:
        """Advance the winding temperatures. The heat is proportional to the squared torque, with a first-order lag.

        Args:
            seconds: time to advance at the present torque [s].
        """
        final = self._parameters.ambient + self._heat * self._torque**2
        self.temperature += seconds / self._parameters.thermal_time * (final - self.temperature)
