from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from atalante_emulator import emergency
from atalante_emulator.drive import NODES, SLOW_CYCLES, WATCHDOG, DriveParameters, Drives, DriveSignals
from atalante_emulator.emergency import Emergency
from atalante_emulator.encoder import COUNTS
from atalante_emulator.motor import MotorParameters
from atalante_hal.robot import Robot, load_robot
from atalante_hal.types import PERIOD
from atalante_hal.wire.cia402 import Controlword, DriveState, controlword_towards_operation

ROBOT = load_robot()
SMOOTH_MOTOR = MotorParameters(coulomb=(0.0,) * 6, viscous=(0.0,) * 6)
SMOOTH = DriveParameters(SMOOTH_MOTOR)
BOTH = (True, True)


@dataclass
class DriveBench:
    """Drives without a body: the test sets positions and velocities of the joints."""

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

    def move(self, position: float) -> None:
        """Move all joints to a position, slowly enough that the drives do not take the motion for an encoder jump."""
        step = 0.5 * self.parameters.jump_speed * PERIOD
        for _ in range(math.ceil(np.abs(position - self.position).max() / step)):
            self.position += np.clip(position - self.position, -step, step)
            self.cycle()

    def enable(self) -> None:
        for _ in range(3):
            self.word[:] = [controlword_towards_operation(state) for state in self.drives.state]
            self.cycle()
        assert set(self.drives.state) == {DriveState.OPERATION_ENABLED}


@pytest.fixture
def bench() -> DriveBench:
    return DriveBench()


def states(bench: DriveBench) -> set[DriveState]:
    assert bench.signals.state.tolist() == bench.drives.state
    return set(bench.drives.state)


def test_each_controlword_moves_all_drives_by_one_transition(bench: DriveBench) -> None:
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


def test_controlword_changes_only_its_own_drive(bench: DriveBench) -> None:
    bench.enable()
    bench.word[4] = Controlword.QUICK_STOP
    bench.cycle()
    assert [i for i, s in enumerate(bench.drives.state) if s is DriveState.QUICK_STOP_ACTIVE] == [4]
    assert bench.signals.state.tolist() == bench.drives.state
    assert not any(bench.drives.latched)


def test_torque_is_zero_before_operation_is_enabled() -> None:
    bench = DriveBench(SMOOTH)
    bench.target[:] = 50.0
    for word in (Controlword.DISABLE_VOLTAGE, Controlword.SHUTDOWN, Controlword.SWITCH_ON):
        bench.word[:] = word
        assert not bench.cycle().any()


def test_hold_before_the_first_sample_of_the_encoder_begins_at_the_first_sample() -> None:
    bench = DriveBench(SMOOTH)
    bench.position[:] = 0.1
    bench.drives.leave(3, DriveState.QUICK_STOP_ACTIVE)
    bench.word[3] = Controlword.QUICK_STOP
    for _ in range(5):
        assert not bench.cycle().any()
    bench.position[3] += 0.001
    bench.cycle()
    torque = [bench.cycle() for _ in range(20)][-1]
    assert torque[3] == pytest.approx(-0.001 * ROBOT.hold_kp[3], rel=0.02)
    assert not np.delete(torque, 3).any()


def test_hold_without_any_encoder_sample_has_no_torque() -> None:
    bench = DriveBench(SMOOTH)
    bench.drives.leave(3, DriveState.QUICK_STOP_ACTIVE)
    assert [bench.drives.drive(bench.velocity) for _ in range(5)] == [[0.0] * 12] * 5


def test_hold_brakes_a_moving_joint_in_its_first_cycle() -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    for word in (*[Controlword.ENABLE_OPERATION] * 5, Controlword.QUICK_STOP):
        bench.position[4] += 0.0005
        bench.word[4] = word
        torque = bench.cycle()
    assert bench.drives.state[4] is DriveState.QUICK_STOP_ACTIVE
    assert torque[4] < -1.0


def test_unpowered_drive_has_friction_and_brake_torque(bench: DriveBench) -> None:
    bench.velocity[:] = 1.0
    p = bench.parameters.motor
    expected = -(np.array(p.coulomb * 2) * math.tanh(1.0 / p.friction_speed) + np.array(p.viscous * 2))
    expected -= np.array(p.brake * 2)
    np.testing.assert_allclose(bench.cycle(), expected)


