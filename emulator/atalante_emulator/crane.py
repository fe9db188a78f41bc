"""Crane of an emulated robot: suspends the robot above the floor, and lowers the robot onto its feet.

The crane lowers the robot after the HAL was in the state ACTIVE or FULL_ASSIST for the time `DELAY`, or at a call of `lower`.

The sling is a spring between the hook and the pelvis. The sling pulls upwards only. While the sling is under tension, the crane
also keeps the pelvis upright and holds its horizontal position and heading constant. These forces and moments grow in
proportion to the tension, until the tension equals the weight of the robot. A slack sling exerts no force.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from atalante_emulator.bodies import PELVIS, Body, Motion
from atalante_hal.types import GRAVITY, PERIOD, SupervisorState, Vector

#: Speed of the hook [m/s].
SPEED: Final = 0.1
#: Total time of the HAL in the states ACTIVE and FULL_ASSIST after which the crane lowers the robot [s].
#: Before the robot is lowered, the walking controller moves the legs of the suspended robot to the standing pose.
#: On the floor, the friction of the feet would prevent the motion of the legs to the standing pose.
DELAY: Final = 2.0
#: Stiffness and damping of the sling, per kg of robot mass.
#: The stiffness is proportional to the mass, so the weight of every robot stretches the sling by the same 25 mm.
STIFFNESS: Final = 400.0  # N/m per kg
DAMPING: Final = 28.0  # N s/m per kg
#: Rotational stiffness and damping with which the crane turns the pelvis upright, per kg of robot mass.
#: The crane multiplies the moment on the pelvis by the fraction of the robot weight that the sling carries.
RIGHTING: Final = 100.0  # Nm/rad per kg
ATTITUDE_DAMPING: Final = 1.5  # Nm s/rad per kg
#: Slack of the sling at which the crane stops the hook [m]. Then the crane exerts no force until a call of `lift`.
#: The pelvis of a walking robot moves up and down by less than `SLACK`, so the sling stays loose.
SLACK: Final = 0.15
_ACTIVE: Final = (SupervisorState.ACTIVE, SupervisorState.FULL_ASSIST)


class Crane:
    """Crane of a robot with a free pelvis. The emulator calls the crane once in each time step.

    Attributes:
        lowered: True after the crane has lowered the robot: the sling is loose, and the robot stands alone.
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
        """Move the hook for one time step of 1 ms (`PERIOD`), and return the force and moment on the pelvis.

        Args:
            hal_state: state of the HAL, a value of `SupervisorState`.

        Returns:
            Force [N] and moment [Nm] in world axes, shape (6,).
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
        """Store horizontal position and heading of the pelvis as setpoints. The crane holds the pelvis there from now on."""
        x, y, _ = motion.position.tolist()
        self._at, half = (x, y), 0.5 * _yaw(motion.attitude)
        self._half_heading = float(np.sin(half)), float(np.cos(half))


def _yaw(attitude: Vector) -> float:
    x, y, z, w = attitude
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _turn_to_upright(attitude: Vector, half_heading: tuple[float, float]) -> tuple[float, float, float]:
    """Return the rotation that turns a pelvis upright and into a given heading, as a vector in world axes [rad].

    The vector has the length 2 sin(angle / 2) along the axis of rotation. For a small angle, 2 sin(angle / 2) is the angle.

    Args:
        attitude: quaternion xyzw, shape (4,).
        half_heading: sine and cosine of half the yaw angle.
    """
    s, c = half_heading
    x, y, z, w = attitude.tolist()
    # The result is twice the vector part of the quaternion product "(0, 0, s, c) times conjugate of `attitude`".
    twice = 2.0 if c * w + s * z >= 0.0 else -2.0
    return twice * (-c * x + s * y), twice * (-s * x - c * y), twice * (s * w - c * z)
