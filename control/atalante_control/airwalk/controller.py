"""Controller of the paper for an exoskeleton suspended by its pelvis: `State -> Command`, once per cycle.

    step switch -> q_des = q_nom + s -> PID, gravity, flat foot -> u_t --------------------------.
                                     -> idealization u_i, feedforward u_f, virtual guide u_v ->  merge -> u
                                     -> haptics

Steps alternate between right and left stance. They change by time, because no foot touches the ground in the air. The sagittal
hip and knee (SH, SK) of the swing leg get the assistive torque; every other joint gets the baseline torque. The paper leaves five
points open. This controller decides them as follows:

- *Assistance factor.* Xi changes only at a stance change, where the reference is re-centred and the torque is carried over.
  The width of the guide therefore does not depend on the operator during a step, and the certificate of the step stays valid.
- *Xi towards 1.* Below Xi = 1 the assisted joints get the torque of the guide filter alone. At Xi = 1 they get exactly the torque
  of the baseline controller. Xi changes only at a stance change, so the carry-over makes the command continuous.
- *Gains.* A narrow guide requires a stiff backup policy, but a stiff policy reaches the torque limit in a wide guide. There are
  a few sets of gains. Each step uses the softest set whose certificate includes the requested promise at the Xi of the step. The
  promise is a disturbance torque that does not move the joints out of the guide.
- *Leaving the guide.* In a guide with a promise, a counter rises in each cycle with h below 0 (outside the safe backward
  image). It falls in every other cycle. If the counter exceeds `outside_cycles`, the disturbance is larger than promised. The
  HAL then moves Xi to 1.
- *Carry-over.* At a stance change the torque jumps for three reasons: the re-centring sets the tracking error to zero, the
  control law of each leg changes, and the prediction of the guide filter, which is shorter near the end of a step, returns to
  its full length. The torque jump is compensated, and the compensation fades out within `blend`, so the command is continuous.
  At hip and knee of a leg with a guide, it fades out within `guided_blend`, and it is at most `HandOver.carried`, as the
  certificate assumes. A larger jump remains in the command.
"""

from __future__ import annotations

import numpy as np

from atalante_control.airwalk.carry_over import CarryOver, add_carried
from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.kernel import Measured, Outputs, Parts, run
from atalante_control.airwalk.reference import Deviation, GaitReference, StartMotion
from atalante_control.airwalk.swing_leg import OVERLAP, swing_leg
from atalante_control.airwalk.telemetry import TELEMETRY_FIELDS, AirwalkStatistics, Step, Telemetry
from atalante_control.dynamics.gravity import Gravity
from atalante_control.dynamics.suspended import check_suspended, suspended_gait
from atalante_control.gait.gait import Gait, step_over
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.certificate import Certificate
from atalante_control.guide.filter import GuideFilter
from atalante_control.guide.literal import LiteralConfig, LiteralGuide, no_promise
from atalante_control.guide.loop_delay import LoopDelay
from atalante_control.guide.outside_count import OutsideCount
from atalante_control.guide.shapes import GuideShape
from atalante_control.guide.step_guides import Choice, StepGuides
from atalante_control.joint.flat_foot import LevelFeet
from atalante_control.joint.haptics import intensity
from atalante_control.joint.idealization import AssistedInertia
from atalante_control.joint.pid import LEFT, RIGHT, Pid
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_control.structured import Records, zeros
from atalante_hal.compiled import specialised
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, Robot
from atalante_hal.types import PERIOD, Command, State, Vector

__all__ = ["AirwalkConfig", "AirwalkController"]

Pair = tuple[float, float]

_N, _LEG = len(JOINTS), len(LEG_JOINTS)
_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")
_PELVIS = IMUS.index("pelvis")


