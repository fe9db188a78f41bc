"""A log as chunks of frames: candump's format by the array parser, every other one through python-can's readers.

Memory is bounded by the chunk, whatever the length of the log. What cannot be read becomes a remark, a finding like any other,
and everything that can be read is delivered.
"""

from __future__ import annotations

import gc
import gzip
import io
import logging
import os
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import (
    FLAG_BRS,
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    ID_ERROR,
    ID_EXTENDED,
    ID_REMOTE,
    WORDS,
    new_frames,
)
from atalante_tools.validate import candump
from atalante_tools.validate.candump import MARGIN, Channels
from atalante_tools.validate.chunk import NOT_SAID, RECEIVED, SENT, Chunk

#: Formats of python-can's LogReader, and whether they keep direction and CAN FD flags.
FORMATS = {
    ".log": (True, True),
    ".asc": (True, True),
    ".blf": (True, True),
    ".mf4": (True, True),
    ".trc": (True, True),
    ".csv": (False, False),
}
#: One frame a line: a file that does not end in a newline breaks off within a frame.
_LINE_FORMATS = (".asc", ".trc", ".csv")
_PIECE_BYTES = 1 << 21  # text parsed at once: its arrays stay in the processor's cache
_CHUNK_FRAMES = 120_000
_BLF_HEADER = struct.Struct("<4sLBBBBBBBBQQ")
#: First bytes of an MDF file.
_MDF = b"MDF     "
_RECORD = struct.Struct("<IBB2x64s")


class LogError(ValueError):
    """The log cannot be opened at all; the message says why, and what would be right."""


@dataclass(frozen=True)
class Remark:
    """Something wrong with the log itself."""

    rule: str
    sentence: str
    count: int
    stamp: int  # ns, of the first occurrence; -1: not known


