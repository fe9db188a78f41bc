"""Bus that replays a recorded log, for programs that only receive.

A HAL cannot repeat its decisions on this bus: nothing can be sent, and the answers in the log have the cycle numbers of the
recorded SYNCs. A HAL on this bus reports `BUS_DOWN` and stays OFF.

The frames are returned in the order and with the time stamps of the log. If `cycle_id` is given, each call of
`receive()` returns the frames of one cycle. `cycle_id` is the identifier of the first frame of a cycle (SYNC).
"""

from __future__ import annotations

import errno
import gzip
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.io.blf import BLFParseError

from atalante_hal.bus import BusDown, BusError, Stamps
from atalante_hal.bus.asc import asc_lines
from atalante_hal.bus.batch import Batches
from atalante_hal.bus.python_can import pack
from atalante_hal.wire.frame import FRAME_BYTES, Frames

#: Log formats that python-can writes incompletely: .csv loses the CAN FD flag, .db loses frames.
WITHOUT_FD = (".csv", ".db")
#: Text log formats with one frame per line. A complete log ends with a newline.
LINE_LOGS = (".log", ".asc", ".trc")
BLF_HEADER_BYTES = 144
#: Error text of a log with relative time stamps, see `has_relative_times`.
RELATIVE_TIMES = 'the time stamps must be absolute, got "timestamps relative"'
#: Exceptions that python-can raises when it reads an invalid log.
UNREADABLE = (
    ValueError,
    IndexError,
    KeyError,
    EOFError,
    OSError,
    NotImplementedError,  # raised if the package for the log format is missing
    struct.error,
    zlib.error,
    sqlite3.Error,
    BLFParseError,
    can.CanError,
)


class LogUnreadable(BusError):  # noqa: N818
    """Error of a log that cannot be read.

    The log is missing, empty, truncated, damaged or not closed, or its format is unknown or cannot store CAN FD frames.
    """


class ReplayBus:
    """Bus that replays a log file: .log (candump -L), .asc, .blf, .mf4 or .trc, also compressed as .gz.

    Args:
        path: Log file.
        cycle_id: Identifier of the first frame of a cycle. Each call of `receive()` stops before the next frame with this
            identifier. With None, the frames are not divided into cycles.
        capacity: Largest number of frames that one `receive()` returns.

    Attributes:
        dropped: Number of records of the log that are not valid CAN frames.

    Raises:
        LogUnreadable: If the log is missing, empty, truncated, not closed by its recorder or in an unknown format.
    """

    def __init__(self, path: str | Path, cycle_id: int | None = None, capacity: int = 1024) -> None:
        self.name = str(path)
        self.dropped = 0
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        self._capacity = capacity
        self._cycle_id = cycle_id
        self._batches = Batches()
        self._closed = False
        self._count = 0
        self._reader = _open(Path(path))
        self._messages: Iterator[can.Message] = iter(self._reader)
        self._next = self._read()
        if self._next is None:
            self.close()
            raise LogUnreadable(f"{path} contains no CAN frame: it is empty, or it is not a {Path(path).suffix} log")
        if has_relative_times(self._reader):
            self.close()
            raise LogUnreadable(f"{path}: {RELATIVE_TIMES}")

    @property
    def ended(self) -> bool:
        """Return whether `receive` has returned every frame of the log."""
        return self._next is None

    def send(self, frames: Frames) -> None:
        """Raise `BusError`, because a log is read-only.

        Args:
            frames: Ignored.

        Raises:
            BusError: Always.
        """
        raise BusError(f"{self.name} is a recording: nothing can be sent to it; use a real or an emulated bus to send")

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Write the next frames of the log to `frames[:n]` and return n, without waiting.

        Args:
            frames: Buffer for the frames, shape (m,) with m >= n.
            timeout: Ignored.

        Returns:
            Number of frames n; 0 at the end of the log.

        Raises:
            BusDown: If the log was closed.
            LogUnreadable: If the rest of the log cannot be read.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        memory = self._batches.to_fill(frames)
        room = min(len(frames), self._capacity)
        count = 0
        while count < room and self._next is not None:
            message = self._next
            if count and message.arbitration_id == self._cycle_id:
                break
            if pack(message, memory, count * FRAME_BYTES):
                self.stamps[count] = round(message.timestamp * 1e9)
                count += 1
            else:
                self.dropped += 1
            self._next = self._read()
        return count

    def close(self) -> None:
        """Close the file."""
        if not self._closed:
            self._closed = True
            self._reader.stop()

    def _read(self) -> can.Message | None:
        try:
            message = next(self._messages, None)
        except UNREADABLE as error:
            self.close()
            raise LogUnreadable(f"{self.name} cannot be read beyond frame {self._count}: {error}") from error
        self._count += 1
        return message


