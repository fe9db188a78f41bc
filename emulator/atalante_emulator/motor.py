"""The twelve motors: wanted torque in, current loop, friction, brake and winding heat, torque on the joint out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, SIDES, Robot

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MotorParameters:
    """What the emulated motors are really like. Per leg joint where a tuple: FH, TH, SH, SK, SA, HA."""

    coulomb: tuple[float, ...] = (4.1, 3.1, 5.15, 4.9, 2.06, 0.97)  # Nm, dry friction at the joint
    viscous: tuple[float, ...] = (6.2, 3.9, 5.9, 4.1, 1.03, 0.49)  # Nm s/rad
    friction_speed: float = 0.05  # rad/s over which dry friction changes sign
    # A relay shorts the windings while the power stage is off: a joint without power sinks, slowly.
    brake: tuple[float, ...] = (150.0, 40.0, 125.0, 80.0, 20.0, 8.0)  # Nm s/rad
    current_loop: float = 0.5e-3  # s, time constant of the torque
    ambient: float = 25.0  # degC
    heating: float = 70.0  # K above ambient in the end at half the joint's torque limit
    thermal_time: float = 300.0  # s


#: Rows of the numbers of all motors; what is commanded, what they are like, and the torque on the joint.
_WANTED, _STRENGTH, _DRY, _DAMPING, _PUSH, _JOINT = range(6)


def _turn(velocity: Vector, motors: Vector, tracking: float, friction_speed: float, torque: Vector) -> None:
    """One `PERIOD` of all motors: `torque` follows what is wanted, the joint feels it less friction. Shapes (12,), (6, 12)."""
    for i in range(len(torque)):
        torque[i] += tracking * (motors[_WANTED, i] - torque[i])
        friction = motors[_DRY, i] * math.tanh(velocity[i] / friction_speed) + motors[_DAMPING, i] * velocity[i]
        motors[_JOINT, i] = motors[_STRENGTH, i] * torque[i] - friction + motors[_PUSH, i]


class Motors:
    """Motors of all joints: `torque` as measured [Nm at the joint] and `temperature` [degC], shape (12,), are rewritten here."""

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
        self.turn(np.zeros(len(JOINTS)))  # is compiled now, not in the first cycle

    def power(self, powered: npt.NDArray[np.bool_]) -> None:
        """Which power stages are on, shape (12,): the others brake."""
        self._motors[_DAMPING] = np.where(powered, self._viscous, self._braked)

    def weaken(self, motor: int, strength: float) -> None:
        """Let a motor make only this share of the torque it measures."""
        self._motors[_STRENGTH, motor] = strength

    def push(self, joint: int, torque: float) -> None:
        """Somebody pushes a joint from now on, on top of what the motor does [Nm]; 0: no longer."""
        self._motors[_PUSH, joint] = torque

    def turn(self, velocity: Vector) -> list[float]:
        """Joint torques for the next `PERIOD`: what the motors make of `wanted`, less friction and brake, and pushes.

        Args:
            velocity: true joint velocity [rad/s], shape (12,): what friction acts on.

        Returns:
            Shape (12,) [Nm].
        """
        self._turn(velocity, self._motors, self._tracking, self._parameters.friction_speed, self._torque)
        torque: list[float] = self._joint.tolist()
        return torque

    def warm(self, seconds: float) -> None:
        """First-order winding temperature, heated by torque squared, after some time at the torque of now."""
        final = self._parameters.ambient + self._heat * self._torque**2
        self.temperature += seconds / self._parameters.thermal_time * (final - self.temperature)
