"""Command `atalante trial`: experiments of the paper with virtual subjects, and walks with faults, pushes and model errors.

experiment -> trials (`plan`) -> results in files (`run`, `store`) -> findings -> report.html
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from atalante_tools.console.options import (
    MUJOCO,
    PYBULLET,
    SEED,
    Between,
    dask_option,
    jobs_option,
    json_option,
    network_option,
    options_as,
)
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import check_stop
from atalante_tools.console.terminal import Progress, print_message, show_json, table
from atalante_tools.session.law import Law, law_options

if TYPE_CHECKING:
    from atalante_tools.trial.findings import Finding, Result
    from atalante_tools.trial.plan import Trial, WalkSetting

_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class Running:
    """Options of all experiments."""

    out: Path  # folder of the results and of the report
    quick: bool  # whether the trials are few and short
    jobs: int  # number of processes
    dask: str  # address of a dask scheduler; empty for processes on this computer
    engine: str  # physics engine
    seed: int  # seed of the experiment


@dataclass(frozen=True)
class Walking:
    """Options of the experiments in which virtual subjects walk on the ground."""

    shape: str  # guide shape
    law: Law  # control law of the assisted joints
    network: Path | None  # file of the neural gait network; None means the network of the package
    haptics: bool  # whether active subjects respond to the vibration motors


def _running(experiment: str) -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of `Running`. The command gets their values as the argument `running`."""
    options = [
        click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=f"runs/{experiment}", show_default=True,
                     metavar="DIR", help="Folder for report.html, report.md and one file per trial. A trial with a valid "
                                         "file is not run again."),
        click.option("--quick", is_flag=True, help="Run few and short trials, to try the command."),
        jobs_option,
        dask_option,
        click.option("--engine", type=click.Choice((MUJOCO, PYBULLET)), default=MUJOCO, show_default=True,
                     help="Physics engine of the emulated robot. MuJoCo is the faster engine on the ground."),
        click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of all random numbers."),
        json_option,
    ]  # fmt: skip
    return options_as("running", Running, options)


def _walking(*, literal: bool = False) -> Callable[[_Command], _Command]:
    """Return a decorator that adds the options of `Walking`. The command gets their values as the argument `walking`.

    Args:
        literal: Whether to add `--literal`.
    """
    options = [
        click.option("--shape", type=click.Choice(("constant", "pinched")), default="constant", show_default=True,
                     help="Shape of the guide. The guide of the paper is constant."),
        law_options(literal=literal),
        network_option,
        click.option("--haptics", is_flag=True,
                     help="Active subjects respond to the vibration motors: while a motor of a joint vibrates, they perceive an "
                          "angle error of any size. Without this option, they perceive no error below one degree."),
    ]  # fmt: skip
    return options_as("walking", Walking, options)


_mass_option = click.option(
    "--mass", "masses", type=float, multiple=True, metavar="KG",
    help="Mass of a subject [kg]. Repeat the option for several subjects.  [default: all eight]",
)  # fmt: skip


@click.group()
def command() -> None:
    """Repeat the experiments of the paper with virtual subjects on the emulated robot, and write a report.

    The experiments `protocol`, `robustness`, `pushes` and `faults` are not in the paper.

    The report is one HTML file with tables, figures and findings. Each finding has a statistic and a verdict. report.md contains
    the findings as Markdown. A verdict of FAIL is a result, not an error of the command. Each trial is stored in a file of its
    own as soon as it has ended. After an interruption, the same command runs only the missing trials.

    \b
    Example: atalante trial shapes
             atalante trial assist --jobs 2
             atalante trial sweep --quick
             atalante trial faults F16 F56
             atalante trial protocol --shape pinched --mass 75
             atalante trial robustness --seeds 10
             atalante trial pushes --quick
    """


@command.command(short_help="Walk in the air inside every guide shape.")
@_running("shapes")
def shapes(running: Running, as_json: bool) -> None:
    """Walk in the air inside every guide shape, with the empty exoskeleton and without feedforward."""
    from atalante_control.guide.shapes import SHAPES
    from atalante_tools.trial.findings import shape_findings
    from atalante_tools.trial.plan import PARTIAL, QUICK_SHAPE_STEPS, SHAPE_STEPS, shape_trials

    steps = QUICK_SHAPE_STEPS if running.quick else SHAPE_STEPS
    _conduct(
        "shapes",
        shape_trials(tuple(SHAPES), steps, PARTIAL, running.seed, running.engine),
        shape_findings,
        running,
        as_json,
    )


