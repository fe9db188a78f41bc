"""The embedded bus between two processes: what `pair` is in one, in shared memory, so that both ends work at once.

Each end has a queue that it alone writes and the other alone reads; a count that is stored after the frames says that they are
there. This relies on stores being seen in program order, as on x86-64. An end that waits looks again and again for a while and
then sleeps until the other end rings: a byte through a socket pair. The socket is also how each end notices that the other has
died, whatever of. Looking is of use only where the other end has a core of its own: let the two have different ones.

In lock-step one end asks and the other serves: `receive()` of the asker hands over everything it sent, lets the other end make
one step, and returns with what that sends, or with nothing when the step is over. So the two run the same sequence of calls as
the two ends of a `PairBus`, and the same bytes come out; only what a step does after its answer happens while the asker goes on.
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

#: 64-bit words of an end in the header, a cache line: frames sent and taken so far; steps asked for and made so far; and
#: what the end is doing.
_SENT, _TAKEN, _ASKED, _MADE, _SERVES, _ASLEEP, _CLOSED = range(7)
_LINE = 8
_HEADER_BYTES = mmap.PAGESIZE
#: How long an end looks again and again before it sleeps [s]: longer than either end of the stack works on a cycle.
_LOOK = 500e-6
#: Waits that sleep at once after one that looked in vain: on a busy machine, or when the other end keeps real time, looking
#: only takes time away from others.
_STEP_ASIDE = 32
#: Longest sleep [ms] before looking again by itself: the bell is rung a moment too early when a store is seen late.
_SLEEP = 20
_BELL = b"\0"
_WORDS_BYTES = 4096


class SharedBus:
    """One end; `shared_pair()` makes both, `descriptors()` what another process makes its end of.

    Attributes:
        patience: longest wait of the asker in lock-step for an answer [s]; 0: this end does not ask.
    """

    def __init__(self, name: str, memory: int, bell: int, end: int) -> None:
        """Take one end of a pair.

        Args:
            memory, bell: descriptors, which belong to the bus from now on.
            end: 0 or 1.
        """
        self.name = name
        self.patience = 0.0
        self.dropped = 0  # nothing is ever lost here
        self._bell = socket.socket(fileno=bell)
        self._bell.setblocking(False)
        self._ringing = select.poll()
        self._ringing.register(bell, select.POLLIN)
        self._map = mmap.mmap(memory, 0)
        os.close(memory)
        octets = memoryview(self._map)
        size = (len(octets) - _HEADER_BYTES) // 2
        queues = [octets[_HEADER_BYTES + place * size :][:size] for place in (0, 1)]
        lines = [octets[place * _LINE * 8 :][: _LINE * 8].cast("q") for place in (0, 1)]
        self._mine, self._peers = lines[end], lines[1 - end]
        self._outgoing, self._incoming = queues[end], queues[1 - end]
        self._size = size
        self._sent = self._taken = 0
        self._aside = 0  # waits left that sleep at once
        self._closed = False
        self._last_words = ""  # of the other end
        self._stamps: Stamps = np.zeros(size // FRAME_BYTES, np.int64)
        self._received_at = 0
        self._batches = Batches()

    @property
    def stamps(self) -> Stamps:
        """Time of the last `receive()` that brought something, for each frame. Shape (capacity,) int64 [ns]."""
        self._stamps.fill(self._received_at)
        return self._stamps

    def send(self, frames: Frames) -> None:
        """Queue a copy of the frames for the other end; raises `BusFull`, `BusDown`, `ValueError`. Shape (n,)."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        memory, _ = self._batches.to_send(frames)
        if self._peers[_CLOSED]:
            return
        size, place = self._size, self._sent * FRAME_BYTES % self._size
        sent = self._sent + len(frames)
        if (sent - self._peers[_TAKEN]) * FRAME_BYTES > size:
            raise BusFull(
                f"{self.name}: {self._sent - self._peers[_TAKEN]} frames wait at the other end and are not read"
            )
        end = place + memory.nbytes
        if end <= size:
            self._outgoing[place:end] = memory
        else:
            self._outgoing[place:] = memory[: size - place]
            self._outgoing[: end - size] = memory[size - place :]
        self._sent = sent
        if not self.patience:
            self._mine[_SENT] = sent
            if self._peers[_ASLEEP]:
                self._ring()

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]`, see `Bus.receive`; the asker in lock-step waits for the answer instead. Shape (m,), n <= m.

        Raises:
            BusDown: closed, or the other end is; with its last words.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        if self._peers[_SENT] == self._taken and not (self._ask() if self.patience else self._wait(timeout)):
            return 0
        memory = self._batches.to_fill(frames)
        place = self._taken * FRAME_BYTES % self._size
        size = min((self._peers[_SENT] - self._taken) * FRAME_BYTES, memory.nbytes)
        before_end = self._size - place
        if size <= before_end:
            memory[:size] = self._incoming[place : place + size]
        else:
            memory[:before_end] = self._incoming[place:]
            memory[before_end:size] = self._incoming[: size - before_end]
        count = size // FRAME_BYTES
        self._taken += count
        self._mine[_TAKEN] = self._taken
        self._received_at = time.time_ns()
        return count

    def serve(self, step: Callable[[], object]) -> None:
        """Call `step` whenever the other end asks, until this raises `BusDown`. In a step `receive` does not wait."""
        mine, peers = self._mine, self._peers
        mine[_SERVES] = 1
        while True:
            made = mine[_MADE]
            self._until(lambda: peers[_ASKED] != made, math.inf)  # noqa: B023 - called in here alone
            step()
            mine[_MADE] = made + 1
            if peers[_ASLEEP]:
                self._ring()

    def meet(self, timeout: float) -> None:
        """Wait until the other end serves, at most `timeout` [s]. Raises `BusDown`: it does not, or is gone."""
        peers = self._peers
        if not self._until(lambda: peers[_SERVES], timeout):
            raise BusDown(f"{self.name}: nobody serves the other end after {timeout:.0f} s")

    def close(self, last_words: str = "") -> None:
        """Leave the bus, with a reason for the other end if there is one; frames that were sent can still be received."""
        if self._closed:
            return
        self._closed = True
        self._mine[_CLOSED] = 1
        with contextlib.suppress(OSError):
            self._bell.send(last_words.encode()[:_WORDS_BYTES] or _BELL)
        self._bell.close()
        for view in (self._mine, self._peers, self._outgoing, self._incoming):
            view.release()
        self._map.close()

    def _ring(self) -> None:
        # A full socket has bells enough, and who is gone is noticed by the next `receive`.
        with contextlib.suppress(OSError):
            self._bell.send(_BELL)

    def _ask(self) -> bool:
        """Let the other end make a step; whether it sent something."""
        peers, taken = self._peers, self._taken
        self._mine[_SENT] = self._sent
        self._mine[_ASKED] = asked = self._mine[_ASKED] + 1
        if peers[_ASLEEP]:
            self._ring()
        # The step's frames are stored before its end.
        self._until(lambda: peers[_SENT] != taken or peers[_MADE] == asked, self.patience)
        return peers[_SENT] != taken

    def _wait(self, timeout: float) -> bool:
        """Whether something came within `timeout` [s]; who serves has what there is."""
        peers, taken = self._peers, self._taken
        return timeout > 0.0 and not self._mine[_SERVES] and self._until(lambda: peers[_SENT] != taken, timeout)

    def _until(self, ready: Callable[[], object], limit: float) -> bool:
        """Wait until `ready()`, at most `limit` [s]; whether it is. Raises `BusDown` when the other end is gone."""
        now = begun = time.monotonic()
        look = 0.0 if self._aside else _LOOK
        slept = False
        while not ready():
            waited = now - begun
            if waited >= limit:
                return False
            if self._peers[_CLOSED]:
                self._hear()
            if waited >= look:
                slept = True
                self._mine[_ASLEEP] = 1
                if not ready():
                    self._sleep(min(_SLEEP, 1e3 * (limit - waited)))
                self._mine[_ASLEEP] = 0
            now = time.monotonic()
        if self._aside:
            self._aside -= 1
        elif slept:
            self._aside = _STEP_ASIDE
        return True

    def _sleep(self, longest: float) -> None:
        """Sleep until the bell rings, at most `longest` [ms]; raises `BusDown` when the other end is gone."""
        if self._ringing.poll(longest):
            self._hear()

    def _hear(self) -> None:
        """Take what came through the socket; raises `BusDown` when nothing can come any more."""
        while True:
            try:
                heard = self._bell.recv(_WORDS_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                continue  # it left without hearing us; what it said is still to come
            if not heard:
                raise BusDown(f"{self.name}: {self._last_words or 'the other end is gone'}")
            if heard != _BELL:
                self._last_words = heard.decode(errors="replace")


def shared_pair(
    capacity: int = 1024, names: tuple[str, str] = ("embedded", "embedded peer")
) -> tuple[SharedBus, SharedBus]:
    """Both ends of an embedded bus in this process; `capacity` frames may wait on each."""
    memory, one, other = descriptors(capacity)
    return SharedBus(names[0], os.dup(memory), one, 0), SharedBus(names[1], memory, other, 1)


def descriptors(capacity: int = 1024) -> tuple[int, int, int]:
    """What an embedded bus is made of: the memory of both ends, the bell of end 0, the bell of end 1."""
    memory = anonymous_file("atalante-bus", _HEADER_BYTES + 2 * capacity * FRAME_BYTES)
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return memory, one.detach(), other.detach()
