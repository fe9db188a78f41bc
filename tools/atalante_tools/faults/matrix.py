"""Loader of the fault matrix FAULTS.md: time limit, final state, diagnostic code and tests of each fault.

FAULTS.md -> rows -> verdicts of the scenarios -> report
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
COLUMNS: Final = ("ID", "Fault", "Detected by", "Cycles", "Reaction", "State", "DTC", "Proof")
#: Text in the column Proof of a fault that a scenario of the catalogue tests. The scenario has the ID of the fault.
SCENARIO: Final = "scenario"
_ID = re.compile(r"F\d\d")
_BOUND = re.compile(r"(\d+)(?: / (\d+))?")


class MatrixError(ValueError):
    """Raised if FAULTS.md is invalid. The message names the line and the valid content."""


@dataclass(frozen=True)
class Row:
    """Row of the fault matrix: description of one fault."""

    id: str
    fault: str  # description of the fault
    noticed_by: str  # check that detects the fault
    #: time limits [cycles] as text: "1 / 5" means that the diagnostic must be reported by cycle 1, and the reaction by cycle 5
    cycles: str
    behaviour: str  # reaction in words
    state: SupervisorState  # final state of the HAL
    dtc: str  # diagnostic code; empty means no code
    #: Tests of the fault. Each entry is SCENARIO or the name of a test in tests/, such as `faults/test_frames.py::test_f08_*`.
    #: The character * at the end of a name stands for any text.
    proof: tuple[str, ...]

    @property
    def detected(self) -> int | None:
        """Return the cycle by which the diagnostic must be reported; None if `cycles` does not have the form "5" or "1 / 5".

        The first faulty cycle is cycle 1.
        """
        bound = _BOUND.fullmatch(self.cycles)
        return int(bound[1]) if bound else None

    @property
    def reacted(self) -> int | None:
        """Return the cycle by which the reaction must occur; None if `cycles` does not have the form "5" or "1 / 5".

        The first faulty cycle is cycle 1. In the text "1 / 5", the cycle of the reaction is 5.
        """
        bound = _BOUND.fullmatch(self.cycles)
        return int(bound[2] or bound[1]) if bound else None

    @property
    def tests(self) -> tuple[str, ...]:
        """Return the names of the tests in `proof`, without the entry SCENARIO."""
        return tuple(entry for entry in self.proof if entry != SCENARIO)


@functools.cache
def load_matrix(path: Path = MATRIX_FILE) -> Mapping[str, Row]:
    """Load the fault matrix. Return its rows by fault ID, in the order of the file.

    Args:
        path: Markdown file with the table.

    Raises:
        MatrixError: If a row has a wrong number of columns, an invalid or repeated ID, an unknown state or an invalid proof.
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
                raise MatrixError(f"{path.name} line {number}: fault ID {row.id} must occur once, got it twice")
            rows[row.id] = row
    if not rows:
        raise MatrixError(f"{path.name} must have a table with the columns {', '.join(COLUMNS)}, got none")
    return rows


def _row(where: str, cells: list[str]) -> Row:
    if len(cells) != len(COLUMNS):
        raise MatrixError(
            f"{where}: a row must have {len(COLUMNS)} columns ({', '.join(COLUMNS)}), got {len(cells)} columns"
        )
    id_, fault, noticed_by, cycles, behaviour, state, dtc, proof = cells
    if not _ID.fullmatch(id_):
        raise MatrixError(f"{where}: ID must be F and two digits, got {id_!r}")
    if state not in SupervisorState.__members__:
        raise MatrixError(f"{where}: state must be one of {', '.join(SupervisorState.__members__)}, got {state!r}")
    entries = tuple(entry.strip().strip("`") for entry in proof.split(","))
    for entry in entries:
        if entry != SCENARIO and "::" not in entry:
            raise MatrixError(f"{where}: proof must be {SCENARIO} or file::test below tests/, got proof {entry!r}")
    dtc = "" if dtc == "-" else dtc
    return Row(id_, fault, noticed_by, cycles, behaviour, SupervisorState[state], dtc, entries)
