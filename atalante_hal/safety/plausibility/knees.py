"""Knee checks, which compare the knee encoders with the accelerometers of pelvis and tibiae.

The sagittal hip SH and the sagittal knee SK affect the attitude of the tibia only by their sum. So the module `legs` does not
detect a drift of SK with an opposite drift of SH. Such drifts turn the computed thigh, so they change the computed position `r`
of the tibia IMU relative to the pelvis IMU. An error `e` of the knee angle changes `r` by `lever * e`, so the true position is
`r - lever * e`. The difference of the accelerometers of tibia and pelvis, in world axes, is the second derivative of the true
position, because gravity cancels:

    difference of the accelerometers = second derivative of (r - lever * e), with lever = derivative of r with respect to SK

Integration and a high-pass of third order give the measured position (from the accelerometers) and the computed position in
metres, without the constant errors of accelerometers and attitudes. The heading of the tibia IMU drifts relative to the pelvis
IMU, so its attitude is corrected by the estimate of the module `legs`. A tibia IMU that is mounted askew about y by the angle a
turns the computed thigh and shank by a, which looks like an error of the knee angle of about 2 a. So the computed position uses
an attitude of the tibia from which the angle a is removed, as the module `legs` has measured it. A regression over about a
second explains the difference of the two positions by two unknowns: the error of the knee angle, and the deviation of the
segment lengths from their mean value `SEGMENT`, because both segments are adjusted to the patient.

The check needs a thigh that turns, so it cannot decide while the robot stands. It decides in each walk, also in the air. If the
error of the knee angle explains only a small part of the difference, the cause is not the encoder, but for example a faulty
accelerometer. Then nothing is reported here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.inertial import to_world, turned_about_vertical
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.safety.plausibility.support import SEGMENT
from atalante_hal.types import Vector
from atalante_hal.vectors import Vector3

#: Position (x, y, z) of the pelvis IMU in the pelvis frame [m].
PELVIS_IMU = (-0.164, -0.015, 0.191)
#: Position y of joint FH of the left leg in the pelvis frame [m]. Its x and z are 0.
FRONTAL_HIP = 0.089
#: Position (x, y) of joint TH of the left leg relative to joint FH, in the axes of the frontal hip [m].
#: Joint SH lies 0.135 m in front of joint TH, along the axis x of the transverse hip.
#: This distance equals `-TRANSVERSE_HIP[0]`. So `motion` uses `TRANSVERSE_HIP[0]` for the offsets of both joints.
TRANSVERSE_HIP = (-0.135, 0.169)
#: Position (x, y, z) of the left tibia IMU in the axes of the tibia [m].
#: Each coordinate has its own origin: x is relative to joint SK, y to joint SH, and z to joint SA.
TIBIA_IMU = (-0.13, -0.069, 0.018)
#: Time constant of the low-passes [s]. Two low-passes in a row replace the double integration of an acceleration.
#: A high-pass is the input minus a low-pass.
_FILTER_TIME = 0.15
#: Time constant of the mean values `Filters.moments` [s].
_MEAN_TIME = 0.75
#: Time that the filters need to settle after the start [s]. `Filters.moments` is updated only after this time.
_SETTLING_TIME = 2.0
#: Rms of u in `knee_error` above which the thigh turns enough to compute an error of the knee angle [m/rad].
#: u in `knee_error` is the filtered motion of the tibia IMU per radian of knee error. In a walk, its rms is about 0.012 m/rad.
_LEAST_LEVER = 0.007
#: Share of the mean square of v in `knee_error` that an error of a knee angle must explain, so that the error is reported.
#: v in `knee_error` is the filtered difference between the measured and the computed position of the tibia IMU.
#: The part of the difference that is due to wrong segment lengths is already subtracted from v.
_SHARE = 0.25
#: Number of low-passes for each axis of a leg.
_FILTERS = 11
_PELVIS = IMUS.index("pelvis")
_TIBIA = IMUS.index("left_tibia")
_FH, _TH, _SK = (JOINTS.index(f"left_{joint}") for joint in ("FH", "TH", "SK"))
#: Indices in JOINTS and in IMUS of the sensors that the check needs.
KNEE_JOINTS = [JOINTS.index(f"{side}_{joint}") for side in SIDES for joint in ("FH", "TH", "SK")]
KNEE_IMUS = [_PELVIS, *(IMUS.index(f"{side}_tibia") for side in SIDES)]


class Readings(NamedTuple):
    """Signals from which the check computes the motion of both legs."""

    position: Vector  # (12,) rad, on the motor side
    to_joint: Vector  # (12,) factor from motor side to joint side
    quaternion: Vector  # (4, 4) wxyz, sensor to world
    accel: Vector  # (4, 3) m/s2
    heading: Vector  # (2, 2) correction of the heading of both tibiae, see `Legs.heading`
    tilt: Vector  # (2, 2) correction of the mounting of both tibia IMUs, see `Legs.tilt`


class Filters(NamedTuple):
    """Values of the filters of both legs.

    The moments of a leg are the running means of the products ss, sg, gg, sd, gd and dd, each summed over three axes. The factors
    are filtered values:

    - s is the lever [m/rad]: derivative of the tibia IMU's position with respect to the knee angle SK.
    - g is the growth [m/m]: derivative of the tibia IMU's position if thigh and shank become longer by the same length.
    - d is the difference [m]: measured minus computed position of the tibia IMU.
    """

    low: Vector  # (2, 33) outputs of the low-passes: one row per leg, with `_FILTERS` low-passes for each of three axes
    time: Vector  # (1,) time since the start, up to `_SETTLING_TIME` [s]
    moments: Vector  # (2, 6) running means of the products ss, sg, gg, sd, gd and dd: one row per leg


class Knees:
    """Checks of both knee encoders.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        heading: correction of the heading of both tibiae, shape (2, 2), see `Legs.heading`.
        tilt: correction of the mounting of both tibia IMUs, shape (2, 2), see `Legs.tilt`.
        period: cycle time [s].
    """

    def __init__(self, robot: Robot, now: Signals, heading: Vector, tilt: Vector, period: float) -> None:
        legs = len(SIDES)
        self._filters = Filters(np.zeros((legs, 3 * _FILTERS)), np.zeros(1), np.zeros((legs, 6)))
        self._error = np.zeros(legs)
        #: Arguments of the function `follow`. The array objects are the same in every call.
        self._arguments = (
            Readings(now.position, robot.polarity / robot.gear, now.quaternion, now.accel, heading, tilt),
            self._filters, self._error,
            2.0 * robot.sensors.attitude_error, period,
        )  # fmt: skip
        self._follow = specialised(follow, *self._arguments)
        self.restart()
        self._found: dict[int, Finding] = {}

    def restart(self) -> None:
        """Restart the filters."""
        for values in self._filters:
            values.fill(0.0)

    def reference(self, leg: int) -> None:
        """Discard the finding of a leg. Call it when the drive of joint SH or SK has restarted.

        A restarted drive references its encoder again, so the old finding no longer applies.

        Args:
            leg: index of the leg in SIDES.
        """
        self._error[leg] = 0.0
        self._found.pop(leg, None)
        self.restart()

    def follow(self) -> bool:
        """Update the filters and the findings by one cycle.

        Returns:
            Whether the findings have changed.
        """
        if not self._follow(*self._arguments) and not self._found:
            return False
        found = {
            leg: self._found.get(leg) or _drift(leg, error) for leg, error in enumerate(self._error.tolist()) if error
        }
        changed = found.keys() != self._found.keys()
        self._found = found
        return changed

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the knee checks."""
        return tuple(self._found.values())


