"""Sparse nonlinear program for IPOPT, assembled from small expressions, for example one constraint for all nodes of a step.

`Rows (SX expressions of a few unknowns) -> NonlinearProgram.add -> f, g and their exact sparse derivatives as five functions`.
The model of walking is in `step_problem`. Each repetition of an expression uses other elements of the vector of unknowns, for
example the unknowns of the next node. Each expression is differentiated only once. For each repetition, the program stores
the positions of the derivatives in the sparse matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi
import numpy as np
import numpy.typing as npt

from atalante_hal.types import Vector

Indices = npt.NDArray[np.intp]
Symbol = Any  # casadi.SX or casadi.MX


class Rows(NamedTuple):
    """Named group of constraints: lower <= values <= upper."""

    name: str  # readable name of the group, for example "swing clearance"
    unit: str  # SI unit of `size`, `values`, `lower` and `upper`
    size: float  # scale of the group; the solver gets the values and the bounds divided by this scale
    values: Symbol  # CasADi SX expressions to constrain, shape (m,)
    lower: Vector  # lower bounds, shape (m,), or (repetitions, m) if they differ between repetitions
    upper: Vector  # upper bounds, same shapes as `lower`


class Group(NamedTuple):
    """Indices of the rows of g that belong to one named group of constraints."""

    name: str  # name of the group, as in `Rows`
    unit: str  # SI unit of the constraints, as in `Rows`
    size: float  # scale of the group, as in `Rows`
    rows: Indices  # row indices in g


class Functions(NamedTuple):
    """Functions that the solver calls, in the order of `NAMES`.

    The arguments are the unknowns x and the parameters p. The Hessian has two more arguments, the multipliers of the Lagrangian
    L = lam_f f + dot(lam_g, g).
    """

    objective: Any  # x, p -> f
    constraints: Any  # x, p -> g
    gradient: Any  # x, p -> f, df/dx
    jacobian: Any  # x, p -> g, dg/dx
    hessian: Any  # x, p, multipliers lam_f and lam_g -> upper triangle of the Hessian of lam_f f + dot(lam_g, g)


NAMES = ("nlp_f", "nlp_g", "nlp_grad_f", "nlp_jac_g", "nlp_hess_l")


class _Block(NamedTuple):
    """Constraint or cost that is repeated, for example once per node of the step."""

    expression: Symbol  # CasADi SX expression to repeat: a scalar cost, or a column of constraints
    x: Symbol  # CasADi SX symbols of the n variables in `expression`, shape (n,)
    at: Indices  # indices of the unknowns that replace `x` in each repetition, shape (repetitions, n)
    weights: Vector | None  # weight of each repetition in the objective, or None if the expression is a constraint


class NonlinearProgram:
    """Nonlinear program: minimise f(x, p) subject to lower <= g(x, p) <= upper.

    Attributes:
        lower: lower bounds of g, each divided by the scale (`size`) of its group.
        upper: upper bounds of g, each divided by the scale (`size`) of its group.
        groups: named groups of constraints, with the rows of g that belong to each group.
    """

    def __init__(self, unknowns: int, parameters: Symbol) -> None:
        """Create a program without constraints.

        Args:
            unknowns: number of unknowns.
            parameters: SX symbols that all expressions may use.
        """
        self.unknowns = unknowns
        self._p = parameters
        self._linear = np.zeros((0, unknowns))
        self._blocks: list[_Block] = []
        self.lower, self.upper = np.zeros(0), np.zeros(0)
        self.groups: list[Group] = []

    def add_linear(self, name: str, unit: str, matrix: Vector, value: Vector) -> None:
        """Add the constraints matrix @ x = value. Linear constraints must be added before all other constraints.

        Args:
            name: name of the group.
            unit: SI unit of the rows.
            matrix: coefficients, shape (m, unknowns).
            value: right-hand side, shape (m,).
        """
        assert not self._blocks, "linear rows must be added before all others"
        self.groups.append(Group(name, unit, 1.0, len(self.lower) + np.arange(len(value))))
        self._linear = np.concatenate([self._linear, matrix])
        self.lower, self.upper = np.append(self.lower, value), np.append(self.upper, value)

    def add(self, rows: Sequence[Rows], x: Symbol, indices: Sequence[Indices]) -> None:
        """Add constraints that are repeated, for example once per node of the step.

        Args:
            rows: constraints to repeat.
            x: SX symbols on which the constraints depend, shape (n,).
            indices: indices of the unknowns for each repetition, each of shape (n,).
        """
        first, height, count = len(self.lower), sum(row.values.shape[0] for row in rows), len(indices)
        lower, upper = np.zeros((count, height)), np.zeros((count, height))
        start = 0
        for row in rows:
            columns = np.arange(start, start + row.values.shape[0])
            lower[:, columns], upper[:, columns] = row.lower / row.size, row.upper / row.size
            index = first + (columns + height * np.arange(count)[:, None]).ravel()
            self.groups.append(Group(row.name, row.unit, row.size, index))
            start += row.values.shape[0]
        self.lower, self.upper = np.append(self.lower, lower), np.append(self.upper, upper)
        expression = casadi.vertcat(*(row.values / row.size for row in rows))
        self._blocks.append(_Block(expression, x, np.array(indices), None))

    def minimise(self, cost: Symbol, x: Symbol, indices: Sequence[Indices], weights: Vector) -> None:
        """Add a cost to the objective, for example the squared torques, summed over all nodes with one weight per node.

        Args:
            cost: scalar SX expression to repeat.
            x: SX symbols on which the cost depends, shape (n,).
            indices: indices of the unknowns for each repetition, each of shape (n,).
            weights: weight of each repetition.
        """
        self._blocks.append(_Block(cost, x, np.array(indices), weights))

    def functions(self) -> Functions:
        """Build the functions of x and p that the solver calls."""
        x, p = casadi.MX.sym("x", self.unknowns), casadi.MX.sym("p", self._p.shape[0])
        lam_f, lam_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", len(self.lower))
        gradient = _Sparse(self.unknowns, 1)
        jacobian, hessian = _Sparse(len(self.lower), self.unknowns), _Sparse(self.unknowns, self.unknowns)
        f: Symbol = casadi.MX(0)
        rows, columns = np.nonzero(self._linear)
        jacobian.add(rows, columns, casadi.DM(self._linear[rows, columns]))
        g = [casadi.sparsify(casadi.DM(self._linear)) @ x]
        row = len(self._linear)
        for block in self._blocks:
            count, height, at = len(block.at), block.expression.shape[0], block.at
            local = casadi.horzcat(*(x[indices.tolist()] for indices in at))
            values, slopes, curvature = _derivatives(block, self._p)
            value, slope = values.map(count)(local, p), slopes.function.map(count)(local, p)
            if block.weights is None:
                lam = casadi.reshape(lam_g[row : row + height * count], height, count)
                g.append(casadi.vec(value))
                jacobian.add(row + slopes.rows + height * np.arange(count)[:, None], at[:, slopes.columns], slope)
                row += height * count
            else:
                weights = casadi.DM(block.weights)
                lam = lam_f * weights.T
                f += value @ weights
                gradient.add(at[:, slopes.columns], 0 * at[:, slopes.columns], slope @ casadi.diag(weights))
            one, other = at[:, curvature.rows], at[:, curvature.columns]
            curved = curvature.function.map(count)(local, p, lam)
            hessian.add(np.minimum(one, other), np.maximum(one, other), curved)
        constraints, given = casadi.vertcat(*g), ["x", "p"]
        return Functions(
            casadi.Function(NAMES[0], [x, p], [f], given, ["f"]),
            casadi.Function(NAMES[1], [x, p], [constraints], given, ["g"]),
            casadi.Function(NAMES[2], [x, p], [f, casadi.densify(gradient.matrix())], given, ["f", "grad_f_x"]),
            casadi.Function(NAMES[3], [x, p], [constraints, jacobian.matrix()], given, ["g", "jac_g_x"]),
            casadi.Function(
                NAMES[4],
                [x, p, lam_f, lam_g],
                [hessian.matrix()],
                [*given, "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            ),
        )


class _Entries(NamedTuple):
    """Function for the nonzero entries of a sparse matrix, with the row and column of each entry."""

    function: Any  # casadi.Function
    rows: Indices  # row index of each entry
    columns: Indices  # column index of each entry


def _derivatives(block: _Block, p: Symbol) -> tuple[Any, _Entries, _Entries]:
    """Return functions for the values, the Jacobian and the Hessian of a repeated constraint or cost.

    The arguments of the functions are x and p. The Hessian has a third argument: one multiplier `lam` for each row of the
    expression. The Hessian function returns the upper triangle of the second derivative of dot(lam, expression).
    """
    lam = casadi.SX.sym("lam", block.expression.shape[0])
    slopes = casadi.jacobian(block.expression, block.x)
    curvature = casadi.triu(casadi.hessian(casadi.dot(lam, block.expression), block.x)[0])
    entries = []
    for name, matrix, arguments in (
        ("jacobian", slopes, [block.x, p]),
        ("hessian", curvature, [block.x, p, lam]),
    ):
        rows, columns = matrix.sparsity().get_triplet()
        # Common subexpressions are not eliminated.
        # The elimination would take most of the build time, and save only 3 % of the operations.
        function = casadi.Function(name, arguments, [casadi.vertcat(*matrix.nonzeros())])
        entries.append(_Entries(function, np.array(rows, np.intp), np.array(columns, np.intp)))
    return casadi.Function("values", [block.x, p], [block.expression]), entries[0], entries[1]


class _Sparse:
    """Sparse matrix under construction. Entries with the same row and column are summed."""

    def __init__(self, rows: int, columns: int) -> None:
        self._shape = (rows, columns)
        self._keys: list[Indices] = []
        self._values: list[Symbol] = []

    def add(self, rows: Indices, columns: Indices, values: Symbol) -> None:
        """Add the matrix entries of one expression that is repeated, for example once per node of the step.

        Each repetition adds n entries to the matrix, at the positions in `rows` and `columns`.

        Args:
            rows: row index of each entry, shape (repetitions, n).
            columns: column index of each entry, shape (repetitions, n).
            values: value of each entry, shape (n, repetitions).
        """
        self._keys.append((columns * self._shape[0] + rows).ravel())
        self._values.append(casadi.vec(values))

    def matrix(self) -> Symbol:
        """Return the sparse matrix as a CasADi MX."""
        keys = np.concatenate(self._keys)
        distinct, row = np.unique(keys, return_inverse=True)
        height = self._shape[0]
        sparsity = casadi.Sparsity.triplet(*self._shape, (distinct % height).tolist(), (distinct // height).tolist())
        collect = casadi.Sparsity.triplet(len(distinct), len(keys), row.tolist(), list(range(len(keys))))
        return casadi.MX(sparsity, casadi.DM(collect, 1.0) @ casadi.vertcat(*self._values))