@pytest.mark.parametrize("speed", [-3.0, -0.01, 0.0, 0.002, 1.5])
def test_friction_always_opposes_the_motion(bench: DriveBench, speed: float) -> None:
    bench.velocity[:] = speed
    power = bench.cycle() * speed
    assert (power < 0).all() if speed else not power.any()


def test_torque_follows_its_target_as_a_first_order_lag() -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.target[:] = 20.0
    for n in range(1, 6):
        expected = 20.0 * (1.0 - math.exp(-n * PERIOD / SMOOTH_MOTOR.current_loop))
        np.testing.assert_allclose(bench.cycle(), expected, rtol=1e-12)
    bench.drives.sample(bench.position)
    np.testing.assert_allclose(bench.signals.torque, expected, rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_stays_within_commanded_and_joint_limits(sign: float) -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.target[:] = sign * 1e4
    bench.limit[:6] = 15.0
    for _ in range(30):
        torque = bench.cycle()
        assert (np.abs(torque) <= np.r_[np.full(6, 15.0), ROBOT.torque_max[6:]]).all()
    np.testing.assert_allclose(sign * torque, np.r_[np.full(6, 15.0), ROBOT.torque_max[6:]], rtol=1e-6)


def test_watchdog_trips_in_the_fifth_cycle_without_command(bench: DriveBench) -> None:
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
    assert bench.drives.emergencies == [Emergency(node, 0x11, 0x8250) for node in NODES]


def test_watchdog_counts_the_delay_of_a_late_command(bench: DriveBench) -> None:
    bench.enable()
    bench.drives.command(BOTH, bench.word, bench.target, bench.limit, (0, WATCHDOG - 1))
    assert states(bench) == {DriveState.OPERATION_ENABLED}
    bench.cycle((False, False))
    assert bench.drives.state == [DriveState.OPERATION_ENABLED] * 6 + [DriveState.QUICK_STOP_ACTIVE] * 6
    bench.drives.command((True, False), bench.word, bench.target, bench.limit, (1, 0))
    for _ in range(WATCHDOG - 1):
        assert bench.drives.state[0] is DriveState.OPERATION_ENABLED
        bench.cycle((False, False))
    assert states(bench) == {DriveState.QUICK_STOP_ACTIVE}


def test_last_torque_is_repeated_while_fewer_than_five_commands_are_lost(bench: DriveBench) -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.target[:] = 12.0
    for _ in range(10):
        bench.cycle()
    for _ in range(WATCHDOG - 1):
        np.testing.assert_allclose(bench.cycle((False, False)), 12.0, rtol=1e-6)


def test_only_the_leg_without_commands_holds(bench: DriveBench) -> None:
    bench.enable()
    for _ in range(WATCHDOG):
        bench.cycle((True, False))
    assert set(bench.drives.state[:6]) == {DriveState.OPERATION_ENABLED}
    assert set(bench.drives.state[6:]) == {DriveState.QUICK_STOP_ACTIVE}


def test_watchdog_does_not_trip_drives_that_are_not_enabled(bench: DriveBench) -> None:
    for _ in range(3 * WATCHDOG):
        bench.cycle((False, False))
    assert states(bench) == {DriveState.SWITCH_ON_DISABLED}
    assert not bench.drives.emergencies


def test_latched_drive_needs_quick_stop_before_enable(bench: DriveBench) -> None:
    bench.enable()
    for _ in range(WATCHDOG):
        bench.cycle((False, False))
    for _ in range(20):  # the HAL continues to send ENABLE_OPERATION
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
def test_hold_torque_is_proportional_to_the_displacement_within_the_limit(polarity: float) -> None:
    robot = dataclasses.replace(ROBOT, polarity=np.full(12, polarity))
    bench = DriveBench(SMOOTH, robot)
    bench.position[:] = 0.1
    bench.enable()
    bench.word[:] = Controlword.QUICK_STOP
    bench.target[:] = -40.0  # ignored in a hold
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, 0.0, atol=0.01)
    bench.position[:] = 0.11
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, -0.01 * robot.hold_kp, rtol=2e-3)
    for end, sign in ((-3.0, 1.0), (3.0, -1.0)):
        bench.move(end)
        for _ in range(60):
            torque = bench.cycle()
        np.testing.assert_allclose(torque, sign * robot.torque_max, rtol=1e-6)


