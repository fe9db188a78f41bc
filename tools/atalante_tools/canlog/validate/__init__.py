"""Command `atalante validate`: check the frames of CAN logs or a live bus against the DBC.

Data flow: log -> validator (rules) -> findings -> report.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import Between, OutputFile, json_option, options_as
from atalante_tools.console.outcome import FAILED, INTERRUPTED, Failed
from atalante_tools.console.stop_request import check_stop, stop_requested
from atalante_tools.console.terminal import Progress, print_message, show_json

if TYPE_CHECKING:
    from atalante_tools.canlog.plan import Plan
    from atalante_tools.canlog.validate.project import Project
    from atalante_tools.canlog.validate.report import Report, Unread

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `atalante validate`."""

    interface: str  # python-can interface of the live bus; empty means log files
    channel: str  # channels of the live bus
    lockstep: bool  # whether the time stamps of the live bus are computed from the cycle number in SYNC
    seconds: float | None  # listening time on the live bus [s]; None means until Ctrl-C
    dbc: Path | None  # DBC to check against; None means the DBC of the robot
    node: str | None  # node whose missing messages are reported; None means all nodes
    rules_file: Path | None
    list_rules: bool
    junit: Path | None
    html_file: Path | None
    as_json: bool


_options = options_as(
    "options",
    Options,
    [
        click.option(
            "-i",
            "--interface",
            default="",
            metavar="NAME",
            help="Check a live bus instead of logs: socketcan, pcan, kvaser, ...",
        ),
        click.option(
            "-c",
            "--channel",
            default="",
            metavar="CHANNEL",
            help="Channel of the live bus: can0, or several: left_leg=can0,right_leg=can1.",
        ),
        click.option(
            "--lockstep",
            is_flag=True,
            help="Use this option if the live bus runs in lock-step. The times are then computed from the cycle number in SYNC.  "
            "[default: wall clock]",
        ),
        click.option(
            "--for",
            "seconds",
            type=Between(0.1),
            default=None,
            metavar="SECONDS",
            help="Listening time on the live bus, in seconds.  [default: until Ctrl-C]",
        ),
        click.option("--dbc", type=_FILE, default=None, help="DBC to check against.  [default: the DBC of the robot]"),
        click.option(
            "--node",
            default=None,
            metavar="NODE",
            help="Report missing messages of this node only, for example on a test bench with one node.  [default: all nodes]",
        ),
        click.option(
            "--rules",
            "rules_file",
            type=_FILE,
            default=None,
            help="TOML file with thresholds, silenced rules and channel names of a project.",
        ),
        click.option("--list-rules", is_flag=True, help="Print every rule with its source and thresholds, then exit."),
        click.option(
            "--junit",
            type=OutputFile(".xml"),
            default=None,
            metavar="FILE",
            help="Write the results as JUnit XML to this .xml file.",
        ),
        click.option(
            "--html",
            "html_file",
            type=OutputFile(".html", ".htm"),
            default=None,
            metavar="FILE",
            help="Write the report with plots to this .html file.",
        ),
        json_option,
    ],
)


@click.command()
@click.argument("logs", nargs=-1, metavar="LOG...", type=click.Path(path_type=Path))
@_options
def command(logs: tuple[Path, ...], options: Options) -> None:
    """Check CAN logs (.log of candump, .asc, .blf, .mf4, .trc, .csv) or a live bus against the DBC.

    The rules check cycle time, jitter, timeout, alive counter, CRC with Data ID, length, flags, range, value table,
    reserved bits, frame order, bus load, plausibility and drive state. The report lists all findings, the findings that
    the rules file silences, and the signals that no rule checked. The exit code is 1 if there are findings that are not
    silenced, or if no frame was checked.

    \b
    Example: atalante validate night.log --html night.html
             atalante validate -i socketcan -c can0 --node LEFT_FH --for 10
             atalante validate drive.blf --dbc vehicle.dbc --rules vehicle.toml --junit result.xml
    """
    from atalante_tools.canlog.validate.report import Report, rules_json, rules_text

    if options.list_rules:
        if options.as_json:
            for rule in rules_json():
                show_json(rule)
        else:
            click.echo(rules_text())
        return
    if bool(logs) == bool(options.interface):
        received = "both" if logs else "neither"
        raise click.UsageError(f"the input must be log files or a live bus (-i socketcan -c can0), got {received}")
    if options.interface and not options.channel:
        raise click.UsageError(f"{options.interface} needs a channel: -c can0")
    live = {"--channel": bool(options.channel), "--lockstep": options.lockstep, "--for": options.seconds is not None}
    for option, given in live.items():
        if given and not options.interface:
            raise click.UsageError(f"{option} needs a live bus: -i socketcan -c can0")
    plan, project = _prepare(options)
    results: Sequence[Report | Unread]
    results, code = _listen(options, plan, project) if options.interface else _read(logs, plan, project, options.node)
    reports = [result for result in results if isinstance(result, Report)]
    for result in reports:
        _show(result, options.as_json)
    _write(results, options.junit, options.html_file)
    if any(result.findings or not result.validator.frames for result in reports):
        raise SystemExit(FAILED)
    if code:
        raise SystemExit(code)


