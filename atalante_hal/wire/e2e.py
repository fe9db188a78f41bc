"""AUTOSAR E2E Profile 5: a CRC over payload and Data ID, and an alive counter, in every frame.

The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) over the payload behind the CRC field, then the Data ID low byte
first: a frame that is damaged, cut, or sent under another identifier does not pass. The counter tells lost, repeated and
replayed frames (AUTOSAR PRS_E2EProtocol, Profile 5).
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc import Message
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES

Octets = npt.NDArray[np.uint8]
Words = npt.NDArray[np.int64]

CRC_START = 0xFFFF
#: Offsets in the payload.
CRC_BYTES = 2
COUNTER_BYTE = 2
#: Largest step of the counter that still counts as fresh data: up to four frames in a row may be lost.
MAX_DELTA = 5


class Check(IntEnum):
    """Result of checking one message in one cycle; `fresh` says whether its data may be used as new."""

    OK = 0
    SOME_LOST = 1  # fresh, but 1 to 4 frames before it are missing
    NO_DATA = 2  # nothing came
    REPEATED = 3  # counter has not moved, and the frame is the one accepted last
    CONFLICT = 4  # counter has not moved, and the frame has other bytes than the one accepted last
    WRONG_SEQUENCE = 5  # counter jumped: replayed, or more than 4 lost
    CRC = 6  # damaged, or another message's data
    LENGTH = 7  # length or frame format is not the DBC's
    RANGE = 8  # a signal is outside its range
    INVALID = 9  # a signal carries its invalid code: the node says that it has no value
    IMPLAUSIBLE = 10  # the frame is right and what it says cannot be true

    @property
    def fresh(self) -> bool:
        """The data is new and may be used."""
        return self <= Check.SOME_LOST


def data_id_bytes(data_id: int) -> bytes:
    """Data ID as it enters the CRC: low byte first."""
    return data_id.to_bytes(2, "little")


def crc(protected: bytes | memoryview, data_id: bytes) -> int:
    """CRC of a frame.

    Args:
        protected: the payload from behind the CRC field to its end.
        data_id: of `data_id_bytes`.
    """
    return crc_hqx(data_id, crc_hqx(protected, CRC_START))


#: What a byte at the head of the CRC makes of it.
_TABLE = np.array([crc_hqx(bytes([octet]), 0) for octet in range(256)], np.int64)


def protected_spans(messages: Sequence[Message]) -> Words:
    """Where the payload of each row of frames begins and ends, and its Data ID. Shape (rows, 3)."""
    spans = []
    for row, message in enumerate(messages):
        begin = row * FRAME_BYTES + HEADER_BYTES
        spans.append((begin, begin + message.length, message.data_id))
    return np.array(spans)


def checksum(octets: Octets, begin: int, end: int, data_id: int) -> int:
    """CRC of the payload `octets[begin:end]`, as `crc`: for loops that are compiled."""
    remainder = CRC_START
    for i in range(begin + CRC_BYTES, end):
        remainder = (remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ octets[i]]
    remainder = (remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ data_id & 0xFF]
    return int((remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ data_id >> 8])


def intact(octets: Octets, spans: Words, counters: Words) -> bool:
    """Whether every row of frames carries its counter and the CRC of what it says.

    Args:
        octets: flat view of the frames, shape (rows * 72,).
        spans: of `protected_spans`.
        counters: shape (rows,).
    """
    for row in range(len(spans)):
        begin, end, data_id = spans[row]
        crc = checksum(octets, begin, end, data_id)
        if (
            octets[begin + COUNTER_BYTE] != counters[row]
            or octets[begin] != crc & 0xFF
            or octets[begin + 1] != crc >> 8
        ):
            return False
    return True


def protect(octets: Octets, spans: Words, counters: Words) -> None:
    """Write counter and CRC into every row of frames. Arguments as for `intact`."""
    for row in range(len(spans)):
        begin, end, data_id = spans[row]
        octets[begin + COUNTER_BYTE] = counters[row]
        crc = checksum(octets, begin, end, data_id)
        octets[begin], octets[begin + 1] = crc & 0xFF, crc >> 8


#: In the place of the counter that is expected: nothing was ever received.
NOTHING = -1
_OK, _SOME_LOST, _REPEATED, _WRONG_SEQUENCE = map(
    int, (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.WRONG_SEQUENCE)
)


def judge_counter(expected: int, received: int) -> int:
    """As `check_counter`, the result as a plain integer: for loops that are compiled.

    Args:
        expected: one more than the last counter accepted, or `NOTHING`.
    """
    skipped = received - expected & 0xFF
    if expected == NOTHING or skipped == 0:
        return _OK
    if skipped == 0xFF:
        return _REPEATED
    return _SOME_LOST if skipped < MAX_DELTA else _WRONG_SEQUENCE


def check_counter(last: int | None, received: int) -> Check:
    """Judge an alive counter against the last one accepted; None: nothing was received before."""
    return Check(judge_counter(NOTHING if last is None else last + 1 & 0xFF, received))


#: The leaky bucket of a message: a bad cycle fills it, a good one empties it, and full it trips. Steady loss above a fifth trips.
BAD_CYCLE, GOOD_CYCLE, FULL = 4, 1, 64
#: Good cycles in a row after which a message is trusted (again): no flapping. A pendant presses nothing before.
REQUALIFY = 16
#: What a cycle with a frame of a second sender adds to the evidence of one; a cycle without takes `GOOD_CYCLE` away. Confirmed
#: at `FULL`: four cycles in a row. A takeover between two pendants overlaps by two.
RIVAL_CYCLE = 16


class Qualification(NamedTuple):
    """How far the sender of a message is trusted."""

    bucket: int = 0
    good: int = 0  # cycles in a row, counted up to `REQUALIFY`
    trusted: bool = False


#: Further good cycles change nothing.
SETTLED = Qualification(0, REQUALIFY, True)


def qualify(before: Qualification, *, good: bool, timed_out: bool = False) -> Qualification:
    """Qualification after one more cycle.

    Args:
        good: new and intact data came.
        timed_out: the data is as old as its timeout, or its sender is not the only one: trust is lost at once.
    """
    if timed_out:
        return Qualification(before.bucket, 0, False)
    if not good:
        bucket = min(before.bucket + BAD_CYCLE, FULL)
        return Qualification(bucket, 0, before.trusted and bucket < FULL)
    in_row = min(before.good + 1, REQUALIFY)
    now = Qualification(max(before.bucket - GOOD_CYCLE, 0), in_row, before.trusted or in_row == REQUALIFY)
    return SETTLED if now == SETTLED else now


def suspect(evidence: int, *, rival: bool) -> int:
    """Return the evidence of two senders of one message after one more cycle, 0 to `FULL`.

    Args:
        evidence: of the cycle before.
        rival: a frame came in this cycle that the sender of the accepted frame cannot have sent.
    """
    return min(evidence + RIVAL_CYCLE, FULL) if rival else max(evidence - GOOD_CYCLE, 0)
