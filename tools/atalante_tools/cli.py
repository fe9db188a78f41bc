"""The command group `atalante`: imports only the called subcommand, and reports an error as one sentence.

`entry.main` runs this group. The group runs the function `command` of the subcommand's module. See console/outcome.py for the
exit codes.
"""

from __future__ import annotations

import importlib
from typing import Any

import click

from atalante_tools.console.outcome import INTERRUPTED, InvalidUsage, failure_of
from atalante_tools.entry import main as main

#: Command name -> module in `atalante_tools` that defines the command, and its one-line description in `atalante --help`.
COMMANDS = {
    "demo": ("commands.demo", "Run all parts in one command: an emulated robot walks in virtual guides."),
    "airwalk": ("commands.airwalk", "Walk in the air inside one virtual guide, on any bus."),
    "walk": ("commands.walk", "Walk on the ground with a patient, from standing to standing, on any bus."),
    "trial": ("trial", "Repeat the experiments of the paper with virtual subjects, and write a report."),
    "emulator": ("commands.emulator", "Emulate the robot on a bus, for a HAL in another process."),
    "jog": ("commands.jog", "Move one joint to an angle."),
    "vibrate": ("commands.vibrate", "Run one vibration motor."),
    "pendant": ("commands.pendant", "Act as the pendant: start, stop, hold, assistance factor."),
    "status": ("commands.status", "Listen to a bus and print the state of every node."),
    "doctor": ("commands.doctor", "Check whether this computer is ready, and print the commands that fix problems."),
    "validate": ("canlog.validate", "Check CAN logs or a live bus against the DBC."),
    "decode": ("canlog.decode", "Write the signals of CAN logs as Parquet or MCAP."),
    "conform": ("conform", "Test one node for acceptance, with this computer as the HAL."),
    "faults": ("faults", "List the fault matrix and run its faults on a walking robot."),
    "guide": ("guide", "Search for pushes that move a joint out of a virtual guide."),
    "dbc": ("dbc", "Check, print and compare DBC files, and generate C code."),
    "model": ("model", "Print, check, export and draw the patient-exoskeleton model."),
    "gait": ("gait", "Solve gaits, build a gait library, fit and check the gait network."),
    "bench": ("bench", "Measure the speed of the stack against baselines."),
}


#: Key in `click.Context.meta`. The value is a tuple with all words of the command line after `atalante`.
_WORDS = "atalante_tools.words"


class Commands(click.Group):
    """Click group of all commands. The group imports a command only when the command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands in the order of `COMMANDS`."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command and return it. Return None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f"atalante_tools.{COMMANDS[cmd_name][0]}").command
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands into the help text, without importing the commands."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line. If the output of `--help` or `--version` cannot be written, print one sentence and exit."""
        try:
            return super().main(*args, **kwargs)
        except OSError as error:
            failure = failure_of(error)
            if failure is None:
                raise
            failure.show()
            raise SystemExit(failure.exit_code) from error

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options of the group, and store the words of the command line for `_called`.

        The words are stored first, because click removes words from `args`.

        Raises:
            Failed: If an option of the group is invalid. The message is one sentence.
        """
        ctx.meta[_WORDS] = tuple(args)
        try:
            return super().parse_args(ctx, args)
        except click.exceptions.NoArgsIsHelpError:
            raise  # no command was given: click prints the help of the group
        except click.UsageError as error:
            raise self._invalid(error, ctx) from error

    def _invalid(self, error: click.UsageError, ctx: click.Context) -> InvalidUsage:
        """Return the error of click as one sentence. The sentence ends with the command that prints the help."""
        command_path = error.ctx.command_path if error.ctx else self._called(ctx)
        return InvalidUsage(f"{error.format_message().rstrip('.')}; see `{command_path} --help`")

    def _called(self, ctx: click.Context) -> str:
        """Return the full name of the called command, such as `atalante dbc diff`.

        Some errors of click, such as a missing value of an option, do not contain the command.
        """
        command: click.Command | None = self
        names = [ctx.command_path]
        for word in ctx.meta[_WORDS]:
            command = command.get_command(ctx, word) if isinstance(command, click.Group) else None
            if command is None:
                break
            names.append(word)
        return " ".join(names)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, and replace known errors by `Failed`.

        Raises:
            Failed: If the command line is invalid, or the command raised a known error. The message of `Failed` is one sentence.
        """
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            ctx.exit(INTERRUPTED)
        except click.exceptions.NoArgsIsHelpError:
            raise  # no subcommand was given: click prints the help of the group
        except click.UsageError as error:
            raise self._invalid(error, ctx) from error
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
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_version, help="Print the version and exit."
)
def cli() -> None:
    """Drive, emulate and monitor an Atalante-like exoskeleton on CAN FD.

    Angles in options and results are in degrees. Start with `atalante demo`.

    Exit codes: 0 ok, 1 failed, 2 usage error, 3 no device, 4 fault latched, 129 SIGHUP, 130 Ctrl-C,
    143 SIGTERM.
    """
