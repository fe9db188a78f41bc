"""Stop request of the process: a record that a stop signal arrived.

The stop signals are SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal was closed, or its connection was lost).

    signal -> handler -> StopRequest: the handler raises `Stopped`, or a loop reads `wanted`

A library may catch and discard an exception that a signal handler raises. For example, compiled code discards an
exception in a callback, and an optimiser counts the exception as a failed evaluation. Therefore the request is stored,
and `check` raises `Stopped` again before the robot moves. Signals are handled only after the import of this module.
Therefore this module has few imports.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TYPE_CHECKING = False  # replaces `typing.TYPE_CHECKING`, because the import of `typing` is slow
if TYPE_CHECKING:
    from types import FrameType

#: Offset of the exit code after a signal (shell convention): exit code = `SIGNALLED` + signal number.
SIGNALLED = 128
#: Stop signals that end the process at once if the process has already received a stop signal.
#: SIGHUP is not in the list, because the shell and the kernel may both send SIGHUP when a terminal closes.
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(SystemExit):
    """Exception that ends the command after a stop signal. `except Exception` does not catch this exception."""


class StopRequest:
    """Record of the stop signals. After the first signal, `wanted` is True and `exit_code` is the exit code to use."""

    def __init__(self) -> None:
        self.wanted = False
        self.exit_code = 0
        self.signals = 0  # number of signals

    def ask(self, number: int) -> None:
        """Record that a stop signal arrived.

        Args:
            number: Signal number.
        """
        self.signals += 1
        if not self.wanted:
            self.exit_code = SIGNALLED + number
            self.wanted = True

    def check(self) -> None:
        """Raise `Stopped` if a stop signal arrived.

        Raises:
            Stopped: If a signal arrived. The exception carries the exit code of the signal.
        """
        if self.wanted:
            raise Stopped(self.exit_code)

    def settle(self) -> None:
        """Clear the request, so that the command ends with exit code 0 even if a signal arrived."""
        self.wanted = False
        self.exit_code = self.signals = 0


#: Stop request of this process. None while no context manager of this module is active.
_request: StopRequest | None = None


def check_stop() -> None:
    """Raise `Stopped` if a stop signal arrived. Call this function after library code that may have caught `Stopped`.

    Raises:
        Stopped: If a signal arrived. The exception carries the exit code of the signal.
    """
    if _request is not None:
        _request.check()


def _stop_signals() -> tuple[signal.Signals, ...]:
    """Return all stop signals. SIGHUP is left out if the process ignores it, as under `nohup`."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return _SIGNALS if ignored else (*_SIGNALS, signal.SIGHUP)


@contextmanager
def _handled(react: Callable[[StopRequest, int, bool], None]) -> Iterator[StopRequest]:
    """Store every stop signal that arrives inside the `with` block in the `StopRequest` of this process.

    An inner block uses the `StopRequest` of its outer block. Python handles signals in the main thread only. In any other
    thread the block gets a request that is never set.

    Args:
        react: Function called after each signal, with the request, the signal number, and whether an earlier signal arrived.
    """
    global _request
    outer = _request
    request = StopRequest() if outer is None else outer

    def arrive(number: int, _frame: FrameType | None) -> None:
        repeated = request.wanted
        if number == signal.SIGHUP and repeated:
            return
        request.ask(number)
        react(request, number, repeated)

    try:
        before = {number: signal.signal(number, arrive) for number in _stop_signals()}
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
    """Raise `Stopped` at each stop signal inside the block. Use this block once, around the whole program.

    Python prints a warning if it ignores an exception, for example in `__del__`. Inside the block this warning is suppressed for
    `Stopped`, because the request is stored. After a signal it is also suppressed for every exception in `__del__`, because
    `Stopped` may have ended the `__init__` of the object before all attributes were set. After the block, a signal ends the
    process with the default action of the system.
    """

    def stop(request: StopRequest, _number: int, _repeated: bool) -> None:
        request.check()

    report = sys.unraisablehook

    def report_others(lost: sys.UnraisableHookArgs) -> None:
        stopped = _request is not None and _request.wanted
        in_destructor = getattr(lost.object, "__name__", None) == "__del__"
        if not (issubclass(lost.exc_type, Stopped) or (stopped and in_destructor)):
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
    """Set `wanted` at the first stop signal inside the block, and end the process at a second SIGINT or SIGTERM.

    The signals raise no exception inside the block, so the block must read `wanted`. If the process ends, the drives hold the
    robot after their watchdog timeout.

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
    """Call `end` at each stop signal inside the block. The signals raise no exception.

    Args:
        end: Function that requests the end of the block. It may be called at any time, so it must only set a flag.
    """

    def ask(_request: StopRequest, _number: int, _repeated: bool) -> None:
        end()

    with _handled(ask) as request:
        yield request


@contextmanager
def deferred() -> Iterator[None]:
    """Store each stop signal inside the block, and raise no exception. Only the next `check_stop` raises `Stopped`.

    Use this block around compiled code, which may replace `Stopped` by another exception. This block has no effect if no
    other block of this module is active, for example in a worker process, which ignores Ctrl-C.
    """
    if _request is None:
        yield
        return
    with _handled(lambda _request, _number, _repeated: None):
        yield
