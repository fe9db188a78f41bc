"""Command `atalante faults`: inject the faults of the fault matrix into an emulated robot that walks suspended in the air.

`fault matrix (FAULTS.md), scenarios -> runner -> verdict -> report`. The modules `link`, `node`, `sensor`, `drive`, `host` and
`operator` define the scenarios. `campaign` runs many scenarios in parallel.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from atalante_tools.console.names import find
from atalante_tools.console.options import dask_option, engine_option, jobs_option, json_option, require_writable
from atalante_tools.console.outcome import Failed, InvalidUsage
from atalante_tools.console.stop_request import check_stop
from atalante_tools.console.terminal import Progress, print_message, show_json, table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from atalante_tools.faults.matrix import Row
    from atalante_tools.faults.report import Summary
    from atalante_tools.faults.tasks import Result, Task


@click.group()
def command() -> None:
    """Inject the faults of the fault matrix into an emulated robot, and check the reaction of the HAL.

    The fault matrix, in the file FAULTS.md of this package, lists for every fault an ID, the largest accepted reaction
    time in cycles of 1 ms, the final state of the HAL and the diagnostic code.

    \b
    Example: atalante faults list
             atalante faults run F04
             atalante faults campaign --jobs 2
             atalante faults false-alarms --cycles 200000
    """


@command.command("list", short_help="List all faults with time limit, diagnostic code and tests.")
@json_option
def list_(as_json: bool) -> None:
    """List all faults: time limit of the reaction, final state, diagnostic code, and tests (column "proof")."""
    from atalante_tools.faults.matrix import load_matrix

    rows = load_matrix().values()
    if as_json:
        for row in rows:
            show_json({**asdict(row), "state": row.state.name})
        return
    head = ["ID", "fault", "cycles", "state", "DTC", "proof"]
    click.echo(
        table([head, *([r.id, r.fault, r.cycles, r.state.name, r.dtc or "-", ", ".join(r.proof)] for r in rows)])
    )


@command.command("run", short_help="Run the cases of one fault and check the reactions.")
@click.argument("id_", metavar="ID")
@click.option("--case", "name", metavar="TEXT", default="", help="Run only the cases whose name contains this text.")
@engine_option
@json_option
def run(id_: str, name: str, engine: str, as_json: bool) -> None:
    """Run all test cases of one fault and check the reactions. Every case starts a new emulated robot."""
    from atalante_tools.faults.catalogue import SCENARIOS
    from atalante_tools.faults.report import Summary, number
    from atalante_tools.faults.tasks import CaseTask
    from atalante_tools.faults.verdict import Verdict

    row = _row(id_)
    if row.id not in SCENARIOS:
        raise InvalidUsage(
            f"{row.id} has only tests and no scenario: run `pytest {' '.join(f'tests/{t}' for t in row.tests)}`"
        )
    cases = SCENARIOS[row.id].cases
    tasks = [CaseTask(row.id, index, engine) for index, case in enumerate(cases) if name in case.name]
    if not tasks:
        raise InvalidUsage(
            f"no case of {row.id} has a name that contains {name!r}; valid cases: {'; '.join(c.name for c in cases)}"
        )
    summary = Summary.of(verdicts := [v for v in _done(tasks, engine=engine) if isinstance(v, Verdict)])
    if as_json:
        show_json(asdict(summary.lines[0]))
    else:
        head = ["case", "passed", "state", "cycles", "bound", "DTC"]
        rows = [[v.case, "yes" if v.passed else "NO", v.state, number(v.cycles), str(v.bound), v.dtc] for v in verdicts]
        click.echo(f"{row.id} {row.fault}: {row.behaviour}\n{table([head, *rows])}")
    _conclude(summary)


@command.command("false-alarms", short_help="Walk without a fault and count the reported diagnostics.")
@click.option(
    "--cycles",
    type=click.IntRange(1),
    default=3_000_000,
    show_default=True,
    metavar="N",
    help="Total number of cycles in all walks, rounded up to whole walks of about 60000 cycles. A cycle lasts 1 ms.",
)
@jobs_option
@dask_option
@engine_option
@json_option
def false_alarms(cycles: int, jobs: int, dask: str, engine: str, as_json: bool) -> None:
    """Walk without a fault, in the air and on the ground with patients, and count the reported diagnostics.

    The true mass of two in three patients differs by 10 % from the mass that the HAL knows. In every fourth walk on the ground,
    the muscles of the patient are active.

    GUIDE_OUTSIDE, TORQUE_SATURATED and OPERATOR_STOP are expected. Every other diagnostic is a false alarm. The exit code is 1
    after a false alarm, or if a walk does not end in ACTIVE.
    """
    from atalante_tools.faults.false_alarms import Quiet, quiet_tasks

    walks = list(_done(list(quiet_tasks(cycles, engine)), jobs=jobs, dask=dask, engine=engine))
    walked = sorted((walk for walk in walks if isinstance(walk, Quiet)), key=lambda walk: walk.name)
    for walk in walked if as_json else ():
        show_json({**asdict(walk), "alarms": walk.alarms})
    if not as_json:
        head = ["walk", "cycles", "state", "diagnostics", "false alarms"]
        rows = [[w.name, str(w.cycles), w.state, _counts(w.counts), _counts(w.alarms)] for w in walked]
        click.echo(table([head, *rows]))
    total, failed = sum(walk.cycles for walk in walked), sum(walk.failed for walk in walked)
    print_message(f"{len(walked)} walks, {total} cycles, {sum(sum(w.alarms.values()) for w in walked)} false alarms")
    if failed:
        raise Failed(f"{failed} of {len(walked)} walks had a false alarm or did not end in ACTIVE")


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{code} {count}" for code, count in sorted(counts.items())) or "-"


@command.command("campaign", short_help="Run all faults, single and in pairs, and write a report.")
@click.argument("ids", metavar="[ID]...", nargs=-1)
@jobs_option
@dask_option
@click.option("--pairs/--no-pairs", default=True, show_default=True, help="Also run pairs of faults.")
@click.option(
    "--moments/--no-moments",
    default=True,
    show_default=True,
    help="Also inject each fault at power-on, in READY, at START, in the walk, in HOLD and at the restart.",
)
@click.option(
    "--random-pairs",
    type=click.IntRange(0),
    default=200,
    show_default=True,
    metavar="N",
    help="Number of random pairs of faults that begin at random times.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, metavar="N", help="Seed of the random pairs."
)
@click.option(
    "--endurance/--no-endurance",
    default=True,
    show_default=True,
    help="Also measure, for each fault that can be permanent, the longest fault duration that does not stop the walk.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default="runs/faults",
    show_default=True,
    metavar="DIR",
    help="Folder for report.md and report.json.",
)
@engine_option
@json_option
def campaign_(
    ids: tuple[str, ...],
    jobs: int,
    dask: str,
    pairs: bool,
    moments: bool,
    random_pairs: int,
    seed: int,
    endurance: bool,
    out: Path,
    engine: str,
    as_json: bool,
) -> None:
    """Run all faults, or the faults with the given IDs, and write a report.

    With IDs, no pairs of faults are run.
    """
    from atalante_tools.faults.catalogue import SCENARIOS
    from atalante_tools.faults.report import Summary
    from atalante_tools.faults.tasks import Scope, plan

    chosen = [_row(id_).id for id_ in ids] or list(SCENARIOS)
    if without := [id_ for id_ in chosen if id_ not in SCENARIOS]:
        raise InvalidUsage(f"{without[0]} has only tests and no scenario: `atalante faults list` shows the tests")
    scope = Scope(endurance, pairs and not ids, moments, 0 if ids else random_pairs, seed)
    tasks = plan(chosen, scope, engine)
    out.mkdir(parents=True, exist_ok=True)  # created now, so that an invalid folder is reported before the runs start
    require_writable(out)
    begun = time.monotonic()
    print_message(f"{len(tasks)} runs on {f'the workers of {dask}' if dask else f'{jobs} processes'}")
    found = list(_done(tasks, jobs=jobs, dask=dask, engine=engine))
    summary = Summary.of(found, time.monotonic() - begun)
    summary.write(out)
    if as_json:
        for line in summary.lines:
            show_json(asdict(line))
    else:
        click.echo(_table(summary))
    print_message(f"{len(found)} runs in {summary.seconds:.0f} s; in {out}: report.md, report.json")
    _conclude(summary)


def _row(id_: str) -> Row:
    from atalante_tools.faults.matrix import load_matrix

    rows = list(load_matrix().values())
    return rows[find(id_, [row.id for row in rows], "fault")]


def _done(tasks: Sequence[Task], *, engine: str, jobs: int = 1, dask: str = "") -> Iterator[Result]:
    """Yield each result as soon as it is complete, and show a progress bar."""
    from atalante_tools.faults.campaign import results
    from atalante_tools.session.body import require_engine

    if not dask:  # with dask, only the workers need the physics engine
        require_engine(engine)
    progress = Progress()
    try:
        for count, result in enumerate(results(tasks, jobs=jobs, dask=dask), 1):
            yield result
            check_stop()
            progress.bar(count, len(tasks), "runs")
    finally:
        progress.clear()


def _table(summary: Summary) -> str:
    """Return a table with one row per fault. Column "survived": longest fault duration that the walk survives [cycles]."""
    from atalante_tools.faults.report import number, survived

    lasts = {one.id: survived(one) for one in summary.endurance}
    head = ["ID", "passed", "state", "cycles", "bound", "DTC", "cases", "survived"]
    rows = [
        [line.id, "yes" if line.passed else "NO", line.state, number(line.cycles), str(line.bound), line.dtc,
         str(line.cases), lasts.get(line.id, "-")]
        for line in summary.lines
    ]  # fmt: skip
    return table([head, *rows])


def _conclude(summary: Summary) -> None:
    """Print all failures to stderr.

    Raises:
        Failed: If a fault or a pair failed.
    """
    for line in summary.lines:
        for failure in line.failures:
            print_message(f"{line.id} {failure}")
    for pair in summary.pairs:
        for failure in pair.failures:
            print_message(f"{pair.first} and {pair.second}: {failure}")
    for verdict in summary.moments:
        for failure in verdict.failures:
            print_message(f"{' and '.join(verdict.faults)}, moment {verdict.moment}: {failure}")
    if not summary.passed:
        faults = sum(not line.passed for line in summary.lines)
        pairs, moments = (sum(bool(one.failures) for one in runs) for runs in (summary.pairs, summary.moments))
        raise Failed(
            f"{faults} of {len(summary.lines)} faults, {pairs} of {len(summary.pairs)} pairs and {moments} of "
            f"{len(summary.moments)} runs at other moments failed"
        )
