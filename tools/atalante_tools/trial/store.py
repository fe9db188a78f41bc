"""Results of trials in a folder: one JSON file for each trial, written atomically. Only missing results are computed.

trials -> stored results, missing trials -> processes or a dask cluster -> files -> results
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from atalante_control.gait_optimization.parallel import FanOutError, fan_out
from atalante_tools.console.outcome import Failed
from atalante_tools.trial.fault_plan import FaultTrial
from atalante_tools.trial.plan import Trial, fields, key, versions

Result = dict[str, Any]


def path_of(trial: Trial, folder: Path) -> Path:
    """Return the file of a trial.

    Args:
        trial: trial of the result.
        folder: folder of the results.
    """
    return folder / f"{trial.name}-{key(trial)}.json"


def stored(trial: Trial, folder: Path) -> Result | None:
    """Return the stored result of a trial; None if the trial must be run.

    The file name contains a hash of the parameters of the trial and of all software versions. So the trial must also be run again
    after a change of a parameter or a version, and if the file is damaged, was edited or contains the result of another trial.

    Args:
        trial: trial of the result.
        folder: folder of the results.
    """
    path = path_of(trial, folder)
    if not path.exists():
        return None
    try:
        result: Result = json.loads(path.read_bytes())
    except ValueError:  # no JSON, or no text
        return None
    expected = json.loads(json.dumps({"trial": fields(trial), "versions": versions()}))  # JSON makes lists of tuples
    valid = (
        isinstance(result, dict)
        and result.pop("sha256", None) == _digest(json.dumps(result))
        and {name: result.get(name) for name in expected} == expected
    )
    return result if valid else None


def compute(
    trials: Sequence[Trial], folder: Path, *, jobs: int = 1, cluster: str = ""
) -> Generator[Result, None, None]:
    """Run trials in parallel, and yield each result after it is written.

    Args:
        trials: trials without a stored result.
        folder: folder of the results; created if it is missing.
        jobs: number of processes on this computer. With 1, the trials run in this process.
        cluster: address of a dask scheduler. Empty means processes on this computer.

    Raises:
        Failed: If joblib or dask is not installed, the scheduler does not answer, or a worker has other versions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    by_name = {trial.name: trial for trial in trials}
    try:
        with closing(fan_out(_run, trials, jobs=jobs, cluster=cluster or None)) as results:
            for result in results:
                if result["versions"] != versions():
                    raise Failed(f"the workers must have the versions {versions()}, got {result['versions']}")
                _write(path_of(by_name[result["trial"]["name"]], folder), result)
                yield result
    except FanOutError as error:
        raise Failed(str(error)) from error


def _run(trial: Trial) -> Result:
    if isinstance(trial, FaultTrial):
        from atalante_tools.trial.fault_run import run_fault

        return {"trial": fields(trial), "versions": versions(), **run_fault(trial)}
    from atalante_tools.trial.run import run_trial

    return {"trial": fields(trial), "versions": versions(), **run_trial(trial)}


def _digest(text: str) -> str:
    """Return the SHA-256 of a result.

    Args:
        text: result as JSON in the order of its file, without the key "sha256".
    """
    return hashlib.sha256(text.encode()).hexdigest()


def _write(path: Path, result: Result) -> None:
    """Write a result to a temporary file, and rename the file when it is complete and on the disk.

    The key "sha256" is added, so that `stored` finds a changed or missing value of any key.
    """
    text = json.dumps(result)
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("w") as file:
        file.write(f'{text[:-1]}, "sha256": "{_digest(text)}"}}\n')
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
