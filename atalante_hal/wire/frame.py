"""One CAN frame as it lies in memory: the kernel's `struct canfd_frame`.

Every stage of the flow (bus, E2E, codec) works on arrays of this record, so the bytes a socket receives are the bytes
the CRC covers and the bytes the decoder reads. 72 bytes a record keeps every payload aligned to 8 bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

#: `struct canfd_frame` of linux/can.h.
FRAME = np.dtype([("can_id", "<u4"), ("len", "u1"), ("flags", "u1"), ("res", "u1", 2), ("data", "u1", 64)])
FRAME_BYTES = FRAME.itemsize
#: Bytes of a record before its payload.
HEADER_BYTES = FRAME_BYTES - FRAME["data"].itemsize
#: A record as nine 64-bit words: one header word, eight payload words.
WORDS = FRAME_BYTES // 8
_WORD = np.dtype("<u8")

FLAG_BRS = 0x01  # payload sent at the data bit rate
FLAG_ESI = 0x02  # sender is error passive
FLAG_FDF = 0x04  # CAN FD frame
ID_EXTENDED = 1 << 31
ID_REMOTE = 1 << 30
ID_ERROR = 1 << 29

#: Payload lengths CAN FD can carry (ISO 11898-1).
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

Frames = npt.NDArray[Any]


def new_frames(count: int) -> Frames:
    """Zeroed frame records. Shape (count,), dtype `FRAME`, payloads 8-byte aligned."""
    return np.zeros(count * WORDS, dtype="<u8").view(FRAME)


def joined(parts: Sequence[Frames]) -> Frames:
    """One array of all frames, a copy. Shape (sum of n,)."""
    # Through their bytes: to join records numpy compares the fields of each with those of the one before, forty times as long.
    return np.frombuffer(bytearray().join([part.tobytes() for part in parts]), FRAME)


def as_words(frames: Frames) -> npt.NDArray[np.uint64]:
    """The same memory as 64-bit words. Shape (n, 9): header word, then the payload."""
    return frames.view(_WORD).reshape(-1, WORDS)


def header_word(can_id: int, length: int, flags: int) -> int:
    """Identifier, length and flags as the first 64-bit word of a record: one integer to compare or look up."""
    return can_id | length << 32 | flags << 40
