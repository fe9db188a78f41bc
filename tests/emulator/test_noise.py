from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.drive import DriveParameters, Drives, DriveSignals
from atalante_emulator.foot import Feet, FootParameters
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_emulator.noise import NOISE_CYCLES, SensorNoise
from atalante_hal.robot import Robot
from atalante_hal.wire.codec import Codec

Make = Callable[..., tuple[SensorNoise, Codec]]


@pytest.fixture
def make(network: Network, robot: Robot) -> Make:
    codec = Codec([m for m in network.messages if m.cycle_ms == 1 and m.sender not in ("HAL", "PENDANT")])

    def build(seed: int, imu: ImuParameters | None = None) -> tuple[SensorNoise, Codec]:
        drives = Drives(robot, DriveParameters(), DriveSignals(*np.zeros((5, 12))))
        imus = Imus(imu or ImuParameters(), ImuSignals(np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((4, 3))))
        feet = Feet(FootParameters(), np.zeros((2, 4, 3)))
        return SensorNoise(seed, codec, drives, imus, feet), codec

    return build


def drawn(noise: SensorNoise, codec: Codec, times: int = 1) -> np.ndarray:
    said = np.zeros((times * NOISE_CYCLES, codec.size))
    for cycle, values in enumerate(said):
        if cycle % NOISE_CYCLES == 0:
            noise.draw()
        noise.add(cycle, np.zeros(codec.size), values)
    return said


def test_one_seed_one_noise(make: Make) -> None:
    first, again, other = (drawn(*make(seed), 2) for seed in (1, 1, 2))
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert first[:NOISE_CYCLES].tobytes() != first[NOISE_CYCLES:].tobytes()


def test_is_added_to_the_truth(make: Make) -> None:
    noise, codec = make(0)
    noise.draw()
    truth, (silent, said) = np.arange(codec.size, dtype=float), np.zeros((2, codec.size))
    noise.add(7, np.zeros(codec.size), silent)
    noise.add(7, truth, said)
    assert said.tolist() == (truth + silent).tolist()


def test_only_what_is_measured_is_noisy(make: Make) -> None:
    noise, codec = make(0)
    noisy = {codec.signals[place][1].name for place in np.flatnonzero(drawn(noise, codec).any(axis=0))}
    assert {name.rsplit("_", 1)[-1].rstrip("XYZ") for name in noisy} == {"Torque", "Gyro", "Accel", "Force"}


def test_another_imu_changes_nothing_for_the_others(make: Make) -> None:
    (usual, codec), (louder, _) = make(3), make(3, dataclasses.replace(ImuParameters(), gyro_noise=1.0))
    one, other = drawn(usual, codec), drawn(louder, codec)
    for quantity in ("Torque", "Force", "Accel"):
        assert one[:, codec.slice(quantity)].tobytes() == other[:, codec.slice(quantity)].tobytes()
    assert other[:, codec.slice("Gyro")].std() > 50 * one[:, codec.slice("Gyro")].std()
