"""The supervisor as a table for people: every state with every condition, made from the function itself.

`make supervisor-table` writes SUPERVISOR.md; a test says when it is stale.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from atalante_hal.diagnostics import Dtc
from atalante_hal.supervisor import Conditions, next_state
from atalante_hal.types import SupervisorState

#: A robot that could go on: everything is well, and nobody presses anything.
WELL: Final = Conditions(nodes_well=True, drives_enabled=True, dead_man=True)
#: What else can hold, beside the diagnostics.
FACTS: Final = (
    ("nothing", WELL),
    ("a node is missing or not trusted", replace(WELL, nodes_well=False)),
    ("the dead-man is released, or the pendant lost", replace(WELL, dead_man=False)),
    ("the operator asks for STOP or HOLD", replace(WELL, stop_requested=True)),
    ("the step is finished", replace(WELL, step_finished=True)),
    ("START, and the drives are not enabled yet", replace(WELL, start_wanted=True, drives_enabled=False)),
    ("START, and the drives are enabled", replace(WELL, start_wanted=True)),
    ("START without dead-man", replace(WELL, start_wanted=True, dead_man=False)),
)
_INTRODUCTION: Final = """\
# The supervisor

Made by `make supervisor-table` from `atalante_hal/supervisor.py` and `atalante_hal/diagnostics.py`; do not edit.

A cell is the state of the next cycle; a dot: the state stays. Moves to a worse state are automatic, moves to a better one take
the operator's START, but for OFF to READY, which moves nothing. Of several conditions the worst counts. A diagnostic acts when
it is confirmed; while it is pending it is noted and the robot goes on.
"""


def page() -> str:
    """The whole page, Markdown."""
    parts = [_INTRODUCTION, "## Without a diagnostic\n", _table("what holds", FACTS)]
    parts.append("## Each diagnostic, nobody presses anything\n")
    parts.append(_table("diagnostic", [(f"`{d}`", _with(WELL, d)) for d in Dtc]))
    parts.append("## Each diagnostic, and START with every drive enabled\n")
    started = replace(WELL, start_wanted=True)
    parts.append(_table("diagnostic", [(f"`{d}`", _with(started, d)) for d in Dtc]))
    parts.append("## What the diagnostics say\n")
    rows = [(f"`{d}`", d.reaction.name, d.severity.value, d.meaning) for d in Dtc]
    parts.append(_markdown(("diagnostic", "reaction", "severity", "meaning"), rows))
    return "\n".join(parts)


def _with(conditions: Conditions, dtc: Dtc) -> Conditions:
    return replace(conditions, diagnostics=frozenset({dtc}))


def _table(what: str, rows: Sequence[tuple[str, Conditions]]) -> str:
    head = (what, *(state.name for state in SupervisorState))
    return _markdown(head, [(name, *(_cell(state, c) for state in SupervisorState)) for name, c in rows])


def _cell(state: SupervisorState, conditions: Conditions) -> str:
    after, _ = next_state(state, conditions)
    return "." if after is state else after.name


def _markdown(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page())
