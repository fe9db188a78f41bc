"""Calls over processes: what comes back, and how an iteration that is left ends."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest
from joblib.externals.loky.process_executor import _ExecutorManagerThread

from atalante_control.gait_optimization.parallel import FanOutError, fan_out


def doubled(number: int) -> tuple[int, int]:
    return 2 * number, os.getpid()


def hears_ctrl_c(_: int) -> bool:
    return signal.getsignal(signal.SIGINT) is not signal.SIG_IGN


def slow(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def test_one_job_is_this_process_in_order() -> None:
    assert list(fan_out(doubled, range(4))) == [(2 * number, os.getpid()) for number in range(4)]


def test_processes_give_the_same_results_and_are_not_this_one() -> None:
    found = list(fan_out(doubled, range(8), jobs=2))
    assert sorted(number for number, _ in found) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert os.getpid() not in {process for _, process in found}


def test_ctrl_c_is_for_the_caller_alone() -> None:
    assert not any(fan_out(hears_ctrl_c, range(4), jobs=2))
    assert hears_ctrl_c(0)


def test_an_iteration_that_is_left_ends_its_processes_without_a_word() -> None:
    """Warnings are errors in these tests."""
    results = fan_out(slow, [0.0, 600.0, 600.0, 600.0], jobs=2)
    process = next(results)
    results.close()
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    pytest.fail(f"process {process} still works")


@pytest.mark.parametrize(("error", "told"), [(KeyError, []), (ValueError, [ValueError])])
def test_that_loky_stumbles_over_calls_it_has_forgotten_is_not_told(
    error: type[Exception], told: list[type[Exception]], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_out = _ExecutorManagerThread.add_call_item_to_queue

    def stumble(thread: _ExecutorManagerThread) -> None:
        if thread.executor_flags.shutdown:
            raise error
        hand_out(thread)

    said: list[type[Exception]] = []
    monkeypatch.setattr(threading, "excepthook", lambda arguments: said.append(arguments.exc_type))
    monkeypatch.setattr(_ExecutorManagerThread, "add_call_item_to_queue", stumble)
    results = fan_out(slow, [0.0, 600.0, 600.0, 600.0], jobs=2)
    next(results)
    results.close()
    assert said == told


def test_no_result_for_too_long_is_told() -> None:
    with pytest.raises(TimeoutError):
        list(fan_out(slow, [600.0], jobs=2, patience=0.1))


def test_what_is_missing_is_said_with_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FanOutError, match="start one with `dask scheduler`"):
        list(fan_out(doubled, [1], cluster="not an address"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(FanOutError, match=r"pip install 'atalante-hal\[dask\]'"):
        list(fan_out(doubled, [1], cluster="tcp://127.0.0.1:1"))
    monkeypatch.setitem(sys.modules, "joblib", None)
    with pytest.raises(FanOutError, match="or use --jobs 1"):
        list(fan_out(doubled, [1], jobs=2))
