"""Fit of the gait network to the gaits of a library, by principal component analysis and a perceptron.

`gaits -> principal directions -> perceptron -> GaitNetwork`. The 96 control points depend on each other, so the perceptron does
not learn them directly. The perceptron learns the coordinates along the few directions in which the library varies (principal
directions). The last layer includes the linear map from these coordinates to the control points.

1. *Periodic gaits.* The angles are exactly continuous at the stance change, which leaves 84 dimensions. The speeds jump slightly
   at the impact. Before the fit, each gait is changed so that the fraction `JUMP_KEPT` of its speed jump remains. A
   smaller fraction gives a smoother walk, a larger fraction keeps the accelerations closer to the solved gait.
2. *Weighted errors.* The distance between two gaits is the deviation of their angles and accelerations along the step. The
   accelerations determine the feedforward. The ends of the step have a larger weight, because the foot lands there. The
   perceptron learns the principal directions of the library in this metric. The least important directions are omitted.
   Together, the omitted directions cause an rms error of at most `RESOLUTION`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from atalante_control.dynamics.gait_network import INPUTS, GaitNetwork, Layer, inputs_of, periodicity
from atalante_control.gait.gait import DEGREE, Gait, bezier, derivative
from atalante_control.gait.subject import Subject, patient_of
from atalante_control.gait_optimization.library import Grid
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

HIDDEN = (64, 64)
ITERATIONS = 1500  # largest number of L-BFGS iterations
#: Largest accepted rms error due to omitted principal directions [rad]. The fit uses as few directions as possible.
RESOLUTION = math.radians(0.003)
JUMP_KEPT = 0.4  # fraction to which the speed jump of each gait at the stance change is reduced before the fit
END_WEIGHT = 40.0  # weight of the squared angle errors at start and end of a step; the weight is 1 at the other samples
#: Weight of acceleration errors [s2]: an acceleration error of 1 rad/s2 counts as much as an angle error of 0.05 rad.
ACCELERATION_WEIGHT = 5e-2
#: Rms length to which the target vectors of the training are scaled.
#: L-BFGS stops if an iteration reduces the training loss by less than 2e-9.
#: With smaller targets, the training loss would be smaller, and L-BFGS would stop too early.
TARGET_SIZE = 10.0
ALPHA = 1e-5  # penalty on the squared weights; keeps the gaits smooth between the subjects of the library
SEED = 1  # seed of the initial weights
_SAMPLES = 41  # number of samples per step in the comparison of two gaits


class FitError(ValueError):
    """Gaits to which no network can be fitted. The message states the reason."""


class Fit(NamedTuple):
    """Fitted network with its errors on the gaits of the library."""

    network: GaitNetwork
    directions: int  # number of principal directions; the perceptron has one output per direction
    rms: float  # rad, rms error of the joint angles along the steps
    worst: float  # rad, largest error of the joint angles


def fit(gaits: Sequence[Gait], grid: Grid, *, hidden: Sequence[int] = HIDDEN, iterations: int = ITERATIONS) -> Fit:
    """Fit a network to the gaits of a library. The result is deterministic.

    Args:
        gaits: gaits with the parameters of their subjects.
        grid: grid of the library; its mean step duration is the time scale of the accelerations.
        hidden: number of neurons of each hidden layer.
        iterations: largest number of L-BFGS iterations.

    Returns:
        Network with its errors. The range of the network is the smallest box that contains the subjects of the gaits.

    Raises:
        FitError: If there are fewer than two gaits, if a parameter has the same value in all gaits, or if all gaits are equal.
    """
    if len(gaits) < 2:
        raise FitError(f"a gait network must be fitted to at least two gaits, got {len(gaits)}")
    subjects = np.array([inputs(gait) for gait in gaits])
    # `round` removes the rounding errors of the ratios `thigh` and `shank`.
    low, high = subjects.min(axis=0).round(12), subjects.max(axis=0).round(12)
    for name, least, most in zip(INPUTS, low, high, strict=True):
        if least == most:
            raise FitError(f"{name} must have at least two values in the gaits, got {least:g} in all gaits")
    x = (subjects - low) * (2.0 / (high - low)) - 1.0
    points = np.array([gait.coefficients.ravel() for gait in gaits])
    measure = _metric(float(np.mean(grid.step_duration)))
    periodic = _null_space(periodicity())
    smooth = points @ measure @ periodic @ np.linalg.inv(periodic.T @ measure @ periodic) @ periodic.T
    points = smooth + JUMP_KEPT * (points - smooth)
    mean = points.mean(axis=0)
    root = np.linalg.cholesky(measure)
    deviations = (points - mean) @ root
    _, spread, directions = np.linalg.svd(deviations, full_matrices=False)
    # Element k of `outside` is the rms error if only the first k directions are used.
    outside = np.sqrt(np.cumsum(spread[::-1] ** 2)[::-1] / len(gaits))
    directions = directions[: int((outside > RESOLUTION).sum())]
    if not len(directions):
        raise FitError(f"the gaits of different subjects must differ, got {len(gaits)} equal gaits")
    scores = deviations @ directions.T
    unit = float(np.sqrt((scores**2).sum(axis=1).mean())) / TARGET_SIZE

    perceptron = MLPRegressor(
        hidden_layer_sizes=tuple(hidden), activation="tanh", solver="lbfgs", alpha=ALPHA, tol=1e-12,
        max_iter=iterations, max_fun=2 * iterations, random_state=SEED,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the optimiser usually stops at the iteration limit
        perceptron.fit(x, scores / unit)
    back = unit * directions @ np.linalg.inv(root)
    *first, last = (Layer(*layer) for layer in zip(perceptron.coefs_, perceptron.intercepts_, strict=True))
    layers = (*first, Layer(last.weights @ back, last.bias @ back + mean))
    network = GaitNetwork(low, high, layers, version("atalante-hal"))

    basis = bezier(np.eye(DEGREE + 1), np.linspace(0.0, 1.0, _SAMPLES))
    error = np.array([(network.coefficients(inputs(gait)) - gait.coefficients) @ basis.T for gait in gaits])
    return Fit(network, len(directions), float(np.sqrt((error**2).mean())), float(np.abs(error).max()))


def inputs(gait: Gait) -> Vector:
    """Return the inputs of the network for the subject of a gait, in the order of INPUTS, shape (6,).

    Args:
        gait: gait with the parameters of its subject.
    """
    parameters = gait.parameters
    return inputs_of(Subject(patient_of(parameters), parameters["step_length"], parameters["step_duration"]))


def _metric(duration: float) -> Vector:
    """Return the matrix M that defines the squared distance `d^T M d` between two gaits, shape (96, 96).

    d contains the control points of one gait minus those of the other gait. The squared distance is the weighted mean of squared
    errors along the step.

    Args:
        duration: duration of the step [s].
    """
    phase = np.linspace(0.0, 1.0, _SAMPLES)
    angle = bezier(np.eye(DEGREE + 1), phase)
    acceleration = bezier(derivative(derivative(np.eye(DEGREE + 1))), phase) / duration**2
    weight = np.where((phase == 0.0) | (phase == 1.0), END_WEIGHT, 1.0)[:, None]
    one = (angle.T @ (weight * angle) + ACCELERATION_WEIGHT**2 * acceleration.T @ acceleration) / _SAMPLES
    return np.asarray(np.kron(np.eye(len(JOINTS)), one), np.float64)


def _null_space(rows: Vector) -> Vector:
    """Return an orthonormal basis of the null space of a matrix, one vector per column."""
    _, singular, right = np.linalg.svd(rows)
    return np.asarray(right[len(singular[singular > 1e-12]) :].T)
