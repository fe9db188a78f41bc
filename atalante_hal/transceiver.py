"""The HAL's end of the bus: what leaves is in its table, what comes in a cycle is bounded, and a bus that fails raises nothing.

`bus -> transceiver -> process image`, and back.

Transmit is default-deny: a batch whose frames are not, header by header, messages this node sends does not reach the bus.
"""

from __future__ import annotations

import time
from typing import Protocol

from atalante_dbc import Message, Network
from atalante_hal.bus import Bus, BusError, BusFull
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, Frames, as_words, header_word, new_frames
from atalante_hal.wire.process_image import ReceiveImage

#: Frames one cycle can take; the cyclic set is about 20.
RECEIVE_BUDGET = 128
#: Cycles in a row after which a flood, or a transmit queue without room, is confirmed.
PERSISTENT = 5
#: Time to listen for another HAL before the first SYNC [s].
LISTEN = 0.2
#: Longest wait [s] for answers that nobody may give: no node has been heard, or what would ask them was not sent.
_DOUBTFUL_PATIENCE = 0.1
#: Class of an error frame that says bus-off, linux/can/error.h.
ERROR_BUS_OFF = 0x40


class TransmitDenied(Exception):  # noqa: N818
    """A frame that this node may not send; the program has a defect."""


class HalDuplicate(BusError):  # noqa: N818
    """Another HAL is at work on this bus."""


class FrameTap(Protocol):
    """Sees every frame the HAL sends and receives, for a CAN log."""

    def sent(self, frames: Frames) -> None:
        """Frames just handed to the bus."""

    def received(self, frames: Frames, count: int) -> None:
        """`frames[:count]` as they came from the bus."""


class Outgoing:
    """A batch of frames that may be sent, always the same array."""

    def __init__(self, frames: Frames) -> None:
        self.frames = frames
        self.headers = as_words(frames)[:, 0]
        self.granted = self.headers.tobytes()


