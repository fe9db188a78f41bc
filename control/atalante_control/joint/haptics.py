"""Haptic feedback: `tracking error, guide, assistance factor -> levels of the eight vibration motors`.

Law of the paper for the level: |e / q_bound| (1 - exp(30 (Xi - 1))). In the swing leg, the thigh motors show the error of the
hip, and the shank motors show the error of the knee. At Xi = 1 no motor vibrates.

The paper lets the motor vibrate "that is located on the side of the joint that matches direction of the tracking error". So the
front motor vibrates if the segment is in front of its desired position, and the back motor if it is behind this position. In the
example of the paper, the front motor shows a joint "above the desired target". Here, "above" is read as raised forwards. This is
a negative tracking error, because a positive angle of SH or SK moves the segment backwards (`_FRONT_SIGN`).
"""

from __future__ import annotations

import math

from atalante_hal.robot import MOTORS
from atalante_hal.types import Vector

#: Indices in MOTORS of the front motors of thigh and shank, per leg. The back motor has the next index.
_FRONT = tuple(
    tuple(MOTORS.index(f"{side}_{segment}_front") for segment in ("thigh", "shank")) for side in ("left", "right")
)

#: Sign of the tracking errors of SH and SK if thigh and shank are in front of their desired positions.
#: Both joints turn about the y axis, which points to the left. So a positive angle moves the segment backwards.
_FRONT_SIGN = -1.0


def intensity(xi: float) -> float:
    """Return the factor of the vibration levels at the assistance factor Xi: 1 - exp(30 (Xi - 1)), which is 0 at Xi = 1.

    Args:
        xi: assistance factor in [0, 1].
    """
    return -math.expm1(30.0 * (xi - 1.0))


def levels(leg: int, errors: tuple[float, float], bounds: tuple[float, float], intensity: float, out: Vector) -> Vector:
    """Compute the levels of all vibration motors. The motors of the stance leg get level 0.

    Args:
        leg: swing leg, 0 left, 1 right.
        errors: tracking errors q - q_des of SH and SK [rad].
        bounds: distance from q_des to the edge of the guide on the side of the error, for SH and SK, positive [rad].
        intensity: result of `intensity(xi)`.
        out: levels in the order of MOTORS, shape (8,), overwritten.

    Returns:
        `out`, each level in [0, 1].
    """
    out[:] = 0.0
    for i in range(2):
        front, share = _FRONT[leg][i], abs(errors[i]) / bounds[i]
        out[front if _FRONT_SIGN * errors[i] > 0.0 else front + 1] = min(1.0, share * intensity)
    return out
