"""Start step and stop step for a periodic gait: `subject, periodic gait -> WalkGaits`."""

from __future__ import annotations

from atalante_control.gait.gait import Gait, GaitError
from atalante_control.gait.subject import Subject
from atalante_control.gait.walk import WalkGaits
from atalante_control.gait_optimization.solve import solve


def solve_walk(subject: Subject, step: Gait) -> WalkGaits:
    """Optimise the start step and the stop step for a periodic gait.

    Args:
        subject: patient and step parameters of the gait.
        step: periodic gait, from the solver or from the gait network.

    Raises:
        GaitError: If the solver finds no start step or no stop step. The message names the violated constraint.
    """
    solved = {}
    for kind in ("start", "stop"):
        result = solve(subject, kind=kind, around=step)
        if not result.solved:
            raise GaitError(f"{kind} step: {result.status}")
        solved[kind] = result.gait
    return WalkGaits(solved["start"], step, solved["stop"])