class Transceiver:
    """Sends and receives for one node; collects what is wrong with the bus until `judge`."""

    def __init__(
        self, network: Network, node: str, bus: Bus, tap: FrameTap | None, *, cyclic: int, surplus: float
    ) -> None:
        """Begin.

        Args:
            cyclic: frames a perfect cycle brings.
            surplus: frames more than that are a flood, see `robot.Thresholds`.
        """
        self.bus, self.tap = bus, tap
        self._table = {_header(m) for m in network.sent_by(node)}
        self._own_ids = {m.frame_id for m in network.sent_by(node)}
        self._node = node
        self._most = cyclic + surplus
        #: Receive buffer, always the same array.
        self.scratch = new_frames(RECEIVE_BUDGET)
        #: Found since the last `judge`: code, whether confirmed, value, sentence.
        self._found: list[tuple[Dtc, bool, float, str]] = []
        self._refused = 0  # batches in a row for which the transmit queue had no room
        self._full_this_cycle = False
        self._asked = True  # the last batch has left whole
        self._floods = 0  # cycles in a row
        self._bus_off = 0  # error class of the frame that said so, until the operator acknowledges it
        #: Nothing is wrong with the bus.
        self.quiet = True

    def grant(self, frames: Frames) -> Outgoing:
        """Make a batch that may be sent.

        Raises:
            TransmitDenied: a frame is no message of this node.
        """
        for header in as_words(frames)[:, 0].tolist():
            if header not in self._table:
                raise TransmitDenied(f"{self._node} may not send id 0x{header & 0xFFFFFFFF:X} in this format")
        return Outgoing(frames)

    def send(self, batch: Outgoing) -> None:
        """Send a batch; what the bus refuses is dropped and told in `judge`.

        Raises:
            TransmitDenied: a header was changed since it was granted.
        """
        if batch.headers.tobytes() != batch.granted:
            raise TransmitDenied(f"a frame of {self._node} has another identifier, length or format than was granted")
        self._asked = False
        try:
            self.bus.send(batch.frames)
        except BusFull as error:
            self._full_this_cycle = True
            self._find(Dtc.BUS_TX_FULL, self._refused + 1 >= PERSISTENT, error.sent, f"{error}")
        except BusError as error:
            self._find(Dtc.BUS_DOWN, True, 0.0, f"the bus {self.bus.name} refuses frames: {error}")
        else:
            self._asked = True
            if self.tap is not None:
                self.tap.sent(batch.frames)

    def receive(self, count: int = 0, cycle: ReceiveImage | None = None, patience: float = 0.0) -> int:
        """Append to the first `count` frames of `scratch` what the bus has, at most the budget.

        Args:
            cycle: wait for its messages; None: what is there at once will do.
            patience: longest wait for them [s]; shorter when the last batch, their SYNC, did not leave.

        Returns:
            Frames in the buffer now.
        """
        first, scratch = count, self.scratch
        try:
            count += self.bus.receive(scratch[first:] if first else scratch)
            if cycle is not None and (first or not cycle.begins(scratch, count)):
                count = self._receive_rest(first, count, cycle.expected_ids(), patience)
        except BusError as error:
            self._find(Dtc.BUS_DOWN, True, 0.0, f"the bus {self.bus.name} fails: {error}")
            count = first
        if self.tap is not None:
            self.tap.received(scratch[first:] if first else scratch, count - first)
        if count > self._most:
            self._find(Dtc.BUS_FLOOD, self._floods + 1 >= PERSISTENT, count, "")
        return count

    def foreign(self, frames: Frames) -> None:
        """Frames that nobody may send to this node: unknown, its own, or what the controller says of itself."""
        for can_id in frames["can_id"].tolist():
            if can_id & ID_ERROR:
                if can_id & ERROR_BUS_OFF:
                    self._bus_off = can_id & ~ID_ERROR
                    self.quiet = False
            elif can_id in self._own_ids:
                self._find(Dtc.HAL_DUPLICATE, True, can_id, f"somebody else sends id 0x{can_id:X}, which is this HAL's")
            else:
                self._find(Dtc.FRAME_UNKNOWN, True, can_id, f"id 0x{can_id:X} is no message to this HAL")

    def listen(self, seconds: float = LISTEN) -> None:
        """Hear whether another HAL is at work, before the first frame is sent; what else comes is dropped.

        Raises:
            HalDuplicate: a message of this node was heard.
            BusError: the bus is gone.
        """
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            count = self.bus.receive(self.scratch, left)
            heard = self._own_ids.intersection(self.scratch["can_id"][:count].tolist())
            if heard:
                raise HalDuplicate(
                    f"another HAL is at work on {self.bus.name} (id 0x{min(heard):X} was heard): end it first"
                )

    def discard(self) -> None:
        """Drop what has piled up: the answers to SYNCs of long ago."""
        try:
            for _ in range(RECEIVE_BUDGET):
                if self.bus.receive(self.scratch) < RECEIVE_BUDGET:
                    return
        except BusError as error:
            self._find(Dtc.BUS_DOWN, True, 0.0, f"the bus {self.bus.name} fails: {error}")

    def acknowledge(self) -> None:
        """The operator starts again: a controller that was bus-off may be used, if it can."""
        self._bus_off = 0

    def judge(self, cycle: int, memory: FaultMemory) -> None:
        """Raise what was found since the last `judge`, and a bus-off that nobody has acknowledged."""
        self._refused = self._refused + 1 if self._full_this_cycle else 0
        self._full_this_cycle = False
        self._floods = self._floods + 1 if any(dtc is Dtc.BUS_FLOOD for dtc, *_ in self._found) else 0
        for dtc, confirmed, value, text in self._found:
            memory.raise_dtc(cycle, dtc, self._node, value=value, confirmed=confirmed, text=text)
        self._found.clear()
        if self._bus_off:
            memory.raise_dtc(cycle, Dtc.BUS_OFF, self._node, value=self._bus_off)
        self.quiet = not (self._refused or self._floods or self._bus_off)

    def _find(self, dtc: Dtc, confirmed: bool, value: float, text: str) -> None:
        self._found.append((dtc, confirmed, value, text))
        self.quiet = False

    def _receive_rest(self, first: int, count: int, expected: set[int], patience: float) -> int:
        """Wait until every expected message has come after the `first` frames, at most `patience` [s]."""
        # Nobody heard yet: take whoever answers until they fall silent, so that no answer is left for the next cycle.
        nobody = not expected
        deadline = time.monotonic() + (min(patience, _DOUBTFUL_PATIENCE) if nobody or not self._asked else patience)
        while count < RECEIVE_BUDGET:
            expected.difference_update(self.scratch["can_id"][first:count].tolist())
            remaining = deadline - time.monotonic()
            if remaining <= 0.0 or not (expected or nobody):
                break
            first = count
            got = self.bus.receive(self.scratch[count:], remaining)
            if got == 0:
                break
            count += got
        return count


def _header(message: Message) -> int:
    return header_word(message.frame_id, message.length, FLAG_FDF | FLAG_BRS)
