"""The `atalante` command: subcommands imported when they are called, and errors as one sentence with an exit code."""

from __future__ import annotations

import importlib
from typing import Any

import click

from atalante_tools.entry import main as main
from atalante_tools.outcome import INTERRUPTED, Misused, failure_of

#: Command -> its line in the list. Each is the attribute `command` of the module of that name.
COMMANDS = {
    "demo": "Everything at once: the emulated robot walks in the air behind each virtual guide.",
    "hang": "The controller of the demo on any bus: steps in the air with the virtual guide.",
    "emulator": "Be the robot on a bus, for a HAL in another process.",
    "jog": "Move one joint to an angle.",
    "vibrate": "Run one vibration motor.",
    "pendant": "Be the operator: start, stop, hold, assistance factor.",
    "status": "Listen to a bus and say what every node says.",
    "doctor": "Is this machine ready, and what to type if not.",
    "validate": "Judge CAN logs or a live bus by everything the DBC says.",
    "decode": "The signals of CAN logs as Parquet or MCAP.",
    "conform": "An acceptance test of one node, with this computer in the place of the HAL.",
    "faults": "The fault matrix, and runs of the walking robot that prove it.",
    "dbc": "Check, print and compare network descriptions, and make C code of one.",
    "model": "The patient-exoskeleton model: its links, checks, URDF and picture.",
    "gait": "Solve gaits, collect them in a library, fit the network that walks them.",
    "bench": "How fast the stack is, with the baseline beside each figure.",
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
        command = importlib.import_module(f"atalante_tools.{cmd_name}").command
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list without importing."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

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
            raise Misused(f"{error.format_message().rstrip('.')}; see `{where} --help`") from error
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
