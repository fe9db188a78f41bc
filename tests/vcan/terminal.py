"""`atalante` commands as processes, as if typed in terminals. They are forked from the test, which has done the slow imports."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from atalante_tools.entry import main
from tests.vcan.conftest import PATIENCE


class Terminal:
    """Process of one `atalante` command, with a keyboard and a log of its output.

    Args:
        log: File for stdout and stderr.
        arguments: Command line after `atalante`.
    """

    def __init__(self, log: Path, *arguments: str) -> None:
        self.log, self.arguments = log, arguments
        keyboard, self._typed = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            os.close(self._typed)
            _become(log, keyboard, arguments)
        os.close(keyboard)
        self.exit_code: int | None = None

    def type(self, line: str) -> None:
        """Type a line on the keyboard."""
        os.write(self._typed, f"{line}\n".encode())

    def text(self) -> str:
        """Return the output so far."""
        return self.log.read_text() if self.log.exists() else ""

    def wait_for(self, text: str, since: int = 0, *others: str) -> None:
        """Wait until the output after the position `since` contains `text` or one of the texts in `others`."""
        wanted = (text, *others)
        wait_until(
            lambda: any(each in self.text()[since:] for each in wanted),
            lambda: f"{self.arguments} must print {' or '.join(wanted)}: {self.text()}",
        )

    def wait_for_pattern(self, pattern: str, since: int) -> None:
        """Wait until a part of the output after the position `since` matches a regular expression."""
        wait_until(
            lambda: re.search(pattern, self.text()[since:]) is not None,
            lambda: f"{self.arguments} must print {pattern!r}: {self.text()}",
        )

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal, wait for the end, and return the exit code, or the negative signal number if the signal killed it."""
        if self.exit_code is None:
            os.kill(self.pid, number)
            _, status = os.waitpid(self.pid, 0)
            os.close(self._typed)
            self.exit_code = os.waitstatus_to_exitcode(status)
        return self.exit_code

    @property
    def running(self) -> bool:
        """Return whether the process still runs."""
        if self.exit_code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.exit_code = os.waitstatus_to_exitcode(status)
        return self.exit_code is None


def wait_until(condition: Callable[[], bool], failure: Callable[[], str], patience: float = PATIENCE) -> None:
    """Wait until a condition holds; fail the test with a message after `patience` [s]."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, failure()
        time.sleep(0.02)


def _become(log: Path, keyboard: int, arguments: tuple[str, ...]) -> NoReturn:
    """Run the command in this forked process, as a shell would start it."""
    code = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number, file in enumerate((keyboard, output, output)):
            os.dup2(file, number)
        sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w", buffering=1), open(2, "w", buffering=1)  # noqa: SIM115
        sys.argv = ["atalante", *arguments]
        os.chdir(log.parent)
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001 - the exception belongs into the log of this terminal
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
