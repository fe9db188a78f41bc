"""A cycle of the controller on the way, as machine code: `row (q_nom + s), state -> u, vibration, telemetry`.

    flat foot -> PID, gravity -> u_t, virtual guide -> u_v, merge with u_i and u_f -> hand-over -> u, haptics, telemetry

What each part computes, and why, is said where it is written; this is their order and what they pass on.
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

Vector = npt.NDArray[np.float64]
Table = npt.NDArray[np.void]

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)

#: What holds for a step.
STEP = np.dtype(
    [
        ("stance", np.int64),  # 0 left, 1 right
        ("completed", np.int64),  # right-stance steps before it
        ("cycles", np.int64),
        ("xi", np.float64),
        ("share", np.float64),  # w, of the baseline
        ("intensity", np.float64),  # of the haptics
        ("acting", np.float64),  # gate above which the filter counts as acting
        ("carry", np.bool_),  # the torque is to go on from the last one
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
    """Rewrite torque, vibration and telemetry.

    Args:
        cycle: since the step change.
        level: the tibia's IMU is heard, and the swing foot is to be level.
        row: q_des, q_des', shape (24,); that of the swing ankle is overwritten.
        attitudes, gyros: of the IMUs, as in `State`.
        sent: what the limits left of the last torque, shape (12,) [Nm].
        steps: shape (1,), of STEP.
        feedforward: u_f of SH and SK by cycle, meant like u_v.

    Returns:
        Of SH and SK: the larger |e| / q_bound, the smaller h, whether the filter acts on one.
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
    """Carry over what the torque would jump by at a change, and fade it out."""
    step = steps[0]
    if step["carry"]:
        for joint in range(len(torque)):
            carried[joint] = last[joint] - torque[joint]
        step["carry"] = False
    if cycle < len(blend):
        for joint in range(len(torque)):
            torque[joint] += carried[joint] * blend[cycle]
