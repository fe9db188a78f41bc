"""Communication faults for tests: a bus that loses, delays or damages frames of chosen messages.

    HAL <- FrameFilter <- bus        HAL -> FrameFilter -> bus

Faults of messages that the HAL sends act in `send`. Faults of messages that the HAL receives act in `receive`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusError
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.transceiver import FrameTap
from atalante_hal.wire.frame import Frames, as_words


@dataclass
class Fault:
    """Fault of some messages. A fault ends when it has affected `frames` frames of each message, or when `end` is called."""

    kind: str  # drop, delay or corrupt
    messages: tuple[str, ...]  # names of the messages
    ids: frozenset[int]  # identifiers of the messages
    probability: float  # probability that a frame is affected
    frames: int | None  # largest number of affected frames of each message; None means no limit
    cycles: int = 0  # duration of a delay [cycles]
    bit: int | None = None  # index of the bit to invert; None means a random bit
    hits: dict[int, int] = field(default_factory=dict)  # CAN identifier -> number of affected frames

    @property
    def hit(self) -> int:
        """Return the number of frames that the fault has affected so far."""
        return sum(self.hits.values())

    def end(self) -> None:
        """End the fault."""
        self.frames = 0

    @property
    def over(self) -> bool:
        """Return whether the fault has ended."""
        return self.frames is not None and all(self.hits.get(frame_id, 0) >= self.frames for frame_id in self.ids)


class FrameFilter(WrappedBus):
    """Bus that applies faults to frames. Without a fault, the bus passes all frames on.

    The filter does not change the list of time stamps. If a frame is dropped or delayed, the stamps of the following
    frames are wrong.

    Args:
        bus: wrapped bus, owned by the caller.
        network: nodes and messages of the DBC.
        tap: recorder of the frames that are passed on. If None, frames are not recorded.
        step: function that runs the emulated robot. Each `receive` first calls this function, and then receives without
            waiting. None means a real robot.
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
        #: Two lists of delayed frames: from the HAL, and from the nodes. An item is (cycle from which the frame may pass, frame).
        self._delayed: tuple[list[tuple[int, Frames]], list[tuple[int, Frames]]] = ([], [])

    def drop(self, name: str, *, frames: int | None = None, probability: float = 1.0) -> Fault:
        """Drop frames of the given messages.

        Args:
            name: name of a message (LEFT_SK_STATE), of a node (LEFT_SK: all its messages), or a pattern (LEFT_*, *_STATE).
            frames: number of affected frames of each message. None means no limit until the caller ends the fault.
            probability: probability that a frame is affected, above 0 and at most 1.

        Returns:
            The fault. The caller can end it, and read its number of affected frames.

        Raises:
            ValueError: If there is no such message or node, or the probability is out of range.
        """
        return self._add("drop", name, frames, probability)

    def delay(self, name: str, cycles: int, *, frames: int | None = None, probability: float = 1.0) -> Fault:
        """Delay frames of the given messages.

        Args:
            name: name or pattern of messages or nodes, as in `drop`.
            cycles: delay in cycles, at least 1.
            frames: number of affected frames of each message. None means no limit until the caller ends the fault.
            probability: probability that a frame is affected, above 0 and at most 1.

        Returns:
            The fault. The caller can end it, and read its number of affected frames.

        Raises:
            ValueError: If an argument is out of range, or there is no such message or node.
        """
        if cycles < 1:
            raise ValueError(f"the parameter 'cycles' must be 1 or more, got {cycles}")
        fault = self._add("delay", name, frames, probability)
        fault.cycles = cycles
        return fault

    def corrupt(
        self, name: str, *, bit: int | None = None, frames: int | None = None, probability: float = 1.0
    ) -> Fault:
        """Invert one bit in the payload of frames of the given messages.

        Args:
            name: name or pattern of messages or nodes, as in `drop`.
            bit: index of the bit, modulo the payload length. None means a random bit.
            frames: number of affected frames of each message. None means no limit until the caller ends the fault.
            probability: probability that a frame is affected, above 0 and at most 1.

        Returns:
            The fault. The caller can end it, and read its number of affected frames.

        Raises:
            ValueError: If an argument is out of range, or there is no such message or node.
        """
        fault = self._add("corrupt", name, frames, probability)
        fault.bit = bit
        return fault

    def clear(self) -> None:
        """End all faults; delayed frames are still passed on."""
        for fault in self.faults:
            fault.end()
        self.faults.clear()

    def _add(self, kind: str, name: str, frames: int | None, probability: float) -> Fault:
        if not 0.0 < probability <= 1.0:
            raise ValueError(f"probability must be above 0 and at most 1, got {probability}")
        messages = [m for m in self._network.messages if fnmatchcase(m.name, name) or fnmatchcase(m.sender, name)]
        if not messages:
            names = [*(m.name for m in self._network.messages), *(n.name for n in self._network.nodes)]
            near = difflib.get_close_matches(name.upper(), names, 3)
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ValueError(f"no message or node has the name {name!r}{hint}")
        affected, ids = tuple(m.name for m in messages), frozenset(m.frame_id for m in messages)
        fault = Fault(kind, affected, ids, probability, frames)
        self.faults.append(fault)
        return fault

    def send(self, frames: Frames) -> None:
        """Apply the faults, and send all frames that are not dropped or delayed; see `Bus.send`.

        Args:
            frames: frames to send, shape (n,).
        """
        if not self._syncs.isdisjoint(frames["can_id"].tolist()):
            self._cycle += 1
        if self.faults or self._delayed[0]:
            frames = self._apply_faults(frames, self._delayed[0], len(frames) + len(self._delayed[0]))
        if not len(frames):
            return
        try:
            self.bus.send(frames)
        except BusError as error:
            # `error.accepted` must contain the frames that the bus accepted.
            # The accepted frames can differ from the frames of the caller, because faults drop, delay or change frames.
            error.accepted = accepted = error.accepted_of(frames)
            if self.tap is not None and error.sent:
                self.tap.sent(accepted)
            raise
        if self.tap is not None:
            self.tap.sent(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames and apply the faults; see `Bus.receive`.

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
        if self.faults or self._delayed[1]:
            kept = self._apply_faults(frames[:count], self._delayed[1], len(frames))
            count = len(kept)
            as_words(frames)[:count] = as_words(kept)
        if self.tap is not None and count:
            self.tap.received(frames, count)
        return count

    def _apply_faults(self, frames: Frames, delayed: list[tuple[int, Frames]], room: int) -> Frames:
        """Apply the faults to new frames. Return one array: first the delayed frames that are due, then the new frames.

        The new frames that are dropped or delayed are not in this array.

        Args:
            frames: new frames, shape (n,).
            delayed: delayed frames of this direction. Updated here.
            room: largest number of frames to return. Further frames are due in the next call.
        """
        arriving = [frame for cycle, frame in delayed if cycle <= self._cycle]
        delayed[:] = [(cycle, frame) for cycle, frame in delayed if cycle > self._cycle]
        for row, frame_id in enumerate(frames["can_id"].tolist()):
            frame: Frames = frames[row : row + 1].copy()
            fault = next((f for f in self.faults if frame_id in f.ids and self._hits(f, frame_id)), None)
            if fault is None:
                arriving.append(frame)
            elif fault.kind == "delay":
                delayed.append((self._cycle + fault.cycles, frame))
            elif fault.kind == "corrupt":
                self._damage(frame, fault)
                arriving.append(frame)
        self.faults = [fault for fault in self.faults if not fault.over]
        delayed[:0] = [(self._cycle, frame) for frame in arriving[room:]]
        return np.concatenate([frames[:0], *arriving[:room]])

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
