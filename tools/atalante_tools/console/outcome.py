"""Exit codes of the commands, and the conversion of known errors into one sentence for the user.

    library error -> failure_of -> Failed -> one line on stderr, exit code

0 ok, 1 failed, 2 usage error, 3 no device, 4 fault latched, 129 SIGHUP, 130 Ctrl-C, 143 SIGTERM.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any, Final

import click

FAILED: Final = 1
USAGE: Final = 2
NO_DEVICE: Final = 3
FAULT_LATCHED: Final = 4
INTERRUPTED: Final = 130


class Failed(click.ClickException):
    """Failure of a command, with exit code 1. The message is one sentence for the user."""

    exit_code = FAILED

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the message to `file`. The default is stderr."""
        click.echo(f"atalante: {self.format_message()}", file=file, err=file is None)


class InvalidUsage(Failed):
    """Invalid command line, with exit code 2."""

    exit_code = USAGE


class NoDevice(Failed):
    """Missing or failed CAN interface, with exit code 3."""

    exit_code = NO_DEVICE


class FaultLatched(Failed):
    """Latched fault, with exit code 4. The robot stays in FAULT until the operator acknowledges the fault."""

    exit_code = FAULT_LATCHED


#: Known library errors: module name, class name, and the subclass of `Failed` to which the error is converted.
#: If several rows match an error, the first one is used.
KNOWN: Final[tuple[tuple[str, str, type[Failed]], ...]] = (
    ("atalante_hal.bus", "BusAbsent", NoDevice),
    ("atalante_hal.bus", "BusDown", NoDevice),
    ("atalante_hal.bus", "BusError", Failed),
    ("atalante_hal.bus.channel_map", "ChannelMapError", InvalidUsage),
    ("atalante_dbc", "DbcError", Failed),
    ("atalante_hal.robot", "RobotError", Failed),
    ("atalante_hal.telemetry.access", "AccessError", Failed),
    ("atalante_hal.telemetry.process", "TelemetryError", Failed),
    ("atalante_hal.telemetry.ring", "RingError", Failed),
    ("atalante_hal.telemetry.sink", "SinkError", Failed),
    ("atalante_emulator.bodies", "DivergedError", Failed),
    ("atalante_control.gait_optimization.parallel", "FanOutError", Failed),
    ("atalante_control.gait.gait", "GaitError", Failed),
    ("atalante_control.guide.shape_file", "ShapeError", Failed),
    ("atalante_control.dynamics.gait_network", "NetworkError", Failed),
    ("atalante_control.gait_optimization.library", "LibraryError", Failed),
    ("atalante_tools.canlog.reader.log_file", "LogError", Failed),
    ("atalante_tools.canlog.validate.project", "ProjectError", InvalidUsage),
)

#: Largest number of lines after the first line of a message. If a message has more lines, only its first line is shown,
#: followed by the number of the other lines, such as ", and 5 more".
MOST: Final = 2
#: Error numbers of a failed write: disk full, over quota, read-only, I/O error.
DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})


def failure_of(error: BaseException) -> Failed | None:
    """Convert a known library error to a failure with one sentence for the user. Return None for any other error.

    An error with a diagnostic code (CONFIG_INVALID, DBC_INVALID, ...) gets a message that starts with the code. The message of
    an operating-system error contains the file name and the reason.

    Args:
        error: Exception that ended the command.
    """
    for module, name, failure in KNOWN:
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            first, *others = str(error).splitlines() or [""]
            text = f"{first}, and {len(others)} more" if len(others) > MOST else str(error)
            sentence = " ".join(text.split())
            code = getattr(error, "code", "")
            return failure(f"{code}: {sentence}" if code else sentence)
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK):
        return Failed(f"{error.filename or 'the output file'} cannot be read or written: {error.strerror}")
    return None


@contextmanager
def one_sentence() -> Iterator[None]:
    """Print a known error of the `with` block as one sentence on stderr, and end the program with the exit code of the error.

    The command line `atalante` does this for its commands. This function is for other programs, such as those in `examples/`.

    Raises:
        SystemExit: If the block raised a known error.
    """
    try:
        yield
    except Exception as error:
        failure = error if isinstance(error, Failed) else failure_of(error)
        if failure is None:
            raise
        failure.show()
        raise SystemExit(failure.exit_code) from error
