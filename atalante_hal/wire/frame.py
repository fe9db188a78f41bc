"""Memory layout of a CAN FD frame: the Linux kernel's `struct canfd_frame`.

All stages of the data flow (bus, E2E, codec) work on arrays of this record. So the CRC check and the decoder read the bytes
directly from the receive buffer of the socket. The record size of 72 bytes keeps every payload aligned to 8 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

#: Record type of a frame, `struct canfd_frame` of linux/can.h.
FRAME = np.dtype([("can_id", "<u4"), ("len", "u1"), ("flags", "u1"), ("res", "u1", 2), ("data", "u1", 64)])
FRAME_BYTES = FRAME.itemsize
#: Layout of `FRAME` for one frame at a time: identifier, length, flags, payload.
FRAME_STRUCT = struct.Struct("<IBB2x64s")
#: Length of the header before the payload [bytes].
HEADER_BYTES = FRAME_BYTES - FRAME["data"].itemsize
#: Record length in 64-bit words: one header word and eight payload words.
WORDS = FRAME_BYTES // 8
_WORD = np.dtype("<u8")

FLAG_BRS = 0x01  # bit rate switch: the payload has the data bit rate
FLAG_ESI = 0x02  # error state indicator: the sender is error passive
FLAG_FDF = 0x04  # CAN FD frame
#: Mask of the bits of an identifier. The bits above them are the flags `ID_EXTENDED`, `ID_REMOTE` and `ID_ERROR`.
ID_MASK = 0x1FFF_FFFF
ID_EXTENDED = 1 << 31
ID_REMOTE = 1 << 30
ID_ERROR = 1 << 29

Frames = npt.NDArray[Any]


def new_frames(count: int) -> Frames:
    """Return zeroed frame records with 8-byte aligned payloads, shape (count,), dtype `FRAME`."""
    return np.zeros(count * WORDS, dtype="<u8").view(FRAME)


def joined(parts: Sequence[Frames]) -> Frames:
    """Concatenate several arrays of frames, shape (total number of frames,)."""
    # The arrays are concatenated as bytes, because numpy takes 40 times as long to concatenate records.
    return np.frombuffer(bytearray().join([part.tobytes() for part in parts]), FRAME)


def as_words(frames: Frames) -> npt.NDArray[np.uint64]:
    """Return a view of the frames as 64-bit words, shape (n, 9): the header word, then the payload."""
    return frames.view(_WORD).reshape(-1, WORDS)


def header_word(can_id: int, length: int, flags: int) -> int:
    """Return identifier, length and flags as the first 64-bit word of a frame record.

    Args:
        can_id: identifier with its flag bits, 32 bits.
        length: payload length [bytes].
        flags: flags of the frame, such as `FLAG_FDF`.
    """
    return can_id | length << 32 | flags << 40
