"""Correction of the lines of an .asc log, so that python-can reads every frame. The replay and the log reader use it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

#: Flags of a frame on a CAN FD channel in an .asc log: CAN FD format and remote frame.
_FDF, _REMOTE = 0x1000, 0x10


def asc_lines(file: Iterable[str]) -> Iterator[str]:
    """Yield the lines of an .asc log, corrected so that python-can reads every frame once and in the right format.

    - python-can takes the first line after the header for a part of the header. A frame in this line would be lost, so a
      header line is inserted before it.
    - A line with the direction TxRq is a request to send. It is omitted, because the sent frame has its own line.
    - A classic frame of a CAN FD channel is written as the line of a classic channel.

    Args:
        file: lines of the log.
    """
    in_header = True
    for line in file:
        words = line.split()
        if in_header and words and words[0][0].isdigit():
            in_header = False
            yield "internal events logged\n"
        if len(words) < 4 or words[3].lower() != "txrq":
            yield _classic_line(words) or line


def _classic_line(words: Sequence[str]) -> str:
    """Convert the line of a classic frame on a CAN FD channel to the line format of a classic channel.

    The result is empty for any other line.

    The words are: time, "CANFD", channel, direction, identifier, name (optional), BRS, ESI, DLC, length, data, duration, length
    in bits, flags (hexadecimal), and further numbers.
    """
    if len(words) < 5 or words[1].upper() != "CANFD":
        return ""
    time, _, channel, direction, identifier = words[:5]
    try:
        switch, error_passive, dlc, length, *rest = words[5 if words[5].isdigit() else 6 :]
        data, flags = rest[: int(length)], int(rest[int(length) + 2], 16)
    except (ValueError, IndexError):
        return ""  # not a data frame, or a line without flags
    if flags & _FDF or switch != "0" or error_passive != "0" or len(data) > 8:
        return ""
    return f"{time} {channel} {identifier} {direction} {'r' if flags & _REMOTE else 'd'} {dlc} {' '.join(data)}\n"
