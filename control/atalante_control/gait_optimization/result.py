"""What a solver of gaits hands back. `solve -> SolvedGait -> library, command line`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import Gait

SOLVED: Final = "solved"


class Residual(NamedTuple):
    """The largest violation of one group of constraints."""

    value: float
    unit: str


@dataclass(frozen=True)
class SolvedGait:
    """A gait with the record of its making, which `gait.solver` holds too."""

    gait: Gait  # the last iterate where the solver failed
    status: str  # SOLVED, or a sentence that names the constraint that does not hold
    max_residual: float  # largest constraint violation, each in its own SI unit
    solve_s: float
    iterations: int
    residuals: Mapping[str, Residual] = field(default_factory=dict)  # by group of constraints
    peak_torque: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))  # (12,) Nm, at the nodes

    @property
    def solved(self) -> bool:
        """Whether every constraint holds."""
        return self.status == SOLVED
