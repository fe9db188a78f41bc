from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_emulator.haptics import WATCHDOG, Haptics, HapticsParameters
from atalante_hal.types import PERIOD

RISE = HapticsParameters().rise_time
LEVEL = np.array([0.0, 0.25, 0.5, 1.0, 0.0, 0.0, 0.75, 0.1])


def test_step_response_is_first_order() -> None:
    motors = Haptics(HapticsParameters(), np.zeros(8))
    for n in range(1, 30):
        motors.advance(LEVEL, 0, 10)
        np.testing.assert_allclose(motors.amplitude, LEVEL * (1.0 - math.exp(-n * 10 * PERIOD / RISE)), rtol=1e-12)


@pytest.mark.parametrize("split", [(30,), (10, 20), (1,) * 30])
def test_response_does_not_depend_on_the_step_length(split: tuple[int, ...]) -> None:
    motors = Haptics(HapticsParameters(), np.full(8, 0.3))
    for cycles in split:
        motors.advance(LEVEL, 0, cycles)
    lag = math.exp(-30 * PERIOD / RISE)
    np.testing.assert_allclose(motors.amplitude, LEVEL + lag * (0.3 - LEVEL), rtol=1e-12)


def test_amplitude_stays_between_zero_and_one() -> None:
    rng = np.random.default_rng(0)
    motors = Haptics(HapticsParameters(), np.zeros(8))
    for _ in range(500):
        motors.advance(rng.integers(0, 2, 8).astype(float), 0, int(rng.integers(1, 40)))
        assert (motors.amplitude >= 0.0).all()
        assert (motors.amplitude <= 1.0).all()


def test_motors_stop_while_the_node_is_in_reset() -> None:
    motors = Haptics(HapticsParameters(), np.ones(8))
    for _ in range(100):
        motors.reset()
        motors.advance(LEVEL, 0, 10)
    np.testing.assert_allclose(motors.amplitude, 0.0, atol=1e-9)
    for _ in range(100):
        motors.advance(LEVEL, 0, 10)
    np.testing.assert_allclose(motors.amplitude, LEVEL, atol=1e-9)


def test_motors_stop_when_commands_time_out() -> None:
    motors = Haptics(HapticsParameters(), np.ones(8))
    motors.advance(LEVEL + 1.0, WATCHDOG - 1, 10)
    assert (motors.amplitude >= 1.0).all()
    for _ in range(100):
        motors.advance(LEVEL, WATCHDOG, 10)
    np.testing.assert_allclose(motors.amplitude, 0.0, atol=1e-9)
