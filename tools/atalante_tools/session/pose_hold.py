"""Controller of `atalante jog` and `atalante vibrate`: holds the initial pose, and moves one joint to a target angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import IMUS, JOINTS, MOTORS, Robot
from atalante_hal.safety.direction import pose_gains
from atalante_hal.types import PERIOD, Command, State, Vector

_PELVIS: Final = IMUS.index("pelvis")
#: Ratio of peak speed to mean speed of the minimum-jerk profile: ds/dx at x = 1/2.
PEAK: Final = 15.0 / 8.0


@dataclass(frozen=True)
class Move:
    """Motion of one joint to a target angle, along the minimum-jerk profile."""

    joint: int  # index in JOINTS
    target: float  # target angle [rad]
    speed: float  # peak speed [rad/s]


def minimum_jerk(phase: float) -> tuple[float, float]:
    """Return the minimum-jerk profile s = 10 x^3 - 15 x^4 + 6 x^5 and its derivative (Flash and Hogan, 1985).

    Args:
        phase: Time divided by the duration of the move, x; clipped to the range from 0 to 1.

    Returns:
        Ratio s of covered distance to whole distance, 0 to 1, and its derivative ds/dx.
    """
    x = min(max(phase, 0.0), 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * (x * (1.0 - x)) ** 2


class PoseHold:
    """PD controller with gravity compensation. It holds a pose with the stiffness that the drives have in HOLD.

    The damping gains are the gains of `pose_gains`. With the damping gains of the drives, the delay of the HAL would make light
    joints unstable.

    Attributes:
        telemetry: Reference angles, shape (12,) [rad].
        duration: Duration of the move [s].
        elapsed: Time since the move started [s].
    """

    telemetry_fields: Sequence[tuple[str, int]] = (("reference", len(JOINTS)),)

    def __init__(self, robot: Robot, *, move: Move | None = None, vibration: Vector | None = None) -> None:
        """Load the dynamics model and set the motion.

        Args:
            robot: Hold gains and joint limits of the robot.
            move: Motion of one joint. If None, all joints are held.
            vibration: Level of each vibration motor, shape (8,), 0 to 1. If None, all motors are off.
        """
        self._stiffness, self._damping = robot.hold_kp, pose_gains(robot)[1]
        self._move = move
        self._gravity = Gravity(pinocchio_model(urdf(ExoskeletonParameters(), robot)))
        self._speed = np.zeros_like(robot.hold_kp)
        self._command = Command(np.zeros_like(robot.hold_kp), np.zeros(len(MOTORS)) if vibration is None else vibration)
        self._from = 0.0
        self.duration = 0.0
        self.elapsed = 0.0
        self.telemetry = np.zeros_like(robot.hold_kp)

    def reset(self, state: State) -> None:
        """Set the reference to the measured pose, and start the motion from this pose.

        Args:
            state: Measured state of the robot.
        """
        self.telemetry[:] = state.position
        self.elapsed = 0.0
        if self._move is not None:
            self._from = float(state.position[self._move.joint])
            self.duration = PEAK * abs(self._move.target - self._from) / self._move.speed

    def update(self, state: State) -> Command:
        """Compute the torque and vibration command of one cycle.

        Args:
            state: Measured state of the robot.
        """
        self.elapsed += PERIOD
        if self._move is not None and self.duration:
            share, rate = minimum_jerk(self.elapsed / self.duration)
            distance = self._move.target - self._from
            self.telemetry[self._move.joint] = self._from + distance * share
            self._speed[self._move.joint] = distance * rate / self.duration
        w, x, y, z = state.imu_quaternion[_PELVIS].tolist()
        torque = self._command.torque
        torque[:] = self._gravity.torque(state.position, (w, x, y, z))
        torque += self._stiffness * (self.telemetry - state.position)
        torque += self._damping * (self._speed - state.velocity)
        return self._command
