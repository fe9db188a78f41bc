"""Array codec: every signal of a set of messages decoded or encoded in a handful of array operations.

The plan (word index, shifts, factors) is compiled from the DBC once. It works because no signal crosses a 64-bit word
of the payload: a signal is one gather, two shifts, one multiply and one add, for all signals of a cycle together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Signal
from atalante_hal.frame import FLAG_BRS, FLAG_FDF, WORDS, Frames, new_frames

Vector = npt.NDArray[np.float64]
Words = npt.NDArray[np.uint64]

#: Adding this to a float rounds it to an integer that then stands in the low bits of the mantissa.
_ROUND = 1.5 * 2.0**52
_LONGEST = 51  # bits such an integer can have


def _words(numbers: Iterable[int]) -> Words:
    """Numbers as 64-bit words, negative ones wrapped."""
    return np.array([number % (1 << 64) for number in numbers], np.uint64)


def group_of(signal: str) -> str:
    """Quantity a signal name ends in: `FH_TargetTorque` is TargetTorque, `QuaternionW` is Quaternion."""
    return signal.rsplit("_", 1)[-1].rstrip("WXYZ")


class Codec:
    """Compiled plan for a fixed list of messages; row i of the frames is messages[i].

    Decoded values are ordered signed signals first, then by quantity, then by frame id, whatever the rows' order: the
    positions of twelve joint states are one contiguous slice in joint order.
    """

    def __init__(self, messages: Sequence[Message]) -> None:
        self.messages = tuple(messages)
        self.rows = {message.name: row for row, message in enumerate(self.messages)}
        entries = [(row, m, s) for row, m in enumerate(self.messages) for s in m.signals]
        for _, message, signal in entries:
            if signal.length > _LONGEST or signal.start // 64 != (signal.start + signal.length - 1) // 64:
                raise ValueError(
                    f"{message.name}.{signal.name} is longer than {_LONGEST} bits or crosses a 64-bit word"
                )
        groups = dict.fromkeys((not s.signed, group_of(s.name)) for _, _, s in entries)
        order = {key: place for place, key in enumerate(sorted(groups, key=lambda key: key[0]))}
        entries.sort(key=lambda e: (order[not e[2].signed, group_of(e[2].name)], e[1].frame_id, e[2].start))
        #: (message, signal) in the order of the decoded values.
        self.signals: tuple[tuple[Message, Signal], ...] = tuple((m, s) for _, m, s in entries)
        self.size = len(entries)
        self._index = {(m.name, s.name): i for i, (m, s) in enumerate(self.signals)}
        #: Row of each decoded value.
        self.row_of = np.array([row for row, _, _ in entries], dtype=np.intp)
        self._compile([s for _, _, s in entries])

    def _compile(self, signals: list[Signal]) -> None:
        limits = [sorted(round((x - s.offset) / s.factor) for x in (s.minimum, s.maximum)) for s in signals]
        place = [s.start % 64 for s in signals]
        self._word = np.array(
            [r * WORDS + 1 + s.start // 64 for r, s in zip(self.row_of, signals, strict=True)], np.intp
        )
        self._factor = np.array([s.factor for s in signals])
        self._offset = np.array([s.offset for s in signals])
        self._has_offset = bool(self._offset.any())
        # Decoding happens in place: the code of a signal stays at its bits of a word, counted from the signal's minimum.
        # That needs no shifts, is one comparison for both ends of the range, and is exact in a float.
        at_place = [2.0**p for p in place]
        self._low = _words(low << p for (low, _), p in zip(limits, place, strict=True))
        self._mask_at = _words((1 << s.length) - 1 << p for s, p in zip(signals, place, strict=True))
        self._span = _words(high - low << p for (low, high), p in zip(limits, place, strict=True))
        largest = [(1 << s.length - s.signed) - 1 for s in signals]
        self._top = _words(end - low << p for end, (low, _), p in zip(largest, limits, place, strict=True))
        self._turn = np.array([float(1 << s.length) for s in signals]) * at_place
        in_codes = [s.offset / s.factor for s in signals]
        exact = all(c == round(c) and round(c) * s.factor == s.offset for c, s in zip(in_codes, signals, strict=True))
        self._base = np.array([low + exact * c for (low, _), c in zip(limits, in_codes, strict=True)]) * at_place
        self._weight = self._factor / at_place
        self._separate_offset = self._has_offset and not exact
        self._raw = np.empty(self.size, np.uint64)
        self._outside = np.empty(self.size, np.bool_)
        self._all_inside = bytes(self.size)
        self._inside = True
        self._raw_min = np.array([float(low) for low, _ in limits])
        self._raw_max = np.array([float(high) for _, high in limits])
        # Encoding: scaled values to masked raw bits, in word order, or-ed together word by word.
        by_word = np.argsort(self._word, kind="stable")
        self._by_word = by_word
        self._mask = np.array([(1 << s.length) - 1 for s in signals], np.uint64)
        self._place = np.array([s.start % 64 for s in signals], np.uint64)[by_word]
        words = self._word[by_word]
        self._word_start = np.flatnonzero(np.diff(words, prepend=-1))
        self._word_target = words[self._word_start]
        self._scaled = np.empty(self.size)
        self._bits = self._scaled.view(np.uint64)
        self._sorted = np.empty(self.size, np.uint64)
        self._round = np.array([_ROUND - exact * code for code in in_codes])
        self._lowest = np.full(self.size, _ROUND).view(np.uint64) + _words(low for low, _ in limits)
        self._range = _words(high - low for low, high in limits)
        self._distance = np.empty(self.size, np.uint64)
        self._beyond = np.empty(self.size, np.bool_)
        # Decoding one row alone: place of the value, bits, largest code, range, scale.
        self._one_by_one: list[list[tuple[int, int, int, int, int, int, float, float]]] = [[] for _ in self.messages]
        for i, (row, s, (low, high)) in enumerate(zip(self.row_of.tolist(), signals, limits, strict=True)):
            plan = (i, s.start, (1 << s.length) - 1, largest[i], low, high, s.factor, s.offset)
            self._one_by_one[row].append(plan)
        self._invalid_codes = [
            [(s.start, (1 << s.length) - 1, s.invalid_raw) for s in m.signals if s.invalid_raw is not None]
            for m in self.messages
        ]
        self._invalid = np.array([s.invalid_raw or 0 for s in signals], np.uint64)
        self._no_invalid = [s.invalid_raw is None for s in signals]

    def index(self, message: str, signal: str) -> int:
        """Place of one signal in the decoded values.

        Raises:
            KeyError: with what there is.
        """
        try:
            return self._index[message, signal]
        except KeyError:
            raise KeyError(f"no signal {message}.{signal}; messages are {', '.join(self.rows)}") from None

    def slice(self, group: str) -> slice:
        """Where the values of a quantity are, of all messages by frame id; see `group_of`.

        Raises:
            KeyError: no such quantity, or it is signed in one message and unsigned in another.
        """
        places = [i for i, (_, s) in enumerate(self.signals) if group_of(s.name) == group]
        if not places or places[-1] - places[0] + 1 != len(places):
            known = dict.fromkeys(group_of(s.name) for _, s in self.signals)
            raise KeyError(f"no contiguous quantity {group!r}; there are {', '.join(known)}")
        return slice(places[0], places[-1] + 1)

    def template(self) -> Frames:
        """Frames of these messages with identifier, length and flags set and an empty payload. Shape (rows,)."""
        frames = new_frames(len(self.messages))
        for row, message in enumerate(self.messages):
            frames[row]["can_id"], frames[row]["len"] = message.frame_id, message.length
            frames[row]["flags"] = FLAG_FDF | FLAG_BRS
        return frames

    def extract(self, words: Words) -> bool:
        """First half of decoding: codes out of the payload words, counted from each signal's minimum.

        Args:
            words: flat view of the frames, shape (rows * 9,).

        Returns:
            Whether every signal is inside its DBC range (an invalid code is outside it).
        """
        # Results as positional arguments: a fifth faster than `out=`.
        raw = self._raw
        words.take(self._word, None, raw, "clip")
        np.subtract(raw, self._low, raw)
        np.bitwise_and(raw, self._mask_at, raw)
        # One comparison for both ends: below the minimum has wrapped around to beyond the maximum.
        np.greater(raw, self._span, self._outside)
        self._inside = self._outside.tobytes() == self._all_inside
        return self._inside

    def rows_outside(self) -> list[int]:
        """Rows with a signal outside its range, of the last `extract`."""
        return sorted(set(self.row_of[self._outside].tolist()))

    def scale(self, out: Vector) -> None:
        """Second half of decoding: codes of the last `extract` to physical values. Shape (size,)."""
        out[...] = self._raw
        np.add(out, self._base, out)
        if not self._inside:
            wrapped = self._raw > self._top
            out[wrapped] -= self._turn[wrapped]
        np.multiply(out, self._weight, out)
        if self._separate_offset:
            np.add(out, self._offset, out)

    def decode(self, frames: Frames, out: Vector) -> bool:
        """Physical values of all signals of the rows. Shape (size,), DBC units.

        Returns:
            Whether every signal is inside its DBC range.
        """
        inside = self.extract(frames.view(np.uint64))
        self.scale(out)
        return inside

    def decode_row(self, row: int, payload: bytes, out: Vector) -> bool:
        """The values of one message alone, signal by signal: for a handful of signals cheaper than array operations.

        Args:
            payload: of the message's length.
            out: shape (size,), DBC units; other messages' values and those of a message outside its range stay.

        Returns:
            Whether every signal is inside its DBC range.
        """
        bits = int.from_bytes(payload, "little")
        values = []
        for place, start, mask, largest, low, high, factor, offset in self._one_by_one[row]:
            code = bits >> start & mask
            if code > largest:  # of a signed signal: negative
                code -= mask + 1
            if not low <= code <= high:
                return False
            values.append((place, code * factor + offset))
        for place, value in values:
            out[place] = value
        return True

    def says_invalid(self, row: int, payload: bytes) -> bool:
        """Whether a signal of one message carries its invalid code. `payload`: of the message's length."""
        bits = int.from_bytes(payload, "little")
        return any(bits >> start & mask == code for start, mask, code in self._invalid_codes[row])

    def encode(self, values: Vector, frames: Frames) -> None:
        """Write physical values into the payloads; reserved bits become 0. Shape (size,), DBC units.

        A value outside its range is sent as the nearest valid one, NaN as the signal's invalid code.

        Raises:
            ValueError: NaN for a signal without an invalid code.
        """
        self.pack(values, frames.view(np.uint64))

    def pack(self, values: Vector, words: Words) -> None:
        """As `encode`, into a flat view of the frames made beforehand. Shape (rows * 9,)."""
        scaled, bits = self._scaled, self._bits
        shifted = np.subtract(values, self._offset, scaled) if self._separate_offset else values
        np.divide(shifted, self._factor, scaled)
        np.add(scaled, self._round, scaled)
        # One comparison for both ends, infinities and NaN: as numbers of bits all are far beyond the maximum.
        np.subtract(bits, self._lowest, self._distance)
        np.greater(self._distance, self._range, self._beyond)
        if self._beyond.tobytes() != self._all_inside:
            self._round_nearest(values)
        np.bitwise_and(bits, self._mask, bits)
        bits.take(self._by_word, None, self._sorted, "clip")
        np.left_shift(self._sorted, self._place, self._sorted)
        words[self._word_target] = np.bitwise_or.reduceat(self._sorted, self._word_start)

    def _round_nearest(self, values: Vector) -> None:
        """Codes as `pack` needs them, when there are values outside their range or NaN."""
        codes = (values - self._offset) / self._factor
        no_value = np.isnan(codes)
        for i in np.flatnonzero(no_value).tolist():
            if self._no_invalid[i]:
                message, signal = self.signals[i]
                raise ValueError(f"{message.name}.{signal.name} is NaN and has no invalid code in the DBC")
        np.add(np.clip(codes, self._raw_min, self._raw_max), _ROUND, self._scaled)
        self._bits[no_value] = self._invalid[no_value]
