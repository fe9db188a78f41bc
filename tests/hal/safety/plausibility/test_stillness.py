"""Standstill checks: stuck encoders, frozen gyros and force cells that repeat are found within their bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_robot import CODEC, GEAR, MESSAGES, MIDDLE, ROBOT, SimulatedRobot, cells, imus, joints, only, row, signs

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import Signals, signals_of
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.wire.process_image import ReceiveImage


class TestStuckEncoder:
    @joints
    @pytest.mark.parametrize("phase", [0, 1, 9, 15])
    def test_stuck_encoder_is_found_within_50_cycles_of_varying_torque(self, joint: int, phase: int):
        robot = SimulatedRobot()
        robot.run(20 + phase)
        stuck = float(robot.now.position[joint])

        def stick(now: Signals) -> None:
            now.position[joint] = stuck
            now.velocity[joint] = 0.0

        assert 32 < robot.until_found(Dtc.ENC_STUCK, 50, stick) <= 48
        finding = only(robot.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.value >= ROBOT.breakaway[joint]
        assert (
            f"{JOINTS[joint]} has a constant reading while the torque varies by {finding.value:.0f} Nm" in finding.text
        )
        assert robot.rejected == {}
        assert robot.run(17) == ()

    @joints
    def test_torque_change_below_breakaway_reports_nothing(self, joint: int):
        robot = SimulatedRobot(amplitude=0.0)
        wobble = 0.0

        def hold(now: Signals) -> None:
            now.position[:] += np.array([robot.cycles % 7] * 12) * 1e-5
            now.position[joint] = MIDDLE[joint] * GEAR[joint]
            now.torque[:] = 3.0 + wobble

        wobble = 30.0
        robot.run(32, lambda now: (hold(now), now.position.__iadd__(1e-4 * robot.cycles)))
        wobble = 0.0
        robot.run(32, hold)
        wobble = ROBOT.breakaway[joint] * (1.0 - 1e-9)
        assert robot.run(100, hold) == ()
        wobble = -1e-6
        assert robot.until_found(Dtc.ENC_STUCK, 16, hold) <= 16
        assert only(robot.checks.findings).value == pytest.approx(ROBOT.breakaway[joint], rel=1e-5)

    @signs
    def test_torque_range_starts_at_the_first_constant_reading(self, sign: float):
        robot, torque = SimulatedRobot(amplitude=0.0), 0.0

        def push(now: Signals) -> None:
            now.torque[:] = torque

        def move(now: Signals) -> None:
            push(now)
            now.position[:] += 1e-5 * robot.cycles * GEAR

        for torque in (sign * 100.0, -sign * 100.0, 0.0):  # noqa: B007 - read by `push`
            assert robot.run(32, move) == ()
            assert robot.run(96, push) == ()
        torque = sign * 100.0
        robot.run(32, move)
        assert robot.run(16, push) == ()  # one sample
        torque = 0.0
        assert robot.until_found(Dtc.ENC_STUCK, 48, push) > 16

    @joints
    @pytest.mark.parametrize("limit", ["position_min", "position_max"])
    def test_joint_at_its_end_stop_may_stand_still(self, joint: int, limit: str):
        end = getattr(ROBOT, limit)[joint]
        inwards = 1.0 if limit == "position_min" else -1.0
        for distance, found in ((0.0049, False), (0.0051, True)):
            robot = SimulatedRobot(amplitude=0.0)
            robot.now.position[joint] = at = (end + inwards * distance) * GEAR[joint]

            def push(now: Signals, robot: SimulatedRobot = robot, at: float = at) -> None:
                now.position[joint] = at
                now.torque[joint] = 20.0 * math.sin(50.0 * robot.time)

            robot.run(100, push)
            stuck = [f.node for f in robot.checks.findings if f.dtc is Dtc.ENC_STUCK]
            assert stuck == ([JOINTS[joint].upper()] if found else [])

    @pytest.mark.parametrize("end", ["position_min", "position_max"])
    def test_joint_exactly_at_the_end_stop_limit_may_stand_still(self, end: str):
        robot, at = SimulatedRobot(amplitude=0.0), {}
        at_stop = 0.005  # rad
        stops = ROBOT.position_min + at_stop if end == "position_min" else ROBOT.position_max - at_stop
        for joint, stop in enumerate(stops):
            to_joint = ROBOT.polarity[joint] / ROBOT.gear[joint]
            near = stop / to_joint + np.spacing(stop / to_joint) * np.arange(-8, 9)
            at.update((joint, value) for value in near[near * to_joint == stop].tolist())
        assert len(at) >= 8  # no motor position of the other joints gives exactly the limit

        def push(now: Signals) -> None:
            for joint, value in at.items():
                now.position[joint] = value
                now.torque[joint] = 20.0 * math.sin(50.0 * robot.time)

        push(robot.now)
        assert robot.run(100, push) == ()

    def test_torque_change_of_exactly_breakaway_is_reported(self):
        robot, torque = SimulatedRobot(amplitude=0.0), np.zeros(12)

        def hold(now: Signals) -> None:
            now.torque[:] = torque

        robot.run(64, lambda now: (hold(now), now.position.__iadd__(1e-5 * robot.cycles)))
        assert robot.run(64, hold) == ()
        torque[:] = ROBOT.breakaway
        robot.run(16, hold)
        assert [f.node for f in robot.checks.findings] == [joint.upper() for joint in JOINTS]
        assert [f.value for f in robot.checks.findings] == ROBOT.breakaway.tolist()

    def test_joint_without_frames_is_not_reported_stuck(self):
        robot = SimulatedRobot()
        robot.missing = {row("left_SK")}
        assert robot.run(200) == ()


class TestFrozenImu:
    @imus
    @pytest.mark.parametrize("phase", [0, 7, 15])
    def test_frozen_gyro_is_found_within_100_cycles(self, imu: int, phase: int):
        robot = SimulatedRobot()
        robot.run(20 + phase)
        frozen = robot.now.gyro[imu].copy()

        def freeze(now: Signals) -> None:
            now.gyro[imu] = frozen

        assert 80 < robot.until_found(Dtc.IMU_STUCK, 100, freeze) <= 96
        finding = only(robot.checks.findings)
        assert (finding.node, finding.value) == (f"IMU_{IMUS[imu].upper()}", 100.0)
        assert f"gyro of the {IMUS[imu]} IMU" in finding.text
        assert robot.rejected == {row(f"IMU_{IMUS[imu]}"): 1}
        assert only(robot.run(20, freeze)) == finding
        assert robot.rejected == {row(f"IMU_{IMUS[imu]}"): 21}
        assert robot.run(17) == ()
        assert robot.rejected == {}

    def test_gyro_with_one_varying_axis_is_accepted(self):
        robot = SimulatedRobot()
        assert robot.run(300, lambda now: now.gyro.__setitem__((slice(None), slice(2)), 0.0)) == ()

    def test_lost_frames_are_not_counted_as_repetitions(self):
        robot = SimulatedRobot()
        frozen = robot.now.gyro[0].copy()
        waited = 0
        while not robot.checks.findings:
            robot.missing = {row("IMU_torso")} if waited % 32 < 16 else set()
            robot.cycle(lambda now: now.gyro.__setitem__(0, frozen))
            waited += 1
        assert 150 < waited < 200


class TestRepeatedForce:
    @cells
    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("value", [0.0, 400.0])
    def test_cell_that_repeats_its_force_is_set_to_zero(self, foot: int, cell: int, axis: int, value: float):
        robot = SimulatedRobot()
        robot.run(21)

        def stick(now: Signals) -> None:
            now.force[foot, cell, axis] = value

        assert 80 < robot.until_found(Dtc.FOOT_CELL, 100, stick) <= 96
        finding = only(robot.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot has a constant reading of" in finding.text
        if axis == 2:
            assert finding.value == value
        assert not robot.now.force[foot, cell].any()
        assert np.count_nonzero(robot.now.force) == 21
        assert robot.rejected == {}
        robot.run(30, stick)
        assert not robot.now.force[foot, cell].any()
        robot.missing = {row(f"FOOT_{FEET[foot]}")}
        robot.run(20, stick)
        robot.missing = set()
        assert only(robot.cycle(stick)).dtc is Dtc.FOOT_CELL
        assert robot.run(17) == ()
        assert robot.now.force[foot, cell].all()


class TestStillnessAlone:
    """The standstill check without the schedule, one sample at a time."""

    rng = np.random.default_rng(4)

    def stillness(self, every: int = 16) -> tuple[Stillness, ReceiveImage, Signals]:
        image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        now = signals_of(CODEC, image.values)
        return Stillness(ROBOT, image, now, every), image, now

    def move(self, now: Signals) -> None:
        now.position[:] = MIDDLE * GEAR + 1e-3 * self.rng.random(12)
        now.gyro[:] = self.rng.random((4, 3))
        now.force[:] = self.rng.random((2, 4, 3))

    def test_new_standstill_check_has_no_findings(self):
        stillness, _, _ = self.stillness()
        assert not stillness.constant_samples.any()
        assert stillness.findings() == ()

    @pytest.mark.parametrize(("every", "to_stuck", "to_freeze"), [(3, 16, 32), (4, 11, 24), (16, 2, 5)])
    def test_required_repetitions_follow_from_the_sample_interval(self, every: int, to_stuck: int, to_freeze: int):
        def hold_encoder(now: Signals) -> None:
            now.position[7] = MIDDLE[7] * GEAR[7]

        def hold_gyro(now: Signals) -> None:
            now.gyro[2] = 1.0, 2.0, 3.0

        def hold_cell(now: Signals) -> None:
            now.force[1, 3, 0] = 1.0

        for hold, repetitions in ((hold_encoder, to_stuck), (hold_gyro, to_freeze), (hold_cell, to_freeze)):
            stillness, _, now = self.stillness(every)
            for sample in range(repetitions + 2):
                self.move(now)
                hold(now)
                now.torque[:] = 100.0 * sample
                assert stillness.sample(True) is (sample >= repetitions)
                assert len(stillness.findings()) == (sample >= repetitions)
            self.move(now)
            assert not stillness.sample(True)
            assert stillness.findings() == ()

    def test_imu_without_new_frame_is_not_sampled(self):
        stillness, image, now = self.stillness()
        torso = row("IMU_torso")

        def sample(value: float, *, new: bool) -> bool:
            self.move(now)
            now.gyro[0] = value
            image.age += 16
            image.age[np.arange(len(MESSAGES)) != torso] = 0
            if new:
                image.age[torso] = 0
            return stillness.sample(False)

        assert not sample(1.0, new=True)
        assert not sample(2.0, new=False)
        assert not sample(2.0, new=True)  # another value than in the last sample
        for _ in range(4):
            assert not sample(2.0, new=True)
            assert not sample(2.0, new=False)
        assert sample(2.0, new=True)
        assert stillness.imus == [0]
        assert sample(3.0, new=False)
        assert not sample(3.0, new=True)