def follow(now: Readings, filters: Filters, error: Vector, limit: float, period: float) -> bool:
    """Update the filters by one cycle, and compute the errors of both knee angles.

    Args:
        now: signals of the cycle.
        filters: values of the filters. Updated here.
        error: output, shape (2,) [rad]: error of each knee angle if this error exceeds the limit, otherwise 0. An element keeps
            its value while the thigh does not turn.
        limit: largest error of a knee angle [rad].
        period: cycle time [s].

    Returns:
        Whether an error exceeds the limit.
    """
    settled = filters.time[0] >= _SETTLING_TIME
    # In the first cycle, the filters begin with the values of this cycle.
    share = period / _FILTER_TIME if filters.time[0] > 0.0 else 1.0
    for leg in range(len(error)):
        products = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        position, lever, growth, accel = motion(leg, now)
        low = filters.low[leg]
        for axis in range(3):
            first = _FILTERS * axis
            moved = low_pass(low, first, share, low_pass(low, first + 1, share, accel[axis])) * _FILTER_TIME**2
            computed = high_pass(low, first + 2, share, high_pass(low, first + 3, share, position[axis]))
            d = high_pass(low, first + 4, share, moved - computed)
            s, g = high_pass_3(low, first + 5, share, lever[axis]), high_pass_3(low, first + 8, share, growth[axis])
            ss, sg, gg, sd, gd, dd = products
            products = ss + s * s, sg + s * g, gg + g * g, sd + s * d, gd + g * d, dd + d * d
        if settled:
            for i in range(len(products)):
                filters.moments[leg, i] += period / _MEAN_TIME * (products[i] - filters.moments[leg, i])
            error[leg] = knee_error(filters.moments[leg], limit, error[leg])
    if not settled:
        filters.time[0] += period
    return bool(error[0] != 0.0 or error[1] != 0.0)


