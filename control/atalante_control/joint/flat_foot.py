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
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.gait.gait import PERIOD
from atalante_control.gait.recentering import Deadbeat
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, imu_link
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.types import State

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]
Quaternion = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]

_SA, _HA = LEG_JOINTS.index("SA"), LEG_JOINTS.index("HA")
_STOP_MARGIN, _STOP_FADE = math.radians(1.0), math.radians(3.0)  # off the ankle's limits
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)
_IMU_AGE = 10  # cycles after which what an IMU said is no longer used, its timeout in the DBC

#: An ankle: what stays, then what a step change leaves to its deadbeat.
ANKLE = np.dtype(
    [
        ("geometry", np.float64, 4),  # of `FlatFoot`
        ("offset", np.float64),  # rad, on SA
        ("joints", np.int64, 2),  # SA and HA in JOINTS
        ("low", np.float64, 2),  # rad, where they are to stay
        ("high", np.float64, 2),
        ("deviation", np.float64, 2),  # rad, from the target at the step change
        ("rate", np.float64, 2),  # rad/s
    ],
    align=True,
)


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

    @property
    def geometry(self) -> tuple[float, float, float, float]:
        """Cosine and sine of the toe-out, x and z of the unit henke axis."""
        ax, _, az = self.axis
        norm = math.hypot(ax, az)
        return math.cos(self.toe_out), math.sin(self.toe_out), ax / norm, az / norm


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
    ) -> tuple[Quaternion, Vector3]:
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


class LevelFeet:
    """Flat-foot targets in the place of the nominal ones of the swing ankle, with a deadbeat of their own.

    Call `start_step` at each step change, then `put_level` once a cycle, or `put` where the tibia's IMU is not heard.

    Attributes:
        ankles: left and right, rows of ANKLE.
        cubics: c0, c1 of the deadbeat and their derivatives, a row a cycle until it ends.
    """

    def __init__(
        self,
        robot: Robot,
        exoskeleton: ExoskeletonParameters,
        articulated: ArticulatedModel,
        deadbeat: Deadbeat,
        nominal: Sequence[Vector],
        offset: float,
    ) -> None:
        """Prepare both ankles.

        Args:
            articulated: with the pelvis fixed.
            nominal: rows (q_nom, q_nom') of a step the left (0) and the right leg (1) swings in, each shape (n, 24).
            offset: added to SA [rad].
        """
        self._nominal, self._tibiae = nominal, Tibiae(articulated)
        self.ankles = np.zeros(len(SIDES), ANKLE)
        self.ankles["offset"] = offset
        for side, (ankle, foot) in enumerate(zip(self.ankles, flat_feet(exoskeleton), strict=True)):
            joints = [side * len(LEG_JOINTS) + joint for joint in (_SA, _HA)]
            ankle["geometry"], ankle["joints"] = foot.geometry, joints
            ankle["low"] = robot.position_min[joints] + _STOP_MARGIN
            ankle["high"] = robot.position_max[joints] - _STOP_MARGIN
        time: Vector = np.arange(len(nominal[0]), dtype=np.float64) * PERIOD
        (c0, c1), (c0d, c1d), _ = deadbeat.basis(time[: np.searchsorted(time, deadbeat.end)])
        self.cubics = np.column_stack([c0, c1, c0d, c1d])

    def start_step(self, state: State, side: int) -> None:
        """Leave what the ankle of the leg that swings now (0 left, 1 right) is off its target to the deadbeat."""
        ankle, (angles, rates) = self.ankles[side], self._target(state, side, 0)
        ankle["deviation"] = state.position[ankle["joints"]] - angles
        ankle["rate"] = state.velocity[ankle["joints"]] - rates

    def heard(self, state: State, side: int) -> bool:
        """The tibia's IMU speaks: `put_level` may follow it."""
        return not state.imu_rows or bool(state.age[state.imu_rows[_TIBIAE[side]]] <= _IMU_AGE)

    def put(self, state: State, side: int, cycle: int, row: Vector) -> None:
        """Targets without the tibia's IMU into a row (q_des, q_des') of shape (24,).

        Its attitude comes from the joints and the pelvis IMU; without that one, too, the nominal holds.
        """
        _put(row, self.ankles[side], self.cubics, cycle, *self._target(state, side, cycle))

    def _target(self, state: State, side: int, cycle: int) -> tuple[Pair, Pair]:
        ankle, imu = self.ankles[side], _TIBIAE[side]
        if self.heard(state, side):
            return _target(ankle, state.imu_quaternion[imu], state.imu_gyro[imu])
        if state.age[state.imu_rows[_PELVIS]] <= _IMU_AGE:
            pelvis = state.imu_quaternion[_PELVIS].tolist(), state.imu_gyro[_PELVIS].tolist()
            return _target(ankle, *self._tibiae.attitude(side, state.position, state.velocity, *pelvis))
        row, (sa, ha), n = self._nominal[side][cycle].tolist(), ankle["joints"], len(JOINTS)
        return (row[sa], row[ha]), (row[n + sa], row[n + ha])


