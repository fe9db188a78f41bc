"""Parser for candump logs (`candump -l`, .log of python-can). It parses many lines at a time with array operations.

    (1700000000.123456) left_leg 181##15A0F004000000041 R
     time                channel id fd flags, payload   direction (may be missing)

The array operations accept only lines with exactly this format. A regular expression parses every other line
individually (remote frame, raw DLC, other spacing). Lines that are neither empty nor a frame are counted. A damaged line
is never read as a shorter frame, because the validator would then report a wrong length or a lost frame.
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import (
    FLAG_BRS,
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    ID_ERROR,
    ID_EXTENDED,
    ID_MASK,
    ID_REMOTE,
    new_frames,
)
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, RECEIVED, SENT, Channels, Chunk

Text = npt.NDArray[np.uint8]
Positions = npt.NDArray[np.intp]

#: Padding before and after the text [byte]. The parser may read up to this number of bytes outside a line.
MARGIN = 160
_NEWLINE, _RETURN, _SPACE, _OPEN, _CLOSE, _HASH, _DOT = b"\n\r ()#."
_NAME_BYTES = 16  # maximum length of a channel name in a regular line; Linux allows 15
_MAX_DIGITS = 2 * 64  # maximum number of hexadecimal digits in a payload
_STANDARD = 0x7FF
_NOT_HEX = 255
_HEX = np.full(256, _NOT_HEX, np.uint8)
_HEX[np.frombuffer(b"0123456789", np.uint8)] = np.arange(10)
_HEX[np.frombuffer(b"ABCDEF", np.uint8)] = _HEX[np.frombuffer(b"abcdef", np.uint8)] = np.arange(10, 16)
#: Lookup table: two characters -> value (0 to 255) of the two hexadecimal digits, or 0xFFFF if a character is not such a digit.
#: The index is the ASCII code of the first character plus 256 times the ASCII code of the second character.
_HEX_PAIR = np.full(1 << 16, 0xFFFF, np.uint16)
_HEX_PAIR.reshape(256, 256)[:] = np.where(
    (_HEX < 16) & (_HEX < 16)[:, None], _HEX.astype(np.uint16) << 4 | _HEX[:, None], 0xFFFF
)
#: Element k (0 to 8) is a mask of the k highest bytes of a 64-bit word, which are the last k of its eight characters.
_TAIL = np.array([0, *((((1 << 8 * k) - 1) << 64 - 8 * k) for k in range(1, 9))], np.uint64)
_ZEROS = np.uint64(0x3030303030303030)
_LINE = re.compile(
    rb"\s*\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(#)([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)|([Rr])(\d?)|((?:[0-9A-Fa-f]{2})*))(?:_([9A-Fa-f]))?(?:\s+([RrTt]))?\s*"
)


@dataclass
class Parsed:
    """Frames parsed from a text, and the unreadable lines (lines that are neither empty nor a frame)."""

    chunk: Chunk
    unreadable: int  # number of unreadable lines
    first_unreadable: bytes  # first unreadable line; empty if there is none


def parse(text: Text, begin: int, end: int, channels: Channels) -> Parsed:
    """Parse all lines of `text[begin:end]`.

    Args:
        text: log as bytes, with at least `MARGIN` bytes before `begin` and after `end`.
        begin: index of the first byte of a line.
        end: index of the byte after the newline of the last line.
        channels: channel names of the log; new names are appended.
    """
    lines = _Lines(text, begin, end)
    count = len(lines.starts)
    frames = new_frames(count)
    chunk = Chunk(frames, np.zeros(count, np.int64), np.zeros(count, np.uint8), np.full(count, NO_DIRECTION, np.int8))
    if not count:
        return Parsed(chunk, 0, b"")
    regular = lines.split()
    regular &= _times(lines, chunk.stamps)
    regular &= _channels(lines, chunk.channels, channels)
    regular &= _identifiers(lines, frames)
    chunk.sent[:] = lines.sent
    regular &= _payloads(lines, frames, regular)
    return _parse_individually(lines, chunk, regular, channels)


class _Lines:
    """Positions of time, channel, identifier and payload in each line, as indices into the text. Shape (lines,)."""

    def __init__(self, text: Text, begin: int, end: int) -> None:
        self.text, self.begin, self.end = text, begin, end
        self.ends: Positions = np.flatnonzero(text[begin:end] == _NEWLINE) + begin
        self.starts: Positions = np.empty_like(self.ends)
        if len(self.starts):
            self.starts[0], self.starts[1:] = begin, self.ends[:-1] + 1

    def window(self, positions: Positions, width: int) -> Text:
        """Return the `width` bytes at each position. Shape (positions, width)."""
        rows: Text = np.ndarray((len(self.text) - width,), f"V{width}", self.text, strides=(1,))[positions].view(
            np.uint8
        )
        return rows.reshape(len(positions), width)

    def word(self, positions: Positions) -> npt.NDArray[np.uint64]:
        """Return the eight bytes at each position as a little-endian number. Shape (positions,)."""
        return np.ndarray((len(self.text) - 8,), "<u8", self.text, strides=(1,))[positions]

    def pair(self, positions: Positions) -> npt.NDArray[np.uint16]:
        """Return the two bytes at each position as a little-endian number. Shape (positions,)."""
        return np.ndarray((len(self.text) - 2,), "<u2", self.text, strides=(1,))[positions]

    def split(self) -> npt.NDArray[np.bool_]:
        """Find the fields of each line, and return the mask of the lines in the regular format. Shape (lines,)."""
        stops = self.ends - (self.text[self.ends[0] - 1] == _RETURN)
        last = self.pair(stops - 2)
        has_direction = last & 0xFF == _SPACE
        letter = last >> 8 & 0xDF  # upper case
        is_sent = letter == ord("T")
        self.sent = np.where(has_direction, np.where(is_sent, SENT, RECEIVED), NO_DIRECTION).astype(np.int8)
        regular: npt.NDArray[np.bool_] = ~has_direction | is_sent | (letter == ord("R"))
        self.stops: Positions = stops - 2 * has_direction
        self.marks = self._marks(regular)
        #: Eight characters of each line: four before the first #, the # itself, and three after the #.
        self.head = self.word(self.marks - 4)
        self.fd = self.head >> np.uint64(40) & np.uint64(0xFF) == _HASH
        self.data: Positions = self.marks + 1 + 2 * self.fd
        self.digits = self.stops - self.data
        regular &= (self.digits >= 0) & (self.digits <= _MAX_DIGITS) & (self.digits & 1 == 0)
        self.extended = self.head & np.uint64(0xFF) != _SPACE
        self.id_starts: Positions = self.marks - 3
        if bool(self.extended.any()):
            self.id_starts = self.marks - np.where(self.extended, 8, 3)
            regular &= self.text[self.id_starts - 1] == _SPACE
        self.closes = self._closes(regular)
        return regular

    def _marks(self, regular: npt.NDArray[np.bool_]) -> Positions:
        """Return the position of the first # in each line. Shape (lines,)."""
        found = np.flatnonzero(self.text[self.begin : self.end] == _HASH) + self.begin
        alone = np.ones(len(found), np.bool_)  # False for the second # of ##
        np.not_equal(found[1:], found[:-1] + 1, out=alone[1:])
        return self._one_per_line(found[alone], regular)

    def _closes(self, regular: npt.NDArray[np.bool_]) -> Positions:
        """Return the position of the closing parenthesis in each line. Shape (lines,).

        The parenthesis is usually at the same offset in all lines, so the offset in the first line is tried first.
        """
        text, starts = self.text, self.starts
        width = int(np.argmax(text[starts[0] : starts[0] + MARGIN] == _CLOSE))
        closes: Positions = starts + width
        after = self.pair(closes) == _CLOSE | _SPACE << 8
        if not bool(after.all()):
            closes = self._one_per_line(
                np.flatnonzero(text[self.begin : self.end] == _CLOSE) + self.begin, regular, alone=False
            )
            after = self.pair(closes) == _CLOSE | _SPACE << 8
        regular &= after & (text[starts] == _OPEN) & (closes < self.id_starts)
        return closes

    def _one_per_line(self, found: Positions, regular: npt.NDArray[np.bool_], *, alone: bool = True) -> Positions:
        """Return for each line the first of the `found` positions that is in this line. Shape (lines,).

        Args:
            found: positions in the text, ascending.
            regular: mask of the lines, shape (lines,); this method sets it to False for a line without a found
                position.
            alone: whether this method also sets `regular` to False for a line with several found positions.
        """
        if len(found) == len(self.starts) and bool(((found > self.starts) & (found < self.stops)).all()):
            return found
        if not len(found):
            regular[:] = False
            return self.starts + MARGIN // 8
        at = np.minimum(np.searchsorted(found, self.starts), len(found) - 1)
        first: Positions = found[at]
        inside = (first >= self.starts) & (first < self.stops)
        if alone:
            after = found[np.minimum(at + 1, len(found) - 1)]
            inside &= (at + 1 >= len(found)) | (after >= self.stops)
        regular &= inside
        return np.where(inside, first, self.starts + MARGIN // 8)


def _times(lines: _Lines, stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Parse the time of each line into `stamps` [ns]; return the mask of lines with a regular time. Shape (lines,)."""
    text, closes = lines.text, lines.closes
    decimals = 9 if text[closes[0] - 10] == _DOT else 6
    dots = closes - decimals - 1
    count = dots - lines.starts - 1
    regular: npt.NDArray[np.bool_] = (count >= 1) & (count <= 10)
    count = np.minimum(np.maximum(count, 1), 10)
    seconds, ok = _number(lines.word(dots - 8), np.minimum(count, 8))
    regular &= ok
    if int(count.max()) > 8:
        upper, ok = _number(lines.word(dots - 16), np.maximum(count - 8, 0))
        seconds += upper * np.uint64(10**8)
        regular &= ok
    last_eight = lines.word(closes - 8)
    fraction, ok = _number(last_eight, np.full(1, min(decimals, 8)))
    regular &= ok
    if decimals == 6:
        regular &= last_eight >> np.uint64(8) & np.uint64(0xFF) == _DOT
        stamps[:] = seconds * np.uint64(10**9) + fraction * np.uint64(1000)
    else:
        first = text[dots + 1] - np.uint8(ord("0"))
        regular &= (text[dots] == _DOT) & (first < 10)
        stamps[:] = seconds * np.uint64(10**9) + fraction + first * np.uint64(10**8)
    return regular


def _number(
    word: npt.NDArray[np.uint64], digits: npt.NDArray[np.intp]
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.bool_]]:
    """Parse the last `digits` characters of each word of eight characters as a decimal number.

    Args:
        word: eight characters of each line, shape (lines,).
        digits: number of characters to parse per line, shape (lines,) or (1,).

    Returns:
        The numbers, and the mask of the lines in which all parsed characters are digits; shape (lines,) each.
    """
    tail = _TAIL[digits]
    word = (word & tail) | (_ZEROS & ~tail)
    changes = np.flatnonzero(word[1:] != word[:-1]) + 1
    if len(changes) * 4 > len(word):
        return _parse_digits(word)
    runs = np.concatenate([[0], changes])  # equal words in consecutive lines, such as the seconds, are parsed only once
    number, valid = _parse_digits(word[runs])
    lengths = np.diff(runs, append=len(word))
    return number.repeat(lengths), valid.repeat(lengths)


def _parse_digits(word: npt.NDArray[np.uint64]) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.bool_]]:
    """Parse words of eight decimal digits. The first digit is in the lowest byte.

    The digits are combined to pairs, the pairs to groups of four digits, and these groups to one number.

    Args:
        word: eight characters, shape (n,).

    Returns:
        The numbers, and the mask of the words in which all characters are digits; shape (n,) each.
    """
    above, below = word + np.uint64(0x4646464646464646), word - _ZEROS
    valid: npt.NDArray[np.bool_] = ((above | below) & np.uint64(0x8080808080808080)) == 0
    word = below * np.uint64(10) + (below >> np.uint64(8))
    low = (word & np.uint64(0x000000FF000000FF)) * np.uint64(0x000F424000000064)
    high = ((word >> np.uint64(16)) & np.uint64(0x000000FF000000FF)) * np.uint64(0x0000271000000001)
    return (low + high) >> np.uint64(32), valid


def _channels(lines: _Lines, numbers: npt.NDArray[np.uint8], channels: Channels) -> npt.NDArray[np.bool_]:
    """Find the channel number of each line by the name of the channel.

    Args:
        lines: lines of the log.
        numbers: channel number of each line, shape (lines,), overwritten for the lines with a found channel.
        channels: names of the channels; new names are appended.

    Returns:
        Mask of the lines with a found channel, shape (lines,). False if the name is empty, longer than `_NAME_BYTES`, or
        contains a space or tab.
    """
    stops = lines.id_starts - 1
    length = stops - lines.closes - 2
    regular: npt.NDArray[np.bool_] = (length > 0) & (length <= _NAME_BYTES)
    length = np.minimum(np.maximum(length, 1), _NAME_BYTES)
    low = lines.word(stops - 8) & _TAIL[np.minimum(length, 8)]
    high = lines.word(stops - 16) & _TAIL[np.maximum(length - 8, 0)]
    left = regular.copy()
    while True:
        first = int(np.argmax(left))
        if not left[first]:
            return regular
        begin = int(lines.closes[first]) + 2
        name = lines.text[begin : begin + int(length[first])].tobytes()
        same = left & (low == low[first]) & (high == high[first])
        if b" " in name or b"\t" in name:
            regular &= ~same
        else:
            numbers[same] = channels.index(name.decode("ascii", "replace"))
        left &= ~same


def _identifiers(lines: _Lines, frames: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Parse identifier, length and flags of each line; return the mask of the regular lines. Shape (lines,)."""
    head = lines.head.view(np.int64)
    number = _HEX[head >> 8 & 0xFF].astype(np.uint32) << 8 | _HEX_PAIR[head >> 16 & 0xFFFF]
    regular: npt.NDArray[np.bool_] = number < 16 << 8
    if bool(lines.extended.any()):
        codes = _HEX[lines.window(lines.marks - 8, 5)].astype(np.uint32)
        upper = codes[:, 0] << 28 | codes[:, 1] << 24 | codes[:, 2] << 20 | codes[:, 3] << 16 | codes[:, 4] << 12
        whole = upper | number
        errors = (whole & np.uint32(ID_ERROR)) != 0
        regular &= ~lines.extended | ((codes < 16).all(axis=1) & (whole <= ID_MASK | ID_ERROR))
        wide = np.where(errors, whole, whole | np.uint32(ID_EXTENDED))
        number = np.where(lines.extended, wide, number)
    regular &= lines.extended | (number <= _STANDARD)
    frames["can_id"] = number
    frames["len"] = np.minimum(np.maximum(lines.digits, 0), _MAX_DIGITS) // 2
    flags = _HEX[head >> 48 & 0xFF]
    regular &= ~lines.fd | (flags < 16)
    frames["flags"] = np.where(lines.fd, flags & (FLAG_BRS | FLAG_ESI) | FLAG_FDF, 0)
    return regular


def _payloads(lines: _Lines, frames: npt.NDArray[np.void], wanted: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Parse the payloads of the `wanted` lines; return the mask of lines with a hexadecimal payload. Shape (lines,).

    Lines of equal length are parsed together.
    """
    regular = wanted.copy()
    digits = np.where(wanted, lines.digits, 0)
    memory = frames.view(np.uint8)
    for length in np.flatnonzero(np.bincount(digits)).tolist():
        if not length:
            continue
        chosen = np.flatnonzero(digits == length)
        window = lines.window(lines.data[chosen], length)
        try:
            payload = np.frombuffer(binascii.unhexlify(window.data), f"V{length // 2}")
        except binascii.Error:
            good = (_HEX[window] < 16).all(axis=1)
            regular[chosen[~good]] = False
            chosen = chosen[good]
            payload = np.frombuffer(binascii.unhexlify(window[good].data), f"V{length // 2}")
        target = np.ndarray((len(frames),), f"V{length // 2}", memory, offset=8, strides=(FRAME_BYTES,))
        target[chosen] = payload
    return regular


def _parse_individually(lines: _Lines, chunk: Chunk, regular: npt.NDArray[np.bool_], channels: Channels) -> Parsed:
    """Parse the irregular lines one by one; remove empty and unreadable lines, and count the unreadable lines."""
    keep = np.ones(len(regular), np.bool_)
    unreadable, first = 0, b""
    for row in np.flatnonzero(~regular).tolist():
        line = lines.text[lines.starts[row] : lines.ends[row]].tobytes()
        if not line.strip():
            keep[row] = False
        elif not _read_line(line, chunk, row, channels):
            keep[row] = False
            first = first if unreadable else line
            unreadable += 1
    return Parsed(chunk if bool(keep.all()) else chunk.select(keep), unreadable, first)


def _read_line(line: bytes, chunk: Chunk, row: int, channels: Channels) -> bool:
    """Parse a line in any candump format into row `row` of the chunk; return whether the line contains a frame."""
    match = _LINE.fullmatch(line)
    if match is None:
        return False
    number = int(match[4], 16)
    data = bytes.fromhex((match[7] or match[10] or b"").decode())
    if len(data) > 64 or (len(match[4]) == 3 and number > _STANDARD):
        return False
    if len(match[4]) == 8:
        if number > ID_MASK | ID_ERROR:
            return False
        number |= 0 if number & ID_ERROR else ID_EXTENDED
    frame = np.zeros(1, chunk.frames.dtype)
    frame["can_id"] = number | (ID_REMOTE if match[8] else 0)
    frame["len"] = int(match[9] or 0) if match[8] else len(data)
    frame["flags"] = FLAG_FDF | int(match[6], 16) & (FLAG_BRS | FLAG_ESI) if match[5] else 0
    frame["data"][0, : len(data)] = list(data)
    chunk.frames[row] = frame[0]
    chunk.stamps[row] = int(match[1]) * 10**9 + int(match[2].ljust(9, b"0"))
    chunk.channels[row] = channels.index(match[3].decode("ascii", "replace"))
    letter = (match[12] or b"").upper()
    chunk.sent[row] = SENT if letter == b"T" else RECEIVED if letter == b"R" else NO_DIRECTION
    return True
