"""Reader of CAN logs in chunks of frames: an array parser for candump logs, and python-can for all other formats.

The chunk size bounds the memory for a log of any length. The reader returns all readable frames. Unreadable parts of a log
become remarks, which the validator reports as findings.
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

from atalante_hal.wire.frame import WORDS, new_frames
from atalante_tools.canlog.validate import candump, python_can_log
from atalante_tools.canlog.validate.candump import MARGIN, Channels
from atalante_tools.canlog.validate.chunk import Chunk, LogError

__all__ = ["FORMATS", "Log", "LogError", "Remark", "open_log"]

#: Log formats by file suffix: (has the direction of a frame, has the CAN FD flags).
FORMATS = {
    ".log": (True, True),
    ".asc": (True, True),
    ".blf": (True, True),
    ".mf4": (True, True),
    ".trc": (True, True),
    ".csv": (False, False),
}
_TEXT_BYTES = 1 << 21  # text parsed in one call [byte]; its arrays fit into the processor cache
_CHUNK_FRAMES = 120_000  # minimum number of frames in a chunk; only the last chunk is smaller


@dataclass(frozen=True)
class Remark:
    """Defect of a log file."""

    rule: str  # identifier of the rule that reports the defect
    sentence: str
    count: int
    stamp: int  # time stamp of the first occurrence [ns]; -1: unknown


@dataclass
class Log:
    """Log file. The list `remarks` is complete after all chunks were read."""

    path: Path
    suffix: str  # suffix of the format, lower case, without .gz
    size: int  # bytes
    channels: Channels = field(default_factory=Channels)
    remarks: list[Remark] = field(default_factory=list)
    position: int = 0  # bytes read so far

    @property
    def keeps_direction(self) -> bool:
        """Return whether the format records the direction of a frame."""
        return FORMATS[self.suffix][0]

    @property
    def keeps_flags(self) -> bool:
        """Return whether the format records the flags of CAN FD frames."""
        return FORMATS[self.suffix][1]

    def chunks(self) -> Iterator[Chunk]:
        """Yield the frames in chunks, sorted by time within a chunk."""
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
                f"{self.path} is not in order of time ({backwards} steps back, the longest {-furthest * 1e-9:.6f} s); the frames "
                "were sorted within each chunk of the log",
                backwards,
                first_backwards,
            )
        if not frames:
            hint = "; a .log file must have the format of `candump -l`" if self.suffix == ".log" and self.size else ""
            self.remark("log-empty", f"{self.path} has no readable CAN frame{hint}", 1, -1)

    def remark(self, rule: str, sentence: str, count: int = 1, stamp: int = -1) -> None:
        """Add a defect of the log to `remarks`.

        Args:
            rule: identifier of the rule that reports the defect.
            sentence: description for the report.
            count: number of occurrences.
            stamp: time stamp of the first occurrence [ns]; -1: unknown.
        """
        self.remarks.append(Remark(rule, sentence, count, stamp))

    # -- candump -----------------------------------------------------------------------------------------------------

    def _candump(self) -> Iterator[Chunk]:
        text = np.zeros(_TEXT_BYTES + 2 * MARGIN, np.uint8)
        memory = text.data
        unreadable, example = 0, b""
        gathered: list[Chunk] = []
        kept, line_too_long = 0, False
        broken = ""
        with self._open() as file:
            while True:
                got, broken = _fill(file, memory[MARGIN + kept : MARGIN + _TEXT_BYTES])
                self.position = file.tell() if not self.compressed else self.position
                end = MARGIN + kept + got
                if not got:
                    break  # end of the file, or a read error, described in `broken`
                stop = _after_last_newline(text, end - got, end)
                if not stop:
                    kept += got
                    if kept == _TEXT_BYTES:
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
                f"{self.path} has {unreadable} lines that are no CAN frame and were not checked; the first is {_shown(example)}",
                unreadable,
                -1,
            )
        if broken:
            self.remark("log-truncated", f"{self.path} is truncated: {broken}", 1, -1)
        elif last_line:
            self.remark(
                "log-truncated",
                f"{self.path} ends within a line, which was not checked: {_shown(last_line)}",
                1,
                -1,
            )

    @property
    def compressed(self) -> bool:
        """Return whether the file is compressed with gzip."""
        return self.path.suffix.lower() == ".gz"

    def _open(self) -> io.RawIOBase | gzip.GzipFile:
        return gzip.GzipFile(self.path) if self.compressed else io.FileIO(self.path)


def open_log(path: Path) -> Log:
    """Open a log for reading.

    Args:
        path: file with a suffix of `FORMATS`, or such a suffix and .gz.

    Raises:
        LogError: If the file does not exist, cannot be read, or has a suffix that is not supported.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    suffix = suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        raise LogError(f"the suffix of a CAN log must be one of {known} (.log for `candump -l`), got {path}")
    if not path.is_file():
        raise LogError(f"the log {path} does not exist")
    if not os.access(path, os.R_OK):
        raise LogError(f"the log {path} cannot be read; check its permissions")
    if suffix == ".mf4":
        _require_asammdf(path)
    return Log(path, suffix, path.stat().st_size)


def _require_asammdf(path: Path) -> None:
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"the MF4 log {path} needs asammdf: type `pip install asammdf`")


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
    """Read from the file until the memory is full or the file ends.

    Returns:
        The number of bytes read, and the read error if no byte was read.
    """
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


def _after_last_newline(text: npt.NDArray[np.uint8], begin: int, end: int) -> int:
    """Return the index after the last newline in `text[begin:end]`, or 0 without a newline.

    The last bytes are searched first.
    """
    for first in (max(begin, end - 4 * MARGIN), begin):
        newlines = np.flatnonzero(text[first:end] == ord("\n"))
        if len(newlines):
            return first + int(newlines[-1]) + 1
    return 0


def _shown(line: bytes) -> str:
    text = line.decode("ascii", "replace").strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")
