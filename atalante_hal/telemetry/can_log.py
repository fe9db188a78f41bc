"""CAN log with every frame that the HAL sent or received, in a file format of python-can.

The suffix determines the format: `.log` (candump), `.asc`, `.blf`, `.log.gz` or `.asc.gz`. Each bus of the network is a channel.
In `.log` and `.log.gz` the channel is the name of the bus (left_leg). In the other formats the channel is the number of the
bus in the order of the DBC, starting at 1. In `.log` and `.blf`, two logs of the same frames are identical. In `.asc`
and `.gz`, they differ, because such files contain the date of writing. An `.asc` file contains times relative to its first
frame. A frame that is older than the first frame gets the time of the first frame.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Mapping, Sequence
from pathlib import Path

import can
import numpy as np
import numpy.typing as npt

from atalante_hal.closing import Closing
from atalante_hal.telemetry.sink import SinkError
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_MASK, ID_REMOTE, Frames

#: File formats of python-can that store CAN FD frames completely.
FORMATS = (".log", ".asc", ".blf", ".log.gz", ".asc.gz")
#: Channel name in the log for a frame whose identifier is not in the DBC.
FOREIGN = "foreign"


def check_format(path: Path) -> str:
    """Check the format of a CAN log.

    Args:
        path: Path of the log.

    Returns:
        Suffix that determines the format.

    Raises:
        SinkError: If python-can cannot write all CAN FD frames in this format.
    """
    name = path.name.lower()
    for suffix in sorted(FORMATS, key=len, reverse=True):
        if name.endswith(suffix):
            return suffix
    raise SinkError(
        f"the format of the CAN log {path.name} cannot store CAN FD frames; end its name in one of {', '.join(FORMATS)}",
        "RECORD_STOPPED",
    )


class CanLog(Closing):
    """Writer of a CAN log file. The file is locked until it is closed, so that a second run cannot write to it.

    Args:
        path: Path of the file; missing folders are created.
        buses: Buses of the network, in the order of the DBC.
        bus_of: Bus of each frame identifier.

    Raises:
        SinkError: If the format is not valid, the file cannot be created, or another run writes it.
    """

    def __init__(self, path: Path, buses: Sequence[str], bus_of: Mapping[int, str]) -> None:
        suffix = check_format(path)
        self.path = path
        self.frames = 0
        self.finished = False  # True if the file was closed and contains every frame passed to `write`
        names = (*buses, FOREIGN)
        by_name = suffix.startswith(".log")
        self._relative = suffix.startswith(".asc")
        self._first_ns: int | None = None  # time of the first frame [ns]; None before the first frame
        self._channels: dict[str, str | int] = {name: name if by_name else number for number, name in enumerate(names)}
        self._channel_of = {frame_id: self._channels[bus] for frame_id, bus in bus_of.items()}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.ExitStack() as stack:
                # Do not truncate the file yet, because another run may be writing it.
                lock = stack.enter_context(path.open("ab"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._logger = can.Logger(path)
                self._lock = stack.pop_all()  # `close` releases the lock
            self._open = True
        except BlockingIOError as error:
            raise SinkError(
                f"another run writes {path}: give another file for the CAN log", "RECORD_STOPPED"
            ) from error
        except OSError as error:
            raise SinkError(f"the CAN log {path} cannot be created: {error.strerror}", "RECORD_STOPPED") from error

    def write(self, frames: Frames, stamps: npt.NDArray[np.int64], sent: npt.NDArray[np.uint8]) -> None:
        """Append frames to the log.

        Args:
            frames: `FRAME` records, shape (n,).
            stamps: Time of each frame, shape (n,) [ns].
            sent: 1 for a sent frame, 0 for a received one, shape (n,).

        Raises:
            SinkError: If the file cannot be written.
        """
        foreign = self._channels[FOREIGN]
        if self._relative and len(stamps):
            # For a frame older than the first frame, python-can would write the absolute Unix time instead of a relative time.
            self._first_ns = int(stamps[0]) if self._first_ns is None else self._first_ns
            stamps = np.maximum(stamps, self._first_ns)
        columns = (frames[name].tolist() for name in ("can_id", "len", "flags"))
        data = frames["data"].tobytes()
        try:
            for index, (can_id, length, flags, stamp, is_sent) in enumerate(
                zip(*columns, stamps.tolist(), sent.tolist(), strict=True)
            ):
                is_fd = bool(flags & FLAG_FDF)
                self._logger.on_message_received(
                    can.Message(
                        timestamp=stamp * 1e-9,
                        arbitration_id=can_id & ID_MASK,
                        is_extended_id=bool(can_id & ID_EXTENDED),
                        is_remote_frame=bool(can_id & ID_REMOTE),
                        is_error_frame=bool(can_id & ID_ERROR),
                        channel=self._channel_of.get(can_id, foreign),
                        dlc=length,
                        data=None if can_id & ID_REMOTE else data[64 * index : 64 * index + length],
                        is_fd=is_fd,
                        is_rx=not is_sent,
                        bitrate_switch=is_fd and bool(flags & FLAG_BRS),
                        error_state_indicator=is_fd and bool(flags & FLAG_ESI),
                    )
                )
        except OSError as error:
            raise self._failed(error) from error
        self.frames += len(frames)

    def close(self) -> None:
        """Close the file; a second call has no effect.

        Raises:
            SinkError: If the rest of the log cannot be written.
        """
        if self._open:
            self._open = False
            try:
                self._logger.stop()
            except OSError as error:
                raise self._failed(error) from error
            self._lock.close()
            self.finished = True

    def _failed(self, error: OSError) -> SinkError:
        self._open = False
        with contextlib.suppress(OSError):  # `stop` writes the buffered frames, which can fail again
            self._logger.stop()
        self._lock.close()
        return SinkError(f"the CAN log {self.path} stopped: {error.strerror}", "RECORD_STOPPED")
