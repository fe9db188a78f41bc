"""Compiled control cycle within a step: `row (q_nom + s), state -> u, vibration, telemetry`.

    flat foot -> PID, gravity -> u_t, virtual guide -> u_v, merge with u_i and u_f -> hand-over -> u, haptics, telemetry

This module defines the order of the parts and the data between them. Each part is documented in its own module.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_control.airwalk.telemetry import write_telemetry
from atalante_control.dynamics.gravity import hold
from atalante_control.guide.kernel import tick
from atalante_control.joint.flat_foot import put_level
from atalante_control.joint.haptics import levels
from atalante_control.joint.idealization import merge
from atalante_control.joint.pid import control
from atalante_hal.robot import IMUS, LEG_JOINTS, SIDES
from atalante_hal.types import Vector

Table = npt.NDArray[np.void]

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)

#: Record of the values that are constant during a step, and of the pending hand-over.
STEP = np.dtype(
    [
        ("stance", np.int64),  # 0 left, 1 right
        ("completed", np.int64),  # right-stance steps completed before this step
        ("cycles", np.int64),  # cycles of a step
        ("xi", np.float64),  # assistance factor
        ("share", np.float64),  # w, weight of the baseline torque
        ("intensity", np.float64),  # factor of the haptic levels
        ("acting", np.float64),  # gate above which the filter counts as active
        ("carry", np.bool_),  # true: the next torque must continue from the last one
    ]
)


def run(
    cycle: int,
    level: bool,
    row: Vector,
    q: Vector,
    qd: Vector,
    attitudes: Vector,
    gyros: Vector,
    sent: Vector,
    steps: Table,
    ankles: Table,
    cubics: Vector,
    links: Table,
    gravity: Vector,
    gains: Vector,
    integral_limit: float,
    integral: Vector,
    torque: Vector,
    feedforward: Vector,
    law: Table,
    last: Vector,
    carried: Vector,
    blend: Vector,
    vibration: Vector,
    telemetry: Table,
    joints: Table,
    flow: Vector,
    guide: Vector,
) -> tuple[float, float, bool]:
    """Compute torque, vibration and telemetry of one cycle in place.

    Args:
        cycle: cycles since the step change.
        level: whether the tibia IMU is valid and the swing sole must be level.
        row: q_des [rad], then q_des' [rad/s], shape (24,); the entries of the swing ankle are overwritten.
        q: measured angles, shape (12,) [rad].
        qd: measured speeds, shape (12,) [rad/s].
        attitudes: attitude of each IMU, as in `State`.
        gyros: angular velocity of each IMU, as in `State`.
        sent: last torque after the limiter, shape (12,) [Nm].
        steps: record of the step, shape (1,), dtype STEP; `carry` is cleared.
        ankles: `LevelFeet.ankles`.
        cubics: `LevelFeet.cubics`.
        links: `Gravity.links`, overwritten.
        gravity: u_g, shape (12,) [Nm], overwritten.
        gains: `Pid.gains`.
        integral_limit: `Pid.limit` [Nm].
        integral: `Pid.integral`, shape (12,) [Nm], updated.
        torque: PID torque of the last cycle, shape (12,) [Nm]; overwritten with the torque command u.
        feedforward: u_f of SH and SK for each cycle, shape (n, 2) [Nm], on the same inertias as u_v.
        law: parameters of `idealization.merge`.
        last: torque at the step change, shape (12,) [Nm].
        carried: torque carried over the step change, shape (12,) [Nm].
        blend: factor of `carried` for each cycle, from 1 to 0.
        vibration: levels of the motors, shape (8,), overwritten.
        telemetry: telemetry of the cycle, shape (1,), dtype TELEMETRY, overwritten.
        joints: `GuideFilter.joints`, updated.
        flow: `GuideFilter.flow`.
        guide: `GuideFilter.step`.

    Returns:
        The larger |e| / q_bound of SH and SK, the smaller h of the two, and whether the filter is active on either.
    """
    step = steps[0]
    swing, w = 1 - step["stance"], step["share"]
    leg = swing * len(LEG_JOINTS)
    hip, knee, n = leg + _SH, leg + _SK, len(q)
    if level:
        put_level(row, ankles, swing, cubics, cycle, attitudes[_TIBIAE[swing]], gyros[_TIBIAE[swing]])
    pelvis = attitudes[_PELVIS]
    hold(links, q, pelvis[0], pelvis[1], pelvis[2], pelvis[3], gravity)
    control(row, q, qd, gains, integral_limit, sent, integral, torque)
    for joint in range(n):
        torque[joint] += gravity[joint]
    errors = q[hip] - row[hip], q[knee] - row[knee]
    u_v = tick(joints, flow, guide, cycle, errors[0], qd[hip] - row[n + hip], errors[1], qd[knee] - row[n + knee])
    if w < 1.0:
        u = u_v[0] + feedforward[cycle, 0], u_v[1] + feedforward[cycle, 1]
        merge(law, torque, gravity, q, qd, leg, w, u)
    hand_over(steps, cycle, torque, last, carried, blend)
    phase = cycle / step["cycles"]
    bounds, ratio, h, acting = write_telemetry(
        telemetry, row, joints, errors, step["acting"], step["completed"], phase, step["stance"], step["xi"]
    )
    levels(swing, errors, bounds, step["intensity"], vibration)
    return ratio, h, acting


def hand_over(steps: Table, cycle: int, torque: Vector, last: Vector, carried: Vector, blend: Vector) -> None:
    """Carry the torque step at a change over and fade it out, so that the command is continuous.

    Args:
        steps: record of the step, shape (1,), dtype STEP; `carry` is cleared.
        cycle: cycles since the change.
        torque: torque command, shape (12,) [Nm], updated.
        last: torque before the change, shape (12,) [Nm].
        carried: torque carried over the change, shape (12,) [Nm], set at the change.
        blend: factor of `carried` for each cycle, from 1 to 0.
    """
    step = steps[0]
    if step["carry"]:
        for joint in range(len(torque)):
            carried[joint] = last[joint] - torque[joint]
        step["carry"] = False
    if cycle < len(blend):
        for joint in range(len(torque)):
            torque[joint] += carried[joint] * blend[cycle]
