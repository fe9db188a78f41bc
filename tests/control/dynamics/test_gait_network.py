"""Tests of the gait network: shape, range, file, continuity. `atalante gait check` measures its accuracy."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from atalante_control.dynamics import gait_network
from atalante_control.dynamics.gait_network import (
    INPUTS,
    OUTPUTS,
    GaitNetwork,
    Layer,
    NetworkError,
    inputs_of,
    load_network,
    periodicity,
    save_network,
    subject_of,
)
from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.array_file import CHECKSUM, write_arrays
from atalante_control.gait.gait import SIGN, SWAP, Gait, check_gait, motion
from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_hal.robot import load_robot

ROBOT = load_robot()
SHIPPED = load_network()


def untrained(seed: int) -> GaitNetwork:
    """Return an untrained network whose last layer gives periodic gaits."""
    rng = np.random.default_rng(seed)
    _, _, right = np.linalg.svd(periodicity())
    basis = right[len(periodicity()) :]
    layers = (
        Layer(rng.normal(size=(len(INPUTS), 5)), rng.normal(size=5)),
        Layer(rng.normal(size=(5, len(basis))) @ basis * 0.05, rng.normal(size=len(basis)) @ basis * 0.05),
    )
    low, high = np.array([50.0, 1.5, 0.1, 0.6, 0.9, 0.95]), np.array([90.0, 1.9, 0.2, 1.2, 1.1, 1.05])
    return GaitNetwork(low, high, layers, "untrained")


def random_inputs(network: GaitNetwork, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(network.low, network.high, (count, len(INPUTS)))


def subject(inputs: np.ndarray) -> Subject:
    mass, height, length, duration, *legs = inputs.tolist()
    return subject_of([mass, height, length, round(duration, 3), *legs])


@pytest.mark.parametrize("network", [SHIPPED, untrained(1)], ids=["shipped", "untrained"])
def test_angles_of_every_gait_continue_in_the_mirrored_step(network: GaitNetwork) -> None:
    for inputs in random_inputs(network, 50):
        points = network.coefficients(inputs)
        np.testing.assert_allclose(points[:, -1], SIGN * points[SWAP, 0], atol=1e-12)


def test_velocities_continue_in_the_mirrored_step_within_tolerance() -> None:
    for inputs in random_inputs(SHIPPED, 200):
        _, qd, _ = motion(SHIPPED.coefficients(inputs), inputs[3], np.array([0.0, 1.0]))
        assert np.abs(qd[1] - SIGN * qd[0][SWAP]).max() < 0.02


def test_gaits_of_the_shipped_network_are_within_robot_limits() -> None:
    ends = np.array(np.meshgrid(*zip(SHIPPED.low, SHIPPED.high, strict=True))).reshape(len(INPUTS), -1).T
    for inputs in [*random_inputs(SHIPPED, 10), *ends]:
        check_gait(SHIPPED.gait(subject(inputs), ROBOT), ROBOT)


def test_shipped_network_covers_the_subjects_of_the_paper() -> None:
    assert dict(zip(INPUTS, SHIPPED.low, strict=True))["mass"] <= 58.0
    assert dict(zip(INPUTS, SHIPPED.high, strict=True))["mass"] >= 91.0
    assert SHIPPED.low[1] <= 1.62
    assert SHIPPED.high[1] >= 1.93
    assert gait_network.DEFAULT_NETWORK.stat().st_size < 100_000


def test_network_output_is_continuous() -> None:
    """An input step of 1e-6 of its range changes every angle by less than 1e-4 degrees."""
    for inputs in random_inputs(SHIPPED, 100):
        for axis, step in enumerate(1e-6 * (SHIPPED.high - SHIPPED.low)):
            nudged = inputs + step * (np.arange(len(INPUTS)) == axis)
            change = SHIPPED.coefficients(nudged) - SHIPPED.coefficients(inputs)
            assert np.degrees(np.abs(change).max()) < 1e-4


def test_feedforward_is_the_inverse_dynamics_of_the_trajectory() -> None:
    person = subject(random_inputs(SHIPPED, 1)[0])
    gait = SHIPPED.gait(person, ROBOT)
    expected = stance_dynamics(ROBOT, person.patient).feedforward(gait.coefficients, gait.duration)
    assert gait.feedforward is not None
    np.testing.assert_array_equal(gait.feedforward, expected)
    assert gait.parameters == person.parameters()
    assert gait.duration == person.step_duration


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda low, high: Subject(Patient(high[0] + 1.0, 1.75), 0.15, 0.9),
            "mass for the gait network must be 58 to 91 kg, got 92 kg",
        ),
        (lambda low, high: Subject(Patient(75.0, low[1] - 0.01), 0.15, 0.9), "height for the gait network must be"),
        (
            lambda low, high: Subject(Patient(75.0, 1.75), high[2] + 0.01, 0.9),
            "step length for the gait network must be",
        ),
        (
            lambda low, high: Subject(Patient(75.0, 1.75), 0.15, high[3] + 0.1),
            "step duration for the gait network must be",
        ),
        (
            lambda low, high: Subject(Patient(75.0, 1.75, 0.47), 0.15, 0.9),
            r"thigh length for the gait network must be 0.403 to 0.454 m at a height of 1.75 m, got 0.470 m",
        ),
        (
            lambda low, high: Subject(Patient(75.0, 1.75, None, 0.40), 0.15, 0.9),
            r"shank length for the gait network must be 0.405 to 0.456 m at a height of 1.75 m, got 0.400 m",
        ),
    ],
)
def test_subject_out_of_range_is_rejected_with_the_range(
    change: Callable[[np.ndarray, np.ndarray], Subject], sentence: str
) -> None:
    with pytest.raises(NetworkError, match=sentence):
        SHIPPED.gait(change(SHIPPED.low, SHIPPED.high), ROBOT)


def test_ends_of_the_range_are_accepted() -> None:
    for inputs in (SHIPPED.low, SHIPPED.high):
        SHIPPED.check(subject(inputs))


def test_inputs_are_the_leg_lengths_relative_to_the_table_of_winter() -> None:
    patient = Patient(70.0, 1.7, 0.95 * 0.245 * 1.7, 1.05 * 0.246 * 1.7)
    values = [70.0, 1.7, 0.12, 0.9, 0.95, 1.05]
    np.testing.assert_allclose(inputs_of(Subject(patient, 0.12, 0.9)), values, rtol=1e-12)
    np.testing.assert_allclose(inputs_of(subject_of(values)), values, rtol=1e-12)
    np.testing.assert_array_equal(inputs_of(Subject(Patient(70.0, 1.7), 0.12, 0.9))[4:], [1.0, 1.0])


def test_gait_depends_on_the_leg_lengths() -> None:
    winter, longer = Patient(75.0, 1.75), Patient(75.0, 1.75, thigh_length=0.45)
    one, other = (SHIPPED.gait(Subject(patient, 0.15, 0.9), ROBOT) for patient in (winter, longer))
    assert np.degrees(np.abs(one.coefficients - other.coefficients).max()) > 0.3
    assert other.parameters["thigh_length"] == 0.45


def test_saved_network_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    network = untrained(2)
    save_network(network, tmp_path / "network.npz")
    back = load_network(tmp_path / "network.npz")
    assert back.version == "untrained"
    for inputs in random_inputs(network, 5):
        np.testing.assert_array_equal(back.coefficients(inputs), network.coefficients(inputs))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": np.array("atalante-gait-network/9")}, "format must be"),
        ({"format": np.array("atalante-gait-network/2")}, "format must be 'atalante-gait-network/3'"),
        ({"inputs": np.array(["mass"])}, "inputs must be mass, height, step_length, step_duration, thigh, shank"),
        ({"format": np.zeros(())}, "format must be a single text"),
        ({"surprise": np.zeros(3)}, "each member of the archive must be one of .*, got 'surprise.npy'"),
        ({"bias_1": None}, "bias_1 is missing"),
        ({"weights_3": np.zeros((6, 5))}, "weights_2 is missing"),
        ({"low": np.full(6, 100.0)}, r"low\[0\] must be below high\[0\] \(.*\), got 100"),
        (
            {"low": np.array([50.0, 1.5, 0.1, 0.1, 0.9, 0.95]), "high": np.array([90.0, 1.9, 0.2, 0.2, 1.1, 1.05])},
            "the range of step_duration must be within 0.4 to 2 s, got 0.1 to 0.2 s",
        ),
        (
            {"low": np.array([10.0, 1.5, 0.1, 0.8, 0.9, 0.95])},
            "each patient in the range .*, but mass of the patient must be",
        ),
        (
            {"low": np.array([50.0, 1.5, 0.1, 0.8, 0.5, 0.95])},
            "each patient in the range .*, but thigh length of the patient",
        ),
        ({"low": np.zeros(3)}, r"low must have shape \(6,\), got shape \(3,\)"),
        ({"weights_0": np.full((6, 5), np.nan)}, "weights_0 must be an array of finite 64-bit floats"),
        ({"weights_0": np.full((6, 5), np.inf)}, "weights_0 must be an array of finite 64-bit floats"),
        ({"weights_0": np.full((6, 5), "1.0")}, "weights_0 must be an array of finite 64-bit floats"),
        ({"weights_0": np.zeros((3, 5))}, r"weights_0 must have shape \(6, \d+\) for 6 inputs"),
        ({"bias_0": np.zeros(4)}, r"weights_0 must have shape \(6, 4\) for 6 inputs and 4 numbers in bias_0"),
        (
            {"weights_0": np.zeros((6, 129)), "bias_0": np.zeros(129)},
            r"bias_0 must have shape \(n,\) with n from 1 to 128, got shape \(129,\)",
        ),
        ({"weights_1": np.zeros((5, 8)), "bias_1": np.zeros(8)}, f"last layer must have {OUTPUTS} columns"),
        ({"bias_1": np.arange(96.0)}, "the angles of a gait must be continuous at the stance change"),
    ],
)
def test_invalid_network_file_is_rejected(tmp_path: Path, change: dict[str, np.ndarray | None], sentence: str) -> None:
    path = tmp_path / "network.npz"
    save_network(untrained(3), path)
    with np.load(path) as file:
        arrays = {**dict(file), **change}
    write_arrays(path, {name: array for name, array in arrays.items() if array is not None and name != CHECKSUM})
    with pytest.raises(
        NetworkError, match=re.escape(str(path)) + ".*" + sentence + ".*make it with `atalante gait fit`$"
    ):
        load_network(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nothing", b"not a network", b"(1700000000.0) can0 123#00"])
def test_damaged_network_file_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "network.npz"
    path.write_bytes(content)
    with pytest.raises(
        NetworkError, match=re.escape(f"{path} is not a valid gait network: ") + ".*`atalante gait fit`$"
    ):
        load_network(path)
    with pytest.raises(NetworkError, match="nowhere"):
        load_network(tmp_path / "nowhere.npz")


def test_invalid_network_is_not_saved(tmp_path: Path) -> None:
    network = untrained(4)
    infinite = replace(
        network, layers=(*network.layers[:-1], Layer(network.layers[-1].weights, np.full(OUTPUTS, np.inf)))
    )
    with pytest.raises(
        NetworkError, match=r"npz is not written, because the network is not valid: bias_1 must be an array of finite"
    ):
        save_network(infinite, tmp_path / "network.npz")
    assert not list(tmp_path.iterdir())


def test_damaged_network_of_the_package_asks_for_reinstallation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "network.npz"
    path.write_bytes(gait_network.DEFAULT_NETWORK.read_bytes()[:1000])
    monkeypatch.setattr(gait_network, "DEFAULT_NETWORK", path)
    with pytest.raises(
        NetworkError, match=re.escape(f"{path} is not a valid gait network: ") + ".*; install atalante-hal again$"
    ):
        load_network()


def test_network_loads_without_the_training_dependencies() -> None:
    program = (
        "import sys; from atalante_control.dynamics.gait_network import load_network; load_network(); "
        "print([m for m in ('casadi', 'joblib', 'sklearn', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ast.literal_eval(done.stdout) == []


def test_gait_mirrored_twice_is_unchanged() -> None:
    gait = SHIPPED.gait(subject(random_inputs(SHIPPED, 1)[0]), ROBOT)
    twice: Gait = gait.mirrored().mirrored()
    np.testing.assert_array_equal(twice.coefficients, gait.coefficients)