def knee_error(moments: Vector, limit: float, before: float) -> float:
    """Return the error of a knee angle if it exceeds the limit, otherwise 0 [rad].

    An error e of the knee angle causes the position difference d = -e * s, with the lever s (see `Filters`). A wrong segment
    length causes a position difference proportional to the growth g. Therefore the parts of s and d that are proportional to g
    are first subtracted (least squares; sg is the mean of s * g):

        u = s - g * sg / gg
        v = d - g * gd / gg

    Then the error is e = -uv / uu, with the mean uv of u * v and the mean uu of u * u. The error explains the share
    uv^2 / (uu * vv) of the mean square vv.

    Args:
        moments: mean products ss, sg, gg, sd, gd and dd, see `Filters`, shape (6,).
        limit: largest error [rad].
        before: last result, which is returned if the thigh does not turn [rad].
    """
    ss, sg, gg, sd, gd, dd = moments[0], moments[1], moments[2], moments[3], moments[4], moments[5]
    # uu, uv and vv are gg times the means of u * u, u * v and v * v (see the docstring). The factor gg avoids divisions.
    uu, uv, vv = ss * gg - sg * sg, sd * gg - sg * gd, dd * gg - gd * gd
    if uu <= _LEAST_LEVER**2 * gg:
        return before
    error = -uv / uu
    return float(error) if abs(error) > limit and uv**2 > _SHARE * uu * vv else 0.0


def motion(leg: int, now: Readings) -> tuple[Vector3, Vector3, Vector3, Vector3]:
    """Return the motion of a tibia IMU relative to the pelvis IMU, in world axes.

    Args:
        leg: index in SIDES.
        now: signals of the cycle.

    Returns:
        Position [m], lever [m/rad] and growth [m/m] (see `Filters`), and specific force at the tibia IMU minus specific force at
        the pelvis IMU [m/s2].
    """
    first, side, tibia = len(LEG_JOINTS) * leg, 1.0 - 2.0 * leg, _TIBIA + leg
    fh = now.position[first + _FH] * now.to_joint[first + _FH]
    th = now.position[first + _TH] * now.to_joint[first + _TH]
    sk = now.position[first + _SK] * now.to_joint[first + _SK]
    # `hip` is the vector from the pelvis IMU to joint SH, in the axes of the pelvis.
    x, y = TRANSVERSE_HIP[0] * (1.0 - math.cos(th)), side * TRANSVERSE_HIP[1] - TRANSVERSE_HIP[0] * math.sin(th)
    y, z = y * math.cos(fh) + side * FRONTAL_HIP, y * math.sin(fh)
    hip = x - PELVIS_IMU[0], y - PELVIS_IMU[1], z - PELVIS_IMU[2]
    # `hip_to_imu` is the vector from joint SH to the tibia IMU, in the axes of the tibia.
    # (x, z) is the sum of two unit vectors: (sine, -cosine) from hip to knee, and (0, -1) from knee to ankle.
    sine, cosine = math.sin(sk), math.cos(sk)
    x, z = sine, -1.0 - cosine
    hip_to_imu = SEGMENT * x + TIBIA_IMU[0], side * TIBIA_IMU[1], SEGMENT * z + TIBIA_IMU[2]
    pelvis, shank = now.quaternion[_PELVIS], turned_about_vertical(now.quaternion[tibia], now.heading[leg])
    w, i, j, k = shank
    c, s = now.tilt[leg, 0], now.tilt[leg, 1]
    leg_axes = c * w - s * j, c * i - s * k, c * j + s * w, c * k + s * i
    hx, hy, hz = to_world(pelvis, hip)
    tx, ty, tz = to_world(leg_axes, hip_to_imu)
    px, py, pz = to_world(pelvis, now.accel[_PELVIS])
    sx, sy, sz = to_world(shank, now.accel[tibia])
    lever, growth = to_world(leg_axes, (SEGMENT * cosine, 0.0, SEGMENT * sine)), to_world(leg_axes, (x, 0.0, z))
    return (hx + tx, hy + ty, hz + tz), lever, growth, (sx - px, sy - py, sz - pz)


def low_pass(low: Vector, index: int, share: float, value: float) -> float:
    """Update a low-pass of first order, and return its output.

    Args:
        low: outputs of all low-passes, shape (33,). Updated here.
        index: index of the low-pass in `low`.
        share: period divided by the time constant.
        value: new input.
    """
    low[index] += share * (value - low[index])
    return float(low[index])


def high_pass(low: Vector, index: int, share: float, value: float) -> float:
    """Update a high-pass of first order, and return its output: the input minus the output of `low_pass`."""
    return value - low_pass(low, index, share, value)


def high_pass_3(low: Vector, index: int, share: float, value: float) -> float:
    """Update a high-pass of third order, which is three times `high_pass` in a row, and return its output."""
    return high_pass(low, index, share, high_pass(low, index + 1, share, high_pass(low, index + 2, share, value)))


def _drift(leg: int, error: float) -> Finding:
    joint = JOINTS.index(f"{SIDES[leg]}_SK")
    text = f"encoder of {JOINTS[joint]}: its angle differs by {math.degrees(error):+.1f} degrees from"
    return Finding(
        Dtc.ENC_DRIFT, JOINT_NODES[joint], error, True, f"{text} the accelerometers of pelvis and {SIDES[leg]} tibia"
    )
