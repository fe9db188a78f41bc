"""`atalante validate`: frames of a log or a live bus against the DBC, `log -> judge (rules) -> findings -> report`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from atalante_tools.options import Between, Written, json_option
from atalante_tools.outcome import FAILED, INTERRUPTED, Failed
from atalante_tools.signals import stop_requested
from atalante_tools.terminal import Progress, say, show_json

if TYPE_CHECKING:
    from atalante_tools.validate.plan import Plan
    from atalante_tools.validate.project import Project
    from atalante_tools.validate.report import Report

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.command()
@click.argument("logs", nargs=-1, metavar="LOG...", type=click.Path(path_type=Path))
@click.option(
    "-i", "--interface", default="", metavar="NAME", help="Listen to a bus instead: socketcan, pcan, kvaser, ..."
)
@click.option("-c", "--channel", default="", metavar="CHANNEL", help="can0, or several: left_leg=can0,right_leg=can1.")
@click.option(
    "--for",
    "seconds",
    type=Between(0.1),
    default=None,
    metavar="SECONDS",
    help="Listen so long [s], otherwise until Ctrl-C.",
)
@click.option("--dbc", type=_FILE, default=None, help="The network; the robot's own unless given.")
@click.option(
    "--node", default=None, metavar="NODE", help="Only this node's messages must be there: one node on the desk."
)
@click.option(
    "--rules",
    "rules_file",
    type=_FILE,
    default=None,
    help="Thresholds, silenced rules and channels of the project (TOML).",
)
@click.option("--list-rules", is_flag=True, help="Print every rule with its source and thresholds, and end.")
@click.option("--junit", type=Written(), default=None, metavar="FILE", help="Write the result as JUnit XML.")
@click.option("--html", "html_file", type=Written(), default=None, metavar="FILE", help="Write a report with plots.")
@json_option
def command(
    logs: tuple[Path, ...],
    interface: str,
    channel: str,
    seconds: float | None,
    dbc: Path | None,
    node: str | None,
    rules_file: Path | None,
    list_rules: bool,
    junit: Path | None,
    html_file: Path | None,
    as_json: bool,
) -> None:
    """Judge CAN logs (.log of candump, .asc, .blf, .mf4, .trc, .csv), or a live bus, by everything the DBC says.

    Cycle time, jitter, timeouts, alive counter, CRC with Data ID, length, flags, ranges, value tables, reserved bits, order,
    load, plausibility, drive states. What is silenced and what no rule looked at is in the report. Ends with code 1 when
    there are findings, and when there was nothing to judge.

    \b
    Example: atalante validate night.log --html night.html
             atalante validate -i socketcan -c can0 --node LEFT_FH --for 10
             atalante validate drive.blf --dbc vehicle.dbc --rules vehicle.toml --junit result.xml
    """
    from atalante_tools.validate.report import rules_json, rules_text

    if list_rules:
        if as_json:
            for rule in rules_json():
                show_json(rule)
        else:
            click.echo(rules_text())
        return
    if bool(logs) == bool(interface):
        raise click.UsageError("name one or more logs, or a bus to listen to: -i socketcan -c can0")
    if interface and not channel:
        raise click.UsageError(f"{interface} needs a channel: -c can0")
    plan, project = _prepare(dbc, rules_file, node)
    if interface:
        results, code = _listen(interface, channel, seconds, plan, project, node)
    else:
        results, code = _read(logs, plan, project, node)
    for result in results:
        _show(result, as_json)
    _write(results, junit, html_file)
    if any(result.findings or not result.judge.frames for result in results):
        raise SystemExit(FAILED)
    if code:
        raise SystemExit(code)


def _prepare(dbc: Path | None, rules_file: Path | None, node: str | None) -> tuple[Plan, Project]:
    from atalante_dbc import DBC_FILE
    from atalante_dbc.foreign import catalogue
    from atalante_tools.validate.plan import Plan
    from atalante_tools.validate.project import Project, load_project

    plan = Plan(catalogue(dbc or DBC_FILE))
    project = Project() if rules_file is None else load_project(rules_file)
    if node is not None and node not in plan.senders:
        raise click.UsageError(
            f"no message of the DBC is sent by {node!r}; senders are {', '.join(plan.senders) or 'none'}"
        )
    if unknown := sorted(set(project.channels.values()) - set(plan.buses)):
        raise click.UsageError(
            f"[channels] names the bus {unknown[0]!r}; the DBC has {', '.join(plan.buses) or 'none'}"
        )
    return plan, project


def _read(logs: Sequence[Path], plan: Plan, project: Project, node: str | None) -> tuple[list[Report], int]:
    """Judge logs; one that cannot be opened is reported and the others go on."""
    from atalante_tools.validate.log import LogError
    from atalante_tools.validate.run import judge_log

    results, code = [], 0
    for path in logs:
        progress = Progress()

        def show(share: float, frames: int, path: Path = path, progress: Progress = progress) -> None:
            if progress.due():
                progress.show(f"{path.name}: {100.0 * share:.0f} %, {frames} frames")

        try:
            results.append(judge_log(path, plan, project, node=node, progress=show))
        except LogError as error:
            say(f"atalante: {error}")
            code = FAILED
        progress.clear()
    return results, code


def _listen(
    interface: str, channel: str, seconds: float | None, plan: Plan, project: Project, node: str | None
) -> tuple[list[Report], int]:
    """Judge a live bus until the time is over or somebody wants to stop; Ctrl-C is the usual end and no failure."""
    from atalante_tools.validate.run import listen, open_channels

    buses = open_channels(interface, channel)
    progress = Progress()
    end = None if seconds is None else time.monotonic() + seconds

    def show(frames: int) -> None:
        if progress.due():
            progress.show(f"{frames} frames" + ("; Ctrl-C ends and prints the report" if end is None else ""))

    try:
        with stop_requested() as stop:
            result = listen(
                buses,
                plan,
                project,
                name=f"{interface} {channel}",
                over=lambda: stop.wanted or (end is not None and time.monotonic() >= end),
                node=node,
                progress=show,
            )
    finally:
        for bus in buses.values():
            bus.close()
    progress.clear()
    if stop.exit_code == INTERRUPTED:
        stop.settle()
    return [result], stop.exit_code


def _show(result: Report, as_json: bool) -> None:
    """Findings as JSON on stdout and the rest on stderr, or everything as text."""
    from atalante_tools.validate.report import text

    if as_json:
        for finding in result.findings:
            show_json(finding.as_json())
        say(text(result))
    else:
        click.echo(text(result))


def _write(results: Sequence[Report], junit: Path | None, html_file: Path | None) -> None:
    from atalante_tools.validate.html import write_html
    from atalante_tools.validate.report import write_junit

    for path, write in ((junit, write_junit), (html_file, write_html)):
        if path is None:
            continue
        try:
            write(results, path)
        except OSError as error:
            raise Failed(f"{path} cannot be written: {error.strerror}") from error
