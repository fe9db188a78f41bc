"""Nonlinear program of a step: derivatives, dependent unknowns and constraint violations in physical units."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.gait.gait import KINDS
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.guess import guess
from atalante_control.gait_optimization.nlp import Functions
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_control.model import Patient
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.types import GRAVITY

ROBOT, REQUIREMENTS = load_robot(), Requirements()
SUBJECT = Subject(Patient(75.0, 1.75), 0.16, 0.8)


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    return StepProblem("periodic", ROBOT, REQUIREMENTS)


@pytest.fixture(scope="module")
def functions(problem: StepProblem) -> Functions:
    return problem.program.functions()


@pytest.fixture(scope="module")
def parameters(problem: StepProblem) -> np.ndarray:
    return problem.parameters(SUBJECT.patient, SUBJECT.step_duration, SUBJECT.step_length)


@pytest.fixture(scope="module")
def coefficients(problem: StepProblem, parameters: np.ndarray) -> np.ndarray:
    return guess(problem, parameters, SUBJECT)


def violations(
    problem: StepProblem, functions: Functions, coefficients: np.ndarray, parameters: np.ndarray
) -> dict[str, float]:
    x = problem.unknowns(coefficients, parameters)
    rows = np.array(functions.constraints(x, parameters)).ravel()
    found = problem.residuals(x, rows, problem.constraint_bounds(), SUBJECT.step_duration)
    return {name: residual.value for name, residual in found.items()}


def test_derivatives_match_finite_differences_along_random_directions(
    problem: StepProblem, functions: Functions, coefficients: np.ndarray, parameters: np.ndarray
) -> None:
    random = np.random.default_rng(5)
    x, step = problem.unknowns(coefficients, parameters), 1e-6
    lam = random.normal(size=len(problem.program.lower))

    def slope(at: np.ndarray) -> np.ndarray:
        jacobian = functions.jacobian(at, parameters)[1]
        return np.array(functions.gradient(at, parameters)[1] + jacobian.T @ lam).ravel()

    for _ in range(3):
        direction = random.normal(size=len(x))
        ahead, behind = x + step * direction, x - step * direction
        change = np.array(functions.constraints(ahead, parameters) - functions.constraints(behind, parameters)).ravel()
        exact = np.array(functions.jacobian(x, parameters)[1] @ direction).ravel()
        np.testing.assert_allclose(exact, change / (2 * step), atol=1e-6 * np.abs(exact).max())
        upper = np.array(functions.hessian(x, parameters, 1.0, lam))
        curved = (upper + np.triu(upper, 1).T) @ direction
        np.testing.assert_allclose(
            curved, (slope(ahead) - slope(behind)) / (2 * step), atol=1e-6 * np.abs(curved).max()
        )


def test_torques_and_ground_forces_follow_from_the_motion(
    problem: StepProblem, functions: Functions, coefficients: np.ndarray, parameters: np.ndarray
) -> None:
    found = violations(problem, functions, coefficients, parameters)
    for name in ("trajectory", "equation of motion", "ground force balance", "ground moment balance"):
        assert found[name] < 1e-9
    x = problem.unknowns(coefficients, parameters)
    np.testing.assert_array_equal(problem.coefficients(x), coefficients)
    assert problem.torques(x).shape == (REQUIREMENTS.nodes, len(JOINTS))


def test_violations_are_in_physical_units(
    problem: StepProblem, functions: Functions, coefficients: np.ndarray, parameters: np.ndarray
) -> None:
    before = violations(problem, functions, coefficients, parameters)
    bent = coefficients.copy()
    bent[JOINTS.index("left_HA"), 0] += 0.5  # rad, changes only the first node
    after = violations(problem, functions, bent, parameters)
    assert after["periodicity"] == pytest.approx(0.5, abs=before["periodicity"] + 1e-12)
    moved = coefficients.copy()
    moved[JOINTS.index("left_SK"), -1] += 0.1
    assert (
        violations(problem, functions, moved, parameters)["landing position"] > 0.02
    )  # m; a shank of 0.43 m turns by 0.1 rad
    backwards = coefficients.copy()
    backwards[JOINTS.index("right_SK")] = -0.5
    assert violations(problem, functions, backwards, parameters)["joint limits"] == pytest.approx(
        REQUIREMENTS.knee_min + 0.5
    )


def test_bounds_are_the_robot_limits_minus_the_margins(problem: StepProblem) -> None:
    low, high = problem.joint_range()
    knees = [i for i, joint in enumerate(JOINTS) if joint.endswith("SK")]
    others = [i for i in range(len(JOINTS)) if i not in knees]
    np.testing.assert_allclose(low[others], ROBOT.position_min[others] + math.radians(2.0))
    np.testing.assert_allclose(high, ROBOT.position_max - math.radians(2.0))
    assert (low[knees] == REQUIREMENTS.knee_min).all()
    lower, upper = problem.bounds(0.8)
    node = problem.node(3)
    np.testing.assert_allclose(upper[node[36:48]] * 100.0, 0.9 * ROBOT.torque_max)
    np.testing.assert_allclose(lower[node[12:24]] / 0.8, -0.9 * ROBOT.velocity_max)
    assert not np.isfinite(lower[: node[0] % 54]).any()  # control points are free


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_periodic_step_has_an_impact_constraint(kind: str) -> None:
    step = StepProblem(kind, ROBOT, REQUIREMENTS)
    assert {group.name for group in step.program.groups} <= set(step.units)
    assert ("impact map" in step.units) == (kind == "periodic")
    assert ("rest" in step.units) == (kind != "periodic")


def test_ground_force_at_standstill_is_the_weight(problem: StepProblem, parameters: np.ndarray) -> None:
    still = np.zeros((len(JOINTS), 8))
    still[[3, 9]] = 0.3
    x = problem.unknowns(still, parameters)
    forces = np.array([x[problem.node(n)][48:51] for n in range(REQUIREMENTS.nodes)]) * 1500.0
    np.testing.assert_allclose(forces[:, 2], (82.0 + 75.0) * GRAVITY, rtol=0.01)
    np.testing.assert_allclose(forces[:, :2], 0.0, atol=1e-9)
