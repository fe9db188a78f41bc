"""An operator with a pendant, at a keyboard: when the node speaks, what it presses, and what the person is told."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from typing import Final

from atalante_hal.hal import PERIOD
from atalante_hal.types import SupervisorState
from atalante_hal.wire.e2e import REQUALIFY
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest
from atalante_tools.console.terminal import say
from atalante_tools.session.pendant_node import PendantNode, Request

#: Listening for another pendant before speaking [s], and SYNCs in it on a machine too slow for that.
LISTEN: Final = 0.05
LISTEN_CYCLES: Final = 3
#: Without a SYNC for so long there is no HAL [s].
NO_HAL: Final = 1.0
#: Longest wait for a frame before looking at signals and the keyboard [s].
LOOK_UP: Final = 0.02
#: Cycles: of `stop` and `hold` in all, of STOP at the end of the others, of the released dead-man after it.
SAY: Final = 500
SAY_STOP: Final = 20
SAY_RELEASED: Final = 5
#: Cycles after START in which a well robot becomes ACTIVE.
STARTED_BY: Final = 400


class Session:
    """An operator with a pendant, at a keyboard."""

    def __init__(
        self,
        node: PendantNode,
        target: Target,
        stop: StopRequest,
        keyboard: Keyboard,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.node, self.stop = node, stop
        #: Press START as soon as the HAL can be started.
        self.start_wanted = False
        self._target, self._keyboard, self._now = target, keyboard, now
        self._begun = self._synced_at = now()
        self._hal_there = True
        self._hal: object = None
        self._pressed_at: int | None = None

    def listen(self) -> None:
        """Hear whether there is a HAL and another pendant, without a word."""
        begun = self._now()
        while not self.stop.wanted:
            self.node.poll(LOOK_UP)
            listened = self._now() - begun
            if listened >= NO_HAL or (listened >= LISTEN and self.node.cycles >= LISTEN_CYCLES):
                return

    def take(self) -> None:
        """Take the pendant from whoever has it, and press the dead-man."""
        self.listen()
        say(f"taking over from another pendant on {self._target}" if self.node.heard_another else "pendant in hand")
        self.node.dead_man = True
        self.node.speak()

    def speak_for(self, cycles: int) -> None:
        """Answer that many SYNCs, fewer if the HAL falls silent, the pendant is taken away or somebody wants to stop."""
        wanted = self.stop.wanted
        last, heard_at = self.node.spoken + cycles, self._now()
        while self.node.spoken < last and not (self.node.displaced or self.node.refused):
            if self.node.poll(LOOK_UP):
                heard_at = self._now()
            elif self._now() - heard_at > NO_HAL:
                return
            if self.stop.wanted and not wanted:
                return

    def stay(self, seconds: float | None) -> None:
        """Hold the pendant until somebody wants to stop, takes it, or the time is over; then STOP.

        Raises:
            Failed: the pendant heard before does not give way.
        """
        node = self.node
        self._begun = self._now()
        while not self.stop.wanted and (seconds is None or self._elapsed() < seconds):
            if node.poll(LOOK_UP):
                self._follow()
            elif self._hal_there and self._now() - self._synced_at > NO_HAL:
                self._hal_there = False
                say(f"no SYNC on {self._target}: no HAL is running there; waiting for one")
            if node.displaced:
                say("another pendant has taken over")
                return
            if node.refused:
                raise Failed("another pendant keeps speaking and does not give way: use that one")
            for line in self._keyboard.lines():
                self.typed(line)
        self.put_down()

    def _elapsed(self) -> float:
        """Seconds of the robot's time, of ours while there is no robot."""
        return self.node.spoken * PERIOD if self.node.spoken else self._now() - self._begun

    def put_down(self) -> None:
        """STOP, and only then let the dead-man go."""
        self.node.press(Request.STOP)
        self.speak_for(SAY_STOP)
        self.node.dead_man = False
        self.speak_for(SAY_RELEASED)
        if self.node.hal is not None:
            say(f"STOP: the HAL is {self.node.hal.name}")

    def typed(self, line: str) -> None:
        """A line of the operator."""
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
            say(f"{line.strip()!r} is none of: start, stop, hold, xi X with X from 0 to 1")

    def _follow(self) -> None:
        """Say what the HAL does, and press START when that is due."""
        node = self.node
        self._synced_at, self._hal_there = self._now(), True
        if node.hal is not self._hal and node.hal is not None:
            self._hal = node.hal
            say(f"the HAL is {node.hal.name}")
            if self._pressed_at is not None and node.hal is not SupervisorState.ACTIVE:
                say("one START is one change of state; type start to press START again")
            self._pressed_at = None
        startable = node.hal in (SupervisorState.READY, SupervisorState.HOLD)
        # The HAL trusts the pendant from its frame number `REQUALIFY` on.
        if self.start_wanted and startable and node.spoken > REQUALIFY:
            self.start_wanted = False
            self._pressed_at = node.cycles
            node.press(Request.START)
            say("START pressed")
        elif self._pressed_at is not None and node.cycles - self._pressed_at > STARTED_BY:
            self._pressed_at = None
            say("the HAL did not become ACTIVE, its events say why; type start to press START again")


class Keyboard:
    """Lines typed on a file descriptor, without waiting for them; None: nobody types."""

    def __init__(self, file: int | None) -> None:
        self._file = file
        self._begun = b""

    def lines(self) -> list[str]:
        """Whole lines typed since the last call."""
        if self._file is None or not select.select([self._file], (), (), 0.0)[0]:
            return []
        # In the background a read from the terminal would stop the process.
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
