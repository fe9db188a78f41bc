"""Transceiver of the HAL: it sends only permitted frames, limits the frames received per cycle, and reports bus faults.

`bus <-> transceiver <-> process image`

Transmission is denied by default. A batch reaches the bus only if the header of each frame belongs to a message of this node.
A failing bus raises no exception. `faults` returns the faults, and the safety monitor raises their diagnostics.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from atalante_dbc import Message, Network
from atalante_hal.bus import Bus, BusError, BusFull
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.wire.e2e import SETTLED, qualify
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, Frames, as_words, header_word, new_frames
from atalante_hal.wire.process_image import ReceiveImage

#: Largest number of frames that are received in one cycle. In each cycle, the nodes send about 20 cyclic frames.
RECEIVE_BUDGET = 128
#: Number of consecutive cycles with too many received frames, or with a full transmit queue, that confirm the fault.
PERSISTENT = 5
#: Time to listen for another HAL before the first SYNC [s].
LISTEN = 0.2
#: Shortened wait [s] for nodes that will probably not answer, for example because the last SYNC was not sent.
#: `Transceiver.receive` lists all cases with a shortened wait, see its argument `patience`.
_DOUBTFUL_PATIENCE = 0.1
#: Class bit of an error frame that reports bus-off (linux/can/error.h).
ERROR_BUS_OFF = 0x40


class TransmitDenied(Exception):  # noqa: N818
    """Error of a program that tries to send a frame that this node may not send."""


class HalDuplicate(BusError):  # noqa: N818
    """Error of a HAL that starts while another HAL is active on the same bus."""


class FrameTap(Protocol):
    """Receiver of a copy of every frame that the HAL sends or receives, for a CAN log."""

    def sent(self, frames: Frames) -> None:
        """Log frames that were just passed to the bus.

        Args:
            frames: Sent frames, shape (n,).
        """

    def received(self, frames: Frames, count: int) -> None:
        """Log frames that were just received.

        Args:
            frames: Receive buffer, shape (m,).
            count: Number of received frames at the start of the buffer.
        """


class Outgoing:
    """Batch of frames that this node may send.

    `granted` is a copy of the headers that `Transceiver.grant` checked. So `send` detects a header that was changed later.

    Args:
        frames: Frames, shape (n,); always the same array.
    """

    def __init__(self, frames: Frames) -> None:
        self.frames = frames
        self.headers = as_words(frames)[:, 0]
        self.granted = self.headers.tobytes()


class Transceiver:
    """Transceiver of one node; it collects the faults of the bus until `faults` returns them."""

    def __init__(
        self, network: Network, node: str, bus: Bus, tap: FrameTap | None, *, cyclic: int, surplus: float
    ) -> None:
        """Prepare the receive buffer and the table of permitted frames.

        Args:
            network: CAN network that defines the messages of the node.
            node: DBC name of the sending node, such as HAL.
            bus: Open bus. The caller owns it.
            tap: Receiver of a copy of every frame; None if there is no receiver.
            cyclic: Number of frames received in a cycle without faults.
            surplus: Number of additional frames in a cycle above which a flood is reported, see `robot.Thresholds`.
        """
        self.bus, self.tap = bus, tap
        self._table = {_header(m) for m in network.sent_by(node)}
        self._own_ids = {m.frame_id for m in network.sent_by(node)}
        self._node = node
        self._most = cyclic + surplus
        #: Receive buffer, always the same array.
        self.scratch = new_frames(RECEIVE_BUDGET)
        self._found: list[Finding] = []  # faults found since the last call of `faults`
        self._refused = 0  # consecutive cycles in which the transmit queue was full
        self._full_this_cycle = False
        self._asked = True  # True if the last batch was sent completely
        self._floods = 0  # number of consecutive cycles with too many received frames
        self._error_frames = 0  # number of error frames since the last call of `faults`
        self._errors = SETTLED  # error counter: +4 in a cycle with error frames, otherwise -1, see `e2e.qualify`
        #: Number of error frames since the start, except frames that report bus-off.
        self.error_frames = 0
        self._bus_off = 0  # error bits of the last frame that reported bus-off; 0 if there was none since `acknowledge`
        #: True if the bus has no fault, so that `faults` need not be called.
        self.quiet = True

    def grant(self, frames: Frames) -> Outgoing:
        """Check the headers of a batch of frames and permit their transmission.

        Args:
            frames: Frames of messages of this node, shape (n,). `send` uses the same array later.

        Returns:
            The batch for `send`.

        Raises:
            TransmitDenied: If a frame is not a message of this node.
        """
        for header in as_words(frames)[:, 0].tolist():
            if header not in self._table:
                raise TransmitDenied(
                    f"{self._node} may send only its own messages, with the length and format of the DBC, "
                    f"got id 0x{header & 0xFFFFFFFF:X}"
                )
        return Outgoing(frames)

    def send(self, batch: Outgoing) -> None:
        """Send a batch. Frames that the bus rejects are dropped and not logged, and `faults` reports the loss.

        Args:
            batch: Batch that `grant` returned.

        Raises:
            TransmitDenied: If a header has changed since `grant`.
        """
        if batch.headers.tobytes() != batch.granted:
            raise TransmitDenied(
                f"a frame of {self._node} must keep the identifier, length and format that `grant` checked"
            )
        self._asked = False
        try:
            self.bus.send(batch.frames)
        except BusError as error:
            self._report_rejected(error)
            if self.tap is not None and error.sent:
                self.tap.sent(error.accepted_of(batch.frames))
        else:
            self._asked = True
            if self.tap is not None:
                self.tap.sent(batch.frames)

    def receive(self, count: int = 0, cycle: ReceiveImage | None = None, patience: float = 0.0) -> int:
        """Append received frames to the frames already in `scratch`, up to `RECEIVE_BUDGET` frames in total.

        Args:
            count: Number of frames already in `scratch`.
            cycle: Process image of the expected messages. With None, the call does not wait for messages.
            patience: Longest wait for the expected messages [s]. If the last batch, which contains the SYNC, was not sent, or
                if every node has timed out, the call waits at most 0.1 s. If none of the missing nodes answered the previous
                n SYNCs, the call waits at most `patience` / 2^n, or 0.1 s if this is longer. So in lock-step, a dead node does
                not cause the full wait in every cycle before it times out.

        Returns:
            Number of frames now in `scratch`.
        """
        first, scratch = count, self.scratch
        try:
            count += self.bus.receive(scratch[first:] if first else scratch)
        except BusError as error:
            self._report_down(error)
            if cycle is not None:  # The answers on the other channels of a `JoinedBus` have not arrived yet.
                count = self._receive_rest(first, count, cycle, min(patience, _DOUBTFUL_PATIENCE))
        else:
            self._log(first, count)
            if cycle is not None and (first or not cycle.begins(scratch, count)):
                count = self._receive_rest(first, count, cycle, patience)
        if count > self._most:
            self._find(Dtc.BUS_FLOOD, self._floods + 1 >= PERSISTENT, count, "")
        return count

    def foreign(self, frames: Frames) -> None:
        """Report received frames that are not for this node: error frames, frames that only this node may send, unknown frames.

        Args:
            frames: Received frames that are not in a process image, shape (n,).
        """
        for can_id in frames["can_id"].tolist():
            if can_id & ID_ERROR:
                if can_id & ERROR_BUS_OFF:
                    self._bus_off = can_id & ~ID_ERROR
                else:
                    self._error_frames += 1
                self.quiet = False
            elif can_id in self._own_ids:
                self._find(Dtc.HAL_DUPLICATE, True, can_id, f"another node sends id 0x{can_id:X} of this HAL")
            else:
                self._find(Dtc.FRAME_UNKNOWN, True, can_id, f"id 0x{can_id:X} is not a message to this HAL")

    def listen(self, seconds: float = LISTEN) -> None:
        """Check that no other HAL sends on the bus. Call this before the first frame of this HAL is sent.

        Frames that are received during this check are dropped.

        Args:
            seconds: Time to listen [s].

        Raises:
            HalDuplicate: If a message of this node was received.
            BusError: If the bus is down.
        """
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            count = self.bus.receive(self.scratch, left)
            duplicates = self._own_ids.intersection(self.scratch["can_id"][:count].tolist())
            if duplicates:
                raise HalDuplicate(
                    f"another HAL is active on {self.bus.name} (received id 0x{min(duplicates):X}): stop it first"
                )

    def receive_queued(self, unneeded: Sequence[int]) -> Frames:
        """Receive all queued frames, at most `RECEIVE_BUDGET` batches. Call this after a gap between cycles.

        The frames are logged, but they do not count for BUS_FLOOD.

        Args:
            unneeded: Identifiers of the frames to drop.

        Returns:
            Received frames with other identifiers, shape (n,), in order of arrival.
        """
        kept = []
        try:
            for _ in range(RECEIVE_BUDGET):
                count = self.bus.receive(self.scratch)
                if self.tap is not None:
                    self.tap.received(self.scratch, count)
                kept.append(self.scratch[:count][np.isin(self.scratch["can_id"][:count], unneeded, invert=True)])
                if count < RECEIVE_BUDGET:
                    break
        except BusError as error:
            self._find(Dtc.BUS_DOWN, True, 0.0, f"{error}")
        return np.concatenate(kept) if kept else new_frames(0)

    def acknowledge(self) -> None:
        """Clear a bus-off that the operator has acknowledged, so that `faults` no longer returns it.

        A later bus-off is returned again.
        """
        self._bus_off = 0

    def faults(self) -> list[Finding]:
        """Return the bus faults found since the last call.

        Call this method once per cycle, because it counts for how many cycles a fault lasts. A bus-off is returned in every
        call until `acknowledge` is called.
        """
        self._refused = self._refused + 1 if self._full_this_cycle else 0
        self._full_this_cycle = False
        self._floods = self._floods + 1 if any(finding.dtc is Dtc.BUS_FLOOD for finding in self._found) else 0
        self._check_error_frames()
        if self._bus_off:
            self._find(Dtc.BUS_OFF, True, self._bus_off, "")
        found, self._found = self._found, []
        self.quiet = self._errors is SETTLED and not (self._refused or self._floods or self._bus_off)
        return found

    def _check_error_frames(self) -> None:
        """Count the error frames of this cycle, and report them as BUS_ERROR.

        BUS_ERROR is confirmed if more than a fifth of the cycles have error frames.
        """
        count, self._error_frames = self._error_frames, 0
        self.error_frames += count
        if count or self._errors is not SETTLED:
            self._errors = qualify(self._errors, good=not count)
        if count or not self._errors.trusted:
            text = (
                f"{self.error_frames} error frames on {self.bus.name} so far: check wiring, termination and bit timing"
            )
            self._find(Dtc.BUS_ERROR, not self._errors.trusted, self.error_frames, text)

    def _report_rejected(self, error: BusError) -> None:
        """Report an error of `send`: a full transmit queue, a bus that is down, or both if the bus has several channels."""
        full = error if isinstance(error, BusFull) else error.full
        if full is not None:
            self._full_this_cycle = True
            self._find(Dtc.BUS_TX_FULL, self._refused + 1 >= PERSISTENT, full.sent, f"{full}")
        if full is not error:
            self._find(Dtc.BUS_DOWN, True, 0.0, f"{error}")

    def _report_down(self, error: BusError) -> None:
        """Report an error of `receive`, once per cycle."""
        if all(finding.text != str(error) for finding in self._found):
            self._find(Dtc.BUS_DOWN, True, 0.0, f"{error}")

    def _log(self, first: int, count: int) -> None:
        """Pass the frames `scratch[first:count]` to the tap. Call this before the next `bus.receive`.

        The next `bus.receive` overwrites the times of the frames in `bus.stamps`.
        """
        if self.tap is not None and count > first:
            self.tap.received(self.scratch[first:] if first else self.scratch, count - first)

    def _find(self, dtc: Dtc, confirmed: bool, value: float, text: str) -> None:
        self._found.append(Finding(dtc, self._node, value, confirmed, text))
        self.quiet = False

    def _receive_rest(self, first: int, count: int, cycle: ReceiveImage, patience: float) -> int:
        """Wait until every expected message of `cycle` has arrived in `scratch[first:]`, at most `patience` [s].

        An error of the bus ends the wait. The frames that arrived before the error are kept: if one channel of a `JoinedBus` is
        lost, these are the frames of the other channels.

        Returns:
            Number of frames now in `scratch`.
        """
        missing = cycle.expected_ages()
        shortest = min(patience, _DOUBTFUL_PATIENCE)
        # If every node has timed out, `missing` is empty. In this case, receive frames until the bus is silent.
        # If the call did not wait, the HAL would regard a late answer to this SYNC as an answer to the next SYNC.
        until_silent = not missing
        begun = time.monotonic()
        while count < RECEIVE_BUDGET:
            for can_id in self.scratch["can_id"][first:count].tolist():
                missing.pop(can_id, None)
            longest = max(shortest, patience / 2 ** min(missing.values())) if missing and self._asked else shortest
            remaining = begun + longest - time.monotonic()
            if remaining <= 0.0 or not (missing or until_silent):
                break
            first = count
            try:
                got = self.bus.receive(self.scratch[count:], remaining)
            except BusError as error:
                self._report_down(error)
                # Without a pause, lock-step cycles on a failing bus would run too fast.
                time.sleep(max(0.0, min(begun + patience - time.monotonic(), _DOUBTFUL_PATIENCE)))
                break
            if got == 0:
                break
            count += got
            self._log(first, count)
        return count


def _header(message: Message) -> int:
    return header_word(message.frame_id, message.length, FLAG_FDF | FLAG_BRS)
