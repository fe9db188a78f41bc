r"""Velocity-aided attitude observer: `gyro, accelerometer, velocity of the IMU -> attitude of the pelvis`.

The gyro drifts, and the accelerometer of a walking robot measures much more than gravity. The observer therefore compares the
integral of the specific force with a measured velocity of the IMU. This velocity follows from the joint angles, the joint speeds
and the gyro, because a sole on the ground is at rest. Let :math:`\hat R` be the rotation from pelvis to world. All
vectors are in the axes of the pelvis: the specific force a, the angular velocity :math:`\omega`, the gravitational
acceleration :math:`g_b = \hat R^T g` and the velocity error :math:`\tilde v = v - \hat v`. The observer is

.. math:: \dot{\hat v} = a - \omega \times \hat v + g_b + 2 w \tilde v, \quad
          \dot{\hat R} = \hat R\,[\omega + (w / |g|)^2\,\tilde v \times g_b]_\times

The error of roll and pitch obeys a critically damped equation with natural frequency w. The heading is the integral of the gyro,
so it drifts. If the IMU has a heading reference, such as a magnetometer, `follow_heading` removes the drift (`walking.heading`).
(After P. Martin and E. Salaun, Design and implementation of a low-cost observer-based attitude and heading reference system,
Control Engineering Practice 18, 2010.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from atalante_control.structured import Records, zeros
from atalante_control.walking.heading import HeadingConfig, HeadingFilter
from atalante_control.walking.rotation import about_z, rotation_of
from atalante_hal.compiled import compiled
from atalante_hal.types import GRAVITY, PERIOD, Vector
from atalante_hal.vectors import Vector3, cross


class Attitude:
    """State of the attitude observer."""

    rotation: Annotated[Vector, (3, 3)]  # rotation matrix from pelvis to world
    velocity: Annotated[Vector, 3]  # m/s, velocity of the IMU in the axes of the pelvis
    bandwidth: float  # rad/s, natural frequency w with which errors of roll and pitch decay


class AttitudeObserver:
    """Velocity-aided observer of the attitude of the pelvis.

    Attributes:
        records: record of `observe`, shape (1,).
        rotation: rotation matrix from pelvis to world, shape (3, 3), a view of the record that `update` overwrites.
    """

    def __init__(self, bandwidth: float = 2.0, heading: HeadingConfig | None = None) -> None:
        """Allocate the state, and compile the kernel.

        Args:
            bandwidth: natural frequency w of the decay of roll and pitch errors [rad/s].
            heading: parameters of `follow_heading`. If None, the defaults are used.
        """
        self.records: Records[Attitude] = zeros(Attitude, 1)
        self.records[0].bandwidth = bandwidth
        self.rotation: Vector = self.records[0].rotation
        self._observe, self._headings = compiled(observe), HeadingFilter(heading or HeadingConfig())
        self.reset((1.0, 0.0, 0.0, 0.0))
        self.update(np.zeros(3), np.array([0.0, 0.0, GRAVITY]), (0.0, 0.0, 0.0))
        self.reset((1.0, 0.0, 0.0, 0.0))

    def reset(self, quaternion: Sequence[float]) -> None:
        """Take roll and pitch from a measured attitude. Set the heading and the velocity to zero.

        Args:
            quaternion: attitude of the pelvis IMU, unit quaternion wxyz, pelvis to world.
        """
        record, rotation = self.records[0], rotation_of(quaternion)
        self._origin = math.atan2(rotation[1, 0], rotation[0, 0])
        record.rotation[:] = about_z(-self._origin) @ rotation
        record.velocity[:] = 0.0
        self._headings.reset()

    def update(self, gyro: Vector, accel: Vector, velocity: Vector3) -> None:
        """Advance the attitude by one cycle, as `observe` does."""
        self._observe(self.records, gyro, accel, velocity)

    def change_imu(self, gyro: Vector, offset: Vector) -> None:
        """Replace the stored velocity of one IMU on the pelvis by the velocity of another IMU on the pelvis.

        Args:
            gyro: angular velocity of the pelvis in the axes of the pelvis, shape (3,) [rad/s].
            offset: position of the new IMU relative to the IMU before, in the axes of the pelvis, shape (3,) [m].
        """
        self.records[0].velocity[:] += cross(gyro, offset)

    def level(self, up: Vector, time: float) -> None:
        """Correct roll and pitch. Call this method once per cycle.

        Args:
            up: measured upward unit vector in the axes of the pelvis, shape (3,).
            time: time constant with which the error decays [s].
        """
        self.rotation[2] += PERIOD / time * (up - self.rotation[2])
        _orthonormalise(self.rotation)

    def follow_heading(self, quaternion: Sequence[float]) -> None:
        """Correct the drift of the heading. Call this method once per cycle, if the IMU has a heading reference.

        Args:
            quaternion: attitude of the pelvis IMU, unit quaternion wxyz, pelvis to world. Its heading at the last `reset`
                counts as zero.
        """
        w, x, y, z = quaternion
        measured = math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)) - self._origin
        rotation = self.rotation
        turn = self._headings.correction(measured, math.atan2(rotation[1, 0], rotation[0, 0]))
        if turn:
            rotation[:] = about_z(turn) @ rotation


def observe(attitudes: Records[Attitude], gyro: Vector, accel: Vector, measured: Vector3) -> None:
    """Advance the attitude by one cycle.

    Args:
        attitudes: state of the observer, shape (1,), updated.
        gyro: angular velocity of the pelvis in the axes of the pelvis, shape (3,) [rad/s].
        accel: specific force at the IMU in the axes of the pelvis, shape (3,) [m/s2].
        measured: velocity of the IMU, computed from the sole at rest, in the axes of the pelvis [m/s].
    """
    state = attitudes[0]
    rotation, velocity, w = state.rotation, state.velocity, state.bandwidth
    gravity = -GRAVITY * rotation[2, 0], -GRAVITY * rotation[2, 1], -GRAVITY * rotation[2, 2]
    error = measured[0] - velocity[0], measured[1] - velocity[1], measured[2] - velocity[2]
    turning = cross(gyro, velocity)
    correction = cross(error, gravity)
    gain = (w / GRAVITY) ** 2
    x, y, z = (
        (gyro[0] + gain * correction[0]) * PERIOD,
        (gyro[1] + gain * correction[1]) * PERIOD,
        (gyro[2] + gain * correction[2]) * PERIOD,
    )
    for k in range(3):
        velocity[k] += (accel[k] - turning[k] + gravity[k] + 2.0 * w * error[k]) * PERIOD
    # Rotate with the Taylor series of the rotation matrix up to second order. The rotation has an error of third order in the
    # angle. The error of the orthogonality is of fourth order.
    for row in range(3):
        a, b, c = rotation[row, 0], rotation[row, 1], rotation[row, 2]
        da, db, dc = b * z - c * y, c * x - a * z, a * y - b * x
        rotation[row, 0] = a + da + 0.5 * (db * z - dc * y)
        rotation[row, 1] = b + db + 0.5 * (dc * x - da * z)
        rotation[row, 2] = c + dc + 0.5 * (da * y - db * x)
    _orthonormalise(rotation)


def _orthonormalise(rotation: Vector) -> None:
    """Remove the rounding error from a rotation matrix. The direction of the last row (the vertical) does not change."""
    norm = math.sqrt(rotation[2, 0] ** 2 + rotation[2, 1] ** 2 + rotation[2, 2] ** 2)
    for k in range(3):
        rotation[2, k] /= norm
    along = rotation[0, 0] * rotation[2, 0] + rotation[0, 1] * rotation[2, 1] + rotation[0, 2] * rotation[2, 2]
    for k in range(3):
        rotation[0, k] -= along * rotation[2, k]
    norm = math.sqrt(rotation[0, 0] ** 2 + rotation[0, 1] ** 2 + rotation[0, 2] ** 2)
    for k in range(3):
        rotation[0, k] /= norm
    rotation[1, 0] = rotation[2, 1] * rotation[0, 2] - rotation[2, 2] * rotation[0, 1]
    rotation[1, 1] = rotation[2, 2] * rotation[0, 0] - rotation[2, 0] * rotation[0, 2]
    rotation[1, 2] = rotation[2, 0] * rotation[0, 1] - rotation[2, 1] * rotation[0, 0]
