"""Twelve emulated motors with current loop, friction, brake and winding temperature. They compute the joint torques."""

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
    """True parameters of the emulated motors. A tuple has one value per joint of a leg, in the order of `LEG_JOINTS`."""

    coulomb: tuple[float, ...] = (4.1, 3.1, 5.15, 4.9, 2.06, 0.97)  # dry friction at the joint [Nm]
    viscous: tuple[float, ...] = (6.2, 3.9, 5.9, 4.1, 1.03, 0.49)  # viscous friction at the joint [Nm s/rad]
    friction_speed: float = 0.05  # joint speed at which dry friction reaches 76 % of its full value [rad/s]
    # While the power stage is off, a relay shorts the windings. The motor then brakes the joint with this additional damping.
    brake: tuple[float, ...] = (150.0, 40.0, 125.0, 80.0, 20.0, 8.0)  # Nm s/rad
    current_loop: float = 0.5e-3  # time constant with which the motor torque follows the torque setpoint [s]
    dead_time: int = 0  # number of cycles until a new torque setpoint reaches the current loop
    ambient: float = 25.0  # ambient temperature [degC]
    heating: float = 70.0  # winding temperature minus `ambient` after a long time at half the torque limit [K]
    thermal_time: float = 300.0  # time constant of the winding temperature [s]


_MOTORS = np.arange(len(JOINTS))
#: Largest delay that a fault can add to the torque setpoint of a motor [cycles], see `Motors.delay`.
MOST_LATE = 20

# Rows 0 to 3 of the motor array: torque setpoint, ratio of true torque to measured torque, dry friction, damping.
# Rows 4 to 6 of the motor array: external torque, resulting joint torque, torque of the wearer's limb.
# Row 7 of the motor array: factor on the torque setpoint, see `set_gain`.
_WANTED, _STRENGTH, _DRY, _DAMPING, _PUSH, _JOINT, _LIMB, _GAIN = range(8)


def _advance(
    velocity: Vector, setpoint: Vector, motors: Vector, tracking: float, friction_speed: float, torque: Vector
) -> None:
    """Advance all motors by one control cycle (`PERIOD`, 1 ms).

    Args:
        velocity: true joint velocities, shape (12,) [rad/s].
        setpoint: motor torque setpoints that now reach the current loops, shape (12,) [Nm].
        motors: motor array, shape (8, 12). Its joint torques are updated.
        tracking: share of the torque deviation that the current loop removes in one cycle.
        friction_speed: joint speed at which dry friction reaches 76 % of its full value [rad/s].
        torque: measured motor torques, shape (12,) [Nm]. Updated here.
    """
    for i in range(len(torque)):
        torque[i] += tracking * (motors[_GAIN, i] * setpoint[i] - torque[i])
        friction = motors[_DRY, i] * math.tanh(velocity[i] / friction_speed) + motors[_DAMPING, i] * velocity[i]
        motors[_JOINT, i] = motors[_STRENGTH, i] * torque[i] - friction + motors[_PUSH, i] + motors[_LIMB, i]


