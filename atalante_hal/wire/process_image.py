"""Process image: the last good copy of every message, and whether it may be trusted.

`ReceiveImage` takes the frames of a cycle as the bus delivered them and commits a message only if identifier, length,
CRC, counter and range hold; otherwise its values stay, its age grows and its check says why. `TransmitImage` is the
mirror: values in, protected frames out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message
from atalante_hal.compiled import compiled
from atalante_hal.wire.codec import (
    INSIDE,
    NO_CODE,
    SAYS_INVALID,
    Codec,
    Vector,
    Words,
    encode,
    read_codes,
    read_row,
    scale,
    scale_row,
)
from atalante_hal.wire.e2e import (
    COUNTER_BYTE,
    NOTHING,
    Check,
    Octets,
    checksum,
    intact,
    judge_counter,
    protect,
    protected_spans,
)
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES, WORDS, Frames, as_words, new_frames

#: In the place of a cycle tag: the senders count for themselves.
_NO_TAG = -1
#: `Check`s as plain integers; up to the first, data is new.
_FRESH = _SOME_LOST = int(Check.SOME_LOST)
_REPEATED, _CONFLICT, _WRONG_SEQUENCE = int(Check.REPEATED), int(Check.CONFLICT), int(Check.WRONG_SEQUENCE)
_CRC, _LENGTH, _RANGE, _INVALID = int(Check.CRC), int(Check.LENGTH), int(Check.RANGE), int(Check.INVALID)
#: Checks of frames that say nothing, or nothing that the accepted frame has not said.
_SAYS_NOTHING_NEW = frozenset({Check.CRC, Check.LENGTH, Check.REPEATED})
#: In the place of a row: the frame is no message of the image.
_FOREIGN = -1
#: Age of a message that never came.
NEVER = 1 << 30
#: Oldest answer [cycles] that is taken for a late one; what is older was replayed.
LATEST = 16
#: Half a turn of the counter: what seems further ahead is behind, unless the row was silent for as long.
_HALF_TURN = 128


class ReceiveImage:
    """The messages of one rate, received: values, and per row check and age.

    `values` is shape (codec.size,) in DBC units and keeps the last good values; `check` and `age` are per row.

    A node answers a SYNC under the counter that is the low byte of the SYNC's Cycle, the cycle tag. An image that is told the
    cycle it is in counts age from the SYNC a frame answers, however late it came.

    Args:
        restarts: the senders may begin anew at any counter (status, emergencies): only the last frame again is refused. A
            frame with the last counter and other bytes is committed, and listed in `refused` as a CONFLICT all the same.
    """

    def __init__(self, messages: Sequence[Message], values: Vector | None = None, *, restarts: bool = False) -> None:
        self.codec = Codec(messages)
        count = len(self.codec.messages)
        self.values = np.full(self.codec.size, np.nan) if values is None else values
        #: `Check` of the cycle, shape (rows,).
        self.check: npt.NDArray[np.uint8] = np.full(count, Check.NO_DATA, np.uint8)
        #: Cycles since the row was committed, shape (rows,).
        self.age: npt.NDArray[np.int64] = np.full(count, NEVER)
        self.crc_errors = 0
        #: What was not committed in this cycle: row and why, one entry a frame.
        self.refused: list[tuple[int, Check]] = []
        self._restarts = restarts
        #: The last frame of each row with the right format, CRC and sequence, shape (rows,).
        self.frames = self.codec.template()
        self._kept: Octets = self.frames.view(np.uint8)
        self._headers: Words = as_words(self.frames)[:, 0].astype(np.int64)
        self._expected_headers = self._headers.tobytes()
        self.frame_ids = {message.frame_id: row for row, message in enumerate(self.codec.messages)}
        self._spans = protected_spans(self.codec.messages)
        #: Counter the next frame of each row should carry.
        self._expected: Words = np.full(count, NOTHING)
        #: Cycles since that counter moved, shape (rows,).
        self._silent: Words = np.zeros(count, np.int64)
        #: The values before the last `accept`.
        self.values_before = self.values.copy()
        self._age_before: npt.NDArray[np.int64] = self.age.copy()
        #: The last cycle was perfect: every row was committed exactly as expected.
        self.all_fresh = self._was_fresh = False
        #: The frames of the last `accept_each`, and of each its row and `Check`.
        self._offered: tuple[Frames, Words] | None = None
        self._ordered = _Received(new_frames(count), count)
        self._received = self._ordered
        self._accept_exact, self._accept_frames = compiled(accept_exact), compiled(accept_frames)
        # Nothing; from now on it is machine code.
        self._accept(self._ordered, None)
        self.accept_each(self._ordered.frames, 0)

    def new_cycle(self, elapsed: int = 1) -> None:
        """`elapsed` cycles have begun: until something arrives, every row is that much older and has no data."""
        self.all_fresh = False
        self.age += elapsed
        self._silent += elapsed
        self.check.fill(Check.NO_DATA)
        self.refused = []

    def accept(self, frames: Frames, count: int, tag: int | None = None) -> Sequence[int]:
        """One whole cycle: judge and commit `frames[:count]`, in whatever order they came.

        Args:
            frames: receive buffer, the same array every cycle.
            tag: low byte of this cycle's number, when the senders answer a SYNC; None: they count for themselves.

        Returns:
            Places in `frames` of the frames that are no message of this image.
        """
        rows = len(self._headers)
        row_of = self.frame_ids
        self._was_fresh = self.all_fresh
        if not self._was_fresh:
            self._age_before[:] = self.age
        if (count == rows or (count > rows and row_of.keys().isdisjoint(frames["can_id"][rows:count].tolist()))) and (
            self._accept(self._received_in(frames), tag)
        ):
            return range(rows, count)
        if count >= rows:
            found = [row_of.get(can_id, -1) for can_id in frames["can_id"][:count].tolist()]
            foreign = [place for place, row in enumerate(found) if row < 0]
            if len(foreign) == count - rows and len(set(found) - {-1}) == rows:
                # Everything is there once, among others or in another order: several buses, or arbitration.
                self._ordered.words[:] = as_words(frames)[np.argsort(found)[count - rows :]].view(np.int64).ravel()
                if self._accept(self._ordered, tag):
                    return foreign
        self.new_cycle()
        return self.accept_each(frames, count, tag)

    def refuse(self, row: int) -> None:
        """What `accept` just committed cannot be true: the row keeps the values it had before, and is a cycle older."""
        mine = self.codec.row_of == row
        self.values[mine] = self.values_before[mine]
        self.age[row] = 1 if self._was_fresh else self._age_before[row] + 1
        self.check[row] = Check.IMPLAUSIBLE
        self.all_fresh = False

    def begins(self, frames: Frames, count: int) -> bool:
        """Whether `frames[:count]` begin with every message of this image, in order: then a cycle is complete."""
        return count >= len(self._headers) and self._received_in(frames).headers.tobytes() == self._expected_headers

    def expected_ids(self) -> set[int]:
        """Identifiers of the messages whose senders are alive: heard within the DBC's timeout."""
        ages = self.age.tolist()
        return {m.frame_id for row, m in enumerate(self.codec.messages) if ages[row] <= m.timeout_ms}

    def _received_in(self, frames: Frames) -> _Received:
        if self._received.frames is not frames:
            self._received = _Received(frames, len(self._headers))
        return self._received

    def _accept(self, received: _Received, tag: int | None) -> bool:
        """Fast path: replaces `new_cycle` and `accept_each` for a perfect cycle; otherwise False, and nothing is changed."""
        if not self._accept_exact(
            received.words,
            received.octets,
            self._headers,
            self._spans,
            self._expected,
            _NO_TAG if tag is None else tag,
            self.codec.plan,
            self.codec.scales,
            self.codec.codes,
            self.values,
            self.values_before,
            self._kept,
        ):
            return False
        self._offered = None
        if not self.all_fresh:
            self.age.fill(0)
            self._silent.fill(0)
            self.check.fill(Check.OK)
            self.refused = []
            self.all_fresh = True
        return True

    def accept_each(self, frames: Frames, count: int, tag: int | None = None) -> list[int]:
        """Slow path: judge frames one by one in order of arrival, decode and commit the good ones. Call `new_cycle` before.

        Returns:
            Places in `frames[:count]` of the frames that are no message of this image.
        """
        self.values_before[:] = self.values
        found: Words = np.full((count, 2), _FOREIGN)
        codec = self.codec
        self._accept_frames(
            frames.view(np.int64),
            frames.view(np.uint8),
            found,
            self._headers,
            self._spans,
            self._expected,
            self._silent,
            _NO_TAG if tag is None else tag,
            self._restarts,
            codec.plan,
            codec.scales,
            codec.signals_by_row,
            codec.row_begins,
            codec.codes,
            self.values,
            self.age,
            self.check,
            self._kept,
        )
        self._offered = frames, found
        foreign = []
        for place, (row, check) in enumerate(found.tolist()):
            if row == _FOREIGN:
                foreign.append(place)
            elif check > _FRESH:
                self.refused.append((row, Check(check)))
                self.crc_errors += check == _CRC
        return foreign

    def beside(self, row: int) -> list[Vector]:
        """Decode the other intact frames of a row that came in this cycle beside the one committed last.

        Repetitions of an accepted frame are left out. Call it before the receive buffer is used again.

        Returns:
            `values` with the row's signals as each of the frames has them, in order of arrival. Shape (codec.size,) each, DBC
            units; the signals may be outside their range.
        """
        if self._offered is None:
            return []
        frames, found = self._offered
        mine = [(place, check) for place, (of, check) in enumerate(found.tolist()) if of == row]
        committed = max((place for place, check in mine if check <= _FRESH), default=None)
        return [
            self._decoded(frames, place, row)
            for place, check in mine
            if place != committed and check not in _SAYS_NOTHING_NEW
        ]

    def _decoded(self, frames: Frames, place: int, row: int) -> Vector:
        codec, codes, values = self.codec, np.zeros_like(self.codec.codes), self.values.copy()
        signals = codec.signals_by_row[codec.row_begins[row] : codec.row_begins[row + 1]]
        read_row(frames.view(np.int64), (place - row) * WORDS, signals, codec.plan, codes)
        scale_row(codes, signals, codec.scales, values)
        return values


