"""SIGINT (Ctrl-C) and SIGTERM as the stop request of the process, kept until the process ends.

    signal -> handler -> StopRequest: `Stopped` is raised where the program is, or a loop reads `wanted`

An exception raised by a handler can be lost: a callback that compiled code calls reports it as ignored and goes on, an optimiser
takes it for a failed evaluation. The request stays, and `check` raises again before something moves. Imports next to nothing,
because it is imported before the signals are handled.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TYPE_CHECKING = False  # as `typing.TYPE_CHECKING`, without importing `typing`
if TYPE_CHECKING:
    from types import FrameType

#: A shell reports a process that a signal ended as 128 and the signal's number.
SIGNALLED = 128
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(SystemExit):
    """The stop request as an exception, which `except Exception` does not catch."""


class StopRequest:
    """Whether a signal asked the process to stop, and the exit code of the first one."""

    def __init__(self) -> None:
        self.wanted = False
        self.exit_code = 0

    def ask(self, number: int) -> None:
        """Note that a signal arrived."""
        if not self.wanted:
            self.exit_code = SIGNALLED + number
            self.wanted = True

    def check(self) -> None:
        """End the command if a signal arrived.

        Raises:
            Stopped: with the exit code of the signal.
        """
        if self.wanted:
            raise Stopped(self.exit_code)

    def settle(self) -> None:
        """Forget the request: the command has ended as the signal asked and this is its usual end."""
        self.wanted = False
        self.exit_code = 0


#: The request of this process, while one of the blocks below handles its signals.
_request: StopRequest | None = None


def check_stop() -> None:
    """End the command if a signal arrived whose exception was lost; to be called between two parts of long work.

    Raises:
        Stopped: with the exit code of the signal.
    """
    if _request is not None:
        _request.check()


@contextmanager
def _handled(react: Callable[[StopRequest, int, bool], None]) -> Iterator[StopRequest]:
    """Note signals inside the block in the request of this process.

    Outside the main thread signals cannot be handled and the request stays as it is.

    Args:
        react: called after a signal with the request, its number, and whether one came before it.
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
    """Raise `Stopped` wherever the program is, at each SIGINT and SIGTERM inside the block, which is the whole program.

    A `Stopped` that is raised where no exception can pass is not reported: the request is kept. After the block a signal ends
    the process as the system does, without Python's traceback.
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
    """Turn the first SIGINT or SIGTERM inside the block into `wanted`; the second ends the process at once.

    Nothing is raised inside the block, which has to look at `wanted`. The drives' own watchdog holds the robot when the process
    is gone.

    Raises:
        Stopped: a signal arrived before the block.
    """

    def note(_request: StopRequest, number: int, repeated: bool) -> None:
        if repeated:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    with _handled(note) as request:
        request.check()
        yield request


@contextmanager
def ended_by(end: Callable[[], None]) -> Iterator[StopRequest]:
    """Call `end` at each SIGINT and SIGTERM inside the block, which then ends by itself; no signal cuts it short.

    Args:
        end: called between any two instructions of the block, so it may only set what the block looks at.
    """

    def ask(_request: StopRequest, _number: int, _repeated: bool) -> None:
        end()

    with _handled(ask) as request:
        yield request
