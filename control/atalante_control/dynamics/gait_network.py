"""Neural network that computes a gait from patient and step parameters: `Subject -> 12 x 8 control points -> Gait`.

`gait_optimization.fit` computes the weights of the network and writes them to a file. This module reads the file and
needs only numpy. The network is a perceptron with tanh layers. The weights of the last layer are constrained so that
every gait satisfies c_7 = S c_0. Here c_0 and c_7 are the first and the last control points, and S swaps and mirrors
the legs. The angles are therefore continuous at the stance change for every input, even if the fit is poor. The speeds
are not exactly continuous: a part of the speed jump at the impact remains in the gaits of the fit, and the fit error is added.
The sum is less than 0.02 rad/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.array_file import ArrayFileError, read_arrays, write_arrays
from atalante_control.gait.gait import DEGREE, SIGN, SWAP, Gait
from atalante_control.gait.subject import STEP_DURATION_RANGE, STEP_LENGTH_RANGE, Subject
from atalante_control.model import Patient
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import Vector

FORMAT = "atalante-gait-network/3"
DEFAULT_NETWORK = Path(__file__).parents[1] / "gaits" / "network.npz"
#: Inputs of the network in this order: name -> unit. `thigh` and `shank` are ratios of segment lengths.
#: Ratio: length of the segment divided by the length that Winter's table of body proportions gives for the patient's height.
INPUTS = {"mass": "kg", "height": "m", "step_length": "m", "step_duration": "s", "thigh": "", "shank": ""}
LEG_SEGMENTS = ("thigh", "shank")  # body segments whose length is an input
OUTPUTS = len(JOINTS) * (DEGREE + 1)
LAYERS_MAX = 4
WIDTH_MAX = 128  # largest number of neurons of a layer
#: Largest accepted jump of a joint angle at the stance change [rad], as a tolerance for rounding errors.
#: The check treats the bias and each weight row of the last layer as control points of a gait, and computes each jump.
_PERIODICITY_DEFECT = 1e-9
_ANGLE_MAX = 2.0 * np.pi  # rad, largest accepted absolute value of a control point
#: Relative tolerance for inputs beyond a bound of their range. Reason: the ratios `thigh` and `shank` have rounding errors.
_ROUNDING = 1e-9


class NetworkError(ValueError):
    """Invalid network file, or subject outside the range of the network. The message states the valid values."""


class Layer(NamedTuple):
    """Linear layer of the network, y = x W + b."""

    weights: Vector  # weight matrix W, shape (inputs, outputs)
    bias: Vector  # bias vector b, shape (outputs,)


@dataclass(frozen=True)
class GaitNetwork:
    """Gait network: weights of the layers, and input range for which the network was fitted."""

    low: Vector  # smallest valid values of INPUTS, shape (6,)
    high: Vector  # largest valid values of INPUTS, shape (6,)
    layers: tuple[Layer, ...]  # layers in order; tanh follows each layer except the last
    version: str  # version of the package atalante-hal with which the network was fitted

    def coefficients(self, inputs: Vector) -> Vector:
        """Return the Bezier control points of a right-stance step, without a check of the inputs.

        The result is a continuous function of the inputs.

        Args:
            inputs: values of INPUTS, shape (6,).

        Returns:
            Control points in the order of JOINTS, shape (12, 8) [rad].
        """
        x = (inputs - self.low) * (2.0 / (self.high - self.low)) - 1.0
        *hidden, last = self.layers
        for weights, bias in hidden:
            x = np.tanh(x @ weights + bias)
        return np.asarray((x @ last.weights + last.bias).reshape(len(JOINTS), DEGREE + 1))

    def gait(self, subject: Subject, robot: Robot) -> Gait:
        """Return the gait of a subject. The feedforward is computed from the trajectories by inverse dynamics.

        The limits of the robot are not checked here, see `check_gait`.

        Args:
            subject: patient and step parameters.
            robot: robot description for the dynamics.

        Raises:
            NetworkError: If a parameter is outside the range of the network, or if the angles are too large to compute torques.
        """
        self.check(subject)
        with np.errstate(over="ignore", invalid="ignore"):
            coefficients = self.coefficients(inputs_of(subject))
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

    def check_patient(self, patient: Patient) -> None:
        """Raise `NetworkError` if a patient is outside the range for which the network was fitted.

        Args:
            patient: patient to check. Step length and step duration are set to the middle of the range.

        Raises:
            NetworkError: If a parameter is out of range, as in `check`.
        """
        _, _, length, duration, *_ = (self.low + self.high) / 2.0
        self.check(Subject(patient, float(length), round(float(duration), 3)))

    def check(self, subject: Subject) -> None:
        """Raise `NetworkError` if a subject is outside the range for which the network was fitted.

        Args:
            subject: patient and step parameters.

        Raises:
            NetworkError: If a parameter is out of range. The message states the parameter and the valid range.
        """
        patient = subject.patient
        for name, value, low, high in zip(INPUTS, inputs_of(subject), self.low, self.high, strict=True):
            if not low * (1.0 - _ROUNDING) <= value <= high * (1.0 + _ROUNDING):
                if name in LEG_SEGMENTS:
                    winter = Patient(patient.mass, patient.height).length(name)
                    raise NetworkError(
                        f"{name} length for the gait network must be {low * winter:.3f} to {high * winter:.3f} m "
                        f"at a height of {patient.height:g} m, got {patient.length(name):.3f} m: "
                        "compute this gait with `atalante gait solve`"
                    )
                unit = INPUTS[name]
                raise NetworkError(
                    f"{name.replace('_', ' ')} for the gait network must be {low:g} to {high:g} {unit}, got {value:g} {unit}"
                )


def inputs_of(subject: Subject) -> Vector:
    """Return the inputs of the network for a subject, in the order of INPUTS, shape (6,).

    Args:
        subject: patient and step parameters.
    """
    patient = subject.patient
    winter = Patient(patient.mass, patient.height)
    legs = [patient.length(segment) / winter.length(segment) for segment in LEG_SEGMENTS]
    return np.array([patient.mass, patient.height, subject.step_length, subject.step_duration, *legs])


def subject_of(inputs: Sequence[float]) -> Subject:
    """Return the subject with the given inputs of the network.

    Args:
        inputs: values of INPUTS. The step duration must be a whole number of milliseconds.
    """
    mass, height, length, duration, thigh, shank = inputs
    winter = Patient(mass, height)
    legs = (ratio * winter.length(segment) for ratio, segment in zip((thigh, shank), LEG_SEGMENTS, strict=True))
    return Subject(Patient(mass, height, *legs), length, duration)


def periodicity() -> Vector:
    """Return the matrix A, shape (24, 96). A gait with the control points c is continuous at the stance change if A c = 0.

    c contains the control points of all joints, shape (96,). The first 12 elements of A c are the jumps of the joint
    angles [rad]. The last 12 elements are the jumps of the joint speeds, multiplied by T / 7 [rad] (T is the step duration).
    """
    points = np.arange(OUTPUTS).reshape(len(JOINTS), DEGREE + 1)
    rows = np.zeros((2, len(JOINTS), OUTPUTS))
    for joint, (other, sign) in enumerate(zip(SWAP, SIGN, strict=True)):
        # Continuity at the stance change: angles q(T) = S q(0), speeds q'(T) = S q'(0). S swaps and mirrors the legs.
        rows[0, joint, points[joint, DEGREE]] = 1.0
        rows[0, joint, points[other, 0]] = -sign
        rows[1, joint, points[joint, DEGREE]] = 1.0
        rows[1, joint, points[joint, DEGREE - 1]] = -1.0
        rows[1, joint, points[other, 1]] -= sign
        rows[1, joint, points[other, 0]] += sign
    return rows.reshape(-1, OUTPUTS)


def save_network(network: GaitNetwork, path: Path) -> None:
    """Write a network file for `load_network`.

    Args:
        network: network to write.
        path: path of the file, replaced if it exists.

    Raises:
        NetworkError: If `load_network` would reject the network.
    """
    layers = {f"{kind}_{i}": array for i, layer in enumerate(network.layers) for kind, array in layer._asdict().items()}
    about = {"format": np.array(FORMAT), "version": np.array(network.version), "inputs": np.array(list(INPUTS))}
    arrays = {"low": network.low, "high": network.high, **about, **layers}
    try:
        _network(arrays)
    except ArrayFileError as error:
        raise NetworkError(f"{path} is not written, because the network is not valid: {error}") from error
    write_arrays(path, arrays)


def load_network(path: Path | None = None) -> GaitNetwork:
    """Read a network file and check its content.

    Args:
        path: path of a file written by `save_network`, or None for the network file of this package.

    Raises:
        NetworkError: If the file cannot be read or is damaged, if an array is unknown, missing or of the wrong shape, if a number
            is not finite, or if the last layer gives gaits that are not periodic. The message states the file and the remedy.
    """
    remedy = "make it with `atalante gait fit`" if path else "install atalante-hal again"
    path = path or DEFAULT_NETWORK
    try:
        return _network(read_arrays(path, _names(LAYERS_MAX), _size_max()))
    except OSError as error:
        raise NetworkError(f"{path} cannot be read: {error.strerror or error}") from error
    except ArrayFileError as error:
        raise NetworkError(f"{path} is not a valid gait network: {error}; {remedy}") from error


def _names(depth: int) -> list[str]:
    """Return the names of the arrays in the file of a network with `depth` layers."""
    layers = [f"{kind}_{i}" for i in range(depth) for kind in Layer._fields]
    return ["format", "version", "inputs", "low", "high", *layers]


def _size_max() -> int:
    """Return the largest valid size of a network file [byte]: 8 bytes per number, and 512 bytes per array for header and text."""
    widths = [len(INPUTS), *(LAYERS_MAX - 1) * [WIDTH_MAX], OUTPUTS]
    numbers = 2 * len(INPUTS) + sum((rows + 1) * columns for rows, columns in pairwise(widths))
    return np.dtype(np.float64).itemsize * numbers + 512 * len(_names(LAYERS_MAX))


def _network(arrays: Mapping[str, npt.NDArray[Any]]) -> GaitNetwork:
    """Check the arrays of a network file, and return the network.

    Raises:
        ArrayFileError: If the arrays are not a valid network.
    """
    depth = sum(name.startswith("weights_") for name in arrays)
    expected = _names(max(1, depth))
    if missing := [name for name in expected if name not in arrays]:
        raise ArrayFileError(f"{missing[0]} is missing; {', '.join(expected)} are required")
    if unknown := sorted(set(arrays) - set(expected)):
        raise ArrayFileError(f"{unknown[0]} is not a valid array; valid arrays are {', '.join(expected)}")
    about = {name: arrays[name] for name in ("format", "version", "inputs")}
    for name, array in about.items():
        if array.dtype.kind != "U" or array.ndim != (name == "inputs"):
            wanted = "a list of texts" if name == "inputs" else "a single text"
            raise ArrayFileError(f"{name} must be {wanted}, got {array.dtype} of shape {array.shape}")
    if str(about["format"]) != FORMAT:
        raise ArrayFileError(f"format must be {FORMAT!r}, got {str(about['format'])!r:.40}")
    if about["inputs"].tolist() != list(INPUTS):
        raise ArrayFileError(f"inputs must be {', '.join(INPUTS)}, got {about['inputs'].tolist()!r:.80}")
    for name, array in arrays.items():
        if name not in about and (array.dtype != np.float64 or not np.isfinite(array).all()):
            found = f"{array.dtype} with a value that is not finite" if array.dtype == np.float64 else array.dtype
            raise ArrayFileError(f"{name} must be an array of finite 64-bit floats, got {found}")
    layers = tuple(Layer(arrays[f"weights_{i}"], arrays[f"bias_{i}"]) for i in range(depth))
    low, high = arrays["low"], arrays["high"]
    width = len(INPUTS)
    for name, bound in (("low", low), ("high", high)):
        if bound.shape != (width,):
            raise ArrayFileError(f"{name} must have shape ({width},), got shape {bound.shape}")
    if (wrong := np.flatnonzero(low >= high)).size:
        i = int(wrong[0])
        raise ArrayFileError(f"low[{i}] must be below high[{i}] ({high[i]:g}), got {low[i]:g}")
    for name, (least, most) in (("step_length", STEP_LENGTH_RANGE), ("step_duration", STEP_DURATION_RANGE)):
        i = list(INPUTS).index(name)
        if low[i] < least or high[i] > most:
            unit = INPUTS[name]
            raise ArrayFileError(
                f"the range of {name} must be within {least:g} to {most:g} {unit}, got {low[i]:g} to {high[i]:g} {unit}"
            )
    for mass, height, _, _, thigh, shank in product(*zip(low.tolist(), high.tolist(), strict=True)):
        try:
            subject_of([mass, height, STEP_LENGTH_RANGE[0], STEP_DURATION_RANGE[0], thigh, shank])
        except ValueError as error:
            raise ArrayFileError(f"each patient in the range of the network must be valid, but {error}") from error
    if depth > LAYERS_MAX:
        raise ArrayFileError(f"the network must have at most {LAYERS_MAX} layers, got {depth}")
    for i, (weights, bias) in enumerate(layers):
        columns = bias.size
        if bias.shape != (columns,) or not 1 <= columns <= WIDTH_MAX:
            raise ArrayFileError(f"bias_{i} must have shape (n,) with n from 1 to {WIDTH_MAX}, got shape {bias.shape}")
        if weights.shape != (width, columns):
            raise ArrayFileError(
                f"weights_{i} must have shape ({width}, {columns}) for {width} inputs and {columns} numbers in bias_{i}, "
                f"got shape {weights.shape}"
            )
        width = columns
    if width != OUTPUTS:
        raise ArrayFileError(f"the last layer must have {OUTPUTS} columns, got {width}")
    # The control points of a gait are the bias of the last layer plus a weighted sum of the rows of its weight matrix.
    # So every gait is continuous at the stance change if the bias and each row of the weight matrix are continuous there.
    defect = np.abs(periodicity()[: len(JOINTS)] @ np.vstack([layers[-1].weights, layers[-1].bias]).T).max()
    if not defect <= _PERIODICITY_DEFECT:
        raise ArrayFileError(
            f"the angles of a gait must be continuous at the stance change, got weights with a jump of {defect:.2g} rad"
        )
    return GaitNetwork(low, high, layers, str(about["version"]))
