r"""Flat foot: swing ankle angles that hold the sole level, from the tibia IMU alone.

`tibia attitude -> SA, HA targets`, in place of the nominal ones, for the same PID. The foot's attitude in the world is
:math:`R_{tibia} R_z(\text{toe}) R_y(q_{SA}) R_a(q_{HA})`; the sole is level when this takes the sole's normal to the
vertical. With :math:`g` the vertical seen from the ankle and the henke axis :math:`a = (a_x, 0, a_z)`, the y component
of :math:`R_a e_z` is :math:`-a_x \sin q_{HA}` and SA does not change it, which gives HA; SA then turns the x-z plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_control.model import ExoskeletonParameters


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

    def angles(self, tibia: tuple[float, float, float, float]) -> tuple[float, float]:
        """SA and HA [rad] that level the sole, or the nearest HA where the tibia leans too far sideways for it.

        Args:
            tibia: attitude of the tibia IMU, unit quaternion wxyz, tibia to world; its heading does not matter.
        """
        w, x, y, z = tibia
        tx, ty, tz = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        c, s = math.cos(self.toe_out), math.sin(self.toe_out)
        gx, gy = c * tx + s * ty, c * ty - s * tx
        ax, _, az = self.axis
        norm = math.hypot(ax, az)
        ax, az = ax / norm, az / norm
        henke = -math.asin(min(1.0, max(-1.0, gy / ax)))
        versine = 1.0 - math.cos(henke)
        sagittal = math.atan2(gx, tz) - math.atan2(versine * ax * az, 1.0 - versine * ax * ax)
        return math.remainder(sagittal, 2.0 * math.pi), henke

    def rates(self, x: float, y: float, z: float) -> tuple[float, float]:
        """Speeds of SA and HA [rad/s] that keep the sole level, to first order in the tilt.

        Args:
            x, y, z: angular velocity of the tibia in its own frame [rad/s].
        """
        c, s = math.cos(self.toe_out), math.sin(self.toe_out)
        return s * x - c * y, -(c * x + s * y) * math.hypot(self.axis[0], self.axis[2]) / self.axis[0]


def flat_feet(parameters: ExoskeletonParameters) -> tuple[FlatFoot, FlatFoot]:
    """Left and right foot of an exoskeleton."""
    return FlatFoot(parameters.toe_out, parameters.ha_axis), FlatFoot(-parameters.toe_out, parameters.ha_axis)
