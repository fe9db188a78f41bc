"""Exit codes of the commands, and the conversion of known errors into one sentence for the user.

    library error -> failure_of -> Failed -> one line on stderr, exit code

0 ok, 1 failed, 2 usage, 3 no device, 4 fault latched, 130 Ctrl-C, 143 SIGTERM.
"""

from __future__ import annotations

import errno
import sys
from typing import IO, Any, Final

import click

FAILED: Final = 1
USAGE: Final = 2
NO_DEVICE: Final = 3
FAULT_LATCHED: Final = 4
INTERRUPTED: Final = 130


class Failed(click.ClickException):
    """Failure of a command, with exit code 1. The message is one sentence: what was expected, received, and what to do."""

    exit_code = FAILED

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the message on stderr, or to `file`."""
        click.echo(f"atalante: {self.format_message()}", file=file, err=file is None)


class InvalidUsage(Failed):
    """Invalid command line, with exit code 2."""

    exit_code = USAGE


class NoDevice(Failed):
    """Missing or failed CAN interface, with exit code 3."""

    exit_code = NO_DEVICE


class FaultLatched(Failed):
    """Latched fault, with exit code 4: the robot stays in FAULT until the operator acknowledges it."""

    exit_code = FAULT_LATCHED


#: Library errors whose message is shown to the user: module and class of the error, and the `Failed` class that replaces it.
#: The first match counts. They are given by name, so that nothing is imported: the module of a raised error is already loaded.
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
    ("atalante_control.gait_optimization.parallel", "FanOutError", Failed),
    ("atalante_control.gait.gait", "GaitError", Failed),
    ("atalante_control.dynamics.gait_network", "NetworkError", Failed),
    ("atalante_control.gait_optimization.library", "LibraryError", Failed),
    ("atalante_tools.canlog.reader.log_file", "LogError", Failed),
    ("atalante_tools.canlog.validate.project", "ProjectError", InvalidUsage),
)

#: Largest number of lines after the first. A longer message is shortened to its first line and the number of the others.
MOST: Final = 2
#: Error numbers of a disk that cannot be written: full, over quota, read-only, I/O error. They may come without a file name.
DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})


def failure_of(error: BaseException) -> Failed | None:
    """Return the failure that a library error becomes, or None for a defect, which keeps its traceback.

    The message of an operating-system error contains the file and the reason, without the error number.
    The message of an error with a diagnostic code (FAULTS.md: CONFIG_INVALID, DBC_INVALID, ...) starts with that code.

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
        return Failed(f"{error.filename or 'the output file'} cannot be used: {error.strerror}")
    return None
