"""Crane of an emulated robot: suspends the robot above the floor, and lowers it onto its feet after the time `DELAY` in ACTIVE.

The sling is a spring between the hook and the pelvis. The sling pulls upwards only. While the sling is under tension, the crane
also keeps the pelvis upright and holds its horizontal position and heading constant. These forces and moments grow in
proportion to the tension, until the tension equals the weight of the robot. A slack sling exerts no force.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from atalante_emulator.bodies import GRAVITY, PELVIS, Body, Motion
from atalante_hal.types import PERIOD, SupervisorState, Vector

#: Speed of the hook [m/s].
SPEED: Final = 0.1
#: Time in ACTIVE or FULL_ASSIST after which the crane lowers the robot [s]. In this time, the walking controller moves the legs
#: to the standing pose. If the feet stood on the floor during this motion, friction would keep the wrong distance between the
#: feet.
DELAY: Final = 2.0
#: Stiffness and damping of the sling, both per kg of the robot. The weight of the robot stretches the sling by 25 mm.
STIFFNESS: Final = 400.0  # N/m per kg
DAMPING: Final = 28.0  # N s/m per kg
#: The sling turns the pelvis upright with this rotational stiffness and damping, both per kg of the robot.
#: Both values apply while the sling carries the full weight.
RIGHTING: Final = 100.0  # Nm/rad per kg
ATTITUDE_DAMPING: Final = 1.5  # Nm s/rad per kg
#: Slack of the sling at which lowering ends [m]. After that, the sling exerts no force until a call of `lift`.
#: The slack exceeds the vertical motion of the pelvis of a walking robot.
SLACK: Final = 0.15
_ACTIVE: Final = (SupervisorState.ACTIVE, SupervisorState.FULL_ASSIST)


class Crane:
    """Crane of a robot with a free pelvis. Each call advances the crane by one `PERIOD` and returns the wrench on the pelvis.

    Attributes:
        lowered: Whether the sling is slack and the robot stands alone.
    """

    def __init__(self, body: Body, *, automatic: bool = True) -> None:
        """Suspend the robot at its current position. The crane turns the pelvis upright.

        Args:
            body: robot with a free pelvis.
            automatic: whether the crane lowers the robot without a call of `lower`, after a total time of `DELAY` in ACTIVE or
                FULL_ASSIST.
        """
        self._body, self._mass, self._automatic = body, body.mass, automatic
        self._wrench = np.zeros(6)
        motion = body.motion(PELVIS)
        self._hold(motion)
        self._hook = self._top = self._goal = float(motion.position[2]) + GRAVITY / STIFFNESS
        self._waited = 0
        self.lowered = False

    def lower(self) -> None:
        """Lower the hook until the sling is slack."""
        self._automatic = False
        self._goal = -np.inf

    def lift(self) -> None:
        """Lift the robot straight up from its current position, until the hook is at its initial height."""
        self._automatic = False
        motion = self._body.motion(PELVIS)
        self._hold(motion)
        self._hook = max(self._hook, float(motion.position[2]))
        self._goal, self.lowered = self._top, False

    def __call__(self, hal_state: int) -> Vector:
        """Advance the crane by one `PERIOD` and return force [N] and moment [Nm] on the pelvis, in world axes, shape (6,).

        Args:
            hal_state: state of the HAL, a value of `SupervisorState`.
        """
        if self._automatic and hal_state in _ACTIVE:
            self._waited += 1
            if self._waited * PERIOD >= DELAY:
                self.lower()
        if self.lowered:
            return self._wrench
        self._hook += max(-SPEED * PERIOD, min(self._goal - self._hook, SPEED * PERIOD))
        motion = self._body.motion(PELVIS)
        x, y, z = motion.position.tolist()
        vx, vy, vz = motion.velocity.tolist()
        mass, stretch = self._mass, self._hook - z
        tension = max(0.0, mass * (STIFFNESS * stretch - DAMPING * vz)) if stretch > 0.0 else 0.0
        share = min(1.0, tension / (mass * GRAVITY))
        wrench, across, (at_x, at_y) = self._wrench, share * mass, self._at
        wrench[0] = across * (STIFFNESS * (at_x - x) - DAMPING * vx)
        wrench[1] = across * (STIFFNESS * (at_y - y) - DAMPING * vy)
        wrench[2] = tension
        turn = _turn_to_upright(motion.attitude, self._half_heading)
        for axis, (angle, rate) in enumerate(zip(turn, motion.rate.tolist(), strict=True)):
            wrench[3 + axis] = across * (RIGHTING * angle - ATTITUDE_DAMPING * rate)
        if stretch < -SLACK and self._goal < self._hook:
            self.lowered = True
            wrench[:] = 0.0
        return wrench

    def _hold(self, motion: Motion) -> None:
        """Hold the horizontal position and the heading of the pelvis from now on."""
        x, y, _ = motion.position.tolist()
        self._at, half = (x, y), 0.5 * _yaw(motion.attitude)
        self._half_heading = float(np.sin(half)), float(np.cos(half))


def _yaw(attitude: Vector) -> float:
    x, y, z, w = attitude
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _turn_to_upright(attitude: Vector, half_heading: tuple[float, float]) -> tuple[float, float, float]:
    """Return the rotation from an attitude to the upright attitude with a given heading, in world axes [rad].

    The result is 2 sin(angle / 2) along the axis of rotation. For a small angle it is the rotation vector.

    Args:
        attitude: quaternion xyzw, shape (4,).
        half_heading: sine and cosine of half the yaw angle.
    """
    s, c = half_heading
    x, y, z, w = attitude.tolist()
    # Product of the quaternion (0, 0, s, c) and the conjugate of the attitude.
    twice = 2.0 if c * w + s * z >= 0.0 else -2.0
    return twice * (-c * x + s * y), twice * (-s * x - c * y), twice * (s * w - c * z)
