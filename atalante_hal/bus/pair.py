"""The embedded bus: two ends in one process, in lock-step, as fast as memory.

The HAL holds one end and the emulator the other. When the HAL asks for frames and none are there, its end calls `step`,
in which the emulator consumes what was sent and answers: the code on both sides is the same as on a wire.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from atalante_hal.bus import BusDown, BusFull, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.wire.frame import FRAME_BYTES, Frames, new_frames


class PairBus:
    """One end of the pair; `lockstep_pair()` makes both. Never waits.

    `step`, if set, is called by `receive()` when nothing is queued. `now_ns` is the virtual time that stamps what is
    received, set by the owner of the end. `send()` keeps up to `capacity` frames for a peer that does not read, then
    raises `BusFull`; frames for a closed peer are gone, as on a wire nobody listens to.
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
        self.now_ns = 0
        self.dropped = 0  # nothing is ever lost here
        self._peer = self
        self._closed = False
        self._queue = new_frames(capacity).view(np.uint8).data  # frames for this end, in bytes [head, tail)
        self._head = 0
        self._tail = 0
        self._limit = capacity * FRAME_BYTES
        self._stamps: Stamps = np.zeros(capacity, np.int64)
        self._received_at = 0
        self._batches = Batches()

    @property
    def stamps(self) -> Stamps:
        """`now_ns` at the last `receive()`, for each frame. Shape (capacity,) int64 [ns]."""
        self._stamps.fill(self._received_at)
        return self._stamps

    def send(self, frames: Frames) -> None:
        """Queue a copy of the frames for the peer; raises `BusFull`, `BusDown`, `ValueError`. Shape (n,)."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        memory, _ = self._batches.to_send(frames)
        peer = self._peer
        if peer._closed:
            return
        tail = peer._tail
        end = tail + memory.nbytes
        if end > peer._limit:
            tail = peer._close_ranks()
            end = tail + memory.nbytes
            if end > peer._limit:
                raise BusFull(
                    f"{self.name}: {peer.name} has {tail // FRAME_BYTES} frames waiting and does not read them"
                )
        peer._queue[tail:end] = memory
        peer._tail = end

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]`, after a `step` if nothing is queued; `timeout` is for wires. Shape (m,), n <= m."""
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
        self._received_at = self.now_ns
        head += size
        if head == tail:
            self._head = self._tail = 0
        else:
            self._head = head
        return size // FRAME_BYTES

    def close(self) -> None:
        """Leave the pair; what was queued for this end is gone."""
        self._closed = True
        self.step = None
        self._head = self._tail = 0

    def _close_ranks(self) -> int:
        """Move what is queued to the front; return where it ends [bytes]."""
        waiting = self._tail - self._head
        self._queue[:waiting] = self._queue[self._head : self._tail]
        self._head = 0
        self._tail = waiting
        return waiting


def lockstep_pair(
    capacity: int = 1024, names: tuple[str, str] = ("embedded", "embedded peer")
) -> tuple[PairBus, PairBus]:
    """The two ends of an embedded bus; `capacity` frames may wait on each."""
    one, other = PairBus(names[0], capacity), PairBus(names[1], capacity)
    one._peer, other._peer = other, one
    return one, other
