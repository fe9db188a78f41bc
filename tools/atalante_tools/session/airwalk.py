"""Trial of `atalante demo` and `atalante airwalk`: walks in the air inside virtual guides (first experiment of the paper).

guide shape -> certificate (printed) -> steps -> recording, summary.json, figure
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from atalante_tools.console.names import find
from atalante_tools.console.options import SEED, Between, Target, json_option, options_as, subject_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import say, show_json
from atalante_tools.session.run_folder import Result, results_table, run_folder, write_summary

if TYPE_CHECKING:
    from atalante_control.airwalk.controller import AirwalkController
    from atalante_control.gait.gait import Gait
    from atalante_control.gait.subject import Subject
    from atalante_control.guide.certificate import Certificate
    from atalante_control.guide.shapes import GuideShape
    from atalante_control.model import ExoskeletonParameters
    from atalante_dbc import Network
    from atalante_hal.hal import Hal
    from atalante_hal.loop import Statistics
    from atalante_hal.robot import Robot
    from atalante_hal.telemetry.process import Recording, TelemetryProcess
    from atalante_hal.types import State
    from atalante_tools.session.embedded import EmbeddedRobot
    from atalante_tools.session.rig import Rig

_Command = TypeVar("_Command", bound=Callable[..., Any])
#: Names of the guide shapes, copied from `shapes.SHAPES` because the help must not import the slow controller.
SHAPE_NAMES = "constant, widening, narrowing, pinched, asymmetric, snap"
#: Longest wait for the telemetry process before a run on the wall clock [s]. A process that is ready later joins the run.
_TELEMETRY_WAIT = 5.0
#: Period of the check of the telemetry process [cycles].
_TEND_CYCLES = 250


@dataclass(frozen=True)
class Options:
    """Options of a trial."""

    steps: int  # number of right-stance steps per guide shape
    xi: float  # assistance factor, 0 to 1
    seed: int  # seed of the sensor noise
    out: Path  # run folder
    record_rate: int  # recording rate [Hz]
    can_log: Path | None  # log file for all CAN frames. None: no CAN log.
    telemetry: (
        Path | None
    )  # TOML file with endpoint, TLS certificate and users. None: publish on the loopback interface only.
    subject: Subject | None = None  # patient and step parameters: inputs of the gait network. None: default gait.


@dataclass
class Walked:
    """Results and recording of a trial. The recording and the state of the CAN log are set when the telemetry is closed."""

    results: list[Result] = field(default_factory=list)  # one result per finished guide shape
    recording: Recording | None = None  # None until the telemetry is closed
    can_log_complete: bool = True  # False if frames are missing in the CAN log


def _record_rate(text: str) -> int:
    """Convert a typed recording rate to a number [Hz] (option type). It must be a divisor of the loop rate 1000 Hz.

    Args:
        text: Rate as the user typed it.

    Raises:
        click.BadParameter: If the text is not a divisor of 1000.
    """
    if text.isdecimal() and int(text) and not 1000 % int(text):
        return int(text)
    raise click.BadParameter(f"must be a divisor of 1000 (1, 10, 50, 100, 200, 250, 500, 1000, ...), got {text!r}")


def trial_options(steps: int, out: str) -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of a trial to a command and passes them to it as the argument `options`.

    Args:
        steps: Default of `--steps`.
        out: Default of `--out`.
    """
    options = [
        click.option("--steps", type=click.IntRange(1), default=steps, show_default=True, metavar="N",
                     help="Number of right-stance steps per guide shape."),
        click.option("--xi", type=Between(0.0, 1.0), default=0.5, show_default=True, metavar="X",
                     help="Initial assistance factor Xi from 0 (guide of +-7.5 deg) to 1 (guide of +-0.5 deg). The pendant may "
                          "change it."),
        click.option("--seed", type=SEED, default=0, show_default=True, metavar="N",
                     help="Seed of the emulated sensor noise."),
        click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=out, show_default=True,
                     metavar="DIR", help="Folder for recording.mcap, summary.json and guide_shapes.png. Existing files are "
                                         "replaced."),
        click.option("--record-rate", type=_record_rate, default="100", show_default=True, metavar="HZ",
                     help="Recording rate [Hz]. It must be a divisor of 1000. With 1000, every cycle is recorded."),
        click.option("--can-log", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                     help="Log every CAN frame to this file. The suffix sets the format: .log, .asc, .blf, .log.gz, .asc.gz.  "
                          "[default: no CAN log]"),
        click.option("--telemetry", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                     help="TOML file with Zenoh endpoint, TLS certificate and users.  "
                          "[default: publish on the loopback interface only]"),
    ]  # fmt: skip

    return options_as("options", Options, [*options, json_option, subject_options])


