"""What a command shows: log lines and a live progress line on stderr, tables and JSON objects on stdout."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TextIO

import click

#: Seconds between two progress lines: on a terminal, where each replaces the last, and in a log.
LIVE: Final = 0.2
LOGGED: Final = 5.0


def say(text: str) -> None:
    """One line for the person at the terminal, on stderr."""
    click.echo(text, err=True)


class Patience(logging.Handler):
    """Says once that hot loops are being compiled, which takes seconds, when the first one is."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._said = False

    @classmethod
    def begin(cls) -> None:
        """Listen to `atalante_hal.compiled`, without importing it: most commands compile nothing."""
        logger = logging.getLogger("atalante_hal.compiled")
        logger.addHandler(cls())
        logger.setLevel(logging.INFO)

    def emit(self, _record: logging.LogRecord) -> None:
        """A loop is compiled."""
        if not self._said:
            self._said = True
            say("preparing machine code: some seconds, once after an installation or an update")


def show_json(value: Mapping[str, Any]) -> None:
    """One JSON object on a line of stdout. A number that is not finite is null."""
    click.echo(json.dumps(_finite(value), allow_nan=False))


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows as aligned columns, the first row being the head; numbers to the right."""
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = []
    for row in rows:
        cells = [c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


class Progress:
    """A line that says how far things are: rewritten in place on a terminal, every few seconds in a log.

    `due()` is cheap enough to be asked every cycle.
    """

    def __init__(
        self, *, period: float | None = None, stream: TextIO | None = None, now: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin now; `period` [s] replaces both usual ones."""
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._now = now
        self._period = period or (LIVE if self._live else LOGGED)
        self._next = now() + self._period
        self._width = 0

    def due(self) -> bool:
        """Whether it is time for the next line."""
        return self._now() >= self._next

    def show(self, text: str) -> None:
        """Print the line."""
        self._next = self._now() + self._period
        if self._live:
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
        else:
            self._stream.write(text + "\n")

    def clear(self) -> None:
        """Take the line away, before something else is printed."""
        if self._live and self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0


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
