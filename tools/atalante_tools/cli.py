"""The `atalante` command: subcommands imported when they are called, and errors as one sentence with an exit code."""

from __future__ import annotations

import importlib
from typing import Any

import click

from atalante_tools.console.outcome import INTERRUPTED, InvalidUsage, failure_of
from atalante_tools.entry import main as main

#: Command -> the module below `atalante_tools` whose attribute `command` it is, and its line in the list.
COMMANDS = {
    "demo": ("commands.demo", "Everything at once: the emulated robot walks in the air behind each virtual guide."),
    "airwalk": ("commands.airwalk", "The controller of the demo on any bus: steps in the air with the virtual guide."),
    "emulator": ("commands.emulator", "Be the robot on a bus, for a HAL in another process."),
    "jog": ("commands.jog", "Move one joint to an angle."),
    "vibrate": ("commands.vibrate", "Run one vibration motor."),
    "pendant": ("commands.pendant", "Be the operator: start, stop, hold, assistance factor."),
    "status": ("commands.status", "Listen to a bus and say what every node says."),
    "doctor": ("commands.doctor", "Is this machine ready, and what to type if not."),
    "validate": ("canlog.validate", "Judge CAN logs or a live bus by everything the DBC says."),
    "decode": ("canlog.decode", "The signals of CAN logs as Parquet or MCAP."),
    "conform": ("conform", "An acceptance test of one node, with this computer in the place of the HAL."),
    "faults": ("faults", "The fault matrix, and runs of the walking robot that prove it."),
    "dbc": ("dbc", "Check, print and compare network descriptions, and make C code of one."),
    "model": ("model", "The patient-exoskeleton model: its links, checks, URDF and picture."),
    "gait": ("gait", "Solve gaits, collect them in a library, fit the network that walks them."),
    "bench": ("bench", "How fast the stack is, with the baseline beside each figure."),
}


class Commands(click.Group):
    """The group of all commands; importing it imports none of them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order in which a newcomer needs them."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command."""
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f"atalante_tools.{COMMANDS[cmd_name][0]}").command
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list without importing."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an error that has a message for the user ends in that message."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            ctx.exit(INTERRUPTED)
        except click.exceptions.NoArgsIsHelpError:
            raise  # a group named alone: its help is the answer
        except click.UsageError as error:
            where = error.ctx.command_path if error.ctx else ctx.command_path
            raise InvalidUsage(f"{error.format_message().rstrip('.')}; see `{where} --help`") from error
        except Exception as error:
            failure = failure_of(error)
            if failure is None:
                raise
            raise failure from error


def _version(ctx: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        click.echo(f"atalante {version('atalante-hal')}")
        ctx.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Print the version."
)
def cli() -> None:
    """Drive, emulate and watch an Atalante-like exoskeleton on CAN FD.

    Angles are degrees at the terminal. Start with `atalante demo`.

    Exit codes: 0 ok, 1 failed, 2 usage, 3 no device, 4 fault latched, 130 Ctrl-C, 143 SIGTERM.
    """
