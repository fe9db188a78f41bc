"""Haptic feedback: `tracking error, guide, assistance factor -> levels of the eight vibration motors`.

The paper's law: |e / q_bound| (1 - exp(30 (Xi - 1))), on the front of the limb where the joint is above its desired
angle and on the back where it is below; thigh for the hip, shank for the knee, of the swing leg; silent at Xi = 1.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import MOTORS

Vector = npt.NDArray[np.float64]

#: First motor (front) of thigh and shank, left leg and right leg; the motor behind it is the next.
_FRONT = tuple(
    tuple(MOTORS.index(f"{side}_{segment}_front") for segment in ("thigh", "shank")) for side in ("left", "right")
)


def intensity(xi: float) -> float:
    """1 - exp(30 (Xi - 1)): close to 1 below Xi = 0.9, exactly 0 at Xi = 1."""
    return -math.expm1(30.0 * (xi - 1.0))


def levels(leg: int, errors: tuple[float, float], bounds: tuple[float, float], intensity: float, out: Vector) -> Vector:
    """Levels of all motors; those of the stance leg are zero.

    Args:
        leg: swing leg, 0 left, 1 right.
        errors: q - q_des of SH and SK [rad].
        bounds: distance from q_des to the guide on the error's side, SH and SK, positive [rad].
        intensity: of `intensity(xi)`.
        out: shape (8,), overwritten, order of MOTORS.

    Returns:
        `out`, each level in [0, 1].
    """
    out[:] = 0.0
    for i in range(2):
        front, share = _FRONT[leg][i], abs(errors[i]) / bounds[i]
        out[front if errors[i] > 0.0 else front + 1] = min(1.0, share * intensity)
    return out
