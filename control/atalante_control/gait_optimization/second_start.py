"""Second optimisation of a gait from another initial guess, if the first optimisation fails.

The second initial guess is a solved gait of the same patient, with the step length and duration in `MODERATE`. The result depends
only on the parameters of the subject, and not on gaits that were solved before. If the second optimisation fails, too, the result
states the reasons of both failures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import Gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.result import SolvedGait
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.types import Vector

MODERATE: Final = (0.15, 0.9)  # step length [m] and duration [s] of the gait that is the second initial guess
#: Relative tolerance: an angle is at a limit if its distance to the limit is at most 0.1 % of the joint range.
#: A speed or a torque is at a limit if it is at least 99.9 % of the largest value that a gait may use.
_AT_LIMIT: Final = 1e-3

#: Function that solves a gait. Its second argument is the gait for a warm start, or None for the usual initial guess.
Attempt = Callable[[Subject, Gait | None], SolvedGait]


def solve_with_second_start(subject: Subject, attempt: Attempt) -> SolvedGait:
    """Solve a gait. If the optimiser fails, solve the gait a second time, from another initial guess.

    The second initial guess is a solved gait of the same patient, with the step length and duration in `MODERATE`.
    If the patient has no landing pose for the step length, the optimiser does not start, and there is no second start.
    There is also no second start if the subject itself has the values in `MODERATE`, or if the gait with these values fails.

    Args:
        subject: patient and step parameters.
        attempt: function that solves a gait.

    Returns:
        The gait. Without a successful attempt, the gait is the last iterate of the first attempt. The status then states the
        reason of each failure. If the optimiser started, the status also names the joints that are at a limit in this iterate.
    """
    first = attempt(subject, None)
    if first.solved or first.iterations == 0:
        return first
    joints = ", ".join(joints_at_limits(first)) or "none"
    reasons = f"{first.status}; joints at a limit: {joints}"
    length, duration = MODERATE
    moderate = replace(subject, step_length=length, step_duration=duration)
    if moderate == subject:
        return with_status(first, reasons)
    reference = attempt(moderate, None)
    if not reference.solved:
        return with_status(first, f"{reasons}; no second start, {reference.status}")
    second = attempt(subject, reference.gait)
    if not second.solved:
        return with_status(
            first, f"{reasons}; second start from a step of {length:g} m in {duration:g} s: {second.status}"
        )
    start = {"start": f"gait of {moderate}"}
    return replace(second, gait=replace(second.gait, solver={**second.gait.solver, **start}))


def joints_at_limits(solved: SolvedGait) -> list[str]:
    """Return the joints at a limit in the last iterate of the optimiser, as texts such as "torque of left_SK".

    Args:
        solved: result of the optimiser.
    """
    robot, requirements, tables = load_robot(), Requirements(), solved.gait.tables()
    low, high = _joint_range()
    margin = _AT_LIMIT * (high - low)
    reached: dict[str, npt.NDArray[np.bool_]] = {
        "angle": (tables.q.min(axis=0) <= low + margin) | (tables.q.max(axis=0) >= high - margin),
        "speed": np.abs(tables.qd).max(axis=0) >= (1.0 - _AT_LIMIT) * requirements.speed_share * robot.velocity_max,
    }
    if solved.peak_torque.size:  # `peak_torque` is empty if the torques are unknown
        reached["torque"] = solved.peak_torque >= (1.0 - _AT_LIMIT) * requirements.torque_share * robot.torque_max
    return [
        f"{quantity} of {joint}"
        for quantity, joints in reached.items()
        for joint, at_limit in zip(JOINTS, joints, strict=True)
        if at_limit
    ]


def with_status(solved: SolvedGait, status: str) -> SolvedGait:
    """Return a copy of a result with another status. The status is also replaced in `gait.solver`.

    Args:
        solved: result of the optimiser.
        status: `SOLVED`, or the reason of the failure.
    """
    gait = replace(solved.gait, solver={**solved.gait.solver, "status": status})
    return replace(solved, gait=gait, status=status)


@cache
def _joint_range() -> tuple[Vector, Vector]:
    """Return the smallest and the largest joint angles that a gait may use. The computation takes about a second."""
    return StepProblem("periodic", load_robot(), Requirements()).joint_range()
