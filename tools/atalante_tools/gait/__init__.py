"""`atalante gait`: make a library of gaits, fit the network to it, and see whether the network knows gaits it never saw."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

import click

from atalante_tools.console.options import SEED, OutputFile, json_option
from atalante_tools.console.outcome import FAILED, Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import Progress, say, show_json, table
from atalante_tools.gait.extra import extra
from atalante_tools.gait.solve import solve

_FOLDER = click.Path(file_okay=False, path_type=Path)
_FILE = click.Path(dir_okay=False, path_type=Path)


def levels_of(text: str) -> tuple[float, ...]:
    """Levels of a parameter, numbers with commas between them: an option's type."""
    try:
        return tuple(map(float, text.split(",")))
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of levels; write numbers with commas, 58,75,91") from None


@click.group()
def command() -> None:
    """Solve gaits, collect them in a library, and fit the network that the controller walks with.

    \b
    Example: atalante gait solve --mass 75 --height 175
             atalante gait library --out runs/library --jobs 2
             atalante gait fit --library runs/library --out runs/network.npz
             atalante gait check --network runs/network.npz
    """


command.add_command(solve)


@command.command(short_help="Solve the gaits of a grid of patients and steps.")
@click.option(
    "--out", type=_FOLDER, required=True, metavar="DIR", help="Folder of the library; made if it is not there."
)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, metavar="N", help="Processes.")
@click.option(
    "--compile/--no-compile",
    "machine_code",
    default=False,
    help="Compile the program with gcc first: minutes, once on a machine; then a gait takes half the time.",
)
@click.option("--dask", "cluster", metavar="ADDRESS", help="Solve on the workers of this dask scheduler instead.")
@click.option(
    "--mass", type=levels_of, metavar="KG,...", help="Levels of the grid.  [default: four over the paper's subjects]"
)
@click.option("--height", type=levels_of, metavar="M,...", help="Levels of the grid.")
@click.option("--step-length", type=levels_of, metavar="M,...", help="Levels of the grid.")
@click.option("--step-duration", type=levels_of, metavar="S,...", help="Levels of the grid.")
@json_option
def library(
    out: Path, jobs: int, machine_code: bool, cluster: str | None, as_json: bool, **levels: tuple[float, ...] | None
) -> None:
    """Solve the gait of every point of a grid of patients and steps, one file each in DIR/gaits.

    Interrupted, the same command goes on where it stopped. A gait that fails is listed, here and in DIR/failed, and tried
    again by the next call; exit code 1 if there is one.

    \b
    Example: atalante gait library --out runs/library --jobs 2
             atalante gait library --out runs/library --dask tcp://127.0.0.1:8786
             atalante gait library --out runs/slow --step-duration 1.0,1.1,1.2
    """
    with extra():
        from atalante_control.gait_optimization.library import Grid, Library, solve_compiled, solve_subject
    try:
        grid = Grid(**{name: values for name, values in levels.items() if values is not None})
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    collection = Library(out, grid)
    points, todo = len(grid.points()), len(collection.missing())
    say(f"{points} gaits in {out}, {points - todo} of them solved before")
    progress, began = Progress(), time.monotonic()
    solve = solve_compiled if machine_code else solve_subject
    # The optimiser keeps an exception to itself and gives up: a gait that is begun is finished, or it would count as failed.
    with stop_requested() as stop, closing(collection.generate(solve, jobs=jobs, cluster=cluster)) as outcomes:
        for done, (_, solved) in enumerate(outcomes, 1):
            if as_json:
                show_json({**solved.gait.parameters, **solved.gait.solver})
            if progress.due():
                left = (time.monotonic() - began) / done * (todo - done)
                progress.show(f"{_bar(done / todo)} {done}/{todo} gaits, {_minutes(left)} left")
            if stop.wanted:
                break
    progress.clear()
    if stop.wanted:
        say(f"interrupted, {points - len(collection.missing())} of {points} gaits solved; the same command goes on")
        raise SystemExit(stop.exit_code)
    failures = collection.failures()
    for index, status in failures.items():
        say(f"failed: {grid.subject(index)}: {status}")
    say(f"{points - len(collection.missing())} of {points} gaits solved, {_minutes(time.monotonic() - began)}")
    if failures:
        raise Failed(f"{len(failures)} gaits failed; their records are in {out / 'failed'}")


@command.command()
@click.option("--library", "folder", type=_FOLDER, required=True, metavar="DIR", help="What `gait library` made.")
@click.option("--out", type=OutputFile(".npz"), required=True, metavar="FILE", help="The network, .npz.")
@json_option
def fit(folder: Path, out: Path, as_json: bool) -> None:
    """Fit the gait network to a library; takes a minute. The same library gives the same network.

    \b
    Example: atalante gait fit --library runs/library --out runs/network.npz
    """
    import math

    from atalante_control.dynamics.gait_network import save_network
    from atalante_hal.robot import load_robot

    with extra():
        from atalante_control.gait_optimization.fit import fit as fit_network
        from atalante_control.gait_optimization.library import Library
    collection = Library(folder)
    gaits = collection.gaits(load_robot())
    if missing := collection.missing():
        say(
            f"{len(missing)} of {len(gaits) + len(missing)} gaits are missing in {folder}: the network will be worse there"
        )
    say(f"fitting {len(gaits)} gaits")
    began = time.monotonic()
    fitted = fit_network(list(gaits.values()), collection.grid)
    save_network(fitted.network, out)
    summary = {
        "gaits": len(gaits),
        "directions": fitted.directions,
        "rms_deg": math.degrees(fitted.rms),
        "worst_deg": math.degrees(fitted.worst),
        "seconds": time.monotonic() - began,
        "bytes": out.stat().st_size,
    }
    if as_json:
        show_json(summary)
    say(
        f"{out}: {summary['bytes'] / 1024:.0f} KiB, joint error at the library's own gaits {summary['rms_deg']:.3f} deg rms, "
        f"{summary['worst_deg']:.3f} deg worst; `atalante gait check --network {out}` says how it is elsewhere"
    )


@command.command(short_help="Compare the network with freshly solved gaits.")
@click.option("--network", "file", type=_FILE, metavar="FILE", help="The network.  [default: the one that ships]")
@click.option(
    "--count", type=click.IntRange(min=1), default=50, show_default=True, metavar="N", help="Random subjects."
)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Of the subjects.")
@json_option
def check(file: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Compare the network with freshly solved gaits of subjects it never saw; exit code 1 if it is not near enough.

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
        click.echo(table([["of the network against solved gaits", "found", "limit", "unit", ""], *rows]))
    if not all(finding.ok for finding in found):
        raise SystemExit(FAILED)


def _bar(share: float, width: int = 24) -> str:
    full = round(share * width)
    return f"[{'#' * full}{'.' * (width - full)}]"


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"