def put_level(
    row: Vector, ankles: npt.NDArray[np.void], side: int, cubics: Vector, cycle: int, tibia: Vector, gyro: Vector
) -> None:
    """The targets of the swing leg's ankle (0 left, 1 right) into a row (q_des, q_des') of shape (24,).

    Args:
        ankles, cubics: of `LevelFeet`.
        tibia, gyro: as in `level`.
    """
    angles, rates = _target(ankles[side], tibia, gyro)
    _put(row, ankles[side], cubics, cycle, angles, rates)


def _put(row: Vector, ankle: Any, cubics: Vector, cycle: int, angles: Pair, rates: Pair) -> None:
    """Targets with what their deadbeat adds."""
    n = len(row) // 2
    for i in range(2):
        angle, rate, joint = angles[i], rates[i], ankle["joints"][i]
        if cycle < len(cubics):
            cubic, deviation, speed = cubics[cycle], ankle["deviation"][i], ankle["rate"][i]
            angle = angle + deviation * cubic[0] + speed * cubic[1]
            rate = rate + deviation * cubic[2] + speed * cubic[3]
        row[joint], row[n + joint] = angle, rate


def _target(ankle: Any, tibia: Sequence[float] | Vector, gyro: Sequence[float] | Vector) -> tuple[Pair, Pair]:
    """Angles and rates of SA and HA that hold the sole level, with the offset, within the joints' limits."""
    (sagittal, henke), rates = level(ankle["geometry"], tibia, gyro)
    low, high = ankle["low"], ankle["high"]
    sa, sa_rate = _within(sagittal + ankle["offset"], rates[0], low[0], high[0])
    ha, ha_rate = _within(henke, rates[1], low[1], high[1])
    return (sa, ha), (sa_rate, ha_rate)


def _within(angle: float, rate: float, low: float, high: float) -> Pair:
    """Angle held within limits, with a speed that fades out before them rather than at them."""
    room = max(0.0, min(angle - low, high - angle) / _STOP_FADE)
    return min(high, max(low, angle)), rate * min(1.0, room)


def level(geometry: Vector, tibia: Sequence[float] | Vector, gyro: Sequence[float] | Vector) -> tuple[Pair, Pair]:
    """SA and HA that level the sole, or the nearest HA where the tibia leans too far sideways for it.

    Args:
        geometry: of `FlatFoot`.
        tibia: attitude of the tibia IMU, unit quaternion wxyz, tibia to world; its heading does not matter.
        gyro: angular velocity of the tibia in its own frame [rad/s].

    Returns:
        Angles [rad] and their rates [rad/s], SA then HA.
    """
    c, s, ax, az = geometry[0], geometry[1], geometry[2], geometry[3]
    w, x, y, z = tibia[0], tibia[1], tibia[2], tibia[3]
    tx, ty, tz = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    p, q, r = gyro[0], gyro[1], gyro[2]
    txd, tyd, tzd = ty * r - tz * q, tz * p - tx * r, tx * q - ty * p  # the vertical, seen from a turning tibia
    gx, gy, gxd, gyd = c * tx + s * ty, c * ty - s * tx, c * txd + s * tyd, c * tyd - s * txd

    sine = -gy / ax
    sine, henke_rate = (math.copysign(1.0, sine), 0.0) if abs(sine) >= 1.0 else (sine, -gyd / ax)
    cosine = math.sqrt(1.0 - sine * sine)
    henke_rate = henke_rate / cosine if cosine else 0.0
    versine, versine_rate = 1.0 - cosine, sine * henke_rate
    nx, nz = versine * ax * az, 1.0 - versine * ax * ax
    sagittal = math.atan2(gx, tz) - math.atan2(nx, nz)
    if abs(sagittal) > math.pi:
        sagittal -= math.copysign(2.0 * math.pi, sagittal)
    leaning = gx * gx + tz * tz
    sagittal_rate = (tz * gxd - gx * tzd) / leaning if leaning else 0.0
    sagittal_rate -= versine_rate * ax * (nz * az + nx * ax) / (nx * nx + nz * nz)
    return (sagittal, math.asin(sine)), (sagittal_rate, henke_rate)