@command.command(short_help="Compare full and partial assistance, with passive and active subjects.")
@_mass_option
@_walking()
@_running("assist")
def assist(masses: tuple[float, ...], walking: Walking, running: Running, as_json: bool) -> None:
    """Compare full and partial assistance.

    Each of eight subjects walks four times for five minutes: passive and active, with full and with partial assistance.
    """
    from atalante_tools.trial.findings import assist_findings
    from atalante_tools.trial.plan import PROTOCOL, QUICK_MASSES, QUICK_PROTOCOL, assist_trials

    masses = _known(masses)
    if running.quick:
        masses = masses or QUICK_MASSES
    trials = assist_trials(_setting(walking, running, QUICK_PROTOCOL if running.quick else PROTOCOL), masses)
    _conduct("assist", trials, assist_findings, running, as_json)


@command.command(short_help="Walk with falling and rising assistance factors.")
@click.option("--days", type=click.IntRange(1), metavar="N",
              help="Number of days. A day has one trial on the treadmill and one walk per assistance factor.  "
                   "[default: 3; with --quick: 1]")  # fmt: skip
@_walking()
@_running("sweep")
def sweep(days: int | None, walking: Walking, running: Running, as_json: bool) -> None:
    """Run a series of five-minute walks of one active subject.

    Each walk begins with full assistance and ends with the assistance factor of the walk. From walk to walk, this factor falls
    from 1 to 0 and then rises to 1.
    """
    from atalante_tools.trial.findings import sweep_findings
    from atalante_tools.trial.plan import DAYS, PROTOCOL, QUICK_DAYS, QUICK_PROTOCOL, QUICK_SWEEP, SWEEP, sweep_trials

    factors, protocol = (QUICK_SWEEP, QUICK_PROTOCOL) if running.quick else (SWEEP, PROTOCOL)
    number = days or (QUICK_DAYS if running.quick else DAYS)
    trials = sweep_trials(_setting(walking, running, protocol), factors, number)
    _conduct("sweep", trials, sweep_findings, running, as_json)


@command.command(short_help="Inject the faults of the fault matrix into walks on the ground.")
@click.argument("ids", metavar="[ID]...", nargs=-1)
@network_option
@_running("ground-faults")
def faults(ids: tuple[str, ...], network: Path | None, running: Running, as_json: bool) -> None:
    """Inject each fault, or the faults with the given IDs, into walks on the ground with a passive wearer.

    Each case of the fault matrix begins at ten moments: at eight phases of a step, and in double support before and after the
    steps. The faults F15, F16 and F41, after which the HAL sends no more frames, begin at 13 moments: also while the robot
    stands, at the start of the first step, and at the landing of the stop step. With --quick, there are two moments. The
    report states which walks end in a fall, and why. For permanent faults, it states the longest duration without a fall.
    """
    from atalante_tools.console.names import find
    from atalante_tools.trial.fault_findings import fault_findings
    from atalante_tools.trial.fault_plan import QUICK_IDS, fault_trials
    from atalante_tools.trial.ground_cases import FAULT_IDS

    chosen = [FAULT_IDS[find(id_, FAULT_IDS, "fault with a case")] for id_ in ids] or (
        QUICK_IDS if running.quick else ()
    )
    trials = fault_trials(chosen, running.quick, running.seed, running.engine, _network(network))
    if without := [id_ for id_ in chosen if id_ not in {trial.id for trial in trials}]:
        raise click.UsageError(
            f"a fault must be one that can begin during a walk, got {without[0]}, which is injected only at power-on"
        )
    _conduct("faults", trials, fault_findings, running, as_json)


@command.command(short_help="Walk with full and then partial assistance, with every subject.")
@_mass_option
@click.option(
    "--subject",
    "kinds",
    type=click.Choice(["passive", "active"]),
    multiple=True,
    help="Kind of the subjects.  [default: both]",
)
@click.option(
    "--xi",
    "factors",
    type=Between(0.0, 1.0),
    multiple=True,
    metavar="X",
    help="Assistance factor of the last part of the walk. Repeat the option for several factors. With 1, all steps have full "
    "assistance.  [default: 0.5 and 0]",
)
@click.option(
    "--heading-reference",
    is_flag=True,
    help="Give the IMUs a heading reference, such as a magnetometer. The controller then estimates the drift of the gyro.",
)
@_walking(literal=True)
@_running("protocol")
def protocol(
    masses: tuple[float, ...],
    kinds: tuple[str, ...],
    factors: tuple[float, ...],
    heading_reference: bool,
    walking: Walking,
    running: Running,
    as_json: bool,
) -> None:
    """Walk 112 steps with full assistance, then 38 steps in which the factor changes, then 225 steps with the new factor.

    Each of the eight subjects walks passive and active, with each of the new factors.
    """
    from atalante_tools.trial.findings import protocol_findings
    from atalante_tools.trial.plan import (
        KINDS,
        PROTOCOL,
        PROTOCOL_FACTORS,
        QUICK_MASSES,
        QUICK_PROTOCOL,
        protocol_trials,
    )

    masses, factors = _known(masses), _distinct(factors)
    if running.quick:
        masses = masses or QUICK_MASSES
    setting = replace(
        _setting(walking, running, QUICK_PROTOCOL if running.quick else PROTOCOL),
        heading_reference=heading_reference,
    )
    trials = protocol_trials(setting, factors or PROTOCOL_FACTORS, masses, kinds or KINDS)
    _conduct("protocol", trials, protocol_findings, running, as_json)


