"""Parallel function calls in processes or on a cluster, used by the gait library and the fault campaign.

The calls use the processes of `joblib.Parallel`, or the workers of a dask scheduler.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, Final, TypeVar

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")
#: Timeout of the connection to a dask scheduler.
_CONNECT_TIMEOUT: Final = "10s"
#: Part of the error message of dask if the scheduler cannot load the calls. Loading a call imports the called function.
_FOREIGN: Final = "Error during deserialization of the task graph"
#: Timeout of the connection of the first worker to the dask scheduler [s].
_WORKER_TIMEOUT: Final = 10.0
#: Number of process crashes after which the calls run one at a time. A crash then loses the result of one call only.
_SHARED_LOSSES: Final = 3
_REMEDY: Final = "repeat the command, if necessary with fewer --jobs"
_TERMINAL_SIGNALS: Final = (signal.SIGINT, signal.SIGHUP)
_LOKY_THREAD: Final = "ExecutorManagerThread"
#: Lock for the threads of a dask worker. Calls use the global state of their process, so only one call may be active.
_one_at_a_time: Final = threading.Lock()


class FanOutError(RuntimeError):
    """Failure of parallel calls. The message states the remedy."""


class LostProcessError(FanOutError):
    """Unexpected end of a process, for example for lack of memory. Some calls therefore have no result."""


def fan_out(
    call: Callable[[_Task], _Result],
    tasks: Iterable[_Task],
    *,
    jobs: int = 1,
    cluster: str | None = None,
    patience: float | None = None,
    on_lost: Callable[[str], None] | None = None,
) -> Generator[_Result, None, None]:
    """Call a function for many tasks in parallel, and yield the results in the order of completion.

    Only the calling process handles Ctrl-C and SIGHUP. All other processes ignore them, and end when the iteration ends or is
    closed.

    Args:
        call: function to call, defined at module level, because other processes import it.
        tasks: argument of each call.
        jobs: number of processes on this computer. With 1, the calls run in this process.
        cluster: address of a dask scheduler such as tcp://127.0.0.1:8786. The project must be installed on its workers.
            A worker process runs one call at a time, even if the worker has several threads.
        patience: longest time between two results [s], or None for no limit. On a cluster there is no limit.
        on_lost: function called with a message when a process of this computer has ended unexpectedly, for example for
            lack of memory. The calls without a result are then repeated in new processes. After 3 unexpected ends,
            these calls run one at a time. A call that ends its process again is not repeated. If None, no call is
            repeated.

    Raises:
        FanOutError: If joblib or dask is missing, the scheduler does not respond or has no worker, or its connection is lost.
        LostProcessError: If calls have no result because their processes ended unexpectedly. The other calls of this computer
            were finished.
        TimeoutError: If no result arrives within `patience`.
    """
    if jobs == 1 and not cluster:
        yield from map(call, tasks)
        return
    if cluster:
        yield from _on_cluster(call, tasks, cluster)
        return
    try:
        from joblib import Parallel, delayed
    except ModuleNotFoundError as error:
        raise FanOutError(
            "several processes need joblib: install it with `pip install 'atalante-hal[campaign]'`, or use --jobs 1"
        ) from error
    pending, without_result, losses = dict(enumerate(tasks)), 0, 0
    while pending:
        alone = losses >= _SHARED_LOSSES
        calls = list(pending.items())[: 1 if alone else None]
        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", timeout=patience)
        results = None
        try:
            with _terminal_signals_later():
                results = pool(delayed(_numbered)(call, number, task) for number, task in calls)
            for number, result in results:
                del pending[number]
                yield result
        except multiprocessing.TimeoutError as error:  # joblib does not raise the built-in TimeoutError
            raise TimeoutError(f"no parallel call finished within {patience:g} s") from error
        except BrokenProcessPool as error:
            if on_lost is None:
                raise LostProcessError(f"{_lost(len(pending))}; {_REMEDY}") from error
            losses += 1
            if alone:
                del pending[calls[0][0]]
                without_result += 1
            else:
                on_lost(f"{_lost(len(pending))}; they are repeated in new processes")
        finally:
            if results is not None:
                with warnings.catch_warnings(), _without_loky_errors():
                    warnings.simplefilter("ignore", UserWarning)  # joblib warns about results that are not used
                    results.close()
    if without_result:
        raise LostProcessError(f"{_lost(without_result)}; {_REMEDY}")


def _lost(calls: int) -> str:
    """Return the beginning of an error message about a crashed process. The caller appends the consequence.

    Args:
        calls: number of calls that have no result.
    """
    return f"a process ended unexpectedly, for example for lack of memory; calls without a result: {calls}"


def _numbered(call: Callable[[_Task], _Result], number: int, task: _Task) -> tuple[int, _Result]:
    return number, call(task)


@contextmanager
def _terminal_signals_later() -> Iterator[None]:
    """Delay SIGINT and SIGHUP until the end of the `with` block. They stay blocked in child processes that start in the block.

    The parent process ends the child processes. Processes and threads that start in the block inherit the signal mask, so the
    signals stay blocked in them. A thread of the parent process that started before the block may receive a signal. Then a
    handler stores the signal, and the signal is raised again at the end of the block.
    """
    from joblib.externals.loky.backend import resource_tracker as loky_tracker

    arrived: list[int] = []
    before = {number: signal.signal(number, lambda number, _: arrived.append(number)) for number in _TERMINAL_SIGNALS}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
    try:
        for tracker in (resource_tracker, loky_tracker):
            tracker.ensure_running()  # Python before 3.12 and joblib before 1.6 unblock SIGINT when they start the tracker
        signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL_SIGNALS)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for stored in arrived:
            signal.raise_signal(stored)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _without_loky_errors() -> Iterator[None]:
    """Inside the `with` block, hide the traceback of a KeyError in a thread of loky. Loky is the process pool of joblib.

    Before loky ends its processes, it clears the table of pending calls. If the executor thread queues a call at that moment, the
    call is not in the table (`add_call_item_to_queue` in loky 3.6). The error has no effect, because all calls are cancelled.
    """
    before = threading.excepthook

    def report(failure: threading.ExceptHookArgs) -> None:
        thread = failure.thread
        expected = failure.exc_type is KeyError and thread is not None and thread.name == _LOKY_THREAD
        if not expected:
            before(failure)

    threading.excepthook = report
    try:
        yield
    finally:
        threading.excepthook = before


def _on_cluster(
    call: Callable[[_Task], _Result], tasks: Iterable[_Task], address: str
) -> Generator[_Result, None, None]:
    """Call a function for many tasks on the workers of a dask scheduler, and yield the results in the order of completion.

    The backend `dask` of joblib is not used: with a cluster of one thread, joblib runs the calls in the calling process.

    Args:
        call: function to call.
        tasks: argument of each call.
        address: address of the scheduler.

    Raises:
        FanOutError: If dask is missing, the scheduler does not respond, has no worker or cannot load the calls, or if its
            connection is lost.
        LostProcessError: If a call ended several workers.
    """
    with _client(address) as client:
        from distributed import CancelledError, KilledWorker, as_completed

        try:
            client.wait_for_workers(1, timeout=_WORKER_TIMEOUT)
        except TimeoutError as error:
            raise FanOutError(
                f"the dask scheduler at {address} has no worker: start one with `dask worker {address}`"
            ) from error
        futures = client.map(partial(_alone, call), list(tasks), pure=False)
        try:
            for future in as_completed(futures):  # type: ignore[no-untyped-call]
                yield future.result()
                future.release()
        except KilledWorker as error:
            raise LostProcessError(
                f"a call ended several workers of {address}, for example for lack of memory; repeat the command"
            ) from error
        except RuntimeError as error:
            if _FOREIGN not in str(error):
                raise
            raise FanOutError(
                f"the dask scheduler at {address} must have the same versions of this project and of all packages as this program"
            ) from error
        except CancelledError as error:
            raise FanOutError(
                f"the connection to the dask scheduler at {address} is lost; repeat the command when the scheduler runs again"
            ) from error
        finally:
            with suppress(Exception):  # after a lost connection, nothing can be cancelled
                client.cancel(futures)


def _alone(call: Callable[[_Task], _Result], task: _Task) -> _Result:
    with _one_at_a_time:
        return call(task)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Connect to a dask scheduler, and yield the client.

    Args:
        address: address of the scheduler.

    Raises:
        FanOutError: If dask is missing, or the scheduler does not respond.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise FanOutError("--dask needs dask: install it with `pip install 'atalante-hal[dask]'`") from error
    try:
        client = Client(address, timeout=_CONNECT_TIMEOUT)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, TypeError, ValueError) as error:  # TypeError: no certificate for tls://
        raise FanOutError(
            f"no dask scheduler responds at {address} ({error}): start one with `dask scheduler`"
        ) from error
    # A lost connection is reported as one sentence. Without the change of the log level, the client would also log a traceback.
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with client:
            yield client
    finally:
        logger.setLevel(level)
