"""The paper's first experiment, behind `atalante demo` and `atalante airwalk`: steps in the air inside a virtual guide.

guide shape -> certificate (announced) -> steps -> recording, summary.json, figure
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
from atalante_tools.session.run_folder import Result, leave, results_table, run_folder

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
#: Those of `shapes.SHAPES`, for help that imports no controller.
SHAPE_NAMES = "constant, widening, narrowing, pinched, asymmetric, snap"
#: Cycles between two looks at the telemetry process.
_TEND_CYCLES = 250


@dataclass(frozen=True)
class Options:
    """What the user asked for."""

    steps: int  # right-stance steps a shape
    xi: float  # assistance factor
    seed: int
    out: Path  # run folder
    record_rate: int  # Hz
    can_log: Path | None
    telemetry: Path | None  # telemetry file: endpoint, TLS, users
    subject: Subject | None = None  # whose gait of the network; None: the gait drawn for the air


@dataclass
class Walked:
    """What a trial has so far; complete once its telemetry is closed."""

    results: list[Result] = field(default_factory=list)  # one a shape
    recording: Recording | None = None  # None: the telemetry was not started


def _record_rate(text: str) -> int:
    """A rate [Hz] that takes every n-th cycle: an option's type."""
    if text.isdecimal() and int(text) and not 1000 % int(text):
        return int(text)
    raise click.BadParameter(f"{text!r} does not divide 1000 as 1, 10, 50, 100, 200, 250, 500 and 1000 do")


def trial_options(steps: int, out: str) -> Callable[[_Command], _Command]:
    """Give a command the options scripts may rely on, handed over as the argument `options`."""
    options = [
        click.option("--steps", type=click.IntRange(1), default=steps, show_default=True, metavar="N",
                     help="Right-stance steps with each shape."),
        click.option("--xi", type=Between(0.0, 1.0), default=0.5, show_default=True, metavar="X",
                     help="Assistance factor: 0 widest guide (7.5 deg), 1 full assistance. The pendant may change it."),
        click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Of the emulated sensors' noise."),
        click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=out, show_default=True,
                     metavar="DIR", help="Run folder: recording.mcap, summary.json, figure; an earlier run's are replaced."),
        click.option("--record-rate", type=_record_rate, default="100", show_default=True, metavar="HZ",
                     help="Recorded cycles a second, a divisor of 1000, which is every cycle."),
        click.option("--can-log", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                     help="Log every frame; format by suffix: .log, .asc, .blf, .log.gz, .asc.gz."),
        click.option("--telemetry", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                     help="Telemetry file (TOML): Zenoh endpoint, TLS certificate, users."),
    ]  # fmt: skip

    return options_as("options", Options, [*options, json_option, subject_options])


