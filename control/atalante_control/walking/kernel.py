"""Compiled control cycle of the walk: `sense` evaluates the measurements, `act` computes the torque command u.

    sense: foot forces -> loads; joints -> kinematics; gyro, accelerometer, sole at rest -> attitude; all -> headings
    act:   all -> DCM; q_nom + s, steering, lowering of the swing foot, flat foot -> q_des
           q_des -> PID, gravity, feedforward, ankle stabiliser, guide -> u

DCM is the divergent component of motion (`walking.dcm`). The controller calls `sense`, selects the phase, and calls `act`. Each
part is documented in its own module.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from atalante_control.dynamics.gravity import LinkRecord, hold
from atalante_control.guide.kernel import GuideTables, leg_state, tick
from atalante_control.guide.literal import LiteralTables, assistive_torque
from atalante_control.joint.flat_foot import Ankle, start_level_ankle, write_level_ankle
from atalante_control.joint.haptics import levels
from atalante_control.joint.pid import PidRecord, control
from atalante_control.structured import Records
from atalante_control.walking.attitude import Attitude, observe
from atalante_control.walking.dcm import Balance, Stabiliser, ankle_torques, dcm, pressure_shift, within_sole
from atalante_control.walking.kinematics import FOOT_TO_TIBIA, Chain, move
from atalante_control.walking.lean import Lean, LeanConfig, follow_lean, lean_target, leg_target
from atalante_control.walking.placement import (
    Motion,
    Placement,
    PlacementConfig,
    ankle_position,
    follow,
    landing,
    late_landing,
    shift_foot,
)
from atalante_control.walking.reference import PhaseTable
from atalante_control.walking.rotation import tilt_quaternion
from atalante_control.walking.telemetry import Telemetry, write_guide, write_telemetry
from atalante_hal.robot import CELLS, JOINTS, LEG_JOINTS, MOTORS, SIDES
from atalante_hal.types import PERIOD, Vector
from atalante_hal.vectors import Vector3, cross, rotated

_LEG = len(LEG_JOINTS)
_FH, _TH, _SH, _SK, _SA, _HA = (LEG_JOINTS.index(name) for name in ("FH", "TH", "SH", "SK", "SA", "HA"))
_ANKLES = (_SA, _HA)
_FL, _FR, _RL, _RR = (CELLS.index(name) for name in ("FL", "FR", "RL", "RR"))
#: Values of `Stage.gyro_source`, the source of the angular velocity of the pelvis. TRUNK: IMU of the pelvis or the torso.
#: TIBIA: tibia IMU and joint speeds of the leg whose sole is at rest. SOLE: joint speeds of this leg only.
TRUNK, TIBIA, SOLE = range(3)
#: s, time constant with which a swing foot accelerates downwards if it has not landed at the nominal end of the step
_REACH_RISE = 0.03

Quaternion = tuple[float, float, float, float]


class Measured(NamedTuple):
    """Measurements of this cycle, and torque command of the previous cycle."""

    q: Vector  # (12,) rad, joint angles
    qd: Vector  # (12,) rad/s, joint speeds
    imu: Vector  # (3,) m, position of the IMU in the pelvis frame; the axes of IMU and pelvis are parallel
    #: (3,) rad/s, angular velocity of the IMU in the axes of the IMU. `sense` writes it if `Stage.gyro_source` is not `TRUNK`.
    gyro: Vector
    accel: Vector  # (3,) m/s2, specific force at the IMU in the axes of the IMU
    force: Vector  # (2, 4, 3) N, force at each force cell in the foot frame; axes of the array: foot, cell, x/y/z
    sent: Vector  # (12,) Nm, torque command of the previous cycle after the limiter
    tibiae: Vector  # (2, 3) rad/s, angular velocities of the left and the right tibia IMU, in the axes of the IMU


class Stage:
    """Data of the current phase, written by the controller at the start of the phase."""

    stance: int  # stance leg, 0 left, 1 right
    double: bool  # True: no foot swings, because both feet are on the ground or the robot is suspended
    steering: float  # rad, steering: offset of the transverse hip of the swing leg at the end of the step
    #: rad, joint angles at the start of the phase minus the angles in the first row of the phase table
    deviation: Annotated[Vector, len(JOINTS)]
    #: rad/s, joint speeds at the start of the phase minus the speeds in the first row of the phase table
    rate: Annotated[Vector, len(JOINTS)]
    placed: bool  # True: foot placement and step timing react to pushes in this phase
    literal: bool  # True: joints without a guide get only PID torques, as in the paper, see `WalkConfig.literal`
    flat: bool  # True: the sole of the swing foot is held horizontal
    #: True: the virtual guide drives sagittal hip and knee of the swing leg, so the patient can move them within bounds.
    #: False: the baseline controller (PID) drives all joints, for example at assistance factor 1 or in the start step.
    assisted: bool
    #: Last cycle in which the guide acts: the nominal end of the step, or earlier if the loop is too slow.
    last_guided: int
    intensity: float  # factor from 0 (off) to 1 on the levels of the vibration motors
    #: Nm, torque of the virtual guide minus torque of the baseline controller, in the last cycle with the guide.
    #: Elements: sagittal hip and knee of the swing leg.
    excess: Annotated[Vector, 2]
    #: Source of the angular velocity of the pelvis: `TRUNK`, `TIBIA` or `SOLE`. It may change in every cycle.
    gyro_source: int


class Sensed:
    """Results of the first half of a cycle, `sense`: loads, kinematics, attitude."""

    load: Annotated[Vector, 2]  # N, filtered vertical force on the left and the right foot
    #: N, the smaller of filtered and unfiltered vertical force on each foot.
    #: When a foot leaves the ground, this force drops without the delay of the filter.
    bearing: Annotated[Vector, 2]
    #: N, filtered difference FL - FR - RL + RR of the force cells of each foot (front left, front right, rear left, rear right).
    #: With four correct cells, the difference is 0. `contact_force` uses the difference to detect a wrong cell.
    twist: Annotated[Vector, 2]
    heading: Annotated[Vector, 2]  # rad, yaw angle of each foot in the world, minus the toe-out of the foot
    step: Annotated[Vector, 3]  # m, position of the right sole relative to the left sole, world axes


class Constants(NamedTuple):
    """Constants of the kernel."""

    weight: float  # N, weight of robot and patient
    keep: float  # coefficient of the previous value in the low-pass of the foot forces, 0 to 1
    standing_gains: float  # N, while standing: smallest load on a foot with which its leg has the full stance gains
    walking_gains: float  # N, in a step: smallest load with which the stance ankle has the full stance gains
    gains: Vector  # (2, 3, 12) gains of swing leg and stance leg: Kp [Nm/rad], Kd [Nm s/rad], Ki times the cycle time [Nm/rad]
    placement: PlacementConfig  # parameters of foot placement and step timing
    lean: LeanConfig  # parameters of the lean


class Assistance(NamedTuple):
    """Virtual guide that drives sagittal hip and knee of the swing leg in the current step."""

    guide: GuideTables  # tables of the guide filter (`GuideFilter.tables`)
    literal: LiteralTables  # tables of the guide law of the paper (`LiteralGuide.tables`), used if `Stage.literal`
    #: (n + 1, 2) Nm, torques of hip and knee that carry the patient's leg and compensate the pelvis motion. Row: cycle.
    #: `_assist` adds these torques to the gravity torques of the exoskeleton, unless `Stage.literal` is True.
    unmodelled: Vector
    #: (m,) weights from 1 to 0 that fade out `Stage.excess`. Row k: k cycles after the last cycle with the guide.
    fade: Vector


class Parts(NamedTuple):
    """Arrays of the controller parts. The kernels read and update them. Each part allocates the arrays that it owns."""

    chain: Chain  # `Kinematics.chain`
    attitudes: Records[Attitude]  # (1,) state of the attitude observer
    links: Records[LinkRecord]  # (n,) `Gravity.links`
    pids: Records[PidRecord]  # (1,) `Pid.records`
    ankles: Records[Ankle]  # (2,) `ankle_records`
    stages: Records[Stage]  # (1,)
    sensed: Records[Sensed]  # (1,)
    balances: Records[Balance]  # (1,)
    placements: Records[Placement]  # (1,)
    leans: Records[Lean]  # (1,)
    outputs: Records[Outputs]  # (1,) results
    telemetry: Records[Telemetry]  # (1,) telemetry of the cycle


class Outputs:
    """Results of the second half of a cycle, `act`: desired motion, torque command and vibration levels."""

    desired: Annotated[Vector, 2 * len(JOINTS)]  # q_des [rad], then q_des' [rad/s]
    gravity: Annotated[Vector, len(JOINTS)]  # Nm, u_g
    torque: Annotated[Vector, len(JOINTS)]  # Nm, torque command u
    vibration: Annotated[Vector, len(MOTORS)]  # levels of the vibration motors, 0 to 1


def sense(measured: Measured, constants: Constants, stabiliser: Stabiliser, parts: Parts) -> None:
    """Update loads, kinematics, attitude and headings from the measurements.

    Args:
        measured: measurements of the cycle.
        constants: constants of the kernel.
        stabiliser: geometry of the feet.
        parts: arrays of the parts; updated.
    """
    stage, sensed, soles = parts.stages[0], parts.sensed[0], parts.chain.soles
    load = sensed.load
    for side in range(len(SIDES)):
        cells, force = measured.force[side], 0.0
        for cell in range(len(cells)):
            force += cells[cell, 2]
        twist = cells[_FL, 2] - cells[_FR, 2] - cells[_RL, 2] + cells[_RR, 2]
        load[side] += (1.0 - constants.keep) * (force - load[side])
        sensed.twist[side] += (1.0 - constants.keep) * (twist - sensed.twist[side])
        sensed.bearing[side] = min(force, load[side])
    move(parts.chain, measured.q, measured.qd)

    resting, gyro = _resting_foot(stage, load), measured.gyro
    sole = soles[resting]
    if stage.gyro_source != TRUNK:
        _replace_gyro(resting, measured, parts)
    suspended = stage.double and load[0] + load[1] < 0.1 * constants.weight
    velocity = (0.0, 0.0, 0.0) if suspended else _velocity(measured.imu, sole.position, sole.linear, gyro)
    if stage.gyro_source != TRUNK:
        # No accelerometer of the trunk is in use. With a velocity error of 0, `observe` only integrates the angular velocity.
        for k in range(3):
            parts.attitudes[0].velocity[k] = velocity[k]
    observe(parts.attitudes, gyro, measured.accel, velocity)
    rotation = parts.attitudes[0].rotation

    for side in range(len(SIDES)):
        # The x axis of a foot points outwards by the toe-out. The toe-out is subtracted from the heading of the x axis.
        foot = soles[side].rotation
        ahead = rotated(rotation, (foot[0, 0], foot[1, 0], foot[2, 0]))
        toe_out = -stabiliser.toe_out if side else stabiliser.toe_out
        sensed.heading[side] = math.atan2(ahead[1], ahead[0]) - toe_out
    left, right = soles[0].position, soles[1].position
    step = rotated(rotation, (right[0] - left[0], right[1] - left[1], right[2] - left[2]))
    for k in range(3):
        sensed.step[k] = step[k]


def _replace_gyro(resting: int, measured: Measured, parts: Parts) -> None:
    """Compute the angular velocity of the pelvis without an IMU of the trunk, and write it into `Measured.gyro`.

    A link of the leg whose sole is at rest has a known angular velocity. The velocities of the joints between this link and the
    pelvis are subtracted. The link is the tibia, which has an IMU, or the foot, which does not turn.

    Args:
        resting: foot whose sole is at rest.
        measured: measurements of the cycle; `gyro` is updated.
        parts: arrays of the parts.
    """
    sole, turn = parts.chain.soles[resting], (0.0, 0.0, 0.0)
    angular = sole.angular
    if parts.stages[0].gyro_source == TIBIA:
        shank, rate = parts.chain.links[sole.link - FOOT_TO_TIBIA], measured.tibiae[resting]
        turn, angular = rotated(shank.rotation, (rate[0], rate[1], rate[2])), shank.angular
    for k in range(3):
        measured.gyro[k] = turn[k] - angular[k]


def _resting_foot(stage: Stage, load: Vector) -> int:
    """Return the foot whose sole is assumed to be at rest.

    A foot that has just landed may bounce and is therefore unsuitable. So the result is the stance foot, unless both feet are
    down and the stance foot carries less than 10 % of the load.

    Args:
        stage: current phase.
        load: filtered vertical forces on both feet, shape (2,) [N].
    """
    foot = stage.stance
    return 1 - foot if stage.double and load[foot] < 0.1 * (load[0] + load[1]) else foot


def _locate_dcm(measured: Measured, table: PhaseTable, parts: Parts) -> None:
    """Compute the DCM relative to the stance foot, or to the middle between the feet while no foot swings.

    Args:
        measured: measurements of the cycle.
        table: table of the phase.
        parts: arrays of the parts; `balances` is updated.
    """
    stage, sensed, balance = parts.stages[0], parts.sensed[0], parts.balances[0]
    centre, gyro, rotation = parts.chain.centre[0], measured.gyro, parts.attitudes[0].rotation
    base = _resting_foot(stage, sensed.load)
    sole, step = parts.chain.soles[base], sensed.step
    about = sole.position
    lever = rotated(
        rotation, (centre.position[0] - about[0], centre.position[1] - about[1], centre.position[2] - about[2])
    )
    moved = _velocity(centre.position, sole.position, sole.linear, gyro)
    speed = rotated(
        rotation,
        (moved[0] + centre.velocity[0], moved[1] + centre.velocity[1], moved[2] + centre.velocity[2]),
    )
    balance.heading = sensed.heading[stage.stance]
    if stage.double:
        balance.heading = 0.5 * (sensed.heading[0] + sensed.heading[1])
        half = 0.5 if base == 1 else -0.5
        lever = lever[0] + half * step[0], lever[1] + half * step[1], lever[2] + half * step[2]
    balance.dcm[0], balance.dcm[1] = dcm(lever, speed, balance.heading, table.frequency)


def _velocity(point: Vector, sole: Vector, sole_velocity: Vector, gyro: Vector) -> Vector3:
    """Return the velocity of a point on the pelvis, in the axes of the pelvis [m/s]. One sole is assumed to be at rest.

    Args:
        point: position of the point, shape (3,) [m].
        sole: position of the sole, shape (3,) [m].
        sole_velocity: velocity of the sole relative to the pelvis, shape (3,) [m/s].
        gyro: angular velocity of the pelvis, shape (3,) [rad/s].
    """
    turned = cross(gyro, (point[0] - sole[0], point[1] - sole[1], point[2] - sole[2]))
    return turned[0] - sole_velocity[0], turned[1] - sole_velocity[1], turned[2] - sole_velocity[2]


def start(measured: Measured, table: PhaseTable, parts: Parts) -> None:
    """Store how far the measured joint motion is from the first row of the phase table, at the start of a phase.

    The re-centring fades out these deviations during the phase. If no foot swings, the speed deviations are set to 0. With the
    measured speeds, the re-centring would continue the downward motion of a foot that has just landed, and press the foot into
    the floor.

    Args:
        measured: measurements of the cycle.
        table: table of the new phase.
        parts: arrays of the parts; `stages`, `placements`, `leans` and `ankles` are updated.
    """
    stage, placement, n = parts.stages[0], parts.placements[0], len(measured.q)
    placement.clock, placement.pace, placement.held = 0.0, 1.0, 0.0
    parts.leans[0].angle, parts.leans[0].speed = 0.0, 0.0
    placement.target[:], placement.offset[:], placement.speed[:], placement.change[:] = 0.0, 0.0, 0.0, 0.0
    for joint in range(n):
        stage.deviation[joint] = measured.q[joint] - table.rows[0, joint]
        stage.rate[joint] = 0.0 if stage.double else measured.qd[joint] - table.rows[0, n + joint]
    swing = 1 - stage.stance
    attitude, gyro = _tibia(swing, measured, parts)
    start_level_ankle(parts.ankles[swing], attitude, gyro, measured.q, measured.qd)


def _tibia(side: int, measured: Measured, parts: Parts) -> tuple[Quaternion, Vector3]:
    """Return the tilt of a tibia as a unit quaternion wxyz, and its angular velocity in the axes of the tibia [rad/s]."""
    shank = parts.chain.links[parts.chain.soles[side].link - FOOT_TO_TIBIA]
    rotation, up, gyro = shank.rotation.T, parts.attitudes[0].rotation[2], measured.gyro
    rate = rotated(
        rotation,
        (gyro[0] + shank.angular[0], gyro[1] + shank.angular[1], gyro[2] + shank.angular[2]),
    )
    return tilt_quaternion(rotated(rotation, up)), rate


def act(
    cycle: int,
    measured: Measured,
    table: PhaseTable,
    constants: Constants,
    stabiliser: Stabiliser,
    assistance: Assistance,
    parts: Parts,
) -> None:
    """Compute torque command and vibration levels of one cycle.

    Args:
        cycle: cycles since the start of the phase.
        measured: measurements of the cycle.
        table: table of the phase.
        constants: constants of the kernel.
        stabiliser: parameters of the ankle stabiliser.
        assistance: guide of the swing leg; read if `Stage.assisted`.
        parts: arrays of the parts; updated. The results are in `outputs` and `telemetry`.
    """
    stage, sensed, balance, output = parts.stages[0], parts.sensed[0], parts.balances[0], parts.outputs[0]
    desired, torque, n = output.desired, output.torque, len(measured.q)
    placement = parts.placements[0]
    if cycle > 0:
        placement.clock += placement.pace
    row = _desired(cycle, placement, table, stage, desired)
    _locate_dcm(measured, table, parts)
    for k in range(2):
        balance.error[k] = balance.dcm[k] - table.dcm[row, k]
    swing = 1 - stage.stance
    if stage.placed:
        _place(cycle, table, constants, stabiliser.gain, parts)
    if stage.flat and not stage.double:
        attitude, gyro = _tibia(swing, measured, parts)
        write_level_ankle(parts.ankles[swing], table.recentring, cycle, attitude, gyro, desired)

    _set_gains(constants, stage, sensed.load, parts.pids)
    control(parts.pids, desired, measured.q, measured.qd, measured.sent, torque)
    up = parts.attitudes[0].rotation[2]
    hold(parts.links, measured.q, tilt_quaternion(up), output.gravity)
    carried = min(max((sensed.load[0] + sensed.load[1]) / constants.weight, 0.0), 1.0) if stage.double else 1.0
    if not stage.literal:
        for joint in range(n):
            torque[joint] += output.gravity[joint] + carried * table.feedforward[row, joint]

    balance.shift[0], balance.shift[1] = pressure_shift(stabiliser, balance.error)
    for side in range(len(SIDES)):
        if (stage.double or side == stage.stance) and not stage.literal:
            sagittal, henke = ankle_torques(stabiliser, balance.shift, sensed.bearing[side], side)
            torque[side * _LEG + _SA] += sagittal
            torque[side * _LEG + _HA] += henke
    if not stage.double and not stage.literal:
        ankle = stage.stance * _LEG + _SA
        torque[ankle] = within_sole(stabiliser, torque[ankle], sensed.bearing[stage.stance])
    if stage.assisted:
        _assist(cycle, measured, assistance, parts)
    requested = parts.pids[0].requested
    for joint in range(len(requested)):  # `requested[:] = torque` would allocate an array
        requested[joint] = torque[joint]
    write_telemetry(parts.telemetry, cycle * PERIOD, not stage.double, desired, sensed.load, balance, up)


def _assist(cycle: int, measured: Measured, assistance: Assistance, parts: Parts) -> None:
    """Let the virtual guide drive sagittal hip and knee (SH, SK) of the swing leg, and set the vibration levels.

    The torques of the guide replace the torques of the baseline controller (PID). After the nominal end of the step, the baseline
    controller lowers the foot. It also takes over if the guide ends earlier (`Stage.last_guided`). `Stage.excess` is the torque
    of the guide minus the torque of the baseline controller in the last cycle with the guide. This difference is added to the
    torque of the baseline controller and fades out with `fade`, so the command is continuous.

    Args:
        cycle: cycles since the start of the step.
        measured: measurements of the cycle.
        assistance: guide of the swing leg.
        parts: arrays of the parts; `stages`, `outputs` and `telemetry` are updated.
    """
    stage, output, guide = parts.stages[0], parts.outputs[0], assistance.guide
    q, qd, sent = measured.q, measured.qd, measured.sent
    desired, torque, gravity = output.desired, output.torque, output.gravity
    hip, knee = _LEG * (1 - stage.stance) + _SH, _LEG * (1 - stage.stance) + _SK
    last = stage.last_guided
    if cycle <= last:
        added = assistance.unmodelled[cycle]
        if stage.literal:
            leg = leg_state(hip, q, qd, desired, sent, (gravity[hip], gravity[knee]))
            rates = desired[len(q) + hip], desired[len(q) + knee]
            u_hip, u_knee = assistive_torque(assistance.literal, guide.guards[0], cycle, leg, rates)
        else:
            leg = leg_state(hip, q, qd, desired, sent, (gravity[hip] + added[0], gravity[knee] + added[1]))
            u_hip, u_knee = tick(guide, cycle, leg)
        stage.excess[0], stage.excess[1] = u_hip - torque[hip], u_knee - torque[knee]
        torque[hip], torque[knee] = u_hip, u_knee
        errors = q[hip] - desired[hip], q[knee] - desired[knee]
        bounds = write_guide(parts.telemetry, guide.guards[0], errors)
        levels(1 - stage.stance, errors, bounds, stage.intensity, output.vibration)
        return
    output.vibration[:] = 0.0
    if cycle - last < len(assistance.fade):
        torque[hip] += assistance.fade[cycle - last] * stage.excess[0]
        torque[knee] += assistance.fade[cycle - last] * stage.excess[1]


def _place(cycle: int, table: PhaseTable, constants: Constants, gain: float, parts: Parts) -> None:
    """React to a DCM error: lean the trunk, shift the landing of the swing foot, and change the speed of the step.

    Lean and shift change the desired motion of this cycle. The phase rate is the speed of the step relative to the gait. A new
    phase rate acts from the next cycle on.

    Args:
        cycle: cycles since the start of the phase.
        table: table of the phase.
        constants: parameters of foot placement, step timing and lean.
        gain: gain of the ankle stabiliser.
        parts: arrays of the parts; `placements`, `leans` and `outputs` are updated.
    """
    stage, balance, placement, config = parts.stages[0], parts.balances[0], parts.placements[0], constants.placement
    last, swing = len(table.rows) - 1, 1 - stage.stance
    remaining, rate, row = (last - placement.clock) * PERIOD, placement.pace, int(min(placement.clock, float(last)))
    error, side = (balance.error[0], balance.error[1]), -1.0 if swing else 1.0
    if remaining <= config.frozen:
        rate = 1.0
        placement.target[0], placement.target[1] = late_landing(config, error, side)
    elif cycle * PERIOD >= config.settled:
        nominal = table.dcm[row, 0], table.dcm[row, 1]
        final = table.dcm[last, 0], table.dcm[last, 1]
        motion = Motion(error, nominal, final, table.frequency * remaining, side)
        placement.target[0], placement.target[1], rate = landing(config, gain, motion)
    outward = leg_target(constants.lean, balance.dcm[1], side)
    if outward != 0.0:
        placement.target[1] = outward
    follow(config, placement, rate)
    lean, target = parts.leans[0], lean_target(constants.lean, error[1], balance.dcm[1], side)
    follow_lean(constants.lean, lean, target)
    desired, hip = parts.outputs[0].desired, stage.stance * _LEG + _FH
    desired[hip] = min(max(desired[hip] + lean.angle, placement.low[hip]), placement.high[hip])
    desired[len(desired) // 2 + hip] += lean.speed
    if placement.held > 0.0 or target != 0.0 or rate != 1.0 or placement.target[0] != 0.0 or placement.target[1] != 0.0:
        placement.held = min(1.0, placement.held + PERIOD / config.hold)
        _hold_foot(row, table, parts)


def _hold_foot(row: int, table: PhaseTable, parts: Parts) -> None:
    """Move the desired swing ankle to a position relative to the stance foot: the nominal position plus the landing offset.

    The landing offset is the shift of the landing position that foot placement requests.

    Args:
        row: current row of the table.
        table: table of the phase.
        parts: arrays of the parts; `placements` and `outputs` are updated.
    """
    stage, placement, desired = parts.stages[0], parts.placements[0], parts.outputs[0].desired
    rotation, heading = parts.attitudes[0].rotation, parts.balances[0].heading
    swing, late = 1 - stage.stance, placement.clock - (len(table.rows) - 1)
    c, s = math.cos(heading), math.sin(heading)
    x, y, z = table.ankle[row, 0] + placement.offset[0], table.ankle[row, 1] + placement.offset[1], table.ankle[row, 2]
    if late > 0.0:
        z -= table.lowering * _lowered(late, table.lowering_cycles)[0]
    x, y = c * x - s * y, s * x + c * y
    sole, first = parts.chain.soles[stage.stance].position, parts.chain.soles[swing].link - _LEG + 1
    ankle = ankle_position(placement, parts.chain.links, first, desired)
    share = placement.held**2 * (3.0 - 2.0 * placement.held)
    goal = (
        ankle[0] + share * (rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z + sole[0] - ankle[0]),
        ankle[1] + share * (rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z + sole[1] - ankle[1]),
        ankle[2] + share * (rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z + sole[2] - ankle[2]),
    )
    shift_foot(placement, parts.chain.links, first, desired, swing * _LEG, goal)


def _desired(cycle: int, placement: Placement, table: PhaseTable, stage: Stage, desired: Vector) -> int:
    """Write q_des and q_des', and return the current row of the phase table.

    q_des is the sum of the table, the re-centring (fades out the deviation at the start of the phase), the steering and the
    lowering of a late swing foot. Afterwards, lean, foot placement and flat foot change q_des further.

    Args:
        cycle: cycles since the start of the phase.
        placement: position in the table, phase rate, and limits of the transverse hip.
        table: table of the phase.
        stage: data of the phase.
        desired: q_des [rad], then q_des' [rad/s], shape (24,), overwritten.
    """
    n, last, clock = len(desired) // 2, len(table.rows) - 1, placement.clock
    row = int(min(clock, float(last)))
    part, following = min(clock, float(last)) - row, min(row + 1, last)
    pace = placement.pace if clock <= last else 0.0
    for joint in range(n):
        angle, rate = table.rows[row, joint], table.rows[row, n + joint]
        desired[joint] = angle + part * (table.rows[following, joint] - angle)
        desired[n + joint] = pace * (rate + part * (table.rows[following, n + joint] - rate))
    leg = _LEG * (1 - stage.stance)
    for joint in range(n):
        guided = stage.assisted and (joint == leg + _SH or joint == leg + _SK)
        recentring = table.guided if guided else table.recentring
        if cycle < len(recentring):
            cubic, deviation, rate = recentring[cycle], stage.deviation[joint], stage.rate[joint]
            desired[joint] += deviation * cubic[0] + rate * cubic[1]
            desired[n + joint] += deviation * cubic[2] + rate * cubic[3]
    if stage.double:
        return row
    x = min(clock / last, 1.0)
    hip = leg + _TH
    desired[hip] += stage.steering * x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    desired[n + hip] += stage.steering * pace * 30.0 * x * x * (1.0 - x) ** 2 / (last * PERIOD)
    limited = min(max(desired[hip], placement.low[hip]), placement.high[hip])
    if limited != desired[hip]:
        desired[hip], desired[n + hip] = limited, 0.0
    if clock > last:
        time, moving = _lowered(clock - last, table.reach_cycles)
        for joint, speed in ((_SH, table.reach[0]), (_SK, table.reach[1])):
            desired[leg + joint] += speed * time
            desired[n + leg + joint] += speed * moving
    return row


def _lowered(cycles: float, longest: int) -> tuple[float, float]:
    """Return the distance [m] and the speed [m/s] of a late swing foot that moves down with a final speed of 1 m/s.

    A late swing foot has not landed at the nominal end of the step. The speed rises from 0 to 1 m/s. The caller scales
    both results to the real final speed.

    Args:
        cycles: cycles since the nominal end of the step, above 0.
        longest: number of cycles after which the motion ends.
    """
    # The downward speed rises slowly. A sudden rise would tilt a foot that already touches the ground with one corner.
    time = min(cycles, float(longest)) * PERIOD
    moving = 1.0 - math.exp(-time / _REACH_RISE)
    return time - _REACH_RISE * moving, moving if cycles < longest else 0.0


def _set_gains(constants: Constants, stage: Stage, load: Vector, pids: Records[PidRecord]) -> None:
    """Set the PID gains of both legs: the more load a foot carries, the closer the gains are to the full stance gains.

    While no foot swings, the rule applies to all joints of both legs. In a step, the rule applies only to the ankle of the
    stance leg. The other joints of the stance leg have the full stance gains, and the swing leg has the swing gains. In a guided
    step, hip and knee (SH, SK) of the swing leg have no integral gain, because the guide drives them.

    Args:
        constants: gains of swing leg and stance leg, and loads at which the full stance gains are applied.
        stage: data of the phase.
        load: vertical forces on both feet, shape (2,) [N].
        pids: `Pid.records`; the gains are overwritten.
    """
    gains, pair = pids[0].gains, constants.gains
    for side in range(len(SIDES)):
        carrying = min(max(load[side] / constants.standing_gains, 0.0), 1.0)
        ankle = min(max(load[side] / constants.walking_gains, 0.0), 1.0)
        for joint in range(_LEG):
            if stage.double:
                share = carrying
            elif side != stage.stance:
                share = 0.0
            else:
                share = ankle if joint in _ANKLES else 1.0
            i = side * _LEG + joint
            for k in range(3):
                gains[k, i] = pair[0, k, i] + share * (pair[1, k, i] - pair[0, k, i])
    if stage.assisted:
        leg = _LEG * (1 - stage.stance)
        gains[2, leg + _SH], gains[2, leg + _SK] = 0.0, 0.0
