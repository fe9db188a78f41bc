"""Twelve emulated motors with current loop, friction, brake and winding heat: wanted torque in, joint torque out."""

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
    """True parameters of the emulated motors; a tuple has one value per leg joint: FH, TH, SH, SK, SA, HA."""

    coulomb: tuple[float, ...] = (4.1, 3.1, 5.15, 4.9, 2.06, 0.97)  # Nm, dry friction at the joint
    viscous: tuple[float, ...] = (6.2, 3.9, 5.9, 4.1, 1.03, 0.49)  # Nm s/rad
    friction_speed: float = 0.05  # rad/s over which dry friction changes sign
    # A relay shorts the windings while the power stage is off, so that a joint without power sinks slowly.
    brake: tuple[float, ...] = (150.0, 40.0, 125.0, 80.0, 20.0, 8.0)  # Nm s/rad
    current_loop: float = 0.5e-3  # s, time constant of the torque
    ambient: float = 25.0  # degC
    heating: float = 70.0  # K, final temperature rise at half the joint's torque limit
    thermal_time: float = 300.0  # s


#: Rows of the motor array: wanted torque, strength, dry friction, damping, external torque, resulting joint torque.
_WANTED, _STRENGTH, _DRY, _DAMPING, _PUSH, _JOINT = range(6)


def _turn(velocity: Vector, motors: Vector, tracking: float, friction_speed: float, torque: Vector) -> None:
    """Advance all motors by one `PERIOD`.

    Args:
        velocity: true joint velocities, shape (12,) [rad/s].
        motors: motor array, shape (6, 12); its joint torques are updated.
        tracking: share of the torque error that the current loop removes per `PERIOD`.
        friction_speed: speed over which dry friction changes sign [rad/s].
        torque: motor torques, shape (12,) [Nm]; updated.
    """
    for i in range(len(torque)):
        torque[i] += tracking * (motors[_WANTED, i] - torque[i])
        friction = motors[_DRY, i] * math.tanh(velocity[i] / friction_speed) + motors[_DAMPING, i] * velocity[i]
        motors[_JOINT, i] = motors[_STRENGTH, i] * torque[i] - friction + motors[_PUSH, i]


class Motors:
    """Motors of all joints; they rewrite the given arrays of measured torque [Nm at the joint] and temperature [degC]."""

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
        self._turn = compiled(_turn)
        self.turn(np.zeros(len(JOINTS)))  # the first call compiles the kernel, which would be too slow within a cycle

    def power(self, powered: npt.NDArray[np.bool_]) -> None:
        """Set the power stages; motors without power brake.

        Args:
            powered: whether each power stage is on, shape (12,).
        """
        self._motors[_DAMPING] = np.where(powered, self._viscous, self._braked)

    def weaken(self, motor: int, strength: float) -> None:
        """Reduce the true torque of a motor to a share of the torque it measures.

        Args:
            motor: index of the motor.
            strength: share of the torque, 1 is a motor without fault.
        """
        self._motors[_STRENGTH, motor] = strength

    def push(self, joint: int, torque: float) -> None:
        """Set the external torque on a joint, which adds to the motor torque.

        Args:
            joint: index of the joint.
            torque: external torque [Nm], 0 for none.
        """
        self._motors[_PUSH, joint] = torque

    def turn(self, velocity: Vector) -> list[float]:
        """Advance the motors by one `PERIOD` and return the torques on the joints.

        A joint torque is the motor torque, which follows `wanted`, minus friction and brake, plus the external torque.

        Args:
            velocity: true joint velocities, which friction depends on, shape (12,) [rad/s].

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        self._turn(velocity, self._motors, self._tracking, self._parameters.friction_speed, self._torque)
        torque: list[float] = self._joint.tolist()
        return torque

    def warm(self, seconds: float) -> None:
        """Advance the winding temperatures, a first-order lag heated by the squared torque.

        Args:
            seconds: time to advance at the present torque [s].
        """
        final = self._parameters.ambient + self._heat * self._torque**2
        self.temperature += seconds / self._parameters.thermal_time * (final - self.temperature)
