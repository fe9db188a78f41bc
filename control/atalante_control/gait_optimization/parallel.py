"""Many calls over processes or the workers of a cluster, results as they come: what gait library and fault campaign share.

`joblib.Parallel`, on its own processes or, when a scheduler is named, on dask's workers.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Final, TypeVar

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")
#: Longest wait for a scheduler.
_MEETING: Final = "10s"
_LOKY_THREAD: Final = "ExecutorManagerThread"


class FanOutError(RuntimeError):
    """The calls cannot be spread as asked; the message says what to type."""


def fan_out(
    call: Callable[[_Task], _Result],
    tasks: Iterable[_Task],
    *,
    jobs: int = 1,
    cluster: str | None = None,
    patience: float | None = None,
) -> Generator[_Result, None, None]:
    """Results in the order in which they come.

    Ctrl-C is for the caller alone: the processes do not hear it, and end with the iteration, however that ends.

    Args:
        call: a function of a module, for other processes to find it.
        jobs: processes on this computer; 1 is this process.
        cluster: address of a dask scheduler, such as tcp://127.0.0.1:8786, whose workers have the project installed.
        patience: longest wait for a result of a process [s].

    Raises:
        FanOutError: joblib or dask is missing, or the scheduler does not answer.
        TimeoutError: there was no result for `patience`.
    """
    if jobs == 1 and not cluster:
        yield from map(call, tasks)
        return
    try:
        from joblib import Parallel, delayed, parallel_config
    except ModuleNotFoundError as error:
        raise FanOutError(
            "several processes need joblib: type `pip install 'atalante-hal[campaign]'`, or --jobs 1"
        ) from error
    with ExitStack() as stack:
        if cluster:
            stack.enter_context(_client(cluster))
            stack.enter_context(parallel_config(backend="dask"))
        pool = Parallel(
            n_jobs=-1 if cluster else jobs, return_as="generator_unordered", timeout=None if cluster else patience
        )
        with _without_ctrl_c():
            results = pool(delayed(call)(task) for task in tasks)
        try:
            for result in results:  # noqa: UP028 - `yield from` would close the results by itself, and not quietly
                yield result
        except multiprocessing.TimeoutError as error:  # which is no TimeoutError
            raise TimeoutError(f"no result for {patience:g} s") from error
        finally:
            with warnings.catch_warnings(), _without_stumbles():
                warnings.simplefilter("ignore", UserWarning)  # that results are left is what was wanted
                results.close()


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes begun inside inherit that Ctrl-C is not for them: their parent ends them.

    Blocking the signal would not do: what joblib starts first, its resource tracker, unblocks it for those that follow.
    """
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _without_stumbles() -> Iterator[None]:
    """Nothing is said of a KeyError in loky's thread.

    Told to kill its processes, it forgets the calls that wait, kills, and then looks one of them up if it was just about to hand
    it out (`add_call_item_to_queue` in loky 3.6): nothing is left to be done by then.
    """
    before = threading.excepthook

    def tell(said: threading.ExceptHookArgs) -> None:
        stumbled = said.exc_type is KeyError and said.thread is not None and said.thread.name == _LOKY_THREAD
        if not stumbled:
            before(said)

    threading.excepthook = tell
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def _client(address: str) -> Iterator[None]:
    """A client of the scheduler, which joblib's backend `dask` finds by itself."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise FanOutError("--dask needs dask: type `pip install 'atalante-hal[dask]'`") from error
    try:
        client = Client(address, timeout=_MEETING)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise FanOutError(f"no dask scheduler at {address}: {error}; start one with `dask scheduler`") from error
    with client:
        yield
