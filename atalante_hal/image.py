"""Process image: the last good copy of every message, and whether it may be trusted.

`ReceiveImage` takes the frames of a cycle as the bus delivered them and commits a message only if identifier, length,
CRC, counter and range hold; otherwise its values stay, its age grows and its check says why. `TransmitImage` is the
mirror: values in, protected frames out.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message
from atalante_hal.codec import Codec, Vector
from atalante_hal.e2e import COUNTER_BYTE, CRC_BYTES, CRC_START, Check, check_counter, crc, data_id_bytes
from atalante_hal.frame import FRAME_BYTES, WORDS, Frames, as_words, new_frames

_HEADER_BYTES = 8
#: Counter byte -> the next one.
_NEXT = bytes((counter + 1) & 0xFF for counter in range(256))
#: Largest `Check` whose data is new, as a plain integer.
_FRESH = int(Check.SOME_LOST)
#: Age of a message that never came.
NEVER = 1 << 30
#: Oldest answer [cycles] that is taken for a late one; what is older was replayed.
LATEST = 16
_HALF_TURN = 128  # of the counter: what seems further ahead than this is behind


class ReceiveImage:
    """The messages of one rate, received: values, and per row check and age.

    `values` is shape (codec.size,) in DBC units and keeps the last good values; `check` and `age` are per row.

    A node answers a SYNC under the counter that is the low byte of the SYNC's Cycle, the cycle tag. An image that is told the
    cycle it is in counts age from the SYNC a frame answers, however late it came.

    Args:
        restarts: the senders may begin anew at any counter (status, emergencies): only the last one again is refused.
    """

    def __init__(self, messages: Sequence[Message], values: Vector | None = None, *, restarts: bool = False) -> None:
        self.codec = Codec(messages)
        count = len(self.codec.messages)
        self.values = np.full(self.codec.size, np.nan) if values is None else values
        #: `Check` of the cycle, shape (rows,).
        self.check: npt.NDArray[np.uint8] = np.full(count, Check.NO_DATA, np.uint8)
        #: Cycles since the row was committed, shape (rows,).
        self.age: npt.NDArray[np.int64] = np.full(count, NEVER, np.int64)
        self.crc_errors = 0
        #: What was not committed in this cycle: row and why, one entry a frame.
        self.refused: list[tuple[int, Check]] = []
        self._restarts = restarts
        self.frames = self.codec.template()
        self._words = self.frames.view(np.uint64)
        self._bytes = self.frames.view(np.uint8)
        self._headers = as_words(self.frames)[:, 0].tolist()
        self._row_of_header = {header: row for row, header in enumerate(self._headers)}
        self.frame_ids = {message.frame_id: row for row, message in enumerate(self.codec.messages)}
        self._data_ids = [data_id_bytes(m.data_id) for m in self.codec.messages]
        self._lengths = [m.length for m in self.codec.messages]
        self._counter: list[int | None] = [None] * count
        self._expected_headers = as_words(self.frames)[:, 0].tobytes()
        self._expected_counters: bytes | None = None
        self._counters_of = [bytes([tag]) * count for tag in range(256)]
        #: The values before the last `accept`.
        self.values_before = self.values.copy()
        self._age_before: npt.NDArray[np.int64] = self.age.copy()
        #: The last cycle was perfect: every row was committed exactly as expected.
        self.all_fresh = self._was_fresh = False
        self._scratch: _Scratch | None = None
        self._ordered = _Scratch(new_frames(count), self.codec.messages)

    def new_cycle(self, elapsed: int = 1) -> None:
        """`elapsed` cycles have begun: until something arrives, every row is that much older and has no data."""
        self.all_fresh = False
        self.age += elapsed
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
            self.accept_exact(self._scratch_of(frames), tag)
        ):
            return range(rows, count)
        if count >= rows:
            found = [row_of.get(can_id, -1) for can_id in frames["can_id"][:count].tolist()]
            foreign = [place for place, row in enumerate(found) if row < 0]
            if len(foreign) == count - rows and len(set(found) - {-1}) == rows:
                # Everything is there once, among others or in another order: several buses, or arbitration.
                self._ordered.words[:] = as_words(frames)[np.argsort(found, kind="stable")[count - rows :]].reshape(-1)
                if self.accept_exact(self._ordered, tag):
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
        return count >= len(self._headers) and self._scratch_of(frames).headers.tobytes() == self._expected_headers

    def awaited(self) -> set[int]:
        """Identifiers of the messages whose senders are alive: heard within the DBC's timeout."""
        ages = zip(self.codec.messages, self.age.tolist(), strict=True)
        return {message.frame_id for message, age in ages if age <= message.timeout_ms}

    def _scratch_of(self, frames: Frames) -> _Scratch:
        if self._scratch is None or self._scratch.frames is not frames:
            self._scratch = _Scratch(frames, self.codec.messages)
        return self._scratch

    def accept_exact(self, scratch: _Scratch, tag: int | None = None) -> bool:
        """Fast path: the rows are exactly the expected messages, in order, intact, in sequence and of this cycle.

        Replaces `new_cycle` and `accept_each` for a perfect cycle; otherwise returns False and changes nothing.
        """
        expected = self._expected_counters or self._next_counters()
        if tag is not None and expected != self._counters_of[tag]:
            return False
        if scratch.headers.tobytes() != self._expected_headers or scratch.e2e.counters.tobytes() != expected:
            return False
        if scratch.e2e.checksums() != scratch.e2e.crcs.tolist():
            return False
        if not self.codec.extract(scratch.words):
            return False
        self.values_before[:] = self.values
        self.codec.scale(self.values)
        self._bytes[:] = scratch.bytes
        self._expected_counters = expected.translate(_NEXT)
        if not self.all_fresh:
            self.age.fill(0)
            self.check.fill(Check.OK)
            self.refused = []
            self.all_fresh = True
        return True

    def accept_each(self, frames: Frames, count: int, tag: int | None = None) -> list[int]:
        """Slow path: judge frames one by one in order of arrival, decode and commit the good ones. Call `new_cycle` before.

        Returns:
            Places in `frames[:count]` of the frames that are no message of this image.
        """
        self._synchronise_counters()
        self.values_before[:] = self.values
        foreign: list[int] = []
        checks, words = self.check, as_words(frames)
        for place, header in enumerate(words[:count, 0].tolist()):
            row = self._row_of_header.get(header)
            if row is None:
                row = self.frame_ids.get(header & 0xFFFFFFFF)
                if row is None:
                    foreign.append(place)
                else:
                    self._refuse_frame(row, Check.LENGTH)
                continue
            payload = words[place].tobytes()[_HEADER_BYTES : _HEADER_BYTES + self._lengths[row]]
            result = self._judge(row, payload, tag)
            if result <= _FRESH and not self.codec.decode_row(row, payload, self.values):
                result = Check.INVALID if self.codec.says_invalid(row, payload) else Check.RANGE
            if result > _FRESH:
                self._refuse_frame(row, result)
                continue
            self._words[row * WORDS : (row + 1) * WORDS] = words[place]
            self.age[row] = 0 if tag is None else tag - payload[COUNTER_BYTE] & 0xFF
            checks[row] = result
        return foreign

    def _refuse_frame(self, row: int, why: Check) -> None:
        self.refused.append((row, why))
        if self.check[row] > _FRESH:
            self.check[row] = why

    def _judge(self, row: int, payload: bytes, tag: int | None) -> Check:
        if crc(payload[CRC_BYTES:], self._data_ids[row]) != int.from_bytes(payload[:CRC_BYTES], "little"):
            self.crc_errors += 1
            return Check.CRC
        counter, last = payload[COUNTER_BYTE], self._counter[row]
        result = check_counter(last, counter)
        if tag is not None and result is not Check.REPEATED:
            # An answer to no SYNC of the last cycles, or older than what is known already, says nothing about what comes next.
            behind = last is not None and counter - last & 0xFF >= _HALF_TURN
            if tag - counter & 0xFF >= LATEST or behind:
                return Check.WRONG_SEQUENCE
        self._counter[row] = counter
        return Check.SOME_LOST if result is Check.WRONG_SEQUENCE and self._restarts else result

    def _synchronise_counters(self) -> None:
        """Take over what the fast path counted."""
        if self._expected_counters is not None:
            self._counter = [(c - 1) & 0xFF for c in self._expected_counters]
            self._expected_counters = None

    def _next_counters(self) -> bytes:
        """What the fast path is to expect after the slow one; empty while a message was never received."""
        return bytes((c + 1) & 0xFF for c in self._counter if c is not None) if None not in self._counter else b""


