from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from atalante_emulator.body import PERIOD
from atalante_emulator.drive import (
    COMMUNICATION_ERROR,
    COUNTS,
    TEMPERATURE_ERROR,
    THERMAL_CYCLES,
    WATCHDOG,
    DriveParameters,
    Drives,
    DriveSignals,
    Emergency,
)
from atalante_hal.cia402 import Controlword, DriveState, controlword_towards_operation
from atalante_hal.robot import Robot, load_robot

ROBOT = load_robot()
SMOOTH = DriveParameters(coulomb=(0.0,) * 6, viscous=(0.0,) * 6)
BOTH = (True, True)


@dataclass
class Bench:
    """Drives on a bench: somebody else turns the joints."""

    parameters: DriveParameters = field(default_factory=DriveParameters)
    robot: Robot = ROBOT

    def __post_init__(self) -> None:
        self.signals = DriveSignals(*np.zeros((5, 12)))
        self.drives = Drives(self.robot, self.parameters, self.signals)
        self.position, self.velocity = np.zeros(12), np.zeros(12)
        self.word = np.full(12, float(Controlword.DISABLE_VOLTAGE))
        self.target, self.limit = np.zeros(12), np.full(12, 800.0)

    def cycle(self, fresh: tuple[bool, bool] = BOTH) -> np.ndarray:
        self.drives.sample(self.position)
        self.drives.command(fresh, self.word, self.target, self.limit)
        return np.array(self.drives.drive(self.velocity))

    def enable(self) -> None:
        for _ in range(3):
            self.word[:] = [controlword_towards_operation(state) for state in self.drives.state]
            self.cycle()
        assert set(self.drives.state) == {DriveState.OPERATION_ENABLED}


@pytest.fixture
def bench() -> Bench:
    return Bench()


def states(bench: Bench) -> set[DriveState]:
    assert bench.signals.state.tolist() == bench.drives.state
    return set(bench.drives.state)


def test_cia402_walk_up_one_state_a_cycle_and_down(bench: Bench) -> None:
    seen = [states(bench)]
    for word in (
        Controlword.SHUTDOWN,
        Controlword.SWITCH_ON,
        Controlword.ENABLE_OPERATION,
        Controlword.DISABLE_VOLTAGE,
    ):
        bench.word[:] = word
        bench.cycle()
        bench.cycle()
        seen.append(states(bench))
    assert seen == [
        {DriveState.SWITCH_ON_DISABLED},
        {DriveState.READY_TO_SWITCH_ON},
        {DriveState.SWITCHED_ON},
        {DriveState.OPERATION_ENABLED},
        {DriveState.SWITCH_ON_DISABLED},
    ]


def test_a_drive_obeys_its_own_controlword(bench: Bench) -> None:
    bench.enable()
    bench.word[4] = Controlword.QUICK_STOP
    bench.cycle()
    assert [i for i, s in enumerate(bench.drives.state) if s is DriveState.QUICK_STOP_ACTIVE] == [4]
    assert not any(bench.drives.latched)


def test_without_operation_enabled_there_is_no_torque() -> None:
    bench = Bench(SMOOTH)
    bench.target[:] = 50.0
    for word in (Controlword.DISABLE_VOLTAGE, Controlword.SHUTDOWN, Controlword.SWITCH_ON):
        bench.word[:] = word
        assert not bench.cycle().any()


def test_disabled_drives_still_rub(bench: Bench) -> None:
    bench.velocity[:] = 1.0
    p = bench.parameters
    expected = -(np.array(p.coulomb * 2) * math.tanh(1.0 / p.friction_speed) + np.array(p.viscous * 2))
    np.testing.assert_allclose(bench.cycle(), expected)


@pytest.mark.parametrize("speed", [-3.0, -0.01, 0.0, 0.002, 1.5])
def test_friction_takes_power_and_never_gives_it(bench: Bench, speed: float) -> None:
    bench.velocity[:] = speed
    power = bench.cycle() * speed
    assert (power < 0).all() if speed else not power.any()