class _Received:
    """Views of the first rows of a receive buffer, made once: what the fast path reads every cycle."""

    def __init__(self, frames: Frames, rows: int) -> None:
        self.frames = frames
        head = frames[:rows]
        self.words: Words = head.view(np.int64)
        self.octets: Octets = head.view(np.uint8)
        self.headers = as_words(head)[:, 0]


def accept_exact(
    words: Words,
    octets: Octets,
    headers: Words,
    spans: Words,
    expected: Words,
    tag: int,
    plan: Words,
    scales: Vector,
    codes: Words,
    values: Vector,
    values_before: Vector,
    kept: Octets,
) -> bool:
    """Commit rows that are exactly the expected messages, in order, intact, in sequence, in range and of this cycle.

    Args:
        words, octets: views of the frames received, shapes (rows * 9,) and (rows * 72,).
        headers: first word of each message, shape (rows,).
        spans: of `e2e.protected_spans`.
        expected: counter of each row, shape (rows,); moved on.
        tag: counter all have to carry, or `_NO_TAG`.
        plan, scales, codes: of the codec.
        values, values_before: shape (size,); the new ones, and what they were.
        kept: the last accepted frames, shape (rows * 72,); rewritten.

    Returns:
        Whether they were; if not, nothing was changed.
    """
    for row in range(len(headers)):
        if words[row * WORDS] != headers[row] or (tag != _NO_TAG and expected[row] != tag):
            return False
    if not (intact(octets, spans, expected) and read_codes(words, plan, codes)):
        return False
    values_before[:] = values
    scale(codes, scales, values)
    kept[:] = octets
    for row in range(len(headers)):
        expected[row] = expected[row] + 1 & 0xFF
    return True


