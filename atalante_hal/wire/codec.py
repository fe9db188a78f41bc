"""Array codec: every signal of a set of messages decoded or encoded in one pass of machine code.

The plan (word, place, mask, range, factor) is made from the DBC once. It works because no signal crosses a 64-bit word of the
payload: a signal is one word, a shift and a mask, one add and one multiply.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message, Signal
from atalante_hal.compiled import compiled
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, WORDS, Frames, new_frames

Vector = npt.NDArray[np.float64]
Words = npt.NDArray[np.int64]

#: Rows of a plan, one column a signal: where it stands and which codes it may have.
WORD, PLACE, MASK, LARGEST, LOW, HIGH, INVALID = range(7)
#: Rows of the scales: what a code means, (code + base) * factor + offset.
BASE, FACTOR, OFFSET = range(3)
#: In the place of an invalid code, or of a signal: there is none.
NO_CODE = -1
#: What `read_row` found.
INSIDE, OUTSIDE, SAYS_INVALID = range(3)
#: Adding this to a float and taking it away again rounds it to an integer.
_ROUND = 1.5 * 2.0**52
_LONGEST = 51  # bits such an integer can have


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
        self._groups = [group_of(s.name) for _, s in self.signals]
        #: Row of each decoded value.
        self.row_of = np.array([row for row, _, _ in entries], dtype=np.intp)
        self._compile([s for _, _, s in entries])

    def _compile(self, signals: list[Signal]) -> None:
        plan, scales = [], []
        for row, s in zip(self.row_of.tolist(), signals, strict=True):
            low, high = sorted(round((x - s.offset) / s.factor) for x in (s.minimum, s.maximum))
            mask, largest = (1 << s.length) - 1, (1 << s.length - s.signed) - 1
            invalid = NO_CODE if s.invalid_raw is None else s.invalid_raw
            plan.append((row * WORDS + 1 + s.start // 64, s.start % 64, mask, largest, low, high, invalid))
            # An offset that is a whole number of codes is added to the code, which is exact.
            code = s.offset / s.factor
            exact = code == round(code) and round(code) * s.factor == s.offset
            scales.append((code, s.factor, 0.0) if exact else (0.0, s.factor, s.offset))
        #: For the loops below: shapes (7, size) and (3, size).
        self.plan: Words = np.array(plan, np.int64).T.copy()
        self.scales: Vector = np.array(scales).T.copy()
        #: Payload words that carry a signal.
        self.words: Words = np.unique(self.plan[WORD])
        #: Raw code of every signal, of the last `decode` or `encode`.
        self.codes = np.zeros(self.size, np.int64)
        self._decode, self._encode = compiled(decode), compiled(encode)
        #: Signals of row r: signals_by_row[row_begins[r] : row_begins[r + 1]], by their place in the decoded values.
        self.signals_by_row: Words = np.argsort(self.row_of, kind="stable").astype(np.int64)
        self.row_begins: Words = np.searchsorted(self.row_of[self.signals_by_row], np.arange(len(self.messages) + 1))

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
        places = [i for i, name in enumerate(self._groups) if name == group]
        if not places or places[-1] - places[0] + 1 != len(places):
            raise KeyError(f"no contiguous quantity {group!r}; there are {', '.join(dict.fromkeys(self._groups))}")
        return slice(places[0], places[-1] + 1)

    def template(self) -> Frames:
        """Frames of these messages with identifier, length and flags set and an empty payload. Shape (rows,)."""
        frames = new_frames(len(self.messages))
        for row, message in enumerate(self.messages):
            frames[row]["can_id"], frames[row]["len"] = message.frame_id, message.length
            frames[row]["flags"] = FLAG_FDF | FLAG_BRS
        return frames

    def decode(self, frames: Frames, out: Vector) -> bool:
        """Physical values of all signals of the rows. Shape (size,), DBC units.

        Returns:
            Whether every signal is inside its DBC range (an invalid code is outside it).
        """
        return self._decode(frames.view(np.int64), self.plan, self.scales, self.codes, out)

    def rows_outside(self) -> list[int]:
        """Rows with a signal outside its range, of the last `decode`."""
        outside = (self.codes < self.plan[LOW]) | (self.codes > self.plan[HIGH])
        return sorted(set(self.row_of[outside].tolist()))

    def encode(self, values: Vector, frames: Frames) -> None:
        """Write physical values into the payloads; reserved bits become 0. Shape (size,), DBC units.

        A value outside its range is sent as the nearest valid one, NaN as the signal's invalid code.

        Raises:
            ValueError: NaN for a signal without an invalid code.
        """
        words = frames.view(np.int64)
        self.require_code(self._encode(values, self.plan, self.scales, self.words, self.codes, words))

    def require_code(self, nameless: int) -> None:
        """Raise `ValueError` for what `encode` returned, unless every value had a code."""
        if nameless != NO_CODE:
            message, signal = self.signals[nameless]
            raise ValueError(f"{message.name}.{signal.name} is NaN and has no invalid code in the DBC")


def decode(words: Words, plan: Words, scales: Vector, codes: Words, values: Vector) -> bool:
    """Raw codes and physical values of all signals; returns whether every code is in its range.

    Args:
        words: flat view of the frames, shape (rows * 9,).
        plan, scales: of the codec.
        codes, values: shape (size,), rewritten.
    """
    inside = read_codes(words, plan, codes)
    scale(codes, scales, values)
    return inside


def read_codes(words: Words, plan: Words, codes: Words) -> bool:
    """First half of decoding: raw codes; returns whether every one is in its range."""
    word, place, mask, largest = plan[WORD], plan[PLACE], plan[MASK], plan[LARGEST]
    low, high = plan[LOW], plan[HIGH]
    inside = True
    for i in range(len(codes)):
        code = codes[i] = signed(words[word[i]] >> place[i] & mask[i], mask[i], largest[i])
        inside &= low[i] <= code <= high[i]
    return inside


def signed(raw: int, mask: int, largest: int) -> int:
    """The code of raw bits: of a signed signal, what is larger than its largest code is negative."""
    return raw - mask - 1 if raw > largest else raw


def scale(codes: Words, scales: Vector, values: Vector) -> None:
    """Second half of decoding: raw codes to physical values."""
    base, factor, offset = scales[BASE], scales[FACTOR], scales[OFFSET]
    for i in range(len(codes)):
        values[i] = (codes[i] + base[i]) * factor[i] + offset[i]


def read_row(words: Words, behind: int, signals: Words, plan: Words, codes: Words) -> int:
    """`read_codes` of one row alone: `INSIDE`, `OUTSIDE`, or `SAYS_INVALID`: outside, and a signal carries its invalid code.

    Args:
        behind: how many words behind its place in the plan the row stands.
        signals: those of the row, places in the decoded values.
    """
    inside, invalid = True, False
    for i in signals:
        raw = words[plan[WORD, i] + behind] >> plan[PLACE, i] & plan[MASK, i]
        invalid |= raw == plan[INVALID, i]
        code = codes[i] = signed(raw, plan[MASK, i], plan[LARGEST, i])
        inside &= plan[LOW, i] <= code <= plan[HIGH, i]
    if inside:
        return INSIDE
    return SAYS_INVALID if invalid else OUTSIDE


def scale_row(codes: Words, signals: Words, scales: Vector, values: Vector) -> None:
    """`scale` of some signals alone."""
    for i in signals:
        values[i] = (codes[i] + scales[BASE, i]) * scales[FACTOR, i] + scales[OFFSET, i]


def encode(values: Vector, plan: Words, scales: Vector, targets: Words, codes: Words, words: Words) -> int:
    """Physical values into the payload words; values outside their range as the nearest valid code, NaN as the invalid one.

    Args:
        targets: payload words that carry a signal; their other bits become 0.
        words: flat view of the frames, shape (rows * 9,).

    Returns:
        `NO_CODE`; or a signal that is NaN and has no invalid code, and then nothing was written.
    """
    base, factor, offset = scales[BASE], scales[FACTOR], scales[OFFSET]
    low, high, invalid = plan[LOW], plan[HIGH], plan[INVALID]
    for i in range(len(codes)):
        # Rounds to even; infinities and NaN stay what they are.
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
    for target in targets:
        words[target] = 0
    word, place, mask = plan[WORD], plan[PLACE], plan[MASK]
    for i in range(len(codes)):
        words[word[i]] |= (codes[i] & mask[i]) << place[i]
    return NO_CODE
