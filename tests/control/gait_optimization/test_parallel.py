"""Parallel calls in processes: their results, and the end of an interrupted iteration."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterable
from typing import Any

import joblib
import pytest
from distributed import LocalCluster
from joblib.externals.loky.process_executor import _ExecutorManagerThread

from atalante_control.gait_optimization.parallel import FanOutError, LostProcessError, fan_out

TERMINAL_SIGNALS = {signal.SIGINT, signal.SIGHUP}


def doubled(number: int) -> tuple[int, int]:
    return 2 * number, os.getpid()


def handles_terminal_signals(_: int) -> bool:
    return not signal.pthread_sigmask(signal.SIG_BLOCK, ()) >= TERMINAL_SIGNALS


def slow(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def test_one_job_runs_in_this_process_in_order() -> None:
    assert list(fan_out(doubled, range(4))) == [(2 * number, os.getpid()) for number in range(4)]


def test_two_jobs_run_in_other_processes_with_the_same_results() -> None:
    found = list(fan_out(doubled, range(8), jobs=2))
    assert sorted(number for number, _ in found) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert os.getpid() not in {process for _, process in found}


def test_worker_processes_ignore_ctrl_c_and_a_closed_terminal() -> None:
    assert not any(fan_out(handles_terminal_signals, range(4), jobs=2))
    assert handles_terminal_signals(0)


@pytest.mark.parametrize("number", sorted(TERMINAL_SIGNALS))
@pytest.mark.parametrize("in_thread", [False, True], ids=["blocked", "received by another thread"])
def test_terminal_signal_during_the_start_of_the_processes_is_handled_after_it(
    number: int, in_thread: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    received: list[int] = []
    before = signal.signal(number, lambda arrived, _: received.append(arrived))
    original = joblib.Parallel.__call__

    def interrupted(pool: joblib.Parallel, calls: Iterable[Any]) -> Any:
        if in_thread:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
            signal.raise_signal(number)
            signal.pthread_sigmask(signal.SIG_BLOCK, {number})
        else:
            os.kill(os.getpid(), number)
        results = original(pool, calls)
        assert received == []
        return results

    monkeypatch.setattr(joblib.Parallel, "__call__", interrupted)
    try:
        results = fan_out(handles_terminal_signals, range(4), jobs=2)
        first = next(results)
        assert received == [number]
        assert not any([first, *results])
    finally:
        signal.signal(number, before)


def test_closing_the_iteration_ends_its_processes_without_a_warning() -> None:
    """A warning would fail this test."""
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
    pytest.fail(f"process {process} still runs")


@pytest.mark.parametrize(("error", "reported"), [(KeyError, []), (ValueError, [ValueError])])
def test_key_error_of_loky_at_shutdown_is_suppressed(
    error: type[Exception], reported: list[type[Exception]], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = _ExecutorManagerThread.add_call_item_to_queue

    def fail_at_shutdown(thread: _ExecutorManagerThread) -> None:
        if thread.executor_flags.shutdown:
            raise error
        original(thread)

    raised: list[type[Exception]] = []
    monkeypatch.setattr(threading, "excepthook", lambda arguments: raised.append(arguments.exc_type))
    monkeypatch.setattr(_ExecutorManagerThread, "add_call_item_to_queue", fail_at_shutdown)
    results = fan_out(slow, [0.0, 600.0, 600.0, 600.0], jobs=2)
    next(results)
    results.close()
    assert raised == reported


def test_missing_result_raises_timeout_error() -> None:
    with pytest.raises(TimeoutError):
        list(fan_out(slow, [600.0], jobs=2, patience=0.1))


def killed(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_end_of_a_process_gives_one_sentence() -> None:
    with pytest.raises(
        LostProcessError, match=r"^a process ended unexpectedly.*; calls without a result: 3; repeat the command"
    ):
        list(fan_out(killed, range(3), jobs=2))


_active = 0


def active_calls(_: int) -> tuple[int, int]:
    """Return the number of calls that are active in this process at the same time, and the process."""
    global _active
    _active += 1
    time.sleep(0.2)
    found, _active = _active, _active - 1
    return found, os.getpid()


@pytest.mark.filterwarnings("ignore")  # dask's own
@pytest.mark.parametrize("threads", [1, 2])
def test_a_worker_of_a_cluster_runs_one_call_at_a_time(threads: int) -> None:
    with LocalCluster(
        n_workers=1, threads_per_worker=threads, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        found = list(fan_out(active_calls, range(4), cluster=cluster.scheduler_address))
    assert [active for active, _ in found] == [1] * 4
    assert len({process for _, process in found} - {os.getpid()}) == 1


@pytest.mark.filterwarnings("ignore")  # dask's own
def test_cluster_without_workers_gives_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("atalante_control.gait_optimization.parallel._WORKER_TIMEOUT", 0.2)
    with LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=None, silence_logs=50) as cluster:
        address = cluster.scheduler_address
        with pytest.raises(FanOutError, match=f"has no worker: start one with `dask worker {address}`$"):
            list(fan_out(doubled, [1], cluster=address))


def _missing() -> None:
    raise AttributeError("this version has no such function")


class Foreign:
    """Task that can be pickled but not loaded, like a function that the scheduler does not have."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _missing, ()


@pytest.mark.filterwarnings("ignore")  # dask's own
def test_scheduler_that_cannot_load_the_calls_gives_one_sentence() -> None:
    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        with pytest.raises(FanOutError, match="must have the same versions of this project"):
            list(fan_out(str, [Foreign()], cluster=cluster.scheduler_address))
        with pytest.raises(RuntimeError, match="raised in a call"):
            list(fan_out(fails, [1], cluster=cluster.scheduler_address))


@pytest.mark.filterwarnings("ignore")  # dask's own
def test_lost_scheduler_gives_one_sentence() -> None:
    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        results = fan_out(slow, [0.0, 600.0], cluster=cluster.scheduler_address)
        next(results)
        cluster.close()
        with pytest.raises(FanOutError, match=r"is lost; repeat the command when the scheduler runs again$"):
            next(results)


def fails(_: int) -> None:
    raise RuntimeError("raised in a call")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # dask's own
def test_call_that_ends_every_worker_gives_one_sentence() -> None:
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
        ) as cluster,
        pytest.raises(LostProcessError, match=r"^a call ended several workers of .*; repeat the command$"),
    ):
        list(fan_out(killed, [1], cluster=cluster.scheduler_address))


def test_missing_dependency_error_contains_the_command_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FanOutError, match="start one with `dask scheduler`"):
        list(fan_out(doubled, [1], cluster="not an address"))
    with pytest.raises(FanOutError, match=r"at tls://127.0.0.1:1 .*start one with `dask scheduler`"):
        list(fan_out(doubled, [1], cluster="tls://127.0.0.1:1"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(FanOutError, match=r"pip install 'atalante-hal\[dask\]'"):
        list(fan_out(doubled, [1], cluster="tcp://127.0.0.1:1"))
    monkeypatch.setitem(sys.modules, "joblib", None)
    with pytest.raises(FanOutError, match="or use --jobs 1"):
        list(fan_out(doubled, [1], jobs=2))
