"""Walk of `atalante walk` on the ground, with a patient in the exoskeleton. The walk starts and ends in standing.

gaits of the subject -> walking controller -> rig on the ground -> progress, outcome
"""

from __future__ import annotations

import json
import math
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from atalante_hal.robot import IMUS
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message, show_json
from atalante_tools.session.law import Law
from atalante_tools.session.recording import (
    EndpointReport,
    Outputs,
    Recorder,
    RecordingOptions,
    close_telemetry,
    outlet_of,
    require_complete,
    require_complete_log,
    require_format,
    start_telemetry,
)
from atalante_tools.session.run_folder import run_folder

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import WalkGaits
    from atalante_control.guide.certificate import Certificate
    from atalante_control.guide.statistics import GuideStatistics
    from atalante_control.model import Patient
    from atalante_control.walking.controller import WalkController
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator
    from atalante_hal.hal import Hal
    from atalante_hal.robot import Robot
    from atalante_hal.telemetry.child import TelemetryChild
    from atalante_hal.telemetry.process import Recording
    from atalante_hal.types import State, Vector
    from atalante_tools.session.rig import Rig
    from atalante_tools.session.walk_trace import WalkTrace

#: Patient of the walk file of this project: mass [kg] and height [m].
DEFAULT_PATIENT: Final = (75.0, 1.75)
#: Step of the walk file of this project: length [m] and duration [s].
DEFAULT_STEP: Final = (0.16, 0.8)
#: The robot has fallen if its pelvis leans by more than this angle [rad].
FALLEN: Final = math.radians(35.0)
#: Time for which a robot that left ACTIVE is observed [cycles], because a HOLD within a step may end in a fall.
_AFTERMATH: Final = 1500
#: Row of the pelvis IMU.
_PELVIS: Final = IMUS.index("pelvis")


@dataclass(frozen=True)
class Push:
    """Push at the pelvis of the emulated robot."""

    force: float  # N
    direction: float  # deg, 0 forwards, 90 to the left
    duration: float = 0.2  # s


@dataclass(frozen=True)
class WalkOptions:
    """Options of a walk."""

    steps: int  # number of steps between start step and stop step
    xi: float  # assistance factor, 0 to 1
    shape: str  # name or file of the guide shape
    passive: bool  # whether the limbs of the emulated patient have the impedance of a passive wearer
    subject: Subject | None  # patient and step parameters; None means the values in the walk file
    #: walk file; None means the gait of the network, or the walk file of the project for the default subject
    gait: Path | None
    seed: int  # seed of the sensor noise
    friction: float  # coefficient of friction between soles and floor
    push: Push | None  # push in the middle of the walk; None means no push
    law: Law  # control law of the periodic steps
    #: numbers of steps with full assistance, in the transition to `xi`, and with `xi`; None means that all steps have `xi`
    protocol: tuple[int, int, int] | None = None
    #: options of the recording in `out`, of the CAN log and of telemetry. If the user requests none of these three outputs, no
    #: telemetry process is started
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    out: Path | None = None  # folder for summary.json, trace.npz and walk.png; None means no files


@dataclass
class WalkResult:
    """Result of a walk. The JSON object has the same fields."""

    steps: int  # completed steps of the periodic gait
    fell: bool
    outcome: str  # stood, fell, stopped, hold or fault
    engine: str | None  # None means the real robot
    xi: float
    shape: str | None  # guide shape; None at Xi = 1, where there is no guide
    certified: bool | None  # whether the guide is certified; None at Xi = 1, where there is no guide
    #: disturbance torque of SH for which the guide is built; None if the guide has no promise
    promise_hip_nm: float | None
    #: disturbance torque of SK for which the guide is built; None if the guide has no promise
    promise_knee_nm: float | None
    max_ratio: float | None  # largest tracking error as a fraction of the guide; None if no step was guided
    inside: float | None  # fraction of the guided time with both joints inside the guide; None if no step was guided
    outside_cycles: int  # guided cycles with a joint outside the guide
    filter_active: float | None  # fraction of the guided time with the guide filter active; None if no step was guided
    hand_overs_exceeded: int  # guided steps that started with a larger deviation than the certificate assumes
    full_assist: bool  # whether the HAL changed to full assistance
    lateral_m: float  # sideways deviation from the walking line at the last landing, positive to the left
    yaw_deg: float  # heading of the soles relative to the walking line at the last landing, positive to the left
    #: true value of `lateral_m` at the end of the walk; None if the robot is real or fell
    true_lateral_m: float | None
    true_yaw_deg: float | None  # true value of `yaw_deg` at the end of the walk; None if the robot is real or fell
    #: root mean square of the angle between the true and the estimated vertical during the walk; None if the robot is real
    attitude_rms_deg: float | None
    distance_m: float  # distance along the walking line
    unnoticed: int  # number of steps in which no landing of the foot was detected
    max_dcm_error_m: float  # largest error of the divergent component of motion
    diagnostics: dict[str, int]  # number of occurrences of each diagnostic of the HAL
    real_time_factor: float
    cpu_per_second: float  # processor time of this process per second of the run