def test_hold_position_is_the_position_at_the_quick_stop() -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.position[:] = 0.2
    bench.cycle()
    bench.word[:] = Controlword.QUICK_STOP
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, 0.0, atol=0.02)


def test_torque_is_zero_before_the_first_command() -> None:
    bench = DriveBench(SMOOTH)
    bench.drives.sample(bench.position)
    assert bench.drives.drive(bench.velocity) == [0.0] * 12


def test_position_and_velocity_signals_are_at_the_motor(bench: DriveBench) -> None:
    bench.cycle()
    bench.position[:] = 0.05
    bench.cycle()
    np.testing.assert_allclose(bench.signals.position, 0.05 * ROBOT.gear * ROBOT.polarity, atol=1e-4)
    assert (bench.signals.velocity * ROBOT.polarity > 0.0).all()


@pytest.mark.parametrize("jump", [-1.0, -0.03, 0.03, 1.0])
def test_encoder_jump_during_a_hold_moves_the_setpoint_and_not_the_joint(jump: float) -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.move(0.2)
    bench.word[:] = Controlword.QUICK_STOP
    bench.cycle()
    bench.position[:] = 0.21
    for _ in range(30):
        before = bench.cycle()
    bench.position[:] = 0.21 + jump
    peaks = np.max([np.abs(np.array(bench.cycle()) - before) for _ in range(30)], axis=0)
    assert (peaks < 0.1).all()  # the resolution of the encoder
    np.testing.assert_allclose(before, -0.01 * ROBOT.hold_kp, rtol=0.02)


@pytest.mark.parametrize("jump", [-0.3, 0.3])
def test_hold_that_begins_with_an_encoder_jump_does_not_move_the_joint(jump: float) -> None:
    """The encoder jumps away and back. The hold begins in the cycle of the second jump."""
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.move(0.2)
    bench.position[:] = 0.2 + jump
    bench.cycle()
    bench.position[:] = 0.2
    bench.word[:] = Controlword.QUICK_STOP
    torques = [bench.cycle() for _ in range(30)]
    assert np.abs(torques).max() < 0.1  # the resolution of the encoder
    bench.position[:] = 0.21
    for _ in range(30):
        torque = bench.cycle()
    np.testing.assert_allclose(torque, -0.01 * ROBOT.hold_kp, rtol=0.02)


def test_drive_that_enters_quick_stop_again_keeps_its_hold_position() -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.word[:] = Controlword.QUICK_STOP
    bench.cycle()
    bench.position[:] = 0.01
    for _ in range(30):
        bench.drives.leave(3, DriveState.QUICK_STOP_ACTIVE)
        torque = bench.cycle()
    np.testing.assert_allclose(torque, -0.01 * ROBOT.hold_kp, rtol=0.02)


def test_hold_torque_opposes_the_velocity() -> None:
    bench = DriveBench(SMOOTH)
    bench.enable()
    bench.word[:] = Controlword.QUICK_STOP
    bench.cycle()
    speed = 0.2
    for _ in range(30):
        bench.position += speed * PERIOD
        torque = bench.cycle()
    stretched = torque + ROBOT.hold_kp * bench.position
    np.testing.assert_allclose(stretched, -speed * ROBOT.hold_kd, rtol=0.1)


def test_torque_noise_is_reproducible_and_has_the_configured_deviation(bench: DriveBench) -> None:
    first, again, other = np.zeros((3, 500, 12))
    bench.drives.draw_noise(np.random.default_rng(1), first)
    bench.drives.draw_noise(np.random.default_rng(1), again)
    bench.drives.draw_noise(np.random.default_rng(2), other)
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert first.std() == pytest.approx(DriveParameters().torque_noise, rel=0.05)


