from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.bodies.soles import read_soles
from atalante_emulator.drive import DriveParameters, Drives, DriveSignals
from atalante_emulator.foot import Feet, FootParameters
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_emulator.noise import NOISE_CYCLES, SensorNoise
from atalante_hal.robot import Robot
from atalante_hal.wire.codec import Codec

Make = Callable[..., tuple[SensorNoise, Codec]]


@pytest.fixture
def make(network: Network, robot: Robot, urdf_text: str) -> Make:
    codec = Codec([m for m in network.messages if m.cycle_ms == 1 and m.sender not in ("HAL", "PENDANT")])

    def build(seed: int, imu: ImuParameters | None = None) -> tuple[SensorNoise, Codec]:
        drives = Drives(robot, DriveParameters(), DriveSignals(*np.zeros((5, 12))))
        imus = Imus(imu or ImuParameters(), ImuSignals(np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((4, 3))))
        feet = Feet(FootParameters(), read_soles(urdf_text), np.zeros((2, 4, 3)))
        return SensorNoise(seed, codec, drives, imus, feet), codec

    return build


def noise_of_cycles(noise: SensorNoise, codec: Codec, times: int = 1) -> np.ndarray:
    noisy_values = np.zeros((times * NOISE_CYCLES, codec.size))
    for cycle, values in enumerate(noisy_values):
        if cycle % NOISE_CYCLES == 0:
            noise.draw()
        noise.add(cycle, np.zeros(codec.size), values)
    return noisy_values


def test_noise_is_reproducible_for_one_seed_and_differs_for_another(make: Make) -> None:
    first, again, other = (noise_of_cycles(*make(seed), 2) for seed in (1, 1, 2))
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert first[:NOISE_CYCLES].tobytes() != first[NOISE_CYCLES:].tobytes()


def test_noise_is_added_to_the_true_value(make: Make) -> None:
    noise, codec = make(0)
    noise.draw()
    truth, (noise_only, noisy_values) = np.arange(codec.size, dtype=float), np.zeros((2, codec.size))
    noise.add(7, np.zeros(codec.size), noise_only)
    noise.add(7, truth, noisy_values)
    assert noisy_values.tolist() == (truth + noise_only).tolist()


def test_only_measured_quantities_have_noise(make: Make) -> None:
    noise, codec = make(0)
    noisy = {codec.signals[index][1].name for index in np.flatnonzero(noise_of_cycles(noise, codec).any(axis=0))}
    assert {name.rsplit("_", 1)[-1].rstrip("XYZ") for name in noisy} == {"Torque", "Gyro", "Accel", "Force"}


def test_imu_noise_parameters_do_not_change_the_noise_of_other_signals(make: Make) -> None:
    (usual, codec), (louder, _) = make(3), make(3, dataclasses.replace(ImuParameters(), gyro_noise=1.0))
    one, other = noise_of_cycles(usual, codec), noise_of_cycles(louder, codec)
    for quantity in ("Torque", "Force", "Accel"):
        assert one[:, codec.slice(quantity)].tobytes() == other[:, codec.slice(quantity)].tobytes()
    assert other[:, codec.slice("Gyro")].std() > 50 * one[:, codec.slice("Gyro")].std()


class TestAttitudeError:
    parameters = dataclasses.replace(ImuParameters(), attitude_error=0.004, attitude_time=2.0, heading_drift=1e-3)

    def estimated(self, make: Make, seed: int, seconds: float, parameters: ImuParameters | None = None) -> np.ndarray:
        """Return the rotation vectors from the true to the estimated attitude of the four IMUs, in world axes.

        Shape (n, 4, 3).
        """
        noise, codec = make(seed, parameters or self.parameters)
        where, truth = codec.slice("Quaternion"), np.zeros(codec.size)
        rng = np.random.default_rng(1)
        attitude = rng.normal(size=(4, 4))
        attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
        attitude *= np.sign(attitude[:, :1])
        truth[where] = attitude.reshape(-1)
        errors = []
        for cycle in range(round(seconds * 1000)):
            if cycle % NOISE_CYCLES == 0:
                noise.draw()
            noisy = np.zeros(codec.size)
            noise.add(cycle, truth, noisy)
            if cycle % 16 == 0:
                found = noisy[where].reshape(4, 4)
                assert (found[:, 0] >= 0.0).all()
                np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
                w, x, y, z = attitude.T
                a, b, c, d = found.T
                vector = [
                    -a * x + b * w - c * z + d * y,
                    -a * y + b * z + c * w - d * x,
                    -a * z - b * y + c * x + d * w,
                ]
                errors.append(2.0 * np.array(vector).T * np.sign(a * w + b * x + c * y + d * z)[:, None])
        return np.array(errors)

    def test_without_errors_the_attitude_is_exact(self, make: Make) -> None:
        assert np.abs(self.estimated(make, 3, 0.3, ImuParameters())).max() < 1e-12

    def test_errors_are_reproducible_slow_and_of_the_configured_size(self, make: Make) -> None:
        errors = self.estimated(make, 3, 60.0)
        assert errors.tobytes() == self.estimated(make, 3, 60.0).tobytes()
        assert errors.tobytes() != self.estimated(make, 4, 60.0).tobytes()
        assert 0.0025 < errors[:, :, :2].std() < 0.0055
        assert np.abs(np.diff(errors, axis=0)).max() < 0.001  # rad in 16 ms

    def test_heading_drifts_and_tilt_does_not(self, make: Make) -> None:
        drifting = dataclasses.replace(self.parameters, attitude_error=0.0)
        errors = self.estimated(make, 3, 20.0, drifting)
        assert np.abs(errors[:, :, :2]).max() < 1e-12
        rate = errors[-1, :, 2] / 20.0
        np.testing.assert_allclose(
            errors[:, :, 2], np.linspace(0.0, 1.0, len(errors))[:, None] * errors[-1, :, 2], atol=4e-4
        )
        assert 1e-4 < np.abs(rate).max() < 4e-3

    def test_other_noise_does_not_depend_on_the_attitude_error(self, make: Make) -> None:
        measured = []
        for parameters in (ImuParameters(), self.parameters):
            noise, codec = make(3, parameters)
            truth, noisy = np.zeros(codec.size), np.zeros((2 * NOISE_CYCLES, codec.size))
            truth[codec.slice("Quaternion")] = [1.0, 0.0, 0.0, 0.0] * 4
            for cycle, values in enumerate(noisy):
                if cycle % NOISE_CYCLES == 0:
                    noise.draw()
                noise.add(cycle, truth, values)
            measured.append(noisy)
        for quantity in ("Torque", "Force", "Accel", "Gyro"):
            plain, other = (noisy[:, codec.slice(quantity)].tobytes() for noisy in measured)
            assert plain == other
        assert (measured[0] != measured[1]).any()
