"""Steering along a line: a rotation of the hip in the next step corrects the deviation from the line.

`positions and headings of the soles -> deviation from the line -> hip rotation in the next step`

The line is the straight path that the robot must follow. The line starts in the middle between the feet when the walk begins,
in the direction of the mean heading of the soles. The position on the ground is the sum of the relative sole positions at each
landing. The heading of the pelvis is not used, because the pelvis turns by several degrees during a step. TH is the transverse
hip.
"""

from __future__ import annotations

import math

import numpy as np

from atalante_hal.types import Vector


class Steering:
    """Deviation of the walk from the desired line, and the offset of the transverse hip (TH) that steers back.

    Attributes:
        feet: positions of left and right sole, x along the line and y to the left of the line, shape (2, 2) [m].
        yaw: mean heading of both soles relative to the line [rad].
    """

    def __init__(self, gains: tuple[float, float, float], turn: float = 0.0) -> None:
        """Set the gains of the steering.

        Args:
            gains: TH offset per heading error [rad/rad], TH offset per sideways deviation [rad/m], and largest TH
                offset without a turn [rad].
            turn: angle by which the line turns before each periodic step, positive to the left [rad].
        """
        self._gains, self._turn = gains, turn
        self.feet: Vector = np.zeros((2, 2))
        self.reset()

    def reset(self) -> None:
        """Set the positions of both feet to the origin, and the heading error to 0."""
        self.feet.fill(0.0)
        self.yaw = self._origin = 0.0

    @property
    def lateral(self) -> float:
        """Return the distance of the middle between the feet from the desired line, positive to the left [m]."""
        return float(self.feet[:, 1].mean())

    @property
    def distance(self) -> float:
        """Return the distance walked along the desired line [m]."""
        return float(self.feet[:, 0].mean())

    def begin(self, step: Vector, headings: Vector) -> None:
        """Start the desired line in the middle between the feet.

        Args:
            step: position of the right sole relative to the left sole in world axes, shape (3,) [m].
            headings: headings of both feet without the toe-out, shape (2,) [rad].
        """
        self._origin, self.yaw = float(headings.mean()), 0.0
        right = self._on_line(step)
        self.feet[0], self.feet[1] = -0.5 * right, 0.5 * right

    def land(self, side: int, step: Vector, headings: Vector) -> None:
        """Update the positions of the feet and the heading error at the landing of a foot.

        Args:
            side: foot that landed, 0 left, 1 right.
            step: position of the right sole relative to the left sole in world axes, shape (3,) [m].
            headings: headings of both feet without the toe-out, shape (2,) [rad].
        """
        right = self._on_line(step)
        self.feet[side] = self.feet[1 - side] + (right if side else -right)
        self.yaw = float(headings.mean()) - self._origin

    def turn(self) -> None:
        """Turn the line about the middle between the feet. The sideways deviation from the line stays the same."""
        self._origin += self._turn
        self.yaw -= self._turn
        c, s = math.cos(self._turn), math.sin(self._turn)
        middle = self.feet.mean(axis=0)
        x, y = (self.feet - middle).T
        self.feet[:] = middle + np.column_stack([c * x + s * y, c * y - s * x])

    def offset(self) -> float:
        """Return the offset of the transverse hip (TH) of the swing leg for the next step, positive to the left [rad].

        In a steady turn, the line turns by the same angle before each step, and each foot lands in the direction of the line. At
        the start of a step, the stance foot is then one turn behind the line, and the swing foot is two turns behind the line.
        Their mean heading is 1.5 turns behind the line. This lag is not an error.
        """
        per_yaw, per_metre, largest = self._gains
        limit = largest + abs(self._turn)
        lag = 1.5 * self._turn  # rad, lag of the mean heading of the feet behind the line in a steady turn
        error = self.yaw + lag
        return -min(max(per_yaw * error + per_metre * self.lateral - self._turn, -limit), limit)

    def _on_line(self, step: Vector) -> Vector:
        c, s = math.cos(self._origin), math.sin(self._origin)
        return np.array([c * step[0] + s * step[1], c * step[1] - s * step[0]])
