"""Log file: format, channels, defects and read position. The log reader updates channels, defects and read position."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from atalante_tools.canlog.reader.chunk import Channels

#: Suffix of a log format -> three truth values: the format records the direction of frames; the format records CAN FD flags;
#: the reader reads all bus errors. Some bus errors are not read, because python-can skips the ER records of .trc and the
#: CAN FD error objects of .blf.
FORMATS = {
    ".log": (True, True, True),
    ".asc": (True, True, True),
    ".blf": (True, True, False),
    ".mf4": (True, True, True),
    ".trc": (True, True, False),
    ".csv": (False, False, True),
}


class LogError(ValueError):
    """Raised if a log cannot be opened. The message gives the reason and the remedy."""


@dataclass(frozen=True)
class Remark:
    """Defect of a log file."""

    rule: str  # identifier of the validator rule that reports the defect
    sentence: str
    count: int
    stamp: int  # time stamp of the first frame with the defect [ns]; -1 means unknown


@dataclass
class LogFile:
    """Log file, with the channels, defects and read position that the log reader updates."""

    path: Path
    suffix: str  # file suffix of the format, in lower case, without .gz
    size: int  # size of the file [byte]
    channels: Channels = field(default_factory=Channels)
    remarks: list[Remark] = field(default_factory=list)
    position: int = 0  # number of bytes read so far

    @property
    def keeps_direction(self) -> bool:
        """Return whether the format records the direction of a frame."""
        return FORMATS[self.suffix][0]

    @property
    def keeps_flags(self) -> bool:
        """Return whether the format records the flags of CAN FD frames."""
        return FORMATS[self.suffix][1]

    @property
    def keeps_errors(self) -> bool:
        """Return whether all bus errors in the log are read."""
        return FORMATS[self.suffix][2]

    @property
    def compressed(self) -> bool:
        """Return whether the file is compressed with gzip."""
        return self.path.suffix.lower() == ".gz"

    def remark(self, rule: str, sentence: str, count: int = 1, stamp: int = -1) -> None:
        """Add a defect of the log to `remarks`.

        Args:
            rule: identifier of the validator rule that reports the defect.
            sentence: description for the report.
            count: number of occurrences.
            stamp: time stamp of the first occurrence [ns]; -1 means unknown.
        """
        self.remarks.append(Remark(rule, sentence, count, stamp))