class TestHeat:
    """A drive heats up, reduces its torque when hot, and trips when too hot."""

    @pytest.mark.exhaustive
    def test_winding_temperature_follows_the_closed_form(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        torque = 0.3 * ROBOT.torque_max
        bench.target[:] = torque
        cycles = 400 * SLOW_CYCLES
        for _ in range(cycles):
            bench.cycle()
        final = SMOOTH_MOTOR.heating * (torque / (0.5 * ROBOT.torque_max)) ** 2
        expected = SMOOTH_MOTOR.ambient + final * (1.0 - math.exp(-cycles * PERIOD / SMOOTH_MOTOR.thermal_time))
        np.testing.assert_allclose(bench.signals.temperature, expected, rtol=1e-3)

    @pytest.mark.parametrize("degrees", [20.0, 89.0, 90.4, 91.0, 100.2, 115.0, 119.9])
    def test_torque_limit_follows_the_curve_at_the_reported_temperature(self, degrees: float) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.target[:] = 1e4
        bench.drives.heat(3, degrees)
        for _ in range(30):
            torque = bench.cycle()
        codes = np.full(12, SMOOTH_MOTOR.ambient)
        codes[3] = round(degrees)
        np.testing.assert_allclose(torque, ROBOT.torque_limit(codes), rtol=1e-6)

    def test_hot_drive_holds_with_its_derated_torque(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.drives.heat(3, 118.0)
        bench.word[:] = Controlword.QUICK_STOP
        bench.cycle()
        bench.move(-3.0)
        for _ in range(60):
            torque = bench.cycle()
        assert torque[3] == pytest.approx(ROBOT.derating.floor * ROBOT.torque_max[3])
        assert torque[2] == pytest.approx(ROBOT.torque_max[2])

    def test_every_hot_drive_is_derated(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.target[:] = 1e4
        for drive in range(12):
            bench.drives.heat(drive, 110.0)
        for _ in range(30):
            torque = bench.cycle()
        np.testing.assert_allclose(torque, ROBOT.torque_limit(np.full(12, 110.0)), rtol=1e-6)

    def test_cooled_drive_has_its_full_torque_again(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.target[:] = 1e4
        bench.drives.heat(3, 110.0)
        bench.cycle()
        bench.drives.heat(3, 60.0)
        for _ in range(30):
            torque = bench.cycle()
        np.testing.assert_allclose(torque, ROBOT.torque_max, rtol=1e-6)

    def test_overheating_trips_the_drive_in_a_slow_cycle(self) -> None:
        bench = DriveBench(DriveParameters(dataclasses.replace(SMOOTH_MOTOR, thermal_time=1.0, heating=600.0)))
        bench.enable()
        bench.target[3] = 0.5 * ROBOT.torque_max[3]
        seen = []
        for _ in range(10 * SLOW_CYCLES):
            bench.cycle()
            seen.append(bench.drives.state[3])
        tripped = 3 + seen.index(DriveState.FAULT_REACTION_ACTIVE) + 1  # cycles, 3 of them to enable
        assert tripped > SLOW_CYCLES
        assert tripped % SLOW_CYCLES == 0
        assert bench.drives.emergencies == [Emergency("LEFT_SK", 0x09, 0x4310)]

    def test_overheated_drive_lowers_its_joint_and_the_others_stay_enabled(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.target[:] = 30.0
        bench.drives.heat(3, 120.0)
        assert bench.drives.state[3] is DriveState.FAULT_REACTION_ACTIVE
        bench.velocity[:] = 0.4
        for _ in range(30):
            torque = bench.cycle()
        assert [s is DriveState.OPERATION_ENABLED for s in bench.drives.state] == [d != 3 for d in range(12)]
        assert torque[3] == pytest.approx(-0.4 * SMOOTH_MOTOR.brake[3])
        assert torque[4] == pytest.approx(30.0)
        assert bench.signals.torque[3] == pytest.approx(0.0, abs=1e-6)

    def test_fault_reaction_ends_when_the_joint_is_at_rest(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.drives.heat(3, 120.0)
        for _ in range(3 * SLOW_CYCLES):
            bench.position[3] += 1.1 * SMOOTH.rest_speed * PERIOD
            bench.cycle()
        assert bench.drives.state[3] is DriveState.FAULT_REACTION_ACTIVE
        for _ in range(SLOW_CYCLES):
            bench.position[3] += 0.9 * SMOOTH.rest_speed * PERIOD
            bench.cycle()
        assert bench.drives.state[3] is DriveState.FAULT
        assert bench.signals.state[3] == DriveState.FAULT

    def test_joint_at_exactly_the_rest_speed_counts_as_moving(self) -> None:
        counts = ROBOT.gear[3] * COUNTS / (2.0 * math.pi)
        bench = DriveBench(dataclasses.replace(SMOOTH, rest_speed=4.0 / (counts * PERIOD)))
        bench.enable()
        bench.drives.heat(3, 120.0)
        for moved, state in ((4, DriveState.FAULT_REACTION_ACTIVE), (3, DriveState.FAULT)):
            for _ in range(SLOW_CYCLES):
                bench.position[3] += moved / counts
                bench.cycle()
            assert bench.drives.state[3] is state

    def test_fault_cannot_be_reset_while_the_drive_is_hot(self) -> None:
        bench = DriveBench(SMOOTH)
        bench.enable()
        bench.drives.heat(3, 125.0)
        for _ in range(SLOW_CYCLES):
            bench.cycle()
        bench.word[3] = Controlword.FAULT_RESET
        for degrees in (125.0, 119.0, 100.5):
            bench.drives.heat(3, degrees)
            bench.cycle()
            assert bench.drives.state[3] is DriveState.FAULT
        bench.drives.heat(3, 100.0)
        assert bench.drives.emergencies == [Emergency("LEFT_SK", 0x09, 0x4310)]
        bench.cycle()
        assert bench.drives.state[3] is DriveState.SWITCH_ON_DISABLED
        assert bench.drives.emergencies[1:] == [Emergency("LEFT_SK", 0, 0)]


class TestErrors:
    """Reactions of a drive to each class of error."""

    @pytest.mark.parametrize("code", [0x2310, 0x2110, 0x3222, 0x4110, 0x4310, 0x7305, 0x7121])
    def test_error_that_prevents_a_hold_starts_the_fault_reaction(self, bench: DriveBench, code: int) -> None:
        bench.enable()
        bench.drives.fail(7, code)
        assert bench.drives.state[7] is DriveState.FAULT_REACTION_ACTIVE
        assert not bench.drives.latched[7]
        assert [e.code for e in bench.drives.emergencies] == [code]

    @pytest.mark.parametrize("code", [0x1000, 0x3210, 0x3220, 0x6100, 0x8130, 0x8150, 0x8250, 0xFF00])
    def test_error_that_permits_a_hold_latches_the_hold(self, bench: DriveBench, code: int) -> None:
        bench.enable()
        bench.drives.fail(7, code)
        assert bench.drives.state[7] is DriveState.QUICK_STOP_ACTIVE
        assert [d for d in range(12) if bench.drives.latched[d]] == [7]

    @pytest.mark.parametrize("code", [0x3220, 0x8250])
    def test_disabled_drive_stays_disabled_when_an_error_occurs(self, bench: DriveBench, code: int) -> None:
        bench.drives.fail(7, code)
        assert bench.drives.state[7] is DriveState.SWITCH_ON_DISABLED
        assert not bench.drives.latched[7]

    def test_commanded_hold_keeps_its_position_when_an_error_latches_it(self, bench: DriveBench) -> None:
        bench.position[:] = 0.1
        bench.enable()
        bench.word[:] = Controlword.QUICK_STOP
        bench.cycle()
        bench.position[:] = 0.11
        bench.cycle()
        bench.drives.fail(7, 0x8250)
        for _ in range(30):
            torque = bench.cycle()
        assert bench.drives.latched[7] is False  # acknowledged by the QUICK_STOP that is still commanded
        np.testing.assert_allclose(torque, -0.01 * ROBOT.hold_kp, rtol=0.02)

    def test_error_that_prevents_a_hold_ends_a_latched_hold(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x8250)
        bench.drives.fail(7, 0x7305)
        assert bench.drives.state[7] is DriveState.FAULT_REACTION_ACTIVE
        assert bench.drives.latched[7] is False
        assert bench.signals.state[7] == DriveState.FAULT_REACTION_ACTIVE

    def test_disabling_a_latched_hold_acknowledges_its_error(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x8250)
        bench.word[7] = Controlword.DISABLE_VOLTAGE
        bench.cycle()
        assert (bench.drives.state[7], bench.drives.latched[7]) == (DriveState.SWITCH_ON_DISABLED, False)
        assert [e.code for e in bench.drives.emergencies] == [0x8250, 0]

    def test_other_controlwords_keep_a_latched_hold_and_its_error(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x8250)
        for word in (
            Controlword.ENABLE_OPERATION,
            Controlword.SHUTDOWN,
            Controlword.SWITCH_ON,
            Controlword.FAULT_RESET,
        ):
            bench.word[7] = word
            bench.cycle()
            assert (bench.drives.state[7], bench.drives.latched[7]) == (DriveState.QUICK_STOP_ACTIVE, True)
        assert [e.code for e in bench.drives.emergencies] == [0x8250]

    def test_fault_reset_acknowledges_every_ended_error(self, bench: DriveBench) -> None:
        bench.drives.fail(7, 0x2310)
        bench.drives.fail(7, 0x4310)
        bench.drives.leave(7, DriveState.FAULT)
        bench.word[7] = Controlword.FAULT_RESET
        bench.cycle()
        assert bench.drives.state[7] is DriveState.SWITCH_ON_DISABLED
        assert [e.code for e in bench.drives.emergencies] == [0x2310, 0x4310, 0]

    def test_fault_remains_after_the_end_of_its_error(self, bench: DriveBench) -> None:
        bench.drives.fail(7, 0x2310, persists=True)
        for _ in range(SLOW_CYCLES):
            bench.cycle()
        bench.drives.recover(7, 0x2310)
        bench.cycle()
        assert bench.drives.state[7] is DriveState.FAULT
        assert [e.code for e in bench.drives.emergencies] == [0x2310]

    def test_stale_commands_of_a_leg_do_not_acknowledge_a_latched_hold(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x8250)
        bench.drives.fail(1, 0x8250)
        bench.word[:] = Controlword.QUICK_STOP
        for fresh, other in (((True, False), 7), ((False, True), 1)):
            bench.drives.fail(other, 0x8250)
            for _ in range(3):
                bench.cycle(fresh)
            assert bench.drives.latched[other]
            bench.cycle()
            assert not bench.drives.latched[other]
        bench.cycle()
        assert not bench.drives.latched[7]

    def test_emergencies_are_appended_to_the_given_list(self) -> None:
        outbox: list[Emergency] = []
        drives = Drives(ROBOT, SMOOTH, DriveSignals(*np.zeros((5, 12))), outbox)
        drives.fail(0, 0x4310)
        assert outbox == [Emergency("LEFT_FH", 0x09, 0x4310)]

    def test_error_in_a_fault_does_not_change_the_state(self, bench: DriveBench) -> None:
        bench.drives.fail(7, 0x4310)
        bench.drives.leave(7, DriveState.FAULT)
        bench.drives.fail(7, 0x2310)
        assert bench.drives.state[7] is DriveState.FAULT

    def test_persistent_error_cannot_be_acknowledged(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x3220, persists=True)
        bench.word[:] = Controlword.QUICK_STOP
        for _ in range(3):
            bench.cycle()
        assert bench.drives.latched[7]
        bench.drives.recover(7, 0x3220)
        assert [e.code for e in bench.drives.emergencies] == [0x3220]
        bench.cycle()
        assert not bench.drives.latched[7]
        assert bench.drives.emergencies == [Emergency("RIGHT_TH", 0x05, 0x3220), Emergency("RIGHT_TH", 0, 0)]

    def test_drive_with_a_persistent_error_can_be_disabled_and_not_enabled(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x3220, persists=True)
        bench.word[7] = Controlword.DISABLE_VOLTAGE
        bench.cycle()
        assert bench.drives.state[7] is DriveState.SWITCH_ON_DISABLED
        for _ in range(5):
            bench.word[:] = [controlword_towards_operation(state) for state in bench.drives.state]
            bench.cycle()
        assert bench.drives.state[7] is DriveState.SWITCHED_ON
        bench.drives.recover(7, 0x3220)
        assert [e.code for e in bench.drives.emergencies] == [0x3220, 0]
        bench.cycle()
        assert bench.drives.state[7] is DriveState.OPERATION_ENABLED

    @pytest.mark.parametrize("delay", [1, 7])
    def test_slow_drive_follows_enable_operation_after_its_delay(self, bench: DriveBench, delay: int) -> None:
        bench.drives.enable_delay[7] = delay
        for _ in range(2):  # the delay is that of each transition
            bench.word[:] = Controlword.DISABLE_VOLTAGE
            bench.cycle()
            for word in (Controlword.SHUTDOWN, Controlword.SWITCH_ON):
                bench.word[:] = word
                bench.cycle()
            bench.word[:] = Controlword.ENABLE_OPERATION
            for _ in range(delay):
                bench.cycle()
                assert [d for d, s in enumerate(bench.drives.state) if s is DriveState.SWITCHED_ON] == [7]
            bench.cycle()
            assert states(bench) == {DriveState.OPERATION_ENABLED}

    def test_no_controlword_ends_a_fault_reaction(self, bench: DriveBench) -> None:
        bench.drives.fail(7, 0x2310)
        for word in Controlword:
            bench.word[:] = word
            bench.cycle()
        assert bench.drives.state[7] is DriveState.FAULT_REACTION_ACTIVE

    def test_reset_removes_errors_and_latch_without_an_emergency(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.fail(7, 0x3220, persists=True)
        bench.drives.reset(7)
        assert (bench.drives.state[7], bench.drives.latched[7]) == (DriveState.SWITCH_ON_DISABLED, False)
        assert not bench.drives.errors.any_persists(7)
        assert [e.code for e in bench.drives.emergencies] == [0x3220]

    def test_unrequested_state_change_sends_no_emergency(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.leave(7, DriveState.SWITCHED_ON)
        assert bench.signals.state[7] == DriveState.SWITCHED_ON
        assert not bench.drives.emergencies

    @pytest.mark.parametrize("left_to", [DriveState.SWITCHED_ON, DriveState.QUICK_STOP_ACTIVE])
    def test_drive_that_left_operation_alone_ignores_enable_operation(
        self, bench: DriveBench, left_to: DriveState
    ) -> None:
        bench.enable()
        bench.drives.leave(7, left_to)
        for word in (Controlword.ENABLE_OPERATION, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION):
            bench.word[7] = word
            for _ in range(5):
                bench.cycle()
            assert (bench.drives.state[7], bench.drives.latched[7]) == (left_to, True)

    @pytest.mark.parametrize("word", [Controlword.QUICK_STOP, Controlword.SHUTDOWN, Controlword.DISABLE_VOLTAGE])
    def test_drive_that_left_operation_alone_is_enabled_after_another_controlword(
        self, bench: DriveBench, word: Controlword
    ) -> None:
        bench.enable()
        bench.drives.leave(7, DriveState.SWITCHED_ON)
        bench.word[7] = word
        bench.cycle()
        assert not bench.drives.latched[7]
        bench.enable()

    @pytest.mark.parametrize("left_to", [DriveState.SWITCHED_ON, DriveState.SWITCH_ON_DISABLED])
    def test_quick_stop_unlatches_a_drive_without_power_but_does_not_end_its_lasting_error(
        self, bench: DriveBench, left_to: DriveState
    ) -> None:
        bench.enable()
        bench.drives.leave(7, left_to)
        bench.drives.supply(7, 30.0)
        bench.word[7] = Controlword.QUICK_STOP
        for _ in range(5):
            bench.cycle()
        assert (bench.drives.state[7], bench.drives.latched[7]) == (DriveState.SWITCH_ON_DISABLED, False)
        for _ in range(5):
            bench.word[7] = controlword_towards_operation(bench.drives.state[7])
            bench.cycle()
        assert bench.drives.state[7] is DriveState.SWITCHED_ON
        assert [e.code for e in bench.drives.emergencies] == [0x3220]
        bench.drives.supply(7, 48.0)
        bench.cycle()
        assert bench.drives.state[7] is DriveState.OPERATION_ENABLED
        assert [e.code for e in bench.drives.emergencies] == [0x3220, 0]

    @pytest.mark.parametrize("left_to", [DriveState.OPERATION_ENABLED, DriveState.FAULT_REACTION_ACTIVE])
    def test_drive_that_stays_enabled_or_faults_is_not_latched(self, bench: DriveBench, left_to: DriveState) -> None:
        bench.enable()
        bench.drives.leave(7, left_to)
        assert not bench.drives.latched[7]

    def test_drive_that_was_not_enabled_is_not_latched(self, bench: DriveBench) -> None:
        bench.drives.leave(7, DriveState.SWITCHED_ON)
        bench.word[:] = Controlword.ENABLE_OPERATION
        bench.cycle()
        assert bench.drives.state[7] is DriveState.OPERATION_ENABLED

    def test_warning_is_sent_by_every_drive_of_the_leg_and_keeps_it_enabled(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.warn(1, emergency.COMMAND_LOST)
        assert states(bench) == {DriveState.OPERATION_ENABLED}
        assert bench.drives.emergencies == [Emergency(node, 0x11, 0x8110) for node in NODES[6:]]
        for _ in range(2 * SLOW_CYCLES):
            bench.cycle()
        assert bench.drives.emergencies[6:] == [Emergency(node, 0, 0) for node in NODES[6:]]


class TestSync:
    def test_leg_holds_in_the_fifth_cycle_without_sync(self, bench: DriveBench) -> None:
        bench.enable()
        for cycle in range(100, 100 + WATCHDOG - 1):
            bench.drives.miss_sync(1, cycle)
        assert states(bench) == {DriveState.OPERATION_ENABLED}
        bench.drives.miss_sync(1, 100 + WATCHDOG - 1)
        assert set(bench.drives.state[:6]) == {DriveState.OPERATION_ENABLED}
        assert set(bench.drives.state[6:]) == {DriveState.QUICK_STOP_ACTIVE}
        assert bench.drives.emergencies == [Emergency(node, 0x11, 0x8130) for node in NODES[6:]]

    def test_sync_missed_in_cycle_zero_counts(self, bench: DriveBench) -> None:
        bench.enable()
        for cycle in range(WATCHDOG - 1):
            bench.drives.miss_sync(0, cycle)
        assert states(bench) == {DriveState.OPERATION_ENABLED}
        bench.drives.miss_sync(0, WATCHDOG - 1)
        assert set(bench.drives.state[:6]) == {DriveState.QUICK_STOP_ACTIVE}

    def test_only_consecutive_missed_syncs_count(self, bench: DriveBench) -> None:
        bench.enable()
        for cycle in (1, 2, 3, 4, 6, 7, 8, 9, 11):
            bench.drives.miss_sync(0, cycle)
        assert states(bench) == {DriveState.OPERATION_ENABLED}

    def test_late_sync_restarts_the_sync_watchdog(self, bench: DriveBench) -> None:
        bench.enable()
        for cycle in range(20):
            bench.drives.miss_sync(0, cycle)
            bench.drives.restart_sync_watchdog(0)
        assert states(bench) == {DriveState.OPERATION_ENABLED}
        for cycle in range(20, 20 + WATCHDOG - 1):
            bench.drives.miss_sync(0, cycle)
        assert states(bench) == {DriveState.OPERATION_ENABLED}
        bench.drives.miss_sync(0, 20 + WATCHDOG - 1)
        assert set(bench.drives.state[:6]) == {DriveState.QUICK_STOP_ACTIVE}


class TestSupply:
    @pytest.mark.parametrize(
        ("volts", "state", "codes"),
        [
            (48.0, DriveState.OPERATION_ENABLED, []),
            (40.0, DriveState.OPERATION_ENABLED, []),
            (39.9, DriveState.QUICK_STOP_ACTIVE, [0x3220]),
            (20.0, DriveState.QUICK_STOP_ACTIVE, [0x3220]),
            (19.9, DriveState.FAULT_REACTION_ACTIVE, [0x3220, 0x3222]),
        ],
    )
    def test_voltage_thresholds_for_hold_and_fault_reaction(
        self, bench: DriveBench, volts: float, state: DriveState, codes: list[int]
    ) -> None:
        bench.enable()
        for _ in range(3):
            bench.drives.supply(2, volts)
        assert bench.drives.state[2] is state
        assert [e.code for e in bench.drives.emergencies] == codes
        assert bench.drives.voltage == [48.0, 48.0, volts] + [48.0] * 9

    @pytest.mark.parametrize("volts", [30.0, 10.0])
    def test_under_voltage_cannot_be_acknowledged_while_it_lasts(self, bench: DriveBench, volts: float) -> None:
        bench.enable()
        bench.drives.supply(2, volts)
        for _ in range(2 * SLOW_CYCLES):
            bench.word[2] = Controlword.FAULT_RESET if volts < 20.0 else Controlword.QUICK_STOP
            bench.cycle()
        assert bench.drives.state[2] is (DriveState.FAULT if volts < 20.0 else DriveState.QUICK_STOP_ACTIVE)
        assert bench.drives.latched[2] is (volts >= 20.0)
        assert [e.code for e in bench.drives.emergencies][-1] != 0

    def test_hold_remains_until_acknowledged_when_the_voltage_returns(self, bench: DriveBench) -> None:
        bench.enable()
        bench.drives.supply(2, 30.0)
        bench.drives.supply(2, 48.0)
        for _ in range(5):
            bench.cycle()
        assert bench.drives.state[2] is DriveState.QUICK_STOP_ACTIVE
        bench.word[:] = Controlword.QUICK_STOP
        bench.cycle()
        assert not bench.drives.latched[2]
        assert [e.code for e in bench.drives.emergencies] == [0x3220, 0]
