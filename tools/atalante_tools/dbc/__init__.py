"""Command `atalante dbc`: check, print and compare DBC files, and generate C code."""

from __future__ import annotations

from pathlib import Path

import click

from atalante_tools.console.options import SEED, Between, json_option, typed
from atalante_tools.console.outcome import FAILED, Failed
from atalante_tools.console.terminal import print_message, show_json, table

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
#: Argument FILE: a DBC file. The default is the DBC file of the robot.
_file_argument = click.argument("file", type=_FILE, required=False)


@click.group()
def command() -> None:
    """Check, print and compare DBC files, and generate C code. The default of FILE is the DBC file of the robot.

    \b
    Example: atalante dbc lint
             atalante dbc diff old.dbc new.dbc
    """


@command.command(short_help="List the errors of FILE.")
@_file_argument
@json_option
def lint(file: Path | None, as_json: bool) -> None:
    """List all errors in FILE with line numbers. The exit code is 1 if FILE has an error."""
    from atalante_tools.dbc.lint import findings

    path = file or _own()
    found = findings(path)
    for finding in found:
        if as_json:
            show_json({"file": str(path), "line": finding.line, "text": finding.text})
        else:
            click.echo(f"{path}:{finding.line or ''}{':' if finding.line else ''} {finding.text}")
    if found:
        print_message(f"{path}: {len(found)} error{'s' * (len(found) > 1)}")
        raise SystemExit(FAILED)
    print_message(f"{path}: no errors")


@command.command("table")
@_file_argument
@click.option("--signals", is_flag=True, help="Print one row per signal, with unit, range and invalid code.")
@json_option
def print_table(file: Path | None, signals: bool, as_json: bool) -> None:
    """Print a table of the messages of FILE."""
    import atalante_dbc
    from atalante_tools.dbc.tables import message_rows, signal_rows

    network = atalante_dbc.load(file)
    _show(signal_rows(network) if signals else message_rows(network), as_json)


@command.command(short_help="Print the worst-case load of each bus.")
@_file_argument
@click.option(
    "--limit",
    type=Between(min=0.0),
    default=60.0,
    show_default=True,
    metavar="PERCENT",
    help="Largest accepted load of a bus, in percent.",
)
@json_option
def busload(file: Path | None, limit: float, as_json: bool) -> None:
    """Print the worst-case load per bus and per message. The exit code is 1 if a bus load is above the limit."""
    import atalante_dbc
    from atalante_tools.dbc.tables import load_rows

    network = atalante_dbc.load(file)
    load = {bus: 100.0 * share for bus, share in network.bus_load().items()}
    for bus in network.buses:
        rows = load_rows(network, bus)
        if as_json:
            show_json({"bus": bus, "percent": load[bus], "limit_percent": limit, "messages": rows})
            continue
        click.echo(f"{bus}: {load[bus]:.1f} % of {limit:g} %")
        _show([{**row, "us": f"{row['us']:.1f}", "percent": f"{row['percent']:.2f}"} for row in rows], as_json)
        click.echo()
    if over := [f"{bus} ({percent:.1f} %)" for bus, percent in load.items() if percent > limit]:
        raise Failed(f"worst-case bus load must be at most {limit:g} %, got {', '.join(over)}")


@command.command(short_help="List the changes on the bus from OLD to NEW.")
@click.argument("old", type=_FILE)
@click.argument("new", type=_FILE)
@json_option
def diff(old: Path, new: Path, as_json: bool) -> None:
    """List the changes from OLD to NEW. The exit code is 1 if nodes with OLD and nodes with NEW cannot communicate."""
    import atalante_dbc
    from atalante_tools.dbc.diff import changes

    found = changes(atalante_dbc.load(old), atalante_dbc.load(new))
    breaking = [change for change in found if change.breaking]
    for change in sorted(found, key=lambda change: not change.breaking):
        kind = "breaking" if change.breaking else "compatible"
        if as_json:
            show_json({"kind": kind, "subject": change.subject, "where": change.where, "text": change.text})
        else:
            click.echo(f"{kind:<10}  {change.where}: {change.text}")
    print_message(f"{len(breaking)} breaking and {len(found) - len(breaking)} compatible changes")
    if breaking:
        raise SystemExit(FAILED)


@command.command("c-code", short_help="Generate C code for FILE.")
@_file_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    metavar="DIR",
    help="Folder of the generated files; created if it does not exist.",
)
@click.option("--node", metavar="NODE", help="Generate code only for the messages that this node sends or receives.")
@click.option(
    "--check",
    is_flag=True,
    help="Compile and run the C code on this computer, and compare its results with the Python codec.",
)
@click.option(
    "--images",
    type=click.IntRange(min=1),
    default=10_000,
    show_default=True,
    metavar="N",
    help="Number of comparisons. Each comparison tests one random payload of every message. Requires --check.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the random payloads.")
@json_option
def c_code(
    file: Path | None, output: Path, node: str | None, check: bool, images: int, seed: int, as_json: bool
) -> None:
    """Generate C code for the messages of FILE: pack, unpack, E2E protection, test vectors and a host test.

    The host test is a C program that compares the C code with the Python codec.
    """
    if typed("images") and not check:
        raise click.UsageError("--images requires a comparison: add --check")
    from atalante_tools.dbc.build import Build
    from atalante_tools.dbc.c_code import write
    from atalante_tools.dbc.host_test import compile_host_test, run_host_test

    build = Build.of(file or _own(), node)
    written = write(build, output, seed)
    if as_json:
        show_json(
            {"files": [str(path) for path in written], "node": node, "messages": [m.name for m in build.messages]}
        )
    else:
        for path in written:
            click.echo(path)
    if check:
        program = compile_host_test(build, output)
        compared = run_host_test(build, program, images, seed)
        if as_json:
            show_json({"images": images, "compared": compared, "equal": True})
        else:
            print_message(f"C and Python agree on {images} images, {compared} frames")


def _own() -> Path:
    from atalante_dbc import DBC_FILE

    return DBC_FILE


def _show(rows: list[dict[str, object]], as_json: bool) -> None:
    if as_json:
        for row in rows:
            show_json(row)
    elif rows:
        click.echo(table([list(rows[0]), *([_cell(value) for value in row.values()] for row in rows)]))


def _cell(value: object) -> str:
    if isinstance(value, list | tuple):
        return " ".join(map(str, value))
    if value is None:
        return "-"
    return f"{value:.10g}" if isinstance(value, float) else str(value)
