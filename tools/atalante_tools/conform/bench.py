"""The HAL's part played for one node, a cycle at a time: `SYNC -> the node's answer -> command`, with every frame recorded.

The same examination runs on a wire, on the wall clock, and against the emulator in this process, in lock-step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from atalante_dbc import Message, Network, Node
from atalante_hal.bus import Bus, BusFull
from atalante_hal.hal import PERIOD
from atalante_hal.robot import Robot
from atalante_hal.wire.frame import Frames, as_words, new_frames
from atalante_tools.conform.frames import Heard, Incoming, Outgoing
from atalante_tools.conform.technician import Action, Technician
from atalante_tools.console.outcome import Failed

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator

#: Frames one `receive` can take.
_RECEIVE_BUDGET: Final = 128
#: How long a node may take to answer before the command goes out [s].
_PATIENCE: Final = 0.6e-3
#: Silence before anything is sent, to hear whether somebody else plays the HAL [s].
_LISTEN: Final = 0.2


class NotTested(Exception):  # noqa: N818
    """A requirement could not be tested; the message says why."""


class Clock(Protocol):
    """When the next cycle begins."""

    late: float  # s, longest delay of a cycle since it was last set to 0: this computer's fault, not the node's

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """Return when it is time; `listen(s)` receives meanwhile. `sync`: the cycle will begin with one."""

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """Time [s] of a frame."""


class LockStep:
    """The emulated node answers at once. Milliseconds without SYNC pass for it as they do in `Emulator.run`."""

    def __init__(self, emulator: Emulator) -> None:
        from atalante_emulator.drive import WATCHDOG

        self.late = 0.0
        self._emulator = emulator
        self._watchdog = WATCHDOG
        self._silent = 0

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """At once."""
        self._silent = 0 if sync else self._silent + 1
        if self._silent >= self._watchdog:
            self._emulator.idle()

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """The cycle's."""
        return cycle * PERIOD


class WallClock:
    """1 kHz by absolute deadlines. A missed deadline is not caught up with: that would be a burst of SYNCs."""

    def __init__(self) -> None:
        self.late = 0.0
        self._deadline = time.monotonic()

    def next_cycle(self, *, sync: bool, listen: Callable[[float], None]) -> None:
        """Listen until the deadline."""
        self._deadline += PERIOD
        while (left := self._deadline - time.monotonic()) > 0.0:
            listen(left)
        listen(0.0)  # after a late wake-up what came before this SYNC is no answer to it
        behind = -left
        self.late = max(self.late, behind)
        if behind > PERIOD:
            self._deadline = time.monotonic()

    def time_of(self, stamp_ns: int, cycle: int) -> float:
        """The stamp of the bus."""
        return stamp_ns * 1e-9


@dataclass(frozen=True)
class Limits:
    """What the bench may do to the node."""

    torque: float = 3.0  # Nm: the largest torque it lets a drive make


