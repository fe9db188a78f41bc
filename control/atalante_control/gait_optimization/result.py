"""Result of the gait solver. `solve -> SolvedGait -> library, command line`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import Gait

SOLVED: Final = "solved"


class Residual(NamedTuple):
    """Largest violation of one group of constraints."""

    value: float
    unit: str


@dataclass(frozen=True)
class SolvedGait:
    """Solved gait with the record of the solver, which is also in `gait.solver`."""

    gait: Gait  # the last iterate if the solver failed
    status: str  # SOLVED, or a sentence with the violated constraint
    max_residual: float  # largest violation of all constraints, each in its SI unit
    solve_s: float  # s, computing time
    iterations: int  # iterations of the optimiser
    residuals: Mapping[str, Residual] = field(default_factory=dict)  # by group of constraints
    peak_torque: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))  # (12,) Nm, at the nodes

    @property
    def solved(self) -> bool:
        """Return whether every constraint holds."""
        return self.status == SOLVED
