"""Benchmarks of the gait optimiser on one core, from a rough initial guess or from a similar gait.

The rough initial guess is a simple step, computed by inverse kinematics. The similar gait differs in one of mass, height, step
length and step duration.
"""

from __future__ import annotations

import statistics
import time
from functools import cache
from itertools import cycle, islice
from typing import Final

from atalante_control.gait.gait import Gait
from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_tools.bench.measure import Effort, Measurement, require

#: Target time to solve a gait from a rough initial guess [s].
_COLD_LIMIT: Final = 3.0
#: Target time to solve a gait from a similar gait [s].
_WARM_LIMIT: Final = 1.0
_ROUNDS: Final = 12
_CENTRE: Final = Subject(Patient(75.0, 1.75), 0.15, 0.9)
_SUBJECTS: Final = (
    Subject(Patient(78.0, 1.75), 0.15, 0.9),
    Subject(Patient(75.0, 1.80), 0.15, 0.9),
    Subject(Patient(75.0, 1.75), 0.17, 0.9),
    Subject(Patient(75.0, 1.75), 0.15, 0.95),
)


def gait_solve_cold(effort: Effort) -> Measurement:
    """Measure the time to solve a gait from a rough initial guess."""
    return Measurement(_solved(effort, None), _COLD_LIMIT)


def gait_solve_warm(effort: Effort) -> Measurement:
    """Measure the time to solve a gait from a similar gait."""
    return Measurement(_solved(effort, _centre()), _WARM_LIMIT)


@cache
def _centre() -> Gait:
    """Return the gait of `_CENTRE`, which is similar to the gaits of `_SUBJECTS`. The first call solves this gait."""
    from atalante_control.gait_optimization.solve import solve

    return solve(_CENTRE).gait


def _solved(effort: Effort, neighbour: Gait | None) -> float:
    """Return the median processor time to solve a gait [s]. The time to build the nonlinear program is excluded."""
    from atalante_control.gait_optimization.solve import solve

    if effort.quick:
        _centre()
    else:
        solve(_CENTRE, neighbour, machine_code=True)
    rounds, seconds = 1 if effort.quick else _ROUNDS, []
    for done, subject in enumerate(islice(cycle(_SUBJECTS), rounds), 1):
        began = time.thread_time()
        solved = solve(subject, neighbour, machine_code=not effort.quick)
        seconds.append(time.thread_time() - began)
        require(solved.solved, f"{subject}: {solved.status}")
        effort.progress(done, rounds)
    return statistics.median(seconds)
