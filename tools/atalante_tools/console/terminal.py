"""Console output of the commands: messages and a progress line on stderr, tables and JSON objects on stdout."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, TextIO

import click

#: Time between two progress lines on a terminal [s]. Each line overwrites the previous line.
LIVE: Final = 0.2
#: Time between two progress lines if stderr is a file or a pipe [s].
LOGGED: Final = 5.0
#: Width of the bar of a progress line [characters].
_BAR: Final = 24


def print_message(text: str) -> None:
    """Print a message of one line on stderr.

    A failed output raises no exception, because messages are also printed while the robot walks. For example, Ctrl-C also ends a
    program that reads stderr through a pipe.
    """
    with suppress(OSError):
        click.echo(text, err=True)


class CompilationNotice(logging.Handler):
    """Log handler that prints one message at the first compilation of a function, because compilation can take minutes."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._printed = False

    @classmethod
    def begin(cls) -> None:
        """Install the handler on the logger of `atalante_hal.compiled`."""
        logger = logging.getLogger("atalante_hal.compiled")
        logger.addHandler(cls())
        logger.setLevel(logging.INFO)

    def emit(self, _record: logging.LogRecord) -> None:
        """Print the message at the first log record. Every log record reports a compilation."""
        if not self._printed:
            self._printed = True
            print_message(
                "compiling: takes up to some minutes, only in the first runs after an installation or an update"
            )


def show_json(value: Mapping[str, Any]) -> None:
    """Print a JSON object as one line on stdout. NaN and infinity become null."""
    click.echo(json.dumps(_finite(value), allow_nan=False))


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as text with aligned columns. The first row is the header. Columns of numbers are right-aligned."""
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = []
    for row in rows:
        cells = [c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


class Progress:
    """Progress line of a command. On a terminal each line overwrites the previous line.

    `due()` is fast and may be called in every cycle.
    """

    def __init__(
        self, *, period: float | None = None, stream: TextIO | None = None, now: Callable[[], float] = time.monotonic
    ) -> None:
        """Set up the progress line and start its first period.

        Args:
            period: Time between two lines [s]. None means `LIVE` on a terminal, `LOGGED` otherwise.
            stream: Text stream of the lines. None means stderr.
            now: Monotonic clock [s].
        """
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._now = now
        self._period = period or (LIVE if self._live else LOGGED)
        self._begun = now()
        self._next = self._begun + self._period
        self._width = 0  # length of the last line [characters]
        self._written = 0  # length of the last line, including the spaces written at its end [characters]

    def due(self) -> bool:
        """Return whether it is time to print the next progress line.

        One period must have passed since the last progress line. The first period begins in `__init__`.
        """
        return self._now() >= self._next

    def show(self, text: str) -> None:
        """Print a progress line and start the next period."""
        self._next = self._now() + self._period
        if self._live:
            padded = text.ljust(self._width)
            self._write(self._to_start() + padded)
            self._width, self._written = len(text), len(padded)
        else:
            self._write(text + "\n")

    def _write(self, text: str) -> None:
        with suppress(OSError):  # see `print_message`
            self._stream.write(text)
            self._stream.flush()

    def bar(self, done: int, total: int, unit: str) -> None:
        """Print a progress bar and the estimated remaining time, if one period has passed since the last progress line.

        Args:
            done: Number of finished parts, at least 1.
            total: Number of all parts.
            unit: Plural noun for the parts, such as "steps".
        """
        if self.due():
            full = _BAR * done // total
            left = (self._now() - self._begun) / done * (total - done)
            self.show(f"[{'#' * full}{'.' * (_BAR - full)}] {done} of {total} {unit}, {left:.0f} s left")

    def clear(self) -> None:
        """Erase the progress line on a terminal, before other text is printed."""
        if self._live and self._width:
            self._write(self._to_start() + " " * self._width)
            self._written = self._width
            self._write(self._to_start())
            self._width = self._written = 0

    def _to_start(self) -> str:
        """Return the control characters that move the cursor to the start of the last line. A long line covers several rows."""
        try:
            columns = os.get_terminal_size(self._stream.fileno()).columns
        except OSError:
            columns = 0
        rows = (self._written - 1) // columns if columns and self._written else 0
        return "\r" + (f"\x1b[{rows}A" if rows else "")


def _is_number(cell: str) -> bool:
    return not cell or cell == "-" or cell.lstrip("+-").replace(".", "", 1).rstrip("%").isdigit()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
