"""Initial guess of the optimiser: the swing foot makes a step."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import bezier
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.guess import guess
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_control.model import Patient
from atalante_hal.robot import load_robot

ROBOT = load_robot()


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    return StepProblem("periodic", ROBOT, Requirements())


@pytest.mark.parametrize(("height", "length"), list(product((1.62, 1.93), (0.10, 0.20))))
def test_swing_foot_of_the_guess_makes_a_step(problem: StepProblem, height: float, length: float) -> None:
    subject = Subject(Patient(75.0, height), length, 0.8)
    coefficients = guess(problem, problem.parameters(subject.patient, 0.8, length), subject)
    poses = bezier(coefficients, np.array([0.0, 0.5, 1.0]))
    feet = [stance_dynamics(ROBOT, subject.patient).swing_foot(pose).translation for pose in poses]
    along = np.array([np.cos(problem.exoskeleton.toe_out), np.sin(problem.exoskeleton.toe_out), 0.0])
    assert feet[0] @ along == pytest.approx(-length, abs=0.01)
    assert feet[2] @ along == pytest.approx(length, abs=0.01)
    assert abs(feet[0][2]) < 0.01
    assert abs(feet[2][2]) < 0.01
    assert feet[1][2] > 0.04
