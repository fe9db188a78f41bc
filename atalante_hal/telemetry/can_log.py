"""CAN log: every frame the HAL sent and received, in the formats of python-can's Logger.

The suffix chooses the format: `.log` (candump), `.asc`, `.blf`, also `.log.gz` and `.asc.gz`. Each network bus is a channel: by
name in `.log` (left_leg), by number from 1 in the order of the DBC in `.asc` and `.blf`. Byte for byte the same for the
same frames is `.log` alone (and `.blf`, which dates from the first frame); `.asc` and `.gz` carry the date of the writing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import can
import numpy as np
import numpy.typing as npt

from atalante_hal.closing import Closing
from atalante_hal.telemetry.sink import SinkError
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE, Frames

#: Formats of python-can that keep CAN FD frames whole.
FORMATS = (".log", ".asc", ".blf", ".log.gz", ".asc.gz")
#: Channel of a frame whose id is not in the DBC.
FOREIGN = "foreign"


def check_format(path: Path) -> str:
    """The suffix that decides about the format.

    Raises:
        SinkError: python-can has no writer for it, or one that loses CAN FD frames.
    """
    name = path.name.lower()
    for suffix in sorted(FORMATS, key=len, reverse=True):
        if name.endswith(suffix):
            return suffix
    raise SinkError(
        "RECORD_STOPPED",
        f"a CAN log {path.name} cannot keep every CAN FD frame; end its name in one of {', '.join(FORMATS)}",
    )


class CanLog(Closing):
    """Writes frames to a log file.

    Args:
        path: of the file; its folder is made.
        buses: network buses, in the order of the DBC.
        bus_of: frame id -> its network bus.

    Raises:
        SinkError: the format is not valid, or the file cannot be made.
    """

    def __init__(self, path: Path, buses: Sequence[str], bus_of: Mapping[int, str]) -> None:
        suffix = check_format(path)
        self.path = path
        self.frames = 0
        names = (*buses, FOREIGN)
        by_name = suffix.startswith(".log")
        self._channels: dict[str, str | int] = {name: name if by_name else number for number, name in enumerate(names)}
        self._channel_of = {frame_id: self._channels[bus] for frame_id, bus in bus_of.items()}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._logger = can.Logger(path)
            self._open = True
        except OSError as error:
            raise SinkError("RECORD_STOPPED", f"the CAN log {path} cannot be made: {error.strerror}") from error

    def write(self, frames: Frames, stamps: npt.NDArray[np.int64], sent: npt.NDArray[np.uint8]) -> None:
        """Add frames. Shapes (n,): `FRAME` records, times [ns], 1 where sent.

        Raises:
            SinkError: the disk is full or gone.
        """
        foreign = self._channels[FOREIGN]
        columns = (frames[name].tolist() for name in ("can_id", "len", "flags"))
        data = frames["data"].tobytes()
        try:
            for place, (can_id, length, flags, stamp, is_sent) in enumerate(
                zip(*columns, stamps.tolist(), sent.tolist(), strict=True)
            ):
                is_fd = bool(flags & FLAG_FDF)
                self._logger.on_message_received(
                    can.Message(
                        timestamp=stamp * 1e-9,
                        arbitration_id=can_id & 0x1FFFFFFF,
                        is_extended_id=bool(can_id & ID_EXTENDED),
                        is_remote_frame=bool(can_id & ID_REMOTE),
                        is_error_frame=bool(can_id & ID_ERROR),
                        channel=self._channel_of.get(can_id, foreign),
                        dlc=length,
                        data=None if can_id & ID_REMOTE else data[64 * place : 64 * place + length],
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
        """Finish the file; raises as `write`. A second call does nothing."""
        if self._open:
            self._open = False
            try:
                self._logger.stop()
            except OSError as error:
                raise self._failed(error) from error

    def _failed(self, error: OSError) -> SinkError:
        self._open = False
        with contextlib.suppress(OSError):  # what the buffer still holds does not fit either
            self._logger.stop()
        return SinkError("RECORD_STOPPED", f"the CAN log {self.path} stopped: {error.strerror}")
