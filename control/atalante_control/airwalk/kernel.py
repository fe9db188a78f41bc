"""Compiled control cycle within a step: `q_des, measurements -> torque command u, vibration levels, telemetry`.

    flat foot -> PID, gravity -> u_t, virtual guide -> torques of SH and SK -> carry-over -> u, haptics, telemetry

This module defines the order of the parts and the data between them. Each part is documented in its own module.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from atalante_control.airwalk.carry_over import Carry, add_carried
from atalante_control.airwalk.telemetry import Step, Telemetry, write_telemetry
from atalante_control.dynamics.gravity import LinkRecord, hold
from atalante_control.guide.kernel import GuideTables, leg_state, tick
from atalante_control.guide.literal import LiteralTables, assistive_torque
from atalante_control.joint.flat_foot import Ankle, write_level_ankle
from atalante_control.joint.haptics import levels
from atalante_control.joint.pid import PidRecord, control
from atalante_control.structured import Records
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, MOTORS, SIDES
from atalante_hal.types import Vector

_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)


class Measured(NamedTuple):
    """Measurements of this cycle, and torque command of the previous cycle."""

    q: Vector  # (12,) rad, joint angles
    qd: Vector  # (12,) rad/s, joint speeds
    attitudes: Vector  # (4, 4) attitude of each IMU, unit quaternion wxyz, sensor frame to world
    gyros: Vector  # (4, 3) rad/s, angular velocity of each IMU in the frame of the same IMU
    sent: Vector  # (12,) Nm, torque command of the previous cycle after the limiter


class Parts(NamedTuple):
    """Arrays of the controller parts. `run` reads and updates them. Each part allocates the arrays that it owns."""

    steps: Records[Step]  # (1,) values of the step
    links: Records[LinkRecord]  # (n,) links of the exoskeleton, see `Gravity.links`
    pids: Records[PidRecord]  # (1,) gains and integral torques of the PIDs, see `Pid.records`
    ankles: Records[Ankle]  # (2,) left and right ankle, see `LevelFeet.ankles`
    #: (n, 4) row i: basis cubics c0 and c1 of the re-centring and their derivatives c0' and c1' in cycle i of a step.
    #: With c0 and c1, the ankle deviations at the stance change fade out, see `LevelFeet.cubics`.
    cubics: Vector
    literal: LiteralTables  # tables of the control law as printed in the paper, see `LiteralGuide.tables`
    carries: Records[Carry]  # (1,) state of the carry-over, see `CarryOver.records`
    #: (2, n) column i: fractions of `Carry.carried` that are added in cycle i after a stance change, see `CarryOver.blends`.
    blends: Vector
    outputs: Records[Outputs]  # (1,) results of the cycle
    telemetry: Records[Telemetry]  # (1,) telemetry of the cycle


class Outputs:
    """Results of one control cycle."""

    desired: Annotated[Vector, 2 * len(JOINTS)]  # q_des [rad], then q_des' [rad/s]
    gravity: Annotated[Vector, len(JOINTS)]  # Nm, gravity torques u_g
    torque: Annotated[Vector, len(JOINTS)]  # Nm, torque command u
    vibration: Annotated[Vector, len(MOTORS)]  # levels of the vibration motors, 0 to 1


def run(
    cycle: int, level: bool, row: Vector, measured: Measured, guide: GuideTables, parts: Parts
) -> tuple[float, float, bool]:
    """Compute torque, vibration and telemetry of one cycle.

    Args:
        cycle: number of cycles since the stance change.
        level: whether the targets of the swing ankle come from the tibia IMU. If not, the targets come from `row`.
        row: q_des [rad], then q_des' [rad/s], shape (24,).
        measured: measurements of the cycle.
        guide: tables of the guide filter of this step.
        parts: arrays of the other parts; updated, and the results are written to `outputs` and `telemetry`.

    Returns:
        Three values: the larger of the ratios |e| / q_bound of SH and SK, then h, then whether the guide filter is active.
    """
    step, outputs = parts.steps[0], parts.outputs[0]
    q, qd, attitudes, gyros, sent = measured
    desired, gravity, torque = outputs.desired, outputs.gravity, outputs.torque
    swing, n = 1 - step.stance, len(q)
    leg = swing * len(LEG_JOINTS)
    hip, knee = leg + _SH, leg + _SK

    # Element by element: numba would allocate a temporary array for `desired[:] = row`, because the arrays could overlap.
    for k in range(len(desired)):
        desired[k] = row[k]
    if level:
        tibia = _TIBIAE[swing]
        write_level_ankle(parts.ankles[swing], parts.cubics, cycle, attitudes[tibia], gyros[tibia], desired)
    pelvis = attitudes[_PELVIS]
    hold(parts.links, q, (pelvis[0], pelvis[1], pelvis[2], pelvis[3]), gravity)
    control(parts.pids, desired, q, qd, sent, torque)

    motion = leg_state(hip, q, qd, desired, sent, (gravity[hip], gravity[knee]))
    if step.literal:
        assisted = assistive_torque(
            parts.literal, guide.guards[0], cycle, motion, (desired[n + hip], desired[n + knee])
        )
    else:
        assisted = tick(guide, cycle, motion)
        for joint in range(n):
            torque[joint] += gravity[joint]
    if step.assisted:
        torque[hip], torque[knee] = assisted
    add_carried(parts.carries, parts.blends, cycle, torque)
    requested = parts.pids[0].requested
    for joint in range(len(requested)):
        requested[joint] = torque[joint]

    errors = q[hip] - desired[hip], q[knee] - desired[knee]
    bounds, ratio, active = write_telemetry(parts.telemetry, step, guide.guards[0], cycle, desired, errors)
    levels(swing, errors, bounds, step.intensity, outputs.vibration)
    return ratio, guide.guards[0].h, active
