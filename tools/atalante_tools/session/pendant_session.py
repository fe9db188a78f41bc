"""Session of a pendant at a terminal: runs a pendant node, reads the keyboard and prints messages for the user.

keyboard and HAL state -> Session -> PendantNode
"""

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
from atalante_tools.console.terminal import print_message
from atalante_tools.session.listening import POLL_TIMEOUT
from atalante_tools.session.pendant_node import PendantNode, Request

#: Shortest time for which a new pendant listens before its first frame [s].
LISTEN: Final = 0.05
#: Smallest number of SYNCs that a new pendant must receive before its first frame.
LISTEN_CYCLES: Final = 3
#: Time without a SYNC after which the HAL is considered absent [s].
HAL_TIMEOUT: Final = 1.0
#: Number of SYNCs that a new pendant answers with the signals of the older pendant. In this time the older pendant stops sending.
#: If the signals of the two pendants differed, the HAL would hold the robot after four cycles.
COPY_SYNCS: Final = 20
#: Number of SYNCs that `atalante pendant stop` and `atalante pendant hold` answer (0.5 s).
PRESS_SYNCS: Final = 500
#: Number of SYNCs answered with STOP at the end of `pendant start` and `pendant xi`.
STOP_SYNCS: Final = 20
#: Number of SYNCs answered with a released dead-man switch at the end of `pendant start` and `pendant xi`.
RELEASE_SYNCS: Final = 5
#: Longest time from START to the HAL state ACTIVE in normal operation [cycles].
#: If the HAL has not changed its state after `START_TIMEOUT`, the operator gets a message.
START_TIMEOUT: Final = 400