def walk(target: Target, options: WalkOptions, *, as_json: bool) -> None:
    """Walk, and print the result.

    Args:
        target: Bus and clock.
        options: Options of the user.
        as_json: Whether to print a JSON object instead of text.

    Raises:
        Failed: If the robot fell or did not walk to the end, or the recording or the CAN log is incomplete.
    """
    from atalante_hal.telemetry.child import TelemetryChild

    outputs = _outputs(options)
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(run_folder(options.out))
        # start the subprocess early: it imports its modules while this process creates the controller
        child = None if outputs is None else stack.enter_context(TelemetryChild())
        _walk(target, options, outputs, child, as_json=as_json)


def _outputs(options: WalkOptions) -> Outputs | None:
    """Return the outputs of the telemetry process; None if the user wants none."""
    recording = options.recording
    if recording.can_log is not None:
        require_format(recording.can_log)
    if not (options.out or recording.can_log or recording.telemetry):
        return None
    file = None if options.out is None else options.out / "recording.mcap"
    return Outputs(file, recording.record_rate, recording.can_log, outlet_of(recording.telemetry))


def _walk(
    target: Target, options: WalkOptions, outputs: Outputs | None, child: TelemetryChild | None, *, as_json: bool
) -> None:
    """Walk as `walk` does, with a subprocess for the outputs."""
    from atalante_control.walking.config import WALK_GUIDE, WalkConfig
    from atalante_control.walking.controller import WalkController
    from atalante_hal.robot import load_robot
    from atalante_hal.types import PERIOD
    from atalante_tools.session.body import describe
    from atalante_tools.session.rig import open_hal
    from atalante_tools.session.shapes import guide_shape
    from atalante_tools.session.walk_trace import WalkTrace

    robot = load_robot()
    patient, gaits = gaits_of(options, robot)
    law = options.law
    config = replace(
        WalkConfig.literal() if law.literal else WalkConfig(),
        guide=replace(WALK_GUIDE, idealization=law.idealization, feedforward=law.feedforward),
    )
    controller = WalkController(robot, patient, gaits, options.steps, config, shape=guide_shape(options.shape))
    guide = _announced(controller, options.xi)
    if not target.lockstep:
        controller.prepare()
    mechanics = operator = None
    if target.embedded:
        from atalante_emulator.mechanics import Ground, Mechanics
        from atalante_emulator.pendant import Operator
        from atalante_emulator.wearer import LimbParameters

        ground, limbs = Ground(friction=options.friction), LimbParameters() if options.passive else None
        mechanics = Mechanics(describe(robot, None, patient), target.engine, ground, limbs)
        operator = Operator()
    with ExitStack() as stack:
        rig = stack.enter_context(
            open_hal(
                target,
                robot=robot,
                seed=options.seed,
                pose=controller.standing_pose.tolist(),
                operator=operator,
                assistance_factor=options.xi if options.protocol is None else 1.0,
                controller_fields=controller.telemetry_fields,
                gait_hash=gaits.step.hash32,
                mechanics=mechanics,
            )
        )
        telemetry = recorder = summary = None
        if outputs is not None:
            about = {"seed": options.seed, "steps": options.steps, "xi": options.xi, **asdict(law)}
            telemetry = start_telemetry(target, outputs, rig.hal, rig.hal.network, gaits.step.hash32, about, child)
            stack.callback(telemetry.close)
            telemetry.begin_run("walk", {"shape": options.shape, "xi": options.xi})
            recorder = Recorder(rig, telemetry, EndpointReport(telemetry))
        observation, trace = Observation(rig, controller, options.push), WalkTrace(controller)
        dial = None
        if options.protocol is not None and operator is not None:
            dial = Dial(operator, options.protocol, options.xi)

        def record() -> None:
            trace.sample(rig.hal.state.cycle)
            if recorder is not None:
                recorder.write()
            if dial is not None:
                dial.turn(controller.statistics.steps)

        with stop_requested() as stop:
            watch = WalkWatch(rig, controller, observation, stop, options.steps)
            processor = time.process_time()
            statistics = rig.run(controller, until=watch, record=record, on_stop=controller.stop)
            processor = time.process_time() - processor
        if recorder is not None and telemetry is not None:
            recorder.report_events()
            summary = close_telemetry(telemetry)
        result = WalkResult(
            steps=controller.statistics.steps,
            fell=observation.fell,
            outcome=watch.outcome,
            engine=target.engine if target.embedded else None,
            xi=options.xi,
            **_guided(_weakest(controller, guide), controller.statistics.guide),
            full_assist=watch.full_assist,
            lateral_m=round(controller.steering.lateral, 3),
            yaw_deg=round(math.degrees(controller.steering.yaw), 2),
            **observation.true_deviation(),
            attitude_rms_deg=observation.attitude_rms_deg,
            distance_m=round(controller.steering.distance, 2),
            unnoticed=controller.statistics.unnoticed,
            max_dcm_error_m=round(controller.max_dcm_error, 4),
            diagnostics=_diagnostics(rig.hal),
            real_time_factor=round(statistics.real_time_factor, 2),
            cpu_per_second=round(processor / (statistics.cycles * PERIOD), 4),
        )
        if as_json:
            show_json(asdict(result))
        else:
            _show(result)
        if options.out is not None:
            _write(options.out, options, result, trace, None if summary is None else summary.recording)
        watch.conclude()
        if summary is not None:
            require_complete(summary.recording)
            require_complete_log(options.recording.can_log, summary.can_log_complete)


