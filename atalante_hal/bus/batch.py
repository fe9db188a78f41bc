"""Byte views of frame arrays, cached for each array that is passed to `Bus.send()` or `Bus.receive()`.

Creating a byte view of an array takes longer than copying the frames of a cycle, so the views are cached.

The first 8 bytes of a frame are its header: identifier, length and flags. The header alone decides whether a frame is valid.
So the headers of each valid batch are cached, too. In most cycles the next batch has the same headers, and a batch with
cached headers needs no check.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_dbc.network import FD_LENGTHS
from atalante_hal.wire.frame import FLAG_FDF, FRAME, ID_ERROR, ID_EXTENDED, ID_MASK, ID_REMOTE, Frames, as_words

#: Largest number of entries in a cache. A full cache is emptied.
#: One entry is an array or a batch of frames; a HAL or an emulator uses about five arrays and five batches.
REMEMBERED = 64
CLASSIC_LENGTHS = tuple(range(9))


class Batch(NamedTuple):
    """Array of frames, with one view of all its bytes and one view of its headers (identifier, length, flags)."""

    frames: Frames
    memory: memoryview  # bytes of the array of n frames, 72 bytes per frame
    headers: npt.NDArray[np.uint64]  # header of each frame (identifier, length, flags), shape (n,)


class Batches:
    """Cache of the arrays that were passed to one bus. Each array is stored with its views."""

    def __init__(self) -> None:
        self._batches: list[Batch] = []
        self._legal: set[bytes] = set()

    def to_fill(self, frames: Frames) -> memoryview:
        """Return the bytes of a receive buffer, into which the bus writes the received frames.

        Args:
            frames: Receive buffer, shape (n,).

        Returns:
            Writable bytes of the array, length 72 n.

        Raises:
            TypeError: If `frames` is not a contiguous array of `FRAME`.
        """
        return self._batch_of(frames).memory

    def to_send(self, frames: Frames) -> tuple[memoryview, bytes]:
        """Check a batch of frames to send, and return its bytes and its headers (identifier, length, flags).

        Args:
            frames: Frames to send, shape (n,).

        Returns:
            All bytes of the array, length 72 n, and only the headers of its frames as bytes, length 8 n.

        Raises:
            ValueError: If a frame is not a valid CAN frame; the message names the first one.
            TypeError: If `frames` is not a contiguous array of `FRAME`.
        """
        _, memory, words = self._batch_of(frames)
        headers = words.tobytes()
        if headers not in self._legal:
            require_legal(frames)
            if len(self._legal) >= REMEMBERED:
                self._legal.clear()
            self._legal.add(headers)
        return memory, headers

    def _batch_of(self, frames: Frames) -> Batch:
        """Return the cached views of this array object, or create and cache them."""
        for batch in self._batches:
            if batch.frames is frames:
                return batch
        return self._add(frames)

    def _add(self, frames: Frames) -> Batch:
        if not isinstance(frames, np.ndarray) or frames.dtype != FRAME or frames.ndim != 1:
            raise TypeError(
                "frames must be a one-dimensional array of frame.FRAME records: create it with frame.new_frames(n)"
            )
        if not frames.flags.c_contiguous:
            raise TypeError("frames must be a contiguous array, got a strided slice: pass a copy of the slice")
        batch = Batch(frames, frames.view(np.uint8).data, as_words(frames)[:, 0])
        if len(self._batches) >= REMEMBERED:
            self._batches.clear()
        self._batches.append(batch)
        return batch


def is_legal(can_id: int, length: int, flags: int) -> bool:
    """Return whether a CAN FD controller can send this frame (ISO 11898-1).

    Args:
        can_id: Identifier with the flags of `struct canfd_frame`.
        length: Payload length [bytes].
        flags: CAN FD flags of the frame.

    Returns:
        True if identifier, length and flags are a valid combination.
    """
    number = can_id & ID_MASK
    if not can_id & ID_EXTENDED and not can_id & ID_ERROR and number > 0x7FF:
        return False
    if flags & FLAG_FDF:
        return length in FD_LENGTHS and not can_id & ID_REMOTE
    return length in CLASSIC_LENGTHS and not flags


def require_legal(frames: Frames) -> None:
    """Check that a CAN FD controller can send every frame.

    Args:
        frames: Frames to check, shape (n,).

    Raises:
        ValueError: If a frame is not a valid CAN frame; the message names the first one.
    """
    headers = zip(frames["can_id"].tolist(), frames["len"].tolist(), frames["flags"].tolist(), strict=True)
    for index, (can_id, length, flags) in enumerate(headers):
        if not is_legal(can_id, length, flags):
            raise ValueError(
                f"frame {index} (id 0x{can_id:X}, {length} bytes, flags 0x{flags:02X}) is not a valid CAN frame: with "
                "FDF the payload must be 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes and the frame must not be remote; "
                "without FDF the payload must be 0 to 8 bytes and the flags 0; an identifier above 0x7FF must be extended"
            )
