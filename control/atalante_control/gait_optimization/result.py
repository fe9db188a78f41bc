"""Result of the gait solver, for the gait library and the command line: `solve -> SolvedGait`."""

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
    """Result of the solver: gait, status and constraint violations. `gait.solver` contains a summary."""

    gait: Gait  # solved gait, or the last iterate if the solver failed
    status: str  # SOLVED, or a sentence that states why there is no gait
    max_residual: float  # largest value in `residuals`; values in different SI units are compared as plain numbers
    solve_s: float  # s, computing time
    iterations: int  # iterations of the optimiser
    residuals: Mapping[str, Residual] = field(default_factory=dict)  # largest violation of each group of constraints
    #: Largest absolute joint torques at the nodes, shape (12,) [Nm].
    peak_torque: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def solved(self) -> bool:
        """Return whether the solver found a gait that satisfies every constraint."""
        return self.status == SOLVED
