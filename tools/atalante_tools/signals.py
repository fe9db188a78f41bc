"""Ctrl-C and SIGTERM as a flag that a loop looks at, so that it ends in HOLD before the process does."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

#: A shell reports a process that a signal ended as 128 and the signal's number.
SIGNALLED: Final = 128


class StopRequest:
    """Whether somebody asked the program to end, and the exit code that says so."""

    def __init__(self) -> None:
        self.wanted = False
        self.exit_code = 0

    def ask(self, number: int) -> None:
        """A signal arrived."""
        self.wanted = True
        self.exit_code = SIGNALLED + number


@contextmanager
def stop_requested() -> Iterator[StopRequest]:
    """Turn the first SIGINT or SIGTERM inside the block into `wanted`; the second ends the process at once.

    Nothing is raised in the middle of a cycle. The drives' own watchdog holds the robot when the process is gone. Outside
    the main thread signals cannot be handled and the request stays as it is.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def arrive(number: int, _frame: FrameType | None) -> None:
        if request.wanted:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        request.ask(number)

    before = {number: signal.signal(number, arrive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
