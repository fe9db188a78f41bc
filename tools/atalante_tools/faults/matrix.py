"""The table of record: FAULTS.md as data. Scenarios, tests and the command line take bound, state and code of a fault from here.

FAULTS.md -> rows -> scenarios are judged by them -> report
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from atalante_hal.types import SupervisorState

MATRIX_FILE: Final = Path(__file__).with_name("FAULTS.md")
COLUMNS: Final = ("ID", "Fault", "Noticed by", "Cycles", "What happens", "State", "DTC", "Proof")
#: Proof by a run of the scenario of the row's ID.
SCENARIO: Final = "scenario"
_ID = re.compile(r"F\d\d")
_BOUND = re.compile(r"(\d+)(?: / (\d+))?")


class MatrixError(ValueError):
    """FAULTS.md is not the table it has to be; the message names the line and what is valid."""


@dataclass(frozen=True)
class Row:
    """One fault."""

    id: str
    fault: str
    noticed_by: str
    cycles: str  # as written; `noticed` and `reacted` where it is a bound
    behaviour: str
    state: SupervisorState  # the supervisor's when it has reacted
    dtc: str  # empty: nothing to notice
    proof: tuple[str, ...]  # SCENARIO, `path::test` below tests/, * at its end: any

    @property
    def noticed(self) -> int | None:
        """Cycles until the DTC, the first faulty one counted; None: not a number of cycles."""
        bound = _BOUND.fullmatch(self.cycles)
        return int(bound[1]) if bound else None

    @property
    def reacted(self) -> int | None:
        """Cycles until the reaction: the second number of `noticed / reacted`, or the only one."""
        bound = _BOUND.fullmatch(self.cycles)
        return int(bound[2] or bound[1]) if bound else None

    @property
    def tests(self) -> tuple[str, ...]:
        """What proves it besides a scenario."""
        return tuple(entry for entry in self.proof if entry != SCENARIO)


@functools.cache
def load_matrix(path: Path = MATRIX_FILE) -> Mapping[str, Row]:
    """Rows by ID, in the order of the file.

    Raises:
        MatrixError: a row with another number of columns, an ID twice or none, a state there is not, no proof.
    """
    rows: dict[str, Row] = {}
    inside = False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            inside = False
        elif tuple(cells) == COLUMNS:
            inside = True
        elif inside and not set(line) <= set("|- "):
            row = _row(f"{path.name} line {number}", cells)
            if row.id in rows:
                raise MatrixError(f"{path.name} line {number}: {row.id} has a row already")
            rows[row.id] = row
    if not rows:
        raise MatrixError(f"{path.name} has no table with the columns {', '.join(COLUMNS)}")
    return rows


def _row(where: str, cells: list[str]) -> Row:
    if len(cells) != len(COLUMNS):
        raise MatrixError(f"{where}: {len(cells)} columns; a row has {len(COLUMNS)}: {', '.join(COLUMNS)}")
    id_, fault, noticed_by, cycles, behaviour, state, dtc, proof = cells
    if not _ID.fullmatch(id_):
        raise MatrixError(f"{where}: {id_!r} is no ID; one is F and two digits")
    if state not in SupervisorState.__members__:
        raise MatrixError(f"{where}: no state {state!r}; there are {', '.join(SupervisorState.__members__)}")
    entries = tuple(entry.strip().strip("`") for entry in proof.split(","))
    for entry in entries:
        if entry != SCENARIO and "::" not in entry:
            raise MatrixError(f"{where}: proof {entry!r}; valid are {SCENARIO} and file::test below tests/")
    dtc = "" if dtc == "-" else dtc
    return Row(id_, fault, noticed_by, cycles, behaviour, SupervisorState[state], dtc, entries)
