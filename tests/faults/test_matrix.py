"""Check that the fault matrix, the scenarios and the names of the tests agree."""

from __future__ import annotations

import ast
import fnmatch
import re
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from atalante_hal.robot import LEG_JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.encoders import JUMPS_TO_CONFIRM
from atalante_hal.types import PERIOD, SupervisorState
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.matrix import COLUMNS, MATRIX_FILE, SCENARIO, MatrixError, load_matrix
from atalante_tools.faults.tasks import REPRESENTATIVES
from atalante_tools.faults.verdict import Expectation

TESTS = Path(__file__).parents[1]
MATRIX = load_matrix()
S = SupervisorState
#: The name of a test that proves a row of the matrix begins with the ID of this row.
PROOF = re.compile(r"test_f(\d\d)_")


@cache
def functions_of(path: Path) -> frozenset[str]:
    """Return the names of the functions and methods of a test file."""
    tree = ast.parse(path.read_text())
    return frozenset(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def test_fault_ids_are_consecutive() -> None:
    assert list(MATRIX) == [f"F{number:02d}" for number in range(1, len(MATRIX) + 1)]


def test_row_names_a_scenario_exactly_if_one_exists() -> None:
    assert {id_ for id_, row in MATRIX.items() if SCENARIO in row.proof} == set(SCENARIOS)


@pytest.mark.parametrize("row", MATRIX.values(), ids=list(MATRIX))
def test_tests_named_by_a_row_exist(row) -> None:
    for proof in row.tests:
        path, name = proof.split("::")
        assert (TESTS / path).is_file(), f"{row.id}: no {path}"
        assert fnmatch.filter(functions_of(TESTS / path), name), f"{row.id}: no {name} in {path}"


def test_row_names_every_test_with_its_id() -> None:
    for path in TESTS.rglob("test_*.py"):
        for name in functions_of(path):
            if match := PROOF.match(name):
                where = f"{path.relative_to(TESTS)}::{name}"
                named = MATRIX[f"F{match[1]}"].tests
                assert any(fnmatchcase(where, proof) for proof in named), f"{where} is not in the row of F{match[1]}"


@pytest.mark.parametrize("row", [row for row in MATRIX.values() if row.dtc], ids=lambda row: row.id)
def test_diagnostic_code_of_a_row_exists_in_the_hal(row) -> None:
    assert any(re.fullmatch(row.dtc.replace("x", "[0-9A-Fx]"), dtc.value) for dtc in Dtc)


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=list(SCENARIOS))
def test_cases_of_a_scenario_have_unique_names_and_a_bound(scenario) -> None:
    names = [case.name for case in scenario.cases]
    assert len(set(names)) == len(names) > 0
    for case in scenario.cases:
        assert Expectation.of(case, MATRIX[scenario.id]).reacted > 0
    if scenario.permanent is not None:
        assert scenario.permanent.ends is None


def test_representatives_are_existing_cases_of_at_least_twelve_faults() -> None:
    assert len({id_ for id_, _ in REPRESENTATIVES}) == len(REPRESENTATIVES) >= 12
    for id_, name in REPRESENTATIVES:
        assert name in [case.name for case in SCENARIOS[id_].cases]


def test_the_largest_jump_that_is_used_as_a_motion_is_the_one_of_the_robot() -> None:
    reach = JUMPS_TO_CONFIRM * PERIOD * load_robot().top_speed[: len(LEG_JOINTS)]
    reach_of = dict(zip(LEG_JOINTS, reach.tolist(), strict=True))
    ankle = reach_of.pop("SA")
    (other,) = set(reach_of.values())
    text = " ".join(MATRIX_FILE.read_text("utf-8").split())
    assert f"motion possible in five cycles ({1e3 * other:g} mrad; SA: {1e3 * ankle:g})" in text
    assert f"jump, of up to {np.degrees(other):.2f} deg (SA: {np.degrees(ankle):.2f})" in text


def test_invalid_matrix_is_rejected_with_line_and_value(tmp_path) -> None:
    good = "| F01 | a | b | 1 / 5 | c | HOLD | - | scenario, `test_x.py::test_y` |"
    head = f"| {' | '.join(COLUMNS)} |\n|---|\n"

    def load(text: str):
        path = tmp_path / "FAULTS.md"
        path.write_text(text)
        return load_matrix.__wrapped__(path)

    row = load(head + good)["F01"]
    assert (row.detected, row.reacted, row.state, row.dtc) == (1, 5, S.HOLD, "")
    assert row.tests == ("test_x.py::test_y",)
    for text, message in (
        ("", "must have a table"),
        (head + good + "\n" + good, "line 4: fault ID F01 must occur once, got it twice"),
        (head + good.replace("F01", "X1"), "got 'X1'"),
        (head + good.replace("HOLD", "STOP"), "state must be one of .*, got 'STOP'"),
        (head + good.replace("| - ", ""), "got 7 columns"),
        (head + good.replace("scenario", "sure"), "got proof 'sure'"),
    ):
        with pytest.raises(MatrixError, match=message):
            load(text)