class Motors:
    """Motors of all joints. They update two arrays: measured torque [Nm at the joint] and winding temperature [degC]."""

    def __init__(self, robot: Robot, parameters: MotorParameters, torque: Vector, temperature: Vector) -> None:
        both = len(SIDES)
        self._parameters, self._torque, self.temperature = parameters, torque, temperature
        self._tracking = 1.0 - math.exp(-PERIOD / parameters.current_loop)
        self._motors = np.zeros((8, len(JOINTS)))
        self.wanted, self._joint = self._motors[_WANTED], self._motors[_JOINT]
        #: Time until a new setpoint reaches the current loop of each motor [cycles].
        self._dead_time = np.full(len(JOINTS), parameters.dead_time)
        #: Past torque setpoints. Row `_cycle % len(_setpoints)` is the newest. Recorded only if a motor has or had a delay.
        self._setpoints = np.zeros((parameters.dead_time + MOST_LATE + 1, len(JOINTS)))
        self._records = parameters.dead_time > 0
        self._cycle = 0
        #: Torques of the wearer's limbs on the joints, shape (12,) [Nm]. The emulator writes into this array.
        self.limb = self._motors[_LIMB]
        self._viscous = np.array(parameters.viscous * both)
        self._braked = self._viscous + parameters.brake * both
        self._motors[_STRENGTH] = self._motors[_GAIN] = 1.0
        self._motors[_DRY] = parameters.coulomb * both
        self._motors[_DAMPING] = self._braked
        self._heat = parameters.heating / (0.5 * robot.torque_max) ** 2
        temperature.fill(parameters.ambient)
        self._advance = compiled(_advance)
        # Compile `_advance` now. In the first control cycle, the compilation would take too long.
        self.advance(np.zeros(len(JOINTS)))

    def power(self, powered: npt.NDArray[np.bool_]) -> None:
        """Switch the power stage of each motor on or off. A motor whose power stage is off brakes its joint.

        Args:
            powered: whether each power stage is on, shape (12,).
        """
        self._motors[_DAMPING] = np.where(powered, self._viscous, self._braked)

    def set_strength(self, motor: int, strength: float) -> None:
        """Set the ratio of true torque to measured torque of a motor.

        Args:
            motor: index of the motor.
            strength: ratio; 1 for a motor without fault, -1 for a reversed motor.
        """
        self._motors[_STRENGTH, motor] = strength

    def set_gain(self, motor: int, gain: float) -> None:
        """Scale the torque setpoint of a motor. The current loop follows the scaled setpoint.

        The gain therefore changes the true torque and the measured torque alike.

        Args:
            motor: index of the motor.
            gain: factor on the setpoint; 1 for a motor without fault, 0 for a motor whose power stage is off.
        """
        self._motors[_GAIN, motor] = gain

    def delay(self, motor: int, cycles: int) -> None:
        """Set the additional time until a setpoint reaches the current loop of a motor.

        If no past setpoints are recorded at the first call, the current setpoint is used as past setpoint.

        Args:
            motor: index of the motor.
            cycles: additional time [cycles], from 0 to `MOST_LATE`.
        """
        if not self._records:
            self._setpoints[:] = self.wanted
            self._records = True
        self._dead_time[motor] = self._parameters.dead_time + cycles

    def push(self, joint: int, torque: float) -> None:
        """Set an external torque on a joint. The external torque is added to the motor torque.

        Args:
            joint: index of the joint.
            torque: external torque [Nm].
        """
        self._motors[_PUSH, joint] = torque

    def advance(self, velocity: Vector) -> list[float]:
        """Advance the motors by one control cycle (`PERIOD`, 1 ms) and return the torques on the joints.

        The measured motor torque follows the setpoint `wanted`. The joint torque is the true motor torque (see `set_strength`)
        minus friction and brake torque, plus the external torque and the torque of the wearer's limb.

        Args:
            velocity: true joint velocities, shape (12,) [rad/s]. The friction depends on them.

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        setpoint = self.wanted
        if self._records:
            self._cycle += 1
            self._setpoints[self._cycle % len(self._setpoints)] = setpoint
            setpoint = self._setpoints[(self._cycle - self._dead_time) % len(self._setpoints), _MOTORS]
        self._advance(velocity, setpoint, self._motors, self._tracking, self._parameters.friction_speed, self._torque)
        torque: list[float] = self._joint.tolist()
        return torque

    def warm(self, seconds: float) -> None:
        """Advance the winding temperatures. The temperature rise follows the squared torque with a first-order lag.

        Args:
            seconds: time to advance, during which the torque is constant [s].
        """
        final = self._parameters.ambient + self._heat * self._torque**2
        self.temperature += seconds / self._parameters.thermal_time * (final - self.temperature)
