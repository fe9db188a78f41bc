"""Reader of the logs of python-can (.asc, .blf, .mf4, .trc, .csv) in chunks of frames.

If the readers of python-can cannot parse an entry, they log a warning and skip this entry. They return a truncated
record as a shorter frame, and they leave files open. This module counts the skipped entries, detects truncated records
and closes the files. It rejects .asc logs with relative time stamps, because python-can returns these stamps as times.
"""

from __future__ import annotations

import gc
import gzip
import io
import logging
import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from atalante_hal.bus.asc import asc_lines
from atalante_hal.wire.frame import (
    FLAG_BRS,
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    FRAME_STRUCT,
    ID_ERROR,
    ID_EXTENDED,
    ID_REMOTE,
    new_frames,
)
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, RECEIVED, SENT, Channels, Chunk
from atalante_tools.canlog.reader.log_file import LogError, LogFile

#: Formats with one frame per line. If the file does not end with a newline, the last frame is truncated.
_LINE_FORMATS = (".asc", ".trc", ".csv")
_BLF_HEADER = struct.Struct("<4sLBBBBBBBBQQ")
#: First bytes of an MDF file.
_MDF = b"MDF     "


def read(log: LogFile, chunk_frames: int) -> Iterator[Chunk]:
    """Yield the frames of a log in chunks.

    Args:
        log: log to read; channels, position and remarks are updated.
        chunk_frames: number of frames per chunk; only the last chunk may be smaller.

    Raises:
        LogError: If a read error occurs before the first frame.
    """
    from atalante_hal.bus.replay import UNREADABLE

    batch, count, broken = _Batch(chunk_frames), 0, ""
    warnings = _Warnings()
    ends_within = log.suffix in _LINE_FORMATS and not log.compressed and _last_byte(log.path) not in b"\r\n"
    with _quiet_asammdf(), warnings.captured():
        try:
            with _messages(log) as (messages, position):
                for message in _without_last(messages) if ends_within else messages:
                    batch.add(message, log.channels, log.keeps_direction)
                    count += 1
                    if batch.count == chunk_frames:
                        log.position = position()
                        yield batch.take()
        except (*UNREADABLE, _mdf_error()) as error:
            broken = " ".join(str(error).split()) or type(error).__name__
        if broken and log.suffix == ".mf4":
            # If asammdf cannot open the file, an MDF object remains, and its destructor raises an error.
            # Destroy this object here, because `_quiet_asammdf` suppresses the error only inside the `with` block.
            gc.collect()
    if batch.count:
        yield batch.take()
    _remark(log, count, broken, ends_within, warnings)


@contextmanager
def _messages(log: LogFile) -> Iterator[tuple[Iterator[Any], Callable[[], int]]]:
    """Yield an iterator over the messages of the log, and a function that returns the number of bytes read so far.

    If a reader of python-can rejects a file, python-can does not close this file. Therefore this function opens and
    closes the file itself. Only .mf4 files are opened by asammdf.
    """
    import can
    from can.io.generic import BinaryIOMessageReader

    reader_type = can.io.player.MESSAGE_READERS[log.suffix]
    if log.suffix == ".mf4":
        if (kind := _first_bytes(log.path, len(_MDF))) != _MDF:
            raise ValueError(f"the first bytes must be {_MDF!r}, got {kind!r}")
        with reader_type(log.path) as reader:
            yield iter(reader), lambda: 0
        return
    with log.path.open("rb") as raw, ExitStack() as stack:
        file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if log.compressed else raw
        if not issubclass(reader_type, BinaryIOMessageReader):
            file = stack.enter_context(io.TextIOWrapper(file, encoding="utf-8", errors="replace"))
        if log.suffix == ".asc":
            file = asc_lines(file)
        reader = stack.enter_context(reader_type(file))
        yield _with_absolute_times(reader) if log.suffix == ".asc" else iter(reader), raw.tell


def _with_absolute_times(reader: Any) -> Iterator[Any]:
    """Yield the messages of an .asc log.

    Raises:
        ValueError: If the time stamps of the log are relative. The error is raised before the first message.
    """
    from atalante_hal.bus.replay import RELATIVE_TIMES, has_relative_times

    messages = iter(reader)
    for first in messages:
        if has_relative_times(reader):
            raise ValueError(RELATIVE_TIMES)
        yield first
        break
    yield from messages


def _without_last(messages: Iterator[Any]) -> Iterator[Any]:
    """Yield all messages except the last, whose line is truncated.

    If a read error occurs, yield all messages before the error, then raise the error.
    """
    held: Any = None
    try:
        for message in messages:
            if held is not None:
                yield held
            held = message
    except Exception:
        if held is not None:
            yield held
        raise


