"""Console entry point `atalante`: installs the signal handlers, runs the command line and returns the exit code.

The signal handlers are installed first, because Ctrl-C during the slow imports must not print a traceback.
"""

from __future__ import annotations

import gc
import sys

from atalante_tools.console.stop_request import Stopped, interruptible

TYPE_CHECKING = False  # replaces `typing.TYPE_CHECKING`, because the import of `typing` is slow
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> NoReturn:
    """Run the command line and end the process with its exit code.

    Raises:
        SystemExit: Always. If a stop signal arrived, its exit code is used, otherwise the exit code of the command.
    """
    code: object = 0
    with interruptible() as stop:
        try:
            from atalante_tools.cli import cli
            from atalante_tools.console.terminal import CompilationNotice

            CompilationNotice.begin()
            cli(prog_name="atalante")
        except SystemExit as end:
            code = end.code
        except BaseException as error:
            if not stop.wanted:
                raise
            if not _made_from_stop(error):
                print(f"atalante: stopped by a signal, then {type(error).__name__}: {error}", file=sys.stderr)
    # At exit, the interpreter searches all objects for garbage cycles. Frozen objects are left out, which saves 0.1 to 0.3 s.
    gc.freeze()
    raise SystemExit(stop.exit_code or code)


def _made_from_stop(error: BaseException) -> bool:
    """Return whether `error` is `Stopped`, or was raised as a consequence of `Stopped`."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, Stopped):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
