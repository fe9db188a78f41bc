"""Run every case of every scenario of the matrix, with HAL and emulated robot in lock-step."""

from __future__ import annotations

import pytest

from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.scenario import Case
from atalante_tools.faults.tasks import run_case

#: `make test` runs the first case of every scenario, and `make test-long` runs all other cases.
CASES = [
    pytest.param(scenario.id, case, id=f"{scenario.id}-{case.name}", marks=[pytest.mark.long] if number else [])
    for scenario in SCENARIOS.values()
    for number, case in enumerate(scenario.cases)
]


@pytest.mark.parametrize(("id_", "case"), CASES)
def test_case_has_the_documented_reaction(id_: str, case: Case) -> None:
    verdict = run_case(id_, case)
    assert verdict.passed, "\n".join(verdict.failures)