def has_relative_times(reader: Any) -> bool:
    """Return whether an .asc log has relative time stamps. Call this after the first message was read.

    A relative time stamp counts from the previous line of the log. python-can does not add up relative time stamps, and it
    skips the lines without a CAN frame. Therefore the times of such a log cannot be computed from the messages. python-can reads
    the header of the log together with the first message.

    Args:
        reader: Reader of python-can. Readers of other formats have no relative time stamps.
    """
    return (getattr(reader, "timestamps_format", "") or "").lower() == "relative"


def _open(path: Path) -> can.io.generic.MessageReader:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    kind = suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else path.suffix.lower()
    if kind in WITHOUT_FD:
        raise LogUnreadable(
            f"{path}: python-can's {kind} logs cannot store CAN FD frames completely; record the log as .log, .asc or .blf"
        )
    if kind not in can.io.player.MESSAGE_READERS:
        raise LogUnreadable(
            f"{path}: the log format must be one that python-can can read, such as .log (candump -L), .asc or .blf, "
            f"got {kind or 'no suffix'!r}"
        )
    try:
        size = path.stat().st_size
        plain = kind == path.suffix.lower()
        if plain and kind in LINE_LOGS and size and _bytes(path, -1, os.SEEK_END) != b"\n":
            raise LogUnreadable(f"{path} is truncated within its last line: remove that line, or copy the log again")
        if plain and kind == ".blf" and (size < BLF_HEADER_BYTES or _bytes(path, 4, os.SEEK_SET) != b"LOGG"):
            raise LogUnreadable(f"{path} is empty or not a .blf log: it has no BLF header")
        reader = can.ASCReader(_asc_text(path)) if kind == ".asc" else can.LogReader(path)
    except UNREADABLE as error:
        reason = os.strerror(errno.ENOENT) if isinstance(error, FileNotFoundError) else error
        raise LogUnreadable(f"{path} cannot be opened as a CAN log: {reason}") from error
    if isinstance(reader, can.BLFReader) and (defect := _size_defect(path, reader.file_size, size if plain else None)):
        reader.stop()
        raise LogUnreadable(f"{path} {defect}")
    return reader


def _asc_text(path: Path) -> Any:
    """Yield the lines of an .asc log, see `asc_lines`. The file is closed after the last line, or by `close` of the generator.

    Args:
        path: Log file, also compressed as .gz.
    """
    with (gzip.open if path.suffix.lower() == ".gz" else open)(path, "rt", encoding="utf-8") as file:
        yield from asc_lines(file)


def _size_defect(path: Path, stated: int, size: int | None) -> str:
    """Return the defect of a .blf log, found from its size, as text; empty if the log is complete.

    The recorder writes the final size into the header when it closes the log. Until then, the header states a smaller size.

    Args:
        path: Log file.
        stated: Size in the header [bytes].
        size: Size of the file [bytes]. With None, the log is compressed, and only a header that states no data is detected.
    """
    if size is not None and stated > size:
        return f"is truncated: its header states {stated} bytes, but the file has {size} bytes; copy the file again"
    if stated <= BLF_HEADER_BYTES if size is None else stated < size:
        return (
            "was not closed by its recorder, so its last frames are missing; `can_logconvert "
            f"{path} complete.blf` copies the other frames to a complete log"
        )
    return ""


def _bytes(path: Path, count: int, whence: int) -> bytes:
    """Return the first `count` bytes of a file; for a negative `count`, return the last `-count` bytes.

    Args:
        path: File to read.
        count: Number of bytes: 4 returns the first 4 bytes, and -4 returns the last 4 bytes.
        whence: `os.SEEK_SET` for a positive count, `os.SEEK_END` for a negative count.
    """
    with path.open("rb") as file:
        file.seek(min(count, 0), whence)
        return file.read(abs(count))
