"""The gait network: who walks and how, to the twelve trajectories of his step. `Subject -> 12 x 8 control points -> Gait`.

`gait library -> fit (training stack) -> weights in a file -> this module (numpy) -> controller`. A perceptron with tanh
layers. The rows of its last layer satisfy the linear equation by which the angles of a step continue in the next one
through the swap of the legs, c_7 = S c_0 with S swap and sign; so every gait it can put out is periodic in them, trained
well or badly. Speeds jump by what the fit keeps of the impact, under 0.02 rad/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.array_file import ArrayFileError, read_arrays, write_arrays
from atalante_control.gait.gait import DEGREE, SIGN, SWAP, Gait
from atalante_control.gait.subject import Subject
from atalante_hal.robot import JOINTS, Robot

Vector = npt.NDArray[np.float64]

FORMAT = "atalante-gait-network/2"
DEFAULT_NETWORK = Path(__file__).parents[1] / "gaits" / "network.npz"
#: What the network is told, in this order, and the unit.
INPUTS = {"mass": "kg", "height": "m", "step_length": "m", "step_duration": "s"}
OUTPUTS = len(JOINTS) * (DEGREE + 1)
LAYERS_MAX = 4
WIDTH_MAX = 128  # numbers between two layers
_PERIODICITY_DEFECT = 1e-9  # rad, of the weights of one neuron
_ANGLE_MAX = 2.0 * np.pi  # rad, of a control point
_LEG_TOLERANCE = 1e-3  # m, thigh and shank against Winter's, which the network was fitted to


class NetworkError(ValueError):
    """The file is not a gait network, or the subject is not one it knows; the message says what is valid."""


class Layer(NamedTuple):
    """y = x W + b."""

    weights: Vector  # (inputs, outputs)
    bias: Vector  # (outputs,)


@dataclass(frozen=True)
class GaitNetwork:
    """The weights, and the box of parameters they were fitted in."""

    low: Vector  # (4,) of INPUTS
    high: Vector
    layers: tuple[Layer, ...]  # tanh after all but the last
    version: str  # of the code that fitted it

    def coefficients(self, inputs: Vector) -> Vector:
        """Bezier control points of a right-stance step, unchecked; a continuous function. (4,) to (12, 8) [rad]."""
        x = (inputs - self.low) * (2.0 / (self.high - self.low)) - 1.0
        *hidden, last = self.layers
        for weights, bias in hidden:
            x = np.tanh(x @ weights + bias)
        return np.asarray((x @ last.weights + last.bias).reshape(len(JOINTS), DEGREE + 1))

    def gait(self, subject: Subject, robot: Robot) -> Gait:
        """The subject's gait, its feedforward by inverse dynamics of the trajectory it puts out.

        Raises:
            NetworkError: a parameter outside the range of the network, legs that are not Winter's, or weights that give
                angles of which no torque can be computed. Limits of the robot are not checked here, see `check_gait`.
        """
        self.check(subject)
        with np.errstate(over="ignore", invalid="ignore"):
            coefficients = self.coefficients(_inputs(subject))
        largest = np.abs(coefficients).max()
        if not largest <= _ANGLE_MAX:
            raise NetworkError(
                f"control points of a gait must be at most {_ANGLE_MAX:.3g} rad, got {largest:.3g} rad for {subject}: "
                "fit the network again with `atalante gait fit`"
            )
        coefficients.setflags(write=False)
        feedforward = stance_dynamics(robot, subject.patient).feedforward(coefficients, subject.step_duration)
        made = {"method": "gait network", "version": self.version}
        return Gait(str(subject), subject.step_duration, coefficients, feedforward, subject.parameters(), made)

    def check(self, subject: Subject) -> None:
        """Refuse a subject the network was not fitted for.

        Raises:
            NetworkError: names the parameter and its range.
        """
        for name, value, low, high in zip(INPUTS, _inputs(subject), self.low, self.high, strict=True):
            if not low <= value <= high:
                unit = INPUTS[name]
                raise NetworkError(
                    f"the gait network knows a {name.replace('_', ' ')} from {low:g} to {high:g} {unit}, not {value:g} {unit}"
                )
        patient = subject.patient
        winter = type(patient)(patient.mass, patient.height)
        for segment in ("thigh", "shank"):
            if abs(patient.length(segment) - winter.length(segment)) > _LEG_TOLERANCE:
                raise NetworkError(
                    f"the gait network knows legs of Winter's proportions, a {segment} of {winter.length(segment):.3f} m "
                    f"and not {patient.length(segment):.3f} m: make this gait with `atalante gait solve`"
                )


def periodicity() -> Vector:
    """Linear equations on the control points by which a step continues in the next one: 12 of angles, 12 of slopes. (24, 96)."""
    points = np.arange(OUTPUTS).reshape(len(JOINTS), DEGREE + 1)
    rows = np.zeros((2, len(JOINTS), OUTPUTS))
    for joint, (other, sign) in enumerate(zip(SWAP, SIGN, strict=True)):
        # q(T) is S q(0) of the next step, and the slopes at both ends alike.
        rows[0, joint, points[joint, DEGREE]] = 1.0
        rows[0, joint, points[other, 0]] = -sign
        rows[1, joint, points[joint, DEGREE]] = 1.0
        rows[1, joint, points[joint, DEGREE - 1]] = -1.0
        rows[1, joint, points[other, 1]] -= sign
        rows[1, joint, points[other, 0]] += sign
    return rows.reshape(-1, OUTPUTS)


def save_network(network: GaitNetwork, path: Path) -> None:
    """Write the file `load_network` reads.

    Raises:
        NetworkError: the network is not one that `load_network` accepts.
    """
    layers = {f"{kind}_{i}": array for i, layer in enumerate(network.layers) for kind, array in layer._asdict().items()}
    about = {"format": np.array(FORMAT), "version": np.array(network.version), "inputs": np.array(list(INPUTS))}
    arrays = {"low": network.low, "high": network.high, **about, **layers}
    try:
        _network(arrays)
    except ArrayFileError as error:
        raise NetworkError(f"{path} cannot hold this network: {error}") from error
    write_arrays(path, arrays)


def load_network(path: Path | None = None) -> GaitNetwork:
    """Read a network strictly.

    Args:
        path: of a file of `save_network`; the one that ships with the package unless given.

    Raises:
        NetworkError: the file cannot be read or is damaged, an array is unknown or missing or has a wrong shape, a number
            is not finite, or the last layer gives gaits that are not periodic. The message names the file and what makes
            a good one.
    """
    remedy = "make it with `atalante gait fit`" if path else "install atalante-hal again"
    path = path or DEFAULT_NETWORK
    try:
        return _network(read_arrays(path, _names(LAYERS_MAX), _size_max()))
    except OSError as error:
        raise NetworkError(f"{path} cannot be read: {error.strerror or error}") from error
    except ArrayFileError as error:
        raise NetworkError(f"{path} is no gait network: {error}; {remedy}") from error


def _names(depth: int) -> list[str]:
    """Return the names of the arrays of a network with so many layers."""
    layers = [f"{kind}_{i}" for i in range(depth) for kind in Layer._fields]
    return ["format", "version", "inputs", "low", "high", *layers]


def _size_max() -> int:
    """Return the bytes that a file of the largest network may have; half a kilobyte an array is for headers and texts."""
    widths = [len(INPUTS), *(LAYERS_MAX - 1) * [WIDTH_MAX], OUTPUTS]
    numbers = 2 * len(INPUTS) + sum((rows + 1) * columns for rows, columns in pairwise(widths))
    return np.dtype(np.float64).itemsize * numbers + 512 * len(_names(LAYERS_MAX))


def _network(arrays: Mapping[str, npt.NDArray[Any]]) -> GaitNetwork:
    """Return the network of arrays by name. Raises `ArrayFileError` unless they are one."""
    depth = sum(name.startswith("weights_") for name in arrays)
    expected = _names(max(1, depth))
    if missing := [name for name in expected if name not in arrays]:
        raise ArrayFileError(f"{missing[0]} is missing; {', '.join(expected)} are required")
    if unknown := sorted(set(arrays) - set(expected)):
        raise ArrayFileError(f"{unknown[0]} does not belong there; valid arrays are {', '.join(expected)}")
    about = {name: arrays[name] for name in ("format", "version", "inputs")}
    for name, array in about.items():
        if array.dtype.kind != "U" or array.ndim != (name == "inputs"):
            raise ArrayFileError(f"{name} must be text, got {array.dtype} of shape {array.shape}")
    if str(about["format"]) != FORMAT:
        raise ArrayFileError(f"format must be {FORMAT!r}, got {str(about['format'])!r:.40}")
    if about["inputs"].tolist() != list(INPUTS):
        raise ArrayFileError(f"inputs must be {', '.join(INPUTS)}, got {about['inputs'].tolist()!r:.80}")
    for name, array in arrays.items():
        if name not in about and (array.dtype != np.float64 or not np.isfinite(array).all()):
            raise ArrayFileError(f"{name} must be an array of finite 64-bit numbers")
    layers = tuple(Layer(arrays[f"weights_{i}"], arrays[f"bias_{i}"]) for i in range(depth))
    low, high = arrays["low"], arrays["high"]
    width = len(INPUTS)
    if low.shape != (width,) or high.shape != (width,) or not (low < high).all():
        raise ArrayFileError(f"low and high must be {width} numbers each, low below high")
    if depth > LAYERS_MAX:
        raise ArrayFileError(f"a network must have at most {LAYERS_MAX} layers, got {depth}")
    for i, (weights, bias) in enumerate(layers):
        columns = bias.size
        if weights.shape != (width, columns) or bias.shape != (columns,) or not 1 <= columns <= WIDTH_MAX:
            raise ArrayFileError(
                f"weights_{i} must have {width} rows and as many columns, 1 to {WIDTH_MAX}, as bias_{i} has numbers, "
                f"got shapes {weights.shape} and {bias.shape}"
            )
        width = columns
    if width != OUTPUTS:
        raise ArrayFileError(f"the last layer must have {OUTPUTS} columns, got {width}")
    defect = np.abs(periodicity()[: len(JOINTS)] @ np.vstack([layers[-1].weights, layers[-1].bias]).T).max()
    if not defect <= _PERIODICITY_DEFECT:
        raise ArrayFileError(
            f"the angles of a gait must continue in the next step, got weights with a jump of {defect:.2g} rad"
        )
    return GaitNetwork(low, high, layers, str(about["version"]))


def _inputs(subject: Subject) -> Vector:
    return np.array([subject.patient.mass, subject.patient.height, subject.step_length, subject.step_duration])
