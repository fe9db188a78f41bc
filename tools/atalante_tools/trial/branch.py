"""Branches of a run. A branch is a waiting copy of the process, forked at one moment of the run.

    run --fork--> waiting process --fork per request--> continued run -> answer

For each request, a further copy of the process continues the run from this moment. The operating system copies only the memory
that changes, so a branch takes less time than a repetition of the run from its start. Equal requests lead to equal runs,
because all time is virtual.
"""

from __future__ import annotations

import os
import signal
import threading
import warnings
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any


class Branch:
    """Handle of a forked process that waits at one moment of a run.

    `ask` continues the run from this moment, in a further copy of the process. The handle owns the pipe to the waiting process.
    """

    def __init__(self, channel: Connection) -> None:
        self._channel = channel

    def ask(self, request: Any) -> Any:
        """Continue the run in a new process, from the moment at which the branch waits. Return the answer of the new process.

        Args:
            request: object that describes how the run continues.

        Raises:
            RuntimeError: If the new process ended without an answer.
        """
        self._channel.send(request)
        answer = self._channel.recv()
        if isinstance(answer, _NoAnswer):
            raise RuntimeError(
                f"the new process that continues the run must answer, but it ended with exit code {answer.exit_code}"
            )
        return answer


class Continuation:
    """Copy of a run that continues from a branch, in a new process. The new process must end with `finish` or `abandon`.

    The new process also ends when nobody waits for its answer, for example after Ctrl-C in the process that asked. Otherwise the
    copy would walk on for seconds and keep the open files of the run, with the lock of the output folder.

    Attributes:
        request: how the run continues.
    """

    def __init__(self, request: Any, channel: Connection) -> None:
        self.request = request
        self._channel = channel
        self._answered = False
        threading.Thread(target=self._end_without_listener, daemon=True).start()

    def _end_without_listener(self) -> None:
        """End this process when the other end of the pipe is closed.

        Between a request and its answer, nothing is sent to this process. So the pipe becomes readable only when it is closed.
        """
        self._channel.poll(None)
        if not self._answered:
            os._exit(1)

    def finish(self, answer: Any) -> None:
        """Send the answer and end this process.

        Args:
            answer: object that can be pickled.
        """
        self._answered = True  # after the answer, the pipe also becomes readable when the next request arrives
        self._channel.send(answer)
        os._exit(0)

    @staticmethod
    def abandon() -> None:
        """End this process without an answer."""
        os._exit(1)


class _NoAnswer:
    """Message of the waiting process to its parent: the process that continued the run ended without an answer.

    Attributes:
        exit_code: exit code of the ended process; the negative number of the signal if a signal ended it.
    """

    def __init__(self, exit_code: int) -> None:
        self.exit_code = exit_code


def branch() -> Branch | Continuation:
    """Fork this process. The parent gets a `Branch` and continues the run. The child waits at this moment of the run.

    For each request that the parent sends through the `Branch`, the waiting child forks a new process. In the new process, this
    function returns a `Continuation`, and the run continues from this moment.
    """
    ours, theirs = Pipe()
    if _fork():
        theirs.close()
        return Branch(ours)
    ours.close()
    # This process ignores the signals of the terminal. It ends when the run closes the pipe.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        while True:
            request = theirs.recv()
            child = _fork()
            if not child:
                break
            _, status = os.waitpid(child, 0)
            if status:
                theirs.send(_NoAnswer(os.waitstatus_to_exitcode(status)))
    except EOFError:  # the run has closed its end of the pipe, or has ended
        os._exit(0)
    except BaseException:  # noqa: BLE001 - after any error, this process must end here and not run the code of the caller
        os._exit(1)
    return Continuation(request, theirs)


def _fork() -> int:
    with warnings.catch_warnings():
        # Python 3.12 warns if a process forks while the numeric libraries have idle threads. A branch uses no thread.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()
