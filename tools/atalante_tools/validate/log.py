"""A log as chunks of frames: candump's format by the array parser, every other one through python-can's readers.

Memory is bounded by the chunk, whatever the length of the log. What cannot be read becomes a remark, a finding like any other,
and everything that can be read is delivered.
"""

from __future__ import annotations

import gzip
import importlib.util
import io
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import WORDS, new_frames
from atalante_tools.validate import candump, python_can_log
from atalante_tools.validate.candump import MARGIN, Channels
from atalante_tools.validate.chunk import Chunk, LogError

__all__ = ["FORMATS", "Log", "LogError", "Remark", "open_log"]

#: Formats of python-can's LogReader, and whether they keep direction and CAN FD flags.
FORMATS = {
    ".log": (True, True),
    ".asc": (True, True),
    ".blf": (True, True),
    ".mf4": (True, True),
    ".trc": (True, True),
    ".csv": (False, False),
}
_PIECE_BYTES = 1 << 21  # text parsed at once: its arrays stay in the processor's cache
_CHUNK_FRAMES = 120_000


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
        for chunk in self._candump() if self.suffix == ".log" else python_can_log.read(self, _CHUNK_FRAMES):
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
            self.remark(
                "log-unsorted",
                f"{self.path} is not in order of time ({backwards} steps back, the longest {-furthest * 1e-9:.6f} s): sorted "
                "as far as a chunk of the log reaches",
                backwards,
                first_backwards,
            )
        if not frames:
            hint = "; a .log is what `candump -l` writes" if self.suffix == ".log" and self.size else ""
            self.remark("log-empty", f"{self.path} holds no CAN frame that can be read{hint}", 1, -1)

    def remark(self, rule: str, sentence: str, count: int = 1, stamp: int = -1) -> None:
        """Note something wrong with the log."""
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
                self.position = file.tell() if not self.compressed else self.position
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
            self.remark(
                "log-unreadable",
                f"{self.path} has {unreadable} lines that are no CAN frame, the first is {_shown(example)}: nothing looked at "
                "them",
                unreadable,
                -1,
            )
        if broken:
            self.remark("log-truncated", f"{self.path} breaks off: {broken}", 1, -1)
        elif last_line:
            self.remark(
                "log-truncated",
                f"{self.path} ends within a line, {_shown(last_line)}: nothing looked at it",
                1,
                -1,
            )

    @property
    def compressed(self) -> bool:
        """Whether the file is compressed with gzip."""
        return self.path.suffix.lower() == ".gz"

    def _open(self) -> io.RawIOBase | gzip.GzipFile:
        return gzip.GzipFile(self.path) if self.compressed else io.FileIO(self.path)


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


def _require_asammdf(path: Path) -> None:
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path} is an MF4 log, which python-can reads with asammdf: pip install asammdf")


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


def _shown(line: bytes) -> str:
    text = line.decode("ascii", "replace").strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")
