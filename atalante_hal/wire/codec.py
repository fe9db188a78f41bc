"""Signal codec that decodes or encodes all signals of a list of messages in one pass of compiled code.

The decoding plan (word, shift, mask, range, factor of each signal) is built once from the DBC. No signal crosses the boundary of
a 64-bit payload word. So a signal is decoded with one word, one shift, one mask, two additions and one multiplication.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Signal
from atalante_dbc.network import LONGEST_SIGNAL
from atalante_hal.compiled import compiled
from atalante_hal.types import Vector
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, WORDS, Frames, new_frames

Words = npt.NDArray[np.int64]

# Rows of `SignalTable.plan`. WORD, SHIFT, MASK: position of the bits of a signal. LARGEST: largest code that fits into the bits.
# LOW, HIGH: smallest and largest code in the DBC range of a signal.
# INVALID: code with which a sender marks a value as invalid.
WORD, SHIFT, MASK, LARGEST, LOW, HIGH, INVALID = range(7)
#: Rows of `SignalTable.scales`: physical value = (raw code + BASE) * FACTOR + OFFSET.
BASE, FACTOR, OFFSET = range(3)
#: In `plan[INVALID, i]`, `NO_CODE` means that the DBC defines no invalid code for signal i.
#: `encode` returns `NO_CODE` if all values were encoded, otherwise the index of a signal that could not be encoded.
NO_CODE = -1
# Results of `read_row`. INSIDE: all signals are in range.
# OUTSIDE: a signal is out of range, and no signal is marked as invalid.
# MARKED_INVALID: a signal is out of range, and at least one signal has its invalid code.
INSIDE, OUTSIDE, MARKED_INVALID = range(3)
#: Number that rounds a float64 to an integer of at most 51 bits (`LONGEST_SIGNAL`) when it is added and then subtracted.
_ROUND = 1.5 * 2.0**52


class SignalTable(NamedTuple):
    """Arrays that describe the coding of all signals of a codec, for the compiled functions of this module.

    Column i of `plan`, column i of `scales` and element i of `codes` belong to decoded value i. The codec owns the
    arrays. Only `codes` changes: every decoding and encoding overwrites it.
    """

    plan: Words  # (7, size) decoding plan; rows WORD, SHIFT, MASK, LARGEST, LOW, HIGH, INVALID
    scales: Vector  # (3, size) scales; rows BASE, FACTOR, OFFSET
    codes: Words  # (size,) raw codes of the last decoding or encoding
    words: Words  # (n,) indices of all 64-bit words of the frame array that contain a signal
    by_row: Words  # (size,) indices of all signals, sorted by the row of the frame that contains the signal
    row_begins: Words  # (rows + 1,) start index of each row in `by_row`; row r ends before the start of row r + 1


@lru_cache(maxsize=4096)
def group_of(signal: str) -> str:
    """Return the quantity in a signal name, without the prefix and the axis, such as Force for `FL_ForceZ`."""
    return signal.rsplit("_", 1)[-1].rstrip("WXYZ")


class Codec:
    """Compiled codec for a fixed list of messages. Row i of a frame array contains messages[i].

    The decoded values are ordered by sign (signed signals first), then by quantity, then by frame id. The order of the rows has
    no effect on this order. So the positions of the twelve joints are one contiguous slice in joint order.
    """

    def __init__(self, messages: Sequence[Message]) -> None:
        self.messages = tuple(messages)
        self.rows = {message.name: row for row, message in enumerate(self.messages)}
        entries = [(row, m, s) for row, m in enumerate(self.messages) for s in m.signals]
        for _, message, signal in entries:
            if signal.length > LONGEST_SIGNAL or signal.start // 64 != (signal.start + signal.length - 1) // 64:
                raise ValueError(
                    f"{message.name}.{signal.name} must have at most {LONGEST_SIGNAL} bits and must not cross a 64-bit boundary "
                    f"of the payload, got {signal.length} bits starting at bit {signal.start}"
                )
        groups = dict.fromkeys((not s.signed, group_of(s.name)) for _, _, s in entries)
        order = {key: index for index, key in enumerate(sorted(groups, key=lambda key: key[0]))}
        entries.sort(key=lambda e: (order[not e[2].signed, group_of(e[2].name)], e[1].frame_id, e[2].start))
        #: (message, signal) pairs in the order of the decoded values.
        self.signals: tuple[tuple[Message, Signal], ...] = tuple((m, s) for _, m, s in entries)
        self.size = len(entries)
        self._index = {(m.name, s.name): i for i, (m, s) in enumerate(self.signals)}
        self._groups = [group_of(s.name) for _, s in self.signals]
        #: Row of the frame that contains each decoded value, shape (size,).
        self.row_of = np.array([row for row, _, _ in entries], dtype=np.intp)
        self._compile([s for _, _, s in entries])

    def _compile(self, signals: list[Signal]) -> None:
        plan, scales = [], []
        for row, s in zip(self.row_of.tolist(), signals, strict=True):
            low, high = sorted(round((x - s.offset) / s.factor) for x in (s.minimum, s.maximum))
            mask, largest = (1 << s.length) - 1, (1 << s.length - s.signed) - 1
            invalid = NO_CODE if s.invalid_raw is None else s.invalid_raw
            plan.append((row * WORDS + 1 + s.start // 64, s.start % 64, mask, largest, low, high, invalid))
            # If offset / factor is an integer, it is added to the raw code, because this sum has no rounding error.
            # Example: offset -40 and factor 0.5 give (raw - 80) * 0.5. In all other cases, the formula is raw * factor + offset.
            code = s.offset / s.factor
            exact = code == round(code) and round(code) * s.factor == s.offset
            scales.append((code, s.factor, 0.0) if exact else (0.0, s.factor, s.offset))
        plan_array: Words = np.array(plan, np.int64).T.copy()
        by_row: Words = np.argsort(self.row_of, kind="stable").astype(np.int64)
        #: Arrays for the compiled functions.
        self.table = SignalTable(
            plan=plan_array,
            scales=np.array(scales).T.copy(),
            codes=np.zeros(self.size, np.int64),
            words=np.unique(plan_array[WORD]),
            by_row=by_row,
            row_begins=np.searchsorted(self.row_of[by_row], np.arange(len(self.messages) + 1)),
        )
        self._decode, self._encode = compiled(decode), compiled(encode)

    def index(self, message: str, signal: str) -> int:
        """Return the index of one signal in the decoded values.

        Args:
            message: name of the message.
            signal: name of the signal.

        Raises:
            KeyError: If there is no such signal; the error lists the messages.
        """
        try:
            return self._index[message, signal]
        except KeyError:
            raise KeyError(f"there is no signal {message}.{signal}; messages are {', '.join(self.rows)}") from None

    def slice(self, group: str) -> slice:
        """Return the slice that selects all signals of one quantity, such as Force, from the decoded values.

        The elements of the slice are in the order of the frame identifiers.

        Args:
            group: name of the quantity, see `group_of`.

        Raises:
            KeyError: If there is no such quantity, or if it is signed in one signal and unsigned in another.
        """
        found = [i for i, name in enumerate(self._groups) if name == group]
        if not found:
            raise KeyError(f"the quantity must be one of {', '.join(dict.fromkeys(self._groups))}, got {group!r}")
        if found[-1] - found[0] + 1 != len(found):
            raise KeyError(f"the signals of the quantity {group!r} must be all signed or all unsigned, got both")
        return slice(found[0], found[-1] + 1)

    def template(self) -> Frames:
        """Create one frame per message, with identifier, length, flags and an empty payload, shape (rows,)."""
        frames = new_frames(len(self.messages))
        for row, message in enumerate(self.messages):
            frames[row]["can_id"], frames[row]["len"] = message.frame_id, message.length
            frames[row]["flags"] = FLAG_FDF | FLAG_BRS
        return frames

    def decode(self, frames: Frames, out: Vector) -> bool:
        """Decode the physical values of all signals.

        Args:
            frames: one frame per message, shape (rows,).
            out: output for the physical values, shape (size,), in DBC units.

        Returns:
            Whether every signal is inside its DBC range. An invalid code is outside the range.
        """
        return self._decode(frames.view(np.int64), self.table, out)

    def rows_outside(self) -> list[int]:
        """Return the rows with a signal that was outside its range in the last `decode`."""
        codes, plan = self.table.codes, self.table.plan
        outside = (codes < plan[LOW]) | (codes > plan[HIGH])
        return sorted(set(self.row_of[outside].tolist()))

    def encode(self, values: Vector, frames: Frames) -> None:
        """Encode physical values into the payloads.

        A value outside its range is encoded as the nearest valid code, and NaN as the invalid code of its signal. Bits without a
        signal become 0 in each word that contains a signal.

        Args:
            values: physical values, shape (size,), in DBC units.
            frames: frames whose payloads are overwritten, shape (rows,).

        Raises:
            ValueError: If the value of a signal without an invalid code is NaN.
        """
        self.require_code(self._encode(values, self.table, frames.view(np.int64)))

    def require_code(self, result: int) -> None:
        """Raise an error if the function `encode` could not encode a signal.

        Args:
            result: result of the function `encode`: `NO_CODE`, or the index of a signal.

        Raises:
            ValueError: If `result` is the index of a signal.
        """
        if result != NO_CODE:
            message, signal = self.signals[result]
            raise ValueError(
                f"{message.name}.{signal.name} must be a number, because the DBC has no invalid code for it, got NaN"
            )


def decode(words: Words, table: SignalTable, values: Vector) -> bool:
    """Decode all signals to raw codes and to physical values.

    Args:
        words: frames as a flat array of 64-bit words, shape (rows * 9,).
        table: signals of the codec; `codes` is overwritten.
        values: output for the physical values, shape (size,), in DBC units.

    Returns:
        Whether every code is in its range.
    """
    inside = read_codes(words, table)
    scale(table, values)
    return inside


def read_codes(words: Words, table: SignalTable) -> bool:
    """Read the raw codes of all signals. This is the first half of `decode`.

    Args:
        words: frames as a flat array of 64-bit words, shape (rows * 9,).
        table: signals of the codec; `codes` is overwritten.

    Returns:
        Whether every code is in its range.
    """
    plan, codes = table.plan, table.codes
    word, shift, mask, largest = plan[WORD], plan[SHIFT], plan[MASK], plan[LARGEST]
    low, high = plan[LOW], plan[HIGH]
    inside = True
    for i in range(len(codes)):
        code = codes[i] = signed(words[word[i]] >> shift[i] & mask[i], mask[i], largest[i])
        inside &= low[i] <= code <= high[i]
    return inside


def signed(raw: int, mask: int, largest: int) -> int:
    """Convert the raw bits of a signal to its code. Negative codes are in two's complement.

    Args:
        raw: raw bits, right-aligned.
        mask: mask of the bits of the signal, right-aligned.
        largest: largest code of the signal; raw bits above it represent a negative code.
    """
    return raw - mask - 1 if raw > largest else raw


def scale(table: SignalTable, values: Vector) -> None:
    """Convert the raw codes of all signals to physical values. This is the second half of `decode`.

    Args:
        table: signals of the codec, with their raw codes.
        values: output for the physical values, shape (size,), in DBC units.
    """
    codes, scales = table.codes, table.scales
    base, factor, offset = scales[BASE], scales[FACTOR], scales[OFFSET]
    for i in range(len(codes)):
        values[i] = (codes[i] + base[i]) * factor[i] + offset[i]


def read_row(words: Words, offset: int, row: int, table: SignalTable) -> int:
    """Read the raw codes of one frame.

    Args:
        words: frames as a flat array of 64-bit words.
        offset: position of the frame in `words`, relative to the position that the decoding plan assumes for the row [words].
        row: row of the message of the frame.
        table: signals of the codec; the elements of `codes` that belong to the row are overwritten.

    Returns:
        `INSIDE` if all codes are in range, `MARKED_INVALID` if a code is out of range and a signal has its invalid code,
        otherwise `OUTSIDE`.
    """
    plan, codes = table.plan, table.codes
    inside, invalid = True, False
    for i in table.by_row[table.row_begins[row] : table.row_begins[row + 1]]:
        raw = words[plan[WORD, i] + offset] >> plan[SHIFT, i] & plan[MASK, i]
        invalid |= raw == plan[INVALID, i]
        code = codes[i] = signed(raw, plan[MASK, i], plan[LARGEST, i])
        inside &= plan[LOW, i] <= code <= plan[HIGH, i]
    if inside:
        return INSIDE
    return MARKED_INVALID if invalid else OUTSIDE


def scale_row(row: int, table: SignalTable, values: Vector) -> None:
    """Convert the raw codes of one row to physical values.

    Args:
        row: row of the message.
        table: signals of the codec, with the raw codes of the row.
        values: output for the physical values, shape (size,), in DBC units; only the values of the row are written.
    """
    codes, scales = table.codes, table.scales
    for i in table.by_row[table.row_begins[row] : table.row_begins[row + 1]]:
        values[i] = (codes[i] + scales[BASE, i]) * scales[FACTOR, i] + scales[OFFSET, i]


def encode(values: Vector, table: SignalTable, words: Words) -> int:
    """Encode physical values into the payload words.

    A value outside its range is encoded as the nearest valid code, and NaN as the invalid code of its signal.

    Args:
        values: physical values, shape (size,), in DBC units.
        table: signals of the codec; `codes` is overwritten.
        words: frames as a flat array of 64-bit words, shape (rows * 9,). The words that contain a signal are overwritten; their
            bits without a signal become 0.

    Returns:
        `NO_CODE` if all values were encoded; otherwise the index of a signal that is NaN and has no invalid code. In that case no
        word is written.
    """
    plan, scales, codes = table.plan, table.scales, table.codes
    base, factor, offset = scales[BASE], scales[FACTOR], scales[OFFSET]
    low, high, invalid = plan[LOW], plan[HIGH], plan[INVALID]
    for i in range(len(codes)):
        # Round half to even; infinities and NaN stay unchanged.
        code = ((values[i] - offset[i]) / factor[i] + (_ROUND - base[i])) - _ROUND
        if low[i] <= code <= high[i]:
            codes[i] = int(code)
        elif code < low[i]:
            codes[i] = low[i]
        elif code > high[i]:
            codes[i] = high[i]
        elif invalid[i] == NO_CODE:
            return i
        else:
            codes[i] = invalid[i]
    for i in table.words:
        words[i] = 0
    word, shift, mask = plan[WORD], plan[SHIFT], plan[MASK]
    for i in range(len(codes)):
        words[word[i]] |= (codes[i] & mask[i]) << shift[i]
    return NO_CODE