def run_trial(target: Target, shapes: Sequence[str], options: Options, *, as_json: bool) -> None:
    """Walk inside one guide shape after another, record the run, and print the results.

    If the run ends early, it keeps its recording and its results.

    Args:
        target: Bus and clock.
        shapes: Names of the guide shapes.
        options: Options of the user.
        as_json: Whether to print JSON objects instead of a table.

    Raises:
        Failed: If the robot left ACTIVE before the last step, or the recording or the CAN log is incomplete.
        FaultLatched: If the robot is in FAULT.
        SystemExit: If a signal ended the run.
    """
    from atalante_control.guide.shapes import SHAPES
    from atalante_hal.telemetry.access import load_telemetry_file

    names = tuple(SHAPES)
    wanted = {name: SHAPES[name] for name in (names[find(shape, names, "guide shape")] for shape in shapes)}
    if options.can_log is not None:
        _require_format(options.can_log)
    outlet = load_telemetry_file(options.telemetry) if options.telemetry else {}
    walked = Walked()
    with run_folder(options.out):
        try:
            _walk_all(target, wanted, options, outlet, walked, as_json=as_json)
        finally:
            if walked.results and walked.recording is not None:
                if as_json:
                    show_json({"recording": asdict(walked.recording)})
                else:
                    click.echo(results_table(walked.results))
                write_summary(options.out, _summary_options(options), walked.results, walked.recording)
    _require_complete(walked.recording)
    if not walked.can_log_complete:
        raise Failed(f"the CAN log {options.can_log} must contain every frame, but frames are missing")


def _require_complete(recording: Recording | None) -> None:
    """Check that the recording is one file that contains every cycle.

    Raises:
        Failed: If cycles are missing or the file is truncated. The message contains the files and the number of missing cycles.
    """
    if recording is not None and not recording.complete:
        raise Failed(
            f"the recording must be one file with every cycle, got {', '.join(recording.files) or 'no file'} "
            f"with {recording.missing_cycles} cycles missing"
        )


def _summary_options(options: Options) -> dict[str, Any]:
    """Return the options for summary.json, as JSON types and without the output paths."""
    given = {key: value for key, value in asdict(options).items() if key not in ("out", "can_log")}
    telemetry = None if options.telemetry is None else str(options.telemetry)
    return {**given, "telemetry": telemetry, "version": version("atalante-hal")}


def _require_format(can_log: Path) -> None:
    from atalante_hal.telemetry.can_log import check_format
    from atalante_hal.telemetry.sink import SinkError

    try:
        check_format(can_log)
    except SinkError as error:
        raise click.UsageError(str(error)) from error


def _walk_all(
    target: Target,
    shapes: Mapping[str, GuideShape],
    options: Options,
    outlet: Mapping[str, Any],
    walked: Walked,
    *,
    as_json: bool,
) -> None:
    """Walk inside one guide shape after another, and add results and recording to `walked`. Raise the errors of `run_trial`."""
    import atalante_dbc
    from atalante_hal.robot import load_robot

    with ExitStack() as stack:
        robot_process = _start_robot(
            target, stack
        )  # start it early: it imports its modules while this process creates the controllers
        network, robot = atalante_dbc.load(), load_robot()
        exoskeleton, gait, controllers = _controllers(options.subject, robot, shapes)
        certificates: dict[str, Certificate] = {}
        telemetry: TelemetryProcess | None = None
        last = [*controllers][-1]
        for name, controller in controllers.items():
            with _open(target, options, network, robot, controller, gait.hash32, robot_process, exoskeleton) as rig:
                robot_process = _start_robot(target, stack) if name != last else None
                if telemetry is None:
                    # The certificates are printed only after the bus could be opened.
                    certificates = {shape: walking.certificate(options.xi) for shape, walking in controllers.items()}
                    _announce(certificates.values())
                    telemetry = _telemetry(target, options, outlet, rig.hal, network, gait.hash32)
                    telemetry.start() if target.lockstep else telemetry.start(_TELEMETRY_WAIT)
                    stack.callback(_close, telemetry, walked)
                    report_endpoint = _EndpointReport(telemetry)
                telemetry.begin_run(name, {"shape": name, "xi": options.xi, **_bounds(certificates[name])})
                walk = _Walk(rig, controller, telemetry, report_endpoint, name, options.steps)
                with stop_requested() as stop:
                    statistics = walk.run(stop)
                factors = controller.statistics.factors or {options.xi}
                walked.results.append(_result(_weakest(controller, factors), controller, rig.hal, statistics))
                if as_json:
                    show_json(asdict(walked.results[-1]))
                walk.conclude()


