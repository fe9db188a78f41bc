"""Trial of `atalante demo` and `atalante airwalk`: walks in the air inside virtual guides (first experiment of the paper).

guide shape -> certificate (printed) -> steps -> recording, summary.json, figure
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from atalante_tools.console.options import (
    SEED,
    Between,
    GaitFiles,
    Target,
    gait_options,
    json_option,
    options_as,
    subject_options,
)
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message, show_json
from atalante_tools.session.certificates import announce, promise_fields, report_hand_overs, weakest
from atalante_tools.session.law import Law, law_options
from atalante_tools.session.recording import (
    RECORDING_OPTIONS,
    EndpointReport,
    Outputs,
    Recorder,
    close_telemetry,
    outlet_of,
    require_complete,
    require_complete_log,
    require_format,
    start_telemetry,
    telemetry_cores,
)
from atalante_tools.session.run_folder import Result, results_table, run_folder, write_summary
from atalante_tools.session.shapes import guide_shapes

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


@dataclass(frozen=True)
class Options:
    """Options of a walk in the air inside virtual guides."""

    steps: int  # number of right-stance steps (the left leg swings) per guide shape
    xi: float  # assistance factor, 0 to 1
    seed: int  # seed of the sensor noise
    out: Path  # run folder
    record_rate: int  # recording rate [Hz]
    can_log: Path | None  # log file for all CAN frames. None means no CAN log.
    #: TOML file with endpoint, TLS certificate and users. If None, the run publishes on the loopback interface only.
    telemetry: Path | None
    law: Law  # control law of the assisted joints
    #: Patient and step parameters.
    #: With a gait file, the step parameters of `subject` have no effect. If `subject` is None, the patient comes from the file.
    #: Without a gait file, `subject` is the input of the gait network. If `subject` is None, the default gait is walked.
    subject: Subject | None = None
    files: GaitFiles = field(default_factory=GaitFiles)  # files of the gait


@dataclass
class Walked:
    """Results and recording of a trial. `recording` and `can_log_complete` are set when the telemetry is closed."""

    results: list[Result] = field(default_factory=list)  # one result per finished guide shape
    recording: Recording | None = None  # recording of the trial; None until the telemetry is closed
    can_log_complete: bool = True  # False if frames are missing in the CAN log


def trial_options(steps: int, out: str) -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of a trial to a command. The command gets their values as the argument `options`.

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
        *RECORDING_OPTIONS,
    ]  # fmt: skip

    return options_as("options", Options, [*options, law_options(), json_option, subject_options, gait_options])


def run_trial(target: Target, shapes: Sequence[str], options: Options, *, as_json: bool) -> None:
    """Walk inside one guide shape after another, record the run, and print the results.

    If the run ends early, it keeps its recording and its results.

    Args:
        target: Bus and clock.
        shapes: Names or files of the guide shapes, see `guide_shapes`.
        options: Options of the user.
        as_json: Whether to print JSON objects instead of a table.

    Raises:
        Failed: If the robot left ACTIVE before the last step, or the recording or the CAN log is incomplete.
        ShapeError: If a shape file is invalid.
        FaultLatched: If the robot is in FAULT.
        SystemExit: If a signal ended the run.
    """
    options.files.require_patient(options.subject)
    wanted = guide_shapes(shapes)
    if options.can_log is not None:
        require_format(options.can_log)
    outputs = Outputs(
        options.out / "recording.mcap", options.record_rate, options.can_log, outlet_of(options.telemetry)
    )
    walked = Walked()
    with run_folder(options.out):
        try:
            _walk_all(target, wanted, options, outputs, walked, as_json=as_json)
        finally:
            if walked.results and walked.recording is not None:
                if as_json:
                    show_json({"recording": asdict(walked.recording)})
                else:
                    click.echo(results_table(walked.results))
                write_summary(options.out, _summary_options(options), walked.results, walked.recording)
    require_complete(walked.recording)
    require_complete_log(options.can_log, walked.can_log_complete)


def _summary_options(options: Options) -> dict[str, Any]:
    """Return the options for summary.json, as JSON types and without the output paths."""
    given = {key: value for key, value in asdict(options).items() if key not in ("out", "can_log")}
    telemetry, law = None if options.telemetry is None else str(options.telemetry), given.pop("law")
    files = {name: None if path is None else str(path) for name, path in given.pop("files").items()}
    return {**given, **law, **files, "telemetry": telemetry, "version": version("atalante-hal")}


def _walk_all(
    target: Target,
    shapes: Mapping[str, GuideShape],
    options: Options,
    outputs: Outputs,
    walked: Walked,
    *,
    as_json: bool,
) -> None:
    """Walk inside one guide shape after another, and add results and recording to `walked`.

    The raised exceptions are listed in `run_trial`.
    """
    import atalante_dbc
    from atalante_hal.robot import load_robot
    from atalante_hal.telemetry.child import TelemetryChild
    from atalante_tools.session.embedded import EmbeddedRobot, robot_process_wanted

    with ExitStack() as stack:
        parallel = robot_process_wanted(target, telemetry_cores(outputs))
        # start the subprocesses early: they import their modules while this process creates the controllers
        telemetry_child = stack.enter_context(TelemetryChild())
        robot_process = stack.enter_context(EmbeddedRobot(target.engine)) if parallel else None
        network, robot = atalante_dbc.load(), load_robot()
        exoskeleton, gait, controllers = _controllers(options, robot, shapes)
        if not target.lockstep:
            for controller in controllers.values():
                controller.prepare()
        certificates: dict[str, Certificate] = {}
        telemetry: TelemetryProcess | None = None
        last = [*controllers][-1]
        for name, controller in controllers.items():
            with _open(target, options, network, robot, controller, gait.hash32, robot_process, exoskeleton) as rig:
                if parallel and name != last:
                    robot_process = stack.enter_context(EmbeddedRobot(target.engine))
                if telemetry is None:
                    # Print the certificates only when the bus is open. If the bus is missing, only the error is printed.
                    certificates = {shape: walking.certificate(options.xi) for shape, walking in controllers.items()}
                    announce(certificates.values(), controller.config.mismatch, "swing leg of the empty exoskeleton")
                    about = {"seed": options.seed, "steps": options.steps, "xi": options.xi, **asdict(options.law)}
                    telemetry = start_telemetry(target, outputs, rig.hal, network, gait.hash32, about, telemetry_child)
                    stack.callback(_close, telemetry, walked)
                    report_endpoint = EndpointReport(telemetry)
                telemetry.begin_run(name, {"shape": name, "xi": options.xi, **promise_fields(certificates[name])})
                walk = _Walk(rig, controller, Recorder(rig, telemetry, report_endpoint), name, options.steps)
                with stop_requested() as stop:
                    statistics = walk.run(stop)
                factors = controller.statistics.factors or {options.xi}
                certificate = weakest(controller.certificate(xi) for xi in factors)
                walked.results.append(_result(certificate, controller, rig.hal, statistics))
                report_hand_overs(name, controller.statistics)
                if as_json:
                    show_json(asdict(walked.results[-1]))
                walk.conclude()


class _Walk:
    """Run of the robot inside one guide shape, with telemetry and a progress line."""

    def __init__(
        self,
        rig: Rig,
        controller: AirwalkController,
        recorder: Recorder,
        name: str,
        steps: int,
    ) -> None:
        from atalante_tools.session.rig import Watch

        self._rig, self._controller, self._recorder = rig, controller, recorder
        self._name, self._steps = name, steps
        self._watch_of = functools.partial(
            Watch, rig, done=self._done, describe=self._describe, resumes=not rig.target.embedded
        )

    def run(self, stop: Any) -> Statistics:
        """Walk until all steps are done, a stop signal arrives, or the robot leaves ACTIVE.

        Args:
            stop: Stop request of the process.
        """
        self._watch = self._watch_of(stop)
        statistics = self._rig.run(self._controller, until=self._watch, record=self._recorder.write)
        self._recorder.report_events()
        return statistics

    def conclude(self) -> None:
        """End the command with an error unless all steps are done. See `Watch.conclude`."""
        self._watch.conclude()

    def _done(self, state: State) -> bool:
        return self._controller.statistics.steps >= self._steps

    def _describe(self, state: State) -> str:
        statistics = self._controller.statistics
        # The statistics contain no ratio |e|/q_bound before the first step is completed.
        largest = f"   largest |e|/q_bound {statistics.max_ratio:.2f}" if statistics.cycles else ""
        return (
            f"{self._name:<11} step {statistics.steps:3d}/{self._steps}   t {state.time:6.1f} s   "
            f"Xi {state.assistance_factor:.2f}{largest}"
        )


def _controllers(
    options: Options, robot: Robot, shapes: Mapping[str, GuideShape]
) -> tuple[ExoskeletonParameters, Gait, dict[str, AirwalkController]]:
    """Return the exoskeleton, the gait, and one controller per guide shape.

    If the user or the gait file states a patient, the leg lengths of the exoskeleton are those of this patient. If the user
    gives a patient and no gait file, the gait network computes the gait for this patient.
    """
    from atalante_control.airwalk.controller import AirwalkController
    from atalante_tools.session.gait_source import gait_in_the_air

    config = options.law.config()
    exoskeleton, gait, source = gait_in_the_air(options.files, options.subject, robot)
    controllers = {name: AirwalkController(robot, gait, shape, config, exoskeleton) for name, shape in shapes.items()}
    # The text `source` names the origin of the gait (empty: default gait). Print it only after the controllers accept the gait.
    if source:
        print_message(f"{source}; the exoskeleton is empty")
    return exoskeleton, gait, controllers


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
    from atalante_control.joint.leg_model import leg_model
    from atalante_emulator.mechanics import Mechanics
    from atalante_tools.session.body import describe
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
        mechanics=Mechanics(describe(robot, exoskeleton), target.engine),
        legs=leg_model(exoskeleton),
    )


def _close(telemetry: TelemetryProcess, walked: Walked) -> None:
    """Close the telemetry, and add its recording to `walked`."""
    summary = close_telemetry(telemetry)
    walked.recording, walked.can_log_complete = summary.recording, summary.can_log_complete


def _result(certificate: Certificate, controller: AirwalkController, hal: Hal, statistics: Statistics) -> Result:
    walking = controller.statistics
    # After a single step, the statistics contain only the cycle in which this step ended. Such statistics are not reported.
    # `walking.cycles` counts only the cycles with a guide. There is no guide at the assistance factor 1.
    counted = walking.steps >= 2 and walking.cycles > 0
    return Result(
        shape=certificate.shape,
        **promise_fields(certificate),
        steps=walking.steps,
        max_ratio=round(walking.max_ratio, 4) if counted else None,
        inside=round(walking.inside_fraction, 4) if counted else None,
        filter_active=round(walking.active_fraction, 4) if counted else None,
        cycles=statistics.cycles,
        real_time_factor=round(statistics.real_time_factor, 2),
        frames=int(hal.record[hal.layout["frames"]][0]),
        crc_errors=hal.crc_errors,
        hand_overs=walking.hand_overs,
        hand_overs_exceeded=walking.hand_overs_exceeded,
    )
