from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_emulator.supply import COPPER, IDLE, HoldUp
from atalante_hal.robot import Robot
from atalante_hal.types import PERIOD

ZERO = np.zeros(12)


def energy(capacity: float, voltage: float) -> float:
    return 0.5 * capacity * voltage**2


def test_voltage_falls_with_the_idle_power_when_no_motor_works(robot: Robot) -> None:
    link = HoldUp(robot, 0.1, 48.0)
    for n in range(1, 200):
        left = energy(0.1, 48.0) - n * IDLE * PERIOD
        assert link.draw(ZERO, ZERO) == pytest.approx(math.sqrt(2.0 * left / 0.1))


@pytest.mark.parametrize(("torque", "speed", "power"), [(10.0, 2.0, 20.0), (-10.0, -2.0, 20.0), (10.0, -2.0, 0.0)])
def test_motoring_power_drains_the_charge_and_braking_returns_none(
    robot: Robot, torque: float, speed: float, power: float
) -> None:
    link, torques, speeds = HoldUp(robot, 0.1, 48.0), ZERO.copy(), ZERO.copy()
    torques[3], speeds[3] = torque, speed
    copper = COPPER * (torque / robot.torque_max[3]) ** 2
    left = energy(0.1, 48.0) - (IDLE + power + copper) * PERIOD
    assert energy(0.1, link.draw(torques, speeds)) == pytest.approx(left)


def test_voltage_falls_to_zero_and_never_below(robot: Robot) -> None:
    link = HoldUp(robot, 1e-3, 48.0)
    volts = [link.draw(robot.torque_max, ZERO) for _ in range(10)]
    assert volts == sorted(volts, reverse=True)
    assert volts[-1] == 0.0