@dataclass
class Log:
    """A log being read; `remarks` grows while `chunks` is exhausted."""

    path: Path
    suffix: str
    size: int  # bytes
    channels: Channels = field(default_factory=Channels)
    remarks: list[Remark] = field(default_factory=list)
    position: int = 0  # bytes read so far

    @property
    def keeps_direction(self) -> bool:
        """Whether the format can say who sent a frame."""
        return FORMATS[self.suffix][0]

    @property
    def keeps_flags(self) -> bool:
        """Whether the format keeps the flags of CAN FD frames."""
        return FORMATS[self.suffix][1]

    def chunks(self) -> Iterator[Chunk]:
        """The frames, in order of time within a chunk."""
        frames, last = 0, -1
        backwards, first_backwards, furthest = 0, -1, 0
        for chunk in self._candump() if self.suffix == ".log" else self._python_can():
            steps = np.diff(chunk.stamps, prepend=last if frames else chunk.stamps[0])
            wrong = steps < 0
            if bool(wrong.any()):
                if not backwards:
                    first_backwards = int(chunk.stamps[np.argmax(wrong)])
                backwards += int(wrong.sum())
                furthest = min(furthest, int(steps.min()))
                chunk = chunk.select(np.argsort(chunk.stamps, kind="stable"))
            frames += len(chunk)
            last = max(last, int(chunk.stamps[-1]))
            yield chunk
        if backwards:
            self._remark(
                "log-unsorted",
                f"{self.path} is not in order of time ({backwards} steps back, the longest {-furthest * 1e-9:.6f} s): sorted "
                "as far as a chunk of the log reaches",
                backwards,
                first_backwards,
            )
        if not frames:
            hint = "; a .log is what `candump -l` writes" if self.suffix == ".log" and self.size else ""
            self._remark("log-empty", f"{self.path} holds no CAN frame that can be read{hint}", 1, -1)

    def _remark(self, rule: str, sentence: str, count: int, stamp: int) -> None:
        self.remarks.append(Remark(rule, sentence, count, stamp))

    # -- candump -----------------------------------------------------------------------------------------------------

    def _candump(self) -> Iterator[Chunk]:
        text = np.zeros(_PIECE_BYTES + 2 * MARGIN, np.uint8)
        memory = text.data
        unreadable, example = 0, b""
        gathered: list[Chunk] = []
        kept, line_too_long = 0, False
        broken = ""
        with self._open() as file:
            while True:
                got, broken = _fill(file, memory[MARGIN + kept : MARGIN + _PIECE_BYTES])
                self.position = file.tell() if not self._compressed else self.position
                end = MARGIN + kept + got
                if not got:
                    break  # at the end, or nothing more can be read: `broken` says so again
                stop = _behind_last_newline(text, end - got, end)
                if not stop:
                    kept += got
                    if kept == _PIECE_BYTES:
                        kept, line_too_long = 0, True
                    continue
                parsed = candump.parse(text, MARGIN, stop, self.channels)
                example = example if unreadable else parsed.first_unreadable
                unreadable += parsed.unreadable + line_too_long
                line_too_long = False
                if len(parsed.chunk):
                    gathered.append(parsed.chunk)
                kept = end - stop
                text[MARGIN : MARGIN + kept] = text[stop:end].copy()
                if sum(map(len, gathered)) >= _CHUNK_FRAMES:
                    yield _joined(gathered)
                    gathered.clear()
        if gathered:
            yield _joined(gathered)
        last_line = text[MARGIN : MARGIN + kept].tobytes().strip()
        self._remark_candump(unreadable, example, last_line, broken)

    def _remark_candump(self, unreadable: int, example: bytes, last_line: bytes, broken: str) -> None:
        if unreadable:
            self._remark(
                "log-unreadable",
                f"{self.path} has {unreadable} lines that are no CAN frame, the first is {_shown(example)}: nothing looked at "
                "them",
                unreadable,
                -1,
            )
        if broken:
            self._remark("log-truncated", f"{self.path} breaks off: {broken}", 1, -1)
        elif last_line:
            self._remark(
                "log-truncated",
                f"{self.path} ends within a line, {_shown(last_line)}: nothing looked at it",
                1,
                -1,
            )

    @property
    def _compressed(self) -> bool:
        return self.path.suffix.lower() == ".gz"

    def _open(self) -> io.RawIOBase | gzip.GzipFile:
        return gzip.GzipFile(self.path) if self._compressed else io.FileIO(self.path)

    # -- python-can --------------------------------------------------------------------------------------------------

    def _python_can(self) -> Iterator[Chunk]:
        from atalante_hal.bus.replay import UNREADABLE

        batch, count, broken = _Batch(), 0, ""
        complaints = _Complaints()
        ends_within = self.suffix in _LINE_FORMATS and not self._compressed and _last_byte(self.path) not in b"\r\n"
        with _quiet_asammdf(), complaints.heard():
            try:
                with self._messages() as (messages, position):
                    held = next(messages, None)
                    while held is not None:
                        message, held = held, next(messages, None)
                        if held is None and ends_within:
                            break
                        batch.add(message, self.channels, self.keeps_direction)
                        count += 1
                        if batch.count == _CHUNK_FRAMES:
                            self.position = position()
                            yield batch.take()
            except (*UNREADABLE, _mdf_error()) as error:
                broken = " ".join(str(error).split()) or type(error).__name__
            if broken and self.suffix == ".mf4":
                gc.collect()  # the half-opened file, while its complaint is not heard
        if batch.count:
            yield batch.take()
        self._remark_python_can(count, broken, ends_within, complaints)

    @contextmanager
    def _messages(self) -> Iterator[tuple[Iterator[Any], Callable[[], int]]]:
        """The messages of the log, and how to ask how far the file is read.

        python-can does not close a file that its reader refuses: it is opened here, but for .mf4, which asammdf opens.
        """
        import can
        from can.io.generic import BinaryIOMessageReader

        reader_type = can.io.player.MESSAGE_READERS[self.suffix]
        if self.suffix == ".mf4":
            if (kind := _first_bytes(self.path, len(_MDF))) != _MDF:
                raise ValueError(f"the file begins with {kind!r}, not with {_MDF!r}")
            with reader_type(self.path) as reader:
                yield iter(reader), lambda: 0
            return
        with self.path.open("rb") as raw, ExitStack() as stack:
            file: Any = stack.enter_context(gzip.GzipFile(fileobj=raw)) if self._compressed else raw
            if not issubclass(reader_type, BinaryIOMessageReader):
                file = stack.enter_context(io.TextIOWrapper(file, encoding="utf-8", errors="replace"))
            yield iter(stack.enter_context(reader_type(file))), raw.tell

    def _remark_python_can(self, count: int, broken: str, ends_within: bool, complaints: _Complaints) -> None:
        if broken and not count:
            raise LogError(f"{self.path} cannot be read as a {self.suffix} log: {broken}")
        if broken:
            self._remark("log-truncated", f"{self.path} cannot be read beyond frame {count}: {broken}", 1, -1)
        elif ends_within:
            self._remark("log-truncated", f"{self.path} ends within a line: nothing looked at its last frame", 1, -1)
        elif self.suffix == ".blf" and (missing := _missing_bytes(self.path)):
            self._remark(
                "log-truncated",
                f"{self.path} breaks off: its header speaks of {missing} bytes more; {count} frames could be read",
                1,
                -1,
            )
        if complaints.count:
            self._remark(
                "log-unreadable",
                f"{self.path} has {complaints.count} entries that python-can cannot read ({complaints.first}): nothing looked "
                "at them",
                complaints.count,
                -1,
            )


