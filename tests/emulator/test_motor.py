from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from atalante_emulator.motor import MOST_LATE, MotorParameters, Motors
from atalante_hal.robot import Robot
from atalante_hal.types import PERIOD

SMOOTH = MotorParameters(coulomb=(0.0,) * 6, viscous=(0.0,) * 6)
POWERED, UNPOWERED = np.ones(12, np.bool_), np.zeros(12, np.bool_)
AT_REST = np.zeros(12)


@pytest.fixture
def motors(robot: Robot) -> Motors:
    return Motors(robot, SMOOTH, *np.zeros((2, 12)))


def settle(motors: Motors, velocity: np.ndarray = AT_REST) -> np.ndarray:
    for _ in range(30):
        torque = motors.advance(velocity)
    return np.array(torque)


def test_delay_that_begins_keeps_the_torque_until_the_first_delayed_setpoint(motors: Motors) -> None:
    motors.power(POWERED)
    for setpoint in (20.0, -10.0):  # the second delay must not repeat setpoints from before the first one
        motors.wanted[:] = setpoint
        settle(motors)
        motors.delay(3, 8)
        for cycle in range(30):
            motors.wanted[:] = setpoint + 5.0
            torque = motors.advance(AT_REST)
            assert torque[2] > setpoint
            assert torque[3] == pytest.approx(setpoint) if cycle < 8 else torque[3] > setpoint
        motors.delay(3, 0)
        motors.wanted[:] = setpoint - 5.0
        assert motors.advance(AT_REST)[3] < setpoint + 5.0


def test_torque_follows_its_setpoint_as_a_first_order_lag(robot: Robot) -> None:
    measured = np.zeros(12)
    motors = Motors(robot, SMOOTH, measured, np.zeros(12))
    motors.power(POWERED)
    motors.wanted[:] = 20.0
    for n in range(1, 6):
        expected = 20.0 * (1.0 - math.exp(-n * PERIOD / SMOOTH.current_loop))
        np.testing.assert_allclose(motors.advance(AT_REST), expected, rtol=1e-12)
        np.testing.assert_allclose(measured, expected, rtol=1e-12)


@pytest.mark.parametrize("speed", [-3.0, -0.01, 0.0, 0.002, 1.5])
@pytest.mark.parametrize("powered", [POWERED, UNPOWERED], ids=["powered", "braked"])
def test_friction_and_brake_always_oppose_the_motion(robot: Robot, powered: np.ndarray, speed: float) -> None:
    motors = Motors(robot, MotorParameters(), *np.zeros((2, 12)))
    motors.power(powered)
    power = np.array(motors.advance(np.full(12, speed))) * speed
    assert (power < 0.0).all() if speed else not power.any()


def test_brake_torque_acts_only_on_an_unpowered_motor(motors: Motors) -> None:
    motors.power(np.arange(12) != 3)
    torque = np.array(motors.advance(np.full(12, 0.5)))
    assert torque[3] == pytest.approx(-0.5 * SMOOTH.brake[3])
    assert not np.delete(torque, 3).any()
    motors.power(POWERED)
    assert not np.array(motors.advance(np.full(12, 0.5))).any()


def test_weak_motor_makes_less_torque_than_it_measures(robot: Robot) -> None:
    measured = np.zeros(12)
    motors = Motors(robot, SMOOTH, measured, np.zeros(12))
    motors.power(POWERED)
    motors.set_strength(2, 0.25)
    motors.wanted[:] = 40.0
    np.testing.assert_allclose(settle(motors), [40.0, 40.0, 10.0] + [40.0] * 9, rtol=1e-6)
    np.testing.assert_allclose(measured, 40.0, rtol=1e-6)
    motors.set_strength(2, 1.0)
    np.testing.assert_allclose(settle(motors), 40.0, rtol=1e-6)


@pytest.mark.parametrize("dead_time", [0, 1, 3])
def test_torque_is_late_by_its_dead_time_and_its_additional_delay(robot: Robot, dead_time: int) -> None:
    motors = Motors(robot, replace(SMOOTH, dead_time=dead_time), *np.zeros((2, 12)))
    motors.power(POWERED)
    motors.delay(4, MOST_LATE)
    for cycle in range(30):
        motors.wanted[:] = 10.0 * (cycle + 1)
        torque = np.array(motors.advance(AT_REST))
        assert bool(torque[3]) == (cycle >= dead_time)
        assert bool(torque[4]) == (cycle >= dead_time + MOST_LATE)


def test_push_acts_on_the_joint_and_is_not_measured(robot: Robot) -> None:
    measured = np.zeros(12)
    motors = Motors(robot, SMOOTH, measured, np.zeros(12))
    motors.push(5, 30.0)
    motors.push(6, -10.0)
    np.testing.assert_allclose(motors.advance(AT_REST), [0.0] * 5 + [30.0, -10.0] + [0.0] * 5)
    motors.push(5, 0.0)
    np.testing.assert_allclose(motors.advance(AT_REST), [0.0] * 6 + [-10.0] + [0.0] * 5)
    motors.push(6, 0.0)
    assert not any(motors.advance(AT_REST))
    assert not measured.any()


def test_temperature_rises_with_torque_squared_and_time(robot: Robot) -> None:
    motors = Motors(robot, SMOOTH, *np.zeros((2, 12)))
    assert set(motors.temperature) == {SMOOTH.ambient}
    motors.power(POWERED)
    motors.wanted[:] = 0.5 * robot.torque_max
    motors.wanted[0] *= 0.5
    settle(motors)
    motors.warm(3.0)
    rise = SMOOTH.heating * 3.0 / SMOOTH.thermal_time
    np.testing.assert_allclose(motors.temperature - SMOOTH.ambient, [0.25 * rise] + [rise] * 11, rtol=1e-6)
    motors.warm(0.0)
    np.testing.assert_allclose(motors.temperature - SMOOTH.ambient, [0.25 * rise] + [rise] * 11, rtol=1e-6)
