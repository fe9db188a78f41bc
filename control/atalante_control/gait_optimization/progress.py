"""What IPOPT is doing, once an iteration: `iterate -> iteration number, largest violation`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
#: Called once an iteration with its number and the largest violation in the program's scale.
Progress = Callable[[int, float], None]


class Watch(casadi.Callback):
    """CasADi's iteration callback."""

    def __init__(self, unknowns: int, bounds: tuple[Vector, Vector], progress: Progress) -> None:
        """Take the bounds of the rows."""
        casadi.Callback.__init__(self)
        self._unknowns, self._bounds, self._progress, self._iteration = unknowns, bounds, progress, 0
        self.construct("watch", {})

    def get_n_in(self) -> int:
        """What a solver hands out."""
        return int(casadi.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Nonzero to stop."""
        return 1

    def get_name_in(self, index: int) -> str:
        """As the solver calls it."""
        return str(casadi.nlpsol_out(index))

    def get_sparsity_in(self, index: int) -> Any:
        """Shapes of the solver's results; nothing for parameters."""
        name, rows = self.get_name_in(index), len(self._bounds[0])
        length = {"f": 1, "x": self._unknowns, "lam_x": self._unknowns, "g": rows, "lam_g": rows}.get(name, 0)
        return casadi.Sparsity.dense(length, 1 if length else 0)

    def eval(self, arguments: Sequence[Any]) -> list[int]:
        """Count, judge, go on."""
        rows = np.array(arguments[casadi.nlpsol_out().index("g")]).ravel()
        outside = np.maximum(self._bounds[0] - rows, rows - self._bounds[1])
        self._progress(self._iteration, max(0.0, float(outside.max())))
        self._iteration += 1
        return [0]
