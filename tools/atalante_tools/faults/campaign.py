"""Parallel runs of a campaign in processes or on a cluster: tasks -> `fan_out` -> results -> report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from atalante_control.gait_optimization.parallel import FanOutError, fan_out
from atalante_tools.console.outcome import Failed
from atalante_tools.faults.tasks import Result, Task, run_task

#: Time without a result after which a campaign fails as hanging [s].
HANGS: Final = 300.0


def results(tasks: Sequence[Task], *, jobs: int = 1, dask: str = "") -> Iterator[Result]:
    """Run the tasks and yield the results in the order of completion; see `fan_out`.

    Args:
        tasks: tasks to run.
        jobs: number of processes.
        dask: address of a dask scheduler. Empty means processes on this computer.

    Raises:
        Failed: If joblib or dask is missing, the scheduler does not answer, or a task hangs.
    """
    try:
        yield from fan_out(run_task, tasks, jobs=jobs, cluster=dask, patience=HANGS)
    except FanOutError as error:
        raise Failed(str(error)) from error
    except TimeoutError as error:
        raise Failed(f"the campaign hangs: no result for {HANGS:.0f} s") from error
