"""Output of the commands: log lines, progress, tables, JSON."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import logging
import math
import os
import select
import struct
import sys
import termios

import pytest

from atalante_hal import compiled
from atalante_tools.console.terminal import LIVE, LOGGED, CompilationNotice, Progress, print_message, show_json, table


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_log_lines_go_to_stderr_and_objects_to_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    print_message("hello")
    show_json({"a": 1.5, "b": math.nan, "c": [math.inf, {"d": -math.inf}], "e": None})
    captured = capsys.readouterr()
    assert captured.err == "hello\n"
    assert json.loads(captured.out) == {"a": 1.5, "b": None, "c": [None, {"d": None}], "e": None}
    assert captured.out.count("\n") == 1


def test_a_table_aligns_numbers_right_and_words_left() -> None:
    rows = [("node", "V", "degC"), ("LEFT_FH", "48.0", "-"), ("HAL", "-", "-5")]
    assert table(rows).splitlines() == ["node        V  degC", "LEFT_FH  48.0     -", "HAL         -    -5"]


def test_a_progress_line_is_overwritten_on_a_terminal() -> None:
    now = [0.0]
    terminal = Terminal()
    progress = Progress(stream=terminal, now=lambda: now[0])
    assert not progress.due()
    now[0] = LIVE
    assert progress.due()
    progress.show("a long line")
    assert not progress.due()
    progress.show("short")
    progress.clear()
    progress.clear()
    assert terminal.getvalue() == "\ra long line\rshort      \r     \r"


def test_a_progress_line_of_several_rows_is_overwritten_on_a_terminal() -> None:
    """A row has 10 columns. The cursor moves up by one row for each further row of the last line."""
    controller, end = os.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("4H", 24, 10, 0, 0))

    def written() -> str:
        text = b""
        while select.select([controller], (), (), 0.0)[0]:
            text += os.read(controller, 1000)
        return text.decode()

    with os.fdopen(end, "w") as terminal:
        progress = Progress(stream=terminal)
        for text in ("x" * 21, "y" * 11, "z"):
            progress.show(text)
        progress.clear()
        up = "\r\x1b[{}A".format
        expected = f"\r{'x' * 21}{up(2)}{'y' * 11:21}{up(2)}{'z':11}{up(1)} \r"
        assert written() == expected
        progress.show("w" * 10)  # the cursor remains in the last column
        progress.clear()
        assert written() == f"\r{'w' * 10}\r{' ' * 10}\r"
    os.close(controller)


def test_progress_is_printed_as_separate_lines_in_a_log() -> None:
    now = [0.0]
    log = io.StringIO()
    progress = Progress(stream=log, now=lambda: now[0])
    now[0] = LIVE
    assert not progress.due()
    now[0] = LOGGED
    assert progress.due()
    progress.show("one")
    progress.clear()
    assert log.getvalue() == "one\n"


def test_a_given_period_replaces_both_default_periods() -> None:
    now = [0.0]
    progress = Progress(period=1.0, stream=io.StringIO(), now=lambda: now[0])
    now[0] = 1.0
    assert progress.due()


def test_compilation_notice_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger(compiled.__name__)
    before = list(logger.handlers), logger.level
    try:
        CompilationNotice.begin()
        for name in ("accept", "limit"):
            logger.info("%s is compiled", name)
    finally:
        logger.handlers, logger.level = before
    assert capsys.readouterr().err == (
        "compiling: takes up to some minutes, only in the first runs after an installation or an update\n"
    )


def test_bar_shows_the_finished_share_and_the_time_left_when_a_line_is_due() -> None:
    now, log = [0.0], io.StringIO()
    progress = Progress(period=1.0, stream=log, now=lambda: now[0])
    now[0] = 0.5
    progress.bar(1, 4, "runs")
    assert log.getvalue() == ""
    now[0] = 2.0
    progress.bar(1, 4, "runs")
    assert log.getvalue() == f"[{'#' * 6}{'.' * 18}] 1 of 4 runs, 6 s left\n"


class _Closed(io.StringIO):
    """Stream whose reader has gone."""

    def write(self, _text: str) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


@pytest.mark.parametrize("live", [True, False])
def test_output_to_a_closed_pipe_raises_nothing_because_the_robot_may_walk(
    live: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = _Closed()
    monkeypatch.setattr(closed, "isatty", lambda: live)
    monkeypatch.setattr(sys, "stderr", closed)
    print_message("a message")
    progress = Progress()
    progress.show("a progress line")
    progress.clear()