def _write(out: Path, options: WalkOptions, result: WalkResult, trace: WalkTrace, recording: Recording | None) -> None:
    """Write options and result to summary.json, and the trace and its figure, and print the names of the files."""
    subject, law = None if options.subject is None else str(options.subject), asdict(options.law)
    given = {key: value for key, value in asdict(options).items() if key not in ("out", "recording", "law")}
    given = {**given, **law, "subject": subject, "record_rate": options.recording.record_rate}
    for name, path in (("gait", options.gait), ("telemetry", options.recording.telemetry)):
        given[name] = None if path is None else str(path)
    recorded = None if recording is None else asdict(recording)
    content = {"options": given, "result": asdict(result), "recording": recorded, "version": version("atalante-hal")}
    (out / "summary.json").write_text(json.dumps(content, indent=2) + "\n")
    files = [] if recording is None else recording.files
    print_message(f"in {out}: {', '.join([*files, 'summary.json', *trace.write(out)])}")


def _announced(controller: WalkController, xi: float) -> Certificate | None:
    """Print the certificate of the guide, and return it; None at Xi = 1, where there is no guide."""
    if xi >= 1.0:
        return None
    from atalante_tools.session.certificates import announce

    certificate = controller.certificate(xi)
    leg = "leg of exoskeleton and patient, while the pelvis moves as in the gait, until the foot touches the ground"
    announce([certificate], controller.config.guide.mismatch, leg)
    return certificate


def _weakest(controller: WalkController, announced: Certificate | None) -> Certificate | None:
    """Return the certificate with the smallest promise, among the certificates of all assistance factors of the walk.

    Args:
        controller: Controller of the walk.
        announced: Certificate at the assistance factor of the user; None at Xi = 1.
    """
    if announced is None:
        return None
    walked = [controller.certificate(xi) for xi in sorted(controller.statistics.guide.factors)]
    return min(walked or [announced], key=lambda c: -1.0 if c.promise is None else c.promise.hip)


