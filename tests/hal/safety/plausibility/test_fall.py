"""Fall check: a robot has fallen if the trunk IMUs show that it leans by more than 35 degrees."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from simulated_robot import SimulatedRobot, only, row, signals

from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.fall import FALLEN, Fall
from atalante_hal.safety.plausibility.imus import IMU_CYCLES
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.wire.process_image import NEVER

TORSO, PELVIS = IMUS.index("torso"), IMUS.index("pelvis")
TRUNK = [TORSO, PELVIS]
ABOVE, BELOW = FALLEN + 1e-3, FALLEN - 1e-3


def leaning(now: Signals, angle: float, axis: int = 0, imus: list[int] = TRUNK) -> None:
    """Set the attitude of IMUs to a rotation about a horizontal axis."""
    now.quaternion[imus] = 0.0
    now.quaternion[imus, 0], now.quaternion[imus, 1 + axis] = math.cos(angle / 2.0), math.sin(angle / 2.0)


def upright() -> tuple[Signals, Fall]:
    """Return the signals of an upright robot, and its fall check."""
    now = signals()
    now.quaternion[:, 0] = 1.0
    return now, Fall(now)


def ages(torso: int, pelvis: int) -> Ages:
    """Return the ages of the sensor values."""
    imu = np.zeros(len(IMUS), np.int64)
    imu[TRUNK] = torso, pelvis
    return Ages(np.zeros(12, np.int64), imu, np.zeros(2, np.int64))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_lean_above_35_degrees_is_pending_and_then_confirmed_until_the_robot_is_upright(axis: int, sign: float):
    now, check = upright()
    assert (check.evaluate(None), check.findings()) == (False, ())
    leaning(now, sign * ABOVE, axis)
    text = "the robot has fallen: its trunk leans by 35 degrees"
    for confirmed in (False, True, True):
        assert check.evaluate(None)
        assert check.findings() == (Finding(Dtc.FALLEN, "IMU_PELVIS", pytest.approx(ABOVE), confirmed, text),)
    leaning(now, sign * BELOW, axis)
    assert (check.evaluate(None), check.findings()) == (False, ())
    leaning(now, sign * ABOVE, axis)
    assert check.evaluate(None)
    assert not only(check.findings()).confirmed


def test_robot_upside_down_has_fallen():
    now, check = upright()
    now.quaternion[TRUNK] = 0.0, 1.0 + 1e-9, 0.0, 0.0
    assert check.evaluate(None)
    assert only(check.findings()).value == pytest.approx(math.pi)
    assert only(check.findings()).text.endswith("180 degrees")


@pytest.mark.parametrize("imu", TRUNK)
def test_both_trunk_imus_must_show_the_lean_unless_one_is_too_old(imu: int):
    now, check = upright()
    leaning(now, ABOVE, imus=[imu])
    for _ in range(3):
        assert not check.evaluate(None)
        assert not check.evaluate(ages(NEVER - 1, NEVER - 1))
    other = (NEVER, 0) if imu == PELVIS else (0, NEVER)
    assert check.evaluate(ages(*other))
    assert check.evaluate(ages(*other))
    assert only(check.findings()).confirmed
    assert not check.evaluate(ages(*other[::-1]))
    leaning(now, ABOVE)
    assert not check.evaluate(ages(NEVER, NEVER))


def test_robot_that_falls_is_found_within_two_evaluations_by_the_schedule():
    robot = SimulatedRobot()
    assert robot.run(64) == ()
    assert robot.until_found(Dtc.FALLEN, 40, lambda now: leaning(now, 1.2)) <= 32
    robot = SimulatedRobot()
    robot.missing = {row("imu_torso"), row("imu_pelvis")}
    assert all(found.dtc is not Dtc.FALLEN for found in robot.run(64, lambda now: leaning(now, 1.2)))


@pytest.mark.parametrize("imu", TRUNK)
@pytest.mark.parametrize(
    "rejected",
    [
        lambda now, imu: now.quaternion[imu].fill(0.0),
        lambda now, imu: now.gyro[imu].fill(100.0),
        lambda now, imu: now.gyro[imu].fill(0.01),
    ],
    ids=["no attitude", "saturated", "stuck"],
)
def test_trunk_imu_whose_values_are_rejected_does_not_hide_a_fall(rejected: Callable[[Signals, int], None], imu: int):
    robot, other = SimulatedRobot(), TORSO + PELVIS - imu

    def fall(now: Signals) -> None:
        leaning(now, 1.2, imus=[other])
        rejected(now, imu)

    robot.run(300, lambda now: rejected(now, imu))
    assert robot.until_found(Dtc.FALLEN, 40, fall) <= 32


@pytest.mark.parametrize(("rejections", "expected"), [(IMU_CYCLES - 1, False), (IMU_CYCLES, True)])
def test_trunk_imu_is_left_out_after_the_time_in_which_its_fault_is_confirmed(rejections: int, expected: bool):
    robot = SimulatedRobot()
    while robot.cycles % 32 != 14 - rejections:
        robot.cycle()

    def fall(now: Signals) -> None:
        leaning(now, 1.2, imus=[TORSO])
        now.quaternion[PELVIS] = 0.0

    robot.run(rejections, fall)
    assert all(found.dtc is not Dtc.FALLEN for found in robot.checks.findings)
    robot.cycle(fall)
    assert any(found.dtc is Dtc.FALLEN for found in robot.checks.findings) is expected
