"""AUTOSAR E2E Profile 5, which protects each frame with an alive counter and a CRC over payload and Data ID.

The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, initial value 0xFFFF) over the payload after the CRC field, followed by the Data
ID, low byte first. The CRC detects frames that are damaged, truncated, or sent with a wrong identifier. The alive
counter detects lost, repeated and replayed frames (AUTOSAR PRS_E2EProtocol, Profile 5).
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
#: Length of the CRC field at the start of the payload [bytes].
CRC_BYTES = 2
#: Offset of the alive counter in the payload [bytes].
COUNTER_BYTE = 2
#: Largest increase of the alive counter at which a frame counts as new data. So up to four frames in a row may be lost.
MAX_DELTA = 5


class Check(IntEnum):
    """Result of checking one message in one cycle."""

    OK = 0
    SOME_LOST = 1  # new data, but the 1 to 4 previous frames were lost
    NO_DATA = 2  # no frame was received
    REPEATED = 3  # same counter and same bytes as the last accepted frame
    CONFLICT = 4  # same counter as the last accepted frame, but other bytes
    WRONG_SEQUENCE = 5  # the counter jumped: the frame is old, or more than 4 frames are missing
    CRC = 6  # wrong CRC: the frame is damaged or belongs to another message
    LENGTH = 7  # length or frame format differs from the DBC
    RANGE = 8  # a signal is outside its DBC range
    INVALID = 9  # a signal has its invalid code, because the node has no value for the signal
    IMPLAUSIBLE = 10  # the frame is intact, but its values are physically impossible

    @property
    def fresh(self) -> bool:
        """Return whether the data is new and may be used."""
        return self <= Check.SOME_LOST


def data_id_bytes(data_id: int) -> bytes:
    """Return the Data ID as two bytes, low byte first, as the CRC requires."""
    return data_id.to_bytes(2, "little")


def crc(protected: bytes | memoryview, data_id: bytes) -> int:
    """Return the CRC of a frame.

    Args:
        protected: rest of the payload after the CRC field.
        data_id: result of `data_id_bytes`.
    """
    return crc_hqx(data_id, crc_hqx(protected, CRC_START))


#: Lookup table: element i is the CRC of the single byte i with the initial value 0.
_TABLE = np.array([crc_hqx(bytes([octet]), 0) for octet in range(256)], np.int64)


def protected_spans(messages: Sequence[Message]) -> Words:
    """Return three values for each message: start and end of its payload [byte offsets], and its Data ID.

    Args:
        messages: message in each row of an array of frames.

    Returns:
        Shape (rows, 3), one row per message. The offsets count from the start of the array of frames.
    """
    spans = []
    for row, message in enumerate(messages):
        begin = row * FRAME_BYTES + HEADER_BYTES
        spans.append((begin, begin + message.length, message.data_id))
    return np.array(spans)


def checksum(octets: Octets, begin: int, end: int, data_id: int) -> int:
    """Return the CRC of a payload. This is the variant of `crc` for compiled code.

    Args:
        octets: frames as a flat array of bytes.
        begin: offset of the first byte of the payload.
        end: offset after the last byte of the payload.
        data_id: Data ID of the message, 16 bits.
    """
    remainder = CRC_START
    for i in range(begin + CRC_BYTES, end):
        remainder = (remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ octets[i]]
    remainder = (remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ data_id & 0xFF]
    return int((remainder << 8 & 0xFFFF) ^ _TABLE[remainder >> 8 ^ data_id >> 8])


def intact(octets: Octets, spans: Words, counters: Words) -> bool:
    """Return whether every frame has the expected counter and a correct CRC.

    Args:
        octets: frames as a flat array of bytes, shape (rows * 72,).
        spans: result of `protected_spans`, shape (rows, 3).
        counters: expected counter of each frame, shape (rows,).
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
    """Write counter and CRC into every frame.

    Args:
        octets: frames as a flat array of bytes, shape (rows * 72,); overwritten.
        spans: result of `protected_spans`, shape (rows, 3).
        counters: counter of each frame, shape (rows,).
    """
    for row in range(len(spans)):
        begin, end, data_id = spans[row]
        octets[begin + COUNTER_BYTE] = counters[row]
        crc = checksum(octets, begin, end, data_id)
        octets[begin], octets[begin + 1] = crc & 0xFF, crc >> 8


#: Expected counter while no frame has been accepted yet.
NOTHING = -1
_OK, _SOME_LOST, _REPEATED, _WRONG_SEQUENCE = map(
    int, (Check.OK, Check.SOME_LOST, Check.REPEATED, Check.WRONG_SEQUENCE)
)


def classify_counter(expected: int, received: int) -> int:
    """Compare an alive counter with the expected counter; variant of `check_counter` for compiled code.

    Args:
        expected: last accepted counter plus 1, modulo 256, or `NOTHING`.
        received: counter of the received frame, 0 to 255.

    Returns:
        Value of `Check` as a plain integer.
    """
    skipped = received - expected & 0xFF
    if expected == NOTHING or skipped == 0:
        return _OK
    if skipped == 0xFF:
        return _REPEATED
    return _SOME_LOST if skipped < MAX_DELTA else _WRONG_SEQUENCE


def check_counter(last: int | None, received: int) -> Check:
    """Check an alive counter against the last accepted counter.

    Args:
        last: last accepted counter, 0 to 255; None if no frame was accepted before.
        received: counter of the received frame, 0 to 255.
    """
    return Check(classify_counter(NOTHING if last is None else last + 1 & 0xFF, received))


# The error counter (leaky bucket) of a message rises in a cycle without good data and falls in a cycle with good data.
#: Increase of the error counter in a bad cycle.
BAD_CYCLE = 4
#: Decrease of the error counter in a good cycle. The counter rises on average if more than a fifth of the frames are lost.
GOOD_CYCLE = 1
#: Limit of the error counter. When the error counter reaches the limit, the message is no longer trusted.
FULL = 64
#: Number of consecutive good cycles after which a message is trusted.
#: The values of a message that is not trusted are not used. For example, the inputs of the pendant are ignored.
REQUALIFY = 16
#: Increase of the counter of `suspect` in each cycle in which a message has frames of two senders.
#: After 64 / 16 = 4 consecutive cycles with frames of two senders, the counter reaches `FULL`. Then two senders are confirmed.
RIVAL_CYCLE = 16


class Qualification(NamedTuple):
    """Trust in the sender of one message, and the error counter on which the trust depends."""

    bucket: int = 0  # error counter (leaky bucket), 0 to `FULL`
    good: int = 0  # number of good cycles in a row, counted up to `REQUALIFY`
    trusted: bool = False  # True if the values of the message may be used


#: Qualification of a message that is trusted and has the error counter 0. A good cycle does not change this qualification.
SETTLED = Qualification(0, REQUALIFY, True)


def qualify(before: Qualification, *, good: bool, timed_out: bool = False) -> Qualification:
    """Compute the qualification of a message at the end of a cycle.

    Args:
        before: qualification after the previous cycle.
        good: True if new and intact data was received.
        timed_out: True if the age of the data has reached the timeout, or if two senders are confirmed. Then the
            message is not trusted.
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
    """Return the updated counter that detects two senders of one message.

    Args:
        evidence: counter after the previous cycle, 0 to `FULL`.
        rival: True if this cycle has a frame that cannot be from the sender of the accepted frame.

    Returns:
        The counter, 0 to `FULL`. `FULL` confirms two senders. A cycle without a rival frame reduces the counter by
        `GOOD_CYCLE`.
    """
    return min(evidence + RIVAL_CYCLE, FULL) if rival else max(evidence - GOOD_CYCLE, 0)
