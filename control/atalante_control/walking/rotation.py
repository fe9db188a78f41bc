"""Rotation matrices and tilt quaternions for compiled kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from atalante_hal.types import Vector
from atalante_hal.vectors import Vector3


def about_z(angle: float) -> Vector:
    """Return the rotation matrix about the vertical axis, shape (3, 3).

    Args:
        angle: angle [rad].
    """
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_of(quaternion: Sequence[float]) -> Vector:
    """Return the rotation matrix of a unit quaternion, shape (3, 3).

    Args:
        quaternion: unit quaternion wxyz.
    """
    w, x, y, z = quaternion
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def tilt_quaternion(vertical: Vector | Vector3) -> tuple[float, float, float, float]:
    """Return the attitude of a frame without its heading, as unit quaternion wxyz from the frame to the world.

    Args:
        vertical: upward unit vector in the axes of the frame; it must not point straight down.
    """
    x, y, z = vertical[0], vertical[1], vertical[2]
    norm = math.sqrt(2.0 * (1.0 + z))
    return 0.5 * norm, y / norm, -x / norm, 0.0