def _remark(log: LogFile, count: int, broken: str, ends_within: bool, warnings: _Warnings) -> None:
    if broken and not count:
        raise LogError(f"{log.path} cannot be read as a {log.suffix} log: {broken}")
    if broken:
        log.remark("log-truncated", f"{log.path} cannot be read after frame {count}: {broken}", 1, -1)
    elif ends_within:
        log.remark("log-truncated", f"{log.path} ends within a line; its last frame was not checked", 1, -1)
    elif log.suffix == ".blf" and (defect := _size_defect(log)):
        log.remark("log-truncated", f"{log.path} {defect}; {count} frames were read", 1, -1)
    if warnings.count:
        log.remark(
            "log-unreadable",
            f"{log.path} has {warnings.count} entries that python-can cannot read and that were not checked; first "
            f"warning: {warnings.first}",
            warnings.count,
            -1,
        )


class _Batch:
    """Buffer of frames that were converted from python-can messages."""

    def __init__(self, capacity: int) -> None:
        self._frames = new_frames(capacity)
        self._memory = self._frames.view(np.uint8).data
        self._stamps: list[int] = []
        self._channels: list[int] = []
        self._sent: list[int] = []

    @property
    def count(self) -> int:
        return len(self._stamps)

    def add(self, message: Any, channels: Channels, keeps_direction: bool) -> None:
        data, can_id, flags = bytes(message.data), message.arbitration_id, 0
        length = len(data)
        if message.is_error_frame:
            can_id |= ID_ERROR
        elif message.is_extended_id:
            can_id |= ID_EXTENDED
        if message.is_remote_frame and not message.is_fd:  # the .asc reader marks empty FD frames as remote frames
            can_id, length = can_id | ID_REMOTE, message.dlc
        if message.is_fd:
            flags = FLAG_FDF | bool(message.bitrate_switch) * FLAG_BRS | bool(message.error_state_indicator) * FLAG_ESI
        FRAME_STRUCT.pack_into(self._memory, self.count * FRAME_BYTES, can_id, min(length, 255), flags, data[:64])
        self._stamps.append(round(message.timestamp * 1e9))
        self._channels.append(channels.index("" if message.channel is None else str(message.channel)))
        self._sent.append((RECEIVED if message.is_rx else SENT) if keeps_direction else NO_DIRECTION)

    def take(self) -> Chunk:
        count = self.count
        chunk = Chunk(
            self._frames[:count].copy(),
            np.array(self._stamps, np.int64),
            np.array(self._channels, np.uint8),
            np.array(self._sent, np.int8),
        )
        self._stamps.clear()
        self._channels.clear()
        self._sent.clear()
        return chunk


class _Warnings(logging.Handler):
    """Counter of the warnings of the python-can readers. A reader logs one warning for each entry that it skips."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0
        self.first = ""

    @contextmanager
    def captured(self) -> Iterator[None]:
        """Count the warnings that python-can logs inside the `with` block."""
        logging.getLogger("can").addHandler(self)
        try:
            yield
        finally:
            logging.getLogger("can").removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        self.first = self.first or " ".join(record.getMessage().split())
        self.count += 1


@contextmanager
def _quiet_asammdf() -> Iterator[None]:
    """Suppress the traceback of asammdf for a file that cannot be opened.

    The destructor of the file object raises an exception, which Python prints.
    """
    before = sys.unraisablehook

    def hook(failure: sys.UnraisableHookArgs) -> None:
        if getattr(failure.object, "__qualname__", "") != "MDF4.__del__":
            before(failure)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


def _mdf_error() -> type[Exception]:
    """Return the exception type that asammdf raises for a damaged file; `EOFError` if asammdf is not installed."""
    try:
        from asammdf.blocks.utils import MdfException
    except ImportError:
        return EOFError
    found: type[Exception] = MdfException
    return found


def _first_bytes(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


def _last_byte(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        if not file.tell():
            return b"\n"
        file.seek(-1, os.SEEK_END)
        return file.read(1)


def _size_defect(log: LogFile) -> str:
    """Return the reason why a .blf file is incomplete, or an empty text if the file is complete.

    The function compares the size of the file with the size in the file header. The recorder writes the final size into
    the header when it closes the log. Until then, the header states a smaller size. For a compressed log, this function
    checks only whether the header states any data.
    """
    with gzip.open(log.path) if log.compressed else log.path.open("rb") as file:
        header = file.read(_BLF_HEADER.size)
    if len(header) < _BLF_HEADER.size:
        return ""
    _, header_size, *_, stated, _ = _BLF_HEADER.unpack(header)
    if not log.compressed and stated > log.size:
        return f"is truncated: according to its header {stated - log.size} bytes are missing"
    if stated <= header_size if log.compressed else stated < log.size:
        return (
            f"was not closed by its recorder, so its last frames are missing: its header states {stated} bytes, "
            "and the file has more"
        )
    return ""