def _prepare(options: Options) -> tuple[Plan, Project]:
    """Load the DBC and the rules file.

    Raises:
        click.UsageError: If the node sends no message of the DBC, or the rules file names a bus that is not in the
            DBC.
    """
    from atalante_dbc import DBC_FILE
    from atalante_dbc.foreign import catalogue
    from atalante_tools.canlog.plan import Plan
    from atalante_tools.canlog.validate.project import Project, load_project

    plan = Plan(catalogue(options.dbc or DBC_FILE))
    project = Project() if options.rules_file is None else load_project(options.rules_file)
    if options.node is not None and options.node not in plan.senders:
        raise click.UsageError(
            f"--node must be a sender in the DBC ({', '.join(plan.senders) or 'the DBC has none'}), got {options.node!r}"
        )
    if unknown := sorted(set(project.channels.values()) - set(plan.buses)):
        raise click.UsageError(
            f"[channels] must name buses of the DBC ({', '.join(plan.buses) or 'the DBC has none'}), got {unknown[0]!r}"
        )
    return plan, project


def _read(logs: Sequence[Path], plan: Plan, project: Project, node: str | None) -> tuple[list[Report | Unread], int]:
    """Check the logs one after another. A log that cannot be read is reported on stderr, and the next log is checked.

    Returns:
        One result for each log, in the order of `logs`, and the exit code. The result of a log that cannot be read is
        `Unread`.
    """
    from atalante_tools.canlog.reader.log_file import LogError
    from atalante_tools.canlog.validate.report import Unread
    from atalante_tools.canlog.validate.run import validate_log

    results: list[Report | Unread] = []
    code = 0
    for path in logs:
        progress = Progress()

        def show(share: float, frames: int, path: Path = path, progress: Progress = progress) -> None:
            check_stop()  # a library may have discarded the exception of a stop signal
            if progress.due():
                progress.show(f"{path.name}: {100.0 * share:.0f} %, {frames} frames")

        try:
            results.append(validate_log(path, plan, project, node=node, progress=show))
        except LogError as error:
            print_message(f"atalante: {error}")
            results.append(Unread(str(path), str(error)))
            code = FAILED
        progress.clear()
        check_stop()
    return results, code


def _listen(options: Options, plan: Plan, project: Project) -> tuple[list[Report], int]:
    """Check a live bus until the listening time ends or a stop signal is received.

    Returns:
        The report, and the exit code of the stop signal. Ctrl-C is the normal end, so its exit code is 0.
    """
    from atalante_tools.canlog.validate.run import listen, open_channels

    buses = open_channels(options.interface, options.channel)
    progress = Progress()
    end = None if options.seconds is None else time.monotonic() + options.seconds

    def show(frames: int) -> None:
        if progress.due():
            progress.show(f"{frames} frames" + ("; Ctrl-C ends and prints the report" if end is None else ""))

    def notice(message: str) -> None:
        progress.clear()
        print_message(message)

    try:
        with stop_requested() as stop:
            result = listen(
                buses,
                plan,
                project,
                name=f"{options.interface} {options.channel}{' in lock-step' if options.lockstep else ''}",
                stopped=lambda: stop.wanted or (end is not None and time.monotonic() >= end),
                node=options.node,
                lockstep=options.lockstep,
                progress=show,
                notice=notice,
            )
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    finally:
        for bus in buses.values():
            bus.close()
    progress.clear()
    if stop.exit_code == INTERRUPTED:
        stop.settle()
    return [result], stop.exit_code


def _show(result: Report, as_json: bool) -> None:
    """Print the report as text on stdout. With `as_json`, print JSON findings on stdout and the text on stderr."""
    from atalante_tools.canlog.validate.report import text

    if as_json:
        for finding in result.findings:
            show_json({"log": result.name, **finding.as_json()})
        print_message(text(result))
    else:
        click.echo(text(result))


def _write(results: Sequence[Report | Unread], junit: Path | None, html_file: Path | None) -> None:
    """Write the JUnit and HTML reports that were requested."""
    from atalante_tools.canlog.validate.html import write_html
    from atalante_tools.canlog.validate.report import write_junit

    for path, write in ((junit, partial(write_junit, results)), (html_file, partial(write_html, results))):
        if path is None:
            continue
        try:
            write(path)
        except OSError as error:
            raise Failed(f"{path} cannot be written: {error.strerror}") from error
