"""Progress report at each iteration of IPOPT: `iterate -> iteration number, largest constraint violation`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np

from atalante_hal.types import Vector

#: Progress function. Arguments: iteration number, and largest value of (constraint violation / scale of the constraint).
Progress = Callable[[int, float], None]


class Watch(casadi.Callback):
    """CasADi callback that reports the progress of the solver at each iteration."""

    def __init__(self, unknowns: int, bounds: tuple[Vector, Vector], progress: Progress) -> None:
        """Create the callback.

        Args:
            unknowns: number of unknowns of the program.
            bounds: lower and upper bounds of the constraints.
            progress: function to call at each iteration.
        """
        casadi.Callback.__init__(self)
        self._unknowns, self._bounds, self._progress, self._iteration = unknowns, bounds, progress, 0
        self.construct("watch", {})

    def get_n_in(self) -> int:
        """Return the number of inputs of the callback: one input for each output of the solver."""
        return int(casadi.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return the number of outputs of the callback: one flag, nonzero to stop the solver."""
        return 1

    def get_name_in(self, index: int) -> str:
        """Return the name of an input of the callback."""
        return str(casadi.nlpsol_out(index))

    def get_sparsity_in(self, index: int) -> Any:
        """Return the size of an input of the callback, as a dense CasADi sparsity.

        The callback does not use the parameter multipliers `lam_p`, so the input `lam_p` has size 0.
        """
        name, rows = self.get_name_in(index), len(self._bounds[0])
        length = {"f": 1, "x": self._unknowns, "lam_x": self._unknowns, "g": rows, "lam_g": rows}.get(name, 0)
        return casadi.Sparsity.dense(length, 1 if length else 0)

    def eval(self, arguments: Sequence[Any]) -> list[int]:
        """Report the iteration number and the largest constraint violation, and let the solver continue."""
        rows = np.array(arguments[casadi.nlpsol_out().index("g")]).ravel()
        outside = np.maximum(self._bounds[0] - rows, rows - self._bounds[1])
        self._progress(self._iteration, max(0.0, float(outside.max())))
        self._iteration += 1
        return [0]
