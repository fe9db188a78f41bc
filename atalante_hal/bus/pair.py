"""Embedded bus, which connects the HAL with an emulator in the same process, in lock-step.

The HAL has one end and the emulator has the other end. If the HAL calls `receive()` and no frame is queued for the HAL, the
HAL's end calls `step`. In this call the emulator receives the frames of the HAL and sends the answers. Both sides run the same
code as on a real bus.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from atalante_hal.bus import BusDown, BusFull, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.wire.frame import FRAME_BYTES, Frames, new_frames


class PairBus:
    """One end of an embedded bus within one process. `send` and `receive` never wait.

    Args:
        name: Name of this end.
        capacity: Number of frames that can be queued for this end. If the queue is full, `send` of the other end (the peer)
            raises `BusFull`.

    Attributes:
        step: Function that `receive()` calls when no frame is queued. With None, `receive()` returns 0 instead.
        now_ns: Time that received frames get [ns], such as a virtual time. With None, they get the time of day of `receive()`.
        dropped: Always 0, because no frame is lost here.
    """

    __slots__ = (
        "_batches",
        "_closed",
        "_head",
        "_limit",
        "_peer",
        "_queue",
        "_received_at",
        "_stamps",
        "_tail",
        "dropped",
        "name",
        "now_ns",
        "step",
    )

    def __init__(self, name: str, capacity: int) -> None:
        self.name = name
        self.step: Callable[[], object] | None = None
        self.now_ns: int | None = None
        self.dropped = 0
        self._peer = self
        self._closed = False
        self._queue = new_frames(capacity).view(np.uint8).data  # queued frames, from byte `_head` to byte `_tail`
        self._head = 0
        self._tail = 0
        self._limit = capacity * FRAME_BYTES
        self._stamps: Stamps = np.zeros(capacity, np.int64)
        self._received_at = 0
        self._batches = Batches()

    @property
    def stamps(self) -> Stamps:
        """Return an array of receive times, shape (capacity,), int64 [ns].

        All elements are equal: the time of the last `receive()` that returned frames.
        """
        self._stamps.fill(self._received_at)
        return self._stamps

    def send(self, frames: Frames) -> None:
        """Queue a copy of the frames for the peer; drop them if the peer is closed.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If the queue of the peer has no room for the whole batch.
            BusDown: If this end is closed.
            ValueError: If a frame is not a valid CAN frame.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        memory, _ = self._batches.to_send(frames)
        peer = self._peer
        if peer._closed:
            return
        tail = peer._tail
        end = tail + memory.nbytes
        if end > peer._limit:
            tail = peer._move_to_start()
            end = tail + memory.nbytes
            if end > peer._limit:
                raise BusFull(
                    f"{self.name} cannot send: the receive queue of {peer.name} is full, with {tail // FRAME_BYTES} frames"
                )
        peer._queue[tail:end] = memory
        peer._tail = end

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Move queued frames to `frames[:n]` and return n. If no frame is queued and `step` is set, call `step` first.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Ignored, because this end never waits.

        Returns:
            Number of received frames n.

        Raises:
            BusDown: If this end is closed.
        """
        head, tail = self._head, self._tail
        if head == tail:
            if self._closed:
                raise BusDown(f"{self.name} is closed")
            if self.step is None:
                return 0
            self.step()
            head, tail = self._head, self._tail
            if head == tail:
                return 0
        memory = self._batches.to_fill(frames)
        size = min(tail - head, memory.nbytes)
        memory[:size] = self._queue[head : head + size]
        self._received_at = time.time_ns() if self.now_ns is None else self.now_ns
        head += size
        if head == tail:
            self._head = self._tail = 0
        else:
            self._head = head
        return size // FRAME_BYTES

    def close(self) -> None:
        """Close this end and drop the frames queued for it."""
        self._closed = True
        self.step = None
        self._head = self._tail = 0

    def _move_to_start(self) -> int:
        """Move the queued frames to the start of the queue, and return the offset [bytes] of their end."""
        size = self._tail - self._head
        self._queue[:size] = self._queue[self._head : self._tail]
        self._head = 0
        self._tail = size
        return size


def lockstep_pair(
    capacity: int = 1024, names: tuple[str, str] = ("embedded", "embedded peer")
) -> tuple[PairBus, PairBus]:
    """Create the two ends of an embedded bus.

    Args:
        capacity: Number of frames that can be queued for each end.
        names: Names of the two ends.

    Returns:
        Both ends, in the order of `names`.
    """
    one, other = PairBus(names[0], capacity), PairBus(names[1], capacity)
    one._peer, other._peer = other, one
    return one, other