def run_trial(target: Target, shapes: Sequence[str], options: Options, *, as_json: bool) -> None:
    """Walk behind each shape in turn, record everything, and say how it went.

    Raises:
        Failed, FaultLatched: the robot left ACTIVE before the steps were done; what was walked until then is kept.
        Failed: the steps were done and the recording is not complete.
        SystemExit: a signal ended it.
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
                leave(options.out, _asked(options), walked.results, walked.recording)
    _require_complete(walked.recording)


def _require_complete(recording: Recording | None) -> None:
    """Refuse a recording with gaps.

    Raises:
        Failed: cycles are missing, or its file has no end; names the files and the number of cycles.
    """
    if recording is not None and not recording.complete:
        raise Failed(
            f"the recording must be one file with every cycle, got {', '.join(recording.files)} "
            f"with {recording.missing_cycles} cycles missing"
        )


def _asked(options: Options) -> dict[str, Any]:
    """Return what the user asked for as JSON types: a path as text, without the files that the run itself writes."""
    asked = {key: value for key, value in asdict(options).items() if key not in ("out", "can_log")}
    telemetry = None if options.telemetry is None else str(options.telemetry)
    return {**asked, "telemetry": telemetry, "version": version("atalante-hal")}


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
    """Walk behind each shape in turn and add what became of it and of the recording to `walked`; raises as `run_trial`."""
    import atalante_dbc
    from atalante_hal.robot import load_robot

    with ExitStack() as stack:
        robot_process = _start_robot(target, stack)  # it loads what it needs while the controllers are made
        network, robot = atalante_dbc.load(), load_robot()
        exoskeleton, gait, controllers = _controllers(options.subject, robot, shapes)
        promised: dict[str, Certificate] = {}
        telemetry: TelemetryProcess | None = None
        last = [*controllers][-1]
        for name, controller in controllers.items():
            with _open(target, options, network, robot, controller, gait.hash32, robot_process, exoskeleton) as rig:
                robot_process = _start_robot(target, stack) if name != last else None
                if telemetry is None:
                    # Promises come when the bus is there to keep them on.
                    promised = {shape: guarded.certificate(options.xi) for shape, guarded in controllers.items()}
                    _announce(promised.values())
                    telemetry = _telemetry(target, options, outlet, rig.hal, network, gait.hash32)
                    stack.enter_context(telemetry)
                    stack.callback(_close, telemetry, walked)
                    report_endpoint = _EndpointReport(telemetry)
                telemetry.begin_run(name, {"shape": name, "xi": options.xi, **_promise(promised[name])})
                walk = _Walk(rig, controller, telemetry, report_endpoint, name, options.steps)
                with stop_requested() as stop:
                    statistics = walk.run(stop)
                factors = controller.statistics.factors or {options.xi}
                walked.results.append(_result(_weakest(controller, factors), controller, rig.hal, statistics))
                if as_json:
                    show_json(asdict(walked.results[-1]))
                walk.conclude()


class _Walk:
    """One shape: the loop, its telemetry and its progress line."""

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
        self._told = 0
        self._watch_of = functools.partial(Watch, rig, done=self._done, describe=self._describe)
        hal = rig.hal
        if telemetry.frames is not None:
            if rig.target.lockstep:
                hal.tap = telemetry.tap(lambda: hal.state.cycle * 1_000_000)
            else:
                hal.tap = telemetry.tap(stamps=lambda: hal.bus.stamps)

    def run(self, stop: Any) -> Statistics:
        self._watch = self._watch_of(stop)
        statistics = self._rig.run(self._controller, until=self._watch, record=self._record)
        self._tell()
        return statistics

    def conclude(self) -> None:
        self._watch.conclude()

    def _record(self) -> None:
        hal = self._rig.hal
        self._telemetry.write(hal.record)
        if not hal.state.cycle % _TEND_CYCLES:
            self._telemetry.tend()
            self._report_endpoint()
        if hal.events.count != self._told:
            self._tell()

    def _tell(self) -> None:
        events = self._rig.hal.events
        for event in events.since(self._told):
            self._telemetry.event(event.cycle, event.code, event.text, event.severity, event.node, event.value)
        self._told = events.count

    def _done(self, state: State) -> bool:
        return self._controller.statistics.steps >= self._steps

    def _describe(self, state: State) -> str:
        statistics = self._controller.statistics
        # Counted from the first completed step on.
        largest = f"   largest |e|/q_bound {statistics.max_ratio:.2f}" if statistics.cycles else ""
        return (
            f"{self._name:<11} step {statistics.steps:3d}/{self._steps}   t {state.time:6.1f} s   "
            f"Xi {state.assistance_factor:.2f}{largest}"
        )


def _controllers(
    subject: Subject | None, robot: Robot, shapes: Mapping[str, GuideShape]
) -> tuple[ExoskeletonParameters, Gait, dict[str, AirwalkController]]:
    """The exoskeleton adjusted to the subject, his gait, and a controller of each shape that walks it in the air."""
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
    made = {name: AirwalkController(robot, gait, shape, config, exoskeleton) for name, shape in shapes.items()}
    if subject is not None:  # the gait was accepted
        say(f"gait of the network: {subject}; nobody is in the exoskeleton")
    return exoskeleton, gait, made


def _announce(certificates: Collection[Certificate]) -> None:
    """Print before the run what each filter is built for, and what is not included in it."""
    for certificate in certificates:
        name, xi, bound = certificate.shape, certificate.xi, certificate.joint_torque
        if bound is None:
            say(f"{name}: NOT CERTIFIED at Xi {xi:g}, the guide may be left: {certificate.reason}")
            continue
        say(
            f"{name}: certified on the model at Xi {xi:g}: built for {bound.hip:.2f} Nm at the hip and {bound.knee:.2f} Nm at "
            f"the knee together (worst pose: knee at {math.degrees(bound.worst_knee):.0f} deg); {certificate.reason}"
        )
    if any(certificate.certified for certificate in certificates):
        say(
            "certified is a margin on the model, no guarantee: joint torque and rate limits, delay, the torque carried over a "
            "step change and errors of friction and mass are not included"
        )


def _promise(certificate: Certificate) -> dict[str, Any]:
    """Return `certified` and the bounds, as in `Result`."""
    bound = certificate.joint_torque
    return {
        "certified": certificate.certified,
        "bound_hip_nm": None if bound is None else bound.hip,
        "bound_knee_nm": None if bound is None else bound.knee,
    }


def _weakest(controller: AirwalkController, factors: Iterable[float]) -> Certificate:
    """Return the certificate that promises least of those at the assistance factors."""
    certificates = [controller.certificate(xi) for xi in factors]
    return min(certificates, key=lambda c: -1.0 if c.joint_torque is None else c.joint_torque.hip)


#: Processor cores for HAL, telemetry and a robot in a process of its own.
_CORES = 3


def _start_robot(target: Target, stack: ExitStack) -> EmbeddedRobot | None:
    """A process for the embedded robot, where it gets a core of its own: sharing one, each waits for the other."""
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
        slots=8192,  # 8 s: a demo runs many times faster than real time, and a recorder may pause
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
    """Print where subscribers connect: when it is made, and on each call after a restart that changed the endpoint."""

    def __init__(self, telemetry: TelemetryProcess) -> None:
        for notice in telemetry.notices:
            say(notice)
        self._telemetry = telemetry
        self._endpoint: str | None = None
        self()

    def __call__(self) -> None:
        """Print the endpoint unless it is the one printed last."""
        endpoint = self._telemetry.endpoint
        if endpoint != self._endpoint:
            self._endpoint = endpoint
            keys = f"keys atalante/{self._telemetry.config.robot}/**"
            say(f"telemetry on Zenoh at {endpoint}, {keys}" if endpoint else "telemetry is no longer published")


def _close(telemetry: TelemetryProcess, walked: Walked) -> None:
    """Close the telemetry, print what it could not record or publish, and add its recording to `walked`."""
    summary = telemetry.close()
    walked.recording = summary.recording
    for notice in summary.notices:
        if notice not in telemetry.notices:  # those were told at the start
            say(notice)
    if not summary.complete and not summary.notices:
        say("the telemetry process has died: the recording may end early")


def _result(certificate: Certificate, controller: AirwalkController, hal: Hal, statistics: Statistics) -> Result:
    walked = controller.statistics
    return Result(
        shape=certificate.shape,
        **_promise(certificate),
        steps=walked.steps,
        max_ratio=round(walked.max_ratio, 4),
        inside=round(walked.inside_fraction, 4),
        filter_active=round(walked.active_fraction, 4),
        cycles=statistics.cycles,
        real_time_factor=round(statistics.real_time_factor, 2),
        frames=int(hal.record[hal.layout["frames"]][0]),
        crc_errors=hal.crc_errors,
    )
