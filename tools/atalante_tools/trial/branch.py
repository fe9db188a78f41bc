"""Branches of a run: copies of this process that wait at a moment of the run and continue it from there, once per request.

    run --fork--> waiting process --fork per request--> continued run -> answer

The operating system copies the memory of the process only where it changes, so a branch is cheaper than a repetition of the run
until its moment. Equal requests lead to equal runs, because all time is virtual.
"""

from __future__ import annotations

import os
import signal
import warnings
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any


class Branch:
    """Branch of a run, as the process that made the run uses it."""

    def __init__(self, channel: Connection) -> None:
        self._channel = channel

    def ask(self, request: Any) -> Any:
        """Return the answer of a run that continues from the moment of the branch.

        Args:
            request: object that describes how the run continues.

        Raises:
            RuntimeError: If the process of the continued run ended without an answer.
        """
        self._channel.send(request)
        answer = self._channel.recv()
        if isinstance(answer, _NoAnswer):
            raise RuntimeError(f"the process of the continued run must answer, it ended with status {answer.status}")
        return answer


class Continuation:
    """Continued run, as its own process uses it. The process must end by `finish` or `abandon`.

    Attributes:
        request: how the run continues.
    """

    def __init__(self, request: Any, channel: Connection) -> None:
        self.request = request
        self._channel = channel

    def finish(self, answer: Any) -> None:
        """Send the answer and end this process.

        Args:
            answer: object that can be pickled.
        """
        self._channel.send(answer)
        os._exit(0)

    @staticmethod
    def abandon() -> None:
        """End this process without an answer."""
        os._exit(1)


class _NoAnswer:
    """Message of a waiting process whose continued run ended without an answer."""

    def __init__(self, status: int) -> None:
        self.status = status


def branch() -> Branch | Continuation:
    """Branch off at this point of the run. In the calling process, return the branch and let the run continue.

    Each request to the branch lets this function return a second time, in another process and with a `Continuation`.
    """
    ours, theirs = Pipe()
    if _fork():
        theirs.close()
        return Branch(ours)
    ours.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process of the run decides when its branches end
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        while True:
            request = theirs.recv()
            child = _fork()
            if not child:
                break
            _, status = os.waitpid(child, 0)
            if status:
                theirs.send(_NoAnswer(status))
    except EOFError:  # the process of the run has closed the branch, or has ended
        os._exit(0)
    except BaseException:  # noqa: BLE001 - no error may return into the run, which the calling process continues
        os._exit(1)
    return Continuation(request, theirs)


def _fork() -> int:
    with warnings.catch_warnings():
        # Python 3.12 warns of forks beside the idle threads of the numeric libraries. A branch uses no thread.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()
