"""Reach of the legs: the subjects and steps of the paper have a landing pose. For other steps, the reason names a joint."""

from __future__ import annotations

from itertools import product

import pytest

from atalante_control.gait_optimization.reach import Reach
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_control.model import Patient
from atalante_hal.robot import load_robot


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    return StepProblem("periodic", load_robot(), Requirements())


@pytest.fixture(scope="module")
def reach(problem: StepProblem) -> Reach:
    return Reach(problem)


@pytest.mark.parametrize(("height", "length"), list(product((1.62, 1.75, 1.93), (0.10, 0.20))))
def test_steps_of_the_library_are_within_reach(
    problem: StepProblem, reach: Reach, height: float, length: float
) -> None:
    assert reach.refusal(problem.parameters(Patient(75.0, height), 0.8, length), length) is None


def test_step_out_of_reach_is_rejected_with_joint_and_angle(problem: StepProblem, reach: Reach) -> None:
    refusal = reach.refusal(problem.parameters(Patient(110.0, 1.5), 0.8, 0.4), 0.4)
    assert refusal is not None
    assert "0.4 m apart right_SA would be at -15" in refusal
    assert "limit for gaits is -14.0 degrees" in refusal


def test_only_the_longest_steps_are_out_of_reach(problem: StepProblem, reach: Reach) -> None:
    refusals = [
        reach.refusal(problem.parameters(Patient(75.0, 1.5), 0.8, length), length) for length in (0.3, 0.4, 0.5)
    ]
    assert refusals[0] is None
    assert refusals[2] is not None