class _Walk:
    """Run of the robot inside one guide shape. It writes the telemetry and prints the progress line."""

    def __init__(
        self,
        rig: Rig,
        controller: AirwalkController,
        telemetry: TelemetryProcess,
        report_endpoint: _EndpointReport,
        name: str,
        steps: int,
    ) -> None:
        from atalante_tools.session.rig import Watch

        self._rig, self._controller, self._telemetry = rig, controller, telemetry
        self._report_endpoint, self._name, self._steps = report_endpoint, name, steps
        self._reported = 0
        self._watch_of = functools.partial(
            Watch, rig, done=self._done, describe=self._describe, resumes=not rig.target.embedded
        )
        hal = rig.hal
        if telemetry.frames is not None:
            if rig.target.lockstep:
                hal.tap = telemetry.tap(lambda: hal.state.cycle * 1_000_000)
            else:
                hal.tap = telemetry.tap(stamps=lambda: hal.bus.stamps)

    def run(self, stop: Any) -> Statistics:
        """Walk until all steps are done, a stop signal arrives, or the robot leaves ACTIVE.

        Args:
            stop: Stop request of the process.
        """
        self._watch = self._watch_of(stop)
        statistics = self._rig.run(self._controller, until=self._watch, record=self._record)
        self._report_events()
        return statistics

    def conclude(self) -> None:
        """End the command with an error unless all steps are done. See `Watch.conclude`."""
        self._watch.conclude()

    def _record(self) -> None:
        hal = self._rig.hal
        self._telemetry.write(hal.record)
        if not hal.state.cycle % _TEND_CYCLES:
            self._telemetry.tend()
            self._report_endpoint()
        if hal.events.count != self._reported:
            self._report_events()

    def _report_events(self) -> None:
        events = self._rig.hal.events
        for event in events.since(self._reported):
            self._telemetry.event(event.cycle, event.code, event.text, event.severity, event.node, event.value)
        self._reported = events.count

    def _done(self, state: State) -> bool:
        return self._controller.statistics.steps >= self._steps

    def _describe(self, state: State) -> str:
        statistics = self._controller.statistics
        # The statistics contain no ratio before the first step is completed.
        largest = f"   largest |e|/q_bound {statistics.max_ratio:.2f}" if statistics.cycles else ""
        return (
            f"{self._name:<11} step {statistics.steps:3d}/{self._steps}   t {state.time:6.1f} s   "
            f"Xi {state.assistance_factor:.2f}{largest}"
        )


def _controllers(
    subject: Subject | None, robot: Robot, shapes: Mapping[str, GuideShape]
) -> tuple[ExoskeletonParameters, Gait, dict[str, AirwalkController]]:
    """Return the exoskeleton, the gait, and one controller per guide shape. Leg lengths and gait fit the subject."""
    from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.dynamics.suspended import suspended_gait
    from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
    from atalante_control.model import ExoskeletonParameters

    exoskeleton = ExoskeletonParameters()
    if subject is None:
        gait, config = load_gait(AIRWALK_GAIT, robot), AirwalkConfig()
    else:
        exoskeleton = exoskeleton.fitted(subject.patient)
        gait = suspended_gait(load_network().gait(subject, robot), exoskeleton, robot)
        config = AirwalkConfig(feedforward=True)
    controllers = {name: AirwalkController(robot, gait, shape, config, exoskeleton) for name, shape in shapes.items()}
    if subject is not None:  # the gait is valid, because the controllers accepted it
        say(f"gait of the network: {subject}; the exoskeleton is empty")
    return exoskeleton, gait, controllers


def _announce(certificates: Collection[Certificate]) -> None:
    """Print the certificate of each guide shape: the tolerated disturbance torques and the effects that are not included."""
    for certificate in certificates:
        name, xi, bound = certificate.shape, certificate.xi, certificate.joint_torque
        if bound is None:
            say(f"{name}: NOT CERTIFIED at Xi {xi:g}, the robot may leave the guide: {certificate.reason}")
            continue
        say(
            f"{name}: certified on the model at Xi {xi:g} for disturbances of {bound.hip:.2f} Nm at the hip and "
            f"{bound.knee:.2f} Nm at the knee together (worst pose: knee at {math.degrees(bound.worst_knee):.0f} deg); "
            f"{certificate.reason}"
        )
    if any(certificate.certified for certificate in certificates):
        say(
            "a certificate is a margin on the model, no guarantee: joint torque and rate limits, delay, the torque carried "
            "over a step change, and errors of friction and mass are not included"
        )


def _bounds(certificate: Certificate) -> dict[str, Any]:
    """Return the fields `certified`, `bound_hip_nm` and `bound_knee_nm` of `Result` for a certificate."""
    bound = certificate.joint_torque
    return {
        "certified": certificate.certified,
        "bound_hip_nm": None if bound is None else bound.hip,
        "bound_knee_nm": None if bound is None else bound.knee,
    }


