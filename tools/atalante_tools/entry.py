"""The console entry point `atalante`: signals are handled before anything else is imported, and the exit code is decided here."""

from __future__ import annotations

import sys

from atalante_tools.console.stop_request import Stopped, interruptible

TYPE_CHECKING = False  # as `typing.TYPE_CHECKING`, without importing `typing`
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line.

    Raises:
        SystemExit: with the exit code of the signal that asked to stop, else with that of the command.
    """
    code: object = 0
    with interruptible() as stop:
        try:
            from atalante_tools.cli import cli
            from atalante_tools.console.terminal import Patience

            Patience.begin()
            cli(prog_name="atalante")
        except SystemExit as end:
            code = end.code
        except BaseException as error:
            if not stop.wanted:
                raise
            if not _made_from_stop(error):
                print(f"atalante: stopped by a signal, then {type(error).__name__}: {error}", file=sys.stderr)
    raise SystemExit(stop.exit_code or code)


def _made_from_stop(error: BaseException) -> bool:
    """Whether a library turned `Stopped` into an exception of its own."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Stopped):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