def open_log(path: Path) -> Log:
    """A log to read.

    Raises:
        LogError: no such file, or a format that python-can does not read or that does not keep what is judged.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    suffix = suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        raise LogError(f"{path} has no suffix of a CAN log; use one of {known} (.log is candump -l)")
    if not path.is_file():
        raise LogError(f"there is no log {path}")
    if not os.access(path, os.R_OK):
        raise LogError(f"the log {path} may not be read; check its permissions")
    if suffix == ".mf4":
        _require_asammdf(path)
    return Log(path, suffix, path.stat().st_size)


@contextmanager
def _quiet_asammdf() -> Iterator[None]:
    """asammdf's file object cannot be deleted when opening it failed, and Python would print a traceback about that."""
    before = sys.unraisablehook

    def hook(failure: sys.UnraisableHookArgs) -> None:
        if getattr(failure.object, "__qualname__", "") != "MDF4.__del__":
            before(failure)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


def _require_asammdf(path: Path) -> None:
    import importlib.util

    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path} is an MF4 log, which python-can reads with asammdf: pip install asammdf")


class _Batch:
    """Frames of python-can messages, gathered until there are enough."""

    def __init__(self) -> None:
        self._frames = new_frames(_CHUNK_FRAMES)
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
        if message.is_remote_frame and not message.is_fd:  # the .asc reader calls an empty FD frame remote
            can_id, length = can_id | ID_REMOTE, message.dlc
        if message.is_fd:
            flags = FLAG_FDF | bool(message.bitrate_switch) * FLAG_BRS | bool(message.error_state_indicator) * FLAG_ESI
        _RECORD.pack_into(self._memory, self.count * FRAME_BYTES, can_id, min(length, 255), flags, data[:64])
        self._stamps.append(round(message.timestamp * 1e9))
        self._channels.append(channels.index("" if message.channel is None else str(message.channel)))
        self._sent.append((RECEIVED if message.is_rx else SENT) if keeps_direction else NOT_SAID)

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


class _Complaints(logging.Handler):
    """python-can's readers drop what they do not understand and say so in a log message."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0
        self.first = ""

    @contextmanager
    def heard(self) -> Iterator[None]:
        """Listen to python-can."""
        logging.getLogger("can").addHandler(self)
        try:
            yield
        finally:
            logging.getLogger("can").removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        self.first = self.first or " ".join(record.getMessage().split())
        self.count += 1


def _joined(chunks: list[Chunk]) -> Chunk:
    if len(chunks) == 1:
        return chunks[0]
    frames = new_frames(sum(map(len, chunks)))
    np.concatenate([c.frames.view("<u8").reshape(-1, WORDS) for c in chunks], out=frames.view("<u8").reshape(-1, WORDS))
    return Chunk(
        frames,
        np.concatenate([c.stamps for c in chunks]),
        np.concatenate([c.channels for c in chunks]),
        np.concatenate([c.sent for c in chunks]),
    )


def _fill(file: io.RawIOBase | gzip.GzipFile, memory: memoryview) -> tuple[int, str]:
    """Read until the memory is full or the file ends; returns the bytes read and, if none could be read any more, why."""
    if not isinstance(file, gzip.GzipFile):
        return file.readinto(memory) or 0, ""
    total = 0
    while total < len(memory):
        try:
            got = file.readinto1(memory[total:])
        except (OSError, EOFError, zlib.error) as error:
            return total, "" if total else str(error)
        if not got:
            break
        total += got
    return total, ""


def _behind_last_newline(text: npt.NDArray[np.uint8], begin: int, end: int) -> int:
    """Place behind the last newline of `text[begin:end]`, 0 if there is none; it is nearly always in the last few bytes."""
    for first in (max(begin, end - 4 * MARGIN), begin):
        newlines = np.flatnonzero(text[first:end] == ord("\n"))
        if len(newlines):
            return first + int(newlines[-1]) + 1
    return 0


def _mdf_error() -> type[Exception]:
    """What asammdf raises on a damaged file, or nothing that could be raised here without it."""
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


def _missing_bytes(path: Path) -> int:
    """Bytes a .blf file says it has and has not."""
    with path.open("rb") as file:
        header = file.read(_BLF_HEADER.size)
    if len(header) < _BLF_HEADER.size:
        return 0
    size: int = _BLF_HEADER.unpack(header)[-2]
    return max(0, size - path.stat().st_size)


def _shown(line: bytes) -> str:
    text = line.decode("ascii", "replace").strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")