def test_torque_follows_as_a_first_order_lag() -> None:
    bench = Bench(SMOOTH)
    bench.enable()
    bench.target[:] = 20.0
    for n in range(1, 6):
        expected = 20.0 * (1.0 - math.exp(-n * PERIOD / SMOOTH.current_loop))
        np.testing.assert_allclose(bench.cycle(), expected, rtol=1e-12)
    bench.drives.sample(bench.position)
    np.testing.assert_allclose(bench.signals.torque, expected, rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_stays_inside_both_limits(sign: float) -> None:
    bench = Bench(SMOOTH)
    bench.enable()
    bench.target[:] = sign * 1e4
    bench.limit[:6] = 15.0
    for _ in range(30):
        torque = bench.cycle()
        assert (np.abs(torque) <= np.r_[np.full(6, 15.0), ROBOT.torque_max[6:]]).all()
    np.testing.assert_allclose(sign * torque, np.r_[np.full(6, 15.0), ROBOT.torque_max[6:]], rtol=1e-6)


def test_watchdog_trips_at_exactly_the_fifth_cycle_without_command(bench: Bench) -> None:
    bench.enable()
    for _ in range(WATCHDOG - 1):
        bench.cycle((False, False))
        assert states(bench) == {DriveState.OPERATION_ENABLED}
    bench.cycle()
    for _ in range(WATCHDOG - 1):
        bench.cycle((False, False))
    assert states(bench) == {DriveState.OPERATION_ENABLED}
    bench.cycle((False, False))
    assert states(bench) == {DriveState.QUICK_STOP_ACTIVE}
    assert all(bench.drives.latched)
    assert bench.drives.emergencies == [Emergency(drive, *COMMUNICATION_ERROR) for drive in range(12)]


def test_lost_commands_below_the_watchdog_repeat_the_last(bench: Bench) -> None:
    bench = Bench(SMOOTH)
    bench.enable()
    bench.target[:] = 12.0
    for _ in range(10):
        bench.cycle()
    for _ in range(WATCHDOG - 1):
        np.testing.assert_allclose(bench.cycle((False, False)), 12.0, rtol=1e-6)


def test_a_silent_leg_holds_alone(bench: Bench) -> None:
    bench.enable()
    for _ in range(WATCHDOG):
        bench.cycle((True, False))
    assert set(bench.drives.state[:6]) == {DriveState.OPERATION_ENABLED}
    assert set(bench.drives.state[6:]) == {DriveState.QUICK_STOP_ACTIVE}


def test_watchdog_leaves_drives_alone_that_are_not_enabled(bench: Bench) -> None:
    for _ in range(3 * WATCHDOG):
        bench.cycle((False, False))
    assert states(bench) == {DriveState.SWITCH_ON_DISABLED}
    assert not bench.drives.emergencies


def test_latch_needs_quick_stop_before_enable(bench: Bench) -> None:
    bench.enable()
    for _ in range(WATCHDOG):
        bench.cycle((False, False))
    for _ in range(20):  # a HAL that noticed nothing
        bench.cycle()
    assert states(bench) == {DriveState.QUICK_STOP_ACTIVE}
    bench.word[:] = Controlword.QUICK_STOP
    bench.cycle()
    assert states(bench) == {DriveState.QUICK_STOP_ACTIVE}
    assert not any(bench.drives.latched)
    bench.word[:] = Controlword.ENABLE_OPERATION
    bench.cycle()
    assert states(bench) == {DriveState.OPERATION_ENABLED}


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_hold_pulls_back_to_where_it_stopped(polarity: float) -> None:
    robot = dataclasses.replace(ROBOT, polarity=np.full(12, polarity))
    bench = Bench(SMOOTH, robot)
    bench.position[:] = 0.1
    bench.enable()
    bench.word[:] = Controlword.QUICK_STOP
    bench.target[:] = -40.0  # means nothing in a hold
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, 0.0, atol=0.01)
    bench.position[:] = 0.11
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, -0.01 * robot.hold_kp, rtol=2e-3)
    bench.position[:] = -3.0
    for _ in range(60):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, robot.torque_max, rtol=1e-6)


