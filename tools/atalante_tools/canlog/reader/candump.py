"""Parser for candump logs (`candump -l`, .log of python-can). In a long text, a compiled function parses the usual lines.

    (1700000000.123456) left_leg 181##15A0F004000000041 R
     time                channel id fd flags, payload   direction (may be missing)

The compiled function stops at a line with another format (remote frame, raw DLC, other spacing). A regular expression parses
this line, and the compiled function continues after it. In a short text, the regular expression parses all lines. Lines that
are neither empty nor a frame are counted. A damaged line is never read as a shorter frame, because the validator would then
report a wrong length or a lost frame.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import releases_gil, specialised
from atalante_hal.wire.frame import (
    FLAG_BRS,
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    FRAME_STRUCT,
    HEADER_BYTES,
    ID_ERROR,
    ID_EXTENDED,
    ID_MASK,
    ID_REMOTE,
    as_words,
    new_frames,
)
from atalante_tools.canlog.reader.chunk import MAX_CHANNELS, NO_DIRECTION, RECEIVED, SENT, Channels, Chunk

Text = npt.NDArray[np.uint8]

#: Number of bytes that the memory must have after the end of the text, because the parser may also read these bytes.
MARGIN = 1
#: Minimum length of a text for the compiled function [byte]. The time to load numba equals the time to parse
#: 2 * `_COMPILED_BYTES` bytes with the regular expression.
_COMPILED_BYTES = 1 << 20
_NEWLINE, _RETURN, _SPACE, _OPEN, _CLOSE, _HASH, _DOT, _R, _T = b"\n\r ()#.RT"
_UPPER_CASE = 0xDF  # mask that changes a lower-case letter to upper case
_NAME_BYTES = 16  # maximum length of a channel name in a line of the usual format; Linux allows 15
_MAX_BYTES = 64  # maximum length of a payload
_STANDARD = 0x7FF
_STAMP_END = 1 << 63  # smallest time [ns] that is too large for a stamp; it lies in the year 2262
#: Maximum number of whole seconds in a line of the usual format. A stamp can hold `_MAX_SECONDS` plus any fraction of a second.
_MAX_SECONDS = _STAMP_END // 10**9 - 1
_NO_DIGIT = 0x1000
#: Lookup table: ASCII code -> value of the hexadecimal digit (0 to 15), or `_NO_DIGIT` if the character is not such a digit.
_DIGITS = np.full(256, _NO_DIGIT, np.int64)
_DIGITS[np.frombuffer(b"0123456789abcdef", np.uint8)] = np.arange(16)
_DIGITS[np.frombuffer(b"ABCDEF", np.uint8)] = np.arange(10, 16)
#: A payload has at most `_MAX_BYTES` bytes. Without this limit, matching a damaged line of 8 MB would take 1.6 GB of memory.
_LINE = re.compile(
    rb"\s*\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(#)([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64})|([Rr])(\d?)|((?:[0-9A-Fa-f]{2}){0,64}))(?:_([9A-Fa-f]))?(?:\s+([RrTt]))?\s*"
)


@dataclass
class Parsed:
    """Frames parsed from a text, and the unreadable lines (lines that are neither empty nor a frame)."""

    chunk: Chunk
    unreadable: int  # number of unreadable lines
    first_unreadable: bytes  # first unreadable line; empty if there is none


class Columns(NamedTuple):
    """Arrays of a chunk that `parse_usual` fills. Element k belongs to line k."""

    words: npt.NDArray[np.uint64]  # frames as words, shape (n, 9), initially zero
    octets: npt.NDArray[np.uint8]  # the same memory as bytes, shape (n, 72)
    stamps: npt.NDArray[np.int64]  # time stamp [ns], shape (n,)
    channels: npt.NDArray[np.uint8]  # channel number, shape (n,)
    sent: npt.NDArray[np.int8]  # SENT, RECEIVED or NO_DIRECTION, shape (n,)


def parse(text: bytearray, begin: int, end: int, channels: Channels) -> Parsed:
    """Parse all lines of `text[begin:end]`.

    Args:
        text: log, with at least `MARGIN` bytes after `end`.
        begin: index of the first byte of a line.
        end: index of the byte after the newline of the last line.
        channels: channel names of the log; new names are appended.
    """
    characters = np.frombuffer(text, np.uint8)
    count = int(np.count_nonzero(characters[begin:end] == _NEWLINE))
    frames = new_frames(count)
    chunk = Chunk(frames, np.empty(count, np.int64), np.empty(count, np.uint8), np.empty(count, np.int8))
    octets = frames.view(np.uint8).reshape(-1, FRAME_BYTES)
    columns = Columns(as_words(frames), octets, chunk.stamps, chunk.channels, chunk.sent)
    names = _NameTable(channels)
    usual = None
    if end - begin >= _COMPILED_BYTES:
        usual = specialised(parse_usual, characters, 0, 0, names.table(), 0, columns)
    row, unreadable, first = 0, 0, b""
    while begin < end:
        if usual is not None:
            row, begin = usual(characters, begin, end, names.table(), row, columns)
            if begin == end:
                break
        stop = text.index(b"\n", begin)
        line = bytes(text[begin:stop])
        if _read_line(line, chunk, row, channels):
            row += 1
        elif line.strip():
            first = first if unreadable else line
            unreadable += 1
        begin = stop + 1
    return Parsed(chunk if row == count else chunk.select(np.arange(row)), unreadable, first)


# -- lines of the usual format -----------------------------------------------------------------------------------------


@releases_gil
def parse_usual(
    text: Text, begin: int, end: int, names: npt.NDArray[np.uint64], row: int, columns: Columns
) -> tuple[int, int]:
    """Parse consecutive lines of the usual format. This function is compiled.

    Args:
        text: log as bytes, with at least `MARGIN` bytes after `end`.
        begin: index of the first byte of a line.
        end: index of the byte after the newline of the last line.
        names: known channel names, see `_NameTable`, shape (channels, 2).
        row: index of the first line in the arrays of `columns`.
        columns: arrays to fill.

    Returns:
        The index of the next line in the arrays of `columns`, and the index of its first byte in the text. The second is `end`
        after the last line, otherwise this line has another format or an unknown channel name.
    """
    if begin < end:
        columns.words[row] = 0  # delete the payload of a line that the previous call could not parse completely
    while begin < end:
        # Check this first: after an empty last line, the buffer contains bytes of an earlier text.
        if text[begin] != _OPEN:
            break
        seconds, dot = _number(text, begin + 1, 10, 10)
        if dot == begin + 1 or text[dot] != _DOT or seconds > _MAX_SECONDS:
            break
        fraction, close = _number(text, dot + 1, 10, 10)
        decimals = close - dot - 1
        if decimals not in (6, 9) or text[close] != _CLOSE or text[close + 1] != _SPACE:
            break
        channel, at = _channel(text, close + 2, names)
        if channel < 0:
            break
        can_id, mark = _number(text, at + 1, 16, 8)
        digits = mark - at - 1
        if text[mark] != _HASH:
            break
        if digits == 8 and can_id <= ID_MASK | ID_ERROR:
            can_id |= 0 if can_id & ID_ERROR else ID_EXTENDED
        elif digits != 3 or can_id > _STANDARD:
            break
        at, flags = mark + 1, 0
        if text[at] == _HASH:
            digit = _DIGITS[text[at + 1]]
            if digit == _NO_DIGIT:
                break
            at, flags = at + 2, FLAG_FDF | digit & (FLAG_BRS | FLAG_ESI)
        first = at
        octet = _DIGITS[text[at]] << 4 | _DIGITS[text[at + 1]]
        while octet < 256 and at < first + 2 * _MAX_BYTES:
            columns.octets[row, HEADER_BYTES + (at - first) // 2] = octet
            at += 2
            octet = _DIGITS[text[at]] << 4 | _DIGITS[text[at + 1]]
        length = (at - first) // 2
        sent = NO_DIRECTION
        if text[at] == _SPACE:
            letter = text[at + 1] & _UPPER_CASE
            sent = SENT if letter == _T else RECEIVED
            if letter not in (_T, _R):
                break
            at += 2
        if text[at] == _RETURN:
            at += 1
        if text[at] != _NEWLINE:
            break
        columns.words[row, 0] = np.uint64(can_id | length << 32 | flags << 40)
        columns.stamps[row] = seconds * 1_000_000_000 + fraction * (1000 if decimals == 6 else 1)
        columns.channels[row] = channel
        columns.sent[row] = sent
        row += 1
        begin = at + 1
    return row, begin


def _number(text: Text, at: int, base: int, length: int) -> tuple[int, int]:
    """Parse a number.

    Args:
        text: log as bytes.
        at: index of the first digit.
        base: 10 or 16.
        length: maximum number of digits.

    Returns:
        The number, and the index of the byte after it.
    """
    number, stop = 0, at + length
    digit = _DIGITS[text[at]]
    while digit < base and at < stop:
        number = number * base + digit
        at += 1
        digit = _DIGITS[text[at]]
    return number, at


def _channel(text: Text, at: int, names: npt.NDArray[np.uint64]) -> tuple[int, int]:
    """Look up a channel name.

    Args:
        text: log as bytes.
        at: index of the first byte of the name.
        names: known channel names, see `_NameTable`, shape (channels, 2).

    Returns:
        The number of the channel, or -1 if the name is unknown; and the index of the space after the name.
    """
    high, low = np.uint64(0), np.uint64(0)
    begin, stop = at, at + _NAME_BYTES
    letter = text[at]
    while letter > _SPACE and at < stop:
        high = high << np.uint64(8) | low >> np.uint64(56)
        low = low << np.uint64(8) | np.uint64(letter)
        at += 1
        letter = text[at]
    if letter != _SPACE or at == begin:
        return -1, at
    for channel in range(len(names)):
        if names[channel, 1] == low and names[channel, 0] == high:
            return channel, at
    return -1, at


class _NameTable:
    """Channel names as numbers, which a compiled function can compare."""

    def __init__(self, channels: Channels) -> None:
        self._channels = channels
        self._table = np.zeros((MAX_CHANNELS, 2), np.uint64)
        self._count = 0

    def table(self) -> npt.NDArray[np.uint64]:
        """Return the ASCII codes of each name as a 128-bit number, high word first. Shape (channels, 2).

        A name that is too long for a line of the usual format has the number 0. So does a name with a control character, because
        a NUL at its begin does not change the number.
        """
        for row in range(self._count, len(self._channels.names)):
            name = self._channels.names[row]
            if name.isascii() and name.isprintable() and len(name) <= _NAME_BYTES:
                number = int.from_bytes(name.encode(), "big")
                self._table[row] = number >> 64, number & (1 << 64) - 1
        self._count = len(self._channels.names)
        return self._table[: self._count]


# -- lines of every other format ---------------------------------------------------------------------------------------


def _read_line(line: bytes, chunk: Chunk, row: int, channels: Channels) -> bool:
    """Parse a line in any candump format into row `row` of the chunk; return whether the line contains a frame."""
    match = _LINE.fullmatch(line)
    if match is None:
        return False
    number = int(match[4], 16)
    stamp = int(match[1]) * 10**9 + int(match[2].ljust(9, b"0"))
    data = bytes.fromhex((match[7] or match[10] or b"").decode())
    if stamp >= _STAMP_END or (len(match[4]) == 3 and number > _STANDARD):
        return False
    if len(match[4]) == 8:
        if number > ID_MASK | ID_ERROR:
            return False
        number |= 0 if number & ID_ERROR else ID_EXTENDED
    number |= ID_REMOTE if match[8] else 0
    length = int(match[9] or 0) if match[8] else len(data)
    flags = FLAG_FDF | int(match[6], 16) & (FLAG_BRS | FLAG_ESI) if match[5] else 0
    FRAME_STRUCT.pack_into(chunk.frames.data, row * FRAME_BYTES, number, length, flags, data)
    chunk.stamps[row] = stamp
    chunk.channels[row] = channels.index(match[3].decode("ascii", "replace"))
    letter = (match[12] or b"").upper()
    chunk.sent[row] = SENT if letter == b"T" else RECEIVED if letter == b"R" else NO_DIRECTION
    return True
