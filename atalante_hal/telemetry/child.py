"""Telemetry subprocess, seen from the process of the control loop: start, configuration, reports, end.

    TelemetryChild() -> configure(...) -> reports (JSON lines)

While the caller still prepares the session, the subprocess imports its modules and waits for its configuration. The
subprocess is a new interpreter (`python -m atalante_hal.telemetry`), not a fork. It has its own process group, so
Ctrl-C in the terminal does not end the subprocess.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

from atalante_hal.closing import Closing
from atalante_hal.memory import anonymous_file

#: Names of the ring buffers that a session can have: cycle records, events, and CAN frames for the CAN log.
RINGS = RECORDS, EVENTS, FRAMES = "records", "events", "frames"


class TelemetryChild(Closing):
    """Telemetry subprocess.

    The subprocess inherits the files of the rings. If the session does not exist yet, this object creates
    empty files. The session later takes over these files with `take_files`.

    Attributes:
        pid: Process id.
    """

    def __init__(self, files: Mapping[str, int] | None = None) -> None:
        """Start the subprocess.

        Args:
            files: Name -> file descriptor of each ring of the session; None if the session does not exist yet.
        """
        self._files: dict[str, int] = {}  # files of the ring buffers, until `take_files` passes them to a session
        if files is None:
            files = self._files = {name: anonymous_file("atalante-telemetry", 0) for name in RINGS}
        self._unread = b""  # output that was read, but that `report` has not returned yet
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "atalante_hal.telemetry"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=tuple(files.values()),
            process_group=0,
        )
        self.pid = self._process.pid

    def take_files(self) -> dict[str, int]:
        """Return name and file descriptor of each ring buffer. From now on, the caller must close the descriptors."""
        files, self._files = self._files, {}
        return files

    def configure(self, arguments: Mapping[str, Any]) -> None:
        """Send the arguments. The subprocess then opens its files and its Zenoh session.

        Nothing is sent if the subprocess has already ended. `report` then returns None.

        Args:
            arguments: Arguments as JSON types, see `atalante_hal.telemetry.__main__`.
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError), self._process.stdin as standard_input:
            standard_input.write(json.dumps(arguments).encode())

    @property
    def alive(self) -> bool:
        """Return whether the subprocess exists, even if it is suspended. The call is too slow for every cycle."""
        return self._process.poll() is None

    def report(self, timeout: float) -> dict[str, Any] | None:
        """Return the next JSON line of the subprocess. Return None if the subprocess has ended or prints no line in time.

        Args:
            timeout: Longest wait [s].
        """
        assert self._process.stdout is not None
        if self._process.stdout.closed:
            return None
        pipe = self._process.stdout.fileno()
        give_up = time.monotonic() + timeout
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while b"\n" not in self._unread:
                if not selector.select(max(0.0, give_up - time.monotonic())):
                    return None
                read = os.read(pipe, 1 << 16)
                if not read:
                    return None
                self._unread += read
        line, _, self._unread = self._unread.partition(b"\n")
        report: dict[str, Any] = json.loads(line)
        return report

    def kill(self) -> None:
        """Kill the subprocess. `wait` or `close` must follow."""
        self._process.kill()

    def wait(self) -> None:
        """Wait until the subprocess has ended."""
        self._process.wait()

    def close(self, patience: float = 0.0) -> None:
        """Wait for the end of the subprocess, and kill it if it does not end in time.

        Args:
            patience: Longest wait [s].
        """
        for descriptor in self.take_files().values():
            os.close(descriptor)
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
