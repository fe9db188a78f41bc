"""Ring buffer in shared memory. The control loop writes records of fixed size, and the telemetry process reads them.

A slot contains a record, padding to 8 bytes, and the time of the record.

A ring has one writer and one reader. `write` needs no lock and no system call: it copies the record and then stores the counter
of written records. The writer may overwrite the oldest records while the reader copies them. So the reader copies a batch, reads
the counter again and discards the records that may have been overwritten meanwhile (a seqlock for the whole batch). This requires
that stores become visible in program order, as on x86-64. Otherwise a record could be read before its last bytes are visible.

When the ring is full, the oldest record is overwritten and the reader counts the loss. The writer of a lossless ring
waits for the reader instead, in short sleeps. A lossless writer overwrites the oldest record only after the reader's
process has ended, or after the longest wait (`patience`).

The memory is an anonymous file (memfd). It has no name, so nothing is left in /dev/shm after a crash. Its descriptor is passed
to the reader's process (`pass_fds`). Writer and reader each hold a POSIX lock on one byte of the file. When a process ends for
any reason, the kernel releases its lock. So the writer detects that the reader's process has ended, and the reader detects that
the writer's process has ended.
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
VERSION = 2

# Each name is the index of a 64-bit word in the header of a ring. The words form three groups: constants, words that only the
# writer changes, and words that only the reader changes. Each group has its own cache line of the processor.
_MAGIC, _VERSION, _RECORD_SIZE, _STRIDE, _SLOTS, _META_LENGTH, _NOTES_SIZE, _DATA = range(8)
_WRITTEN, _CLOSED, _WRITER_PID, _NOTES_LENGTH, _LOSSLESS = range(8, 13)
_READ, _LOST, _READER_PID, _KEPT = range(16, 20)
_HEADER_BYTES = 256

_WRITER_BYTE, _READER_BYTE = 0, 1  # offsets of the bytes that writer and reader lock
#: Number of attempts to lock a byte. An attempt may fail, because `_held` in the other process locks the byte for microseconds.
_LOCK_TRIES = 50

_WAIT = 0.0002  # polling period [s]
NOTES_BYTES = 1 << 16


class RingError(RuntimeError):
    """Error of a ring that cannot be created, opened or written; the message names the cause."""


class _Ring:
    """Memory of a ring, and the header fields that both ends read."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, 0, flags=mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0))
        self._bytes = memoryview(self._map)
        self._header = self._bytes[:_HEADER_BYTES].cast("q")

    @property
    def record_size(self) -> int:
        """Return the size of a record [bytes]."""
        return self._header[_RECORD_SIZE]

    @property
    def slots(self) -> int:
        """Return the number of slots: one more than the number of records that can wait for the reader."""
        return self._header[_SLOTS]

    @property
    def written(self) -> int:
        """Return the number of records written so far."""
        return self._header[_WRITTEN]

    @property
    def lost(self) -> int:
        """Return the number of records that were overwritten before they were read."""
        return self._header[_LOST]

    @property
    def kept(self) -> int:
        """Return the number of records saved to disk by this reader and all earlier readers, see `RingReader.keep`."""
        return self._header[_KEPT]

    @property
    def lossless(self) -> bool:
        """Return whether the writer waits for the reader when the ring is full."""
        return bool(self._header[_LOSSLESS])

    @property
    def closed(self) -> bool:
        """Return whether the writer has finished, so that no more records follow."""
        return bool(self._header[_CLOSED])

    @property
    def meta(self) -> dict[str, Any]:
        """Return the metadata that the writer stored for the reader, such as the layout of the records, as JSON types."""
        length = self._header[_META_LENGTH]
        found: dict[str, Any] = json.loads(bytes(self._bytes[_HEADER_BYTES : _HEADER_BYTES + length]))
        return found

    @property
    def _notes_start(self) -> int:
        return _HEADER_BYTES + self._header[_META_LENGTH]

    def _lock(self, byte: int) -> bool:
        """Lock one byte of the ring's memory file. Return False if another process keeps this byte locked.

        The lock shows the other process that this process exists, see `_held`.
        """
        for _ in range(_LOCK_TRIES):
            try:
                fcntl.lockf(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
            except (BlockingIOError, PermissionError):
                time.sleep(_WAIT)
            else:
                return True
        return False

    def _held(self, byte: int, pid: int) -> bool:
        """Return whether the process that locked a byte still exists.

        POSIX locks never conflict with locks of the same process, so the process number is compared first.

        Args:
            byte: Offset of the locked byte.
            pid: Number of the process that locked it.

        Returns:
            True if that process exists, even if it is suspended (SIGSTOP).
        """
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
    """Writing end of a ring buffer.

    Args:
        record_size: Size of a record [bytes].
        slots: Number of slots, at least 2. `slots` - 1 records can wait for the reader.
        lossless: Whether `write` waits for the reader when the ring is full.
        patience: Longest wait for the reader [s]. After this time the ring is no longer lossless.
        meta: Metadata for the reader, such as the layout of the records, as JSON types.
        fd: Descriptor of an empty file for the memory, which the writer owns from now on. None: the writer creates the file.

    Raises:
        RingError: If a size is too small.
    """

    def __init__(
        self,
        record_size: int,
        slots: int = 1024,
        *,
        lossless: bool = False,
        patience: float = 5.0,
        meta: Mapping[str, Any] | None = None,
        fd: int | None = None,
    ) -> None:
        if record_size < 1 or slots < 2:
            raise RingError(
                f"a ring must have at least 2 slots of at least 1 byte, got {slots} slots of {record_size} bytes"
            )
        packed = json.dumps(dict(meta or {})).encode()
        stride = (-(-record_size // 8) + 1) * 8
        data = -(-(_HEADER_BYTES + len(packed) + NOTES_BYTES) // mmap.PAGESIZE) * mmap.PAGESIZE
        fd = anonymous_file("atalante-telemetry", 0) if fd is None else fd
        os.ftruncate(fd, data + stride * slots)
        super().__init__(fd)
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
        self._begin = self._offset = data  # offsets [bytes] in the file: first slot, next record
        self._end = data + stride * slots
        self._limit = slots - 1 if lossless else sys.maxsize
        self._times = self._bytes[data:].cast("q")[stride // 8 - 1 :: stride // 8]  # last word of each slot

    def write(self, record: memoryview | npt.NDArray[Any] | bytes, time_ns: int = 0) -> None:
        """Copy one record into the ring buffer.

        Args:
            record: Contiguous buffer of `record_size` bytes.
            time_ns: Time of the record [ns]; 0 if the record has no time of its own.

        Raises:
            IndexError: If the buffer has another size.
        """
        count = self._count
        if count >= self._limit:
            self._wait_for_reader()
        offset = self._offset
        self._map[offset : offset + self._size] = record  # type: ignore[assignment]
        self._times[count % self._slots] = time_ns
        self._header[_WRITTEN] = self._count = count + 1
        offset += self._stride
        self._offset = offset if offset < self._end else self._begin

    def _wait_for_reader(self) -> None:
        """Wait until there is room for one record. If the wait is too long, make the ring overwrite its oldest records."""
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
        """Return the bytes of the newest record; empty before the first record."""
        if not self._count:
            return b""
        offset = self._begin + (self._count - 1) % self._slots * self._stride
        return bytes(self._map[offset : offset + self._size])

    def add_note(self, note: Mapping[str, Any]) -> None:
        """Append a note, which the reader receives with the next record. Use notes only for rare data.

        Args:
            note: JSON types.

        Raises:
            RingError: If all notes of the ring would need more than `NOTES_BYTES` in total.
        """
        packed = json.dumps({**note, "from": self._count}).encode() + b"\n"
        used = self._header[_NOTES_LENGTH]
        if used + len(packed) > NOTES_BYTES:
            raise RingError(f"all notes of a ring must fit into {NOTES_BYTES} bytes, got {used + len(packed)}")
        start = self._notes_start + used
        self._bytes[start : start + len(packed)] = packed
        self._header[_NOTES_LENGTH] = used + len(packed)

    @property
    def taken(self) -> int:
        """Return the number of records that the reader has read or lost so far."""
        return self._header[_READ]

    @property
    def reader_alive(self) -> bool:
        """Return whether a reader has attached and its process exists, even if it is suspended (SIGSTOP)."""
        pid = self._header[_READER_PID]
        return pid != 0 and self._held(_READER_BYTE, pid)

    def finish(self) -> None:
        """Mark the ring as closed, so that the reader expects no more records."""
        self._header[_CLOSED] = 1

    def close(self) -> None:
        """Mark the ring as closed and release the memory. The kernel frees the memory when the reader has also released it."""
        if not self._map.closed:
            self.finish()
            self._times.release()
            self._release()


class RingReader(_Ring, Closing):
    """Reading end of a ring buffer.

    Args:
        fd: Descriptor of the writer (`RingWriter.fd`, inherited or duplicated). The reader owns and closes it.

    Raises:
        RingError: If the descriptor is not a ring of this version, or another process reads the ring.
    """

    def __init__(self, fd: int) -> None:
        if os.fstat(fd).st_size < _HEADER_BYTES:
            raise RingError(f"file descriptor {fd} is not a telemetry ring")
        super().__init__(fd)
        header = self._header
        if header[_MAGIC] != MAGIC or header[_VERSION] != VERSION:
            self._release()
            raise RingError(f"file descriptor {fd} is not a telemetry ring of version {VERSION}")
        if not self._lock(_READER_BYTE):
            self._release()
            raise RingError("a telemetry ring must have only one reader, but another process reads this ring")
        header[_READER_PID] = os.getpid()
        data, stride, slots = header[_DATA], header[_STRIDE], header[_SLOTS]
        self._records = np.frombuffer(self._map, np.uint8, stride * slots, data).reshape(slots, stride)
        self._batch = np.zeros_like(self._records)
        #: Time of each record that the last `read` returned, shape (n,) [ns]; 0 for a record without a time of its own.
        self.times: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._next = header[_READ]
        self._notes_read = 0

    def read(self, limit: int = sys.maxsize) -> npt.NDArray[np.uint8]:
        """Read the records written since the last call; records that were overwritten are counted as lost.

        Args:
            limit: Largest number of records to read, at least 1. The next call continues after the last record of this call.

        Returns:
            Records, oldest first, shape (n, record_size) bytes; n may be 0. Their times are in `times`. The next call reuses both
            arrays.
        """
        header, slots = self._header, len(self._records)
        written = header[_WRITTEN]
        first = max(self._next, written - slots + 1)
        end = min(written, first + limit)
        count, at = end - first, first % slots
        before_end = min(count, slots - at)
        self._batch[:before_end] = self._records[at : at + before_end]
        self._batch[before_end:count] = self._records[: count - before_end]
        intact = min(max(first, header[_WRITTEN] - slots + 1), end)
        header[_LOST] += intact - self._next
        header[_READ] = self._next = end
        found = self._batch[intact - first : count]
        self.times = found[:, -8:].view(np.int64)[:, 0]
        return found[:, : self.record_size]

    def keep(self, records: int) -> None:
        """Increase the number of saved records, which `kept` returns.

        Args:
            records: Number of records whose content was saved to disk since the last call.
        """
        self._header[_KEPT] += records

    @property
    def position(self) -> int:
        """Return the number of the next record to read."""
        return self._next

    def notes(self) -> list[dict[str, Any]]:
        """Return the notes written since the last call.

        The value of the key "from" of a note is the number of the first record that was written after the note.
        Call this method after `read`. Then the result contains every note that belongs to the records read.
        """
        start, length = self._notes_start, self._header[_NOTES_LENGTH]
        packed = bytes(self._bytes[start + self._notes_read : start + length])
        self._notes_read = length
        return [json.loads(line) for line in packed.splitlines()]

    @property
    def writer_alive(self) -> bool:
        """Return whether the writer's process exists, even if it is suspended (SIGSTOP)."""
        return self._held(_WRITER_BYTE, self._header[_WRITER_PID])

    def close(self) -> None:
        """Release the memory; a second call has no effect."""
        if not self._map.closed:
            del self._records
            self._header[_READER_PID] = 0
            self._release()
