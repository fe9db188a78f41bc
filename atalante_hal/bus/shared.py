"""Embedded bus between two processes, in shared memory. The module `pair` is the variant within one process.

Each end has a queue, which only this end writes and only the other end reads. The writer stores the frames and then its
frame counter. The reader reads only frames that are already counted. This requires that stores become visible in
program order, as on x86-64. A waiting end polls the counter for a short time and then sleeps until the other end wakes it
with a byte through a socket pair. If the other process terminates for any reason, the kernel closes its socket, and this
end raises `BusDown`. Polling saves time only if the two processes run on different cores.

In lock-step one end is the client and the other end is the server. `receive()` of the client publishes the frames that the
client sent, and requests one step of the server. Then `receive()` returns the frames that the server sends in this step, if any.
So the sequence of calls and the bytes on the bus are the same as on a `PairBus`. Only the work that the server does
after its answer runs in parallel with the client.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import select
import socket
import time
from collections.abc import Callable

import numpy as np

from atalante_hal.bus import BusDown, BusFull, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.memory import anonymous_file
from atalante_hal.wire.frame import FRAME_BYTES, Frames

#: Indices of the counters of each bus end: sent frames, received frames, requested calls of `step`, completed calls of `step`.
_SENT, _RECEIVED, _REQUESTED, _COMPLETED = range(4)
#: Indices of the flags of each bus end. `_SERVING` is 1 while the end runs `serve`. `_SLEEPING` is 1 while the end sleeps.
#: `_CLOSED` is 1 after the end is closed.
_SERVING, _SLEEPING, _CLOSED = range(4, 7)
#: Number of 64-bit words that store the counters and flags of one bus end: one cache line.
_END_WORDS = 8
_HEADER_BYTES = mmap.PAGESIZE
#: Time for which a waiting bus end polls before it sleeps [s]. Computing one control cycle takes less than `_POLL_TIME`.
_POLL_TIME = 500e-6
#: Number of waits without polling that follow a wait longer than `_POLL_TIME`. In these waits, the bus end sleeps at once.
_WAITS_WITHOUT_POLLING = 32
#: Longest sleep of a waiting bus end before it reads the shared memory again [ms].
#: A sleep must be limited, because a wake-up byte may arrive before the new value in the shared memory is visible.
_SLEEP = 20
_WAKE_UP = b"\0"
_REASON_BYTES = 4096


class SharedBus:
    """One end of an embedded bus between two processes.

    `shared_pair()` creates both ends in one process. For two processes, `descriptors()` creates the file descriptors from which
    each process constructs its end.

    Attributes:
        patience: Longest wait of the client in lock-step for an answer [s]; 0 if this end is not a client.
        before_request: Function that `receive` of the client calls before it requests a step. With None, nothing is called.
        dropped: Always 0, because no frame is lost here.
    """

    def __init__(self, name: str, memory: int, wake_socket: int, end: int) -> None:
        """Attach to one of the two ends of the bus.

        Args:
            name: Name of this end.
            memory: Descriptor of the shared memory. The bus owns the descriptor and closes it.
            wake_socket: Descriptor of the socket that wakes this end. The bus owns the descriptor and closes it.
            end: Number of this end of the bus, 0 or 1.
        """
        self.name = name
        self.patience = 0.0
        self.before_request: Callable[[], object] | None = None
        self.dropped = 0
        self._wake_socket = socket.socket(fileno=wake_socket)
        self._wake_socket.setblocking(False)
        self._wake_poll = select.poll()
        self._wake_poll.register(wake_socket, select.POLLIN)
        self._map = mmap.mmap(memory, 0)
        os.close(memory)
        octets = memoryview(self._map)
        size = (len(octets) - _HEADER_BYTES) // 2
        queues = [octets[_HEADER_BYTES + index * size :][:size] for index in (0, 1)]
        lines = [octets[index * _END_WORDS * 8 :][: _END_WORDS * 8].cast("q") for index in (0, 1)]
        self._own, self._peers = lines[end], lines[1 - end]
        self._outgoing, self._incoming = queues[end], queues[1 - end]
        self._size = size
        self._sent = self._received = 0
        self._waits_without_polling = 0  # number of remaining waits in which this end sleeps at once, without polling
        self._closed = False
        self._close_reason = ""  # text that the other end sent when it closed; empty if it sent no text
        self._stamps: Stamps = np.zeros(size // FRAME_BYTES, np.int64)
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
        """Queue a copy of the frames for the other end; drop the frames if the other end is closed.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If the queue of the other end has no room for the whole batch.
            BusDown: If this end is closed.
            ValueError: If a frame is not a valid CAN frame.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        memory, _ = self._batches.to_send(frames)
        if self._peers[_CLOSED]:
            return
        size, offset = self._size, self._sent * FRAME_BYTES % self._size
        sent = self._sent + len(frames)
        if (sent - self._peers[_RECEIVED]) * FRAME_BYTES > size:
            raise BusFull(
                f"{self.name} cannot send: the receive queue of the other end is full, with "
                f"{self._sent - self._peers[_RECEIVED]} frames"
            )
        end = offset + memory.nbytes
        if end <= size:
            self._outgoing[offset:end] = memory
        else:
            self._outgoing[offset:] = memory[: size - offset]
            self._outgoing[: end - size] = memory[size - offset :]
        self._sent = sent
        if not self.patience:
            self._own[_SENT] = sent
            if self._peers[_SLEEPING]:
                self._wake_peer()

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Move received frames to `frames[:n]` and return n, see `Bus.receive`.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Longest wait for the first frame [s]. The client in lock-step waits up to `patience` instead.

        Returns:
            Number of received frames n.

        Raises:
            BusDown: If this end or the other end is closed; the message contains the reason that the other end sent.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        if self._peers[_SENT] == self._received and not (
            self._request_step() if self.patience else self._wait(timeout)
        ):
            return 0
        memory = self._batches.to_fill(frames)
        offset = self._received * FRAME_BYTES % self._size
        size = min((self._peers[_SENT] - self._received) * FRAME_BYTES, memory.nbytes)
        before_end = self._size - offset
        if size <= before_end:
            memory[:size] = self._incoming[offset : offset + size]
        else:
            memory[:before_end] = self._incoming[offset:]
            memory[before_end:size] = self._incoming[: size - before_end]
        count = size // FRAME_BYTES
        self._received += count
        self._own[_RECEIVED] = self._received
        self._received_at = time.time_ns()
        return count

    def serve(self, step: Callable[[], object]) -> None:
        """Serve the other end of the bus: call `step` for each request of the other end, until the bus is down.

        Args:
            step: Function that receives the queued frames and sends the answers. While it runs, `receive` does not wait.

        Raises:
            BusDown: If the other end is closed or its process has ended.
        """
        own, peers = self._own, self._peers
        own[_SERVING] = 1
        try:
            while True:
                completed = own[_COMPLETED]
                self._until(lambda: peers[_REQUESTED] != completed, math.inf)  # noqa: B023 - the lambda is called only in this iteration
                step()
                own[_COMPLETED] = completed + 1
                if peers[_SLEEPING]:
                    self._wake_peer()
        finally:
            if not self._closed:
                own[_SERVING] = 0

    def run_step(self) -> None:
        """Request a step from the server, and wait until the step is complete. Frames that the server sends stay queued.

        Only the client in lock-step may call this method.

        Raises:
            BusDown: If the other end is closed, or the step is not complete within `patience`.
        """
        peers, requested = self._peers, self._request()
        if not self._until(lambda: peers[_COMPLETED] == requested, self.patience):
            raise BusDown(f"{self.name}: the other end did not complete a step within {self.patience:g} s")

    def wait_until_served(self, timeout: float) -> None:
        """Wait until the other end runs `serve`.

        Args:
            timeout: Longest wait [s].

        Raises:
            BusDown: If the other end does not run `serve` within `timeout`, or is closed.
        """
        peers = self._peers
        if not self._until(lambda: peers[_SERVING], timeout):
            raise BusDown(f"{self.name}: the other end did not call `serve` within {timeout:.0f} s")

    def close(self, reason: str = "") -> None:
        """Close this end. The other end can still receive the frames that were sent.

        Args:
            reason: Reason for closing, which the other end states in its `BusDown`; empty if there is none.
        """
        if self._closed:
            return
        self._closed = True
        self._own[_CLOSED] = 1
        with contextlib.suppress(OSError):
            self._wake_socket.send(reason.encode()[:_REASON_BYTES] or _WAKE_UP)
        self._wake_socket.close()
        for view in (self._own, self._peers, self._outgoing, self._incoming):
            view.release()
        self._map.close()

    def _wake_peer(self) -> None:
        # Errors are ignored: a full socket already contains a wake-up byte, and the next `receive` detects a closed peer.
        with contextlib.suppress(OSError):
            self._wake_socket.send(_WAKE_UP)

    def _request_step(self) -> bool:
        """Request a step from the other end, and return whether the other end sent frames."""
        peers, received = self._peers, self._received
        if self.before_request is not None:
            self.before_request()
        requested = self._request()
        # The server publishes the frames of a step before it marks the step as completed, so no frame is missed here.
        self._until(lambda: peers[_SENT] != received or peers[_COMPLETED] == requested, self.patience)
        return peers[_SENT] != received

    def _request(self) -> int:
        """Publish the sent frames, and request a step from the other end. Return the number of requests so far."""
        self._own[_SENT] = self._sent
        self._own[_REQUESTED] = requested = self._own[_REQUESTED] + 1
        if self._peers[_SLEEPING]:
            self._wake_peer()
        return requested

    def _wait(self, timeout: float) -> bool:
        """Wait up to `timeout` [s] for frames and return whether any arrived. Do not wait while this end runs `serve`.

        Raises:
            BusDown: If the other end is closed. While this end runs `serve`, `serve` raises the error instead.
        """
        peers, received = self._peers, self._received
        if self._own[_SERVING]:
            return False
        if timeout > 0.0:
            return self._until(lambda: peers[_SENT] != received, timeout)
        self._sleep(0.0)  # only detects a closed end
        return peers[_SENT] != received

    def _until(self, ready: Callable[[], object], limit: float) -> bool:
        """Wait until `ready()` is true and return True; return False after `limit` [s].

        Args:
            ready: Condition on the shared memory.
            limit: Longest wait [s].

        Returns:
            Whether the condition became true in time.

        Raises:
            BusDown: If the other end is closed.
        """
        now = start = time.monotonic()
        poll_time = 0.0 if self._waits_without_polling else _POLL_TIME
        slept = False
        while not ready():
            waited = now - start
            if waited >= limit:
                return False
            if self._peers[_CLOSED]:
                self._read_wake_ups()
            if waited >= poll_time:
                slept = True
                self._own[_SLEEPING] = 1
                if not ready():
                    self._sleep(min(_SLEEP, 1e3 * (limit - waited)))
                self._own[_SLEEPING] = 0
            now = time.monotonic()
        if self._waits_without_polling:
            self._waits_without_polling -= 1
        elif slept:
            self._waits_without_polling = _WAITS_WITHOUT_POLLING
        return True

    def _sleep(self, longest: float) -> None:
        """Sleep until the other end wakes this end, at most `longest` [ms]; raise `BusDown` if the other end is closed."""
        if self._wake_poll.poll(longest):
            self._read_wake_ups()

    def _read_wake_ups(self) -> None:
        """Read all wake-up bytes from the socket; raise `BusDown` if the other end is closed."""
        while True:
            try:
                received = self._wake_socket.recv(_REASON_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                # The other end closed before it had read all wake-up bytes.
                # The socket still contains the last message of the other end.
                continue
            if not received:
                raise BusDown(f"{self.name}: {self._close_reason or 'the other end is closed'}")
            if received != _WAKE_UP:
                self._close_reason = received.decode(errors="replace")


def shared_pair(
    capacity: int = 1024, names: tuple[str, str] = ("embedded", "embedded peer")
) -> tuple[SharedBus, SharedBus]:
    """Create both ends of an embedded bus in this process.

    Args:
        capacity: Number of frames that can be queued for each end.
        names: Names of the two ends.

    Returns:
        Both ends, in the order of `names`.
    """
    memory, one, other = descriptors(capacity)
    return SharedBus(names[0], os.dup(memory), one, 0), SharedBus(names[1], memory, other, 1)


def descriptors(capacity: int = 1024) -> tuple[int, int, int]:
    """Create the descriptors of an embedded bus.

    Args:
        capacity: Number of frames that can be queued for each end.

    Returns:
        Descriptors of the shared memory, of the socket of end 0 and of the socket of end 1.
    """
    memory = anonymous_file("atalante-bus", _HEADER_BYTES + 2 * capacity * FRAME_BYTES)
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return memory, one.detach(), other.detach()