class Session:
    """Session of one pendant node at a terminal. Commands from the keyboard control the node."""

    def __init__(
        self,
        node: PendantNode,
        target: Target,
        stop: StopRequest,
        keyboard: Keyboard,
        now: Callable[[], float] = time.monotonic,
        losses: Callable[[], int] = lambda: 0,
        reopens: Callable[[], bool] = lambda: True,
    ) -> None:
        """Create a pendant session on an open bus.

        Args:
            node: Pendant node on its bus.
            target: Bus. Its name is printed in the messages.
            stop: Stop request of the process.
            keyboard: Reader of the lines that the user types.
            now: Clock [s].
            losses: Function that returns how often the link to the bus was lost so far.
            reopens: Function that returns whether a lost link is opened again. If False, this program must be restarted.
        """
        self.node, self.stop = node, stop
        #: Whether START is pressed automatically as soon as the HAL is in READY or HOLD, as in `atalante pendant start`.
        self.start_wanted = False
        # Whether the operator typed start, and START is not pressed yet.
        # START is pressed in any state of the HAL, as soon as the HAL accepts requests of this pendant.
        self._start_typed = False
        self._target, self._keyboard, self._now = target, keyboard, now
        self._begun = self._synced_at = now()
        self._hal_present, self._hal_found = True, False
        # Total duration of the ended absences of the HAL since the first SYNC [s]. An absence that still lasts is not included.
        self._absent = 0.0
        self._hal: object = None
        self._pressed_at: int | None = None
        self._losses, self._reopens, self._lost_before = losses, reopens, 0

    def listen(self) -> None:
        """Listen for SYNC of a HAL and for frames of another pendant, without sending."""
        begun = self._now()
        while not self.stop.wanted:
            self.node.poll(POLL_TIMEOUT)
            listened = self._now() - begun
            if listened >= HAL_TIMEOUT or (listened >= LISTEN and self.node.cycles >= LISTEN_CYCLES):
                return

    def take_over(self) -> None:
        """Listen first, then press the dead-man switch and start to answer each SYNC.

        If another pendant is sending, the first answers are copies of its signals.
        """
        self.listen()
        print_message(
            f"taking over from another pendant on {self._target}"
            if self.node.found_another
            else "the pendant is active"
        )
        self.node.dead_man = True
        self.node.start_sending()
        if self.node.found_another:
            self.answer_syncs(COPY_SYNCS)

    def answer_syncs(self, count: int) -> None:
        """Answer a number of SYNCs.

        The method returns early if the HAL stops sending, another pendant takes over, or a stop signal arrives.

        Args:
            count: Number of SYNCs to answer.
        """
        stopping = self.stop.wanted
        last, received_at = self.node.answered + count, self._now()
        while self.node.answered < last and not (self.node.displaced or self.node.takeover_failed):
            if self.node.poll(POLL_TIMEOUT):
                received_at = self._now()
                if self._start_typed:
                    self._press_start()
            elif self._now() - received_at > HAL_TIMEOUT:
                return
            if self.stop.wanted and not stopping:
                return

    def run(self, seconds: float | None) -> None:
        """Answer each SYNC until the time is over or a stop signal arrives, and then press STOP.

        The method returns without STOP if another pendant takes over.

        Args:
            seconds: Duration [s]. None means no limit.

        Raises:
            Failed: If another pendant does not stop sending.
        """
        node = self.node
        self._begun = self._synced_at = self._now()
        # If the node answered SYNCs during its takeover, a HAL is already on the bus.
        self._hal_found = node.answered > 0
        while not self.stop.wanted and (seconds is None or self._elapsed() < seconds):
            if node.poll(POLL_TIMEOUT):
                self._react_to_sync()
            elif self._hal_present and self._now() - self._synced_at > HAL_TIMEOUT:
                self._hal_present = False
                print_message(f"no SYNC received on {self._target}: waiting for a HAL")
            if node.displaced:
                print_message("another pendant has taken over")
                return
            self.check_takeover()
            if self._losses() > self._lost_before:
                self._release_after_loss()
            for line in self._keyboard.lines():
                self.execute(line)
        self.press_stop()

    def check_takeover(self) -> None:
        """Raise an error if another pendant did not stop sending during the takeover.

        Raises:
            Failed: If the other pendant did not stop.
        """
        if self.node.takeover_failed:
            state = f", and the HAL is in {self.node.hal.name}" if self.node.hal is not None else ""
            raise Failed(
                f"another pendant is already in use on this bus{state}: operate the robot with that pendant, or end it first"
            )

    def _release_after_loss(self) -> None:
        """Release the dead-man switch after the link to the bus was lost, so that the operator must press it again.

        If the lost link is not opened again, `start` has no effect. The error message of the link then contains the remedy.
        """
        self._lost_before = self._losses()
        self.node.dead_man = False
        self.start_wanted = self._start_typed = False
        remedy = "; type start to press it again, with START" if self._reopens() else ""
        print_message(f"the dead-man switch is released{remedy}")

    def _elapsed(self) -> float:
        """Return the running time of the pendant [s].

        Before the first answer to a SYNC, this is the time since the call of `run`. After the first answer, it is the number of
        answered SYNCs times `PERIOD`, plus the time without a HAL.
        """
        if not self.node.answered:
            return self._now() - self._begun
        absent = 0.0 if self._hal_present else self._now() - self._synced_at
        return self.node.answered * PERIOD + self._absent + absent

    def press_stop(self) -> None:
        """Press STOP for some cycles, then release the dead-man switch. Print whether the HAL could receive STOP."""
        self._start_typed = False
        answered = self.node.answered
        self.node.press(Request.STOP)
        self.answer_syncs(STOP_SYNCS)
        self.node.dead_man = False
        self.answer_syncs(RELEASE_SYNCS)
        if self.node.hal is None:
            return
        if self.node.answered > answered:
            print_message(f"STOP: the HAL is {self.node.hal.name}")
        else:
            print_message(
                f"STOP was not sent, because no SYNC was received on {self._target}; the HAL was last {self.node.hal.name}"
            )

    def execute(self, line: str) -> None:
        """Execute a command that the operator typed.

        Args:
            line: Typed line: start, stop, hold, or xi with a factor from 0 to 1.
        """
        word, *arguments = line.lower().split() or [""]
        if word in ("start", "stop", "hold") and not arguments:
            self.start_wanted = False
            self._start_typed = word == "start"
            self._pressed_at = None
            if self._start_typed:
                self.node.dead_man = True
            else:
                self.node.press(Request[word.upper()])
                print_message(f"{word.upper()} pressed")
        elif word == "xi" and len(arguments) == 1 and (factor := _factor(arguments[0])) is not None:
            self.node.assist(factor)
            print_message(f"assistance factor {factor:g}")
        elif word:
            print_message(f"a command must be start, stop, hold or xi X with X from 0 to 1, got {line.strip()!r}")

    def _press_start(self) -> None:
        """Press START if the HAL already accepts requests of this pendant.

        The HAL accepts requests after `REQUALIFY` answers in a row. If it also received a frame of another pendant, it counts
        from the last of these frames on. So START is pressed after more than twice as many answers.
        """
        if self.node.answered_in_row > 2 * REQUALIFY:
            self.start_wanted = self._start_typed = False
            self._pressed_at = self.node.cycles
            self.node.press(Request.START)
            print_message("START pressed")

    def _react_to_sync(self) -> None:
        """Print a change of the HAL state, and press START if it is due.

        START is due if the operator typed start, or if `start_wanted` is True and the HAL is in READY or HOLD.
        """
        node, now = self.node, self._now()
        if not self._hal_present and self._hal_found:
            self._absent += now - self._synced_at
        self._synced_at, self._hal_present, self._hal_found = now, True, True
        if node.hal is not self._hal and node.hal is not None:
            self._hal = node.hal
            print_message(f"the HAL is {node.hal.name}")
            if self._pressed_at is not None and node.hal is not SupervisorState.ACTIVE:
                print_message("each START changes the state once; type start to press START again")
            self._pressed_at = None
        startable = node.hal in (SupervisorState.READY, SupervisorState.HOLD)
        if self._start_typed or (self.start_wanted and startable):
            self._press_start()
        elif self._pressed_at is not None and node.cycles - self._pressed_at > START_TIMEOUT:
            self._pressed_at = None
            print_message("the HAL did not become ACTIVE, see its event log; type start to press START again")


class Keyboard:
    """Non-blocking reader of the lines that the user types. Without a file descriptor, the reader returns no lines."""

    def __init__(self, file: int | None) -> None:
        self._file = file
        self._partial = b""

    def lines(self) -> list[str]:
        """Return the complete lines that the user typed since the last call."""
        if self._file is None or not select.select([self._file], (), (), 0.0)[0]:
            return []
        try:
            # Linux would suspend a background process that reads from the terminal.
            if os.isatty(self._file) and os.tcgetpgrp(self._file) != os.getpgrp():
                return []
            typed = os.read(self._file, 4096)
        except OSError:  # the terminal was closed, or its shell has ended
            typed = b""
        if not typed:
            self._file = None
        *lines, self._partial = (self._partial + typed).split(b"\n")
        return [line.decode(errors="replace") for line in lines]


def _factor(text: str) -> float | None:
    try:
        factor = float(text)
    except ValueError:
        return None
    return factor if 0.0 <= factor <= 1.0 else None
