"""Stop request of the process: SIGINT (Ctrl-C) and SIGTERM, stored until the process ends.

    signal -> handler -> StopRequest: the handler raises `Stopped`, or a loop reads `wanted`

An exception raised by a signal handler can be lost. A callback of compiled code reports it as ignored and continues; an
optimiser treats it as a failed evaluation. Therefore the request is stored, and `check` raises it again before the robot moves.
This module has few imports, because it is imported before the signals are handled.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TYPE_CHECKING = False  # same as `typing.TYPE_CHECKING`; importing `typing` would delay the signal handlers
if TYPE_CHECKING:
    from types import FrameType

#: Base of the exit code after a signal: the exit code is this base plus the signal number (shell convention).
SIGNALLED = 128
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(SystemExit):
    """Exception raised by a stop request. `except Exception` does not catch it."""


class StopRequest:
    """Record of the first stop signal: `wanted` after it arrived, and its `exit_code`."""

    def __init__(self) -> None:
        self.wanted = False
        self.exit_code = 0

    def ask(self, number: int) -> None:
        """Record that a signal arrived.

        Args:
            number: Signal number.
        """
        if not self.wanted:
            self.exit_code = SIGNALLED + number
            self.wanted = True

    def check(self) -> None:
        """End the command if a signal arrived.

        Raises:
            Stopped: If a signal arrived, with its exit code.
        """
        if self.wanted:
            raise Stopped(self.exit_code)

    def settle(self) -> None:
        """Clear the request, for a command that a signal ends normally."""
        self.wanted = False
        self.exit_code = 0


#: Stop request of this process, while one of the context managers below handles its signals.
_request: StopRequest | None = None


def check_stop() -> None:
    """End the command if a signal arrived. Call it between two parts of long work, which may have lost the exception.

    Raises:
        Stopped: If a signal arrived, with its exit code.
    """
    if _request is not None:
        _request.check()


@contextmanager
def _handled(react: Callable[[StopRequest, int, bool], None]) -> Iterator[StopRequest]:
    """Record the signals that arrive inside the block in the stop request of this process.

    Python handles signals in the main thread only. In any other thread the block gets a request that is never set.

    Args:
        react: Called after each signal with the request, the signal number, and whether it repeats an earlier signal.
    """
    global _request
    outer = _request
    request = StopRequest() if outer is None else outer

    def arrive(number: int, _frame: FrameType | None) -> None:
        repeated = request.wanted
        request.ask(number)
        react(request, number, repeated)

    try:
        before = {number: signal.signal(number, arrive) for number in _SIGNALS}
    except ValueError:  # not the main thread
        yield StopRequest()
        return
    _request = request
    try:
        yield request
    finally:
        _request = outer
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[StopRequest]:
    """Raise `Stopped` at each SIGINT and SIGTERM inside the block, which is the whole program.

    A `Stopped` raised where Python ignores exceptions (e.g. in `__del__`) is not reported, because the request is stored.
    After the block a signal ends the process with the default action of the system, without a Python traceback.
    """

    def stop(request: StopRequest, _number: int, _repeated: bool) -> None:
        request.check()

    report = sys.unraisablehook

    def report_others(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, Stopped):
            report(lost)

    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    sys.unraisablehook = report_others
    try:
        with _handled(stop) as request:
            yield request
    finally:
        sys.unraisablehook = report


@contextmanager
def stop_requested() -> Iterator[StopRequest]:
    """Set `wanted` at the first SIGINT or SIGTERM inside the block, and end the process at the second.

    No exception is raised inside the block, so the block must read `wanted`. If the process ends, the watchdog of each drive
    holds the robot.

    Raises:
        Stopped: If a signal arrived before the block.
    """

    def end_on_repetition(_request: StopRequest, number: int, repeated: bool) -> None:
        if repeated:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    with _handled(end_on_repetition) as request:
        request.check()
        yield request


@contextmanager
def ended_by(end: Callable[[], None]) -> Iterator[StopRequest]:
    """Call `end` at each SIGINT and SIGTERM inside the block. No signal interrupts the block.

    Args:
        end: Requests the end of the block. It may be called between any two instructions, so it must only set a flag.
    """

    def ask(_request: StopRequest, _number: int, _repeated: bool) -> None:
        end()

    with _handled(ask) as request:
        yield request
