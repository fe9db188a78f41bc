"""Parallel execution of the tasks of a campaign, in processes or on a dask cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from atalante_control.gait_optimization.parallel import FanOutError, fan_out
from atalante_tools.console.outcome import Failed
from atalante_tools.faults.tasks import Result, Task, run_task

#: Longest accepted time between two results [s]. If no result comes within this time, the campaign fails.
#: The first runs after an installation compile functions, which takes minutes on a busy machine.
RESULT_TIMEOUT: Final = 900.0


def results(tasks: Sequence[Task], *, jobs: int = 1, dask: str = "") -> Iterator[Result]:
    """Run the tasks in parallel and yield each result as soon as it is complete.

    Args:
        tasks: tasks to run.
        jobs: number of processes.
        dask: address of a dask scheduler. Empty means processes on this computer.

    Raises:
        Failed: If joblib or dask is not installed, the scheduler does not answer, or no result comes within `RESULT_TIMEOUT`.
    """
    try:
        yield from fan_out(run_task, tasks, jobs=jobs, cluster=dask, patience=RESULT_TIMEOUT)
    except FanOutError as error:
        raise Failed(str(error)) from error
    except TimeoutError as error:
        raise Failed(f"a task must end within {RESULT_TIMEOUT:.0f} s, got no result in this time") from error
