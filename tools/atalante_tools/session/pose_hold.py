"""The controller of `jog` and `vibrate`: hold the pose that was measured at the start, and lead one joint elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.hal import PERIOD
from atalante_hal.robot import IMUS, JOINTS, MOTORS, Robot, Vector
from atalante_hal.types import Command, State

_PELVIS: Final = IMUS.index("pelvis")
#: Peak over mean speed of the minimum-jerk profile: s'(1/2).
PEAK: Final = 15.0 / 8.0


@dataclass(frozen=True)
class Move:
    """One joint to an angle, along the minimum-jerk profile."""

    joint: int  # of JOINTS
    target: float  # rad
    speed: float  # rad/s, the fastest on the way


def minimum_jerk(phase: float) -> tuple[float, float]:
    """Share of the way and its derivative at a phase, 0 to 1: s = 10 x^3 - 15 x^4 + 6 x^5 (Flash and Hogan, 1985)."""
    x = min(max(phase, 0.0), 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * (x * (1.0 - x)) ** 2


class PoseHold:
    """PD with the robot's own hold gains around a reference, plus the gravity of the hanging empty exoskeleton.

    `telemetry` is the reference, shape (12,) [rad].
    """

    telemetry_fields: Sequence[tuple[str, int]] = (("reference", len(JOINTS)),)

    def __init__(self, robot: Robot, *, move: Move | None = None, vibration: Vector | None = None) -> None:
        """Prepare; `vibration` is the level of each of MOTORS, 0 to 1."""
        self._robot, self._move = robot, move
        self._gravity = Gravity(pinocchio_model(urdf(ExoskeletonParameters(), robot)))
        self._speed = np.zeros_like(robot.hold_kp)
        self._command = Command(np.zeros_like(robot.hold_kp), np.zeros(len(MOTORS)) if vibration is None else vibration)
        self._from = 0.0
        self.duration = 0.0  # s, of the move
        self.elapsed = 0.0  # s, since it began
        self.telemetry = np.zeros_like(robot.hold_kp)

    def reset(self, state: State) -> None:
        """Hold here."""
        self.telemetry[:] = state.position
        self.elapsed = 0.0
        if self._move is not None:
            self._from = float(state.position[self._move.joint])
            self.duration = PEAK * abs(self._move.target - self._from) / self._move.speed

    def update(self, state: State) -> Command:
        """One cycle."""
        self.elapsed += PERIOD
        if self._move is not None and self.duration:
            share, rate = minimum_jerk(self.elapsed / self.duration)
            way = self._move.target - self._from
            self.telemetry[self._move.joint] = self._from + way * share
            self._speed[self._move.joint] = way * rate / self.duration
        w, x, y, z = state.imu_quaternion[_PELVIS].tolist()
        torque = self._command.torque
        torque[:] = self._gravity.torque(state.position, (w, x, y, z))
        torque += self._robot.hold_kp * (self.telemetry - state.position)
        torque += self._robot.hold_kd * (self._speed - state.velocity)
        return self._command