class Bench:
    """One node under test and everything heard of it.

    `heard` are its frames since the examination began; `cycle_number` counts milliseconds, with SYNC or without.
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
        self.heard: list[Heard] = []
        self.cycle_number = 0
        self.sync = Outgoing(network.message(f"SYNC_{self._of_node('STATE').bus.upper()}"))
        self.state_message = self._of_node("STATE")
        self.status_message = self._of_node("STATUS")
        self.emergency_message = self._of_node("EMCY")
        commands = [
            m for m in network.received_by(node.name) if m.sender == "HAL" and m.cycle_ms and m != self.sync.message
        ]
        commands = [m for m in commands if not m.name.endswith("_STATUS")]
        self._command = Outgoing(commands[0]) if commands else None
        self._bus = bus
        self._incoming = {m.frame_id: Incoming(m) for m in network.sent_by(node.name)}
        self._masters = {m.frame_id: m.name for m in network.sent_by("HAL")}
        self._scratch = new_frames(_RECEIVE_BUDGET)
        self._outboxes: dict[int, Frames] = {}
        self._singles = [self._scratch[place : place + 1] for place in range(_RECEIVE_BUDGET)]

    @property
    def command(self) -> Outgoing:
        """The HAL's command to this node."""
        assert self._command is not None, f"{self.node.name} takes no command"
        return self._command

    def _of_node(self, kind: str) -> Message:
        return self.network.message(f"{self.node.name}_{kind}")

    def make_sure_to_be_alone(self) -> None:
        """Listen before the first frame.

        Raises:
            Failed: another HAL is on the bus.
        """
        deadline = time.monotonic() + _LISTEN
        while (left := deadline - time.monotonic()) > 0.0:
            count = self._bus.receive(self._scratch, left)
            for frame_id in self._scratch["can_id"][:count].tolist():
                if frame_id in self._masters:
                    raise Failed(
                        f"somebody else plays the HAL on {self._bus.name} ({self._masters[frame_id]} was heard): stop it first"
                    )

    # -- one cycle -----------------------------------------------------------------------------------------------------

    def cycle(self, *commands: Frames, sync: Frames | None = None, before: Frames | None = None) -> list[Heard]:
        """One millisecond that begins with SYNC: send it, listen, send the commands.

        Args:
            commands: frames to send after the answers, shape (n,) each.
            sync: frames in the place of the next SYNC.
            before: frames to send before SYNC.

        Returns:
            What the node said since the SYNC.
        """
        if sync is None:
            sync = self.sync_frame()
        self.clock.next_cycle(sync=True, listen=self._listen)
        self.cycle_number += 1
        if before is not None:
            self._send(before)
        self._send(sync)
        first = len(self.heard)
        self._listen_for_answer()
        for frames in commands:
            self._send(frames)
        return self.heard[first:]

    def silent_cycle(self) -> list[Heard]:
        """One millisecond in which nothing is sent; what the node said."""
        first = len(self.heard)
        self.clock.next_cycle(sync=False, listen=self._listen)
        self.cycle_number += 1
        self._listen(0.0)
        return self.heard[first:]

    def sync_frame(
        self, *, counter: int | None = None, length: int | None = None, classic: bool = False, flip: int | None = None
    ) -> Frames:
        """The next SYNC, with the defects of `Outgoing.frame`."""
        cycle = {"Cycle": self.cycle_number + 1 & 0xFFFFFFFF}
        return self.sync.frame(cycle, counter=counter, length=length, classic=classic, flip=flip)

    def _send(self, frames: Frames) -> None:
        outbox = self._outboxes.setdefault(len(frames), new_frames(len(frames)))  # a bus likes to see the same array
        as_words(outbox)[:] = as_words(frames)
        try:
            self._bus.send(outbox)
        except BusFull:
            # Nobody acknowledges while the node is switched off.
            return

    def _listen(self, timeout: float) -> None:
        self._take(self._bus.receive(self._scratch, timeout))

    def _listen_for_answer(self) -> None:
        first = len(self.heard)
        deadline = time.monotonic() + _PATIENCE
        left = _PATIENCE
        while left > 0.0:
            count = self._bus.receive(self._scratch, left)
            self._take(count)
            if not count or any(h.message is self.state_message for h in self.heard[first:]):
                return
            left = deadline - time.monotonic()

    def _take(self, count: int) -> None:
        if not count:
            return
        stamps = self._bus.stamps
        for place, can_id in enumerate(self._scratch["can_id"][:count].tolist()):
            incoming = self._incoming.get(can_id)
            if incoming is not None:
                stamp = self.clock.time_of(int(stamps[place]), self.cycle_number)
                self.heard.append(incoming.hear(self._singles[place], self.cycle_number, stamp))

    # -- waiting -------------------------------------------------------------------------------------------------------

    def idle(self, cycles: int) -> list[Heard]:
        """SYNC alone for some cycles; what the node said."""
        first = len(self.heard)
        for _ in range(cycles):
            self.cycle()
        return self.heard[first:]

    def states(self, heard: list[Heard]) -> list[Heard]:
        """The readable state frames among what was heard."""
        return [h for h in heard if h.message is self.state_message and h.values]

    def until(self, shows: Callable[[list[Heard]], bool], cycle: Callable[[], list[Heard]] | None = None) -> bool:
        """Run cycles until `shows(heard)` holds, or the technician's patience ends."""
        cycle = cycle or self.cycle
        return any(shows(cycle()) for _ in range(round(self.technician.patience / PERIOD)))

    def ask(
        self, action: Action, shows: Callable[[list[Heard]], bool], cycle: Callable[[], list[Heard]] | None = None
    ) -> bool:
        """Have something done to the node, run cycles, and say whether it shows.

        Raises:
            NotTested: it does not, and may not have been done.
        """
        technician = self.technician
        technician.please(action, self.node.name)
        shown = self.until(shows, cycle)
        if not shown and not technician.certain:
            wanted = action.value.format(node=self.node.name)
            raise NotTested(f"nothing was seen within {technician.patience:g} s of the request to {wanted}")
        return shown

    @property
    def dropped(self) -> int:
        """Frames this computer lost."""
        return self._bus.dropped