def _diagnostics(hal: Hal) -> dict[str, int]:
    """Return the number of occurrences of each diagnostic in the events of the HAL."""
    from atalante_hal.safety.diagnostics import Dtc

    codes, counts = {dtc.value for dtc in Dtc}, dict[str, int]()
    for event in hal.events:
        if event.code in codes:
            counts[event.code] = counts.get(event.code, 0) + event.count
    return counts


def _guided(certificate: Certificate | None, statistics: GuideStatistics) -> dict[str, Any]:
    """Return the fields of `WalkResult` about the guide."""
    promise = None if certificate is None else certificate.promise
    counted = statistics.cycles > 0
    return {
        "shape": None if certificate is None else certificate.shape,
        "certified": None if certificate is None else certificate.certified,
        "promise_hip_nm": None if promise is None else promise.hip,
        "promise_knee_nm": None if promise is None else promise.knee,
        "max_ratio": round(statistics.max_ratio, 3) if counted else None,
        "inside": round(statistics.inside_fraction, 6) if counted else None,
        "outside_cycles": statistics.cycles - statistics.inside,
        "filter_active": round(statistics.active_fraction, 3) if counted else None,
        "hand_overs_exceeded": statistics.hand_overs_exceeded,
    }


def gaits_of(options: WalkOptions, robot: Robot) -> tuple[Patient, WalkGaits]:
    """Return the patient and the gaits of a walk.

    Args:
        options: Options of the user.
        robot: Limits of the joints.

    Raises:
        GaitError: If the walk file is invalid, or if there is no start step or no stop step for the gait.
        NetworkError: If the subject is outside the range of the network.
        Failed: If the gait optimisation is needed, but not installed.
    """
    from atalante_control.gait.walk import DEFAULT_WALK, check_walk, load_walk
    from atalante_control.model import Patient

    if options.gait is not None or options.subject is None or _is_default(options.subject):
        gaits = load_walk(options.gait or DEFAULT_WALK, robot)
        parameters = gaits.step.parameters
        if options.subject is not None:
            return options.subject.patient, gaits
        try:
            return Patient(parameters["patient_mass"], parameters["patient_height"]), gaits
        except KeyError as error:
            raise Failed(
                f"the parameters of the step in {options.gait} must contain {error.args[0]}: add --mass and --height"
            ) from error
    from atalante_control.dynamics.gait_network import load_network

    step = load_network().gait(options.subject, robot)
    print_message(f"solving start step and stop step for {options.subject}")
    from atalante_tools.session.extra import extra

    with extra():
        from atalante_control.gait_optimization.walk import solve_walk

        gaits = solve_walk(options.subject, step)
    check_walk(gaits, robot)
    return options.subject.patient, gaits


def _is_default(subject: Subject) -> bool:
    patient = subject.patient
    return ((patient.mass, patient.height), (subject.step_length, subject.step_duration)) == (
        DEFAULT_PATIENT,
        DEFAULT_STEP,
    )


class Dial:
    """Assistance dial of the emulated operator, which changes the assistance factor from step to step."""

    def __init__(self, operator: Operator, protocol: tuple[int, int, int], xi: float) -> None:
        """Set the dial to full assistance.

        Args:
            operator: Operator of the emulated pendant.
            protocol: Numbers of steps with full assistance, in the transition, and with `xi`.
            xi: Assistance factor at the end.
        """
        self._operator, self._set = operator, 1.0
        self._full, self._transition, _ = protocol
        self._xi = xi
        operator.assist(self._set)

    def turn(self, steps: int) -> None:
        """Turn the dial to the assistance factor of the next step. It acts from the next stance change on.

        Args:
            steps: Number of completed steps.
        """
        share = min(1.0, max(0.0, (steps + 2 - self._full) / (self._transition + 1)))
        factor = round(1.0 + share * (self._xi - 1.0), 4)
        if factor != self._set:
            self._set = factor
            self._operator.assist(factor)


