"""Node tester: replaces the HAL for one node. Each cycle is `SYNC -> state message of the node -> command`.

The tester records every frame of the node. The same examination tests a real node on a bus in real time, or an emulated
node in this process in lock-step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from atalante_dbc import Message, Network, Node
from atalante_hal.bus import Bus, BusFull
from atalante_hal.robot import Robot
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import ID_ERROR, ID_EXTENDED, ID_REMOTE, Frames, as_words, new_frames
from atalante_tools.conform.frames import MessageReceiver, MessageSender, ReceivedFrame
from atalante_tools.conform.technician import Action, Technician
from atalante_tools.console.outcome import Failed

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator

#: Size of the receive buffer [frames].
_RECEIVE_BUDGET: Final = 128
#: Longest wait for the state message that answers SYNC [s]. Then the tester sends the command, even without a state message.
_PATIENCE: Final = 0.6e-3
#: Time to listen for another HAL before the first frame is sent [s].
_LISTEN: Final = 0.2


class NotTested(Exception):  # noqa: N818
    """Raised if a requirement cannot be tested. The message gives the reason."""


class Clock(Protocol):
    """Clock that starts the cycles."""

    delay: float  # largest delay of a cycle start in the current test, caused by this computer [s]

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """Wait for the start of the next cycle.

        Args:
            sync: True if the cycle starts with SYNC.
            listen: function that receives frames for a given time [s]. It is called during the wait.
        """

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """Return the receive time of a frame [s].

        Args:
            stamp_ns: time stamp of the bus [ns].
            cycle: number of the cycle in which the frame was received.
        """


class LockStep:
    """Lock-step clock for an emulated node. The emulated node answers without delay.

    An emulated node normally runs one cycle per SYNC. After several cycles without SYNC, this clock advances the node.
    """

    def __init__(self, emulator: Emulator) -> None:
        from atalante_emulator.drive import WATCHDOG

        self.delay = 0.0
        self._emulator = emulator
        self._watchdog = WATCHDOG
        self._silent = 0

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """Start the next cycle without a wait.

        From the `WATCHDOG`-th consecutive cycle without SYNC, also advance the node.
        """
        self._silent = 0 if sync else self._silent + 1
        if self._silent >= self._watchdog:
            self._emulator.idle()

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """Return the start time of the cycle in which the frame was received [s]."""
        return cycle * PERIOD


class WallClock:
    """Real-time clock that starts a cycle every millisecond.

    After a delay of more than 1 ms, the clock continues from the current time. It does not make up for missed cycles, because the
    node would then receive several SYNCs at once.
    """

    def __init__(self) -> None:
        self.delay = 0.0
        self._deadline = time.monotonic()

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """Receive frames until the next cycle starts."""
        self._deadline += PERIOD
        while (left := self._deadline - time.monotonic()) > 0.0:
            listen(left)
        listen(0.0)  # if this process woke up late, the frames in the receive buffer belong to the old cycle
        delay = -left
        self.delay = max(self.delay, delay)
        if delay > PERIOD:
            self._deadline = time.monotonic()

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """Return the time stamp that the bus gave the frame [s]."""
        return stamp_ns * 1e-9


@dataclass(frozen=True)
class Limits:
    """Limits of the commands to the node."""

    torque: float = 3.0  # largest torque commanded to a drive [Nm]


class NodeTester:
    """Tester of one node: sends SYNC and commands, and records every frame of the node.

    Attributes:
        received: recorded frames of the node. The test of the start-up (NODE-01) empties this list.
        unexpected: description of each 29-bit or remote frame with the identifier number of a message of the node. Such a
            frame is not in `received`. NODE-01 empties this list, too.
        frame_count: number of frames of the node recorded so far, including the frames that were removed from `received`.
        cycle_number: number of past cycles of 1 ms, with or without SYNC.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        node: Node,
        bus: Bus,
        clock: Clock,
        technician: Technician,
        limits: Limits | None = None,
    ) -> None:
        self.network, self.robot, self.node, self.clock, self.technician = network, robot, node, clock, technician
        self.limits = limits or Limits()
        self.received: list[ReceivedFrame] = []
        self.unexpected: list[str] = []
        self.frame_count = 0
        self.cycle_number = 0
        self.sync = MessageSender(network.message(f"SYNC_{self._of_node('STATE').bus.upper()}"))
        self.state_message = self._of_node("STATE")
        self.status_message = self._of_node("STATUS")
        self.emergency_message = self._of_node("EMCY")
        commands = [
            m for m in network.received_by(node.name) if m.sender == "HAL" and m.cycle_ms and m != self.sync.message
        ]
        commands = [m for m in commands if not m.name.endswith("_STATUS")]
        self._command = MessageSender(commands[0], self.sync) if commands else None
        self._bus = bus
        self._receivers = {m.frame_id: MessageReceiver(m) for m in network.sent_by(node.name)}
        self._masters = {m.frame_id: m.name for m in network.sent_by("HAL")}
        self._scratch = new_frames(_RECEIVE_BUDGET)
        self._outboxes: dict[int, Frames] = {}
        self._singles = [self._scratch[row : row + 1] for row in range(_RECEIVE_BUDGET)]

    @property
    def command(self) -> MessageSender:
        """Return the sender of the command message for this node."""
        assert self._command is not None, f"{self.node.name} receives no command"
        return self._command

    def _of_node(self, kind: str) -> Message:
        return self.network.message(f"{self.node.name}_{kind}")

    def require_no_other_master(self) -> None:
        """Listen on the bus and fail if another HAL is active.

        Raises:
            Failed: If a frame of another HAL is received.
        """
        deadline = time.monotonic() + _LISTEN
        while (left := deadline - time.monotonic()) > 0.0:
            count = self._bus.receive(self._scratch, left)
            for frame_id in self._scratch["can_id"][:count].tolist():
                if frame_id in self._masters:
                    raise Failed(
                        f"another HAL is active on {self._bus.name} ({self._masters[frame_id]} was received); stop it first"
                    )

    # -- one cycle -----------------------------------------------------------------------------------------------------

    def cycle(self, *commands: Frames, sync: Frames | None = None, before: Frames | None = None) -> list[ReceivedFrame]:
        """Run one cycle of 1 ms: send SYNC, receive the answers, send the commands.

        Args:
            *commands: frames to send after the answers, shape (n,) each.
            sync: frames to send in place of the next SYNC, shape (n,).
            before: frames to send before SYNC, shape (n,).

        Returns:
            Frames of the node since the SYNC.
        """
        if sync is None:
            sync = self.sync_frame()
        self.clock.next_cycle(sync=True, listen=self._listen)
        self.cycle_number += 1
        if before is not None:
            self._send(before)
        self._send(sync)
        first = len(self.received)
        self._listen_for_answer()
        for frames in commands:
            self._send(frames)
        return self.received[first:]

    def silent_cycle(self) -> list[ReceivedFrame]:
        """Run one cycle of 1 ms without sending, and return the frames of the node."""
        first = len(self.received)
        self.clock.next_cycle(sync=False, listen=self._listen)
        self.cycle_number += 1
        self._listen(0.0)
        return self.received[first:]

    def sync_frame(
        self, *, counter: int | None = None, length: int | None = None, classic: bool = False, flip: int | None = None
    ) -> Frames:
        """Return the next SYNC, optionally defective. Shape (1,).

        Args:
            counter: alive counter of the frame; None means the next alive counter.
            length: payload length [byte]; None means the length in the DBC.
            classic: True for a classic CAN frame.
            flip: payload bit that is inverted after the CRC is written.
        """
        cycle = {"Cycle": self.cycle_number + 1 & 0xFFFFFFFF}
        return self.sync.frame(cycle, counter=counter, length=length, classic=classic, flip=flip)

    def _send(self, frames: Frames) -> None:
        # Keep one array for each number of frames and fill it again, because a bus caches memory views of each array object.
        outbox = self._outboxes.setdefault(len(frames), new_frames(len(frames)))
        as_words(outbox)[:] = as_words(frames)
        try:
            self._bus.send(outbox)
        except BusFull:
            # A full transmit queue is expected while the node is switched off, because no node acknowledges the frames.
            return

    def _listen(self, timeout: float) -> None:
        self._record(self._bus.receive(self._scratch, timeout))

    def _listen_for_answer(self) -> None:
        first = len(self.received)
        deadline = time.monotonic() + _PATIENCE
        left = _PATIENCE
        while left > 0.0:
            count = self._bus.receive(self._scratch, left)
            self._record(count)
            if not count or any(frame.message is self.state_message for frame in self.received[first:]):
                return
            left = deadline - time.monotonic()

    def _record(self, count: int) -> None:
        if not count:
            return
        stamps = self._bus.stamps
        for row, can_id in enumerate(self._scratch["can_id"][:count].tolist()):
            receiver = self._receivers.get(can_id)
            if receiver is not None:
                stamp = self.clock.time_of(int(stamps[row]), self.cycle_number)
                self.received.append(receiver.decode(self._singles[row], self.cycle_number, stamp))
                self.frame_count += 1
            elif can_id & (ID_EXTENDED | ID_REMOTE) and not can_id & ID_ERROR:
                self._record_unexpected(can_id)

    def _record_unexpected(self, can_id: int) -> None:
        receiver = self._receivers.get(can_id & ~(ID_EXTENDED | ID_REMOTE))
        if receiver is not None:
            kind = "29-bit " * bool(can_id & ID_EXTENDED) + ("remote frame" if can_id & ID_REMOTE else "frame")
            self.unexpected.append(
                f"{kind} with the identifier of {receiver.message.name} in cycle {self.cycle_number}"
            )

    # -- waiting -------------------------------------------------------------------------------------------------------

    def idle(self, cycles: int) -> list[ReceivedFrame]:
        """Send only SYNC for a number of cycles, and return the frames of the node."""
        first = len(self.received)
        for _ in range(cycles):
            self.cycle()
        return self.received[first:]

    def states(self, received: list[ReceivedFrame]) -> list[ReceivedFrame]:
        """Return the received state frames with valid length."""
        return [frame for frame in received if frame.message is self.state_message and frame.values]

    def run_until(
        self, shows: Callable[[list[ReceivedFrame]], bool], cycle: Callable[[], list[ReceivedFrame]] | None = None
    ) -> bool:
        """Run cycles until a condition holds, for at most `technician.patience` [s]; return whether the condition holds.

        Args:
            shows: condition on the frames received in a cycle.
            cycle: function that runs one cycle; None means `self.cycle`.
        """
        cycle = cycle or self.cycle
        return any(shows(cycle()) for _ in range(round(self.technician.patience / PERIOD)))

    def request(
        self,
        action: Action,
        shows: Callable[[list[ReceivedFrame]], bool],
        cycle: Callable[[], list[ReceivedFrame]] | None = None,
    ) -> bool:
        """Request a manual action, run cycles, and return whether the effect of the action was measured.

        Args:
            action: manual action on the node.
            shows: function that returns whether the frames of one cycle show the effect.
            cycle: function that runs one cycle; None means `self.cycle`.

        Raises:
            NotTested: If no effect was measured, and the technician may have ignored the request.
        """
        technician = self.technician
        technician.request(action, self.node.name)
        shown = self.run_until(shows, cycle)
        if not shown and not technician.certain:
            instruction = action.value.format(node=self.node.name)
            raise NotTested(f"no effect within {technician.patience:g} s after the request: {instruction}")
        return shown

    @property
    def dropped(self) -> int:
        """Return the number of frames lost by this computer."""
        return self._bus.dropped
