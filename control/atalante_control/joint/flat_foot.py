r"""Flat foot: ankle angles that hold the sole of the swing foot horizontal. `tibia attitude -> targets of SA and HA`.

SA is the sagittal ankle. HA is the henke ankle, which turns about the oblique henke axis and tilts the foot sideways.

The attitude comes from the tibia IMU. If this IMU is lost, the attitude is computed from the joints and the pelvis IMU. The
targets replace the nominal angles in the reference of the PID. The attitude of the foot in the world is
:math:`R_{tibia} R_z(\text{toe}) R_y(q_{SA}) R_a(q_{HA})`. The sole is level when this rotation maps the normal of the sole to the
vertical, so :math:`R_y(q_{SA}) R_a(q_{HA}) e_z = g`, with the sole normal :math:`e_z` in the foot frame and the vertical
:math:`g` in the ankle frame. With the unit henke axis :math:`a = (a_x, 0, a_z)`, the y component of :math:`R_a e_z` is
:math:`-a_x \sin q_{HA}`. :math:`R_y` does not change y components, so HA follows from :math:`g_y = -a_x \sin q_{HA}`. SA then
follows from the x and z components.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.gait.recentering import Deadbeat
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, imu_link
from atalante_control.structured import Records, zeros
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.types import PERIOD, State, Vector

Pair = tuple[float, float]
Quaternion = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]

_SA, _HA = LEG_JOINTS.index("SA"), LEG_JOINTS.index("HA")
_STOP_MARGIN = math.radians(1.0)  # rad, smallest distance between a target and the joint limit
#: rad, width of the range next to a limit (`Ankle.low`, `Ankle.high`) in which the rate of a target is reduced
_STOP_FADE = math.radians(3.0)
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)
_IMU_AGE = 10  # cycles, largest valid age of an IMU message, equal to the timeout of the message in the DBC


class Ankle:
    """Constants of one ankle, and its deviation from the flat-foot targets at the start of a step.

    The re-centring fades out the deviation: at the start of a step, the targets begin at the measured angles, and then
    approach the flat-foot angles.
    """

    geometry: Annotated[Vector, 4]  # cosine and sine of the toe-out, then x and z of the unit henke axis
    offset: float  # rad, angle added to the target of the sagittal ankle (SA)
    joints: Annotated[npt.NDArray[np.int64], 2]  # indices of sagittal and henke ankle (SA, HA) of this leg in JOINTS
    low: Annotated[Vector, 2]  # rad, smallest targets of sagittal and henke ankle
    high: Annotated[Vector, 2]  # rad, largest targets of sagittal and henke ankle
    #: rad, measured minus flat-foot angles of sagittal and henke ankle at the start of the step
    deviation: Annotated[Vector, 2]
    #: rad/s, measured minus flat-foot speeds of sagittal and henke ankle at the start of the step
    rate: Annotated[Vector, 2]


@dataclass(frozen=True)
class FlatFoot:
    """Ankle geometry of one foot.

    Raises:
        ValueError: If the henke axis has a y component or no x component.
    """

    toe_out: float  # rad, rotation of the foot about the vertical axis of the tibia, positive to the left
    axis: tuple[float, float, float]  # direction of the henke axis in the foot frame; need not be a unit vector

    def __post_init__(self) -> None:
        if self.axis[1] != 0.0 or self.axis[0] == 0.0:
            raise ValueError(f"henke axis must have y = 0 and x != 0 in the foot frame, got {self.axis!r}")

    @property
    def geometry(self) -> tuple[float, float, float, float]:
        """Return cosine and sine of the toe-out, then x and z of the unit henke axis."""
        ax, _, az = self.axis
        norm = math.hypot(ax, az)
        return math.cos(self.toe_out), math.sin(self.toe_out), ax / norm, az / norm


class Tibiae:
    """Substitute for a lost tibia IMU. It computes attitude and angular velocity from the joints and the pelvis IMU."""

    def __init__(self, articulated: ArticulatedModel) -> None:
        """Prepare the forward kinematics.

        Args:
            articulated: model with the pelvis fixed.
        """
        self._model, self._into, self._rates = articulated
        self._data = self._model.createData()
        self._pelvis, *self._tibiae = (
            self._model.getFrameId(imu_link(imu)) for imu in ("pelvis", *(f"{side}_tibia" for side in SIDES))
        )

    def attitude(
        self, side: int, position: Vector, velocity: Vector, pelvis: Sequence[float], gyro: Sequence[float]
    ) -> tuple[Quaternion, Vector3]:
        """Compute the attitude and the angular velocity that the IMU of a tibia would measure.

        Args:
            side: 0 left, 1 right.
            position: joint angles, shape (12,) [rad].
            velocity: joint speeds, shape (12,) [rad/s].
            pelvis: attitude of the pelvis IMU, unit quaternion wxyz, pelvis to world.
            gyro: angular velocity of the pelvis IMU in the frame of this IMU [rad/s].

        Returns:
            Unit quaternion wxyz, tibia to world, and angular velocity in the frame of the tibia [rad/s].
        """
        model, data, tibia = self._model, self._data, self._tibiae[side]
        q, v = pinocchio.neutral(model), np.zeros(model.nv)
        q[self._into], v[self._rates] = position, velocity
        pinocchio.forwardKinematics(model, data, q, v)
        pinocchio.updateFramePlacements(model, data)
        to_pelvis = data.oMf[self._pelvis].rotation.T @ data.oMf[tibia].rotation  # rotation, tibia to pelvis
        x, y, z, w = (pinocchio.Quaternion(*pelvis) * pinocchio.Quaternion(to_pelvis)).coeffs().tolist()
        own = pinocchio.getFrameVelocity(model, data, tibia, pinocchio.ReferenceFrame.LOCAL).angular
        p, q_rate, r = (own + to_pelvis.T @ np.asarray(gyro)).tolist()
        return (w, x, y, z), (p, q_rate, r)


def flat_feet(parameters: ExoskeletonParameters) -> tuple[FlatFoot, FlatFoot]:
    """Return the ankle geometry of the left and the right foot of an exoskeleton."""
    return FlatFoot(parameters.toe_out, parameters.ha_axis), FlatFoot(-parameters.toe_out, parameters.ha_axis)


def ankle_records(robot: Robot, exoskeleton: ExoskeletonParameters, offset: float) -> Records[Ankle]:
    """Return the records of the left and the right ankle. Only the constants are set.

    Args:
        robot: limits of the joints.
        exoskeleton: geometry of the feet.
        offset: angle added to SA [rad].
    """
    ankles: Records[Ankle] = zeros(Ankle, len(SIDES))
    for side, foot in enumerate(flat_feet(exoskeleton)):
        ankle, joints = ankles[side], [side * len(LEG_JOINTS) + joint for joint in (_SA, _HA)]
        ankle.geometry[:], ankle.offset, ankle.joints[:] = foot.geometry, offset, joints
        ankle.low[:] = robot.position_min[joints] + _STOP_MARGIN
        ankle.high[:] = robot.position_max[joints] - _STOP_MARGIN
    return ankles


def recentring_rows(deadbeat: Deadbeat, count: int) -> Vector:
    """Return the polynomials c0, c1 of the re-centring and their time derivatives c0', c1' in each cycle, shape (n, 4).

    Let d and v be the deviations of angle and speed at the stance change. The re-centring adds c0 d + c1 v to the target angle,
    and c0' d + c1' v to the target speed.

    Args:
        deadbeat: re-centring of the gait.
        count: largest number of rows.
    """
    time: Vector = np.arange(count, dtype=np.float64) * PERIOD
    (c0, c1), (c0d, c1d), _ = deadbeat.basis(time[: np.searchsorted(time, deadbeat.end)])
    return np.column_stack([c0, c1, c0d, c1d])


class LevelFeet:
    """Flat-foot targets of the swing ankle, which replace the nominal angles of this ankle.

    Call `start_step` at each stance change. Then call `write_level_ankle` once per cycle, or `without_imu` while the tibia IMU is
    lost.

    Attributes:
        ankles: records of the left and the right ankle.
        cubics: basis cubics c0 and c1 of the re-centring and their time derivatives c0' and c1', one row per cycle, shape (n, 4).
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
        """Compute the constants of both ankles.

        Args:
            robot: limits of the joints.
            exoskeleton: geometry of the feet.
            articulated: model with the pelvis fixed.
            deadbeat: re-centring of the gait.
            nominal: two arrays of shape (n, 24) with rows (q_nom, q_nom'): the step in which the left leg swings, then the
                step in which the right leg swings.
            offset: angle added to SA [rad].
        """
        self._nominal, self._tibiae = nominal, Tibiae(articulated)
        self.ankles = ankle_records(robot, exoskeleton, offset)
        self.cubics = recentring_rows(deadbeat, len(nominal[0]))

    def start_step(self, state: State, side: int) -> None:
        """Store how far the swing ankle is from its targets at the stance change. The re-centring fades out this deviation.

        Args:
            state: measured state of the robot at the stance change.
            side: leg that swings now, 0 left, 1 right.
        """
        _store_deviation(self.ankles[side], self._target(state, side, 0), state.position, state.velocity)

    def imu_valid(self, state: State, side: int) -> bool:
        """Return whether the last message of a tibia IMU is recent enough for `write_level_ankle`.

        Args:
            state: measured state of the robot.
            side: 0 left, 1 right.
        """
        return not state.imu_rows or bool(state.age[state.imu_rows[_TIBIAE[side]]] <= _IMU_AGE)

    def without_imu(self, state: State, side: int, cycle: int, row: Vector) -> Vector:
        """Return a copy of q_des and q_des' in which the swing ankle has flat-foot targets. The tibia IMU is not used.

        The attitude of the tibia is computed from the joints and the pelvis IMU. If the pelvis IMU is lost too, the targets are
        the nominal angles.

        Args:
            state: measured state of the robot.
            side: swing leg, 0 left, 1 right.
            cycle: number of cycles since the stance change.
            row: q_des [rad], then q_des' [rad/s], shape (24,); not changed.
        """
        desired = row.copy()
        _write_targets(self.ankles[side], self.cubics, cycle, self._target(state, side, cycle), desired)
        return desired

    def _target(self, state: State, side: int, cycle: int) -> tuple[Pair, Pair]:
        ankle, imu = self.ankles[side], _TIBIAE[side]
        if self.imu_valid(state, side):
            return _target(ankle, state.imu_quaternion[imu], state.imu_gyro[imu])
        if state.age[state.imu_rows[_PELVIS]] <= _IMU_AGE:
            pelvis = state.imu_quaternion[_PELVIS].tolist(), state.imu_gyro[_PELVIS].tolist()
            return _target(ankle, *self._tibiae.attitude(side, state.position, state.velocity, *pelvis))
        row, (sa, ha), n = self._nominal[side][cycle].tolist(), ankle.joints, len(JOINTS)
        return (row[sa], row[ha]), (row[n + sa], row[n + ha])