class E2eFields:
    """Where CRC, counter and what the CRC covers lie in the rows of an array of frames: views, made once."""

    def __init__(self, frames: Frames, messages: Sequence[Message]) -> None:
        octets = frames.view(np.uint8)
        rows = octets.reshape(-1, FRAME_BYTES)
        self.counters = rows[:, _HEADER_BYTES + COUNTER_BYTE]
        self.crcs = frames.view(np.uint16).reshape(-1, FRAME_BYTES // 2)[:, _HEADER_BYTES // 2]
        # The CRC ends with the Data ID. Put into the unused bytes behind the payload, it costs no call of its own; a payload
        # of 64 bytes leaves none.
        protected: list[memoryview] = []
        parked: list[int] = []
        ids = b""
        self._rest: list[tuple[int, bytes]] = []
        for row, message in enumerate(messages):
            data_id, end = data_id_bytes(message.data_id), _HEADER_BYTES + message.length
            if end + len(data_id) <= FRAME_BYTES:
                parked += range(row * FRAME_BYTES + end, row * FRAME_BYTES + end + len(data_id))
                ids, end = ids + data_id, end + len(data_id)
            else:
                self._rest.append((row, data_id))
            protected.append(rows[row].data[_HEADER_BYTES + CRC_BYTES : end])
        self._octets, self._parked, self._ids = octets, np.array(parked, np.intp), np.frombuffer(ids, np.uint8)
        self._protected, self._starts = protected, [CRC_START] * len(protected)

    def checksums(self) -> list[int]:
        """What the CRC of each row should be."""
        self._octets[self._parked] = self._ids
        checksums = list(map(crc_hqx, self._protected, self._starts))
        for row, data_id in self._rest:
            checksums[row] = crc_hqx(data_id, checksums[row])
        return checksums


class _Scratch:
    """Views of the first rows of a receive buffer, made once: what the fast path reads every cycle."""

    def __init__(self, frames: Frames, messages: Sequence[Message]) -> None:
        self.frames = frames
        head = frames[: len(messages)]
        self.words = head.view(np.uint64)
        self.bytes = head.view(np.uint8)
        self.headers = as_words(head)[:, 0]
        self.e2e = E2eFields(head, messages)


class TransmitImage:
    """Messages to send: write `values`, call `seal`, send `frames`."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self.codec = Codec(messages)
        self.values = np.zeros(self.codec.size)
        self.frames = self.codec.template()
        self._words = self.frames.view(np.uint64)
        self._octets = self.frames.view(np.uint8)
        self._e2e = E2eFields(self.frames, self.codec.messages)
        rows = len(self.codec.messages)
        self._counters = [0xFF] * rows
        self._in_step = True  # all rows have the counter of the first: none was ever sealed alone
        self._singles = [self.frames[row : row + 1] for row in range(rows)]

    def seal(self, counter: int | None = None) -> Frames:
        """Encode the values and protect every row with counter and CRC. Returns the frames to send, shape (rows,).

        Args:
            counter: alive counter of every row; None: one more than the last.

        Raises:
            ValueError: NaN for a signal without an invalid code.
        """
        self.codec.pack(self.values, self._words)
        self._protect(counter)
        return self.frames

    @property
    def counter(self) -> int:
        """Alive counter of the last `seal`."""
        return self._counter_of(0)

    def prepare(self) -> bytes:
        """Payloads of the values as they are now, for `seal_prepared`."""
        self.codec.pack(self.values, self._words)
        return self._octets.tobytes()

    def seal_prepared(self, prepared: bytes) -> Frames:
        """As `seal`, of payloads encoded beforehand: nothing that went wrong since can spoil them."""
        self._octets[:] = np.frombuffer(prepared, np.uint8)
        self._protect(None)
        return self.frames

    def _protect(self, counter: int | None) -> None:
        if counter is not None:
            self._counters, self._in_step = [counter] * len(self._counters), True
        elif self._in_step:
            counter = self._counters[0] = (self._counters[0] + 1) & 0xFF
        else:
            self._counters = [(counter + 1) & 0xFF for counter in self._counters]
        if counter is None:
            self._e2e.counters[:] = self._counters
        else:
            self._e2e.counters.fill(counter)
        self._e2e.crcs[:] = self._e2e.checksums()

    def seal_row(self, row: int) -> Frames:
        """As `seal` for one row alone, the counters of the others stay. Shape (1,)."""
        self.codec.pack(self.values, self._words)
        self.resume(row, self._counter_of(row) + 1 & 0xFF)
        self._e2e.counters[:] = self._counters
        self._e2e.crcs[:] = self._e2e.checksums()
        return self._singles[row]

    def resume(self, row: int, counter: int) -> None:
        """Go on after the frame with this alive counter, which another sender of the row sent."""
        self._counters = [self._counter_of(other) for other in range(len(self._counters))]
        self._counters[row], self._in_step = counter, False

    def _counter_of(self, row: int) -> int:
        return self._counters[0 if self._in_step else row]
