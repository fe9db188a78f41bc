"""Many tasks over processes or a cluster, with the same call: `joblib.Parallel`, on dask's workers when a cluster is named.

tasks -> joblib (its processes, or dask's) -> results as they come -> report
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from atalante_tools.faults.tasks import Result, Task, run_task
from atalante_tools.outcome import Failed

#: Seconds after which a campaign that got no result is said to hang.
HANGS: Final = 300.0


def results(tasks: Sequence[Task], *, jobs: int = 1, dask: str = "") -> Iterator[Result]:
    """Results in the order in which they come.

    Args:
        jobs: processes on this computer; 1 is this process.
        dask: address of a scheduler, such as tcp://127.0.0.1:8786, whose workers have the project installed; empty: none.

    Raises:
        Failed: joblib or dask is missing, the scheduler does not answer, or a task hangs.
    """
    if jobs == 1 and not dask:
        yield from map(run_task, tasks)
        return
    try:
        from joblib import Parallel, delayed, parallel_config
    except ModuleNotFoundError as error:
        raise Failed(
            "several processes need joblib: type `pip install 'atalante-hal[campaign]'`, or --jobs 1"
        ) from error
    with ExitStack() as stack:
        stack.enter_context(_hanging())
        if dask:
            stack.enter_context(_cluster(dask))
            stack.enter_context(parallel_config(backend="dask"))
        pool = Parallel(n_jobs=-1 if dask else jobs, return_as="generator_unordered", timeout=None if dask else HANGS)
        with _processes_without_ctrl_c():
            outputs = pool(delayed(run_task)(task) for task in tasks)
        yield from outputs


@contextmanager
def _processes_without_ctrl_c() -> Iterator[None]:
    """Processes begun inside inherit that Ctrl-C is not for them: their parent ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _hanging() -> Iterator[None]:
    try:
        yield
    except TimeoutError as error:
        raise Failed(f"the campaign hangs: no result for {HANGS:.0f} s") from error


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """A client of the scheduler, which joblib's backend `dask` finds by itself."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise Failed("--dask needs dask: type `pip install 'atalante-hal[dask]'`") from error
    try:
        client = Client(address, timeout="10s")  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise Failed(f"no dask scheduler at {address}: {error}; start one with `dask scheduler`") from error
    with client:
        yield
