"""Table of the experiment `faults`: `results -> headings, rows`.

A row shows how the walks with one fault ended, with a column for each moment at which the fault begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from atalante_tools.trial.fault_plan import FURTHER_MOMENTS, MOMENTS

#: Outcome of a walk -> word in the table.
_WORDS: Final = {
    "walked": "walks",
    "hold": "stops",
    "fell": "FALLS",
    "unfinished": "unfinished",
    "exception": "ERROR",
}


def fault_table(results: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of the table.

    Cases of the same fault share a row if their outcomes and their longest durations without a fall are equal.

    Args:
        results: results of `fault` trials.
    """
    tried = {run["moment"] for result in results for run in result["runs"]}
    moments = [name for name in MOMENTS | FURTHER_MOMENTS if name in tried]
    rows: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for result in results:
        outcomes = {run["moment"]: _WORDS[run["outcome"]] for run in result["runs"]}
        cells = (*(outcomes.get(name, "-") for name in moments), _survived(result))
        rows.setdefault((result["trial"]["id"], cells), []).append(result["trial"]["case"])
    head = ["fault", "cases", *moments, "longest without a fall [cycles]"]
    return head, [[id_, ", ".join(cases), *cells] for (id_, cells), cases in rows.items()]


def _survived(result: dict[str, Any]) -> str:
    """Return the longest fault duration without a fall [cycles] as text.

    The duration depends on the moment at which the fault begins. The text is the range from the smallest to the largest duration.
    A moment at which the robot does not fall with the permanent fault is left out.
    """
    survived = [cycles for cycles in result["longest"] if cycles is not None]
    if not survived:
        return "-"
    low, high = min(survived), max(survived)
    return str(low) if low == high else f"{low} to {high}"
