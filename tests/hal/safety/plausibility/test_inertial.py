"""Inertial checks: IMUs whose readings contradict gravity, each other, or the other IMU of the trunk."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio
import pytest
from simulated_robot import PERIOD, ROBOT, SimulatedRobot, imus, only, signals, signs, specific_force

from atalante_hal.dbc_names import IMU_NODES
from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.imus import ImuLimits
from atalante_hal.safety.plausibility.inertial import FIRST_SAMPLES, SAMPLES, Inertial, to_world, turn_rate, upward
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.types import GRAVITY
from atalante_hal.wire.process_image import NEVER

TORSO, PELVIS = IMUS.index("torso"), IMUS.index("pelvis")
LIMITS = ImuLimits(ROBOT.sensors.quaternion_error, 40.0, 160.0)
INTERVALS = (15, 17)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
axes = pytest.mark.parametrize("axis", range(3))

#: Function that changes the signals of a sample in place.
Change = Callable[[Signals], object]


def turned(axis: int, angle: float) -> np.ndarray:
    """Return the attitude wxyz of a sensor that is turned about one of its axes [rad]."""
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2.0), math.sin(angle / 2.0)
    return quaternion


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    w, x, y, z = (pinocchio.Quaternion(*first.tolist()) * pinocchio.Quaternion(*second.tolist())).coeffs()[[3, 0, 1, 2]]
    return np.array([w, x, y, z])


class Turning:
    """The inertial checks of a robot whose IMUs turn about one axis, called directly.

    Args:
        rate: amplitude of the angular velocity [rad/s].
        axis: axis of the turn.
        base: attitude wxyz in the middle of the motion.
    """

    def __init__(self, rate: float = 0.0, axis: int = 0, base: np.ndarray = LEVEL) -> None:
        self.rate, self.axis, self.base = rate, axis, base
        self.now, self.time, self.samples = signals(), 0.0, 0
        self.checks = Inertial(ROBOT, self.now, LIMITS, INTERVALS, PERIOD)

    def sample(self, change: Change = lambda now: None, ages: Ages | None = None) -> bool:
        now, frequency = self.now, 4.0
        late = np.zeros(len(IMUS)) if ages is None else np.minimum(ages.imu, 100) * PERIOD
        for imu, delay in enumerate(late.tolist()):
            phase = frequency * (self.time - delay)
            now.quaternion[imu] = product(self.base, turned(self.axis, self.rate / frequency * math.sin(phase)))
            now.gyro[imu] = 0.0
            now.gyro[imu, self.axis] = self.rate * math.cos(phase)
            now.accel[imu] = specific_force(now.quaternion[imu])
        change(now)
        self.time += INTERVALS[self.samples % 2] * PERIOD
        self.samples += 1
        return self.checks.evaluate(ages)

    def until_found(self, samples: int, change: Change, ages: Ages | None = None) -> int:
        """Return the number of samples until the finding, at most `samples`; 0 if there is none."""
        return next((count for count in range(1, samples + 1) if self.sample(change, ages)), 0)


def ages(**imu: int) -> Ages:
    """Return the ages of all sensors: 0 except for the given IMUs."""
    found = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
    for name, age in imu.items():
        found.imu[IMUS.index(name)] = age
    return found


class TestForce:
    @imus
    @pytest.mark.parametrize(
        ("change", "error"),
        [
            (lambda accel: accel.__imul__(-1.0), 5.0),
            (lambda accel: accel.__imul__(1.35), 0.35 * GRAVITY),
            (lambda accel: accel.__imul__(0.65), 0.35 * GRAVITY),
            (lambda accel: accel.__setitem__(slice(None), accel[[2, 1, 0]].copy()), 5.0),
            (lambda accel: accel.__setitem__(slice(None), accel[[0, 2, 1]].copy()), 5.0),
            (lambda accel: accel.fill(0.0), 5.0),
        ],
    )
    def test_wrong_accelerometer_is_found_after_the_first_samples(self, imu: int, change, error: float):
        robot = Turning()
        assert robot.until_found(FIRST_SAMPLES[imu] + 2, lambda now: change(now.accel[imu])) == FIRST_SAMPLES[imu] + 1
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.IMU_IMPLAUSIBLE, IMU_NODES[imu], True)
        assert finding.value == pytest.approx(error, abs=1e-6)
        assert finding.text == (
            f"the accelerometer of the {IMUS[imu]} IMU contradicts gravity in the reported attitude by {error:.1f} m/s2"
        )
        assert robot.checks.implausible == {imu}

    @imus
    @axes
    @signs
    def test_error_is_compared_with_its_limit_along_each_axis(self, imu: int, axis: int, sign: float):
        for error, found in ((2.98, False), (3.02, True)):
            robot = Turning(base=product(turned(0, 0.4), turned(2, 1.0)))
            shift = sign * error * np.eye(3)[axis]
            assert bool(robot.until_found(100, lambda now, by=shift: now.accel[imu].__iadd__(by))) == found

    @imus
    @axes
    def test_tilted_attitude_is_found(self, imu: int, axis: int):
        robot = Turning()
        robot.until_found(20, lambda now: now.quaternion.__setitem__(imu, turned(axis, 0.4)))
        texts = [finding.text for finding in robot.checks.findings() if "gravity" in finding.text]
        assert len(texts) == (axis != 2)

    @imus
    def test_finding_ends_after_the_repair(self, imu: int):
        robot = Turning()
        robot.until_found(20, lambda now: now.accel[imu].__imul__(-1.0))
        assert 0 < next(count for count in range(200) if not robot.sample()) < SAMPLES
        assert robot.checks.findings() == ()

    @imus
    def test_later_fault_is_found_within_a_second_and_a_short_impact_is_not(self, imu: int):
        robot = Turning()
        for _ in range(3 * SAMPLES):
            assert not robot.sample()
        for _ in range(50):
            assert not robot.sample(lambda now: now.accel[imu].__iadd__(100.0))
        assert robot.until_found(20, lambda now: now.accel[imu].__iadd__(100.0)) in range(6, 12)
        assert robot.checks.findings()[0].value == pytest.approx(3.0, abs=0.06)

    @imus
    def test_error_is_averaged_in_world_axes(self, imu: int):
        """The specific force of a sensor that turns about a horizontal axis points in all directions of the sensor."""
        robot = Turning(rate=0.45, axis=1)
        assert not any(robot.sample() for _ in range(300))

    @imus
    @axes
    def test_fast_turn_is_not_compared_with_gravity(self, imu: int, axis: int):
        for rate, found in ((0.55, False), (0.45, True)):
            robot, angle = Turning(), 0.0
            for _ in range(50):
                angle += rate * PERIOD * INTERVALS[(robot.samples + 1) % 2]

                def change(now: Signals, angle: float = angle, rate: float = rate) -> None:
                    now.quaternion[:] = turned(axis, angle)
                    now.gyro[:] = 0.0
                    now.gyro[:, axis] = rate
                    now.accel[:] = specific_force(now.quaternion[0])
                    now.accel[imu] *= -1.0

                robot.sample(change)
            assert bool(robot.checks.findings()) == found


class TestRate:
    @imus
    @axes
    @pytest.mark.parametrize("gain", [0.7, 1.3])
    def test_small_error_of_the_gain_of_a_gyroscope_is_accepted(self, imu: int, axis: int, gain: float):
        robot = Turning(rate=0.4, axis=axis, base=product(turned(0, 1.0), turned(1, -0.7)))
        assert robot.until_found(150, lambda now: now.gyro[imu].__imul__(gain)) == 0
        assert robot.checks.findings() == ()
        assert robot.checks.implausible == frozenset()

    @imus
    @axes
    @pytest.mark.parametrize("gain", [-1.0, 0.1, 0.3, 1.9])
    def test_wrong_gain_of_a_gyroscope_is_found(self, imu: int, axis: int, gain: float):
        robot = Turning(rate=0.4, axis=axis, base=product(turned(0, 1.0), turned(1, -0.7)))
        robot.until_found(150, lambda now: now.gyro[imu].__imul__(gain))
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.IMU_IMPLAUSIBLE, IMU_NODES[imu], True)
        assert 0.1 < finding.value < abs(1.0 - gain) * 0.4
        text = (
            f"the gyroscope of the {IMUS[imu]} IMU contradicts the change of its attitude by {finding.value:.2f} rad/s"
        )
        assert finding.text == text
        assert robot.checks.implausible == {imu}

    @imus
    @axes
    @signs
    def test_error_of_a_gyroscope_at_rest_is_compared_with_its_limit(self, imu: int, axis: int, sign: float):
        for error, found in ((0.099, False), (0.101, True)):
            robot = Turning()
            shift = sign * error * np.eye(3)[axis]
            until = robot.until_found(100, lambda now, by=shift: now.gyro[imu].__iadd__(by))
            assert until == (FIRST_SAMPLES[imu] + 1 if found else 0)
            if found:
                assert only(robot.checks.findings()).value == pytest.approx(error)

    @imus
    @axes
    def test_exchanged_axes_of_a_gyroscope_are_found(self, imu: int, axis: int):
        robot, other = Turning(rate=0.3, axis=axis), (axis + 1) % 3
        pair = [axis, other]
        assert robot.until_found(60, lambda now: now.gyro[imu].__setitem__(pair, now.gyro[imu, pair[::-1]]))

    @pytest.mark.parametrize("rate", [0.2, 2.0])
    @axes
    def test_healthy_imus_are_accepted_with_both_signs_of_the_attitude(self, axis: int, rate: float):
        robot = Turning(rate=rate, axis=axis, base=product(turned(1, 0.3), turned(0, -0.2)))
        for sample in range(200):
            sign = -1.0 if sample % 3 else 1.0
            assert not robot.sample(lambda now, by=sign: now.quaternion.__imul__(by))

    def test_intervals_of_the_samples_alternate(self):
        robot = Turning(rate=3.0, axis=2)
        assert not any(robot.sample() for _ in range(200))
        robot = Turning(rate=3.0, axis=2)
        robot.checks = Inertial(ROBOT, robot.now, LIMITS, (40, 40), PERIOD)
        assert any(robot.sample() for _ in range(200))


def rotated(now: Signals, axis: int, angle: float) -> None:
    """Set the attitude of all IMUs, and the readings that healthy IMUs at rest report in this attitude."""
    now.quaternion[:] = turned(axis, angle)
    now.gyro[:] = 0.0
    now.accel[:] = specific_force(now.quaternion[0])


class TestConstantReading:
    @imus
    @axes
    @signs
    @pytest.mark.parametrize("repeats", [3, 4])
    def test_constant_gyroscope_is_found_while_the_imu_turns_slowly(
        self, imu: int, axis: int, sign: float, repeats: int
    ):
        """The rate is below the limit of the comparison of gyroscope and attitude."""
        robot, rate, angle = Turning(), sign * 0.09, 0.0
        robot.now.gyro[:, axis] = rate
        for sample in range(20):
            angle += rate * PERIOD * INTERVALS[(sample + 1) % 2]

            def change(now: Signals, sample: int = sample, angle: float = angle) -> None:
                rotated(now, axis, angle)
                noise = 0.001 * (sample % 2)
                now.gyro[:, axis] = rate + noise
                now.accel[:] += noise
                if sample > 10:
                    now.gyro[imu, axis] = -rate if sample <= 11 + repeats else rate + noise

            if robot.sample(change):
                assert repeats == 4
                break
        else:
            assert repeats == 3
            return
        assert sample == 11 + repeats
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.IMU_IMPLAUSIBLE, IMU_NODES[imu], True)
        assert finding.value == pytest.approx(2.0 * 0.09 * PERIOD * (2 * sum(INTERVALS)), rel=1e-3)
        assert finding.text == (
            f"one axis of the {IMUS[imu]} IMU has a constant reading while its attitude turns by "
            f"{math.degrees(finding.value):.1f} degrees"
        )
        assert robot.checks.implausible == {imu}

    @imus
    @axes
    @signs
    def test_constant_accelerometer_is_found_when_the_direction_of_gravity_changes(
        self, imu: int, axis: int, sign: float
    ):
        base = product(turned(0, 0.6), turned(1, 0.6))  # gravity has a component along each axis
        for turn, found in ((0.0099, False), (0.0101, True)):
            robot = Turning()
            up = upward(base)
            other = 1 if axis == 0 else 0
            start, step, last = up[axis], 0.0, base
            while abs(upward(last)[axis] - start) < turn:
                step += 1e-6
                last = product(base, turned(other, sign * step))
            for sample in range(10):
                part = product(base, turned(other, sign * step * max(0, sample - 5) / 4.0))
                rate = np.eye(3)[other] * (sign * step / (2 * sum(INTERVALS) * PERIOD) if sample > 5 else 0.0)

                def change(
                    now: Signals, sample: int = sample, part: np.ndarray = part, rate: np.ndarray = rate
                ) -> None:
                    now.quaternion[:] = part
                    noise = 0.001 * (1 + sample % 2)
                    now.gyro[:] = rate + noise
                    now.accel[:] = specific_force(part) + noise
                    if sample >= 5:
                        now.accel[imu, axis] = specific_force(base)[axis]

                result = robot.sample(change)
                assert result == (found and sample == 9)
            if found:
                finding = only(robot.checks.findings())
                assert finding.value == pytest.approx(turn, rel=1e-3)
                assert robot.checks.implausible == {imu}

    @imus
    def test_finding_stays_until_the_reading_changes(self, imu: int):
        """The turn back does not end the finding."""
        robot, angle = Turning(), 0.0
        for sample in range(40):
            angle += 0.09 * PERIOD * INTERVALS[(sample + 1) % 2] * (1.0 if sample < 20 else -1.0)

            def change(now: Signals, sample: int = sample, angle: float = angle) -> None:
                rotated(now, 1, angle)
                noise = 0.001 * (sample % 2)
                now.gyro[:, 1] = (0.09 if sample < 20 else -0.09) + noise
                now.accel[:] += noise
                now.gyro[imu, 1] = 0.0

            robot.sample(change)
        assert only(robot.checks.findings()).value == pytest.approx(0.01, abs=0.002)

        def healthy(now: Signals) -> None:
            now.gyro[:] = 0.0005

        assert not robot.sample(healthy)
        assert robot.checks.implausible == frozenset()

    @imus
    def test_imu_at_rest_or_with_a_frozen_attitude_is_not_found(self, imu: int):
        """An IMU that repeats all its values is reported by another check (F32)."""
        robot = Turning()
        robot.now.gyro[imu] = 0.09
        assert not any(robot.sample(lambda now: now.gyro[imu].fill(0.09)) for _ in range(100))

    def test_noise_of_one_code_and_a_constant_error_at_rest_are_accepted(self):
        """Gyroscope and attitude have the resolution of the DBC, and the attitude changes by one code."""
        robot, random = Turning(), np.random.default_rng(3)
        for _ in range(10_000):
            readings = 0.00125 * np.rint((0.03 / 0.00125) + random.standard_normal((len(IMUS), 3)))
            attitude = turned(1, 2.0 * 3.05e-5 * random.integers(2))

            def change(now: Signals, readings: np.ndarray = readings, attitude: np.ndarray = attitude) -> None:
                now.quaternion[:], now.gyro[:] = attitude, readings

            assert not robot.sample(change)

    @imus
    def test_changed_reading_ends_the_count_while_the_attitude_is_constant(self, imu: int):
        robot, angle = Turning(), 0.0
        for sample in range(60):
            if sample % 4:
                angle += 0.09 * PERIOD * INTERVALS[(sample + 1) % 2]

            def change(now: Signals, sample: int = sample, angle: float = angle) -> None:
                rotated(now, 1, angle)
                now.gyro[:] = now.accel[imu, 0] = 0.001 * (sample // 4 % 2)

            assert not robot.sample(change)

    @imus
    def test_lost_values_end_the_count(self, imu: int):
        robot, angle = Turning(), 0.0
        for sample in range(60):
            angle += 0.09 * PERIOD * INTERVALS[(sample + 1) % 2]
            lost = ages(**{IMUS[imu]: NEVER}) if sample % 4 == 3 else None

            def change(now: Signals, sample: int = sample, angle: float = angle) -> None:
                rotated(now, 1, angle)
                noise = 0.001 * (sample % 2)
                now.gyro[:, 1] = 0.09 + noise
                now.accel[:] += noise
                now.gyro[imu, 1] = 0.0

            assert not robot.sample(change, lost)

    @imus
    @pytest.mark.parametrize("accelerometer", [False, True])
    @pytest.mark.parametrize("skipped", ["lost", "saturated", "no attitude", ""])
    @pytest.mark.parametrize(("before", "after"), [((4, 0.18), (5, 0.03)), ((7, 0.0), (4, 0.3))])
    def test_skipped_sample_or_another_reading_ends_the_count(
        self, imu: int, skipped: str, accelerometer: bool, before: tuple[int, float], after: tuple[int, float]
    ):
        """The number of equal samples, or the missed turn, exceeds its limit only as the sum before and after this sample."""
        robot, angle, healthy = Turning(), 0.0, SAMPLES
        gap = healthy + before[0]
        for sample in range(gap + 1 + after[0]):
            rate = 0.0 if sample < healthy else before[1] if sample < gap else 0.0 if sample == gap else after[1]
            angle += rate * PERIOD * INTERVALS[(sample + 1) % 2]

            def change(now: Signals, sample: int = sample, angle: float = angle, rate: float = rate) -> None:
                rotated(now, 1, angle)
                noise = 0.001 * (1 + sample % 2)
                now.gyro[:, 1] = rate + noise
                now.accel[:] += noise
                if sample >= healthy:
                    constant = 0.0 if sample < gap else 0.01 if sample == gap else 0.004
                    if accelerometer:
                        now.accel[imu, 0] = constant
                    else:
                        now.gyro[imu, 1] = constant
                if sample == gap:
                    skip(now, imu, skipped)

            assert not robot.sample(change, ages(**{IMUS[imu]: NEVER}) if (sample, skipped) == (gap, "lost") else None)

    @imus
    @pytest.mark.parametrize(("skipped", "until"), [("lost", 20), ("saturated", 22), ("no attitude", 22)])
    def test_only_lost_values_or_another_reading_end_a_finding(self, imu: int, skipped: str, until: int):
        robot, angle = Turning(), 0.0
        for sample in range(23):
            angle += 0.09 * PERIOD * INTERVALS[(sample + 1) % 2]

            def change(now: Signals, sample: int = sample, angle: float = angle) -> None:
                rotated(now, 1, angle)
                noise = 0.001 * (1 + sample % 2)
                now.gyro[:, 1] = 0.09 + noise
                now.accel[:] += noise
                if sample < 20:
                    now.gyro[imu, 1] = 0.0
                if sample == 20:
                    skip(now, imu, skipped)

            found = robot.sample(change, ages(**{IMUS[imu]: NEVER}) if (sample, skipped) == (20, "lost") else None)
            assert sample < 10 or found == (sample < until)


def skip(now: Signals, imu: int, reason: str) -> None:
    """Change the values of an IMU so that the checks skip this sample for a reason; "lost" changes nothing."""
    if reason == "saturated":
        now.accel[imu, 0] = LIMITS.accel_end
    elif reason == "no attitude":
        now.quaternion[imu] *= 1.5


class TestPair:
    @pytest.mark.parametrize("imu", [TORSO, PELVIS])
    @pytest.mark.parametrize("axis", [0, 1])
    @signs
    def test_difference_in_tilt_is_found(self, imu: int, axis: int, sign: float):
        limit = 2.0 * ROBOT.sensors.attitude_error
        for base in (LEVEL, turned(1, 0.5)):
            for angle, found in ((0.98 * limit, False), (1.05 * limit, True)):
                robot = Turning(base=base)
                tilted = (
                    product(base, turned(axis, sign * angle))
                    if axis == 1
                    else product(turned(axis, sign * angle), base)
                )

                def tilt(now: Signals, tilted: np.ndarray = tilted) -> None:
                    now.quaternion[imu], now.accel[imu] = tilted, specific_force(tilted)

                assert robot.until_found(100, tilt) == (FIRST_SAMPLES[imu] + 1 if found else 0)
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO", True)
        assert finding.value == pytest.approx(1.05 * limit, rel=0.01)
        assert finding.text == "torso IMU and pelvis IMU contradict each other by 3.6 degrees of tilt"

    def test_difference_in_heading_is_accepted(self):
        robot = Turning(base=turned(1, 0.2))
        turn = product(turned(2, 1.5), turned(1, 0.2))
        assert not robot.until_found(100, lambda now: now.quaternion.__setitem__(TORSO, turn))

    @pytest.mark.parametrize("imu", [TORSO, PELVIS])
    def test_turned_mount_is_found_by_the_rate(self, imu: int):
        robot = Turning(rate=0.11)  # the difference in tilt is within its limit

        def turn(now: Signals) -> None:
            now.quaternion[imu] = product(now.quaternion[imu], turned(2, math.pi))
            now.gyro[imu, :2] *= -1.0
            now.accel[imu, :2] *= -1.0

        for _ in range(40):
            robot.sample(turn)
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node) == (Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO")
        assert finding.text == f"torso IMU and pelvis IMU contradict each other by {finding.value:.2f} rad/s"
        assert 0.11 < finding.value < 0.22
        assert robot.checks.implausible == frozenset()

    @pytest.mark.parametrize("imu", [TORSO, PELVIS])
    def test_pair_is_not_compared_if_one_imu_has_a_finding(self, imu: int):
        robot = Turning()

        def change(now: Signals) -> None:
            now.quaternion[imu] = turned(0, 0.5)
            now.gyro[imu] = 0.3

        assert robot.until_found(20, change)
        assert only(robot.checks.findings()).node == IMU_NODES[imu]

    def test_finding_of_a_tibia_does_not_hide_the_pair(self):
        robot = Turning()

        def change(now: Signals) -> None:
            now.quaternion[TORSO] = turned(0, 0.1)
            now.accel[TORSO] = specific_force(now.quaternion[TORSO])
            now.gyro[3] = 0.3

        for _ in range(30):
            robot.sample(change)
        assert [finding.node for finding in robot.checks.findings()] == ["IMU_RIGHT_TIBIA", "IMU_TORSO"]
        assert robot.checks.implausible == {IMUS.index("right_tibia")}  # torso or pelvis: unknown


class TestUnusedSamples:
    @imus
    @pytest.mark.parametrize(
        "change",
        [
            lambda now, imu: now.accel[imu].fill(160.0),
            lambda now, imu: now.gyro[imu].fill(-40.0),
            lambda now, imu: now.quaternion[imu].__imul__(1.1),
            lambda now, imu: now.quaternion[imu].fill(math.nan),
        ],
    )
    def test_sample_that_must_not_be_used_is_skipped(self, imu: int, change):
        robot = Turning()
        assert not any(robot.sample(lambda now: change(now, imu)) for _ in range(100))
        assert not any(robot.sample() for _ in range(100))

    @imus
    def test_old_values_are_skipped(self, imu: int):
        robot, old = Turning(), ages(**{IMUS[imu]: NEVER})
        assert not robot.until_found(100, lambda now: now.accel[imu].__imul__(-1.0), old)
        young = ages(**{IMUS[imu]: NEVER - 1})
        assert not robot.sample(lambda now: now.accel[imu].__imul__(-1.0), young)
        assert robot.until_found(30, lambda now: now.accel[imu].__imul__(-1.0), young) == FIRST_SAMPLES[imu]

    @imus
    def test_means_begin_again_after_a_fault_that_another_check_finds(self, imu: int):
        robot = Turning()
        for _ in range(100):
            robot.sample()

        def change(now: Signals) -> None:
            now.accel[imu] *= -1.0
            now.gyro[imu] = 0.5

        assert robot.until_found(60, change)
        assert not robot.sample(ages=ages(**{IMUS[imu]: NEVER}))
        assert not any(robot.sample() for _ in range(100))

    @pytest.mark.parametrize("imu", ["torso", "pelvis"])
    def test_pair_is_compared_only_if_both_are_usable(self, imu: str):
        robot = Turning()

        def tilt(now: Signals) -> None:
            now.quaternion[TORSO] = turned(0, 0.2)
            now.accel[TORSO] = specific_force(now.quaternion[TORSO])

        assert not robot.until_found(100, tilt, ages(**{imu: NEVER}))
        assert robot.until_found(100, tilt, ages(left_tibia=NEVER, right_tibia=NEVER)) == FIRST_SAMPLES[TORSO] + 1

    def test_change_of_the_age_changes_the_time_between_the_attitudes(self):
        robot = Turning(rate=3.0, axis=1)
        for sample in range(300):
            assert not robot.sample(ages=ages(left_tibia=9 * (sample % 2)))

    def test_attitude_before_a_gap_is_not_compared(self):
        robot = Turning()
        for sample in range(200):
            gap = ages(right_tibia=NEVER if sample % 2 else 0)
            assert not robot.sample(lambda now, by=0.3 * sample: now.quaternion.__setitem__(3, turned(2, by)), gap)


class TestFunctions:
    @pytest.mark.parametrize("seed", range(5))
    def test_rotations_agree_with_pinocchio(self, seed: int):
        rng = np.random.default_rng(seed)
        quaternion, vector = rng.standard_normal(4), rng.standard_normal(3)
        quaternion /= np.linalg.norm(quaternion)
        rotation = pinocchio.Quaternion(*quaternion.tolist()).toRotationMatrix()
        assert to_world(quaternion, vector) == pytest.approx((rotation @ vector).tolist())
        assert upward(quaternion) == pytest.approx(rotation[2].tolist())

    @axes
    @signs
    @pytest.mark.parametrize("seed", range(3))
    def test_turn_rate_is_the_angular_velocity_in_the_sensor_frame(self, axis: int, sign: float, seed: int):
        base = np.random.default_rng(seed).standard_normal(4)
        base /= np.linalg.norm(base)
        after = product(base, turned(axis, sign * 0.3 * 0.016))
        expected = (sign * 0.3 * np.eye(3)[axis]).tolist()
        assert turn_rate(base, after, 0.016) == pytest.approx(expected, abs=1e-4)
        assert turn_rate(base, -after, 0.016) == pytest.approx(expected, abs=1e-4)


class TestSchedule:
    def test_vibration_of_500_hz_has_no_effect(self):
        robot = SimulatedRobot(amplitude=0.0)

        def vibrate(now: Signals) -> None:
            now.accel[:, 0] += 9.0 if robot.cycles % 2 else -9.0

        for _ in range(1500):
            assert robot.cycle(vibrate) == ()

    @imus
    def test_wrong_sign_from_the_start_is_found_within_300_cycles(self, imu: int):
        robot = SimulatedRobot(amplitude=0.0)
        cycles = robot.until_found(Dtc.IMU_IMPLAUSIBLE, 300, lambda now: now.accel[imu].__imul__(-1.0))
        assert cycles == (76 if imu in (TORSO, PELVIS) else 268)
        assert robot.checks.implausible_imus == {imu}

    @imus
    def test_wrong_gyroscope_is_found_although_a_message_is_late(self, imu: int):
        robot = SimulatedRobot(amplitude=0.0, late=dict.fromkeys(range(19), 1))
        robot.until_found(Dtc.IMU_IMPLAUSIBLE, 300, lambda now: now.gyro[imu].__iadd__(0.2))

    @imus
    def test_imu_that_repeats_the_values_of_a_fast_turn_is_found_before_it_is_stuck(self, imu: int):
        robot = SimulatedRobot(amplitude=0.0)
        assert robot.run(1100) == ()

        def freeze(now: Signals) -> None:
            now.gyro[imu] = [0.0, 2.0, 0.0]

        cycles = robot.until_found(Dtc.IMU_IMPLAUSIBLE, 32, freeze)
        cycles += robot.until_found(Dtc.IMU_STUCK, 100 - cycles, freeze)
        robot.run(16, freeze)
        finding = only(robot.checks.findings)  # the values are not used any more
        assert (finding.dtc, finding.node) == (Dtc.IMU_STUCK, IMU_NODES[imu])
