"""The twelve motors: wanted torque in, current loop, friction, brake and winding heat, torque on the joint out.

What is linear (current loop, friction on top of the motor) is one matrix-vector product: one call.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.robot import JOINTS, SIDES, Robot

Vector = npt.NDArray[np.float64]

_COUNT = len(JOINTS)


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


class Motors:
    """Motors of all joints: `torque` as measured [Nm at the joint] and `temperature` [degC], shape (12,), are rewritten here."""

    def __init__(self, robot: Robot, parameters: MotorParameters, torque: Vector, temperature: Vector) -> None:
        self._parameters, self._torque_signal, self.temperature = parameters, torque, temperature
        # Motor torque now, wanted torque, direction of dry friction, velocity -> motor torque next, joint torque.
        self._inputs = np.zeros(4 * _COUNT)
        self._torque, self.wanted, self._direction, self._velocity = self._inputs.reshape(4, -1)
        self._outputs = np.zeros(2 * _COUNT)
        self._next_torque, self._joint_torque = self._outputs.reshape(2, -1)
        self._per_friction_speed = np.full(_COUNT, 1.0 / parameters.friction_speed)
        self._powered: npt.NDArray[np.bool_] = np.zeros(_COUNT, np.bool_)
        self._strength = np.ones(_COUNT)
        self._external: Vector | None = None
        self._build()
        self._heat = parameters.heating / (0.5 * robot.torque_max) ** 2
        temperature.fill(parameters.ambient)

    def _build(self) -> None:
        parameters, both = self._parameters, len(SIDES)
        tracking = 1.0 - math.exp(-PERIOD / parameters.current_loop)
        one, none = np.eye(_COUNT), np.zeros((_COUNT, _COUNT))
        motor = [one * (1.0 - tracking), one * tracking]
        brake = np.where(self._powered, 0.0, parameters.brake * both)
        dry, viscous = np.diag(parameters.coulomb * both), np.diag(np.array(parameters.viscous * both) + brake)
        self._matrix = np.block([[*motor, none, none], [*(self._strength * m for m in motor), -dry, -viscous]])

    def power(self, powered: npt.NDArray[np.bool_]) -> None:
        """Which power stages are on, shape (12,): the others brake."""
        if powered.tobytes() != self._powered.tobytes():
            self._powered = powered.copy()
            self._build()

    def weaken(self, motor: int, strength: float) -> None:
        """Let a motor make only this share of the torque it measures."""
        self._strength[motor] = strength
        self._build()

    def push(self, joint: int, torque: float) -> None:
        """Somebody pushes a joint from now on, on top of what the motor does [Nm]; 0: no longer."""
        external = np.zeros(_COUNT) if self._external is None else self._external
        external[joint] = torque
        self._external = external if external.any() else None

    def turn(self, velocity: Vector) -> list[float]:
        """Joint torques for the next `PERIOD`: what the motors make of `wanted`, less friction and brake, and pushes.

        Args:
            velocity: true joint velocity [rad/s], shape (12,): what friction acts on.

        Returns:
            Shape (12,) [Nm].
        """
        direction = self._direction
        np.multiply(velocity, self._per_friction_speed, direction)
        np.tanh(direction, direction)
        self._velocity[:] = velocity
        self._matrix.dot(self._inputs, self._outputs)
        if self._external is not None:
            self._joint_torque += self._external
        self._torque[:] = self._next_torque
        self._torque_signal[:] = self._next_torque
        torque: list[float] = self._joint_torque.tolist()
        return torque

    def warm(self, seconds: float) -> None:
        """First-order winding temperature, heated by torque squared, after some time at the torque of now."""
        final = self._parameters.ambient + self._heat * self._torque**2
        self.temperature += seconds / self._parameters.thermal_time * (final - self.temperature)
