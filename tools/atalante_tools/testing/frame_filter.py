"""Communication faults for tests: a bus that loses, delays or damages frames of chosen messages, and records the others.

    HAL <- FrameFilter <- bus        HAL -> FrameFilter -> bus

Faults of messages from the HAL act in `send`, faults of all other messages in `receive`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Final

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.transceiver import FrameTap
from atalante_hal.wire.frame import Frames, as_words

#: Largest number of delayed frames that arrive in one batch.
_ROOM: Final = 128


@dataclass
class Fault:
    """Fault of chosen messages; it ends after `frames` frames of each message, or with `end()`."""

    kind: str  # drop, delay or corrupt
    messages: tuple[str, ...]  # names of the messages
    ids: frozenset[int]  # identifiers of the messages
    probability: float  # probability that a frame is affected
    frames: int | None  # number of frames of each message; None: no limit
    cycles: int = 0  # duration of a delay [cycles]
    bit: int | None = None  # index of the bit to damage; None: random
    hits: dict[int, int] = field(default_factory=dict)  # identifier -> number of affected frames

    @property
    def hit(self) -> int:
        """Number of frames affected so far."""
        return sum(self.hits.values())

    def end(self) -> None:
        """End the fault."""
        self.frames = 0

    @property
    def over(self) -> bool:
        """Whether the fault has ended."""
        return self.frames is not None and all(self.hits.get(frame_id, 0) >= self.frames for frame_id in self.ids)


class FrameFilter(WrappedBus):
    """Bus with faults; without a fault it passes all frames.

    Time stamps are not shifted with the frames: a delayed frame, or a frame after a dropped one, has the stamp of another frame.

    Args:
        bus: wrapped bus, owned by the caller.
        network: nodes and messages of the DBC.
        tap: records the frames that pass.
        step: makes the emulated robot in this process answer. It is called before every receive, which then does not wait.
        seed: seed of the random faults.
    """

    def __init__(
        self,
        bus: Bus,
        network: Network,
        *,
        tap: FrameTap | None = None,
        step: Callable[[], object] | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(bus)
        self.tap = tap
        self.faults: list[Fault] = []
        self._network, self._step = network, step
        self._random = np.random.default_rng(seed)
        self._syncs = {m.frame_id for m in network.messages if m.name.startswith("SYNC_")}
        self._cycle = 0
        self._late: tuple[list[tuple[int, Frames]], list[tuple[int, Frames]]] = ([], [])  # out, in: (due, frame)

    # -- faults --------------------------------------------------------------------------------------------------------

    def drop(self, what: str, *, frames: int | None = None, probability: float = 1.0) -> Fault:
        """Lose frames.

        Args:
            what: name of a message (LEFT_SK_STATE), of a node (LEFT_SK: all its messages), or a pattern (LEFT_*, *_STATE).
            frames: number of frames of each message. None means until the fault ends.
            probability: probability that a frame is affected, above 0 to 1.

        Returns:
            The fault, to end it or to count its frames.

        Raises:
            ValueError: If there is no such message or node, or the probability is out of range.
        """
        return self._add("drop", what, frames, probability)

    def delay(self, what: str, cycles: int, *, frames: int | None = None, probability: float = 1.0) -> Fault:
        """Delay frames.

        Args:
            what: name or pattern of messages or nodes, as in `drop`.
            cycles: delay in cycles, from 1.
            frames: number of frames of each message. None means until the fault ends.
            probability: probability that a frame is affected, above 0 to 1.

        Returns:
            The fault, to end it or to count its frames.

        Raises:
            ValueError: If an argument is out of range, or there is no such message or node.
        """
        if cycles < 1:
            raise ValueError(f"cycles of a delay must be 1 or more, got {cycles}")
        fault = self._add("delay", what, frames, probability)
        fault.cycles = cycles
        return fault

    def corrupt(
        self, what: str, *, bit: int | None = None, frames: int | None = None, probability: float = 1.0
    ) -> Fault:
        """Invert one bit of the payload.

        Args:
            what: name or pattern of messages or nodes, as in `drop`.
            bit: index of the bit, modulo the payload length. None means a random bit.
            frames: number of frames of each message. None means until the fault ends.
            probability: probability that a frame is affected, above 0 to 1.

        Returns:
            The fault, to end it or to count its frames.

        Raises:
            ValueError: If an argument is out of range, or there is no such message or node.
        """
        fault = self._add("corrupt", what, frames, probability)
        fault.bit = bit
        return fault

    def clear(self) -> None:
        """End all faults; delayed frames still arrive."""
        self.faults.clear()

    def _add(self, kind: str, what: str, frames: int | None, probability: float) -> Fault:
        if not 0.0 < probability <= 1.0:
            raise ValueError(f"probability must be above 0 and at most 1, got {probability}")
        messages = [m for m in self._network.messages if fnmatchcase(m.name, what) or fnmatchcase(m.sender, what)]
        if not messages:
            names = [*(m.name for m in self._network.messages), *(n.name for n in self._network.nodes)]
            near = difflib.get_close_matches(what.upper(), names, 3)
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ValueError(f"no message or node has the name {what!r}{hint}")
        names_hit, ids = tuple(m.name for m in messages), frozenset(m.frame_id for m in messages)
        fault = Fault(kind, names_hit, ids, probability, frames)
        self.faults.append(fault)
        return fault

    # -- bus -----------------------------------------------------------------------------------------------------------

    def send(self, frames: Frames) -> None:
        """Send frames that pass the faults; see `Bus.send`.

        Args:
            frames: frames to send, shape (n,).
        """
        if not self._syncs.isdisjoint(frames["can_id"].tolist()):
            self._cycle += 1
        if self.faults or self._late[0]:
            frames = self._through(frames, self._late[0])
        if len(frames):
            self.bus.send(frames)
            if self.tap is not None:
                self.tap.sent(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames that pass the faults; see `Bus.receive`.

        Args:
            frames: receive buffer, shape (n,).
            timeout: longest wait for the first frame [s].

        Returns:
            Number of frames in the buffer.
        """
        if self._step is not None:
            self._step()
            timeout = 0.0
        count = self.bus.receive(frames, timeout)
        if self.faults or self._late[1]:
            kept = self._through(frames[:count], self._late[1])[: len(frames)]
            count = len(kept)
            as_words(frames)[:count] = as_words(kept)
        if self.tap is not None and count:
            self.tap.received(frames, count)
        return count

    def _through(self, frames: Frames, late: list[tuple[int, Frames]]) -> Frames:
        """Return a copy of the frames of a batch that pass, after the delayed frames that are due."""
        due = [frame for cycle, frame in late if cycle <= self._cycle][:_ROOM]
        late[:] = [(cycle, frame) for cycle, frame in late if cycle > self._cycle]
        arriving = due
        for row, frame_id in enumerate(frames["can_id"].tolist()):
            frame: Frames = frames[row : row + 1].copy()
            fault = next((f for f in self.faults if frame_id in f.ids and self._hits(f, frame_id)), None)
            if fault is None:
                arriving.append(frame)
            elif fault.kind == "delay":
                late.append((self._cycle + fault.cycles, frame))
            elif fault.kind == "corrupt":
                self._damage(frame, fault)
                arriving.append(frame)
        self.faults = [fault for fault in self.faults if not fault.over]
        return np.concatenate(arriving) if arriving else frames[:0]

    def _hits(self, fault: Fault, frame_id: int) -> bool:
        so_far = fault.hits.get(frame_id, 0)
        if fault.frames is not None and so_far >= fault.frames:
            return False
        if fault.probability < 1.0 and self._random.random() >= fault.probability:
            return False
        fault.hits[frame_id] = so_far + 1
        return True

    def _damage(self, frame: Frames, fault: Fault) -> None:
        bits = 8 * int(frame["len"][0])
        bit = int(self._random.integers(bits)) if fault.bit is None else fault.bit % bits
        frame["data"][0][bit // 8] ^= 1 << bit % 8
