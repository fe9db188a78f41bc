"""Walking controller for an exoskeleton with a patient on the ground: `State -> Command`, once per cycle.

    state -> loads, attitude, divergent component of motion (DCM) -> phase (re-centring, steering) -> torque command u

A walk begins and ends with standing: weight shift, start step, periodic steps, stop step, weight shift back (`walking.phases`).
The periodic steps can have several gaits, one after another (`walking.section`).
The controller uses only measurements from the bus. The torque is the sum of the PID torque, the gravity torque u_g, the
feedforward u_f and the torque of the ankle stabiliser. In a periodic step with Xi < 1, the sagittal hip and knee (SH, SK) of the
swing leg get only the torque of the guide filter until the nominal end of the step. The start step and the stop step
are always fully assisted, and so are the first two steps with a new gait.
As in the air, Xi changes only at a stance change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.walk import WalkGaits
from atalante_control.guide.certificate import Certificate
from atalante_control.guide.loop_delay import LoopDelay
from atalante_control.guide.outside_count import OutsideCount
from atalante_control.guide.shapes import PINCHED, GuideShape
from atalante_control.joint.flat_foot import ankle_records, flat_feet
from atalante_control.joint.haptics import intensity
from atalante_control.joint.pid import LEFT, RIGHT, Pid
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.structured import Records, zeros
from atalante_control.walking.attitude import AttitudeObserver
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.contact import ImpactDetector, contact_force
from atalante_control.walking.dcm import Balance, Stabiliser
from atalante_control.walking.kernel import (
    SOLE,
    TIBIA,
    TRUNK,
    Constants,
    Measured,
    Outputs,
    Parts,
    Sensed,
    Stage,
    act,
    sense,
    start,
)
from atalante_control.walking.kinematics import FOOT_TO_TIBIA, Kinematics
from atalante_control.walking.lean import Lean
from atalante_control.walking.phases import STEPPING, WALKING, Facts, Phase, next_phase
from atalante_control.walking.placement import Placement
from atalante_control.walking.rotation import rotation_of
from atalante_control.walking.section import Models, Section, SectionMotion
from atalante_control.walking.steering import Steering
from atalante_control.walking.telemetry import TELEMETRY_FIELDS, Telemetry, WalkStatistics
from atalante_hal.compiled import specialised
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, LEG_JOINTS, Robot
from atalante_hal.types import GRAVITY, PERIOD, Command, State, SupervisorState, Vector

Pair = tuple[float, float]

_N, _LEG = len(JOINTS), len(LEG_JOINTS)
_TH, _SH, _SK = (LEG_JOINTS.index(name) for name in ("TH", "SH", "SK"))
_PELVIS, _TORSO = IMUS.index("pelvis"), IMUS.index("torso")
_TIBIAE = [IMUS.index(f"{side}_tibia") for side in FEET]
#: Smallest distance between the position limit and a joint angle requested by lean or foot placement [rad].
_MARGIN = math.radians(1.0)
#: Largest valid age of the message of an IMU or a foot [cycles], equal to the timeout of these messages in the DBC.
SENSOR_AGE = 10
#: Largest expected difference between the weight and the load on the stance foot, as a fraction of the weight.
#: While one foot swings, the load on the stance foot differs from the weight, because the robot accelerates.
_LOAD_ERROR = 0.15
#: Time constant of the correction of roll and pitch after a trunk IMU was implausible [s]. The stance leg gives the new values.
#: With a correction in a single cycle, the ankles that hold the swing foot level could exceed their velocity limit.
_LEVEL_TIME = 0.02
#: m, height above the stance foot up to which the swing foot counts as landed while the data of both feet is lost
_LANDED_HEIGHT = 0.001


class StanceError(ValueError):
    """Error: a walk cannot start, because the robot stands on the ground with one foot ahead of the other."""


class WalkController:
    """Walking controller, which implements `atalante_hal.types.Controller`.

    Attributes:
        phase: current phase.
        statistics: statistics of the walk since `reset`.
        steering: deviation of the walk from the straight line that begins at the first step, and the steering offset.
        telemetry: telemetry of the last cycle, for the recording.
        telemetry_fields: name and width of each field of `telemetry`.
    """

    telemetry_fields = TELEMETRY_FIELDS

    def __init__(
        self,
        robot: Robot,
        patient: Patient | None,
        gaits: WalkGaits,
        steps: int,
        config: WalkConfig | None = None,
        shape: GuideShape = PINCHED,
        then: Sequence[Section] = (),
    ) -> None:
        """Build the parts and allocate all arrays, because the control loop must not allocate memory.

        Args:
            robot: limits of the joints.
            patient: patient in the exoskeleton, or None for an empty exoskeleton.
            gaits: start step, periodic step and stop step.
            steps: number of periodic steps with these gaits.
            config: parameters of the controller. If None, the defaults are used.
            shape: shape of the virtual guide of the periodic steps.
            then: further sections of the walk with other gaits, in walking order. The stop step is that of the last section.

        Raises:
            GaitError: If a pose of the weight shift cannot be reached.
            ValueError: If a section has no step.
        """
        self.config = config = config or WalkConfig()
        exoskeleton = ExoskeletonParameters() if patient is None else ExoskeletonParameters().fitted(patient)
        worn, empty = pinocchio_model(urdf(exoskeleton, robot, patient)), pinocchio_model(urdf(exoskeleton, robot))
        gravity, kinematics = Gravity(empty), Kinematics(worn, exoskeleton)
        models = Models(robot, worn, gravity, kinematics, exoskeleton)
        self._sections: list[SectionMotion] = []
        for section in (Section(gaits, steps), *then):
            before = self._sections[-1].end if self._sections else 0
            self._sections.append(SectionMotion(section, before, models, config, shape))
        self._section = self._sections[0]

        pid, self._observer = Pid(config.gains), AttitudeObserver(config.observer_bandwidth)
        self._loop_delay = LoopDelay()
        self._imus = {_PELVIS: np.array(exoskeleton.pelvis_imu), _TORSO: np.array(exoskeleton.torso_imu)}
        weight = kinematics.mass * GRAVITY
        self._constants = Constants(
            weight=weight,
            keep=math.exp(-2.0 * math.pi * config.load_bandwidth * PERIOD),
            standing_gains=config.full_gains[0] * weight,
            walking_gains=config.full_gains[1] * weight,
            gains=config.leg_gains(),
            placement=config.placement,
            lean=config.lean,
        )
        middle, half = exoskeleton.sole_centre[0], 0.5 * exoskeleton.sole_size[0] - exoskeleton.pad_radius
        self._stabiliser = Stabiliser(
            config.stabiliser,
            *config.shift_limit,
            flat_feet(exoskeleton)[LEFT].geometry[2],
            exoskeleton.toe_out,
            heel=middle - half + config.edge,
            toe=middle + half - config.edge,
        )
        force = np.zeros((len(FEET), len(CELLS), 3))
        #: Foot forces that the kernels read if the data of one or both feet is lost. The forces of a lost foot are estimates.
        self._forces = force.copy()
        #: Copy of the torque that the controller requested last, used if the `State` does not contain the sent torque.
        self._sent = np.zeros(_N)
        #: `State` object that owns the arrays in `_measured_by`. None before the first `reset` or `update`.
        self._state: State | None = None
        self._measured = Measured(
            np.zeros(_N),
            np.zeros(_N),
            np.zeros(3),
            np.zeros(3),
            np.zeros(3),
            force,
            self._sent,
            np.zeros((len(FEET), 3)),
        )
        #: Index of the IMU in use (pelvis or torso) -> sensor arrays that the kernels read.
        self._measured_by = {_PELVIS: self._measured, _TORSO: self._measured}
        #: Arrays that the kernels read while the data of both trunk IMUs is lost. A kernel writes the computed rates into `gyro`.
        self._without_trunk = self._measured
        self._gyro_source = TRUNK
        stages: Records[Stage] = zeros(Stage, 1)
        sensed: Records[Sensed] = zeros(Sensed, 1)
        balances: Records[Balance] = zeros(Balance, 1)
        placed = zeros(Placement, 1)
        placements: Records[Placement] = placed
        placements[0].low[:], placements[0].high[:] = _range(robot, config)
        leans: Records[Lean] = zeros(Lean, 1)
        # `clock`: progress of the step, as a row of the table of the desired motion. `pace`: rows per cycle.
        # `_clock` and `_pace` are arrays of shape (1,) that share the memory of the record of foot placement.
        # The arrays exist because Python reads an array element faster than a record field.
        self._clock, self._pace = placed["clock"], placed["pace"]
        outputs: Records[Outputs] = zeros(Outputs, 1)
        telemetry = zeros(Telemetry, 1)
        self.telemetry: Vector = telemetry.view(np.float64)
        self._record = telemetry[0]
        guarded = [name for name, width in TELEMETRY_FIELDS for _ in range(width)].index("error")
        #: Consecutive fields `error`, `q_bound`, `h` and `gate` of the telemetry, shape (6,).
        self._guarded = self.telemetry[guarded : guarded + 6]
        self._stage, self._load, self._twist, self._step, self._heading = (
            stages[0],
            sensed[0].load,
            sensed[0].twist,
            sensed[0].step,
            sensed[0].heading,
        )
        self._stage.flat = config.flat_foot
        self._pid, self._impact, self.steering = (
            pid,
            ImpactDetector(config.impact),
            Steering(config.steering, config.turn),
        )
        ankles = ankle_records(robot, exoskeleton, 0.0)
        self._parts = Parts(
            chain=kinematics.chain,
            attitudes=self._observer.records,
            links=gravity.links,
            pids=pid.records,
            ankles=ankles,
            stages=stages,
            sensed=sensed,
            balances=balances,
            placements=placements,
            leans=leans,
            outputs=outputs,
            telemetry=telemetry,
        )
        #: N, load that each foot must carry so that the robot counts as standing on both feet
        self._carrying = config.loaded * weight
        self._settled, self._rest, self._timeout = (
            round(seconds / PERIOD) for seconds in (config.settle, config.rest, config.landing_timeout)
        )
        self._command = Command(outputs[0].torque, outputs[0].vibration)
        self._table = self._section.tables[Phase.POSTURE, RIGHT]
        self._compile()
        self._forget(0)

    def _compile(self) -> None:
        """Compile the kernels by one call, and discard the results."""
        measured, table, constants, stabiliser = self._measured, self._table, self._constants, self._stabiliser
        self._sense = specialised(sense, measured, constants, stabiliser, self._parts)
        self._start = specialised(start, measured, table, self._parts)
        self._act = specialised(act, 0, measured, table, constants, stabiliser, self._section.assistance, self._parts)

    def _forget(self, cycle: int) -> None:
        """Clear all data of the last walk."""
        self.phase, self._since, self._loaded, self._stopping, self._landed = Phase.POSTURE, cycle, 0, False, False
        self._stance, self._finishing = RIGHT, False
        #: Indices in IMUS of the IMUs that were implausible in this walk.
        self._distrusted: frozenset[int] = frozenset()
        self._stage.stance, self._stage.double, self._stage.steering = RIGHT, True, 0.0
        self._assisted, self._promised = False, False
        #: Angle deviations [rad] and speed deviations [rad/s] of hip and knee at the start of the step.
        self._start_deviation: tuple[Pair, Pair] = (0.0, 0.0), (0.0, 0.0)
        self._velocity_before, self._torque_before = np.zeros(_N), np.zeros(_N)
        self._outside = OutsideCount(self.config.guide.outside_cycles)
        self._stage.assisted = self._stage.literal = self._stage.placed = False
        self._command.step, self._command.walking = None, False
        self._command.vibration.fill(0.0)
        self._command.outside = self._command.guide_left = False
        self._command.hand_over_exceeded = self._command.loop_late = False
        self._load[:] = self._twist[:] = 0.0
        self.steering.reset()
        self._pid.reset()
        self._pid.limit_integral(self.config.gains.integral_limit)
        self._section = self._sections[0]
        self._table = self._section.tables[Phase.POSTURE, RIGHT]
        self.telemetry.fill(0.0)
        self.statistics = WalkStatistics()

    @property
    def done(self) -> bool:
        """Return whether the walk is over and the robot stands on both feet."""
        return self.phase is Phase.REST

    @property
    def walking(self) -> bool:
        """Return whether the robot takes steps, or shifts its weight before the first or after the last step."""
        return self.phase in WALKING

    @property
    def standing_pose(self) -> Vector:
        """Return the joint angles of the standing pose, shape (12,) [rad]."""
        pose: Vector = self._sections[0].tables[Phase.STAND, RIGHT].rows[0, :_N]
        return pose

    @property
    def steps_wanted(self) -> int:
        """Return the number of periodic steps between the start step and the stop step."""
        return self._sections[-1].end

    @property
    def steps_begun(self) -> int:
        """Return the number of periodic steps that have begun. The step in progress is included."""
        return self.statistics.steps + (self.phase is Phase.STEP)

    def reached(self, step: int, phase: float) -> bool:
        """Return whether the walk has reached a given phase of a given periodic step. The result remains True afterwards.

        Args:
            step: index of the step, from 0.
            phase: nominal time from the start of the step to the instant, divided by the duration of a step.
        """
        steps = self.statistics.steps
        return steps > step or (
            steps == step and self.phase is Phase.STEP and self._record.elapsed >= phase * self._section.duration
        )

    @property
    def vertical(self) -> Vector:
        """Return the upward unit vector in the axes of the pelvis, from the attitude observer, shape (3,)."""
        up: Vector = self._observer.rotation[2]
        return up

    @property
    def max_dcm_error(self) -> float:
        """Return the largest error of the divergent component of motion (DCM) in the steps of the walk [m]."""
        return float(self._record.max_dcm_error)

    def prepare(self) -> None:
        """Compute the guides for all assistance factors. Must be called before a real-time walk, see `StepGuides.prepare`."""
        for section in self._sections:
            section.prepare()

    def certificates(self, xi: float) -> list[Certificate]:
        """Return the certificates of the guides at an assistance factor, in the order of the sections of the walk.

        Args:
            xi: assistance factor in [0, 1].
        """
        return [section.certificate(xi) for section in self._sections]

    def stop(self) -> None:
        """End the walk with a stop step after the current step."""
        self._stopping = True

    def reset(self, state: State) -> None:
        """Restart the walk from the measured pose.

        Args:
            state: measured state of the robot.

        Raises:
            StanceError: If the robot is on the ground with one foot ahead of the other, for example after HOLD in a step.
        """
        self._forget(state.cycle)
        self._loop_delay.reset(state)
        self._constants.gains[:] = self.config.leg_gains(state.delay)
        self._observer.reset(state.imu_quaternion[_PELVIS].tolist())
        self._bind(state)
        self._measure(state)
        self._load[:] = self._measured.force[:, :, 2].sum(axis=1)  # start value of the low-pass
        self._sense(self._measured, self._constants, self._stabiliser, self._parts)
        self._require_stance()
        self._start(self._measured, self._table, self._parts)
        self._pid.store_request(state.torque if state.torque_sent is None else state.torque_sent)

    # -- computation of one cycle ------------------------------------------------------------------------------------

    def update(self, state: State) -> Command:
        """Compute the command of one cycle. If the current phase is over, start the next phase first.

        Args:
            state: measured state of the robot.

        Returns:
            The command. The next call overwrites the same object.
        """
        imu = self._measured.imu
        self._measure(state)
        if self._gyro_source != TRUNK and not self._distrusted.isdisjoint(self._imus):
            # The implausible data has already changed the attitude.
            self._observer.level(self._vertical_of_stance_leg(state), _LEVEL_TIME)
        if self._measured.imu is not imu:
            self._observer.change_imu(self._measured.gyro, self._measured.imu - imu)
        self._sense(self._measured, self._constants, self._stabiliser, self._parts)
        if state.supervisor is SupervisorState.FINISH_STEP:
            self._finishing = True
            self.stop()
        cycle = state.cycle - self._since
        following = next_phase(self.phase, self._facts(cycle))
        self._command.loop_late, late = False, self._loop_delay.update(state)
        if following is not None:
            self._begin(following, state)
            cycle = 0
            self._torque_before[:] = self._measured.sent
        elif late and self._assisted and cycle <= self._stage.last_guided:
            self._command.loop_late, self._stage.last_guided = True, cycle - 1
            self.statistics.guide.late += 1
            self._clear_guide_record()
        self._act(
            cycle, self._measured, self._table, self._constants, self._stabiliser, self._section.assistance, self._parts
        )
        self._watch_guide(cycle)
        self._velocity_before[:] = self._measured.qd
        return self._command

    def _require_stance(self) -> None:
        """Raise `StanceError` if the robot is on the ground with one foot ahead of the other."""
        yaw = float(self._heading.mean())
        ahead = math.cos(yaw) * float(self._step[0]) + math.sin(yaw) * float(self._step[1])
        if abs(ahead) > self.config.stride and self._load.sum() > self._carrying:
            raise StanceError(
                "the feet must stand side by side at the start of a walk on the ground, got the right foot "
                f"{abs(ahead):.2f} m {'ahead of' if ahead > 0.0 else 'behind'} the left foot: suspend the robot first"
            )

    def _bind(self, state: State) -> None:
        """Give the kernels references to the arrays of a state.

        The values of each new cycle are written into the same arrays, so the references remain valid. They must be renewed only
        for another state object.

        Args:
            state: measured state of the robot.

        Raises:
            TypeError: If an array is not a contiguous array of float64. The kernels do not check the type. The arrays may be
                read-only: the kernels write only into `gyro`, and only while `gyro` is the array of `_without_trunk`.
        """
        sent = self._sent if state.torque_sent is None else state.torque_sent
        tibiae = state.imu_gyro[_TIBIAE[0] :]
        for imu, position in self._imus.items():
            gyro, accel = state.imu_gyro[imu], state.imu_accel[imu]
            measured = Measured(state.position, state.velocity, position, gyro, accel, state.foot_force, sent, tibiae)
            for name, array, like in zip(Measured._fields, measured, self._measured, strict=True):
                contiguous = array.flags.c_contiguous and array.flags.aligned
                if not (contiguous and array.dtype == np.float64 and array.shape == like.shape):
                    raise TypeError(
                        f"{name} must be a contiguous array of {like.shape} float64, got {array.shape} {array.dtype}"
                    )
            self._measured_by[imu] = measured
        self._without_trunk = self._measured_by[_PELVIS]._replace(gyro=np.zeros(3))
        self._state = state

    def _measure(self, state: State) -> None:
        """Select the sensor data that the kernels read in this cycle, and replace lost data by estimates.

        The data of an IMU is used unless it is too old, or the HAL has reported in this walk that it is implausible. The torso
        IMU replaces the pelvis IMU. Without both, the walk ends with a stop step, and the angular velocity is computed from the
        stance leg (`Stage.gyro_source`). If the data of a foot is too old, the load on this foot is estimated.

        Args:
            state: measured state of the robot.
        """
        if state is not self._state:
            self._bind(state)
        if state.implausible_imus:
            self._distrusted |= state.implausible_imus
        replaced, source = self._is_unusable(state, _PELVIS), TRUNK
        self._measured = self._measured_by[_TORSO if replaced else _PELVIS]
        if replaced and self._is_unusable(state, _TORSO):
            self._measured = self._without_trunk
            source = SOLE if any(self._is_unusable(state, tibia) for tibia in _TIBIAE) else TIBIA
            self.stop()
        if source != self._gyro_source:
            self._stage.gyro_source = self._gyro_source = source
        if self.config.heading_reference and not replaced:
            self._observer.follow_heading(state.imu_quaternion[_PELVIS].tolist())
        feet = [side for side, row in enumerate(state.foot_rows) if state.age.item(row) > SENSOR_AGE]
        if len(feet) == 1:
            self._forces[:] = state.foot_force
            self._forces[feet[0], :, 2] = self._load_without(feet[0]) / len(CELLS)
            self._measured = self._measured._replace(force=self._forces)
        elif feet:
            self._forces[:] = 0.0
            self._forces[:, :, 2] = self._loads_without_feet()[:, None] / len(CELLS)
            self._measured = self._measured._replace(force=self._forces)
        if state.torque_sent is None:
            self._sent[:] = self._pid.requested

    def _is_unusable(self, state: State, imu: int) -> bool:
        """Return whether the data of an IMU is too old, or was implausible in this walk."""
        lost = bool(state.imu_rows) and state.age.item(state.imu_rows[imu]) > SENSOR_AGE
        return lost or imu in self._distrusted

    def _vertical_of_stance_leg(self, state: State) -> Vector:
        """Return the upward unit vector in the axes of the pelvis, shape (3,), without the data of the trunk IMUs.

        It follows from the encoders of the stance leg, and from the attitude that its tibia IMU reports. If a tibia IMU cannot be
        used, the sole of the stance foot counts as level.

        Args:
            state: measured state of the robot.
        """
        sole = self._parts.chain.soles[self._stance]
        if self._gyro_source == SOLE:
            return sole.rotation[:, 2]
        tibia = rotation_of(state.imu_quaternion[_TIBIAE[self._stance]].tolist())
        up: Vector = self._parts.chain.links[sole.link - FOOT_TO_TIBIA].rotation @ tibia[2]
        return up

    def _load_without(self, side: int) -> float:
        """Estimate the vertical load on a foot whose data is lost [N] from the load on the other foot.

        Let f be the fraction of the weight that the other foot does not carry. The estimate is 0 up to f = `_LOAD_ERROR`, and
        rises linearly to the weight at f = 1.

        Args:
            side: index of the foot in FEET.
        """
        weight = self._constants.weight
        missing = 1.0 - float(self._forces[1 - side, :, 2].sum()) / weight
        return weight * min(1.0, max(0.0, missing - _LOAD_ERROR) / (1.0 - _LOAD_ERROR))

    def _loads_without_feet(self) -> Vector:
        """Estimate the vertical loads on both feet without the data of the feet, from the kinematics of the last cycle.

        In a step, the stance foot carries the weight until the swing foot is at most `_LANDED_HEIGHT` above the stance foot. With
        both feet on the ground, the position of the centre of mass between the soles gives the loads.

        Returns:
            Loads on the left and the right foot, shape (2,) [N].
        """
        chain, step, weight = self._parts.chain, self._step, self._constants.weight
        height = float(step[2]) if self._stance == LEFT else -float(step[2])
        if self.phase in STEPPING and height > _LANDED_HEIGHT:
            right = float(self._stance == RIGHT)
        else:
            lever = self._observer.rotation @ (chain.centre[0].position - chain.soles[LEFT].position)
            right = min(1.0, max(0.0, float(lever[:2] @ step[:2] / (step[:2] @ step[:2]))))
        return weight * np.array([1.0 - right, right])

    def _facts(self, elapsed: int) -> Facts:
        phase, nominal, landed = self.phase, len(self._table.rows) - 1, False
        load = self._load.tolist()
        self._loaded = self._loaded + 1 if min(load) >= self._carrying else 0
        if phase in STEPPING:
            # In a step, `elapsed` counts rows of the table of the desired motion.
            # The number of rows per cycle can be above or below 1, because step timing changes the speed of the step.
            elapsed = int(self._clock.item() + self._pace.item())
            swing = 1 - self._stance
            contact = contact_force(load[swing], self._twist.item(swing))
            landed = self._landed = self._impact.update(contact, elapsed / nominal)
        loaded = self._loaded >= self._settled
        stopping = self._stopping or self.steps_begun >= self.steps_wanted
        return Facts(elapsed, nominal, self._rest, self._timeout, landed, loaded, stopping)

    def _begin(self, phase: Phase, state: State) -> None:
        """Start a phase: set stance leg and steering, start the re-centring from the measured motion, and start the guide."""
        before, stage, record = self.phase, self._stage, self._record
        swing = 1 - self._stance
        if before in STEPPING:
            self.steering.land(swing, self._step, self._heading)
            self.statistics.steps += before is Phase.STEP
            self.statistics.unnoticed += not self._landed
        if phase is Phase.START:
            self.steering.begin(self._step, self._heading)
        if phase in (Phase.STEP, Phase.STOP):
            self._stance = swing
        if phase in STEPPING:
            self._impact.start_step()
        # In FINISH_STEP, the HAL enters HOLD (all joints hold their positions) if the step number changes or becomes None.
        # A robot on one foot falls in HOLD. So the controller keeps the step number until the robot stands on both feet.
        if phase not in WALKING:
            self._command.step = None
        elif phase is Phase.SHIFT or (phase in STEPPING and not self._finishing):
            self._command.step = 0 if phase is Phase.SHIFT else (self._command.step or 0) + 1
        self._command.walking = phase in WALKING
        stage.stance, stage.double = self._stance, phase not in STEPPING
        if phase is Phase.STEP and self.config.turn:
            self.steering.turn()
        stage.steering = self.steering.offset() if phase is Phase.STEP else 0.0
        steps = self.statistics.steps
        if phase is Phase.STEP and steps == self._section.end:
            self._section = self._sections[self._sections.index(self._section) + 1]
        self.phase, self._since, self._table = phase, state.cycle, self._section.tables[phase, self._stance]
        stage.literal = self.config.literal_law and phase is Phase.STEP
        self._pid.limit_integral(math.inf if stage.literal else self.config.gains.integral_limit)
        guided = phase is Phase.STEP and state.assistance_factor < 1.0 and steps >= self._section.guided
        self._command.loop_late = guided and self._loop_delay.confirmed
        self.statistics.guide.late += self._command.loop_late
        self._assisted = stage.assisted = guided and not self._command.loop_late
        stage.last_guided = len(self._section.assistance.unmodelled) - 1
        stage.placed = phase in (Phase.START, Phase.STEP) and not self._assisted and not stage.literal
        self._start(self._measured, self._table, self._parts)
        self._start_guide(min(1.0, max(0.0, state.assistance_factor)))
        record.feet[:], record.yaw = self.steering.feet.reshape(-1), self.steering.yaw
        record.phase, record.step, record.stance = phase, self.statistics.steps, self._stance

    def _start_guide(self, xi: float) -> None:
        """Start the guide of a step."""
        stage, record, statistics = self._stage, self._record, self.statistics.guide
        self._clear_guide_record()
        self._command.vibration.fill(0.0)
        self._promised = False
        if not self._assisted:
            return
        leg = _LEG * (1 - self._stance)
        angles = float(stage.deviation[leg + _SH]), float(stage.deviation[leg + _SK])
        rates = float(stage.rate[leg + _SH]), float(stage.rate[leg + _SK])
        promise = self._section.start_guide(xi, angles, rates)
        self._start_deviation, self._promised = (angles, rates), promise > 0.0
        statistics.factors.add(xi)
        record.assistance_factor, stage.intensity = xi, intensity(xi)

    def _clear_guide_record(self) -> None:
        """Write the values of a motion without a guide into the telemetry."""
        record = self._record
        record.assistance_factor, record.gate, record.h = 1.0, 0.0, 1.0
        record.error[:], record.q_bound[:] = 0.0, 0.0

    def _watch_guide(self, cycle: int) -> None:
        """Update the statistics of the guide, and set three flags of the command: `outside`, `guide_left`, `hand_over_exceeded`.

        `Command.outside` reports h < 0: the swing leg is outside the guide, or a quantity of the worst-case prediction (error,
        torque or speed) exceeds its limit.

        Args:
            cycle: cycles since the start of the step.
        """
        command, guide = self._command, self.config.guide
        guided = self._assisted and cycle <= self._stage.last_guided
        command.hand_over_exceeded = guided and cycle == 0 and self._check_hand_over()
        command.outside = False
        if guided:
            hip, knee, hip_bound, knee_bound, h, gate = self._guarded.tolist()
            command.outside = h < 0.0
            ratio = max(_ratio(hip, hip_bound), _ratio(knee, knee_bound))
            self.statistics.guide.count(cycle, ratio, h, gate > guide.active)
        command.guide_left = self._outside.update(command.outside, self._promised)

    def _check_hand_over(self) -> bool:
        """Return whether the start deviations of a step exceed the deviations for which its guide is certified. Count the step.

        The guide is certified for deviations inside the hand-over box (`HandOver`). Only steps with a certified guide are checked
        and counted. The torque jump is known after the first cycle of the step.
        """
        if not self._promised:
            return False
        leg = _LEG * (1 - self._stance)
        joints = [leg + _SH, leg + _SK]
        accelerations = (self._measured.qd - self._velocity_before)[joints] / PERIOD
        jumps = (self._torque_before - self._command.torque)[joints]
        inside = self.config.guide.hand_over.contains(
            *self._start_deviation,
            (float(accelerations[0]), float(accelerations[1])),
            (float(jumps[0]), float(jumps[1])),
        )
        self.statistics.guide.hand_overs += 1
        self.statistics.guide.hand_overs_exceeded += not inside
        return not inside


def _ratio(error: float, bound: float) -> float:
    """Return |e| / q_bound of a joint; infinity if the guide has no width."""
    return abs(error) / bound if bound else math.inf


def _range(robot: Robot, config: WalkConfig) -> tuple[Vector, Vector]:
    """Return the smallest and the largest joint angles that lean, foot placement and steering may request [rad].

    Returns:
        Lower limits and upper limits, each of shape (12,).
    """
    low, high = robot.position_min + _MARGIN, robot.position_max - _MARGIN
    low[[_SK, _LEG + _SK]] = config.reach_knee
    # The transverse hip may use its full range. Even without a turn, steering moves it to within 0.4 degrees of a limit.
    turning = [_TH, _LEG + _TH]
    low[turning], high[turning] = robot.position_min[turning], robot.position_max[turning]
    return low, high
