"""A recorded log as a bus: the HAL, the validator or the viewer reads it as if the robot spoke.

Frames come in the order and with the time stamps of the log. `receive()` fills what it is given; with `cycle_id`, the
identifier that begins a cycle (a SYNC), it also stops before each such frame, so that one call returns one cycle.
"""

from __future__ import annotations

import errno
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
from can.io.blf import BLFParseError

from atalante_hal.bus import BusDown, BusError, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.bus.python_can import pack
from atalante_hal.wire.frame import FRAME_BYTES, Frames

#: python-can's writers for these do not keep the FD flag, and its .db loses frames.
WITHOUT_FD = (".csv", ".db")
#: One frame a line: the last line of a whole log is a whole line.
LINE_LOGS = (".log", ".asc", ".trc")
BLF_HEADER_BYTES = 144
#: What python-can's readers raise on a file they do not understand.
UNREADABLE = (
    ValueError,
    IndexError,
    KeyError,
    EOFError,
    OSError,
    NotImplementedError,  # a reader whose package is not installed
    struct.error,
    zlib.error,
    sqlite3.Error,
    BLFParseError,
    can.CanError,
)


class LogUnreadable(BusError):  # noqa: N818
    """The log is missing, empty, broken off or in no format that keeps CAN FD frames."""


class ReplayBus:
    """A log that python-can's LogReader opens: .log (candump -L), .asc, .blf, .mf4, .trc, also with .gz behind.

    `cycle_id`: `receive()` stops before a frame with this identifier, unless it comes first. `ended` is True when all
    frames were returned; `dropped` counts records that are no legal CAN frame. Raises `LogUnreadable`.
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
            raise LogUnreadable(f"{path} holds no CAN frame: it is empty, or it is no {Path(path).suffix} log")

    @property
    def ended(self) -> bool:
        """Whether every frame of the log was returned."""
        return self._next is None

    def send(self, frames: Frames) -> None:
        """Refuse: raises `BusError`."""
        raise BusError(
            f"{self.name} is a recording: nothing can be sent to it; open a real or an emulated bus to command"
        )

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]` with the next frames of the log, 0 at its end; never waits. Shape (m,), n <= m.

        Raises `LogUnreadable` where the log breaks off.
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


def _open(path: Path) -> can.io.generic.MessageReader:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    kind = suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else path.suffix.lower()
    if kind in WITHOUT_FD:
        raise LogUnreadable(f"{path}: python-can's {kind} logs do not keep CAN FD frames; record .log, .asc or .blf")
    if kind not in can.io.player.MESSAGE_READERS:
        raise LogUnreadable(
            f"{path}: unknown log format {kind or 'without suffix'!r}; use .log (candump -L), .asc or .blf"
        )
    try:
        size = path.stat().st_size
        plain = kind == path.suffix.lower()
        if plain and kind in LINE_LOGS and size and _bytes(path, -1, os.SEEK_END) != b"\n":
            raise LogUnreadable(f"{path} breaks off within its last line: remove that line, or copy the log again")
        if plain and kind == ".blf" and (size < BLF_HEADER_BYTES or _bytes(path, 4, os.SEEK_SET) != b"LOGG"):
            raise LogUnreadable(f"{path} is empty or no .blf log: it has no BLF header")
        reader = can.LogReader(path)
    except UNREADABLE as error:
        reason = os.strerror(errno.ENOENT) if isinstance(error, FileNotFoundError) else error
        raise LogUnreadable(f"{path} cannot be opened as a CAN log: {reason}") from error
    if isinstance(reader, can.BLFReader) and reader.file_size > size:
        reader.stop()
        raise LogUnreadable(
            f"{path} breaks off: its header says {reader.file_size} bytes and it has {size}; copy it again"
        )
    return reader


def _bytes(path: Path, count: int, whence: int) -> bytes:
    """The first `count` bytes of a file, or the last `-count`."""
    with path.open("rb") as file:
        file.seek(min(count, 0), whence)
        return file.read(abs(count))
