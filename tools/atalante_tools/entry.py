"""Console entry point `atalante`: installs the signal handlers, runs the command line and returns the exit code.

The signal handlers are installed before any other module is imported, so that Ctrl-C during the imports ends cleanly.
"""

from __future__ import annotations

import sys

from atalante_tools.console.stop_request import Stopped, interruptible

TYPE_CHECKING = False  # same as `typing.TYPE_CHECKING`; importing `typing` would delay the signal handlers
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line.

    Raises:
        SystemExit: Always, with the exit code of the signal that stopped the command, or of the command itself.
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
    """Return whether `Stopped` is the cause of this exception, which a library raised in its place."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Stopped):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