def accept_frames(
    words: Words,
    octets: Octets,
    found: Words,
    headers: Words,
    spans: Words,
    expected: Words,
    silent: Words,
    tag: int,
    restarts: bool,
    plan: Words,
    scales: Vector,
    signals_by_row: Words,
    row_begins: Words,
    codes: Words,
    values: Vector,
    age: Words,
    check: Octets,
    kept: Octets,
) -> None:
    """Judge frames one by one in order of arrival and commit the good ones.

    Args:
        words, octets: flat views of the frames received.
        found: row of each frame, or `_FOREIGN`, and its `Check`; rewritten, shape (count, 2).
        silent: cycles since `expected` of each row moved, shape (rows,).
        tag: counter all should carry, or `_NO_TAG`; the other arguments as for `accept_exact`, and of `ReceiveImage`.
    """
    for place in range(len(found)):
        first = place * WORDS
        row = row_of(words[first], headers)
        found[place, 0] = row
        if row == _FOREIGN:
            continue
        behind = (place - row) * FRAME_BYTES
        result = judge_frame(words, octets, row, behind, headers, spans, expected, silent, tag, restarts, kept)
        new = result <= _FRESH or (restarts and result == _CONFLICT)
        signals = signals_by_row[row_begins[row] : row_begins[row + 1]]
        if new:
            said = read_row(words, first - row * WORDS, signals, plan, codes)
            if said != INSIDE:
                new, result = False, _INVALID if said == SAYS_INVALID else _RANGE
        found[place, 1] = result
        if new:
            scale_row(codes, signals, scales, values)
            counter = int(octets[spans[row, 0] + behind + COUNTER_BYTE])
            age[row] = 0 if tag == _NO_TAG else tag - counter & 0xFF
            check[row] = min(result, _SOME_LOST)
        elif check[row] > _FRESH:
            check[row] = result