def start_level_ankle(ankle: Ankle, tibia: Vector | Quaternion, gyro: Vector | Vector3, q: Vector, qd: Vector) -> None:
    """Store how far a swing ankle is from its targets at the stance change. The re-centring fades out this deviation.

    Args:
        ankle: record of the swing ankle.
        tibia: attitude of the tibia, as in `level`.
        gyro: angular velocity of the tibia, as in `level`.
        q: measured angles, shape (12,) [rad].
        qd: measured speeds, shape (12,) [rad/s].
    """
    _store_deviation(ankle, _target(ankle, tibia, gyro), q, qd)


def _store_deviation(ankle: Ankle, target: tuple[Pair, Pair], q: Vector, qd: Vector) -> None:
    angles, rates = target
    for i in range(2):
        ankle.deviation[i] = q[ankle.joints[i]] - angles[i]
        ankle.rate[i] = qd[ankle.joints[i]] - rates[i]


def write_level_ankle(
    ankle: Ankle,
    cubics: Vector,
    cycle: int,
    tibia: Vector | Quaternion,
    gyro: Vector | Vector3,
    desired: Vector,
) -> None:
    """Compute the targets of the swing ankle from the tibia IMU, and write them into `desired`.

    Args:
        ankle: record of the swing ankle.
        cubics: `LevelFeet.cubics`.
        cycle: number of cycles since the stance change.
        tibia: attitude of the tibia IMU, unit quaternion wxyz as in `level`.
        gyro: angular velocity of the tibia in the frame of the tibia [rad/s].
        desired: q_des [rad], then q_des' [rad/s], shape (24,); the elements of the swing ankle are overwritten.
    """
    _write_targets(ankle, cubics, cycle, _target(ankle, tibia, gyro), desired)


