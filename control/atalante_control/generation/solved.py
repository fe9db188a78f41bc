"""What a solver of gaits hands back. `solve -> SolvedGait -> library, command line`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from atalante_control.gait import Gait

SOLVED: Final = "solved"


@dataclass(frozen=True)
class SolvedGait:
    """A gait with the record of its making, which `gait.solver` holds too."""

    gait: Gait  # the last iterate where the solver failed
    status: str  # SOLVED, or a sentence that names the constraint that does not hold
    max_residual: float  # largest constraint violation, in the programme's scale
    solve_s: float
    iterations: int

    @property
    def solved(self) -> bool:
        """Whether every constraint holds."""
        return self.status == SOLVED
