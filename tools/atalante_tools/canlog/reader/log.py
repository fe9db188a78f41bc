"""Reader of CAN logs in chunks of frames: a parser for candump logs, and python-can for all other formats.

The required memory depends on the chunk size, not on the length of the log. The reader returns all readable frames. For
unreadable parts of a log, the reader adds remarks. The validator reports each remark as a finding.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from atalante_tools.canlog.reader import candump_log, python_can_log
from atalante_tools.canlog.reader.chunk import Chunk
from atalante_tools.canlog.reader.log_file import FORMATS, LogError, LogFile

_CHUNK_FRAMES = 100_000  # minimum number of frames in a chunk; only the last chunk is smaller


class Log(LogFile):
    """Log that is open for reading. The list `remarks` is complete after all chunks were read."""

    def chunks(self) -> Iterator[Chunk]:
        """Yield the frames in chunks, sorted by time within a chunk."""
        reader = candump_log.read if self.suffix == ".log" else python_can_log.read
        frames, last = 0, -1
        backwards, first_backwards, furthest = 0, -1, 0
        for chunk in reader(self, _CHUNK_FRAMES):
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
                f"{self.path} is not in order of time ({backwards} jumps back, the longest {-furthest * 1e-9:.6f} s); the frames "
                "were sorted within each chunk of the log",
                backwards,
                first_backwards,
            )
        if not frames:
            hint = "; a .log file must have the format of `candump -l`" if self.suffix == ".log" and self.size else ""
            self.remark("log-empty", f"{self.path} has no readable CAN frame{hint}", 1, -1)


def open_log(path: Path) -> Log:
    """Open a log for reading.

    Args:
        path: file with a suffix in `FORMATS`, or with such a suffix followed by .gz.

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