@command.command(short_help="Walk with random errors of model, floor and bus, and with pushes.")
@click.option("--seeds", type=click.IntRange(1), metavar="N", help="Number of trials.  [default: 100]")
@click.option(
    "--steps", type=click.IntRange(1), metavar="N", help="Number of periodic steps of each trial.  [default: 60]"
)
@network_option
@_running("robustness")
def robustness(seeds: int | None, steps: int | None, network: Path | None, running: Running, as_json: bool) -> None:
    """Walk at full assistance, with random patients, model errors, friction, delays, lost frames and pushes.

    If the robot does not complete all steps, or does not stand at the end, the trial is repeated, and its repetition is
    recorded in the folder `recordings`.
    """
    from atalante_tools.trial.findings import robust_findings
    from atalante_tools.trial.plan import QUICK_ROBUST, ROBUST, robust_trials

    count, length = QUICK_ROBUST if running.quick else ROBUST
    trials = robust_trials(seeds or count, steps or length, running.seed, running.engine, _network(network))
    try:
        _conduct("robustness", trials, robust_findings, running, as_json)
    finally:
        _record_failures(trials, running)


@command.command(short_help="Find the largest push in each direction that the robot withstands.")
@network_option
@_running("pushes")
def pushes(network: Path | None, running: Running, as_json: bool) -> None:
    """Push the walking robot in 16 directions and at 8 phases of a step. The force rises until the robot falls or stops.

    The report contains a polar figure of the largest push that the robot withstands.
    """
    from atalante_tools.trial.findings import push_findings
    from atalante_tools.trial.plan import PUSH_DIRECTIONS, PUSH_FORCES, PUSH_PHASES, QUICK_PUSHES, push_trials

    grid = QUICK_PUSHES if running.quick else (PUSH_DIRECTIONS, PUSH_PHASES, PUSH_FORCES)
    trials = push_trials(*grid, running.seed, running.engine, _network(network))
    _conduct("pushes", trials, push_findings, running, as_json)


def _record_failures(trials: Sequence[Trial], running: Running) -> None:
    """Repeat and record each trial in which the robot did not complete all steps, or did not stand at the end.

    The name of a recording contains the key of the trial, as the name of its result. While the recording is incomplete, its name
    ends with `.part.mcap`.

    Raises:
        Failed: If another run uses the folder.
        Stopped: If a signal arrived. The same command makes the missing recordings.
    """
    from atalante_tools.session.run_folder import run_folder
    from atalante_tools.trial.findings import walked_all_steps
    from atalante_tools.trial.plan import RobustTrial
    from atalante_tools.trial.store import path_of, stored

    folder = running.out / "recordings"
    with run_folder(running.out):
        for trial in trials:
            result, file = stored(trial, running.out / "trials"), path_of(trial, folder).with_suffix(".mcap")
            if isinstance(trial, RobustTrial) and result and not walked_all_steps(result) and not file.exists():
                from atalante_tools.trial.robustness import robust_walk

                check_stop()
                folder.mkdir(parents=True, exist_ok=True)
                unfinished = file.with_suffix(".part.mcap")
                robust_walk(trial, unfinished)
                unfinished.replace(file)
                print_message(f"{trial.name} ({result['outcome']}): recorded in {file}")


def _known(masses: tuple[float, ...]) -> tuple[float, ...]:
    """Return `masses` unchanged if each value is the mass of a virtual subject.

    Raises:
        UsageError: If a value is not the mass of a virtual subject.
    """
    from atalante_control.gait.subject import STUDY_PATIENTS

    known = [patient.mass for patient in STUDY_PATIENTS]
    if unknown := [mass for mass in masses if mass not in known]:
        raise click.UsageError(f"--mass must be one of {', '.join(f'{mass:g}' for mass in known)}, got {unknown[0]:g}")
    return masses