class AirwalkController:
    """Airwalk controller, which implements `atalante_hal.types.Controller`.

    Attributes:
        reference: desired trajectories of the left-stance and the right-stance step.
        pid: PIDs of the baseline controller.
        guide: virtual guide filter of the current step, one of `guides`.
        statistics: statistics of the guide since `reset`.
        telemetry: telemetry of the last cycle, for the recording.
        telemetry_fields: name and width of each field of `telemetry`, see `telemetry.Telemetry`.
    """

    telemetry_fields = TELEMETRY_FIELDS

    def __init__(
        self,
        robot: Robot,
        gait: Gait,
        shape: GuideShape,
        config: AirwalkConfig | None = None,
        exoskeleton: ExoskeletonParameters | None = None,
    ) -> None:
        """Build the parts and allocate all arrays, because the control loop must not allocate memory.

        Args:
            robot: limits of the joints.
            gait: right-stance step that repeats.
            shape: shape of the virtual guide.
            config: parameters of the controller. If None, the defaults are used.
            exoskeleton: geometry and masses of the empty exoskeleton. If None, the defaults are used.

        Raises:
            GaitError: If the gait exceeds a limit of the robot or is not periodic, see `suspended.check_suspended`.
        """
        self.config = config = config or AirwalkConfig()
        exoskeleton = exoskeleton or ExoskeletonParameters()
        articulated = pinocchio_model(urdf(exoskeleton, robot))
        self._gravity = Gravity(articulated)
        check_suspended(gait, robot, articulated, self._gravity, config.ankle_offset)
        deadbeat, poses = Deadbeat(gait.duration, config.alpha), gait.tables().q

        self.reference = GaitReference(gait, deadbeat, config.ankle_offset)
        nominal = self.reference.nominal
        self._start_motion = StartMotion(nominal[RIGHT][0], config.startup, robot.velocity_max)
        swinging = [nominal[RIGHT], nominal[LEFT]]  # left leg, right leg
        self._feet = LevelFeet(robot, exoskeleton, articulated, deadbeat, swinging, config.ankle_offset)
        self.pid = Pid(config.gains)
        self._carry = CarryOver(config.blend, config.guided_blend)
        inertia = AssistedInertia(articulated, poses)
        leg = swing_leg(config, gait, inertia, self._gravity)
        self._guides = StepGuides(config, robot, shape, leg, self._carry.guided_blend, OVERLAP)
        self.guide, self._loop_delay = self._guides.filters[-1], LoopDelay()
        of_gait = gait if gait.feedforward is not None else suspended_gait(gait, exoskeleton, robot)
        self._literal = LiteralGuide(
            LiteralConfig(config.gains.swing, config.promise, config.zeta, config.idealization, config.feedforward),
            shape,
            leg,
            of_gait.tables().uf[:, [_SH, _SK]],
        )

        self._cycles, self._share = gait.cycles, np.ones(_N)
        steps: Records[Step] = zeros(Step, 1)
        outputs: Records[Outputs] = zeros(Outputs, 1)
        telemetry = zeros(Telemetry, 1)
        self.telemetry: Vector = telemetry.view(np.float64)
        self._step, self._outputs = steps[0], outputs[0]
        self._step.cycles, self._step.active, self._step.literal = gait.cycles, config.active, config.literal_law
        self._command = Command(self._outputs.torque, self._outputs.vibration)
        self._measured = Measured(
            np.zeros(_N), np.zeros(_N), np.zeros((len(IMUS), 4)), np.zeros((len(IMUS), 3)), np.zeros(_N)
        )
        self._parts = Parts(
            steps=steps,
            links=self._gravity.links,
            pids=self.pid.records,
            ankles=self._feet.ankles,
            cubics=self._feet.cubics,
            literal=self._literal.tables,
            carries=self._carry.records,
            blends=self._carry.blends,
            outputs=outputs,
            telemetry=telemetry,
        )
        self._compile()
        self._forget()

    def _compile(self) -> None:
        """Compile the kernel by one call, and discard the results of the call."""
        inputs = 0, False, np.zeros(2 * _N), self._measured, self.guide.tables, self._parts
        self._run = specialised(run, *inputs)

    @property
    def guides(self) -> list[GuideFilter]:
        """Return the guide filters in ascending order of their gains."""
        return self._guides.filters

    @property
    def desired(self) -> Vector:
        """Return q_des [rad], then q_des' [rad/s] of the most recent cycle, shape (24,).

        Cycles of the start motion do not change these values.
        """
        return self._outputs.desired

    def guide_at(self, xi: float) -> GuideFilter:
        """Return the guide filter that is used at an assistance factor, see `StepGuides.at`.

        Args:
            xi: assistance factor in [0, 1].
        """
        return self.choice(xi).guide

    def prepare(self) -> None:
        """Compute the guides for all assistance factors, see `StepGuides.prepare`. Call this before a walk in real time."""
        if not self.config.literal_law:
            self._guides.prepare()

    def choice(self, xi: float) -> Choice:
        """Return the guide filter for an assistance factor, and the certified torques as a fraction of the requested torques.

        The requested disturbance torques are `config.promise`. The literal law is certified for no torques (fraction 0).

        Args:
            xi: assistance factor in [0, 1].
        """
        return Choice(self._guides.filters[0], 0.0) if self.config.literal_law else self._guides.at(xi)

    @property
    def guided_blend(self) -> Vector:
        """Return the fade-out factors of the carry-over torque for joints with a guide, shape (n,).

        Element i is the fraction of the carry-over torque that is still added in cycle i after the stance change.
        """
        return self._carry.guided_blend

    def certificate(self, xi: float) -> Certificate:
        """Return the certificate of the guide that is used at an assistance factor, see `StepGuides.certificate`.

        Args:
            xi: assistance factor in [0, 1].
        """
        if self.config.literal_law and xi < 1.0:
            return no_promise(self.guide.shape.name, xi)
        return self._guides.certificate(xi)

    def reset(self, state: State) -> None:
        """Discard the last motion, and prepare the start motion from the measured pose to the gait.

        The first torque command is the measured torque. Its difference from the computed torque then fades out (carry-over).

        Args:
            state: measured state of the robot.
        """
        self._forget()
        self._loop_delay.reset(state)
        self._changed_at = state.cycle
        self._start_motion.start(state.position)
        self._carry.start(state.torque)
        if state.torque_sent is not None:
            self.pid.store_request(state.torque_sent)

    def _forget(self) -> None:
        """Clear all data of the last motion."""
        self._walking, self._assisting, self._stance, self._changed_at = False, False, RIGHT, 0
        self._carry.cancel()
        self._carry.limit((), ())
        self.pid.reset()
        self._share.fill(1.0)
        self.pid.start_step(RIGHT, self._share)
        self._command.vibration.fill(0.0)
        self._command.outside = self._command.guide_left = False
        self._command.hand_over_exceeded = self._command.loop_late = False
        self._outside = OutsideCount(self.config.outside_cycles)
        self._promised = False
        #: Angle deviations [rad] and speed deviations [rad/s] of hip and knee at the start of the step.
        self._start: tuple[Pair, Pair] = (0.0, 0.0), (0.0, 0.0)
        self._accelerations = np.zeros(2)  # rad/s2, accelerations of hip and knee before the stance change
        self.telemetry.fill(0.0)
        self.statistics = AirwalkStatistics()

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def update(self, state: State) -> Command:
        """Compute the command of one cycle. If the current step is over, start the next step first.

        Args:
            state: measured state of the robot.

        Returns:
            The command, overwritten by the next call.
        """
        cycle = state.cycle - self._changed_at
        self._command.loop_late = False
        self._loop_delay.update(state)
        if self._walking:
            if step_over(cycle, self._cycles):
                if self._stance == RIGHT:
                    self.statistics.steps += 1
                self._change_step(state, LEFT if self._stance == RIGHT else RIGHT)
                cycle = 0
        elif cycle < self._start_motion.cycles:
            return self._move_to_start(state, cycle)
        else:
            self._walking = True
            self._change_step(state, RIGHT)
            cycle = 0
        row, side = self.reference.row(self._stance, cycle), 1 - self._stance
        level = self.config.flat_foot and self._feet.imu_valid(state, side)
        if self.config.flat_foot and not level:
            row = self._feet.without_imu(state, side, cycle, row)
        measured = self._measured
        measured.q[:], measured.qd[:] = state.position, state.velocity
        measured.attitudes[:], measured.gyros[:] = state.imu_quaternion, state.imu_gyro
        measured.sent[:] = self.pid.requested if state.torque_sent is None else state.torque_sent
        ratio, h, active = self._run(cycle, level, row, measured, self.guide.tables, self._parts)
        if self._assisting:
            self.statistics.count(cycle, ratio, h, active)
        self._command.outside = self._assisting and h < 0.0
        self._command.guide_left = self._outside.update(self._command.outside, self._promised)
        self._command.hand_over_exceeded = cycle == 0 and self._check_hand_over()
        return self._command

    def _move_to_start(self, state: State, cycle: int) -> Command:
        """Follow the start motion with the baseline controller only."""
        self._measured.qd[:] = state.velocity
        row, torque = self._start_motion.row(cycle), self._command.torque
        tracking = self.pid.update(row, state.position, state.velocity, state.torque_sent)
        if self.config.literal_law:
            torque[:] = tracking
        else:
            holding = self._gravity.torque(state.position, state.imu_quaternion[_PELVIS].tolist())
            np.add(tracking, holding, out=torque)
        add_carried(self._carry.records, self._carry.blends, cycle, torque)
        self.pid.store_request(torque)
        self.telemetry[:_N] = row[:_N]
        return self._command

    def _change_step(self, state: State, stance: int) -> None:
        """Start a step: re-centre the desired trajectory, start the guide, and start the carry-over of the torque."""
        self._changed_at, self._stance = state.cycle, stance
        self._command.step = (self._command.step or 0) + 1
        xi = min(1.0, max(0.0, state.assistance_factor))
        if xi < 1.0 and self._loop_delay.confirmed:
            self._command.loop_late, xi = True, 1.0
            self.statistics.late += 1
        else:  # Record only factors that the operator sets. If the loop is late, the controller sets the factor 1.
            self.statistics.factors.add(xi)
        self._assisting = xi < 1.0
        leg = _LEG * (1 - stance)
        hip, knee = leg + _SH, leg + _SK
        self._share.fill(1.0)
        self._share[[hip, knee]] = 0.0 if self._assisting else 1.0
        self.pid.start_step(stance, self._share)
        self._start_guide(xi, self.reference.start_step(stance, state.position, state.velocity), (hip, knee))
        # `_measured` still contains the speeds of the previous cycle.
        self._accelerations[:] = (state.velocity[[hip, knee]] - self._measured.qd[[hip, knee]]) / PERIOD
        if self.config.flat_foot:
            self._feet.start_step(state, 1 - stance)
        if not self._carry.pending:
            self._carry.start(self.pid.requested)
        if self._assisting and not self.config.literal_law:
            self._carry.limit((hip, knee), self.config.hand_over.carried)
        else:
            self._carry.limit((), ())
        step = self._step
        step.stance, step.completed = stance, self.statistics.steps
        step.xi, step.assisted, step.intensity = xi, self._assisting, intensity(xi)

    def _start_guide(self, xi: float, deviation: Deviation, joints: tuple[int, int]) -> None:
        """Start the guide of a step."""
        hip, knee = joints
        angles = float(deviation.angle[hip]), float(deviation.angle[knee])
        rates = float(deviation.rate[hip]), float(deviation.rate[knee])
        self.guide, promise = self.choice(xi)
        self.guide.start_step(xi, angles, rates, promise)
        if self.config.literal_law:
            self._literal.start_step(xi, angles, rates)
        self._start, self._promised = (angles, rates), promise > 0.0

    def _check_hand_over(self) -> bool:
        """Count a step, and return whether the step starts outside the hand-over box of the guide certificate.

        The guide is certified for deviations inside the hand-over box (`HandOver`). Only steps with a certified guide are checked
        and counted, and only after the end of the first right-stance step. The torque jump is known after the first cycle of the
        step.
        """
        if not (self._promised and self._assisting and self.statistics.steps):
            return False
        hip, knee = (_LEG * (1 - self._stance) + joint for joint in (_SH, _SK))
        jump, accelerations = self._carry.records[0].jump, self._accelerations
        inside = self.config.hand_over.contains(
            *self._start,
            (float(accelerations[0]), float(accelerations[1])),
            (float(jump[hip]), float(jump[knee])),
        )
        self.statistics.hand_overs += 1
        self.statistics.hand_overs_exceeded += not inside
        return not inside
