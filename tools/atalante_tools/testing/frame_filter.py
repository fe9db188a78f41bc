"""Faults of the wire, by name: a bus that loses, delays or damages what somebody asked for, and tells what it let through.

    HAL <- FrameFilter <- bus        HAL -> FrameFilter -> bus

Messages the HAL sends are met on their way out, all others on their way in.
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

#: Frames of one batch that can be held back and come later together.
_ROOM: Final = 128


@dataclass
class Fault:
    """Something that happens to frames until `frames` of each message were hit, or `end()`."""

    kind: str
    messages: tuple[str, ...]
    ids: frozenset[int]
    probability: float
    frames: int | None  # of each message; None: until it ends
    cycles: int = 0  # of a delay
    bit: int | None = None  # of a damage; None: one at random
    hits: dict[int, int] = field(default_factory=dict)  # frame id -> frames hit

    @property
    def hit(self) -> int:
        """Frames hit so far."""
        return sum(self.hits.values())

    def end(self) -> None:
        """Hit nothing any more."""
        self.frames = 0

    @property
    def over(self) -> bool:
        """It will hit nothing any more."""
        return self.frames is not None and all(self.hits.get(frame_id, 0) >= self.frames for frame_id in self.ids)


class FrameFilter(WrappedBus):
    """A bus with faults. Without any it passes everything on.

    A frame that was delayed, or comes behind one that was dropped, has another's stamp.

    Args:
        bus: owned by the caller.
        tap: sees what really was sent and received.
        step: makes the other end answer, for one that is polled in this process: called before every look at the bus, which
            then waits for nothing.
        seed: of everything that happens at random.
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
            what: a message (LEFT_SK_STATE), a node (LEFT_SK: all it sends), or a pattern of either (LEFT_*, *_STATE).
            frames: how many of each message; None: until the fault ends.
            probability: of each frame to be hit.

        Raises:
            ValueError: there is no such message or node.
        """
        return self._add("drop", what, frames, probability)

    def delay(self, what: str, cycles: int, *, frames: int | None = None, probability: float = 1.0) -> Fault:
        """Let frames arrive some cycles later. Raises `ValueError`; see `drop`."""
        if cycles < 1:
            raise ValueError(f"a delay is one cycle or more, not {cycles}")
        fault = self._add("delay", what, frames, probability)
        fault.cycles = cycles
        return fault

    def corrupt(
        self, what: str, *, bit: int | None = None, frames: int | None = None, probability: float = 1.0
    ) -> Fault:
        """Damage one bit of the payload, at random unless given. Raises `ValueError`; see `drop`."""
        fault = self._add("corrupt", what, frames, probability)
        fault.bit = bit
        return fault

    def clear(self) -> None:
        """End every fault; what is delayed still arrives."""
        self.faults.clear()

    def _add(self, kind: str, what: str, frames: int | None, probability: float) -> Fault:
        if not 0.0 < probability <= 1.0:
            raise ValueError(f"a probability is above 0 and at most 1, not {probability}")
        messages = [m for m in self._network.messages if fnmatchcase(m.name, what) or fnmatchcase(m.sender, what)]
        if not messages:
            names = [*(m.name for m in self._network.messages), *(n.name for n in self._network.nodes)]
            near = difflib.get_close_matches(what.upper(), names, 3)
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ValueError(f"no message and no node is called {what!r}{hint}")
        names_hit, ids = tuple(m.name for m in messages), frozenset(m.frame_id for m in messages)
        fault = Fault(kind, names_hit, ids, probability, frames)
        self.faults.append(fault)
        return fault

    # -- bus -----------------------------------------------------------------------------------------------------------

    def send(self, frames: Frames) -> None:
        """As `Bus.send`."""
        if not self._syncs.isdisjoint(frames["can_id"].tolist()):
            self._cycle += 1
        if self.faults or self._late[0]:
            frames = self._through(frames, self._late[0])
        if len(frames):
            self.bus.send(frames)
            if self.tap is not None:
                self.tap.sent(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """As `Bus.receive`."""
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
        """What arrives of a batch, with what was held back before and is due now. A copy."""
        due = [frame for cycle, frame in late if cycle <= self._cycle][:_ROOM]
        late[:] = [(cycle, frame) for cycle, frame in late if cycle > self._cycle]
        arriving = due
        for place, frame_id in enumerate(frames["can_id"].tolist()):
            frame: Frames = frames[place : place + 1].copy()
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
