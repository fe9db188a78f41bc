"""Generated page SUPERVISOR.md: it is complete, and agrees with the state machine."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from atalante_hal.safety.diagnostics import Dtc, Reaction
from atalante_hal.safety.state_machine import next_state
from atalante_hal.types import SupervisorState
from atalante_tools.supervisor_table import FACTS, a_diagnostic, page

PAGE = Path(__file__).parents[2] / "SUPERVISOR.md"


def test_supervisor_page_matches_the_state_machine():
    assert PAGE.read_text() == page(), "SUPERVISOR.md is stale: type `make supervisor-table`"


def test_page_has_a_row_for_every_reaction_and_diagnostic_code():
    lines = page().splitlines()
    for reaction in Reaction:
        rows = [line for line in lines if line.startswith(f"| {reaction.name} |")]
        assert [row.count("|") for row in rows] == [len(SupervisorState) + 2] * 2
    for dtc in Dtc:
        assert sum(line.startswith(f"| `{dtc}` | {dtc.reaction.name} |") for line in lines) == 1


@pytest.mark.parametrize("conditions", [conditions for _, conditions in FACTS], ids=[name for name, _ in FACTS])
def test_all_diagnostics_of_one_reaction_lead_to_the_same_state(conditions):
    for dtc, state in itertools.product(Dtc, SupervisorState):
        twin = a_diagnostic(dtc.reaction)
        after, _ = next_state(state, replace(conditions, diagnostics=frozenset({dtc})))
        expected, _ = next_state(state, replace(conditions, diagnostics=frozenset({twin})))
        assert after is expected, (dtc, state)
