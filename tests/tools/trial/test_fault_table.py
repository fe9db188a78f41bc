"""Table of the experiment `faults`."""

from __future__ import annotations

from typing import Any

from atalante_tools.trial.fault_plan import FURTHER_MOMENTS, MOMENTS
from atalante_tools.trial.fault_table import fault_table


def result(case: str, outcomes: dict[str, str], longest: list[int | None] | None = None) -> dict[str, Any]:
    runs = [{"moment": moment, "outcome": outcome} for moment, outcome in outcomes.items()]
    return {"trial": {"id": "F22", "case": case}, "runs": runs, "longest": longest or []}


def test_cases_with_equal_outcomes_share_a_row() -> None:
    outcomes = {"phase 0": "walked", "weight shift": "hold", "standing": "exception"}
    other = {"phase 0": "fell", "weight shift": "hold"}
    head, rows = fault_table([result("a", outcomes), result("b", other), result("c", outcomes)])
    assert head == ["fault", "cases", "weight shift", "phase 0", "standing", "longest without a fall [cycles]"]
    assert rows == [
        ["F22", "a, c", "stops", "walks", "ERROR", "-"],
        ["F22", "b", "stops", "FALLS", "-", "-"],
    ]


def test_longest_durations_of_the_falls_are_a_range() -> None:
    outcomes = {"phase 0": "fell", "phase 0.5": "fell", "shift back": "hold"}
    assert fault_table([result("a", outcomes, [31, 62, None])])[1][0][-1] == "31 to 62"
    assert fault_table([result("a", outcomes, [31, 31, None])])[1][0][-1] == "31"
    assert fault_table([result("a", outcomes, [None, None, None])])[1][0][-1] == "-"


def test_moments_of_double_support_do_not_repeat_those_of_the_step() -> None:
    assert not MOMENTS.keys() & FURTHER_MOMENTS.keys()
