"""Shared-memory ring: the loop's process writes fixed-size records, the telemetry process reads them.

One writer, one reader, no lock, no system call in `write`: one copy, then one integer store that says so. The slot after the
newest record counts as being written at any time. So a reader that copies a batch and then looks at the count again knows
which of its records were overwritten under its hands (a seqlock for the whole batch). This relies on stores being seen in
program order, as on x86-64; elsewhere a record could be read before its last bytes arrive.

When the ring is full the oldest record is overwritten and the reader counts the loss. A lossless ring waits for the reader
instead, in short sleeps, but never for a dead reader and never longer than its patience; then it overwrites like the other.

The memory is an anonymous file (memfd): it has no name, so nothing is left in /dev/shm whoever crashes. Its descriptor is
handed to the reader's process (`pass_fds`). Writer and reader hold one byte each of the file under a POSIX lock, which the
kernel drops with the process: that is how they notice each other's death, whatever the cause.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.closing import Closing
from atalante_hal.memory import anonymous_file

MAGIC = int.from_bytes(b"ATLRING\0", "little")
VERSION = 1

# The header as 64-bit words; writer and reader have a cache line of their own.
_MAGIC, _VERSION, _RECORD_SIZE, _STRIDE, _SLOTS, _META_LENGTH, _NOTES_SIZE, _DATA = range(8)
_WRITTEN, _CLOSED, _WRITER_PID, _NOTES_LENGTH, _LOSSLESS = range(8, 13)
_READ, _LOST, _READER_PID, _KEPT = range(16, 20)
_HEADER_BYTES = 256

_WRITER_BYTE, _READER_BYTE = 0, 1  # of the file, locked while the process lives
_LOCK_TRIES = 50  # a probe by the other side holds a lock for microseconds

_WAIT = 0.0002  # s, one sleep of a lossless writer
NOTES_BYTES = 1 << 16


class RingError(RuntimeError):
    """The ring cannot be made, opened or written as asked; the message says why."""


class _Ring:
    """The mapped memory and what both ends know of it."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, 0, flags=mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0))
        self._bytes = memoryview(self._map)
        self._header = self._bytes[:_HEADER_BYTES].cast("q")

    @property
    def record_size(self) -> int:
        """Bytes of a record."""
        return self._header[_RECORD_SIZE]

    @property
    def slots(self) -> int:
        """Places for records; one of them is always being written."""
        return self._header[_SLOTS]

    @property
    def written(self) -> int:
        """Records written so far."""
        return self._header[_WRITTEN]

    @property
    def lost(self) -> int:
        """Records the reader has missed so far."""
        return self._header[_LOST]

    @property
    def kept(self) -> int:
        """Records whose content the readers have saved so far: what a killed reader had not saved is not among them."""
        return self._header[_KEPT]

    @property
    def lossless(self) -> bool:
        """Whether the writer waits for the reader when the ring is full."""
        return bool(self._header[_LOSSLESS])

    @property
    def closed(self) -> bool:
        """Whether the writer has said that nothing more comes."""
        return bool(self._header[_CLOSED])

    @property
    def meta(self) -> dict[str, Any]:
        """What the writer says about the records, as JSON types."""
        length = self._header[_META_LENGTH]
        found: dict[str, Any] = json.loads(bytes(self._bytes[_HEADER_BYTES : _HEADER_BYTES + length]))
        return found

    @property
    def _notes_start(self) -> int:
        return _HEADER_BYTES + self._header[_META_LENGTH]

    def _lock(self, byte: int) -> bool:
        """Lock one byte of the file for this process; False when another process holds it."""
        for _ in range(_LOCK_TRIES):
            try:
                fcntl.lockf(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
            except (BlockingIOError, PermissionError):
                time.sleep(_WAIT)
            else:
                return True
        return False

    def _held(self, byte: int, pid: int) -> bool:
        """Whether the process that took `byte` is there. Its own locks never stand in a process's way, hence the pid."""
        if pid == os.getpid():
            return True
        try:
            fcntl.lockf(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
        except (BlockingIOError, PermissionError):
            return True
        fcntl.lockf(self.fd, fcntl.LOCK_UN, 1, byte)
        return False

    def _release(self) -> None:
        self._header.release()
        self._bytes.release()
        self._map.close()
        os.close(self.fd)


class RingWriter(_Ring, Closing):
    """The writing end; makes the memory and owns it.

    Args:
        record_size: bytes of a record.
        slots: places for records; one less can wait for the reader.
        lossless: wait for the reader when the ring is full.
        patience: longest such wait [s]; after it the ring overwrites for good.
        meta: what the reader needs to know, JSON types.

    Raises:
        RingError: a size is not positive.
    """

    def __init__(
        self,
        record_size: int,
        slots: int = 1024,
        *,
        lossless: bool = False,
        patience: float = 5.0,
        meta: Mapping[str, Any] | None = None,
    ) -> None:
        if record_size < 1 or slots < 2:
            raise RingError(f"a ring of {slots} records of {record_size} bytes cannot be; valid are 2 and 1 upwards")
        packed = json.dumps(dict(meta or {})).encode()
        stride = -(-record_size // 8) * 8
        data = -(-(_HEADER_BYTES + len(packed) + NOTES_BYTES) // mmap.PAGESIZE) * mmap.PAGESIZE
        super().__init__(anonymous_file("atalante-telemetry", data + stride * slots))
        header = self._header
        header[_MAGIC], header[_VERSION] = MAGIC, VERSION
        header[_RECORD_SIZE], header[_STRIDE], header[_SLOTS], header[_DATA] = record_size, stride, slots, data
        header[_META_LENGTH], header[_NOTES_SIZE] = len(packed), NOTES_BYTES
        header[_WRITER_PID], header[_LOSSLESS] = os.getpid(), lossless
        self._bytes[_HEADER_BYTES : _HEADER_BYTES + len(packed)] = packed
        self._lock(_WRITER_BYTE)
        self._patience = patience
        self._count = 0
        self._slots = slots
        self._size, self._stride = record_size, stride
        self._begin = self._place = data  # of the next record in the file [bytes]
        self._end = data + stride * slots
        self._limit = slots - 1 if lossless else sys.maxsize

    def write(self, record: memoryview | npt.NDArray[Any] | bytes) -> None:
        """Copy one record into the ring.

        Args:
            record: contiguous buffer of `record_size` bytes.

        Raises:
            IndexError: the buffer has another size.
        """
        count = self._count
        if count >= self._limit:
            self._wait_for_reader()
        place = self._place
        self._map[place : place + self._size] = record  # type: ignore[assignment]
        self._header[_WRITTEN] = self._count = count + 1
        place += self._stride
        self._place = place if place < self._end else self._begin

    def _wait_for_reader(self) -> None:
        """Lossless: come back with room for one record, or with the ring overwriting from here on."""
        header, oldest = self._header, self._count - self._slots + 1
        give_up = time.monotonic() + self._patience
        while header[_READ] <= oldest:
            if not self.reader_alive or time.monotonic() > give_up:
                header[_LOSSLESS] = 0
                self._limit = sys.maxsize
                return
            time.sleep(_WAIT)
        self._limit = header[_READ] + self._slots - 1

    def last(self) -> bytes:
        """Bytes of the record written last; empty when there is none."""
        if not self._count:
            return b""
        place = self._begin + (self._count - 1) % self._slots * self._stride
        return bytes(self._map[place : place + self._size])

    def note(self, note: Mapping[str, Any]) -> None:
        """Append a remark (JSON types) that the reader gets together with the next record; rare, not for every cycle.

        Raises:
            RingError: there is no room; all remarks together have 64 KiB.
        """
        packed = json.dumps({**note, "from": self._count}).encode() + b"\n"
        used = self._header[_NOTES_LENGTH]
        if used + len(packed) > NOTES_BYTES:
            raise RingError(f"the ring's {NOTES_BYTES} bytes for remarks are full")
        start = self._notes_start + used
        self._bytes[start : start + len(packed)] = packed
        self._header[_NOTES_LENGTH] = used + len(packed)

    @property
    def taken(self) -> int:
        """Records the reader has dealt with so far."""
        return self._header[_READ]

    @property
    def reader_alive(self) -> bool:
        """Whether a reader has attached and its process is there (a stopped process is)."""
        pid = self._header[_READER_PID]
        return pid != 0 and self._held(_READER_BYTE, pid)

    def finish(self) -> None:
        """Tell the reader that nothing more comes."""
        self._header[_CLOSED] = 1

    def close(self) -> None:
        """Finish and let go of the memory; it is gone when the reader has closed, too."""
        if not self._map.closed:
            self.finish()
            self._release()


class RingReader(_Ring, Closing):
    """The reading end, from a descriptor of the writer's (`RingWriter.fd`, inherited or duplicated); takes it over.

    Raises:
        RingError: the descriptor is no ring of this version, or another process reads it.
    """

    def __init__(self, fd: int) -> None:
        if os.fstat(fd).st_size < _HEADER_BYTES:
            raise RingError(f"file descriptor {fd} is no telemetry ring")
        super().__init__(fd)
        header = self._header
        if header[_MAGIC] != MAGIC or header[_VERSION] != VERSION:
            self._release()
            raise RingError(f"file descriptor {fd} is no telemetry ring of version {VERSION}")
        if not self._lock(_READER_BYTE):
            self._release()
            raise RingError("another process reads this telemetry ring; a ring has one reader")
        header[_READER_PID] = os.getpid()
        data, stride, slots = header[_DATA], header[_STRIDE], header[_SLOTS]
        self._records = np.frombuffer(self._map, np.uint8, stride * slots, data).reshape(slots, stride)
        self._batch = np.zeros_like(self._records)
        self._next = header[_READ]
        self._notes_read = 0

    def read(self) -> npt.NDArray[np.uint8]:
        """Everything written since the last call, oldest first; what was overwritten before or meanwhile is counted as lost.

        Returns:
            Shape (n, record_size) bytes, n may be 0; a view that the next call reuses.
        """
        header, slots = self._header, len(self._records)
        written = header[_WRITTEN]
        first = max(self._next, written - slots + 1)
        count, at = written - first, first % slots
        before_end = min(count, slots - at)
        self._batch[:before_end] = self._records[at : at + before_end]
        self._batch[before_end:count] = self._records[: count - before_end]
        intact = min(max(first, header[_WRITTEN] - slots + 1), written)
        header[_LOST] += intact - self._next
        header[_READ] = self._next = written
        return self._batch[intact - first : count, : self.record_size]

    def keep(self, records: int) -> None:
        """Add records to those whose content is saved.

        Args:
            records: number of records that `read` returned and that are on the disk since the last call.
        """
        self._header[_KEPT] += records

    @property
    def position(self) -> int:
        """Number of the record that the next `read` begins with, when none is lost."""
        return self._next

    def notes(self) -> list[dict[str, Any]]:
        """Remarks written since the last call; "from" is the number of the record that follows a remark.

        Called after `read`, it has every remark that belongs to what was read.
        """
        start, length = self._notes_start, self._header[_NOTES_LENGTH]
        packed = bytes(self._bytes[start + self._notes_read : start + length])
        self._notes_read = length
        return [json.loads(line) for line in packed.splitlines()]

    @property
    def writer_alive(self) -> bool:
        """Whether the writer's process is there (a stopped process is)."""
        return self._held(_WRITER_BYTE, self._header[_WRITER_PID])

    def close(self) -> None:
        """Let go of the memory."""
        if not self._map.closed:
            del self._records
            self._header[_READER_PID] = 0
            self._release()