def test_hold_damps_motion() -> None:
    bench = Bench(SMOOTH)
    bench.enable()
    bench.word[:] = Controlword.QUICK_STOP
    bench.cycle()
    speed = 0.2
    for _ in range(30):
        bench.position += speed * PERIOD
        torque = bench.cycle()
    stretched = torque + ROBOT.hold_kp * bench.position
    np.testing.assert_allclose(stretched, -speed * ROBOT.hold_kd, rtol=0.1)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_encoder_is_quantised_at_the_motor(polarity: float) -> None:
    robot = dataclasses.replace(ROBOT, polarity=np.full(12, polarity))
    bench = Bench(robot=robot)
    rng = np.random.default_rng(2)
    lsb = 2.0 * math.pi / COUNTS
    for _ in range(100):
        bench.position[:] = rng.uniform(robot.position_min, robot.position_max)
        bench.cycle()
        counts = bench.signals.position / lsb
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
        error = bench.signals.position - bench.position * robot.gear * polarity
        assert np.abs(error).max() <= 0.5001 * lsb


def test_velocity_estimate_is_an_80_hz_low_pass_of_the_encoder(bench: Bench) -> None:
    speed, lsb = 1.0, 2.0 * math.pi / COUNTS
    bench.cycle()
    assert not bench.signals.velocity.any()
    for n in range(1, 40):
        bench.position += speed * PERIOD
        bench.cycle()
        expected = speed * ROBOT.gear * (1.0 - math.exp(-2.0 * math.pi * 80.0 * n * PERIOD))
        np.testing.assert_allclose(bench.signals.velocity, expected, atol=lsb / PERIOD)


def test_a_joint_that_stands_somewhere_at_switch_on_does_not_seem_to_jump() -> None:
    bench = Bench()
    bench.position[:] = 0.3
    bench.cycle()
    assert not bench.signals.velocity.any()


def test_winding_temperature_follows_the_closed_form() -> None:
    bench = Bench(SMOOTH)
    bench.enable()
    torque = 0.3 * ROBOT.torque_max
    bench.target[:] = torque
    cycles = 400 * THERMAL_CYCLES
    for _ in range(cycles):
        bench.cycle()
    final = SMOOTH.heating * (torque / (0.5 * ROBOT.torque_max)) ** 2
    expected = SMOOTH.ambient + final * (1.0 - math.exp(-cycles * PERIOD / SMOOTH.thermal_time))
    np.testing.assert_allclose(bench.signals.temperature, expected, rtol=1e-3)


def test_a_hot_drive_switches_itself_off_and_tells() -> None:
    bench = Bench(dataclasses.replace(SMOOTH, thermal_time=2.0, trip_temperature=40.0))
    bench.enable()
    bench.target[3] = 150.0
    for _ in range(20 * THERMAL_CYCLES):
        torque = bench.cycle()
    assert [s is DriveState.FAULT for s in bench.drives.state] == [d == 3 for d in range(12)]
    assert bench.drives.emergencies == [Emergency(3, *TEMPERATURE_ERROR)]
    assert torque[3] == pytest.approx(0.0, abs=1e-6)
    bench.word[3] = Controlword.FAULT_RESET
    bench.cycle()
    assert bench.drives.state[3] is DriveState.SWITCH_ON_DISABLED
    for _ in range(2 * THERMAL_CYCLES):
        bench.cycle()
    hot = bench.signals.temperature[3] >= 40.0
    assert (bench.drives.emergencies[-1].code, len(bench.drives.emergencies)) == (TEMPERATURE_ERROR[1], 1 + hot)


def test_torque_noise_is_seeded_and_of_the_stated_size(bench: Bench) -> None:
    first, again, other = np.zeros((3, 500, 12))
    bench.drives.draw_noise(np.random.default_rng(1), first)
    bench.drives.draw_noise(np.random.default_rng(1), again)
    bench.drives.draw_noise(np.random.default_rng(2), other)
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert first.std() == pytest.approx(DriveParameters().torque_noise, rel=0.05)