def _write_targets(ankle: Ankle, cubics: Vector, cycle: int, target: tuple[Pair, Pair], desired: Vector) -> None:
    """Write the targets of the swing ankle plus the remaining start deviation into `desired`.

    The start deviation is the deviation of the ankle from its targets at the stance change. It fades out within `len(cubics)`
    cycles.
    """
    (angles, rates), n = target, len(desired) // 2
    for i in range(2):
        angle, rate, joint = angles[i], rates[i], ankle.joints[i]
        if cycle < len(cubics):
            cubic, deviation, speed = cubics[cycle], ankle.deviation[i], ankle.rate[i]
            angle = angle + deviation * cubic[0] + speed * cubic[1]
            rate = rate + deviation * cubic[2] + speed * cubic[3]
        desired[joint], desired[n + joint] = angle, rate


def _target(ankle: Ankle, tibia: Sequence[float] | Vector, gyro: Sequence[float] | Vector) -> tuple[Pair, Pair]:
    """Return the flat-foot angles and rates of sagittal and henke ankle, with offset and limits applied."""
    (sagittal, henke), rates = level(ankle.geometry, tibia, gyro)
    low, high = ankle.low, ankle.high
    sa, sa_rate = _within(sagittal + ankle.offset, rates[0], low[0], high[0])
    ha, ha_rate = _within(henke, rates[1], low[1], high[1])
    return (sa, ha), (sa_rate, ha_rate)


