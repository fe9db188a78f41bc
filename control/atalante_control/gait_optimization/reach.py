"""Check that a landing pose exists, before the optimisation starts: `problem, subject -> None, or reason why no pose exists`.

The search finds a pose with both feet flat on the ground, one step length apart. In the search the joint limits are
soft. If a joint must leave its range, the joint with the largest violation is reported as the reason why there is no
gait.
"""

from __future__ import annotations

import math
from typing import Any

import casadi
import numpy as np

from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

#: Tolerance of the joint ranges in the search [rad]: joints of a landing pose may be outside their range by a smaller angle.
#: From such a landing pose, the optimiser can still find a nearby pose with all joints inside their ranges.
_TOLERANCE = math.radians(0.5)
_CENTRE_WEIGHT = 1e-6  # weight of (joint angle - middle of the range)^2; the weight of (angle outside the range)^2 is 1
_OPTIONS: dict[str, Any] = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "error_on_fail": False}


class Reach:
    """Search for a landing pose, with a solver that is built once per nonlinear program."""

    def __init__(self, problem: StepProblem) -> None:
        """Build the solver of the search.

        Args:
            problem: nonlinear program of the step.
        """
        self._low, self._high = problem.joint_range()
        q, slack = casadi.SX.sym("q", len(JOINTS)), casadi.SX.sym("slack", len(JOINTS))
        rows = [*problem.landing(q), *problem.attitude(q)]
        inside = casadi.vertcat(q - self._low + slack, self._high + slack - q)
        free = np.full(2 * len(JOINTS), np.inf)
        self._bounds = (
            np.concatenate([*(row.lower for row in rows), np.zeros(len(free))]),
            np.concatenate([*(row.upper for row in rows), free]),
        )
        program = {
            "x": casadi.vertcat(q, slack),
            "p": problem.symbols,
            "f": casadi.sumsqr(slack) + _CENTRE_WEIGHT * casadi.sumsqr(q - (self._low + self._high) / 2.0),
            "g": casadi.vertcat(*(row.values for row in rows), inside),
        }
        self._solver: Any = casadi.nlpsol("reach", "ipopt", program, _OPTIONS)

    def refusal(self, parameters: Vector, step_length: float) -> str | None:
        """Return the reason why there is no landing pose, or None if there is one.

        Args:
            parameters: parameters of the nonlinear program.
            step_length: distance of the feet along the walking direction [m].
        """
        middle = np.clip(0.0, self._low, self._high)
        start = np.concatenate([middle, np.zeros(len(JOINTS))])
        low = np.concatenate([np.full(len(JOINTS), -np.pi), np.zeros(len(JOINTS))])
        found = self._solver(x0=start, p=parameters, lbx=low, lbg=self._bounds[0], ubg=self._bounds[1])
        condition = f"with both feet flat on the ground and {step_length:g} m apart"
        if not self._solver.stats()["success"]:
            return f"{condition} no pose was found"
        pose, slack = np.split(np.array(found["x"]).ravel(), 2)
        worst = int(slack.argmax())
        if slack[worst] < _TOLERANCE:
            return None
        angle, end = np.degrees([pose[worst], np.clip(pose[worst], self._low, self._high)[worst]])
        return f"{condition} {JOINTS[worst]} would be at {angle:.1f} degrees; the limit for gaits is {end:.1f} degrees"
