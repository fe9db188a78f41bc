"""The memory of the frame arrays a bus is given: what lies between `Bus.send()`/`receive()` and a copy of bytes.

Making a byte view of an array costs more than copying a cycle's frames, so the views are kept; and a batch is known to
be legal by the bytes of its header words, which rarely change from cycle to cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import (
    FD_LENGTHS,
    FLAG_FDF,
    FRAME,
    ID_ERROR,
    ID_EXTENDED,
    ID_REMOTE,
    Frames,
    as_words,
)

#: Arrays, and header patterns, remembered at once; a HAL or an emulator uses a handful.
REMEMBERED = 64
CLASSIC_LENGTHS = tuple(range(9))


class Batch(NamedTuple):
    """One array of frames and the views a bus copies from or to."""

    frames: Frames  # held so that its id() cannot be given to another array
    memory: memoryview  # its bytes, length 72 n
    headers: npt.NDArray[np.uint64]  # identifier, length and flags of each frame, shape (n,)


class Batches:
    """The arrays one bus has been given so far, found again by identity."""

    def __init__(self) -> None:
        self._seen: dict[int, Batch] = {}
        self._legal: set[bytes] = set()

    def to_fill(self, frames: Frames) -> memoryview:
        """Bytes of an array to receive into. Raises `TypeError` if it is not a contiguous array of `FRAME`."""
        return (self._seen.get(id(frames)) or self._first_sight(frames))[1]

    def to_send(self, frames: Frames) -> tuple[memoryview, bytes]:
        """Bytes and header words of a batch that a CAN controller could send.

        Raises `ValueError` naming the first frame that is not legal, and `TypeError` as `to_fill()`.
        """
        _, memory, words = self._seen.get(id(frames)) or self._first_sight(frames)
        headers = words.tobytes()
        if headers not in self._legal:
            require_legal(frames)
            if len(self._legal) >= REMEMBERED:
                self._legal.clear()
            self._legal.add(headers)
        return memory, headers

    def _first_sight(self, frames: Frames) -> Batch:
        if not isinstance(frames, np.ndarray) or frames.dtype != FRAME or frames.ndim != 1:
            raise TypeError(
                "a bus carries one-dimensional arrays of frame.FRAME records; frame.new_frames(n) makes one"
            )
        if not frames.flags.c_contiguous:
            raise TypeError("a bus needs contiguous frames: pass a copy() of this slice")
        batch = Batch(frames, frames.view(np.uint8).data, as_words(frames)[:, 0])
        if len(self._seen) >= REMEMBERED:
            self._seen.clear()
        self._seen[id(frames)] = batch
        return batch


def is_legal(can_id: int, length: int, flags: int) -> bool:
    """Whether a CAN FD controller could put this frame on the wire (ISO 11898-1)."""
    number = can_id & 0x1FFF_FFFF
    if not can_id & ID_EXTENDED and not can_id & ID_ERROR and number > 0x7FF:
        return False
    if flags & FLAG_FDF:
        return length in FD_LENGTHS and not can_id & ID_REMOTE
    return length in CLASSIC_LENGTHS and not flags


def require_legal(frames: Frames) -> None:
    """Raise `ValueError` for the first frame that no CAN FD controller could put on the wire."""
    headers = zip(frames["can_id"].tolist(), frames["len"].tolist(), frames["flags"].tolist(), strict=True)
    for index, (can_id, length, flags) in enumerate(headers):
        if not is_legal(can_id, length, flags):
            raise ValueError(
                f"frame {index} (id 0x{can_id:X}, {length} bytes, flags 0x{flags:02X}) is no CAN frame: with FDF a "
                "payload is 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes and there is no remote frame, without it 0 to 8 "
                "bytes and flags 0; an identifier above 0x7FF needs the extended flag"
            )