def _within(angle: float, rate: float, low: float, high: float) -> Pair:
    """Return the angle limited to [low, high], and its rate. The rate is reduced near a limit and is zero at the limit."""
    room = max(0.0, min(angle - low, high - angle) / _STOP_FADE)
    return min(high, max(low, angle)), rate * min(1.0, room)


def level(geometry: Vector, tibia: Sequence[float] | Vector, gyro: Sequence[float] | Vector) -> tuple[Pair, Pair]:
    """Return the angles of sagittal and henke ankle (SA, HA) with which the sole is horizontal.

    If the tibia leans so far sideways that no angle of HA makes the sole horizontal, HA gets the nearest possible angle.

    Args:
        geometry: `FlatFoot.geometry`.
        tibia: attitude of the tibia IMU, unit quaternion wxyz, tibia to world; the heading has no effect.
        gyro: angular velocity of the tibia in the frame of the tibia [rad/s].

    Returns:
        Angles [rad] and their rates [rad/s], SA then HA.
    """
    c, s, ax, az = geometry[0], geometry[1], geometry[2], geometry[3]
    w, x, y, z = tibia[0], tibia[1], tibia[2], tibia[3]
    tx, ty, tz = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    p, q, r = gyro[0], gyro[1], gyro[2]
    # 1/s, time derivative of the vertical direction in the tibia frame
    txd, tyd, tzd = ty * r - tz * q, tz * p - tx * r, tx * q - ty * p
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
