"""Leg checks: encoders that drift or are stuck are found with the IMUs of the leg."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_robot import (
    CODEC,
    GEAR,
    MIDDLE,
    PERIOD,
    ROBOT,
    SimulatedRobot,
    attitudes,
    joints,
    only,
    row,
    signals,
    signs,
)

from atalante_hal.robot import IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.finding import Ages, Signals, signals_of
from atalante_hal.safety.plausibility.legs import Legs, _Contradiction, _forgotten, hip_angles
from atalante_hal.wire.process_image import NEVER

angles = st.floats(-1.2, 1.2)


class TestDrift:
    @given(st.lists(angles, min_size=12, max_size=12))
    def test_hip_angles_follow_from_pelvis_and_tibia_attitude(self, position: list[float]):
        q = np.array(position)
        quaternions = attitudes(q)
        for hip, tibia in ((0, IMUS.index("left_tibia")), (6, IMUS.index("right_tibia"))):
            found = hip_angles(quaternions[IMUS.index("pelvis")].tolist(), quaternions[tibia].tolist())
            expected = (q[hip], q[hip + 1], q[hip + 2] + q[hip + 3])
            assert found == pytest.approx(expected, abs=1e-9)
            turned = hip_angles((-quaternions[IMUS.index("pelvis")]).tolist(), quaternions[tibia].tolist())
            assert turned == pytest.approx(expected, abs=1e-9)

    @pytest.mark.parametrize("heading", [(0.5, 0.5, 0.5, 0.5), (0.5, -0.5, 0.5, 0.5), (0.1, 0.7, -0.1, 0.7)])
    def test_hip_angles_do_not_depend_on_heading(self, heading: tuple[float, ...]):
        """The robot of the tests hangs with its pelvis straight; a wearer walks where he likes."""
        position = np.array([0.2, -0.3, 0.5, 0.4, 0.0, 0.0] * 2)
        whole = pinocchio.Quaternion(np.array(heading)).normalized()
        quaternions = []
        for w, x, y, z in attitudes(position)[[IMUS.index("pelvis"), IMUS.index("left_tibia")]]:
            x, y, z, w = (whole * pinocchio.Quaternion(np.array([x, y, z, w]))).coeffs()
            quaternions.append([w, x, y, z])
        assert hip_angles(*quaternions) == pytest.approx((0.2, -0.3, 0.9), abs=1e-9)

    def test_sine_above_one_gives_a_right_angle(self):
        half = math.sqrt(0.5) * (1.0 + 1e-5)
        assert hip_angles([1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half])[1] == math.pi / 2.0
        assert hip_angles([1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, -half])[1] == -math.pi / 2.0

    @joints
    @signs
    def test_encoder_offset_beyond_threshold_is_reported_as_drift(self, joint: int, sign: float):
        allowed = ROBOT.sensors.attitude_error
        robot = SimulatedRobot(amplitude=0.0)
        offset = 0.0

        def off(now: Signals) -> None:
            now.position[joint] += offset * GEAR[joint]

        for offset in np.linspace(0.0, sign * allowed * (1.0 - 1e-6), 20):  # noqa: B007 - read by `off`
            robot.cycle(off)
        assert robot.run(200, off) == ()
        offset = sign * allowed * (1.0 + 1e-6)
        if JOINTS[joint].endswith(("SA", "HA")):  # the promised miss
            assert robot.run(400, off) == ()
            return
        assert 64 < robot.until_found(Dtc.ENC_DRIFT, 128, off) <= 128
        finding = only(robot.checks.findings)
        named = JOINTS[joint].replace("SK", "SH")
        assert finding.node == named.upper()
        assert finding.value == pytest.approx(offset, rel=1e-5)
        side, axis = JOINTS[joint].split("_")
        told = f"{side}_SH and {side}_SK" if axis in ("SH", "SK") else JOINTS[joint]
        assert finding.text == (
            f"encoder of {told}: {math.degrees(offset):+.1f} degrees off what pelvis and tibia IMU say"
        )
        robot.missing = {row("pendant")}
        assert only(robot.run(40, off)) is finding
        robot.missing = set()
        for offset in np.linspace(sign * allowed, 0.0, 20):  # noqa: B007 - read by `off`
            robot.cycle(off)
        assert robot.run(33, off) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    def test_encoder_angles_agree_modulo_a_full_turn(self, leg: int):
        now = signals_of(CODEC, np.zeros(CODEC.size))
        now.quaternion[:, 0] = 1.0
        legs = Legs(ROBOT, now, np.zeros(12, np.int64), PERIOD)
        for turn in (0.0, 2.0 * math.pi, -2.0 * math.pi):
            now.position[:] = (turn + np.array([0.05, -0.04, 0.03, 0.0] * 3)) * GEAR
            hip = 6 * leg
            now.position[hip : hip + 4] = (turn + np.array([0.05, -0.04, 0.03, -turn])) * GEAR[hip : hip + 4]
            assert legs._compare(leg, None).errors == pytest.approx((0.05, -0.04, 0.03), abs=1e-9)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("late", ["none", "joints", "pelvis", "tibia", "all"])
    def test_values_of_different_ages_are_extrapolated_to_this_cycle(self, leg: int, late: str):
        """All joints at their highest velocity, and a pelvis that turns; values up to four cycles old."""
        velocity, turning = ROBOT.velocity_max, np.array([0.5, -0.7, 0.9])
        tibia = IMUS.index(("left_tibia", "right_tibia")[leg])
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.joint[:] = 4 * (late in ("joints", "all"))
        ages.imu[IMUS.index("pelvis")] = 4 * (late in ("pelvis", "all"))
        ages.imu[tibia] = 4 * (late in ("tibia", "all"))

        def attitudes_at(time: float) -> np.ndarray:
            whole = pinocchio.Quaternion(pinocchio.exp3(turning * time))
            placed = [whole * pinocchio.Quaternion(w, x, y, z) for w, x, y, z in attitudes(MIDDLE + velocity * time)]
            return np.array([q.coeffs()[[3, 0, 1, 2]] for q in placed])

        now = signals()
        now.position[:] = (MIDDLE - velocity * PERIOD * ages.joint) * GEAR
        now.velocity[:] = velocity * GEAR
        for imu, age in enumerate(ages.imu.tolist()):
            w, x, y, z = now.quaternion[imu] = attitudes_at(-age * PERIOD)[imu]
            later = pinocchio.Quaternion(*attitudes_at(1e-6 - age * PERIOD)[imu])
            now.gyro[imu] = (
                pinocchio.log3((pinocchio.Quaternion(w, x, y, z).inverse() * later).toRotationMatrix()) / 1e-6
            )
        legs = Legs(ROBOT, now, np.zeros(12, np.int64), PERIOD)
        said = legs._compare(leg, ages)
        assert said is not None
        cycles = sum(ages.joint[:4]) + sum(ages.imu)
        assert said.doubt == pytest.approx(ROBOT.sensors.velocity_error * PERIOD * cycles)
        assert np.abs(said.errors).max() <= 1e-9 + 0.25 * said.doubt  # without being carried up to 32 mrad
        for values, needed in ((ages.joint, range(6 * leg, 6 * leg + 4)), (ages.imu, (IMUS.index("pelvis"), tibia))):
            for place in range(len(values)):
                kept, values[place] = values[place], NEVER
                assert (legs._compare(leg, ages) is None) is (place in needed)
                values[place] = kept

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("axis", range(3))
    def test_drift_needs_four_samples_beyond_the_exact_threshold(self, leg: int, axis: int):
        legs = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), np.zeros(12, np.int64), PERIOD)
        allowed = ROBOT.sensors.attitude_error
        for size, found in ((allowed, False), (np.nextafter(allowed, 1.0), True)):
            errors = [0.0] * 3
            errors[axis] = -float(size)
            for samples in range(1, 6):
                legs._judge_drift(leg, _Contradiction((0.0, 0.0, 0.0), (errors[0], errors[1], errors[2])))
                assert bool(legs.findings()) is (found and samples >= 4)

    @pytest.mark.parametrize("rate", [0.035, 0.05, 0.2])
    def test_slow_drift_is_found_within_1000_cycles(self, rate: float):
        robot = SimulatedRobot()
        begin = robot.cycles

        def drift(now: Signals) -> None:
            now.position[8] += rate * PERIOD * (robot.cycles - begin) * GEAR[8]

        robot.until_found(Dtc.ENC_DRIFT, 1000, drift)


class TestStandingEncoder:
    """An encoder that stands still while pelvis and tibia IMU say that its leg turns; must_not_be_called drives it."""

    allowed = ROBOT.sensors.attitude_change / (1.0 - ROBOT.sensors.misalignment)

    @staticmethod
    def standing(joint: int) -> tuple[SimulatedRobot, Callable[[float], None]]:
        """A robot that stands, and how to turn a joint whose encoder does not show it."""
        robot = SimulatedRobot(amplitude=0.0)
        turned = np.zeros(12)
        robot.position = lambda: MIDDLE + turned  # type: ignore[method-assign]
        robot.run(40)
        return robot, lambda angle: turned.__setitem__(joint, angle)

    @staticmethod
    def still(now: Signals) -> None:
        now.position[:] = MIDDLE * GEAR

    @joints
    @pytest.mark.parametrize("phase", [0, 9, 24])
    def test_stuck_encoder_is_found_without_torque(self, joint: int, phase: int):
        robot = SimulatedRobot(amplitude=0.1)
        robot.run(200 + phase, lambda now: now.torque.fill(0.0))
        stuck = float(robot.now.position[joint])

        def stick(now: Signals) -> None:
            now.position[joint] = stuck
            now.torque[:] = 0.0

        if JOINTS[joint].endswith(("SA", "HA")):  # the promised miss
            assert robot.run(400, stick) == ()
            return
        robot.until_found(Dtc.ENC_STUCK, 80, stick)
        finding = only(robot.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.text == (
            f"the encoder of {JOINTS[joint]} stands still while its leg turned by {math.degrees(finding.value):+.2f} degrees"
        )
        robot.missing = {row(f"IMU_{JOINTS[joint].split('_')[0]}_tibia")}
        assert robot.run(9, stick)[0] is finding

    @joints
    @signs
    def test_leg_turn_beyond_threshold_reports_stuck_encoder(self, joint: int, sign: float):
        if JOINTS[joint].endswith(("SA", "HA")):
            return
        robot, turn = self.standing(joint)
        turn(sign * 0.99 * self.allowed)
        assert robot.run(33, self.still) == ()
        robot, turn = self.standing(joint)
        turn(sign * 1.01 * self.allowed)
        assert 16 < robot.until_found(Dtc.ENC_STUCK, 48, self.still) <= 48
        pair = (
            {joint, joint ^ 1} if JOINTS[joint].endswith(("SH", "SK")) else {joint}
        )  # no attitude tells these two apart
        assert [f.node for f in robot.checks.findings] == [JOINTS[one].upper() for one in sorted(pair)]
        assert [f.value for f in robot.checks.findings] == pytest.approx([sign * 1.01 * self.allowed] * len(pair))
        turn(0.0)
        assert robot.run(33, self.still) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize(("place", "axis"), [(0, 0), (1, 1), (2, 2), (3, 2)])
    def test_two_samples_of_leg_turn_report_stuck_encoder(self, leg: int, place: int, axis: int):
        standing = np.zeros(12, np.int64)
        legs, joint = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), standing, PERIOD), 6 * leg + place

        def say(turned: float, change: float) -> list[float]:
            angles, errors = [0.1, -0.2, 0.3], [0.05, 0.06, -0.07]
            angles[axis] -= turned
            errors[axis] += change
            legs._judge_standstill(leg, _Contradiction(tuple(angles), tuple(errors)))  # type: ignore[arg-type]
            found = legs.findings()
            assert {f.node for f in found} <= {JOINTS[joint].upper()}
            return [f.value for f in found]

        for _ in range(2):
            standing[joint] = 0
            assert [say(0.5, 0.5), say(0.0, 0.0)] == [[], []]  # it moves
            standing[joint] = 1
            assert say(0.02, 0.02) == []
            assert say(0.02, 0.02) == pytest.approx([-0.02])
            assert say(-0.03, -0.03) == pytest.approx([0.03])
            assert [say(0.0, 0.0), say(0.02, 0.02)] == [[], []]
            # Neither a change without a turn nor a turn without a change is a standstill.
            assert [say(0.0, 0.5), say(0.0, 0.5), say(0.0, 0.5)] == [[]] * 3
            assert [say(0.5, 0.0), say(0.5, 0.0), say(0.5, 0.0)] == [[]] * 3

    def test_change_of_exactly_the_allowance_is_accepted(self):
        sensors, standing = ROBOT.sensors, np.zeros(12, np.int64)
        for turned in (0.0, 0.125, 0.5):
            allowed = sensors.attitude_change + sensors.misalignment * turned
            for change, found in ((allowed, False), (np.nextafter(allowed, 1.0), turned > 0.0)):
                legs = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), standing, PERIOD)
                standing[0] = 0
                legs._judge_standstill(0, _Contradiction((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
                standing[0] = 1
                for _ in range(2):
                    legs._judge_standstill(0, _Contradiction((0.0, turned, 0.0), (float(change), 0.0, 0.0)))
                assert bool(legs.findings()) is found

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize(
        ("change", "way"), [(0.5, 2e-5), (2.1e-5, 2e-5), (1e-5, 1e-5), (-1e-5, -1e-5), (-0.5, -2e-5)]
    )
    def test_slow_change_of_the_difference_is_ignored(self, axis: int, change: float, way: float):
        moved = _Contradiction((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
        now = _forgotten(moved, axis, change)
        assert now.angles == moved.angles
        errors = list(moved.errors)
        errors[axis] += way
        assert now.errors == tuple(errors)

    def test_leg_with_constant_encoder_is_compared_in_each_turn(self):
        standing, looked_at = np.zeros(12, np.int64), []
        legs = Legs(ROBOT, signals(), standing, PERIOD)

        too_old: set[int] = set()

        def compare(leg: int, _: object) -> _Contradiction | None:
            if leg in too_old:
                return None
            looked_at.append(leg)
            return _Contradiction((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

        legs._compare = compare  # type: ignore[method-assign]

        def look(judge: Callable[[None], bool]) -> list[int]:
            looked_at.clear()
            assert not judge(None)
            return looked_at.copy()

        left, right = legs.judge_left, legs.judge_right
        for stands, orders in (
            ([], ([0], [1])),
            ([0], ([0], [1, 0])),
            ([3], ([0], [1, 0])),
            ([4, 11], ([0], [1])),  # ankles
            ([6], ([0, 1], [1])),
            ([9], ([0, 1], [1])),
        ):
            standing[:] = np.isin(range(12), stands)
            assert (look(left), look(right)) == orders
        standing[:] = 0
        for leg, judge in enumerate((right, left)):
            legs._stuck[leg] = (Finding(Dtc.ENC_STUCK, "", 0.0, True, ""),)
            assert look(judge) == [1 - leg, leg]
        standing[:] = 1
        for leg in (0, 1):
            too_old = {leg}
            assert look(left) == look(right) == [1 - leg]

    def test_one_sample_of_leg_turn_reports_nothing(self):
        robot, turn = self.standing(JOINTS.index("left_TH"))
        for _ in range(5):
            turn(0.1)
            assert robot.run(16, self.still) == ()
            turn(0.0)
            assert robot.run(16, self.still) == ()

    def test_misaligned_imu_of_turning_leg_reports_nothing(self):
        robot, turn = self.standing(JOINTS.index("left_SH"))
        askew = pinocchio.Quaternion(np.array([0.0, 0.0, math.sin(math.radians(0.4)), math.cos(math.radians(0.4))]))
        tibia, begin = IMUS.index("left_tibia"), robot.cycles

        def mounted(now: Signals) -> None:
            angle = -1.25 * PERIOD * (robot.cycles - begin)
            turn(angle)
            now.position[:] = MIDDLE * GEAR
            now.position[2] += angle * GEAR[2]
            now.velocity[2] = -1.25 * GEAR[2]
            w, x, y, z = now.quaternion[tibia]
            x, y, z, w = (pinocchio.Quaternion(np.array([x, y, z, w])) * askew).coeffs()
            now.quaternion[tibia] = w, x, y, z

        assert robot.run(400, mounted) == ()

    @pytest.mark.exhaustive
    def test_heading_drift_of_imu_at_standstill_reports_nothing(self):
        robot = SimulatedRobot(amplitude=0.0)

        def drift(now: Signals) -> None:
            half = 0.5 * 1.1e-3 * robot.time
            w, x, y, z = now.quaternion[1]
            c, s = math.cos(half), math.sin(half)
            now.quaternion[1] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w

        assert robot.run(6500, drift) == ()
