"""The gait network: who walks and how, to the twelve trajectories of his step. `Subject -> 12 x 8 control points -> Gait`.

`gait library -> fit (training stack) -> weights in a file -> this module (numpy) -> controller`. A perceptron with tanh
layers. The rows of its last layer satisfy the linear equation by which the angles of a step continue in the next one
through the swap of the legs, c_7 = S c_0 with S swap and sign; so every gait it can put out is periodic in them, trained
well or badly. Speeds jump by what the fit keeps of the impact, under 0.02 rad/s.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.gait import DEGREE, SIGN, SWAP, Gait
from atalante_control.stance_dynamics import stance_dynamics
from atalante_control.subject import Subject
from atalante_hal.robot import JOINTS, Robot

Vector = npt.NDArray[np.float64]

FORMAT = "atalante-gait-network/1"
DEFAULT_NETWORK = Path(__file__).with_name("gaits") / "network.npz"
#: What the network is told, in this order, and the unit.
INPUTS = {"mass": "kg", "height": "m", "step_length": "m", "step_duration": "s"}
OUTPUTS = len(JOINTS) * (DEGREE + 1)
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
            NetworkError: a parameter outside the range of the network, or legs that are not Winter's.
        """
        self.check(subject)
        coefficients = self.coefficients(_inputs(subject))
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
    """Write the file `load_network` reads."""
    arrays = {f"{kind}_{i}": array for i, layer in enumerate(network.layers) for kind, array in layer._asdict().items()}
    about = {"format": np.array(FORMAT), "version": np.array(network.version), "inputs": np.array(list(INPUTS))}
    np.savez_compressed(path, allow_pickle=False, low=network.low, high=network.high, **about, **arrays)


def load_network(path: Path | None = None) -> GaitNetwork:
    """Read a network strictly; the one that ships with the package unless another is named.

    Raises:
        NetworkError: not a file of `save_network`: an unknown or missing array, a wrong shape, a number that is not
            finite, a last layer whose gaits would not be periodic.
    """
    path = path or DEFAULT_NETWORK
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = dict(file)
    except OSError as error:
        raise NetworkError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise NetworkError(f"{path} is no gait network; `atalante gait fit` makes one") from error
    if str(arrays.pop("format", "")) != FORMAT or arrays.pop("inputs", np.array([])).tolist() != list(INPUTS):
        raise NetworkError(f"{path}: format is {FORMAT!r} with the inputs {', '.join(INPUTS)}")
    version = str(arrays.pop("version", ""))
    for name, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise NetworkError(f"{path}: {name} is an array of finite 64-bit numbers")
        array.setflags(write=False)
    depth = sum(name.startswith("weights_") for name in arrays)
    expected = {"low", "high", *(f"{kind}_{i}" for i in range(depth) for kind in Layer._fields)}
    if not depth or set(arrays) != expected:
        wrong = sorted(expected ^ set(arrays)) or ["weights_0"]
        raise NetworkError(
            f"{path}: {wrong[0]} does not belong there or is missing; valid are {', '.join(sorted(expected))}"
        )
    layers = tuple(Layer(arrays[f"weights_{i}"], arrays[f"bias_{i}"]) for i in range(depth))
    low, high = arrays["low"], arrays["high"]
    width = len(INPUTS)
    if low.shape != (width,) or high.shape != (width,) or not (low < high).all():
        raise NetworkError(f"{path}: low and high are {width} numbers each, low below high")
    for i, (weights, bias) in enumerate(layers):
        if weights.ndim != 2 or weights.shape[0] != width or bias.shape != weights.shape[1:]:
            raise NetworkError(f"{path}: weights_{i} has {width} rows and as many columns as bias_{i} has numbers")
        width = weights.shape[1]
    if width != OUTPUTS:
        raise NetworkError(f"{path}: the last layer has {OUTPUTS} columns, not {width}")
    defect = np.abs(periodicity()[: len(JOINTS)] @ np.vstack([layers[-1].weights, layers[-1].bias]).T).max()
    if defect > 1e-9:
        raise NetworkError(
            f"{path}: the angles of a gait continue in the next step, not with a jump of {defect:.2g} rad"
        )
    return GaitNetwork(low, high, layers, version)


def _inputs(subject: Subject) -> Vector:
    return np.array([subject.patient.mass, subject.patient.height, subject.step_length, subject.step_duration])