def _weakest(controller: AirwalkController, factors: Iterable[float]) -> Certificate:
    """Return the certificate for the assistance factor of the run that has the smallest hip bound."""
    certificates = [controller.certificate(xi) for xi in factors]
    return min(certificates, key=lambda c: -1.0 if c.joint_torque is None else c.joint_torque.hip)


#: Smallest number of processor cores for HAL, telemetry and embedded robot in three processes.
_CORES = 3


def _start_robot(target: Target, stack: ExitStack) -> EmbeddedRobot | None:
    """Start the embedded robot in a subprocess. Return None for a real robot or a computer with too few cores."""
    from atalante_tools.session.embedded import EmbeddedRobot

    robot_process = target.embedded and len(os.sched_getaffinity(0)) >= _CORES
    return stack.enter_context(EmbeddedRobot()) if robot_process else None


def _open(
    target: Target,
    options: Options,
    network: Network,
    robot: Robot,
    controller: AirwalkController,
    gait_hash: int,
    robot_process: EmbeddedRobot | None,
    exoskeleton: ExoskeletonParameters,
) -> Any:
    from atalante_tools.session.rig import open_hal

    return open_hal(
        target,
        network=network,
        robot=robot,
        seed=options.seed,
        assistance_factor=options.xi,
        controller_fields=controller.telemetry_fields,
        gait_hash=gait_hash,
        robot_process=robot_process,
        exoskeleton=exoskeleton,
    )


def _telemetry(
    target: Target, options: Options, outlet: Mapping[str, Any], hal: Hal, network: Network, gait_hash: int
) -> TelemetryProcess:
    from atalante_hal.safety.diagnostics import Dtc
    from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess

    config = TelemetryConfig(
        recording=options.out / "recording.mcap",
        record_rate=options.record_rate,
        can_log=options.can_log,
        lock_step=target.lockstep,
        slots=8192,  # buffer for 8192 cycles, because a demo runs faster than real time and the recorder may pause
        **outlet,
    )
    return TelemetryProcess(
        config,
        hal.layout,
        bus_of={message.frame_id: message.bus for message in network.messages},
        buses=network.buses,
        diagnostics=[dtc.value for dtc in Dtc],
        about={
            "version": version("atalante-hal"),
            "dbc_hash": f"{network.hash32:08x}",
            "config_hash": f"{hal.robot.hash32:08x}",
            "gait_hash": f"{gait_hash:08x}",
            "target": target,
            "seed": options.seed,
            "steps": options.steps,
            "xi": options.xi,
        },
    )


class _EndpointReport:
    """Printer of the Zenoh endpoint. It prints the endpoint at the start and after each change."""

    def __init__(self, telemetry: TelemetryProcess) -> None:
        for notice in telemetry.notices:
            say(notice)
        self._telemetry = telemetry
        self._endpoint: str | None = None
        self()

    def __call__(self) -> None:
        """Print the endpoint if it changed since the last call."""
        endpoint = self._telemetry.endpoint
        if endpoint != self._endpoint:
            self._endpoint = endpoint
            keys = f"keys atalante/{self._telemetry.config.robot}/**"
            say(f"telemetry on Zenoh at {endpoint}, {keys}" if endpoint else "telemetry is no longer published")


def _close(telemetry: TelemetryProcess, walked: Walked) -> None:
    """Close the telemetry, print its messages about lost data, and add its recording to `walked`."""
    summary = telemetry.close()
    walked.recording, walked.can_log_complete = summary.recording, summary.can_log_complete
    for notice in summary.notices:
        if notice not in telemetry.notices:  # the messages in `telemetry.notices` are already printed
            say(notice)
    if not summary.complete and not summary.notices:
        say("the telemetry process ended unexpectedly: the recording may be truncated")


def _result(certificate: Certificate, controller: AirwalkController, hal: Hal, statistics: Statistics) -> Result:
    walking = controller.statistics
    # The statistics start after the first step, so after a run of one step they contain only a single cycle.
    counted = walking.steps >= 2
    return Result(
        shape=certificate.shape,
        **_bounds(certificate),
        steps=walking.steps,
        max_ratio=round(walking.max_ratio, 4) if counted else None,
        inside=round(walking.inside_fraction, 4) if counted else None,
        filter_active=round(walking.active_fraction, 4) if counted else None,
        cycles=statistics.cycles,
        real_time_factor=round(statistics.real_time_factor, 2),
        frames=int(hal.record[hal.layout["frames"]][0]),
        crc_errors=hal.crc_errors,
    )
