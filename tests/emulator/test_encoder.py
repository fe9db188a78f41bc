from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from atalante_emulator.encoder import COUNTS, Encoders
from atalante_hal.robot import Robot
from atalante_hal.types import PERIOD

LSB = 2.0 * math.pi / COUNTS  # rad at the motor


class EncoderBench:
    def __init__(self, robot: Robot, bandwidth: float = 80.0) -> None:
        self.position, self.velocity = np.zeros((2, 12))
        self.encoders = Encoders(robot, bandwidth, self.position, self.velocity)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_position_is_quantised_in_counts_at_the_motor(robot: Robot, polarity: float) -> None:
    robot = dataclasses.replace(robot, polarity=np.full(12, polarity))
    bench, rng = EncoderBench(robot), np.random.default_rng(2)
    for _ in range(100):
        joints = rng.uniform(robot.position_min, robot.position_max)
        bench.encoders.sample(joints)
        counts = bench.position / LSB
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
        assert np.abs(bench.position - joints * robot.gear * polarity).max() <= 0.5001 * LSB
        assert np.abs(bench.encoders.angle - joints).max() <= 0.5001 * LSB / robot.gear.min()


@pytest.mark.parametrize("bandwidth", [40.0, 80.0])
def test_velocity_estimate_is_a_low_pass_of_the_encoder(robot: Robot, bandwidth: float) -> None:
    bench, speed, position = EncoderBench(robot, bandwidth), 1.0, np.zeros(12)
    bench.encoders.sample(position)
    assert not bench.velocity.any()
    for n in range(1, 40):
        position += speed * PERIOD
        bench.encoders.sample(position)
        expected = speed * robot.gear * (1.0 - math.exp(-2.0 * math.pi * bandwidth * n * PERIOD))
        np.testing.assert_allclose(bench.velocity, expected, atol=LSB / PERIOD)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_unfiltered_speed_has_no_lag(robot: Robot, polarity: float) -> None:
    bench = EncoderBench(dataclasses.replace(robot, polarity=np.full(12, polarity)))
    for position in (0.1, 0.1, 0.102):
        bench.encoders.sample(np.full(12, position))
    np.testing.assert_allclose(bench.encoders.speed, 2.0, atol=1.01 * LSB / robot.gear.min() / PERIOD)
    assert np.abs(bench.velocity / (robot.gear * polarity)).max() < 1.0


def test_velocity_is_zero_in_the_first_sample_at_any_position(robot: Robot) -> None:
    bench = EncoderBench(robot)
    bench.encoders.sample(np.full(12, 0.3))
    assert not bench.velocity.any()
    assert not bench.encoders.speed.any()
