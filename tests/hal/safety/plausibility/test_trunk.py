"""Trunk check: exchanged IMUs of torso and pelvis are found by their vertical distance, as soon as the robot turns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_robot import PERIOD, SimulatedRobot, only, row, signals

from atalante_control.model import ExoskeletonParameters
from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.safety.plausibility.trunk import TORSO_HEIGHT, Trunk

TORSO, PELVIS = IMUS.index("torso"), IMUS.index("pelvis")
#: Amplitude [rad/s] and angular frequency [rad/s] of the angular velocity.
AMPLITUDE, FREQUENCY = 0.05, 12.0


class Swinging:
    """The check of a trunk that swings about one axis, called directly.

    Args:
        axis: axis of the motion, 0 or 1.
        height: height of the torso IMU above the pelvis IMU [m].
    """

    def __init__(self, axis: int = 1, height: float = TORSO_HEIGHT, amplitude: float = AMPLITUDE) -> None:
        self.axis, self.height, self.amplitude = axis, height, amplitude
        self.now = signals()
        self.checks = Trunk(self.now, PERIOD)
        self.cycles = 0

    def cycle(self) -> bool:
        """Return whether the finding has changed."""
        swing(self.now, self.cycles, self.axis, self.height, self.amplitude)
        self.cycles += 1
        return self.checks.follow()

    def run(self, cycles: int) -> list[int]:
        """Return the cycles in which the finding changed."""
        return [cycle for cycle in range(cycles) if self.cycle()]


def swing(now: Signals, cycle: int, axis: int, height: float, amplitude: float) -> None:
    """Write the readings of a trunk that swings about one axis."""
    phase = FREQUENCY * PERIOD * cycle
    now.gyro[[TORSO, PELVIS], axis] = amplitude * math.sin(phase)
    acceleration = height * amplitude * FREQUENCY * math.cos(phase)
    now.accel[PELVIS] = [3.0, -2.0, 9.0]
    now.accel[TORSO] = now.accel[PELVIS]
    now.accel[TORSO, 1 - axis] += acceleration if axis == 1 else -acceleration


@pytest.mark.parametrize("axis", [0, 1])
def test_exchanged_imus_are_found_and_the_finding_ends_after_the_repair(axis: int):
    robot = Swinging(axis, -TORSO_HEIGHT)
    changed = robot.run(600)
    assert len(changed) == 1
    assert 300 <= changed[0] < 330
    finding = only(robot.checks.findings())
    assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO", True)
    assert -1.2 * TORSO_HEIGHT < finding.value < -0.5 * TORSO_HEIGHT
    assert finding.text == (
        "the IMUs of torso and pelvis are exchanged: when the robot turns, the torso IMU measures the smaller acceleration"
    )
    robot.height = TORSO_HEIGHT
    assert len(robot.run(1500)) == 1
    assert robot.checks.findings() == ()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("share", [1.0, 0.6, 0.0, -0.4])
def test_robot_without_fault_or_without_clear_evidence_is_accepted(axis: int, share: float):
    assert Swinging(axis, share * TORSO_HEIGHT).run(2000) == []


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("height", "amplitude"), [(1.0, 0.05), (-1.0, 0.05), (-0.7, 0.2)])
def test_height_is_the_vertical_distance(axis: int, height: float, amplitude: float):
    robot = Swinging(axis, height * TORSO_HEIGHT, amplitude)
    robot.run(1999)
    swing(robot.now, robot.cycles, axis, robot.height, amplitude)
    assert robot.checks._follow(*robot.checks._arguments) == pytest.approx(height * TORSO_HEIGHT, rel=0.03)


def test_height_is_zero_while_the_filters_settle():
    robot = Swinging()
    for cycle in range(299):
        swing(robot.now, cycle, 1, TORSO_HEIGHT, AMPLITUDE)
        assert robot.checks._follow(*robot.checks._arguments) == 0.0


@pytest.mark.parametrize(("amplitude", "found"), [(0.0205, True), (0.017, False)])
def test_slow_motion_is_not_evaluated(amplitude: float, found: bool):
    # The filters reduce the amplitude to 0.59 times its value, so a limit of 0.008 rad/s rms is an amplitude of 0.0192 rad/s.
    assert bool(Swinging(1, -TORSO_HEIGHT, amplitude).run(3000)) == found


def test_finding_remains_while_the_robot_is_at_rest():
    robot = Swinging(1, -TORSO_HEIGHT)
    robot.run(500)
    robot.amplitude = 0.0
    assert robot.run(2000) == []
    assert robot.checks.findings()


def test_constant_error_of_an_accelerometer_has_no_effect():
    robot = Swinging()
    follow = robot.checks.follow

    def biased() -> bool:
        robot.now.accel[TORSO, 0] -= 0.5
        return follow()

    robot.checks.follow = biased  # type: ignore[method-assign]
    assert robot.run(2000) == []


@pytest.mark.parametrize("imu", [TORSO, PELVIS])
@pytest.mark.parametrize("height", [1.0, -1.0])
def test_gyroscope_with_wrong_sign_gives_no_decision(imu: int, height: float):
    robot = Swinging(1, height * TORSO_HEIGHT)
    follow = robot.checks.follow

    def inverted() -> bool:
        robot.now.gyro[imu, 1] *= -1.0
        return follow()

    robot.checks.follow = inverted  # type: ignore[method-assign]
    assert robot.run(1000) == []


def test_filters_begin_without_the_values_of_the_first_call():
    now = signals()
    now.accel.fill(math.nan)
    filters = Trunk(now, PERIOD)._arguments[2]
    assert [values.tolist() for values in filters] == [[0.0, 0.0]] * 4 + [[0.0], [0.0, 0.0]]


def test_height_is_that_of_the_exoskeleton():
    model = ExoskeletonParameters()
    assert model.torso_imu[2] - model.pelvis_imu[2] == pytest.approx(TORSO_HEIGHT)


class TestInTheCycle:
    """The check runs in each cycle in which the values of both IMUs are at most one cycle old."""

    def found(self, robot: SimulatedRobot, cycles: int = 700) -> bool:
        begin = robot.cycles

        def change(now: Signals) -> None:
            turned = -AMPLITUDE / FREQUENCY * math.cos(FREQUENCY * PERIOD * (robot.cycles - begin))
            half = np.array([math.cos(turned / 2), 0.0, math.sin(turned / 2), 0.0])
            now.quaternion[[TORSO, PELVIS]] = half
            swing(now, robot.cycles - begin, 1, -TORSO_HEIGHT, AMPLITUDE)
            now.accel[[TORSO, PELVIS]] += np.array([0.0, 0.0, 9.81]) - now.accel[PELVIS]

        robot.run(cycles, change)
        return any("exchanged" in finding.text for finding in robot.checks.findings)

    @pytest.mark.parametrize("imu", ["torso", "pelvis"])
    def test_late_values_are_used_and_old_values_are_not(self, imu: str):
        assert self.found(SimulatedRobot(amplitude=0.0))
        assert self.found(SimulatedRobot(amplitude=0.0, late={row(f"IMU_{imu}"): 1}))
        assert not self.found(SimulatedRobot(amplitude=0.0, late={row(f"IMU_{imu}"): 2}))

    def test_late_values_of_other_imus_have_no_effect(self):
        assert self.found(SimulatedRobot(amplitude=0.0, late={row("IMU_left_tibia"): 9}))
