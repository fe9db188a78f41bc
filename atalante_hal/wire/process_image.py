"""Process image: the last good values of every message, with their age and the result of the last check.

`ReceiveImage` processes the frames of a cycle in order of arrival. It commits a message only if identifier, length,
CRC, alive counter and signal ranges are correct. Otherwise the message keeps its previous values, their age grows, and
the check result of the message gives the reason. If only a signal range is wrong, the independent signals of the frame are
committed, for example the state of a drive that marks its position as invalid.

`TransmitImage` encodes values into protected frames to be sent.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message
from atalante_hal.compiled import specialised
from atalante_hal.types import Vector
from atalante_hal.wire.codec import (
    HIGH,
    INSIDE,
    LOW,
    MARKED_INVALID,
    NO_CODE,
    Codec,
    SignalTable,
    Words,
    encode,
    group_of,
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
    classify_counter,
    intact,
    protect,
    protected_spans,
)
from atalante_hal.wire.frame import (
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    HEADER_BYTES,
    WORDS,
    Frames,
    as_words,
    header_word,
    new_frames,
)

#: Bits in the header word of a frame. `_ESI`: flag ESI, the sender is error passive.
#: `_PASSIVE`: flags ESI and FDF, a CAN FD frame from an error passive sender.
_PASSIVE, _ESI = header_word(0, 0, FLAG_ESI | FLAG_FDF), header_word(0, 0, FLAG_ESI)
#: Value of the argument `tag` for senders that do not answer a SYNC. Each of these senders counts its own frames.
#: For senders that answer a SYNC, `tag` is the alive counter expected in this cycle.
_NO_TAG = -1
#: Values of `Check` as plain integers. A value of at most `_FRESH` means new, usable data.
_FRESH = _SOME_LOST = int(Check.SOME_LOST)
_REPEATED, _CONFLICT, _WRONG_SEQUENCE = int(Check.REPEATED), int(Check.CONFLICT), int(Check.WRONG_SEQUENCE)
_NO_DATA = int(Check.NO_DATA)
_CRC, _LENGTH, _RANGE, _INVALID = int(Check.CRC), int(Check.LENGTH), int(Check.RANGE), int(Check.INVALID)
#: Check results of frames that contain no new values: damaged frames and repeats of the accepted frame.
_NO_NEW_VALUES = frozenset({Check.CRC, Check.LENGTH, Check.REPEATED})
#: Check results of frames that were rejected only because a signal is out of its range.
_OUT_OF_RANGE = frozenset({Check.RANGE, Check.INVALID})
#: Row number of a frame whose message is not in this process image.
_FOREIGN = -1
#: Age of a message that has never been received [cycles].
NEVER = 1 << 30
#: Smallest age, counted from its SYNC, at which an answer is rejected as a replayed frame [cycles].
_TOO_OLD = 16
#: Half the period of the 8-bit alive counter. A frame is old if (its counter - last accepted counter) mod 256 is at least 128.
#: Example: (250 - 5) mod 256 is 245, so counter 250 is older than 5. After 128 cycles without a frame, this comparison may err.
_HALF_TURN = 128


class E2EState(NamedTuple):
    """State of the E2E check: expected format, expected counter and last frame of each row of a process image.

    The `ReceiveImage` owns the arrays. The arrays `headers` and `spans` are constant. The other arrays change with
    every accepted frame. In addition, `silent` grows in cycles without an accepted frame.
    """

    headers: Words  # (rows,) header word of the message: identifier, length and flags
    spans: Words  # (rows, 3) begin and end of the payload [bytes] and Data ID, see `e2e.protected_spans`
    expected: Words  # (rows,) expected counter of the next frame; `NOTHING` before the first frame
    silent: Words  # (rows,) cycles since the last change of the expected counter
    kept: Octets  # (rows * 72,) last frame with correct format, correct CRC and accepted counter, see `classify_frame`


class RowStatus(NamedTuple):
    """Age and check result of each row of a process image in this cycle.

    The `ReceiveImage` owns the arrays.
    """

    age: Words  # (rows,) age of the values [cycles]
    check: Octets  # (rows,) value of `Check`


class ReceiveImage:
    """Process image of received messages: the values of all signals, and the check result and age of each row.

    `values` are the last good values, shape (codec.size,), in DBC units. `check` and `age` have one element per row.

    A node answers each SYNC with a frame whose alive counter is the tag of the cycle: the low byte of the signal Cycle in the
    SYNC. If the caller passes the tag of the current cycle, the age of the values is counted from the SYNC that their frame
    answers, even if the frame arrives late.

    Args:
        messages: messages of this process image, one per row.
        values: array for the decoded values, shape (codec.size,). By default, a new array of NaN is created.
        restarts: True if a sender may restart at any counter (status, emergencies). In this case the counter leads to a
            rejection only if a frame repeats the last frame. A frame that has the counter of the last frame but
            other bytes is committed, and also listed in `refused` as CONFLICT.
        independent: quantities (see `codec.group_of`) whose signals are committed even if another signal of the frame is out of
            its range. The age and the check result of the message do not change.
    """

    def __init__(
        self,
        messages: Sequence[Message],
        values: Vector | None = None,
        *,
        restarts: bool = False,
        independent: Collection[str] = (),
    ) -> None:
        self.codec = Codec(messages)
        count = len(self.codec.messages)
        self.values = np.full(self.codec.size, np.nan) if values is None else values
        #: `Check` of each row in this cycle, shape (rows,).
        self.check: npt.NDArray[np.uint8] = np.full(count, Check.NO_DATA, np.uint8)
        #: Age of the values of each row [cycles], shape (rows,).
        #: If `refuse` has restored earlier values of a row, the age of the row is the age of these earlier values.
        self.age: npt.NDArray[np.int64] = np.full(count, NEVER)
        self.crc_errors = 0
        #: Row and `Check` of each frame that was rejected in this cycle.
        #: If the argument `restarts` is True, the list also contains the committed frames with the check result CONFLICT.
        self.refused: list[tuple[int, Check]] = []
        #: Row of each frame with the flag ESI (its sender is error passive) in this cycle. Damaged frames are included.
        self.error_passive: list[int] = []
        self._restarts = restarts
        is_independent = np.array([group_of(signal.name) in independent for _, signal in self.codec.signals])
        #: Indices of the independent signals of each row in `values`.
        self._independent = [np.flatnonzero(is_independent & (self.codec.row_of == row)) for row in range(count)]
        #: For each row, the last frame with correct format, correct CRC and accepted counter, see `classify_frame`.
        self.frames = self.codec.template()
        self._e2e = E2EState(
            headers=as_words(self.frames)[:, 0].astype(np.int64),
            spans=protected_spans(self.codec.messages),
            expected=np.full(count, NOTHING),
            silent=np.zeros(count, np.int64),
            kept=self.frames.view(np.uint8),
        )
        self._status = RowStatus(self.age, self.check)
        self._expected_headers = self._e2e.headers.tobytes()
        self.frame_ids = {message.frame_id: row for row, message in enumerate(self.codec.messages)}
        #: Values before the last `accept`, shape (codec.size,).
        self.values_before = self.values.copy()
        self._age_before: npt.NDArray[np.int64] = self.age.copy()
        #: True if the last `accept` found the expected frame of every message, without an error (a perfect cycle).
        self.all_fresh = self._was_fresh = False
        #: Frames given to the last `accept_each`, with the row and `Check` of each frame. None after a perfect cycle.
        self._offered: tuple[Frames, Words] | None = None
        self._ordered = _Received(new_frames(count), count)
        self._received = self._ordered
        # Compile the functions for the types of these arguments. No frames have been received, so the calls change nothing.
        words, table = self._ordered.words, self.codec.table
        self._accept_exact = specialised(
            accept_exact, words, self._e2e, _NO_TAG, table, self.values, self.values_before
        )
        self._accept_frames = specialised(
            accept_frames, words, _results(0), self._e2e, _NO_TAG, restarts, table, self.values, self._status
        )
        self._begin_cycle = specialised(begin_cycle, self._e2e, self._status, 0)

    def new_cycle(self, elapsed: int = 1) -> None:
        """Begin a new cycle: increase the age of every row, and set the check result of every row to NO_DATA.

        Args:
            elapsed: number of cycles since the last call.
        """
        self.all_fresh = False
        self._begin_cycle(self._e2e, self._status, elapsed)
        self.refused, self.error_passive = [], []

    def accept(self, frames: Frames, count: int, tag: int | None = None) -> Sequence[int]:
        """Check and commit all frames of one cycle, in any order.

        Args:
            frames: receive buffer, the same array in every cycle.
            count: number of received frames at the start of the buffer.
            tag: low byte of the cycle number if the senders answer a SYNC; None if each sender uses its own counter.

        Returns:
            Indices in `frames` of the frames that are not messages of this process image.
        """
        rows = len(self.check)
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
            foreign = [index for index, row in enumerate(found) if row < 0]
            if len(foreign) == count - rows and len(set(found) - {-1}) == rows:
                # Every message arrived once, but in another order than the rows or mixed with other frames. Sort the messages.
                self._ordered.words[:] = as_words(frames)[np.argsort(found)[count - rows :]].view(np.int64).ravel()
                if self._accept(self._ordered, tag):
                    return foreign
        self.new_cycle()
        return self.accept_each(frames, count, tag)

    def refuse(self, row: int, signals: npt.NDArray[np.intp]) -> None:
        """Reject implausible values of a row that `accept` has committed: restore the previous values of these signals.

        The other signals of the message keep their new values.

        Args:
            row: row of the message. From now on, its age is the age of the restored values: one cycle more than before `accept`.
            signals: indices of the implausible signals in `values`, shape (n,).
        """
        self.values[signals] = self.values_before[signals]
        self.age[row] = 1 if self._was_fresh else self._age_before[row] + 1
        self.check[row] = Check.IMPLAUSIBLE
        self.all_fresh = False

    def restart(self, row: int) -> None:
        """Accept any alive counter in the next frame of a row. Call this when the sender of this message has restarted.

        Otherwise the first frame of the restarted sender is rejected as REPEATED if it equals the last frame before the restart.

        Args:
            row: row of the message.
        """
        self._e2e.expected[row] = NOTHING

    def begins(self, frames: Frames, count: int) -> bool:
        """Return whether the buffer begins with one frame of each message, in the order of `messages`.

        In this case no message is missing. Only the headers are compared: identifier, length and flags.

        Args:
            frames: receive buffer.
            count: number of received frames at the start of the buffer.
        """
        return count >= len(self.check) and self._received_in(frames).headers.tobytes() == self._expected_headers

    def expected_ages(self) -> dict[int, int]:
        """Return the age [cycles] of each message that is not older than its DBC timeout, by frame identifier."""
        ages = zip(self.codec.messages, self.age.tolist(), strict=True)
        return {m.frame_id: age for m, age in ages if age <= m.timeout_ms}

    def _received_in(self, frames: Frames) -> _Received:
        if self._received.frames is not frames:
            self._received = _Received(frames, len(self.check))
        return self._received

    def _accept(self, received: _Received, tag: int | None) -> bool:
        """Commit all rows in one pass if every expected frame arrived in order and without an error (a perfect cycle).

        This fast path replaces `new_cycle` and `accept_each`, which check the frames one by one.

        Args:
            received: frames of the cycle.
            tag: low byte of the cycle number, or None.

        Returns:
            Whether the cycle was perfect; if not, nothing is changed.
        """
        cycle_tag = _NO_TAG if tag is None else tag
        if not self._accept_exact(
            received.words, self._e2e, cycle_tag, self.codec.table, self.values, self.values_before
        ):
            return False
        self._offered = None
        if not self.all_fresh:
            self.age.fill(0)
            self._e2e.silent.fill(0)
            self.check.fill(Check.OK)
            self.refused, self.error_passive = [], []
            self.all_fresh = True
        return True

    def accept_each(self, frames: Frames, count: int, tag: int | None = None) -> list[int]:
        """Check the frames one by one in order of arrival, and commit the good frames. Call `new_cycle` first.

        A sender that is error passive sets the flag ESI of its frames. Its frames are valid, so this flag is removed from the
        received frames, and the rows are added to `error_passive`.

        Args:
            frames: receive buffer.
            count: number of received frames at the start of the buffer.
            tag: low byte of the cycle number if the senders answer a SYNC; None if each sender uses its own counter.

        Returns:
            Indices in `frames` of the frames that are not messages of this process image.
        """
        self.values_before[:] = self.values
        found = _results(count)
        self._accept_frames(
            _words_of(frames),
            found,
            self._e2e,
            _NO_TAG if tag is None else tag,
            self._restarts,
            self.codec.table,
            self.values,
            self._status,
        )
        self._offered = frames, found
        foreign = []
        #: For each row: index of its last frame that was rejected only because a value is out of range.
        outside: dict[int, int] = {}
        for index, (row, check, passive) in enumerate(found.tolist()):
            if row == _FOREIGN:
                foreign.append(index)
                continue
            if passive:
                self.error_passive.append(row)
            if check > _FRESH:
                self.refused.append((row, Check(check)))
                self.crc_errors += check == _CRC
                if check in _OUT_OF_RANGE:
                    outside[row] = index
        for row, index in outside.items():
            if self.check[row] > _FRESH:  # no other frame of this row was accepted in this cycle
                self._commit_independent(frames, index, row)
        return foreign

    def _commit_independent(self, frames: Frames, index: int, row: int) -> None:
        """Commit the independent signals of a frame that are inside their ranges.

        Args:
            frames: receive buffer.
            index: index of the frame in the receive buffer.
            row: row of its message.
        """
        values, codes = self._decoded(frames, index, row)
        own, plan = self._independent[row], self.codec.table.plan
        inside = own[(plan[LOW, own] <= codes[own]) & (codes[own] <= plan[HIGH, own])]
        self.values[inside] = values[inside]

    def decode_further_frames(self, row: int) -> list[Vector]:
        """Decode those intact frames of a message in this cycle that are not stored in `values`.

        Repetitions of an accepted frame are left out. Call this method before the receive buffer is used again.

        Args:
            row: row of the message.

        Returns:
            A copy of `values` for each of these frames, in order of arrival, with the signals of the row taken from the frame.
            Shape (codec.size,) each, in DBC units; the signals may be outside their range.
        """
        if self._offered is None:
            return []
        frames, found = self._offered
        mine = [(index, check) for index, (of, check, _) in enumerate(found.tolist()) if of == row]
        committed = max((index for index, check in mine if check <= _FRESH), default=None)
        return [
            self._decoded(frames, index, row)[0]
            for index, check in mine
            if index != committed and check not in _NO_NEW_VALUES
        ]

    def _decoded(self, frames: Frames, index: int, row: int) -> tuple[Vector, Words]:
        """Decode one row from frame `index` of the receive buffer.

        Returns:
            A copy of `values` with the signals of the row, and the raw codes of these signals. Shape (codec.size,) each.
        """
        table = self.codec.table._replace(codes=np.zeros_like(self.codec.table.codes))
        values = self.values.copy()
        read_row(frames.view(np.int64), (index - row) * WORDS, row, table)
        scale_row(row, table, values)
        return values, table.codes


class _Received:
    """Views of the frames at the beginning of a receive buffer, created once. The fast path reads the views in every cycle.

    Args:
        frames: receive buffer.
        rows: number of rows to view.
    """

    def __init__(self, frames: Frames, rows: int) -> None:
        self.frames = frames
        head = frames[:rows]
        self.words = _words_of(head)
        self.headers = as_words(head)[:, 0]


def _words_of(frames: Frames) -> Words:
    """Return the frames as a flat array of 64-bit words, because the compiled functions accept no other array type."""
    return frames.view(np.int64).ravel()


def _results(count: int) -> Words:
    """Return an uninitialized array for the results of `accept_frames`, shape (count, 3)."""
    return np.empty((count, 3), np.int64)


def accept_exact(
    words: Words, e2e: E2EState, tag: int, table: SignalTable, values: Vector, values_before: Vector
) -> bool:
    """Commit all rows at once if the frames are in row order and every frame passes all checks; otherwise commit none.

    Frame i must have identifier, length and flags of row i, a correct CRC, the expected counter, and every signal in its range.
    With a tag, the expected counter must also equal the tag, because each frame must answer the SYNC of this cycle.

    Args:
        words: received frames as a flat array of 64-bit words, shape (rows * 9,).
        e2e: expected format and counter of each row; the counters are increased by 1, and the frames are stored in `kept`.
        tag: counter that all frames must have, or `_NO_TAG`.
        table: signals of the codec; `codes` is overwritten.
        values: decoded values, shape (size,), in DBC units; overwritten with the new values.
        values_before: output for the previous values, shape (size,).

    Returns:
        Whether the frames were committed; if not, nothing is changed except `table.codes`.
    """
    octets, headers, expected = words.view(np.uint8), e2e.headers, e2e.expected
    for row in range(len(headers)):
        if words[row * WORDS] != headers[row] or (tag != _NO_TAG and expected[row] != tag):
            return False
    if not (intact(octets, e2e.spans, expected) and read_codes(words, table)):
        return False
    copy(values, 0, values_before)
    scale(table, values)
    copy(words, 0, e2e.kept.view(np.int64))
    for row in range(len(headers)):
        expected[row] = expected[row] + 1 & 0xFF
    return True


def begin_cycle(e2e: E2EState, status: RowStatus, elapsed: int) -> None:
    """Increase the age of every row, and set the check result of every row to NO_DATA.

    The age of a row that has received a frame stays below `NEVER`.

    Args:
        e2e: `silent` of each row is increased.
        status: age and check result of each row; overwritten.
        elapsed: number of cycles since the last call.
    """
    for row in range(len(status.age)):
        age = status.age[row]
        status.age[row] = age + elapsed if age >= NEVER else min(age + elapsed, NEVER - 1)
        e2e.silent[row] += elapsed
        status.check[row] = _NO_DATA


def accept_frames(
    words: Words,
    found: Words,
    e2e: E2EState,
    tag: int,
    restarts: bool,
    table: SignalTable,
    values: Vector,
    status: RowStatus,
) -> None:
    """Check frames one by one in order of arrival, and commit the good frames.

    The flag ESI of a frame from an error passive sender is removed first.

    Args:
        words: received frames as a flat array of 64-bit words, shape (at least count * 9,).
        found: output, shape (count, 3): row and `Check` of each frame, and 1 if its sender is error passive, otherwise 0. Row and
            check are `_FOREIGN` if the frame has no row.
        e2e: expected format and counter of each row; the counters are updated with each accepted frame.
        tag: expected counter of all frames in this cycle, or `_NO_TAG`.
        restarts: True if a sender may restart at any counter.
        table: signals of the codec; `codes` is updated.
        values: decoded values, shape (size,), in DBC units; updated.
        status: age and check result of each row; updated.
    """
    octets, age, check = words.view(np.uint8), status.age, status.check
    for index in range(len(found)):
        first = index * WORDS
        passive = words[first] & _PASSIVE == _PASSIVE
        if passive:
            words[first] ^= _ESI
        found[index, 2] = passive
        row = row_of(words[first], e2e.headers)
        found[index, 0], found[index, 1] = row, _FOREIGN
        if row == _FOREIGN:
            continue
        offset = (index - row) * FRAME_BYTES
        result = classify_frame(words, row, offset, e2e, tag, restarts)
        new = result <= _FRESH or (restarts and result == _CONFLICT)
        if new:
            coding = read_row(words, first - row * WORDS, row, table)
            if coding != INSIDE:
                new, result = False, _INVALID if coding == MARKED_INVALID else _RANGE
        found[index, 1] = result
        if new:
            scale_row(row, table, values)
            counter = int(octets[e2e.spans[row, 0] + offset + COUNTER_BYTE])
            age[row] = 0 if tag == _NO_TAG else tag - counter & 0xFF
            check[row] = min(result, _SOME_LOST)
        elif check[row] > _FRESH:
            check[row] = result


def row_of(header: int, headers: Words) -> int:
    """Return the row of the message that has the identifier of a frame, or `_FOREIGN`.

    Args:
        header: header word of the frame.
        headers: header word of each message, shape (rows,).
    """
    for row in range(len(headers)):
        if headers[row] & 0xFFFFFFFF == header & 0xFFFFFFFF:
            return row
    return _FOREIGN


def classify_frame(words: Words, row: int, offset: int, e2e: E2EState, tag: int, restarts: bool) -> int:
    """Check format, CRC and counter of a frame.

    If the counter is accepted, the expected counter is updated and the frame is stored in `kept`. A counter that jumped forward
    is also accepted: the result is WRONG_SEQUENCE, but the next frame continues from this counter.

    Args:
        words: received frames as a flat array of 64-bit words.
        row: row of the message of the frame.
        offset: position of the frame, relative to the position of its row in the frame array [bytes].
        e2e: expected format and counter of each row; updated if the counter is accepted.
        tag: expected counter of all frames in this cycle, or `_NO_TAG`.
        restarts: True if a sender may restart at any counter.

    Returns:
        Value of `Check` as a plain integer.
    """
    octets, headers, spans = words.view(np.uint8), e2e.headers, e2e.spans
    expected, silent, kept = e2e.expected, e2e.silent, e2e.kept
    begin, end, data_id = spans[row, 0] + offset, spans[row, 1] + offset, spans[row, 2]
    if words[(begin - HEADER_BYTES) // 8] != headers[row]:
        return _LENGTH
    crc = checksum(octets, begin, end, data_id)
    if octets[begin] != crc & 0xFF or octets[begin + 1] != crc >> 8:
        return _CRC
    counter = int(octets[begin + COUNTER_BYTE])
    in_time = tag == _NO_TAG or tag - counter & 0xFF < _TOO_OLD
    # `back` is True if no frame was accepted for at least 128 cycles, and this frame answers one of the last 16 SYNCs.
    # Then every counter is accepted: after 128 cycles, a comparison with the last counter does not show whether a frame is new.
    back = tag != _NO_TAG and in_time and expected[row] != NOTHING and silent[row] >= _HALF_TURN
    result = classify_counter(expected[row], counter)
    if back and result == _REPEATED:
        result = _WRONG_SEQUENCE
    if result == _REPEATED:
        if equal(octets, begin, kept[spans[row, 0] : spans[row, 1]]):
            return _REPEATED
        if not restarts:
            return _CONFLICT
        result = _CONFLICT
    elif tag != _NO_TAG and not back:
        # Reject a frame that answers no recent SYNC, and a frame that is older than the last accepted frame.
        # A rejected frame does not change the expected counter.
        backwards = expected[row] != NOTHING and counter - expected[row] + 1 & 0xFF >= _HALF_TURN
        if not in_time or backwards:
            return _WRONG_SEQUENCE
    expected[row], silent[row] = counter + 1 & 0xFF, 0
    head = row * FRAME_BYTES
    copy(octets, head + offset, kept[head : head + FRAME_BYTES])
    return _SOME_LOST if result == _WRONG_SEQUENCE and restarts else result


# numba creates a temporary array for `target[:] = source` and for `first == second`, so the next two functions are loops.


def copy(source: Vector | Words | Octets, begin: int, target: Vector | Words | Octets) -> None:
    """Copy elements of an array to another array.

    Args:
        source: array to copy from.
        begin: index of the first element to copy.
        target: output, shape (n,); receives the next n elements of `source`.
    """
    for i in range(len(target)):
        target[i] = source[begin + i]


def equal(octets: Octets, begin: int, others: Octets) -> bool:
    """Return whether a part of a byte array has the same bytes as another array.

    Args:
        octets: array with the part to compare.
        begin: index of the first byte to compare.
        others: bytes to compare with, shape (n,).
    """
    same = True
    for i in range(len(others)):
        same &= octets[begin + i] == others[i]
    return bool(same)


class TransmitImage:
    """Process image of messages to send: write `values`, call `seal`, send `frames`.

    Args:
        messages: messages of this process image, one per row.
    """

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
        # `specialised` runs `seal` once with the counter 0xFF. So the first frame that is sent has the counter 0.
        self._protect = specialised(protect, self._octets, self._spans, self._counters)
        self._seal = specialised(seal, self.values, self.codec.table, self._words, self._spans, self._counters, 0xFF)

    def seal(self, counter: int | None = None) -> Frames:
        """Encode the values and protect every row with counter and CRC.

        Args:
            counter: alive counter of every row, 0 to 255. With None, each row gets its last counter plus 1.

        Returns:
            The frames to send, shape (rows,).

        Raises:
            ValueError: If the value of a signal without an invalid code is NaN.
        """
        codec = self.codec
        tag = _NO_TAG if counter is None else counter
        unencodable = self._seal(self.values, codec.table, self._words, self._spans, self._counters, tag)
        if unencodable != NO_CODE:
            codec.require_code(unencodable)
        return self.frames

    @property
    def counter(self) -> int:
        """Return the last alive counter of the first row."""
        return int(self._counters[0])

    def prepare(self) -> bytes:
        """Return the frames with the current values as bytes, for a later `seal_prepared`."""
        self.codec.encode(self.values, self.frames)
        return self._octets.tobytes()

    def seal_prepared(self, prepared: bytes) -> Frames:
        """Add counter and CRC to frames that `prepare` encoded earlier.

        The current `values` are not encoded, so a faulty value such as NaN cannot prevent or change these frames.

        Args:
            prepared: result of `prepare`.

        Returns:
            The frames to send, shape (rows,), each with its last counter plus 1.
        """
        self._octets[:] = np.frombuffer(prepared, np.uint8)
        self._counters[:] = self._counters + 1 & 0xFF
        self._protect(self._octets, self._spans, self._counters)
        return self.frames

    def seal_row(self, row: int) -> Frames:
        """Return the frame of one row to send. The counter of the frame is the last counter of the row plus 1.

        The counters of the other rows do not change.

        Args:
            row: row of the message.

        Returns:
            The frame to send, shape (1,).
        """
        self.codec.encode(self.values, self.frames)
        self._counters[row] = self._counters[row] + 1 & 0xFF
        self._protect(self._octets, self._spans, self._counters)
        return self._singles[row]

    def set_counter(self, row: int, counter: int) -> None:
        """Set the last counter of a row. The next frame of the row has this counter plus 1; 0 follows 255.

        Args:
            row: row of the message.
            counter: alive counter, 0 to 255.
        """
        self._counters[row] = counter


def seal(values: Vector, table: SignalTable, words: Words, spans: Words, counters: Words, counter: int) -> int:
    """Encode the values and protect every row with counter and CRC.

    Args:
        values: physical values, shape (size,), in DBC units.
        table: signals of the codec; `codes` is overwritten.
        words: frames as a flat array of 64-bit words, shape (rows * 9,); overwritten.
        spans: result of `e2e.protected_spans`, shape (rows, 3).
        counters: last counter of each row, shape (rows,); updated.
        counter: new counter of every row, or `_NO_TAG` for the last counter of each row plus 1.

    Returns:
        `NO_CODE`, or the index of a signal that could not be encoded, see `codec.encode`. In that case no frame is changed.
    """
    unencodable = encode(values, table, words)
    if unencodable == NO_CODE:
        for row in range(len(counters)):
            counters[row] = counters[row] + 1 & 0xFF if counter == _NO_TAG else counter
        protect(words.view(np.uint8), spans, counters)
    return unencodable
