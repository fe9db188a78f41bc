"""Log file: its format, and the channels, defects and read position that a reader records in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from atalante_tools.canlog.reader.chunk import Channels

#: Log formats by file suffix: (has the direction of a frame, has the CAN FD flags).
FORMATS = {
    ".log": (True, True),
    ".asc": (True, True),
    ".blf": (True, True),
    ".mf4": (True, True),
    ".trc": (True, True),
    ".csv": (False, False),
}


class LogError(ValueError):
    """Raised if a log cannot be opened. The message gives the reason and the remedy."""


@dataclass(frozen=True)
class Remark:
    """Defect of a log file."""

    rule: str  # identifier of the rule that reports the defect
    sentence: str
    count: int
    stamp: int  # time stamp of the first occurrence [ns]; -1: unknown


@dataclass
class LogFile:
    """Log file, with the state of its reader."""

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

    @property
    def compressed(self) -> bool:
        """Return whether the file is compressed with gzip."""
        return self.path.suffix.lower() == ".gz"

    def remark(self, rule: str, sentence: str, count: int = 1, stamp: int = -1) -> None:
        """Add a defect of the log to `remarks`.

        Args:
            rule: identifier of the rule that reports the defect.
            sentence: description for the report.
            count: number of occurrences.
            stamp: time stamp of the first occurrence [ns]; -1: unknown.
        """
        self.remarks.append(Remark(rule, sentence, count, stamp))
