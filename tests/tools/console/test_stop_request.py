"""Stop request: SIGINT, SIGTERM and SIGHUP set a flag and an exit code."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest

from atalante_tools.console.stop_request import (
    Stopped,
    check_stop,
    deferred,
    ended_by,
    interruptible,
    stop_requested,
)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_sets_the_stop_request_and_its_exit_code(number: signal.Signals, code: int) -> None:
    before = signal.getsignal(number)
    with stop_requested() as stop:
        assert (stop.wanted, stop.exit_code) == (False, 0)
        signal.raise_signal(number)
        assert (stop.wanted, stop.exit_code) == (True, code)
    assert signal.getsignal(number) is before


def test_the_signal_handlers_are_restored_after_an_error() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(ZeroDivisionError), stop_requested():
        raise ZeroDivisionError
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("numbers", [("SIGINT", "SIGINT"), ("SIGTERM", "SIGINT"), ("SIGINT", "SIGTERM")])
def test_the_second_signal_ends_the_process_immediately(numbers: tuple[str, str]) -> None:
    first, second = numbers
    program = f"""
import signal
from atalante_tools.console.stop_request import stop_requested
try:
    with stop_requested() as stop:
        signal.raise_signal(signal.{first})
        assert stop.wanted
        signal.raise_signal(signal.{second})
finally:
    print("still here")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.Signals[second]
    assert done.stdout == ""


@pytest.mark.parametrize("first", [signal.SIGHUP, signal.SIGINT])
def test_a_hangup_after_the_first_signal_has_no_effect(first: signal.Signals) -> None:
    """A shell and the kernel may both send SIGHUP when a terminal closes."""
    ends: list[bool] = []
    with stop_requested() as stop:
        signal.raise_signal(first)
        signal.raise_signal(signal.SIGHUP)
        assert (stop.signals, stop.exit_code) == (1, 128 + first)
        stop.settle()
        with ended_by(lambda: ends.append(stop.wanted)):
            for number in (first, signal.SIGHUP, signal.SIGHUP):
                signal.raise_signal(number)
    assert ends == [True]


def test_an_ignored_hangup_remains_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with interruptible(), stop_requested() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.wanted
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_in_another_thread_no_handler_is_installed_and_no_error_raised() -> None:
    wanted = []

    def work() -> None:
        with stop_requested() as stop:
            wanted.append(stop.wanted)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert wanted == [False]


def test_a_nested_block_shares_the_stop_request_of_the_outer_block() -> None:
    with stop_requested() as outer:
        with stop_requested() as inner:
            assert inner is outer
            signal.raise_signal(signal.SIGTERM)
        assert outer.exit_code == 143
        with pytest.raises(Stopped) as end, stop_requested():
            raise AssertionError("begun")
        assert end.value.code == 143
        with pytest.raises(Stopped):
            check_stop()
        outer.settle()
        check_stop()
        with stop_requested() as again:
            assert not again.wanted
    with stop_requested() as later:
        assert later is not outer


def test_a_block_with_an_end_callback_is_not_interrupted_by_signals() -> None:
    ends: list[bool] = []
    with stop_requested() as stop:
        with ended_by(lambda: ends.append(stop.wanted)) as request:
            assert request is stop
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
                signal.raise_signal(number)
        assert stop.exit_code == 130
    assert ends == [True, True, True]
    check_stop()  # no stop request is pending


def test_a_deferred_stop_is_raised_by_the_next_check() -> None:
    program = """
import signal
from atalante_tools.console.stop_request import check_stop, deferred, interruptible
with interruptible():
    with deferred():
        signal.raise_signal(signal.SIGINT)
        print("before", flush=True)
        check_stop()
        print("after")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "before\n", "")


def test_without_a_stop_request_deferred_keeps_the_signal_handlers() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a worker process
    try:
        with deferred():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            check_stop()
    finally:
        signal.signal(signal.SIGINT, before)


class HalfBuilt:
    """Object whose destructor fails if `interrupt`, called in `__init__`, raises an exception."""

    def __init__(self, interrupt: Callable[[], None]) -> None:
        interrupt()
        self.handle = 1

    def __del__(self) -> None:
        assert self.handle


def fail() -> None:
    raise ZeroDivisionError


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> list[type[BaseException]]:
    """Return the exceptions that Python ignored and reported outside of `interruptible`."""
    types: list[type[BaseException]] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda lost: types.append(lost.exc_type))
    return types


def test_after_a_signal_the_destructor_of_a_half_built_object_is_silent(reported: list[type[BaseException]]) -> None:
    with interruptible(), suppress(Stopped):
        HalfBuilt(lambda: signal.raise_signal(signal.SIGINT))
    assert reported == []


def test_without_a_signal_a_failed_destructor_is_reported(reported: list[type[BaseException]]) -> None:
    with interruptible(), pytest.raises(ZeroDivisionError):
        HalfBuilt(fail)
    assert reported == [AttributeError]


def test_after_a_signal_other_ignored_exceptions_are_reported(reported: list[type[BaseException]]) -> None:
    with interruptible() as stop:
        stop.ask(signal.SIGTERM)
        ctypes.CFUNCTYPE(None)(fail)()
    assert reported == [ZeroDivisionError]
