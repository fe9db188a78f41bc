"""Fit the gait network to a library: `gaits -> what of them varies -> perceptron -> GaitNetwork`.

The network is not asked for the 96 control points, most of which follow from the others, but for the few directions in
which the library varies. Linear maps lead there and back, and the way back is multiplied into the last layer:

1. *Periodic gaits.* Angles continue exactly in the next step: 84 dimensions are left. Speeds jump a little at an impact;
   the fit keeps `JUMP_KEPT` of it, as a compromise between a smooth walk and the solved gait's accelerations.
2. *Errors as they are felt.* Distance is measured by what deviates: the angles along the step, those at its ends several
   times, for there a foot lands, and the accelerations, which the feedforward is made of. The principal directions of the
   library in that measure, down to `RESOLUTION`, are what the perceptron learns.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from atalante_control.dynamics.gait_network import GaitNetwork, Layer, periodicity
from atalante_control.gait.gait import DEGREE, Gait, bezier, derivative
from atalante_control.gait_optimization.library import Grid
from atalante_hal.robot import JOINTS

Vector = npt.NDArray[np.float64]

HIDDEN = (64, 64)
ITERATIONS = 3000  # of L-BFGS in one of `ROUNDS`, each of which begins where the last one stopped
ROUNDS = 2
RESOLUTION = math.radians(0.003)  # rad, what is left of the library outside the directions that are learned
JUMP_KEPT = 0.45  # of the speed jumps of the library
END_WEIGHT = 20.0  # of a sample at either end against one between
ACCELERATION_WEIGHT = 5e-2  # s2, rad of angle that 1 rad/s2 of acceleration counts as
ALPHA = 1e-7  # weight of the squared weights: smooth between the points of the grid
SEED = 1
_SAMPLES = 41  # phases


class Fit(NamedTuple):
    """A network and how close it came to the gaits it was fitted to."""

    network: GaitNetwork
    directions: int  # learned
    rms: float  # rad, of the joint angles along the steps
    worst: float  # rad


def fit(gaits: Sequence[Gait], grid: Grid, *, hidden: Sequence[int] = HIDDEN, iterations: int = ITERATIONS) -> Fit:
    """Fit a network to gaits of a library; the same gaits give the same network.

    Args:
        gaits: with the parameters of their subjects.
        grid: its ends become the range of the network.
        hidden: neurons of each hidden layer.
        iterations: of the optimiser, at most.
    """
    low, high = (np.array([axis[end] for axis in grid.axes()]) for end in (0, -1))
    x = (np.array([inputs(gait) for gait in gaits]) - low) * (2.0 / (high - low)) - 1.0
    points = np.array([gait.coefficients.ravel() for gait in gaits])
    measure = _metric(float(np.mean(grid.step_duration)))
    periodic = _null_space(periodicity())
    smooth = points @ measure @ periodic @ np.linalg.inv(periodic.T @ measure @ periodic) @ periodic.T
    points = smooth + JUMP_KEPT * (points - smooth)
    mean = points.mean(axis=0)
    root = np.linalg.cholesky(measure)
    deviations = (points - mean) @ root
    _, spread, directions = np.linalg.svd(deviations, full_matrices=False)
    outside = np.sqrt(np.cumsum(spread[::-1] ** 2)[::-1] / len(gaits))  # rms left by the first k directions
    directions = directions[: int((outside > RESOLUTION).sum())]
    scores = deviations @ directions.T
    unit = float(np.sqrt((scores**2).sum(axis=1).mean()))

    perceptron = MLPRegressor(
        hidden_layer_sizes=tuple(hidden), activation="tanh", solver="lbfgs", alpha=ALPHA, tol=1e-12,
        max_iter=iterations, max_fun=2 * iterations, random_state=SEED, warm_start=True,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # ending at the last iteration is the rule, not a defect
        for _ in range(ROUNDS):
            perceptron.fit(x, scores / unit)
    back = unit * directions @ np.linalg.inv(root)
    *first, last = (Layer(*layer) for layer in zip(perceptron.coefs_, perceptron.intercepts_, strict=True))
    layers = (*first, Layer(last.weights @ back, last.bias @ back + mean))
    network = GaitNetwork(low, high, layers, version("atalante-hal"))

    basis = bezier(np.eye(DEGREE + 1), np.linspace(0.0, 1.0, _SAMPLES))
    error = np.array([(network.coefficients(inputs(gait)) - gait.coefficients) @ basis.T for gait in gaits])
    return Fit(network, len(directions), float(np.sqrt((error**2).mean())), float(np.abs(error).max()))


def inputs(gait: Gait) -> Vector:
    """What the network is told of a gait's subject, in the order of its INPUTS. Shape (4,)."""
    names = ("patient_mass", "patient_height", "step_length", "step_duration")
    return np.array([gait.parameters[name] for name in names])


def _metric(duration: float) -> Vector:
    """Mean square of the deviation a difference of control points makes, as a quadratic form. Shape (96, 96)."""
    phase = np.linspace(0.0, 1.0, _SAMPLES)
    angle = bezier(np.eye(DEGREE + 1), phase)
    acceleration = bezier(derivative(derivative(np.eye(DEGREE + 1))), phase) / duration**2
    weight = np.where((phase == 0.0) | (phase == 1.0), END_WEIGHT, 1.0)[:, None]
    one = (angle.T @ (weight * angle) + ACCELERATION_WEIGHT**2 * acceleration.T @ acceleration) / _SAMPLES
    return np.asarray(np.kron(np.eye(len(JOINTS)), one), np.float64)


def _null_space(rows: Vector) -> Vector:
    """Orthonormal basis of what satisfies rows x = 0, in columns."""
    _, singular, right = np.linalg.svd(rows)
    return np.asarray(right[len(singular[singular > 1e-12]) :].T)