class Observation:
    """Attitude and path of the robot during the walk, and the push. For an emulated robot, the true values are read.

    Attributes:
        fell: Whether the pelvis has leaned by more than `FALLEN`.
    """

    def __init__(self, rig: Rig, controller: WalkController, push: Push | None) -> None:
        """Add the push to the emulated robot.

        Args:
            rig: Rig of the walk.
            controller: Controller of the walk.
            push: Push in the middle of the walk; None means no push.
        """
        self.fell = False
        self._rig, self._controller, self._push = rig, controller, push
        self._pushed = 0
        self._squares, self._count = 0.0, 0  # sum of the squared attitude errors [rad2], and their number
        self._origin: tuple[float, float, float] | None = None
        if push is not None and rig.emulator is not None:
            rig.emulator.pelvis_forces.append(self._wrench)

    def check(self) -> bool:
        """Return whether the robot has fallen."""
        emulator = self._rig.emulator
        if emulator is None:
            upright = float(self._controller.vertical[2])
        else:
            # The axes of the pelvis IMU are parallel to those of the pelvis.
            x, y, z, w = emulator.body.imu[_PELVIS, :4].tolist()
            upright = 1.0 - 2.0 * (x * x + y * y)
            if self._controller.walking:
                if self._origin is None:
                    self._origin = _stance(emulator)
                a, b, c = self._controller.vertical.tolist()
                self._squares += (
                    (2.0 * (x * z - w * y) - a) ** 2 + (2.0 * (y * z + w * x) - b) ** 2 + (upright - c) ** 2
                )
                self._count += 1
        self.fell = self.fell or upright < math.cos(FALLEN)
        return self.fell

    @property
    def attitude_rms_deg(self) -> float | None:
        """Return the root mean square of the error of the estimated vertical during the walk [deg]; None if not known."""
        return round(math.degrees(math.sqrt(self._squares / self._count)), 3) if self._count else None

    def true_deviation(self) -> dict[str, Any]:
        """Return the fields of `WalkResult` for the true deviation from the start line; the values are None if not known."""
        emulator, lateral, yaw = self._rig.emulator, None, None
        if emulator is not None and self._origin is not None and not self.fell:
            (x0, y0, yaw0), (x, y, yaw1) = self._origin, _stance(emulator)
            lateral = round(math.cos(yaw0) * (y - y0) - math.sin(yaw0) * (x - x0), 3)
            yaw = round(math.degrees(math.remainder(yaw1 - yaw0, math.tau)), 2)
        return {"true_lateral_m": lateral, "true_yaw_deg": yaw}

    def _wrench(self, _hal_state: int) -> Vector:
        """Return the push of this cycle. The push begins when the middle step of the walk reaches phase 0.3."""
        import numpy as np

        from atalante_hal.types import PERIOD

        wrench = np.zeros(6)
        assert self._push is not None
        controller, push = self._controller, self._push
        if self._pushed == 0 and not controller.halfway:
            return wrench
        self._pushed += 1
        if self._pushed * PERIOD <= push.duration:
            angle = math.radians(push.direction)
            wrench[:2] = push.force * math.cos(angle), push.force * math.sin(angle)
        return wrench


def _stance(emulator: Emulator) -> tuple[float, float, float]:
    """Return the true middle between the feet [m] and the mean heading of both feet [rad]."""
    from atalante_emulator.bodies.links import FOOT_LINKS

    x = y = ahead = left = 0.0
    for link in FOOT_LINKS:
        motion = emulator.body.motion(link)
        i, j, k, w = motion.attitude.tolist()
        x, y = x + 0.5 * float(motion.position[0]), y + 0.5 * float(motion.position[1])
        ahead, left = ahead + 1.0 - 2.0 * (j * j + k * k), left + 2.0 * (i * j + w * k)
    return x, y, math.atan2(left, ahead)