def row_of(header: int, headers: Words) -> int:
    """Row of the message with the identifier of a frame, or `_FOREIGN`."""
    for row in range(len(headers)):
        if headers[row] & 0xFFFFFFFF == header & 0xFFFFFFFF:
            return row
    return _FOREIGN


def judge_frame(
    words: Words,
    octets: Octets,
    row: int,
    behind: int,
    headers: Words,
    spans: Words,
    expected: Words,
    silent: Words,
    tag: int,
    restarts: bool,
    kept: Octets,
) -> int:
    """`Check` of a frame's format, CRC and counter; moves `expected` on and keeps the frame when its counter moved.

    Args:
        behind: bytes it stands behind its row's place.
        kept: the last accepted frames, shape (rows * 72,); the other arguments as for `accept_frames`.
    """
    begin, end, data_id = spans[row, 0] + behind, spans[row, 1] + behind, spans[row, 2]
    if words[(begin - HEADER_BYTES) // 8] != headers[row]:
        return _LENGTH
    crc = checksum(octets, begin, end, data_id)
    if octets[begin] != crc & 0xFF or octets[begin + 1] != crc >> 8:
        return _CRC
    counter = int(octets[begin + COUNTER_BYTE])
    in_time = tag == _NO_TAG or tag - counter & 0xFF < LATEST
    # After half a turn of silence a counter says nothing about the order; an answer to a SYNC of the last cycles is a new one.
    back = tag != _NO_TAG and in_time and expected[row] != NOTHING and silent[row] >= _HALF_TURN
    result = judge_counter(expected[row], counter)
    if back and result == _REPEATED:
        result = _WRONG_SEQUENCE
    if result == _REPEATED:
        if (octets[begin:end] == kept[spans[row, 0] : spans[row, 1]]).all():
            return _REPEATED
        if not restarts:
            return _CONFLICT
        result = _CONFLICT
    elif tag != _NO_TAG and not back:
        # An answer to no SYNC of the last cycles, or older than what is known already, says nothing about what comes next.
        backwards = expected[row] != NOTHING and counter - expected[row] + 1 & 0xFF >= _HALF_TURN
        if not in_time or backwards:
            return _WRONG_SEQUENCE
    expected[row], silent[row] = counter + 1 & 0xFF, 0
    head = row * FRAME_BYTES
    kept[head : head + FRAME_BYTES] = octets[head + behind : head + behind + FRAME_BYTES]
    return _SOME_LOST if result == _WRONG_SEQUENCE and restarts else result


class TransmitImage:
    """Messages to send: write `values`, call `seal`, send `frames`."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self.codec = Codec(messages)
        self.values = np.zeros(self.codec.size)
        self.frames = self.codec.template()
        self._words: Words = self.frames.view(np.int64)
        self._octets: Octets = self.frames.view(np.uint8)
        self._spans = protected_spans(self.codec.messages)
        rows = len(self.codec.messages)
        self._counters: Words = np.zeros(rows, np.int64)
        self._singles = [self.frames[row : row + 1] for row in range(rows)]
        self._seal, self._protect = compiled(seal), compiled(protect)
        # Nothing; from now on it is machine code.
        self._protect(self._octets, self._spans, self._counters)
        self.seal(0xFF)

    def seal(self, counter: int | None = None) -> Frames:
        """Encode the values and protect every row with counter and CRC. Returns the frames to send, shape (rows,).

        Args:
            counter: alive counter of every row; None: one more than the last.

        Raises:
            ValueError: NaN for a signal without an invalid code.
        """
        codec = self.codec
        nameless = self._seal(
            self.values,
            codec.plan,
            codec.scales,
            codec.words,
            codec.codes,
            self._words,
            self._octets,
            self._spans,
            self._counters,
            _NO_TAG if counter is None else counter,
        )
        if nameless != NO_CODE:
            codec.require_code(nameless)
        return self.frames

    @property
    def counter(self) -> int:
        """Alive counter of the last `seal`."""
        return int(self._counters[0])

    def prepare(self) -> bytes:
        """Payloads of the values as they are now, for `seal_prepared`."""
        self.codec.encode(self.values, self.frames)
        return self._octets.tobytes()

    def seal_prepared(self, prepared: bytes) -> Frames:
        """As `seal`, of payloads encoded beforehand: nothing that went wrong since can spoil them."""
        self._octets[:] = np.frombuffer(prepared, np.uint8)
        self._counters[:] = self._counters + 1 & 0xFF
        self._protect(self._octets, self._spans, self._counters)
        return self.frames

    def seal_row(self, row: int) -> Frames:
        """As `seal` for one row alone, the counters of the others stay. Shape (1,)."""
        self.codec.encode(self.values, self.frames)
        self.resume(row, int(self._counters[row]) + 1 & 0xFF)
        self._protect(self._octets, self._spans, self._counters)
        return self._singles[row]

    def resume(self, row: int, counter: int) -> None:
        """Go on after the frame with this alive counter, which another sender of the row sent."""
        self._counters[row] = counter


def seal(
    values: Vector,
    plan: Words,
    scales: Vector,
    targets: Words,
    codes: Words,
    words: Words,
    octets: Octets,
    spans: Words,
    counters: Words,
    counter: int,
) -> int:
    """Encode the values and protect every row: `codec.encode`, then `e2e.protect`; arguments and result are theirs.

    Args:
        counter: of every row, or `_NO_TAG`: one more than its last.
    """
    nameless = encode(values, plan, scales, targets, codes, words)
    if nameless == NO_CODE:
        for row in range(len(counters)):
            counters[row] = counters[row] + 1 & 0xFF if counter == _NO_TAG else counter
        protect(octets, spans, counters)
    return nameless
