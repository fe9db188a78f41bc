"""How a command ends: exit codes, and the one sentence for each error a user can meet.

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
    """The command could not do what was asked; the message is one sentence that says what would be right."""

    exit_code = FAILED

    def show(self, file: IO[Any] | None = None) -> None:
        """Print the sentence on stderr."""
        click.echo(f"atalante: {self.format_message()}", file=file, err=file is None)


class InvalidUsage(Failed):
    """The command line does not make sense."""

    exit_code = USAGE


class NoDevice(Failed):
    """The bus is not there."""

    exit_code = NO_DEVICE


class FaultLatched(Failed):
    """The robot is in FAULT and stays there until the operator acknowledges."""

    exit_code = FAULT_LATCHED


#: Errors of the libraries that have a message for the user: module, class, and how the command ends; first match wins. By
#: name, so that asking costs no import: an error that was raised comes from a module that is loaded.
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
    ("atalante_tools.canlog.validate.log", "LogError", Failed),
    ("atalante_tools.canlog.validate.project", "ProjectError", InvalidUsage),
)

#: Lines of a message, one a problem, that still make a sentence with the first.
MOST: Final = 2
#: What a disk says that takes no more: full, over quota, read-only, broken. Such an error may name no file.
DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})


def failure_of(error: BaseException) -> Failed | None:
    """What a library's error means for the command; None: it is a defect and deserves its traceback.

    A file or folder that the system refuses is named with its reason, without the error's number.
    An error with a diagnostic code (FAULTS.md: CONFIG_INVALID, DBC_INVALID, GAIT_INVALID, ...) is told with it.
    """
    for module, name, failure in KNOWN:
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            first, *others = str(error).splitlines() or [""]
            said = f"{first}, and {len(others)} more" if len(others) > MOST else str(error)
            sentence = " ".join(said.split())
            code = getattr(error, "code", "")
            return failure(f"{code}: {sentence}" if code else sentence)
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK):
        return Failed(f"{error.filename or 'what was to be written'} cannot be used: {error.strerror}")
    return None
