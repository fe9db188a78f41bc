"""Leaky buckets of implausible values: single values are tolerated, more than a fifth of the values are a fault."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_robot import CODEC, GEAR, Change, SimulatedRobot, must_not_be_called, only

from atalante_hal.robot import IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.encoders import EncoderChecks
from atalante_hal.safety.plausibility.rejections import Rejections
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.codec import group_of

PELVIS = IMUS.index("pelvis")


def jumped(now: Signals) -> None:
    now.position[4] += 0.1 * GEAR[4]


def saturated(now: Signals) -> None:
    now.gyro[PELVIS] = 100.0


def without_attitude(now: Signals) -> None:
    now.quaternion[PELVIS] = 0.0


def unchanged(now: Signals) -> None:
    del now


@pytest.mark.parametrize(
    ("change", "message", "restored"),
    [
        (jumped, "LEFT_SA_STATE", {"Position", "Velocity"}),
        (saturated, "IMU_PELVIS_STATE", {"Quaternion", "Gyro", "Accel"}),
        (without_attitude, "IMU_PELVIS_STATE", {"Quaternion", "Gyro", "Accel"}),
    ],
)
@pytest.mark.parametrize("cycles", [1, 4, 20])
def test_rejection_keeps_the_other_signals_of_the_frame(change: Change, message: str, restored: set[str], cycles: int):
    robot = SimulatedRobot()
    codec, values = CODEC, robot.image.values
    own = np.flatnonzero(codec.row_of == codec.rows[message])
    groups = [group_of(codec.signals[index][1].name) for index in own.tolist()]
    if "DriveState" in groups:
        values[own[groups.index("DriveState")]] = DriveState.OPERATION_ENABLED
    before = values[own].copy()
    for cycle in range(cycles):

        def send(now: Signals, cycle: int = cycle) -> None:
            values[own] = 150.0 + cycle + np.arange(len(own))
            change(now)

        robot.cycle(send)
        assert robot.rejected == {codec.rows[message]: cycle + 1}
        sent = 150.0 + cycle + np.arange(len(own))
        expected = np.where([group in restored for group in groups], before, sent)
        assert values[own].tolist() == expected.tolist()
    assert restored < set(groups)


@pytest.mark.parametrize("state", DriveState)
def test_rejection_restores_the_whole_frame_of_a_drive_that_is_off(state: DriveState):
    """A start waits for a drive whose values are rejected, so its state must not change until then."""
    robot = SimulatedRobot()
    values, at = robot.image.values, CODEC.index("LEFT_SA_STATE", "DriveState")
    own = np.flatnonzero(CODEC.row_of == CODEC.rows["LEFT_SA_STATE"])
    values[at] = state
    before = values[own].copy()

    def send(now: Signals) -> None:
        values[own] = 50.0
        jumped(now)

    robot.cycle(send)
    off = state in (0x00, 0x40, 0x21, 0x23)
    assert bool(values[at] == state) == off
    assert np.array_equal(values[own], before) == off


def confirmed_after(robot: SimulatedRobot, change: Change, every: int, cycles: int) -> int | None:
    """Return the number of cycles until a finding is confirmed, if the change is made in every n-th cycle."""
    for cycle in range(cycles):
        robot.cycle(unchanged if cycle % every else change)
        if any(finding.confirmed for finding in robot.checks.findings):
            return cycle + 1
    return None


@pytest.mark.parametrize(
    ("change", "dtc", "node", "sensor"),
    [
        (jumped, Dtc.ENC_JUMP, "LEFT_SA", "encoder of left_SA"),
        (saturated, Dtc.IMU_SATURATED, "IMU_PELVIS", "pelvis IMU"),
        (without_attitude, Dtc.IMU_INVALID, "IMU_PELVIS", "pelvis IMU"),
    ],
)
def test_every_second_implausible_value_is_confirmed(change: Change, dtc: Dtc, node: str, sensor: str):
    robot = SimulatedRobot()
    assert confirmed_after(robot, change, 2, 100) == 41
    robot.cycle(unchanged)
    finding = only(robot.checks.findings)
    assert (finding.dtc, finding.node) == (dtc, node)
    assert finding.text == f"the values of the {sensor} are implausible: more than a fifth of them were rejected"


@pytest.mark.parametrize("change", [jumped, saturated, without_attitude])
@pytest.mark.parametrize(("every", "confirmed"), [(3, True), (4, True), (5, False), (7, False)])
def test_more_than_a_fifth_of_implausible_values_is_confirmed(change: Change, every: int, confirmed: bool):
    assert (confirmed_after(SimulatedRobot(), change, every, 400) is not None) is confirmed


def test_diagnostic_ends_after_sixteen_good_values():
    robot = SimulatedRobot()
    assert confirmed_after(robot, saturated, 2, 100) is not None
    for _ in range(15):
        assert only(robot.cycle(unchanged)).confirmed
    assert robot.cycle(unchanged) == ()


def test_fast_path_is_used_again_when_the_bucket_is_empty(monkeypatch: pytest.MonkeyPatch):
    robot = SimulatedRobot()
    robot.run(3, saturated)
    robot.run(20)
    monkeypatch.setattr(EncoderChecks, "accept", must_not_be_called)
    assert robot.run(64) == ()


def test_confirmed_jump_keeps_its_own_text():
    robot = SimulatedRobot(amplitude=0.0)
    robot.run(20, jumped)
    assert "until it jumps back or its drive restarts" in only(robot.checks.findings).text


@pytest.mark.parametrize(("change", "first_confirmed"), [(jumped, 5), (saturated, 10)])
def test_persistent_fault_ends_with_its_first_good_value(change: Change, first_confirmed: int):
    robot = SimulatedRobot(amplitude=0.0)
    assert not only(robot.run(first_confirmed - 1, change)).confirmed
    assert only(robot.run(40, change)).confirmed
    assert robot.cycle(unchanged) == ()


@pytest.mark.parametrize("change", [jumped, saturated])
def test_nine_of_ten_implausible_values_are_confirmed(change: Change):
    robot = SimulatedRobot(amplitude=0.0)
    for cycle in range(100):
        robot.cycle(change if cycle % 10 else unchanged)
    robot.cycle(unchanged)
    assert any(finding.confirmed and "rejected" in finding.text for finding in robot.checks.findings)


def test_restarted_drive_empties_the_bucket_of_its_encoder():
    robot = SimulatedRobot(amplitude=0.0)
    assert confirmed_after(robot, jumped, 2, 100) is not None
    robot.checks.reference("LEFT_SA")
    assert robot.cycle(unchanged) == ()


def test_each_sensor_has_its_own_bucket_and_last_cause():
    rejections = Rejections()
    for _ in range(16):
        rejections.update({4: Dtc.ENC_JUMP, len(JOINTS): Dtc.IMU_SATURATED})
    rejections.update({len(JOINTS): Dtc.IMU_STUCK})
    assert [(f.dtc, f.node) for f in rejections.findings()] == [
        (Dtc.ENC_JUMP, "LEFT_SA"),
        (Dtc.IMU_STUCK, "IMU_TORSO"),
    ]
    rejections.forget(4)
    rejections.forget(4)
    assert only(rejections.findings()).node == "IMU_TORSO"
    assert rejections.pending
    assert math.isclose(only(rejections.findings()).value, 0.0)
    for _ in range(64):
        rejections.update({})
    assert not rejections.pending
    assert np.size(rejections.findings()) == 0
