"""File with the results of a long check: `verdicts <-> JSON lines`. With this file, an interrupted check can be resumed.

The first line of the file contains the task: conditions, effort, seed, push and control law. Each further line contains one
verdict. The file is flushed after each verdict.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from atalante_tools.guide.promise_check import Verdict

#: Values that identify a guide in the file: gait, shape, assistance factor.
Key = tuple[str, str, float]


class Results:
    """Verdicts of a check, and the file that contains them."""

    def __init__(self, path: Path | None, task: Mapping[str, Any]) -> None:
        """Read the verdicts of an earlier run. A missing file is created when the first verdict is stored.

        The last line is incomplete if an earlier run was killed while it wrote this line. An incomplete last line is removed
        from the file.

        Args:
            path: JSON-lines file. If None, the verdicts are not stored.
            task: JSON values that determine a verdict, apart from gait, shape and assistance factor.

        Raises:
            ValueError: If the file contains the results of another task, a line that is not a verdict, or other bytes than text.
        """
        self._path, self._task = path, json.loads(json.dumps(task))
        self._known: dict[Key, Verdict] = {}
        if path is None or not path.exists():
            return
        try:
            written, end, cut_off = path.read_text(encoding="utf-8").rpartition("\n")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path} must be text in UTF-8, got other bytes: choose another file") from error
        if not end and json.dumps(self._task).startswith(cut_off):  # killed within the first line
            os.truncate(path, 0)
            return
        head, *lines = (written if end else cut_off).splitlines() or [""]
        if _decoded(path, 1, head) != self._task:
            raise ValueError(f"{path} must contain results of the task {json.dumps(self._task)}, got {head}")
        for number, line in enumerate(lines, 2):
            try:
                self._keep(Verdict(**_decoded(path, number, line)))
            except TypeError as error:
                raise ValueError(f"line {number} of {path} must be the verdict of a guide, got {line}") from error
        if end and cut_off:
            os.truncate(path, path.stat().st_size - len(cut_off.encode()))

    def find(self, key: Key) -> Verdict | None:
        """Return the verdict of a guide; None if the file does not contain it.

        Args:
            key: gait, shape and assistance factor.
        """
        return self._known.get(key)

    def add(self, verdict: Verdict) -> None:
        """Store a verdict, and append it to the file.

        Args:
            verdict: result of one guide.
        """
        self._keep(verdict)
        if self._path is None:
            return
        new = not self._path.exists() or not self._path.stat().st_size
        with self._path.open("a", encoding="utf-8") as file:
            if new:
                file.write(json.dumps(self._task) + "\n")
            file.write(json.dumps(asdict(verdict)) + "\n")

    def _keep(self, verdict: Verdict) -> None:
        self._known[verdict.gait, verdict.shape, verdict.xi] = verdict


def _decoded(path: Path, number: int, line: str) -> Any:
    """Return the JSON object of a line.

    Raises:
        ValueError: If the line is not a JSON object.
    """
    try:
        value = json.loads(line)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, dict):
        raise ValueError(f"line {number} of {path} must be a JSON object, got {line!r}")
    return value
