"""Nonlinear program: values, bounds and derivatives, compared with finite differences."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from atalante_control.gait_optimization.nlp import NAMES, Functions, NonlinearProgram, Rows

P = np.array([1.3, 0.7])
X = np.array([0.2, -0.4, 0.9, 1.1, -0.8])
INSTANCES = [np.array([0, 2]), np.array([2, 1]), np.array([4, 3])]  # unknown 2 occurs twice


@pytest.fixture(scope="module")
def program() -> NonlinearProgram:
    p = casadi.SX.sym("p", 2)
    built = NonlinearProgram(5, p)
    built.add_linear("sum", "m", np.array([[1.0, 0.0, 2.0, 0.0, 0.0]]), np.array([3.0]))
    x = casadi.SX.sym("x", 2)
    circle = Rows("circle", "m2", 4.0, casadi.sumsqr(x) * p[0], np.array([-np.inf]), np.array([[1.0], [2.0], [3.0]]))
    product = Rows("product", "N", 2.0, casadi.vertcat(x[0] * x[1] ** 2, casadi.sin(x[0])), np.zeros(2), np.ones(2))
    built.add([circle, product], x, INSTANCES)
    built.minimise(casadi.exp(x[0] * x[1]) * p[1], x, INSTANCES, np.array([0.5, 1.0, 2.0]))
    return built


@pytest.fixture(scope="module")
def functions(program: NonlinearProgram) -> Functions:
    return program.functions()


def slopes(function: object, count: int) -> np.ndarray:
    """Return the central differences of a function of x."""
    step = 1e-6
    columns = []
    for k in range(count):
        ahead, behind = X.copy(), X.copy()
        ahead[k] += step
        behind[k] -= step
        columns.append((np.array(function(ahead)).ravel() - np.array(function(behind)).ravel()) / (2 * step))
    return np.array(columns).T


def test_objective_and_constraints_have_the_expected_values(program: NonlinearProgram, functions: Functions) -> None:
    expected = [X[0] + 2.0 * X[2]]
    for a, b in INSTANCES:
        expected += [(X[a] ** 2 + X[b] ** 2) * P[0] / 4.0, X[a] * X[b] ** 2 / 2.0, np.sin(X[a]) / 2.0]
    np.testing.assert_allclose(np.array(functions.constraints(X, P)).ravel(), expected, rtol=1e-14)
    objective = sum(w * np.exp(X[a] * X[b]) * P[1] for w, (a, b) in zip((0.5, 1.0, 2.0), INSTANCES, strict=True))
    assert float(functions.objective(X, P)) == pytest.approx(objective, rel=1e-14)


def test_derivatives_match_finite_differences(program: NonlinearProgram, functions: Functions) -> None:
    rows = len(program.lower)
    gradient = np.array(functions.gradient(X, P)[1]).ravel()
    np.testing.assert_allclose(gradient, slopes(lambda x: functions.objective(x, P), 5)[0], atol=1e-8)
    jacobian = np.array(functions.jacobian(X, P)[1])
    np.testing.assert_allclose(jacobian, slopes(lambda x: functions.constraints(x, P), 5), atol=1e-8)
    lam = np.random.default_rng(1).normal(size=rows)

    def lagrangian_slope(x: np.ndarray) -> np.ndarray:
        gradient = 0.6 * np.array(functions.gradient(x, P)[1]).ravel()
        return gradient + np.array(functions.jacobian(x, P)[1]).T @ lam

    upper = np.array(functions.hessian(X, P, 0.6, lam))
    assert not np.tril(upper, -1).any()
    np.testing.assert_allclose(upper + np.triu(upper, 1).T, slopes(lagrangian_slope, 5), atol=1e-7)


def test_bounds_are_scaled_and_may_differ_per_instance(program: NonlinearProgram) -> None:
    circle = next(group for group in program.groups if group.name == "circle")
    assert program.upper[circle.rows].tolist() == [0.25, 0.5, 0.75]
    product = next(group for group in program.groups if group.name == "product")
    assert program.upper[product.rows].tolist() == [0.5] * 6
    assert program.lower[0] == program.upper[0] == 3.0


def test_each_constraint_row_is_in_one_group(program: NonlinearProgram) -> None:
    rows = np.concatenate([group.rows for group in program.groups])
    assert sorted(rows.tolist()) == list(range(len(program.lower)))


def test_functions_have_the_names_that_the_solver_expects(functions: Functions) -> None:
    assert tuple(function.name() for function in functions) == NAMES