class WalkWatch:
    """End condition of a walk, called once per cycle. It also prints the progress line.

    Attributes:
        outcome: How the walk ended: stood, fell, stopped, hold or fault.
        full_assist: Whether the HAL changed to full assistance.
    """

    def __init__(self, rig: Rig, controller: WalkController, observation: Observation, stop: Any, steps: int) -> None:
        """Create the end condition of one walk.

        Args:
            rig: Rig of the walk.
            controller: Controller of the walk.
            observation: Attitude of the robot.
            stop: Stop request of the process.
            steps: Number of steps that the user requested.
        """
        from atalante_tools.console.terminal import Progress

        self._rig, self._controller, self._observation, self._stop = rig, controller, observation, stop
        self._steps, self._progress, self._started = steps, Progress(), False
        self.outcome, self._reason, self._halted = "hold", "", 0
        self.full_assist = False

    def __call__(self, state: State) -> bool:
        """Return whether the walk is over. Print the progress line if it is due.

        Args:
            state: State of the robot after a cycle.
        """
        from atalante_hal.types import SupervisorState
        from atalante_tools.session.rig import waiting_for

        moving = self._rig.hal.moving
        self.full_assist = self.full_assist or state.supervisor is SupervisorState.FULL_ASSIST
        if moving and not self._started:
            self._started = True
            self._progress.clear()
            print_message(f"ACTIVE on {self._rig.target}; Ctrl-C ends with a stop step")
        over = self._observation.check()
        if over:
            self.outcome = "fell"
        elif moving:
            over = self._controller.done
            finishing = state.supervisor is SupervisorState.FINISH_STEP
            if finishing and not self._reason:
                self._reason = self._rig.hal.reason
                self._progress.clear()
                print_message(f"FINISH_STEP: {self._reason}")
            self.outcome = ("stopped" if self._stop.wanted or finishing else "stood") if over else self.outcome
        else:
            fault = state.supervisor is SupervisorState.FAULT
            self._halted += self._started
            over = self._halted > _AFTERMATH or (not self._started and (self._stop.wanted or fault))
            self.outcome = "fault" if fault else self.outcome
        if not moving and self._started and not self._reason:
            self._reason = self._rig.hal.reason
        if over:
            self._progress.clear()
            self._reason = self._reason or self._rig.hal.reason
        elif self._progress.due():
            self._progress.show(self._describe(state) if moving else waiting_for(self._rig))
        return over

    def _describe(self, state: State) -> str:
        controller = self._controller
        largest = controller.statistics.guide.max_ratio
        guide = f"   Xi {state.assistance_factor:.2f}   largest |e|/q_bound {largest:.2f}" if largest else ""
        return (
            f"{controller.phase.name:<7} step {controller.statistics.steps:3d}/{self._steps}   t {state.time:6.1f} s   "
            f"{controller.steering.distance:5.2f} m   sideways {controller.steering.lateral:+.2f} m   "
            f"heading {math.degrees(controller.steering.yaw):+.1f} deg{guide}"
        )

    def conclude(self) -> None:
        """End the command with an error unless the robot walked to the end.

        Raises:
            SystemExit: If a signal ended the walk, with its exit code.
            FaultLatched: If the robot is in FAULT.
            Failed: If the robot fell, or left ACTIVE early.
        """
        from atalante_hal.safety.start import WALK_ENDS
        from atalante_tools.console.outcome import FaultLatched

        if self.outcome == "fell":
            raise Failed(f"the robot fell in step {self._controller.statistics.steps}: {self._reason}")
        if self._stop.wanted:
            print_message("stopped, the robot is in HOLD")
            raise SystemExit(self._stop.exit_code)
        if self.outcome == "fault":
            raise FaultLatched(f"the robot is in FAULT: {self._reason}")
        if self.outcome == "stopped":
            if self._reason != WALK_ENDS:
                raise Failed(f"the robot ended the walk early and stands: {self._reason}")
            print_message("stopped by the operator, the robot stands in HOLD")
        elif self.outcome != "stood":
            raise Failed(f"the robot went to HOLD: {self._reason}")


def _show(result: WalkResult) -> None:
    import click

    guided = ""
    if result.max_ratio is not None:
        certified = "certified" if result.certified else "NOT CERTIFIED"
        guided = (
            f"; {result.shape} at Xi {result.xi:g} ({certified}): largest |e|/q_bound {result.max_ratio:.3f}, "
            f"{result.outside_cycles} ms outside the guide"
        )
    click.echo(
        f"{result.outcome} after {result.steps} steps and {result.distance_m:.2f} m: sideways {result.lateral_m:+.3f} m, "
        f"heading {result.yaw_deg:+.2f} deg, largest DCM error {1000.0 * result.max_dcm_error_m:.0f} mm, "
        f"{result.real_time_factor:.2f} times real time{guided}"
    )
