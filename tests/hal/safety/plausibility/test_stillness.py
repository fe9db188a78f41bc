"""Standstill checks: stuck encoders, frozen gyros and force cells that repeat are found within their bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_robot import (
    CODEC,
    GEAR,
    MESSAGES,
    MIDDLE,
    PERIOD,
    ROBOT,
    SimulatedRobot,
    cells,
    imus,
    joints,
    only,
    row,
    signs,
)

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.signals import Signals, signals_of
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.wire.process_image import ReceiveImage

ANKLES = [JOINTS.index(name) for name in ("left_SA", "left_HA", "right_SA", "right_HA")]


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

        assert 12 < robot.until_found(Dtc.ENC_STUCK, 50, stick) <= 48
        finding = only(robot.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.value >= ROBOT.breakaway[joint]
        assert (
            f"{JOINTS[joint]} has a constant reading while the torque varies by {finding.value:.0f} Nm" in finding.text
        )
        assert robot.rejected == {}
        assert robot.run(17) == ()

    @joints
    @signs
    @pytest.mark.parametrize("ridden_through", [False, True])
    def test_stuck_encoder_is_found_within_12_cycles_of_a_fast_torque(
        self, joint: int, sign: float, ridden_through: bool
    ):
        robot = SimulatedRobot(amplitude=0.0)
        robot.run(20)
        robot.missing = {row("IMU_torso")} if ridden_through else set()
        torque = 0.0

        def push(now: Signals) -> None:
            nonlocal torque
            torque += sign * 20.0
            now.torque[joint] = torque

        assert 4 < robot.until_found(Dtc.ENC_STUCK, 12, push) <= 8
        found = [f for f in robot.checks.findings if f.dtc is Dtc.ENC_STUCK]
        assert only(tuple(found)).node == JOINTS[joint].upper()
        assert found[0].value == pytest.approx(abs(torque), abs=21.0)
        assert f"{JOINTS[joint]} has a constant reading while the torque varies by" in found[0].text
        move = robot.run(17, lambda now: now.position.__iadd__(1e-4 * robot.cycles))
        assert [f for f in move if f.dtc is Dtc.ENC_STUCK] == []

    @joints
    def test_accepted_time_of_a_constant_reading_shrinks_with_the_torque(self, joint: int):
        cycles = []
        for beyond in (10.0, 40.0, 160.0):
            robot, torque = SimulatedRobot(amplitude=0.0), 1.0

            def push(now: Signals) -> None:
                now.torque[joint] = torque  # noqa: B023 - called in the same iteration

            robot.run(4, push)
            torque += ROBOT.breakaway[joint] + beyond
            cycles.append(robot.until_found(Dtc.ENC_STUCK, 50, push))
        # A joint with 100 kg m2 turns by beyond * t^2 / 2 / 100 kg m2 in the time t. The finding requires that this is 10 urad.
        assert cycles == [14, 7, 4]

    @joints
    def test_torque_pulse_too_short_to_move_the_heaviest_joint_reports_nothing(self, joint: int):
        robot, torque = SimulatedRobot(amplitude=0.0), 0.0

        def push(now: Signals) -> None:
            now.torque[joint] = torque

        robot.run(4, push)
        torque = ROBOT.breakaway[joint] + 40.0
        assert robot.run(1, push) == ()
        torque = 0.0
        assert robot.run(24, push) == ()

    @joints
    def test_torque_that_stops_a_joint_is_not_counted(self, joint: int):
        robot, torque = SimulatedRobot(amplitude=0.0), 100.0

        def brake(now: Signals) -> None:
            now.torque[joint] = torque

        robot.run(20, lambda now: (brake(now), now.position.__iadd__(1e-3 * robot.cycles)))
        for torque in (100.0, 50.0, 0.0):  # noqa: B007 - read by `brake`
            robot.cycle(lambda now: (brake(now), now.position.__iadd__(1e-3 * 20)))
        assert robot.run(8, lambda now: (brake(now), now.position.__iadd__(1e-3 * 20))) == ()

    def test_late_values_count_with_the_time_between_their_measurements(self):
        stillness, image, now = TestStillnessAlone().stillness()
        image.values_before[:] = image.values
        now.position[7] = image.values_before[CODEC.slice("Position")][7] = MIDDLE[7] * GEAR[7]
        for _ in range(3):
            stillness.follow_joint(7, 1)
        now.torque[7] = ROBOT.breakaway[7] + 40.0
        stillness.follow_joint(7, 0)  # the values are not newer than the last ones
        stillness.follow_joint(7, 4)
        assert not stillness.check_driven()
        stillness.follow_joint(7, 4)
        assert stillness.check_driven()
        assert [f.node for f in stillness.findings()] == [JOINTS[7].upper()]

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
            now.position[:] += 1e-6 * robot.cycles * GEAR

        for torque in (sign * 100.0, -sign * 100.0, 0.0):  # noqa: B007 - read by `push`
            assert robot.run(32, move) == ()
            assert robot.run(96, push) == ()
        torque = sign * 12.0
        robot.run(32, move)
        assert robot.run(16, push) == ()  # one sample
        torque = 0.0
        assert robot.until_found(Dtc.ENC_STUCK, 48, push) > 8

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

    @pytest.mark.parametrize("joint", ANKLES, ids=lambda joint: JOINTS[joint])
    def test_still_ankle_of_a_loaded_foot_is_not_stuck(self, joint: int):
        """The torque varies by 40 Nm, but the ankle would have to move the whole robot."""
        robot = SimulatedRobot(amplitude=1e-3, standing=True)
        at = float(robot.now.position[joint])
        assert robot.run(400, lambda now: now.position.__setitem__(joint, at)) == ()

    @pytest.mark.parametrize("joint", ANKLES, ids=lambda joint: JOINTS[joint])
    @signs
    def test_ankle_of_a_loaded_foot_is_stuck_when_its_shank_turns(self, joint: int, sign: float):
        robot = SimulatedRobot(amplitude=1e-3, standing=True)
        at, shank = float(robot.now.position[joint]), IMUS.index(f"{JOINTS[joint].split('_')[0]}_tibia")

        def turn(now: Signals, rate: float) -> None:
            now.position[joint] = at
            now.gyro[shank, 1] += sign * rate

        assert robot.run(100, lambda now: turn(now, 0.0)) == ()
        assert robot.run(160, lambda now: turn(now, 0.03)) == ()  # 0.3 degrees
        assert robot.until_found(Dtc.ENC_STUCK, 260, lambda now: turn(now, 0.03)) > 100
        finding = next(f for f in robot.checks.findings if f.dtc is Dtc.ENC_STUCK)
        assert finding.node == JOINTS[joint].upper()
        assert finding.value == pytest.approx(0.01, abs=2e-3)
        assert f"{JOINTS[joint]} has a constant reading while the shank turns by 0.6 degrees" in finding.text

    @pytest.mark.parametrize("joint", ANKLES, ids=lambda joint: JOINTS[joint])
    @pytest.mark.parametrize(
        ("silent", "rate"),
        [
            pytest.param("IMU_{}_tibia", 0.0, id="IMU is silent, shank stops"),
            pytest.param("FOOT_{}", 1.0, id="foot is silent, foot leaves the ground and turns with the shank"),
        ],
    )
    def test_last_values_before_a_loss_of_frames_are_not_continued(self, joint: int, silent: str, rate: float):
        robot = SimulatedRobot(amplitude=1e-3, standing=True)
        side = JOINTS[joint].split("_")[0]
        at, shank = float(robot.now.position[joint]), IMUS.index(f"{side}_tibia")

        def turn(now: Signals) -> None:
            now.gyro[shank, 1] += 1.0

        def rest(now: Signals) -> None:
            now.position[joint] = at
            now.gyro[shank, 1] += rate

        robot.run(16, turn)
        robot.missing = {row(silent.format(side))}
        assert not [finding for finding in robot.run(400, rest) if finding.dtc is Dtc.ENC_STUCK]

    @pytest.mark.parametrize("joint", ANKLES, ids=lambda joint: JOINTS[joint])
    def test_ankle_of_a_silent_foot_is_not_stuck_because_the_foot_may_have_landed(self, joint: int):
        robot = SimulatedRobot(amplitude=1e-3)
        robot.run(16)
        at = float(robot.now.position[joint])
        robot.missing = {row(f"FOOT_{JOINTS[joint].split('_')[0]}")}
        found = [robot.run(1, lambda now: now.position.__setitem__(joint, at)) for _ in range(400)]
        assert Dtc.ENC_STUCK not in {finding.dtc for findings in found for finding in findings}

    @pytest.mark.parametrize("joint", ANKLES, ids=lambda joint: JOINTS[joint])
    def test_turn_and_torque_in_the_swing_do_not_count_on_the_ground(self, joint: int):
        robot, rate = SimulatedRobot(amplitude=1e-3), 1.5
        side = JOINTS[joint].split("_")[0]
        foot, knee, at = FEET.index(side), JOINTS.index(f"{side}_SK"), float(robot.now.position[joint])
        position, turned = robot.position, np.zeros(len(JOINTS))
        robot.position = lambda: position() + turned  # type: ignore[method-assign]

        def still(now: Signals, *, loaded: bool) -> None:
            now.position[joint] = at
            now.force[foot, :, 2] += 100.0 if loaded else 0.0

        def swing(now: Signals) -> None:
            still(now, loaded=False)
            now.velocity[knee] += rate * GEAR[knee]
            turned[knee] += rate * PERIOD

        assert robot.run(16, swing) == ()
        assert robot.run(300, lambda now: still(now, loaded=True)) == ()
        # When the foot is in the air again, only the torque since then is evaluated.
        robot.until_found(Dtc.ENC_STUCK, 64, lambda now: still(now, loaded=False))

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
        """The legs turn by less than the turn for which a constant reading of the other axes is reported."""
        robot = SimulatedRobot(amplitude=0.004)
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
    @pytest.mark.sample(7)
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
    """The standstill check, called directly for each sample instead of by the schedule."""

    rng = np.random.default_rng(4)

    def stillness(self, every: int = 16) -> tuple[Stillness, ReceiveImage, Signals]:
        image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        now = signals_of(CODEC, image.values)
        before = signals_of(CODEC, image.values_before)
        return Stillness(ROBOT, image, now, before, every, PERIOD), image, now

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
            stillness, image, now = self.stillness(every)
            for sample in range(repetitions + 2):
                image.values_before[:] = image.values
                self.move(now)
                hold(now)
                now.torque[:] = 12.0 * sample
                stillness.follow_joint(7, 1)
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
        assert not sample(2.0, new=True)  # the new value differs from the last sample
        for _ in range(4):
            assert not sample(2.0, new=True)
            assert not sample(2.0, new=False)
        assert sample(2.0, new=True)
        assert stillness.imus == [0]
        assert sample(3.0, new=False)
        assert not sample(3.0, new=True)
