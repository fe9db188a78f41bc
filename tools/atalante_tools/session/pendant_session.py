"""Session of a pendant at a terminal: `keyboard and HAL state -> Session -> PendantNode`, with messages to the user."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from typing import Final

from atalante_hal.types import PERIOD, SupervisorState
from atalante_hal.wire.e2e import REQUALIFY
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.console.terminal import say
from atalante_tools.session.pendant_node import PendantNode, Request

#: Shortest listening time for another pendant before sending [s].
LISTEN: Final = 0.05
#: Smallest number of SYNCs received while listening, for machines slower than real time.
LISTEN_CYCLES: Final = 3
#: Time without a SYNC after which no HAL is assumed [s].
NO_HAL: Final = 1.0
#: Longest wait for a frame before stop request and keyboard are checked [s].
LOOK_UP: Final = 0.02
#: Number of SYNCs that `pendant stop` and `pendant hold` answer.
SAY: Final = 500
#: Number of SYNCs answered with STOP at the end of `pendant start` and `pendant xi`.
SAY_STOP: Final = 20
#: Number of SYNCs answered after the dead-man switch is released.
SAY_RELEASED: Final = 5
#: Number of cycles after START within which a healthy robot becomes ACTIVE.
STARTED_BY: Final = 400


class Session:
    """Session of one pendant node, controlled by the keyboard."""

    def __init__(
        self,
        node: PendantNode,
        target: Target,
        stop: StopRequest,
        keyboard: Keyboard,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.node, self.stop = node, stop
        #: Whether to press START as soon as the HAL is in READY or HOLD.
        self.start_wanted = False
        self._target, self._keyboard, self._now = target, keyboard, now
        self._begun = self._synced_at = now()
        self._hal_there = True
        self._hal: object = None
        self._pressed_at: int | None = None

    def listen(self) -> None:
        """Listen for a HAL and for another pendant, without sending."""
        begun = self._now()
        while not self.stop.wanted:
            self.node.poll(LOOK_UP)
            listened = self._now() - begun
            if listened >= NO_HAL or (listened >= LISTEN and self.node.cycles >= LISTEN_CYCLES):
                return

    def take(self) -> None:
        """Take over from another pendant if there is one, press the dead-man switch and start to send."""
        self.listen()
        say(
            f"taking over from another pendant on {self._target}"
            if self.node.heard_another
            else "the pendant is active"
        )
        self.node.dead_man = True
        self.node.speak()

    def speak_for(self, cycles: int) -> None:
        """Answer a number of SYNCs.

        It ends early if the HAL stops sending, another pendant takes over, or a signal arrives.

        Args:
            cycles: Number of SYNCs to answer.
        """
        wanted = self.stop.wanted
        last, received_at = self.node.spoken + cycles, self._now()
        while self.node.spoken < last and not (self.node.displaced or self.node.refused):
            if self.node.poll(LOOK_UP):
                received_at = self._now()
            elif self._now() - received_at > NO_HAL:
                return
            if self.stop.wanted and not wanted:
                return

    def stay(self, seconds: float | None) -> None:
        """Answer SYNCs until a signal arrives, another pendant takes over, or the time is over; then press STOP.

        After a takeover STOP is not pressed.

        Args:
            seconds: Duration [s]; None: until a signal arrives.

        Raises:
            Failed: If the older pendant keeps sending.
        """
        node = self.node
        self._begun = self._now()
        while not self.stop.wanted and (seconds is None or self._elapsed() < seconds):
            if node.poll(LOOK_UP):
                self._follow()
            elif self._hal_there and self._now() - self._synced_at > NO_HAL:
                self._hal_there = False
                say(f"no SYNC received on {self._target}: waiting for a HAL")
            if node.displaced:
                say("another pendant has taken over")
                return
            if node.refused:
                raise Failed("another pendant keeps sending: use that pendant, or end it first")
            for line in self._keyboard.lines():
                self.typed(line)
        self.put_down()

    def _elapsed(self) -> float:
        """Return the time since the start [s]: robot time after the first answered SYNC, wall-clock time before."""
        return self.node.spoken * PERIOD if self.node.spoken else self._now() - self._begun

    def put_down(self) -> None:
        """Press STOP, then release the dead-man switch."""
        self.node.press(Request.STOP)
        self.speak_for(SAY_STOP)
        self.node.dead_man = False
        self.speak_for(SAY_RELEASED)
        if self.node.hal is not None:
            say(f"STOP: the HAL is {self.node.hal.name}")

    def typed(self, line: str) -> None:
        """Execute a command line of the operator.

        Args:
            line: start, stop, hold, or xi with a factor from 0 to 1.
        """
        word, *arguments = line.lower().split() or [""]
        if word in ("start", "stop", "hold") and not arguments:
            self.start_wanted = False
            self._pressed_at = self.node.cycles if word == "start" else None
            self.node.press(Request[word.upper()])
            say(f"{word.upper()} pressed")
        elif word == "xi" and len(arguments) == 1 and (factor := _factor(arguments[0])) is not None:
            self.node.assist(factor)
            say(f"assistance factor {factor:g}")
        elif word:
            say(f"a command must be start, stop, hold or xi X with X from 0 to 1, got {line.strip()!r}")

    def _follow(self) -> None:
        """Print a new state of the HAL, and press START when it is due."""
        node = self.node
        self._synced_at, self._hal_there = self._now(), True
        if node.hal is not self._hal and node.hal is not None:
            self._hal = node.hal
            say(f"the HAL is {node.hal.name}")
            if self._pressed_at is not None and node.hal is not SupervisorState.ACTIVE:
                say("each START changes the state once; type start to press START again")
            self._pressed_at = None
        startable = node.hal in (SupervisorState.READY, SupervisorState.HOLD)
        # The HAL ignores requests until it has received `REQUALIFY` valid frames of the pendant.
        if self.start_wanted and startable and node.spoken > REQUALIFY:
            self.start_wanted = False
            self._pressed_at = node.cycles
            node.press(Request.START)
            say("START pressed")
        elif self._pressed_at is not None and node.cycles - self._pressed_at > STARTED_BY:
            self._pressed_at = None
            say("the HAL did not become ACTIVE, see its event log; type start to press START again")


class Keyboard:
    """Non-blocking reader of typed lines from a file descriptor; with None it returns no lines."""

    def __init__(self, file: int | None) -> None:
        self._file = file
        self._begun = b""

    def lines(self) -> list[str]:
        """Return the complete lines typed since the last call."""
        if self._file is None or not select.select([self._file], (), (), 0.0)[0]:
            return []
        # The system suspends a background process that reads from the terminal.
        if os.isatty(self._file) and os.tcgetpgrp(self._file) != os.getpgrp():
            return []
        typed = os.read(self._file, 4096)
        if not typed:
            self._file = None
        *lines, self._begun = (self._begun + typed).split(b"\n")
        return [line.decode(errors="replace") for line in lines]


def _factor(text: str) -> float | None:
    try:
        factor = float(text)
    except ValueError:
        return None
    return factor if 0.0 <= factor <= 1.0 else None