def _distinct(factors: tuple[float, ...]) -> tuple[float, ...]:
    """Return `factors` without repeated values.

    Raises:
        UsageError: If two different factors have the same text in the name of a trial.
    """
    shown: dict[str, float] = {}
    for xi in factors:
        if shown.setdefault(f"{xi:g}", xi) != xi:
            raise click.UsageError(
                f"factors of --xi must differ in their first six digits, got {shown[f'{xi:g}']!r} and {xi!r}"
            )
    return tuple(shown.values())


def _setting(walking: Walking, running: Running, protocol: tuple[int, int, int]) -> WalkSetting:
    from atalante_tools.trial.plan import WalkSetting

    return WalkSetting(
        protocol,
        walking.shape,
        walking.law.idealization,
        walking.law.feedforward,
        running.seed,
        running.engine,
        walking.law.literal,
        network=_network(walking.network),
        haptics=walking.haptics,
    )


def _network(file: Path | None) -> tuple[str, ...]:
    """Return path and SHA-256 of a network file; an empty tuple if the user gave no file."""
    from atalante_tools.trial.plan import network_of

    return () if file is None else network_of(file)


def _require_network(trials: Sequence[Trial]) -> None:
    """Check that the network file of the trials covers every subject.

    Raises:
        NetworkError: If the file is invalid, or if a subject is outside the range of the network.
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient
    from atalante_tools.trial.plan import STEP, ShapeTrial, TreadmillTrial

    for trial in trials:
        if not isinstance(trial, ShapeTrial | TreadmillTrial) and trial.network:
            load_network(Path(trial.network[0])).check(Subject(Patient(trial.mass, trial.height), *STEP))


def _conduct(
    experiment: str,
    trials: Sequence[Trial],
    find: Callable[[Sequence[Result]], list[Finding]],
    running: Running,
    as_json: bool,
) -> None:
    """Run the missing trials, write the report, and print the findings.

    Raises:
        Failed: If the robot fell or stopped in a trial.
    """
    _require_network(trials)
    from atalante_tools.session.run_folder import run_folder
    from atalante_tools.trial.report import summary, verdict, write_report
    from atalante_tools.trial.store import stored

    with run_folder(running.out):
        _run_missing(trials, running)
        results = [result for trial in trials if (result := stored(trial, running.out / "trials")) is not None]
        findings = find(results)
        write_report(
            experiment, results, findings, running.quick, len(trials) - len(results), running.out / "report.html"
        )
    if as_json:
        for result in results:
            show_json(summary(result))
        for finding in findings:
            show_json(asdict(finding))
    else:
        click.echo(table([["finding", "verdict", "statistic"], *([f.id, verdict(f), f.statistic] for f in findings)]))
    print_message(f"in {running.out}: report.html, report.md, {len(results)} results in trials")
    failed = [result for result in results if result["outcome"] not in ("stood", "done", "computed")]
    if failed:
        names = ", ".join(f"{r['trial']['name']} ({r['outcome']})" for r in failed[:3])
        raise Failed(f"{len(failed)} of {len(results)} trials did not end as planned: {names}")


def _run_missing(trials: Sequence[Trial], running: Running) -> None:
    """Run the trials that have no result, and show a progress bar.

    Raises:
        Stopped: If a signal arrived. The results so far are in the folder.
    """
    from atalante_tools.session.body import require_engine
    from atalante_tools.trial.store import compute, path_of, stored

    folder = running.out / "trials"
    missing = [trial for trial in trials if stored(trial, folder) is None]
    if not missing:
        return
    for file in (path_of(trial, folder) for trial in missing):
        if file.exists():
            print_message(f"{file} is damaged or was edited: its trial is run again")
    if not running.dask:  # this computer runs the trials, so it needs the engine
        require_engine(running.engine)
    jobs = min(running.jobs, len(missing))
    where = f"the workers of {running.dask}" if running.dask else f"{jobs} process{'es' if jobs > 1 else ''}"
    print_message(f"{len(missing)} of {len(trials)} trials to run on {where}")
    progress, done = Progress(), 0
    try:
        for _ in compute(missing, folder, jobs=jobs, cluster=running.dask):
            done += 1
            check_stop()
            progress.bar(done, len(missing), "trials")
    finally:
        progress.clear()
        if done < len(missing):
            print_message(f"{done} of {len(missing)} trials done; repeat the command to run the others")
