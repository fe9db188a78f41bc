"""The generated page of the supervisor is up to date and complete."""

from __future__ import annotations

from pathlib import Path

from atalante_hal.diagnostics import Dtc
from atalante_hal.types import SupervisorState
from atalante_tools.supervisor_table import page

PAGE = Path(__file__).parents[1] / "SUPERVISOR.md"


def test_the_page_is_what_the_function_does():
    assert PAGE.read_text() == page(), "SUPERVISOR.md is stale: type `make supervisor-table`"


def test_every_state_with_every_code_is_there():
    lines = page().splitlines()
    for dtc in Dtc:
        rows = [line for line in lines if line.startswith(f"| `{dtc}` |")]
        assert len(rows) == 3
        assert [row.count("|") for row in rows] == [len(SupervisorState) + 2] * 2 + [5]
