"""Tables of the desired motion in one phase of the walk, with one row for each control cycle.

`gait or weight shift -> desired motion, feedforward, DCM`

The divergent component of motion (DCM) is c + c' / w, with the horizontal position c of the centre of mass and
w = sqrt(g / height). In a step the DCM is relative to the centre of the stance sole. While standing the DCM is relative to the
middle between both soles. The axes are the axes of the walking frame: x forward, y left, without the toe-out of the feet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from atalante_control.gait.gait import Gait, bezier, derivative
from atalante_control.gait.recentering import Deadbeat
from atalante_control.joint.flat_foot import recentring_rows
from atalante_control.joint.pid import RIGHT
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.rotation import about_z
from atalante_control.walking.standing import Shift
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import GRAVITY, PERIOD, Vector
from atalante_hal.vectors import cross

_LEG = len(LEG_JOINTS)
_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")


class PhaseTable(NamedTuple):
    """Desired motion of one phase with n cycles. After the last cycle, the last row is held.

    At the start of a phase, the joints deviate from the first row of the table by the angle d and the speed v. The re-centring
    fades out this deviation: it adds c0 d + c1 v to q_nom, and c0' d + c1' v to q_nom'. c0 and c1 are cubic polynomials of time,
    c0' and c1' are their time derivatives.

    A late swing foot has not landed at the end of the table. The fields from `reach` on define how a late swing foot moves down.
    """

    rows: Vector  # (n + 1, 24) q_nom [rad], then q_nom' [rad/s]
    feedforward: Vector  # (n + 1, 12) Nm, u_f
    dcm: Vector  # (n + 1, 2) m, nominal DCM
    #: (n + 1, 3) m, nominal position of the swing ankle relative to the centre of the stance sole, in the walking frame
    ankle: Vector
    frequency: float  # rad/s, natural frequency w of the pendulum
    recentring: Vector  # (m, 4) re-centring polynomials c0, c1, c0', c1' for all joints without a guide; row: cycle
    guided: Vector  # (m, 4) re-centring polynomials c0, c1, c0', c1' for hip and knee with a guide; row: cycle
    reach: Vector  # (2,) rad/s, speeds of sagittal hip and knee of the swing leg that move a late swing foot down
    lowering: float  # m/s, downward speed of a late swing foot that results from the joint speeds `reach`
    #: After the end of the table, hip and knee move with the speeds in `reach` for at most `reach_cycles` cycles.
    #: In these cycles, the desired knee angle does not fall below `Reach.knee`.
    reach_cycles: int
    #: Number of cycles after the end of the table in which foot placement lowers a late swing foot after a push.
    #: Unlike `reach_cycles`, `lowering_cycles` does not depend on the knee angle.
    lowering_cycles: int


class Reach(NamedTuple):
    """Downward motion of a swing foot that has not landed at the nominal end of a step."""

    speed: float  # m/s, downward speed of the foot
    rate: float  # rad/s, largest speed of sagittal hip and knee; if necessary, the foot moves more slowly than `speed`
    time: float  # s, longest duration of the downward motion
    knee: float  # rad, smallest knee angle during the downward motion


def step_table(
    gait: Gait, stance: int, alphas: tuple[float, float], reach: Reach, kinematics: Kinematics, toe_out: float
) -> PhaseTable:
    """Sample the desired motion of a step in every cycle.

    Args:
        gait: right-stance step.
        stance: stance leg, LEFT or RIGHT; for LEFT the mirrored step is sampled.
        alphas: two ends of the re-centring, as fractions of the step duration: for the joints without a guide, and for
            the joints that a guide can assist.
        reach: downward motion of the swing foot after the last cycle.
        kinematics: kinematics of the robot with the patient.
        toe_out: toe-out of the left foot, positive to the left [rad].
    """
    table = (gait if stance == RIGHT else gait.mirrored()).tables()
    yaw = -toe_out if stance == RIGHT else toe_out
    centre, speed, ankle = np.zeros((3, gait.cycles + 1, 3))
    heading, upright = about_z(yaw), about_z(0.0)
    # The array views are created once, before the loop: creating a view takes longer than the computation of one cycle.
    sole, body = kinematics.chain.soles[stance], kinematics.chain.centre[0]
    rotation, position, linear, angular = sole.rotation, sole.position, sole.linear, sole.angular
    body_position, body_velocity = body.position, body.velocity
    joint = kinematics.chain.links[kinematics.chain.soles[1 - stance].link - 1].origin
    for cycle, (q, qd) in enumerate(zip(table.q, table.qd, strict=True)):
        kinematics.update(q, qd)
        upright = _product(heading, rotation.T)  # rotation from pelvis to walking frame
        lever = body_position - position
        # The sole rests on the ground, so the centre of mass has the same velocity relative to the sole as in the world.
        relative = body_velocity - linear - np.array(cross(angular, lever))
        centre[cycle], speed[cycle] = upright @ lever, upright @ relative
        ankle[cycle] = upright @ (joint - position)
    frequency = math.sqrt(GRAVITY / float(centre[:, 2].mean()))
    swing = 1 - stance
    rates = reach.speed * _reach(table.q[-1], swing, kinematics, upright)
    slower = min(1.0, reach.rate / float(np.abs(rates).max()))
    rates *= slower
    bend = float(table.q[-1, swing * _LEG + _SK]) - reach.knee
    time = min(reach.time, max(0.0, bend) / abs(float(rates[1])))
    rows = np.hstack([table.q, table.qd])
    recentring, guided = (recentring_rows(Deadbeat(gait.duration, alpha), len(rows)) for alpha in alphas)
    dcm = (centre + speed / frequency)[:, :2].copy()
    return PhaseTable(
        rows,
        table.uf.copy(),
        dcm,
        ankle,
        frequency,
        recentring,
        guided,
        rates,
        slower * reach.speed,
        round(time / PERIOD),
        round(reach.time / PERIOD),
    )


def shift_tables(shift: Shift, duration: float, alpha: float) -> tuple[PhaseTable, PhaseTable]:
    """Sample a weight shift from the middle between the feet onto one foot, and the weight shift back.

    Args:
        shift: weight shift.
        duration: duration of each weight shift [s].
        alpha: end of the re-centring, as a fraction of the duration.
    """
    recentring = recentring_rows(Deadbeat(duration, alpha), round(duration / PERIOD))
    x: Vector = np.arange(round(duration / PERIOD) + 1, dtype=np.float64) * (PERIOD / duration)
    path = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    pace = 30.0 * x * x * (1.0 - x) ** 2 / duration
    tables = []
    for part, speed in ((path, pace), (path[::-1], -pace[::-1])):
        q, centre = bezier(shift.q, part), bezier(shift.centre, part)
        qd = bezier(derivative(shift.q), part) * speed[:, None]
        velocity = bezier(derivative(shift.centre), part) * speed[:, None]
        frequency = math.sqrt(GRAVITY / float(centre[:, 2].mean()))
        dcm = (centre + velocity / frequency)[:, :2].copy()
        feedforward = np.ascontiguousarray(bezier(shift.feedforward, part))
        rows = np.hstack([q, qd])
        ankle = np.zeros((len(rows), 3))
        tables.append(
            PhaseTable(rows, feedforward, dcm, ankle, frequency, recentring, recentring, np.zeros(2), 0.0, 0, 0)
        )
    return tables[0], tables[1]


def _product(a: Vector, b: Vector) -> Vector:
    return np.asarray(a @ b)


def _reach(q: Vector, swing: int, kinematics: Kinematics, upright: Vector) -> Vector:
    """Return the angles of hip and knee per metre of vertical downward motion of the swing foot, shape (2,) [rad/m]."""
    columns = []
    for joint in (_SH, _SK):
        rate = np.zeros(len(q))
        rate[swing * _LEG + joint] = 1.0
        columns.append((upright @ kinematics.update(q, rate).soles[swing].linear)[[0, 2]])
    return np.asarray(np.linalg.solve(np.array(columns).T, [0.0, -1.0]))
