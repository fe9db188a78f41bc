r"""Flat foot: swing ankle angles that hold the sole level, from the tibia IMU, or from the joints where that is silent.

`tibia attitude -> SA, HA targets`, in place of the nominal ones, for the same PID. The foot's attitude in the world is
:math:`R_{tibia} R_z(\text{toe}) R_y(q_{SA}) R_a(q_{HA})`; the sole is level when this takes the sole's normal to the
vertical. With :math:`g` the vertical seen from the ankle and the henke axis :math:`a = (a_x, 0, a_z)`, the y component
of :math:`R_a e_z` is :math:`-a_x \sin q_{HA}` and SA does not change it, which gives HA; SA then turns the x-z plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.model import ArticulatedModel, ExoskeletonParameters, imu_link
from atalante_hal.robot import SIDES

Vector = npt.NDArray[np.float64]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class FlatFoot:
    """Ankle geometry of one foot.

    Raises:
        ValueError: a henke axis with a y component, or with no x component.
    """

    toe_out: float  # rad, foot about the tibia's vertical, positive to the left
    axis: tuple[float, float, float]  # henke axis in the foot frame, any length

    def __post_init__(self) -> None:
        if self.axis[1] != 0.0 or self.axis[0] == 0.0:
            raise ValueError(f"the henke axis lies in the foot's x-z plane and is not vertical, not {self.axis!r}")

    def level(
        self, tibia: Quaternion, gyro: tuple[float, float, float]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """SA and HA that level the sole, or the nearest HA where the tibia leans too far sideways for it.

        Args:
            tibia: attitude of the tibia IMU, unit quaternion wxyz, tibia to world; its heading does not matter.
            gyro: angular velocity of the tibia in its own frame [rad/s].

        Returns:
            Angles [rad] and their rates [rad/s], SA then HA.
        """
        w, x, y, z = tibia
        tx, ty, tz = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        p, q, r = gyro
        txd, tyd, tzd = ty * r - tz * q, tz * p - tx * r, tx * q - ty * p  # the vertical, seen from a turning tibia
        c, s = math.cos(self.toe_out), math.sin(self.toe_out)
        gx, gy, gxd, gyd = c * tx + s * ty, c * ty - s * tx, c * txd + s * tyd, c * tyd - s * txd
        ax, _, az = self.axis
        norm = math.hypot(ax, az)
        ax, az = ax / norm, az / norm

        sine = -gy / ax
        sine, henke_rate = (math.copysign(1.0, sine), 0.0) if abs(sine) >= 1.0 else (sine, -gyd / ax)
        cosine = math.sqrt(1.0 - sine * sine)
        henke_rate = henke_rate / cosine if cosine else 0.0
        versine, versine_rate = 1.0 - cosine, sine * henke_rate
        nx, nz = versine * ax * az, 1.0 - versine * ax * ax
        sagittal = math.remainder(math.atan2(gx, tz) - math.atan2(nx, nz), 2.0 * math.pi)
        leaning = gx * gx + tz * tz
        sagittal_rate = (tz * gxd - gx * tzd) / leaning if leaning else 0.0
        sagittal_rate -= versine_rate * ax * (nz * az + nx * ax) / (nx * nx + nz * nz)
        return (sagittal, math.asin(sine)), (sagittal_rate, henke_rate)


class Tibiae:
    """Attitude and angular rate of the tibiae from the joints and the pelvis IMU: for a tibia whose own IMU is silent."""

    def __init__(self, articulated: ArticulatedModel) -> None:
        """Take a model with the pelvis fixed."""
        self._model, self._into, self._rates = articulated
        self._data = self._model.createData()
        self._pelvis, *self._tibiae = (
            self._model.getFrameId(imu_link(imu)) for imu in ("pelvis", *(f"{side}_tibia" for side in SIDES))
        )

    def attitude(
        self, side: int, position: Vector, velocity: Vector, pelvis: Sequence[float], gyro: Sequence[float]
    ) -> tuple[Quaternion, tuple[float, float, float]]:
        """What the tibia's IMU would say.

        Args:
            side: 0 left, 1 right.
            position, velocity: shape (12,) [rad], [rad/s].
            pelvis, gyro: attitude (unit quaternion wxyz) and angular velocity [rad/s] of the pelvis IMU.

        Returns:
            Unit quaternion wxyz, tibia to world, and angular velocity in the tibia's frame [rad/s].
        """
        model, data, tibia = self._model, self._data, self._tibiae[side]
        q, v = pinocchio.neutral(model), np.zeros(model.nv)
        q[self._into], v[self._rates] = position, velocity
        pinocchio.forwardKinematics(model, data, q, v)
        pinocchio.updateFramePlacements(model, data)
        seen = data.oMf[self._pelvis].rotation.T @ data.oMf[tibia].rotation  # from the pelvis
        x, y, z, w = (pinocchio.Quaternion(*pelvis) * pinocchio.Quaternion(seen)).coeffs().tolist()
        own = pinocchio.getFrameVelocity(model, data, tibia, pinocchio.ReferenceFrame.LOCAL).angular
        p, q_rate, r = (own + seen.T @ np.asarray(gyro)).tolist()
        return (w, x, y, z), (p, q_rate, r)


def flat_feet(parameters: ExoskeletonParameters) -> tuple[FlatFoot, FlatFoot]:
    """Left and right foot of an exoskeleton."""
    return FlatFoot(parameters.toe_out, parameters.ha_axis), FlatFoot(-parameters.toe_out, parameters.ha_axis)
