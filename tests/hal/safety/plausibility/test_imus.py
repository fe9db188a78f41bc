"""IMU checks: saturated readings and quaternions without unit norm are rejected."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from simulated_robot import CODEC, MESSAGES, PERIOD, ROBOT, Change, SimulatedRobot, imus, only, row, signals, signs

from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.plausibility.imus import Imus
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.wire.process_image import ReceiveImage


class TestImuRange:
    @imus
    @pytest.mark.parametrize("quantity", ["gyro", "accel"])
    @pytest.mark.parametrize("axis", range(3))
    @signs
    def test_reading_at_end_of_range_is_rejected(self, imu: int, quantity: str, axis: int, sign: float):
        index = CODEC.index(f"IMU_{IMUS[imu].upper()}_STATE", f"{quantity.capitalize()}X")
        signal = CODEC.signals[index][1]
        robot = SimulatedRobot()
        robot.run(5)
        before = {name: getattr(robot.now, name)[imu].copy() for name in ("quaternion", "gyro", "accel")}

        def show(value: float) -> Change:
            return lambda now: getattr(now, quantity)[imu].__setitem__(axis, sign * value)

        assert robot.cycle(show(signal.maximum - signal.factor)) == ()
        before = {name: getattr(robot.now, name)[imu].copy() for name in before}
        finding = only(robot.cycle(show(signal.maximum)))
        assert (finding.dtc, finding.node) == (Dtc.IMU_SATURATED, f"IMU_{IMUS[imu].upper()}")
        assert finding.value == pytest.approx(signal.maximum)
        assert f"the {IMUS[imu]} IMU is saturated: its reading of {signal.maximum:.0f} is at the end" in finding.text
        assert robot.rejected == {row(f"IMU_{IMUS[imu]}"): 1}
        for name, value in before.items():
            assert np.array_equal(getattr(robot.now, name)[imu], value)
        assert robot.cycle() == ()

    @imus
    def test_saturation_is_confirmed_after_ten_cycles(self, imu: int):
        robot = SimulatedRobot()
        found = [only(robot.cycle(lambda now: now.gyro.__setitem__(imu, 40.95875))) for _ in range(11)]
        assert [f.confirmed for f in found] == [False] * 9 + [True] * 2
        assert robot.rejected == {row(f"IMU_{IMUS[imu]}"): 11}

    def test_strong_acceleration_of_all_imus_is_accepted(self):
        robot = SimulatedRobot()
        assert robot.cycle(lambda now: now.accel.__iadd__(30.0)) == ()


class TestQuaternion:
    @imus
    @pytest.mark.parametrize("phase", range(8))
    def test_norm_beyond_tolerance_is_rejected_in_the_same_cycle(self, imu: int, phase: int):
        allowed = ROBOT.sensors.quaternion_error
        robot = SimulatedRobot()
        robot.run(phase)
        for squared in (1.0 + allowed * (1.0 - 1e-9), 1.0 - allowed * (1.0 - 1e-9)):
            assert robot.run(9, lambda now, s=squared: now.quaternion[imu].__imul__(math.sqrt(s))) == ()
            assert not robot.rejected
            robot.cycle()
        for squared in (1.0 + allowed * (1.0 + 1e-9), 1.0 - allowed * (1.0 + 1e-9)):

            def stretch(now: Signals, squared: float = squared) -> None:
                now.quaternion[imu] *= math.sqrt(squared)

            finding = only(robot.cycle(stretch))
            assert (finding.dtc, finding.node) == (Dtc.IMU_INVALID, f"IMU_{IMUS[imu].upper()}")
            assert not finding.confirmed
            assert finding.value == pytest.approx(math.sqrt(squared))
            assert (
                f"quaternion of the {IMUS[imu]} IMU must have the norm 1, got {math.sqrt(squared):.3f}" in finding.text
            )
            assert robot.rejected == {row(f"IMU_{IMUS[imu]}"): 1}
            assert np.allclose(np.linalg.norm(robot.now.quaternion[imu]), 1.0)
            assert not only(robot.run(8, stretch)).confirmed
            assert only(robot.cycle(stretch)).confirmed
            assert robot.cycle() == ()
            assert robot.rejected == {}
            robot.run(40)  # until the leaky bucket of the rejected values is empty

    def test_imu_without_data_is_not_checked(self):
        image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        checks = Plausibility(ROBOT, image, PERIOD)
        for _ in range(40):
            image.new_cycle()
            assert checks.check() == ()

    @pytest.mark.parametrize("phase", [0, 5])
    def test_opposite_norm_errors_of_two_imus_are_both_reported(self, phase: int):
        robot = SimulatedRobot()
        robot.run(phase)

        def stretch(now: Signals) -> None:
            now.quaternion[1] *= math.sqrt(1.1)
            now.quaternion[3] *= math.sqrt(0.9)

        assert robot.cycle(stretch)
        assert [f.node for f in robot.checks.findings] == ["IMU_PELVIS", "IMU_RIGHT_TIBIA"]
        assert robot.rejected == {row("IMU_pelvis"): 1, row("IMU_right_tibia"): 1}


class TestImusAlone:
    """The IMU checks, called directly instead of by the schedule, exactly at thresholds that are binary fractions."""

    robot = replace(ROBOT, sensors=replace(ROBOT.sensors, quaternion_error=0.125))
    ends = tuple(
        signal.maximum - 0.5 * signal.factor
        for signal in (CODEC.signals[CODEC.index("IMU_TORSO_STATE", name)][1] for name in ("GyroX", "AccelX"))
    )

    def make(self) -> tuple[Imus, Signals]:
        now = signals()
        now.quaternion[:, 0] = 1.0
        return Imus(self.robot, CODEC, now), now

    @pytest.mark.parametrize(
        ("quaternion", "norm"),
        [
            ((1.0, 0.25, 0.25, 0.0), None),
            ((0.75, 0.5, 0.25, 0.0), None),
            ((1.0, 0.25, 0.25, 0.125), math.sqrt(1.140625)),
            ((0.75, 0.5, 0.125, 0.125), math.sqrt(0.84375)),
        ],
    )
    def test_norm_error_of_exactly_the_tolerance_is_accepted(self, quaternion: tuple[float, ...], norm: float | None):
        wrong = norm is not None
        for imu, turn in itertools.product(range(4), range(4)):
            imus, now = self.make()
            now.quaternion[imu] = np.roll(quaternion, turn)
            assert imus.usable() is not wrong
            assert imus.findings() == ()
            for cycles in (9, 10):
                assert imus.accept(imu, cycles, frozen=False) is not wrong
                assert imus.no_attitude == ({imu: norm} if wrong else {})
                assert [f.confirmed for f in imus.findings()] == [cycles == 10] * wrong

    @pytest.mark.parametrize("quantity", ["gyro", "accel"])
    @pytest.mark.parametrize("usable", [False, True])
    def test_reading_of_exactly_the_range_end_is_saturated(self, quantity: str, usable: bool):
        end = self.ends[quantity == "accel"]
        for imu, axis, sign in itertools.product(range(4), range(3), (1.0, -1.0)):
            imus, now = self.make()
            getattr(now, quantity)[imu, axis] = sign * (np.nextafter(end, 0.0) if usable else end)
            assert imus.usable() is usable
            for cycles in (9, 10):
                assert imus.accept(imu, cycles, frozen=False) is usable
                assert imus.saturated == ({} if usable else {imu: end})
                assert [f.confirmed for f in imus.findings()] == [cycles == 10] * (not usable)

    def test_frozen_imu_is_rejected_without_a_finding(self):
        imus, _ = self.make()
        assert not imus.accept(2, 1, frozen=True)
        assert imus.accept(2, 1, frozen=False)
        assert imus.findings() == ()


@imus
def test_frozen_imu_has_no_pending_diagnostic_because_the_standstill_check_reports_it(imu: int):
    now = signals()
    now.quaternion[:, 0] = 1.0
    checks = Imus(ROBOT, CODEC, now)
    assert not checks.accept(imu, 1, frozen=True)
    assert checks.tolerated(imu) is None
