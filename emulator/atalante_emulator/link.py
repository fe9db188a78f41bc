"""Injected communication faults: a bus wrapper that loses, changes, delays and adds frames in both directions.

    HAL <- bus <- FaultyBus.send <- nodes
    HAL -> bus -> FaultyBus.receive -> nodes

With the same seed and the same frames on both sides, the result is the same. Frames without an active fault pass unchanged.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np

from atalante_dbc import Message, Network
from atalante_emulator.faults import LINK_KINDS, Fault, messages_of
from atalante_emulator.wire import AddedFrame, Babble, Wire
from atalante_hal.bus import Bus, BusFull
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, ID_EXTENDED, Frames, joined, new_frames

#: Bit of a CAN error frame that reports bus-off. The bit is in the identifier (CAN_ERR_BUSOFF of linux/can/error.h).
BUS_OFF: Final = 0x40
_HIGHEST_STANDARD: Final = 0x7FF
_CLASSIC_LENGTH: Final = 8


class _Late(NamedTuple):
    """Frame that a fault delays."""

    due: int  # number of the cycle in which the delayed frame is sent
    frame: Frames  # delayed frame, shape (1,)


class _Disturbance:
    """One communication fault during a run. Its methods change, delay and add frames."""

    def __init__(self, fault: Fault, network: Network, seed: str) -> None:
        self.fault = fault
        # A fault of kind `inject` sends copies of the last real frame. The fault needs such a frame in its first cycle,
        # so it records real frames from one cycle earlier.
        self.from_cycle = fault.start - (fault.kind == "inject")
        self.messages = {message.frame_id: message for message in messages_of(fault, network)}
        self.random = random.Random(seed)
        self.late: list[_Late] = []
        self._network = network
        self._counters: dict[int, int] = {}  # for kind `freeze_counter`: frame identifier -> frozen alive counter
        #: For kind `reorder`: frame identifier -> held frame, which is sent after the next frame of the message.
        self._held: dict[int, Frames] = {}
        self._last: Frames | None = None  # for kind `inject`: last real frame of the target message
        self._effect = _EFFECTS[fault.kind]
        self.babble: Babble | None = None
        if fault.kind == "flood":
            self.babble = Babble(fault.target, fault["can_id"], fault["bytes"], fault["load"])
        self._chance = float(dict(fault.parameters).get("p", 1.0))

    def frames(self, frame: Frames, cycle: int) -> Sequence[Frames]:
        """With the probability `p`, apply the fault to a frame. Return the frames to send instead, each of shape (1,).

        Args:
            frame: frame of a target message of the fault, shape (1,). The function may change this frame.
            cycle: number of the cycle.
        """
        return self.changed(frame, cycle) if self.strikes() else (frame,)

    def strikes(self) -> bool:
        """Draw at random whether the fault affects the next frame of its target messages."""
        return self.random.random() < self._chance

    def changed(self, frame: Frames, cycle: int) -> Sequence[Frames]:
        """Apply the fault to a frame. Return the frames to send instead, each of shape (1,).

        Args:
            frame: frame that the fault affects, shape (1,). The function may change this frame.
            cycle: number of the cycle.
        """
        return self._effect(self, frame, self.messages[_id(frame)], cycle)

    def due(self, cycle: int) -> list[Frames]:
        """Return the delayed frames to send in a cycle, each of shape (1,), and remove them from `late`.

        Args:
            cycle: number of the cycle.
        """
        due = [late.frame for late in self.late if late.due <= cycle]
        self.late = self.late[len(due) :]
        return due

    def added(self, cycle: int) -> Iterable[AddedFrame]:
        """Return the frames that the fault adds in a cycle, except the frames of a flood.

        Args:
            cycle: number of the cycle.
        """
        fault = self.fault
        if not fault.start <= cycle < fault.end:
            return ()
        match fault.kind:
            case "foreign":
                return [AddedFrame(fault.target, _foreign(fault)) for _ in range(fault["count"])]
            case "error_frame":
                return [AddedFrame(fault.target, _error_frame(fault["error"]))]
            case "bus_off" if cycle == fault.start:
                return [AddedFrame(fault.target, _error_frame(BUS_OFF))]
            case "inject":
                return self._injected()
        return ()

    # -- effects of the fault kinds ----------------------------------------------------------------------------------

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
        # Keep `frame` until the next frame of the message arrives. In the last cycle of the fault, send `frame` immediately.
        if cycle + 1 < self.fault.end:
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

    # -- contents of frames ------------------------------------------------------------------------------------------

    def _set_signals(self, frame: Frames, message: Message) -> None:
        payload = int.from_bytes(frame["data"][0].tobytes(), "little")
        for name, value in self.fault.signals.items():
            signal = message.signal(name)
            mask = (1 << signal.length) - 1
            code = value if self.fault.kind == "raw" else (value - signal.offset) / signal.factor
            payload = payload & ~(mask << signal.start) | (round(code) & mask) << signal.start
        frame["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)

    def _injected(self) -> Iterable[AddedFrame]:
        (message,) = self.messages.values()
        if self._last is None:
            self._last = new_frames(1)
            self._last["can_id"], self._last["len"] = message.frame_id, message.length
            self._last["flags"] = FLAG_FDF | FLAG_BRS
        counter = int(self._last["data"][0, COUNTER_BYTE])
        for number in range(int(self.fault["count"])):
            frame = self._last.copy()
            self._set_signals(frame, message)
            counted = _sealed(frame, message, counter=counter + int(self.fault["ahead"]) + number & 0xFF)
            yield AddedFrame(message.bus, counted)


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
    """Bus of the emulated nodes with injected communication faults.

    Delayed frames, and frames that a fault adds, are sent when the SYNC of their cycle arrives. A delayed frame of the HAL
    reaches the nodes, and a delayed frame of a node reaches the HAL. Added frames reach both the HAL and the nodes, except
    error frames, which reach only the HAL. The nodes receive delayed and added frames before the other frames of the HAL. The
    HAL receives delayed and added frames before the answers of the nodes.
    """

    def __init__(
        self, bus: Bus, network: Network, faults: Sequence[Fault], clock: Callable[[], int], *, seed: int = 0
    ) -> None:
        """Wrap the bus of the nodes, and prepare the faults.

        Args:
            bus: bus to the HAL.
            network: nodes and messages of the DBC.
            faults: faults to inject. Faults whose kind is not in `LINK_KINDS` are ignored.
            clock: function that returns the cycle number of the emulator.
            seed: seed of the random faults.

        Raises:
            FaultError: If the target or a signal of a fault is not in the network.
        """
        super().__init__(bus)
        #: Whether the HAL sent a SYNC in the current call of `Emulator.poll`. Each call first sets `synced` to False.
        #: A SYNC also counts if an injected fault removed it, so that no node received it.
        self.synced = False
        self._clock, self._cycle, self._begun = clock, -1, -1
        self._all = [
            _Disturbance(fault, network, f"{seed} {number}")
            for number, fault in enumerate(faults)
            if fault.kind in LINK_KINDS
        ]
        self._active: list[_Disturbance] = []
        self._acting: dict[int, list[_Disturbance]] = {}  # frame identifier -> active faults that affect such frames
        self._syncs = {m.frame_id for m in network.messages if m.name.startswith("SYNC_")}
        self._from_hal = {m.frame_id for m in network.sent_by("HAL")}
        self._for_nodes: list[Frames] = []  # frames that the next `receive` returns to the nodes
        #: Model of the arbitration: selects the frames that are sent in a cycle during a fault `flood`. All other frames wait.
        self.wire = Wire(network)

    def send(self, frames: Frames) -> None:
        """Apply the active faults to frames of the nodes, and send the resulting frames to the HAL.

        Args:
            frames: frames of the nodes, shape (n,).

        Raises:
            BusError: If the wrapped bus raises this error.
        """
        if self._now() or not self.wire.idle:
            frames = joined(self._passed(frames, from_hal=False))
        if len(frames):
            self.bus.send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames of the HAL, and apply the active faults before the nodes get the frames.

        Args:
            frames: receive buffer, shape (n,).
            timeout: longest wait for the first frame [s].

        Returns:
            Number of frames in the buffer.

        Raises:
            BusError: If the wrapped bus raises this error.
        """
        count = self.bus.receive(frames, timeout)
        if not self._syncs.isdisjoint(frames["can_id"][:count].tolist()):
            self.synced = True
            self._begin_cycle()
        # Apply the faults even if no SYNC has arrived yet: a command can arrive before the SYNC of its cycle.
        if self._now() or not self.wire.idle:
            self._for_nodes += self._passed(frames[:count], from_hal=True)
        elif self._for_nodes:
            self._for_nodes.append(frames[:count].copy())
        else:
            return count
        received = joined(self._for_nodes)
        count = min(len(received), len(frames))
        frames[:count] = received[:count]
        self._for_nodes = [received[count:]] if count < len(received) else []
        return count

    def _now(self) -> list[_Disturbance]:
        """Return the faults that are active in this cycle."""
        cycle = self._clock()
        if cycle != self._cycle:
            self._cycle = cycle
            active = [d for d in self._all if d.from_cycle <= cycle < d.fault.end]
            if active != self._active:
                self._active, self._acting = active, {}
                for disturbance in active:
                    for can_id in disturbance.messages:
                        self._acting.setdefault(can_id, []).append(disturbance)
        return self._active

    def _passed(self, frames: Frames, *, from_hal: bool) -> list[Frames]:
        """Apply all active faults to each frame. Return the frames that are sent in this cycle."""
        passing: list[Frames] = []
        # Index of the first frame that is not yet in `passing`. No fault has changed the frames from this index to `row - 1`.
        unchanged = 0
        for row, can_id in enumerate(frames["can_id"].tolist()):
            acting = self._acting.get(can_id, ())
            for number, disturbance in enumerate(acting, 1):
                if disturbance.strikes():
                    if unchanged < row:
                        passing.append(frames[unchanged:row].copy())
                    copies = disturbance.changed(frames[row : row + 1].copy(), self._cycle)
                    for later in acting[number:]:
                        copies = [after for frame in copies for after in later.frames(frame, self._cycle)]
                    passing += copies
                    unchanged = row + 1
                    break
        passing.append(frames[unchanged:].copy())
        if self.wire.idle:
            return passing
        single = [part[row : row + 1] for part in passing for row in range(len(part))]
        return self.wire.carry(single, from_hal=from_hal)

    def _begin_cycle(self) -> None:
        """Send the frames that the faults delayed until this cycle, and the frames that the faults add in this cycle.

        A second call in the same cycle does nothing.
        """
        self._now()
        if self._begun == self._cycle:
            return
        self._begun = self._cycle
        due = [frame for d in self._all if d.late for frame in d.due(self._cycle)]
        added = [frame for d in self._active for frame in d.added(self._cycle)]
        added += self.wire.begin([d.babble for d in self._active if d.babble is not None])
        self._for_nodes += [frame for frame in due if _id(frame) in self._from_hal]
        self._for_nodes += [frame for _, frame in added if not _id(frame) & ID_ERROR]  # only the HAL gets error frames
        for_hal: dict[Bus, list[Frames]] = {}
        if late := [frame for frame in due if _id(frame) not in self._from_hal]:
            for_hal[self.bus] = late
        for bus, frame in added:
            for_hal.setdefault(self._channel(bus), []).append(frame)
        for channel, frames in for_hal.items():
            with suppress(BusFull):  # frames that find no room in the transmit queue are lost
                channel.send(joined(frames))

    def _channel(self, bus: str) -> Bus:
        """Return the channel for the frames that faults add to a bus.

        A `JoinedBus` selects a channel by the frame identifier, but an added frame may have any identifier.
        """
        return self.bus.channel(bus) if isinstance(self.bus, JoinedBus) else self.bus


def _id(frame: Frames) -> int:
    return int(frame["can_id"][0])


def _cut(frame: Frames, length: int) -> None:
    frame["len"] = length
    frame["data"][0, length:] = 0


def _sealed(frame: Frames, message: Message, *, counter: int | None = None) -> Frames:
    """Write a valid CRC into a frame, and return the frame.

    The CRC also covers the Data ID, a number that the DBC gives to `message` and that is not in the frame.

    If `counter` is given, the function also writes this alive counter. A frame that is too short for an alive counter stays
    unchanged.
    """
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
