"""Faults of the wire: a bus at the emulator's end that loses, changes, delays and adds frames, in both directions.

    HAL <- bus <- FaultyBus <- nodes          what the nodes say passes `send`, what they hear `receive`

One seed gives one sequence of frames. Frames of no active fault pass untouched.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from atalante_dbc import Message, Network
from atalante_emulator.faults import LINK_KINDS, Fault, messages_of
from atalante_emulator.wire import Babble, Wire
from atalante_hal.bus import Bus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, ID_EXTENDED, Frames, joined, new_frames

#: Class bit of an error frame (linux/can/error.h).
BUS_OFF: Final = 0x40
_HIGHEST_STANDARD: Final = 0x7FF
_CLASSIC_LENGTH: Final = 8


class _Late(NamedTuple):
    """A frame on its way."""

    due: int
    frame: Frames


class _Disturbance:
    """One fault of the wire at work: what becomes of a frame, and what it adds."""

    def __init__(self, fault: Fault, network: Network, seed: str) -> None:
        self.fault = fault
        # A second sender needs a frame to begin with.
        self.from_cycle = fault.start - (fault.kind == "inject")
        self.messages = {message.frame_id: message for message in messages_of(fault, network)}
        self.random = random.Random(seed)
        self.late: list[_Late] = []
        self._network = network
        self._counters: dict[int, int] = {}  # where the counter of a message stood still
        self._held: dict[int, Frames] = {}  # waits for the next frame of its message
        self._last: Frames | None = None  # frame of the message that is injected
        self._effect = _EFFECTS[fault.kind]
        self.babble: Babble | None = None
        if fault.kind == "flood":
            self.babble = Babble(fault.target, fault["can_id"], fault["bytes"], fault["load"])
        self._chance = float(dict(fault.parameters).get("p", 1.0))

    def frames(self, frame: Frames, cycle: int) -> Sequence[Frames]:
        """What arrives instead of a frame. Shape (1,) each."""
        message = self.messages.get(_id(frame))
        if message is None:
            return (frame,)
        if self.random.random() >= self._chance:
            return (frame,)
        return self._effect(self, frame, message, cycle)

    def due(self, cycle: int) -> list[Frames]:
        """Frames that were late until this cycle. Shape (1,) each."""
        due = [one.frame for one in self.late if one.due <= cycle]
        self.late = self.late[len(due) :]
        return due

    def added(self, cycle: int) -> Iterable[Frames]:
        """Frames nobody sent, of this cycle. Shape (1,) each."""
        fault = self.fault
        if not fault.start <= cycle < fault.end:
            return ()
        match fault.kind:
            case "foreign":
                return [_foreign(fault) for _ in range(fault["count"])]
            case "error_frame":
                return [_error_frame(fault["error"])]
            case "bus_off" if cycle == fault.start:
                return [_error_frame(BUS_OFF)]
            case "inject":
                return self._injected()
        return ()

    # -- effects -----------------------------------------------------------------------------------------------------

    def _lose(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        return ()

    def _pass(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        return (frame,)

    def _duplicate(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        return (frame,) * (1 + int(self.fault["copies"]))

    def _delay(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        self.late.append(_Late(cycle + int(self.fault["by"]), frame))
        return ()

    def _reorder(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        earlier = self._held.pop(message.frame_id, None)
        if earlier is not None:
            return frame, earlier
        if cycle + 1 < self.fault.end:  # there will be a later one
            self._held[message.frame_id] = frame
            return ()
        return (frame,)

    def _flip(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        count = min(int(self.fault["bits"]), 8 * message.length)
        for bit in self.random.sample(range(8 * message.length), count):
            frame["data"][0, bit // 8] ^= 1 << bit % 8
        return (frame,)

    def _freeze_counter(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        counter = self._counters.setdefault(message.frame_id, int(frame["data"][0, COUNTER_BYTE]))
        return (_sealed(frame, message, counter=counter),)

    def _masquerade(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        return (_sealed(frame, self._network.message(self.fault["like"])),)

    def _length(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        _cut(frame, int(self.fault["bytes"]))
        return (_sealed(frame, message),)

    def _flags(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        flags = int(self.fault["flags"])
        frame["flags"] = flags if flags & FLAG_FDF else 0
        if not flags & FLAG_FDF:
            _cut(frame, min(int(frame["len"][0]), _CLASSIC_LENGTH))
        return (_sealed(frame, message),)

    def _change(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        self._set_signals(frame, message)
        return (_sealed(frame, message),)

    def _remember(self, frame: Frames, message: Message, cycle: int) -> Sequence[Frames]:
        self._last = frame.copy()
        return (frame,)

    # -- frames ------------------------------------------------------------------------------------------------------

    def _set_signals(self, frame: Frames, message: Message) -> None:
        payload = int.from_bytes(frame["data"][0].tobytes(), "little")
        for name, value in self.fault.signals.items():
            signal = message.signal(name)
            mask = (1 << signal.length) - 1
            code = value if self.fault.kind == "raw" else (value - signal.offset) / signal.factor
            payload = payload & ~(mask << signal.start) | (round(code) & mask) << signal.start
        frame["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)

    def _injected(self) -> Iterable[Frames]:
        (message,) = self.messages.values()
        if self._last is None:
            self._last = new_frames(1)
            self._last["can_id"], self._last["len"] = message.frame_id, message.length
            self._last["flags"] = FLAG_FDF | FLAG_BRS
        counter = int(self._last["data"][0, COUNTER_BYTE])
        for place in range(int(self.fault["count"])):
            frame = self._last.copy()
            self._set_signals(frame, message)
            yield _sealed(frame, message, counter=counter + int(self.fault["ahead"]) + place & 0xFF)


_EFFECTS: Final[dict[str, Callable[[_Disturbance, Frames, Message, int], Sequence[Frames]]]] = {
    "drop": _Disturbance._lose,
    "silence": _Disturbance._lose,
    "heartbeat_lost": _Disturbance._lose,
    "reset": _Disturbance._lose,
    "bus_off": _Disturbance._lose,
    "duplicate": _Disturbance._duplicate,
    "delay": _Disturbance._delay,
    "reorder": _Disturbance._reorder,
    "flip": _Disturbance._flip,
    "freeze_counter": _Disturbance._freeze_counter,
    "masquerade": _Disturbance._masquerade,
    "length": _Disturbance._length,
    "flags": _Disturbance._flags,
    "value": _Disturbance._change,
    "raw": _Disturbance._change,
    "inject": _Disturbance._remember,
    "foreign": _Disturbance._pass,
    "error_frame": _Disturbance._pass,
    "flood": _Disturbance._pass,
}


class FaultyBus(WrappedBus):
    """The emulator's end of a bus, with faults on the wire.

    Frames that come late or from nobody are on the wire when the SYNC of their cycle is: before what the HAL sent for the
    nodes, and before the nodes' answers for the HAL. What nobody sent is heard at both ends.
    """

    def __init__(
        self, bus: Bus, network: Network, faults: Sequence[Fault], clock: Callable[[], int], *, seed: int = 0
    ) -> None:
        """Put faults on a bus.

        Args:
            bus: the wire.
            faults: those of `LINK_KINDS` among them are its.
            clock: the emulator's cycle.
            seed: of what is left to chance.

        Raises:
            FaultError: the network has no such target or signal.
        """
        super().__init__(bus)
        #: The HAL sent a SYNC in the last `receive`, whatever became of it.
        self.synced = False
        self._clock, self._cycle, self._begun = clock, -1, -1
        self._all = [
            _Disturbance(fault, network, f"{seed} {place}")
            for place, fault in enumerate(faults)
            if fault.kind in LINK_KINDS
        ]
        self._active: list[_Disturbance] = []
        self._syncs = {m.frame_id for m in network.messages if m.name.startswith("SYNC_")}
        self._from_hal = {m.frame_id for m in network.sent_by("HAL")}
        self._for_nodes: list[Frames] = []  # what they have not taken yet
        #: The time the frames take on the buses, while there is a flood.
        self.wire = Wire(network)

    def send(self, frames: Frames) -> None:
        """What the nodes say, on its way to the HAL. Raises as the bus does."""
        if self._now() or not self.wire.idle:
            frames = joined(self._passed(frames, from_hal=False))
        if len(frames):
            self.bus.send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """What the HAL says, as the nodes hear it. Raises as the bus does."""
        count = self.bus.receive(frames, timeout)
        self.synced = not self._syncs.isdisjoint(frames["can_id"][:count].tolist())
        if self.synced:
            self._begin_cycle()
        # Commands may come ahead of their SYNC: they, too, are this cycle's.
        if self._now() or not self.wire.idle:
            self._for_nodes += self._passed(frames[:count], from_hal=True)
        elif self._for_nodes:
            self._for_nodes.append(frames[:count].copy())
        else:
            return count
        heard = joined(self._for_nodes)
        count = min(len(heard), len(frames))
        frames[:count] = heard[:count]
        self._for_nodes = [heard[count:]] if count < len(heard) else []
        return count

    def _now(self) -> list[_Disturbance]:
        """The faults of this cycle."""
        cycle = self._clock()
        if cycle != self._cycle:
            self._cycle = cycle
            self._active = [one for one in self._all if one.from_cycle <= cycle < one.fault.end]
        return self._active

    def _passed(self, frames: Frames, *, from_hal: bool) -> list[Frames]:
        """Frames one by one through every fault in turn, as far as they find time on the wire. Shape (1,) each."""
        passing = [frames[place : place + 1].copy() for place in range(len(frames))]
        for one in self._active:
            passing = [after for frame in passing for after in one.frames(frame, self._cycle)]
        return passing if self.wire.idle else self.wire.carry(passing, from_hal=from_hal)

    def _begin_cycle(self) -> None:
        """Frames that are due, and those of nobody, once a cycle."""
        self._now()
        if self._begun == self._cycle:
            return
        self._begun = self._cycle
        due = [frame for one in self._all if one.late for frame in one.due(self._cycle)]
        added = [frame for one in self._active for frame in one.added(self._cycle)]
        added += self.wire.begin([one.babble for one in self._active if one.babble is not None])
        self._for_nodes += [frame for frame in due if _id(frame) in self._from_hal]
        self._for_nodes += [frame for frame in added if not _id(frame) & ID_ERROR]  # which are no frames of the wire
        if for_hal := [frame for frame in due if _id(frame) not in self._from_hal] + added:
            self.bus.send(joined(for_hal))


def _id(frame: Frames) -> int:
    return int(frame["can_id"][0])


def _cut(frame: Frames, length: int) -> None:
    frame["len"] = length
    frame["data"][0, length:] = 0


def _sealed(frame: Frames, message: Message, *, counter: int | None = None) -> Frames:
    """With the CRC right for the length it has and the Data ID of a message; too short for a CRC: as it is."""
    payload = frame["data"][0]
    length = int(frame["len"][0])
    if length > COUNTER_BYTE:
        if counter is not None:
            payload[COUNTER_BYTE] = counter
        code = crc(payload[CRC_BYTES:length].tobytes(), data_id_bytes(message.data_id))
        payload[:CRC_BYTES] = tuple(code.to_bytes(CRC_BYTES, "little"))
    return frame


def _foreign(fault: Fault) -> Frames:
    frame = new_frames(1)
    can_id = fault["can_id"]
    frame["can_id"] = can_id if can_id <= _HIGHEST_STANDARD else can_id | ID_EXTENDED
    frame["len"], frame["flags"] = fault["bytes"], FLAG_FDF | FLAG_BRS
    return frame


def _error_frame(error: int) -> Frames:
    frame = new_frames(1)
    frame["can_id"], frame["len"] = ID_ERROR | error, 8
    return frame
