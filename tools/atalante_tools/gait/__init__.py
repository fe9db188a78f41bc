"""Command `atalante gait`: optimise gaits, collect them in a library, fit the gait network, and check the network."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from atalante_tools.console.options import SEED, OutputFile, json_option, length, require_writable
from atalante_tools.console.outcome import FAILED, Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import Progress, print_message, show_json, table
from atalante_tools.gait.solve import solve
from atalante_tools.session.extra import extra

if TYPE_CHECKING:
    from atalante_control.gait_optimization.library import Index

_FOLDER = click.Path(file_okay=False, path_type=Path)
_FILE = click.Path(dir_okay=False, path_type=Path)
_network_option = click.option(
    "--network", "file", type=_FILE, metavar="FILE", help="Network file.  [default: the network of the package]"
)
_seed_option = click.option(
    "--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the random subjects."
)


def _count_option(default: int) -> Callable[[Any], Any]:
    return click.option(
        "--count",
        type=click.IntRange(min=1),
        default=default,
        show_default=True,
        metavar="N",
        help="Number of random subjects.",
    )


def levels_of(text: str) -> tuple[float, ...]:
    """Convert the text of a grid option to numbers, for example "58,75" to (58.0, 75.0).

    Raises:
        click.BadParameter: If the text is not a list of numbers.
    """
    try:
        return tuple(map(float, text.split(",")))
    except ValueError:
        raise click.BadParameter(f"levels must be numbers separated by commas (58,75,91), got {text!r}") from None


def lengths_of(text: str) -> tuple[float, ...]:
    """Convert the text of a grid option to lengths [m].

    A number below 5 is in metres, any other number is in centimetres. For example, the text "0.15,20" gives (0.15, 0.2).

    Raises:
        click.BadParameter: If the text is not a list of lengths.
    """
    return tuple(map(length, text.split(",")))


@click.group()
def command() -> None:
    """Optimise gaits, collect them in a library, fit the gait network of the controller, and check the network and its gaits.

    \b
    Example: atalante gait solve --mass 75 --height 175
             atalante gait library --out runs/library --jobs 2
             atalante gait fit --library runs/library --out runs/network.npz
             atalante gait check --network runs/network.npz
             atalante gait verify --network runs/network.npz
    """


command.add_command(solve)


@command.command(short_help="Solve the gaits of a grid of patients and steps.")
@click.option(
    "--out", type=_FOLDER, required=True, metavar="DIR", help="Folder of the library; created if it does not exist."
)
@click.option(
    "--jobs", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Number of processes."
)
@click.option(
    "--compile/--no-compile",
    "machine_code",
    default=False,
    help="Compile the nonlinear program with gcc first. This takes minutes once per computer, and halves the time per gait.",
)
@click.option("--dask", "cluster", metavar="ADDRESS", help="Solve on the workers of this dask scheduler.")
@click.option(
    "--mass",
    type=levels_of,
    metavar="KG,...",
    help="Patient masses of the grid, in kg.  [default: levels that cover the subjects of the paper]",
)
@click.option(
    "--height", type=lengths_of, metavar="M,...", help="Patient heights of the grid, in m (1.75) or cm (175)."
)
@click.option(
    "--step-length", type=lengths_of, metavar="M,...", help="Step lengths of the grid, in m (0.15) or cm (15)."
)
@click.option("--step-duration", type=levels_of, metavar="S,...", help="Step durations of the grid, in s.")
@click.option(
    "--thigh",
    type=levels_of,
    metavar="X,...",
    help="Thigh lengths of the grid, as multiples of the length that Winter's table gives for the height, such as 0.94,1,1.06.",
)
@click.option(
    "--shank",
    type=levels_of,
    metavar="X,...",
    help="Shank lengths of the grid, as multiples of the length that Winter's table gives for the height, such as 0.94,1,1.06.",
)
@click.option(
    "--size",
    type=int,
    metavar="N",
    help="Number of gaits. They are the corners of the grid and points that are spread evenly in the grid. If N is increased, "
    "the existing gaits are kept and further gaits are added.  [default: 1000]",
)
@json_option
def library(out: Path, jobs: int, machine_code: bool, cluster: str | None, as_json: bool, **grid_options: Any) -> None:
    """Solve the gaits of a grid of patients, step lengths and step durations. Write one file per gait to DIR/gaits.

    After an interruption, the same command solves the missing gaits. A gait is also solved again if its file is damaged, was
    made by another version of the code, or belongs to another subject. Failed gaits are listed on stderr and in DIR/failed, and
    the next call retries them. The exit code is 1 if a gait failed.

    \b
    Example: atalante gait library --out runs/library --jobs 2
             atalante gait library --out runs/library --dask tcp://127.0.0.1:8786
             atalante gait library --out runs/slow --step-duration 1.0,1.1,1.2
    """
    with extra():
        from atalante_control.gait_optimization.library import Grid, Library, solve_compiled, solve_subject
    try:
        grid = Grid(**{name: value for name, value in grid_options.items() if value is not None})
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    collection = Library(out, grid)
    require_writable(out)
    points, todo = len(grid.points()), len(collection.missing())
    print_message(f"{points} gaits in {out}, {points - todo} of them already solved")
    if rejected := collection.rejected():
        print_message(f"{_rejected(rejected)}; these gaits are solved again")
    progress, start = Progress(), time.monotonic()
    solve = solve_compiled if machine_code else solve_subject
    # A signal such as Ctrl-C takes effect after the current gait. An interrupted optimiser would report a failed gait.
    with (
        stop_requested() as stop,
        closing(collection.generate(solve, jobs=jobs, cluster=cluster, on_lost=print_message)) as outcomes,
    ):
        for done, (_, solved) in enumerate(outcomes, 1):
            if as_json:
                show_json({**solved.gait.parameters, **solved.gait.solver})
            if progress.due():
                left = (time.monotonic() - start) / done * (todo - done)
                progress.show(f"{_bar(done / todo)} {done}/{todo} gaits, {_minutes(left)} left")
            if stop.wanted:
                break
    progress.clear()
    if stop.wanted:
        print_message(
            f"interrupted, {points - len(collection.missing())} of {points} gaits solved; repeat the command to resume"
        )
        raise SystemExit(stop.exit_code)
    failures = collection.failures()
    for index, status in failures.items():
        print_message(f"failed: {grid.subject(index)}: {status}")
    print_message(
        f"{points - len(collection.missing())} of {points} gaits solved, {_minutes(time.monotonic() - start)}"
    )
    if failures:
        raise Failed(f"{len(failures)} gaits failed; their records are in {out / 'failed'}")


@command.command()
@click.option("--library", "folder", type=_FOLDER, required=True, metavar="DIR", help="Folder of the gait library.")
@click.option("--out", type=OutputFile(".npz"), required=True, metavar="FILE", help="File for the network, .npz.")
@json_option
def fit(folder: Path, out: Path, as_json: bool) -> None:
    """Fit the gait network to a library. This takes about a minute. Equal libraries give equal networks.

    \b
    Example: atalante gait fit --library runs/library --out runs/network.npz
    """
    import math

    from atalante_control.dynamics.gait_network import save_network
    from atalante_hal.robot import load_robot

    with extra():
        from atalante_control.gait_optimization.fit import FitError
        from atalante_control.gait_optimization.fit import fit as fit_network
        from atalante_control.gait_optimization.library import Library
    collection = Library(folder)
    gaits = collection.gaits(load_robot())
    if missing := collection.missing():
        print_message(
            f"{len(missing)} of {len(gaits) + len(missing)} gaits are missing in {folder}; "
            "the network is less accurate near the missing gaits"
        )
    if rejected := collection.rejected():
        print_message(f"{_rejected(rejected)}; solve these gaits again with `atalante gait library --out {folder}`")
    if len(gaits) < 2:
        raise Failed(f"{folder} must contain at least two solved gaits, got {len(gaits)}")
    print_message(f"fitting {len(gaits)} gaits")
    start = time.monotonic()
    try:
        fitted = fit_network(list(gaits.values()), collection.grid)
    except FitError as error:
        raise Failed(f"{folder}: {error}") from error
    save_network(fitted.network, out)
    summary = {
        "gaits": len(gaits),
        "directions": fitted.directions,
        "rms_deg": math.degrees(fitted.rms),
        "worst_deg": math.degrees(fitted.worst),
        "seconds": time.monotonic() - start,
        "bytes": out.stat().st_size,
    }
    if as_json:
        show_json(summary)
    print_message(
        f"{out}: {summary['bytes'] / 1024:.0f} KiB, joint error on the gaits of the library {summary['rms_deg']:.3f} deg rms, "
        f"{summary['worst_deg']:.3f} deg at most; measure the error on other gaits with `atalante gait check --network {out}`"
    )


@command.command(short_help="Compare the gait network with newly solved gaits.")
@_network_option
@_count_option(100)
@_seed_option
@json_option
def check(file: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Compare the gait network with newly solved gaits of random subjects. The exit code is 1 if a deviation is too large.

    \b
    Example: atalante gait check
             atalante gait check --network runs/network.npz --count 20 --seed 7
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_hal.robot import load_robot

    with extra():
        from atalante_control.gait_optimization.library import solve_subject
        from atalante_control.gait_optimization.network_error import deviation, findings, random_subjects
    robot, network = load_robot(), load_network(file)
    progress, deviations = Progress(), []
    for number, subject in enumerate(random_subjects(network.low, network.high, count, seed)):
        with stop_requested() as stop:
            solved = solve_subject(subject)
        if stop.wanted:
            raise SystemExit(stop.exit_code)
        if not solved.solved:
            raise Failed(solved.status)
        deviations.append(deviation(subject, network.gait(subject, robot), solved.gait, robot))
        if progress.due():
            progress.show(f"{_bar((number + 1) / count)} {number + 1}/{count} gaits")
    progress.clear()
    found = findings(deviations)
    if as_json:
        for finding in found:
            show_json({**finding._asdict(), "ok": finding.ok})
    else:
        rows = [[f.name, f"{f.value:.4f}", f"{f.limit:g}", f.unit, "ok" if f.ok else "FAIL"] for f in found]
        click.echo(table([["network against solved gaits", "value", "limit", "unit", ""], *rows]))
    if not all(finding.ok for finding in found):
        raise SystemExit(FAILED)


@command.command(short_help="Verify the gaits of the gait network.")
@_network_option
@_count_option(200)
@_seed_option
@json_option
def verify(file: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Verify the gaits of the network for random subjects with Pinocchio. The exit code is 1 if a gait fails a check.

    The checks cover joint angles, speeds and torques, ground forces, centre of pressure, friction, clearance of the swing foot,
    the landing at the corners of the sole, and the impact. Each step has 201 samples. No gait is solved.

    \b
    Example: atalante gait verify
             atalante gait verify --network runs/network.npz --count 50 --seed 7
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait_optimization.network_error import random_subjects
    from atalante_control.gait_optimization.network_verification import network_checks, worst_checks
    from atalante_hal.robot import load_robot

    robot, network = load_robot(), load_network(file)
    progress, checks = Progress(), []
    for number, subject in enumerate(random_subjects(network.low, network.high, count, seed)):
        checks.append(network_checks(network, subject, robot))
        if progress.due():
            progress.show(f"{_bar((number + 1) / count)} {number + 1}/{count} gaits")
    progress.clear()
    found = worst_checks(checks)
    if as_json:
        for check in found:
            show_json(check._asdict())
    else:
        rows = [[c.name, f"{c.value:.3g}", f"{c.limit:.3g}", c.unit, str(c.failures)] for c in found]
        click.echo(table([[f"{count} gaits of the network", "worst", "limit", "unit", "failures"], *rows]))
    if any(check.failures for check in found):
        raise SystemExit(FAILED)


def _rejected(reasons: Mapping[Index, str]) -> str:
    """Return a sentence with the number of rejected gait files, and the reason for the first one."""
    return f"{len(reasons)} gait files are rejected, for example {next(iter(reasons.values()))}"


def _bar(share: float, width: int = 24) -> str:
    full = round(share * width)
    return f"[{'#' * full}{'.' * (width - full)}]"


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"
