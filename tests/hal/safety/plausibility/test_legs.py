"""Leg checks: encoders that drift or are stuck are found with the IMUs of the leg."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_robot import (
    GEAR,
    MIDDLE,
    PERIOD,
    ROBOT,
    SimulatedRobot,
    attitudes,
    only,
    row,
    signals,
    signs,
)

from atalante_emulator.imu import AttitudeError
from atalante_emulator.mechanics import GROUND_PARAMETERS
from atalante_hal.robot import IMUS, JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.inertial import turned_about_vertical
from atalante_hal.safety.plausibility.legs import DRIFT_SAMPLES, SILENT_SAMPLES, Legs, hip_angles
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.wire.process_image import NEVER

PELVIS, TIBIAE = IMUS.index("pelvis"), [IMUS.index(f"{side}_tibia") for side in ("left", "right")]
#: Names of the joints with an IMU below them, and of the joints without one.
ABOVE_IMU = [name for name in JOINTS if not name.endswith(("SA", "HA"))]
WITHOUT_IMU = [name for name in JOINTS if name not in ABOVE_IMU]
joints_above_imu = pytest.mark.parametrize("joint", [JOINTS.index(name) for name in ABOVE_IMU], ids=ABOVE_IMU)
joints_without_imu = pytest.mark.parametrize("joint", [JOINTS.index(name) for name in WITHOUT_IMU], ids=WITHOUT_IMU)
IDENTITY = [1.0, 0.0, 0.0, 0.0]
UNIT_GEAR = replace(ROBOT, gear=np.ones(12), polarity=np.ones(12))


def tibia_attitude(fh: float, th: float, sagittal: float) -> list[float]:
    """Return the quaternion wxyz of Rx(fh) Rz(th) Ry(sagittal), the attitude of a tibia whose pelvis is upright."""
    axes = ((fh, (1.0, 0.0, 0.0)), (th, (0.0, 0.0, 1.0)), (sagittal, (0.0, 1.0, 0.0)))
    turn = pinocchio.Quaternion.Identity()
    for angle, axis in axes:
        turn = turn * pinocchio.Quaternion(pinocchio.AngleAxis(angle, np.array(axis)))
    x, y, z, w = turn.coeffs().tolist()
    return [w, x, y, z]


def product(first: Sequence[float], second: Sequence[float]) -> list[float]:
    """Return the product of two quaternions wxyz."""
    turn = pinocchio.Quaternion(*first) * pinocchio.Quaternion(*second)
    x, y, z, w = turn.coeffs().tolist()
    return [w, x, y, z]


def tilted(roll: float, pitch: float, yaw: float = 0.0) -> list[float]:
    """Return the attitude of a pelvis with these angles [rad], quaternion wxyz."""
    x, y, z, w = pinocchio.Quaternion(pinocchio.rpy.rpyToMatrix(roll, pitch, yaw)).coeffs().tolist()
    return [w, x, y, z]


class OneLeg:
    """Checks of the legs, with one leg under test. At first, pelvis and tibiae are upright.

    Args:
        leg: index of the leg under test.
        robot: robot with its gear ratios. Default: gear ratio and polarity 1, so that joint positions are exact.
        now: signals. None: all joints are at zero, and all IMUs are upright.
        attitude_error: drift threshold [rad]. Infinity switches the drift check off. With 0, the estimated heading drift is 0.
    """

    def __init__(
        self,
        leg: int,
        *,
        robot: Robot = UNIT_GEAR,
        now: Signals | None = None,
        attitude_error: float = ROBOT.sensors.attitude_error,
    ) -> None:
        self.leg = leg
        self.now = signals() if now is None else now
        if now is None:
            self.now.quaternion[:] = IDENTITY
        self.standing = np.zeros(12, np.int64)
        robot = replace(robot, sensors=replace(robot.sensors, attitude_error=attitude_error))
        self.legs = Legs(robot, self.now, self.standing, PERIOD)

    def show(self, angles: Sequence[float], errors: Sequence[float]) -> None:
        """Set the IMUs to the angles FH, TH and SH + SK [rad], and the encoders to these angles plus the errors [rad]."""
        side = ("left", "right")[self.leg]
        self.now.quaternion[IMUS.index(f"{side}_tibia")] = tibia_attitude(*angles)
        self.now.position[6 * self.leg : 6 * self.leg + 3] = np.add(angles, errors)

    def compare(self, samples: int = 1, ages: Ages | None = None) -> None:
        """Run the check of the leg under test once per sample."""
        check = (self.legs.check_left, self.legs.check_right)[self.leg]
        for _ in range(samples):
            check(ages)

    def stuck(self) -> tuple[Finding, ...]:
        """Return the findings of stuck encoders."""
        return tuple(finding for finding in self.legs.findings() if finding.dtc is Dtc.ENC_STUCK)

    def drifts(self) -> list[float]:
        """Return the errors that are reported as a drift [rad]."""
        return [finding.value for finding in self.legs.findings() if finding.dtc is Dtc.ENC_DRIFT]


def tilted_leg(one_leg: OneLeg, imu: str) -> tuple[int, Callable[[float, float], None]]:
    """Return the index of an IMU in IMUS, and a function that compares the leg four times while the pelvis is tilted.

    The arguments of the function are the error of TH and the angle by which the heading of the IMU is wrong [rad].
    """
    tibia = TIBIAE[one_leg.leg]
    restarted = PELVIS if imu == "pelvis" else tibia

    def compare(th: float, heading: float) -> None:
        one_leg.show((0.2, -0.3, -0.5), (0.01, th, -0.02))
        quaternion = one_leg.now.quaternion
        quaternion[PELVIS] = tilted(0.2, -0.1, 0.5)
        quaternion[tibia] = product(tilted(0.2, -0.1, 0.5), quaternion[tibia].tolist())
        quaternion[restarted] = product(tilted(0.0, 0.0, heading), quaternion[restarted].tolist())
        one_leg.compare(4)

    return restarted, compare


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
        """The simulated robot keeps its pelvis upright, so this test uses arbitrary attitudes of the pelvis."""
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

    @joints_above_imu
    @signs
    @pytest.mark.sample(5)
    def test_encoder_offset_beyond_threshold_is_reported_as_drift(self, joint: int, sign: float):
        allowed = ROBOT.sensors.attitude_error
        robot = SimulatedRobot(amplitude=0.0)
        offset = 0.0

        def off(now: Signals) -> None:
            now.position[joint] += offset * GEAR[joint]

        for offset in np.linspace(0.0, sign * allowed * (1.0 - 1e-6), 20):  # noqa: B007 - read by `off`
            robot.cycle(off)
        assert robot.run(200, off) == ()
        # The check regards a small part of an offset of TH as a drift of the IMU headings.
        heading = 1e-4 if JOINTS[joint].endswith("TH") else 0.0
        offset = sign * (allowed * (1.0 + 1e-6) + heading)
        assert 64 < robot.until_found(Dtc.ENC_DRIFT, 128, off) <= 128
        finding = only(robot.checks.findings)
        named = JOINTS[joint].replace("SK", "SH")
        assert finding.node == named.upper()
        assert finding.value == pytest.approx(offset, rel=1e-5, abs=heading)
        side, axis = JOINTS[joint].split("_")
        named_joints = f"{side}_SH and {side}_SK" if axis in ("SH", "SK") else JOINTS[joint]
        degrees = f"{math.degrees(finding.value):+.1f} degrees"
        assert finding.text == f"encoder of {named_joints}: its angle differs by {degrees} from pelvis and tibia IMU"
        robot.missing = {row("pendant")}
        assert only(robot.run(40, off)) is finding
        robot.missing = set()
        for offset in np.linspace(sign * allowed, 0.0, 20):  # noqa: B007 - read by `off`
            robot.cycle(off)
        assert robot.run(33, off) == ()

    @joints_without_imu
    @signs
    @pytest.mark.sample(5)
    def test_encoder_offset_of_a_joint_without_imu_is_not_reported(self, joint: int, sign: float):
        """The offset reaches twice the threshold slowly, because a jump of the encoder is reported."""
        robot = SimulatedRobot(amplitude=0.0)
        for offset in np.linspace(0.0, 2.0 * sign * ROBOT.sensors.attitude_error, 40) * GEAR[joint]:
            robot.cycle(lambda now, by=offset: now.position.__setitem__(joint, now.position[joint] + by))
        assert robot.run(400, lambda now: now.position.__setitem__(joint, now.position[joint] + offset)) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    def test_encoder_angles_agree_modulo_a_full_turn(self, leg: int):
        hip, zero = 6 * leg, np.array([0.05, -0.04, 0.03, 0.0])
        for turn in (0.0, 2.0 * math.pi, -2.0 * math.pi):
            one_leg = OneLeg(leg, attitude_error=0.0)
            angles = turn + zero
            angles[3] = 0.0
            one_leg.now.position[hip : hip + 4] = angles
            one_leg.compare(4)
            assert one_leg.drifts() == pytest.approx([0.05, -0.04, 0.03], abs=1e-9)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("late", ["none", "joints", "pelvis", "tibia", "all"])
    def test_values_of_different_ages_are_extrapolated_to_this_cycle(self, leg: int, late: str):
        """All joints move at their highest velocity, and the pelvis turns. The values are up to four cycles old."""
        velocity, turning = ROBOT.velocity_max, np.array([0.5, -0.7, 0.9])
        tibia = IMUS.index(("left_tibia", "right_tibia")[leg])
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.joint[:] = 4 * (late in ("joints", "all"))
        ages.imu[IMUS.index("pelvis")] = 4 * (late in ("pelvis", "all"))
        ages.imu[tibia] = 4 * (late in ("tibia", "all"))

        def attitudes_at(time: float) -> np.ndarray:
            whole = pinocchio.Quaternion(pinocchio.exp3(turning * time))
            rotated = [whole * pinocchio.Quaternion(w, x, y, z) for w, x, y, z in attitudes(MIDDLE + velocity * time)]
            return np.array([q.coeffs()[[3, 0, 1, 2]] for q in rotated])

        now = signals()
        now.position[:] = (MIDDLE - velocity * PERIOD * ages.joint) * GEAR
        now.velocity[:] = velocity * GEAR
        for imu, age in enumerate(ages.imu.tolist()):
            w, x, y, z = now.quaternion[imu] = attitudes_at(-age * PERIOD)[imu]
            later = pinocchio.Quaternion(*attitudes_at(1e-6 - age * PERIOD)[imu])
            now.gyro[imu] = (
                pinocchio.log3((pinocchio.Quaternion(w, x, y, z).inverse() * later).toRotationMatrix()) / 1e-6
            )
        cycles = sum(ages.joint[:4]) + sum(ages.imu)
        uncertainty = ROBOT.sensors.velocity_error * PERIOD * cycles

        def drifts(attitude_error: float) -> list[float]:
            checked = OneLeg(leg, robot=ROBOT, now=now, attitude_error=attitude_error)
            checked.compare(4, ages)
            return checked.drifts()

        # The threshold is extended by `uncertainty`: an `attitude_error` of minus infinity shows every error.
        assert drifts(1e-9 - 0.75 * uncertainty) == []  # without extrapolation the errors are up to 32 mrad
        errors = drifts(-math.inf)
        assert len(errors) == 3
        threshold = min(map(abs, errors)) - uncertainty
        assert len(drifts(threshold - 1e-12)) == 3
        assert len(drifts(threshold + 1e-12)) < 3
        for values, needed in ((ages.joint, range(6 * leg, 6 * leg + 4)), (ages.imu, (IMUS.index("pelvis"), tibia))):
            for index in range(len(values)):
                kept, values[index] = values[index], NEVER
                assert (drifts(-math.inf) == []) is (index in needed)
                values[index] = kept

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("axis", range(3))
    def test_drift_needs_four_samples_beyond_the_exact_threshold(self, leg: int, axis: int):
        allowed = ROBOT.sensors.attitude_error
        for size, found in ((allowed, False), (np.nextafter(allowed, 1.0), True)):
            one_leg = OneLeg(leg)
            one_leg.now.position[6 * leg + axis] = -float(size)
            for samples in range(1, 6):
                one_leg.compare()
                assert bool(one_leg.drifts()) is (found and samples >= 4)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_slow_heading_drift_is_not_reported_as_encoder_drift(self, leg: int, sign: float):
        one_leg, allowed = OneLeg(leg), ROBOT.sensors.attitude_error
        for sample in range(5000):
            one_leg.show((0.0, 0.0, 0.0), (0.0, sign * 1e-5 * sample, 0.0))
            one_leg.compare()
            assert one_leg.drifts() == []
        drifted = sign * 1e-5 * 4999
        for error in (drifted + allowed + 1e-9, drifted - allowed - 1e-9):
            one_leg.show((0.0, 0.0, 0.0), (0.0, error, 0.0))
            one_leg.compare(4)
            assert one_leg.drifts() == pytest.approx([error - drifted], abs=1e-12)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_heading_difference_is_corrected_at_a_limited_rate(self, leg: int, sign: float):
        allowed = ROBOT.sensors.attitude_error
        for beyond, found in ((-1e-9, False), (1e-9, True)):
            one_leg = OneLeg(leg)
            one_leg.show((0.0, 0.0, 0.0), (0.0, sign * 0.02, 0.0))
            one_leg.compare(100)
            error = sign * (allowed + 100 * 1e-5 + beyond)
            one_leg.show((0.0, 0.0, 0.0), (0.0, error, 0.0))
            one_leg.compare(10_000 if found else 4)
            expected = [error - sign * 100 * 1e-5] if found else []
            assert one_leg.drifts() == pytest.approx(expected, abs=1e-12)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("imu", ["pelvis", "tibia"])
    @pytest.mark.parametrize("turn", [-2.8, 0.05, 1.5])
    def test_other_heading_of_a_restarted_imu_is_no_drift_and_an_offset_of_th_is_still_found(
        self, leg: int, imu: str, turn: float
    ):
        one_leg, allowed = OneLeg(leg), ROBOT.sensors.attitude_error
        restarted, compare = tilted_leg(one_leg, imu)
        one_leg.legs.restart_heading(restarted)  # has no effect before the first comparison
        compare(0.0, 0.0)
        compare(0.015, 0.0)
        before = one_leg.legs.encoder_error.copy()
        one_leg.legs.restart_heading(IMUS.index("torso"))
        one_leg.legs.restart_heading(TIBIAE[1 - leg])
        one_leg.legs.restart_heading(restarted)
        compare(0.015, turn)
        assert one_leg.drifts() == []
        assert one_leg.legs.encoder_error == pytest.approx(before, abs=1e-4)
        for error in (allowed - 1e-3, allowed + 1e-3, -allowed + 1e-3, -allowed - 1e-3):
            compare(error, turn)
            assert bool(one_leg.drifts()) is (abs(error) > allowed)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("error", [0.029, -0.029, 0.031, -0.031])
    def test_first_error_of_sh_and_sk_is_the_angle_by_which_the_tibia_imu_is_mounted_askew(
        self, leg: int, error: float
    ):
        one_leg, allowed = OneLeg(leg), ROBOT.sensors.attitude_error
        assert one_leg.legs.tilt.tolist() == [[1.0, 0.0]] * 2
        for later in (error, 0.01, -0.05):
            one_leg.show((0.1, 0.2, 0.3), (0.005, -0.005, later))
            one_leg.compare(10)
            half = 0.5 * error if abs(error) <= allowed else 0.0
            assert one_leg.legs.tilt[leg] == pytest.approx([math.cos(half), math.sin(half)], abs=1e-12)
            assert one_leg.legs.tilt[1 - leg].tolist() == [1.0, 0.0]

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("imu", ["pelvis", "tibia"])
    @pytest.mark.parametrize(("before", "turn"), [(0.1, -2.8), (0.1, 0.0), (-0.1, 0.3), (0.02, 0.0), (0.031, 0.015)])
    def test_offset_of_th_ends_if_its_drive_is_referenced_while_an_imu_restarts(
        self, leg: int, imu: str, before: float, turn: float
    ):
        one_leg, allowed = OneLeg(leg), ROBOT.sensors.attitude_error
        restarted, compare = tilted_leg(one_leg, imu)
        compare(0.0, 0.0)
        compare(before, 0.0)
        assert bool(one_leg.drifts()) is (abs(before) > allowed)
        one_leg.legs.reference(6 * leg + 1)
        one_leg.legs.restart_heading(restarted)
        compare(0.0, turn)
        assert one_leg.drifts() == []
        assert abs(one_leg.legs.encoder_error[6 * leg + 1]) < 1e-3
        for error in (allowed - 1e-3, allowed + 1e-3, -allowed + 1e-3, -allowed - 1e-3):
            compare(error, turn)
            assert bool(one_leg.drifts()) is (abs(error) > allowed)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("imu", ["pelvis", "tibia"])
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    @pytest.mark.parametrize(
        ("restarts", "turn"),
        [
            (("TH", "imu"), 0.0), (("imu", "TH"), 0.025), (("TH",), 0.0), (("imu",), 0.8), (("TH", "compare", "imu"), 0.8),
            (("imu", "compare", "TH"), 0.8), (("FH", "other TH", "imu"), 0.8),
        ],
    )  # fmt: skip
    def test_offset_of_th_that_remains_is_still_found(
        self, leg: int, imu: str, sign: float, restarts: tuple[str, ...], turn: float
    ):
        """The heading changes in the restart of the IMU by `turn`. An unchanged heading proves that the offset remains."""
        one_leg, error, heading = OneLeg(leg), 0.1 * sign, 0.0
        restarted, compare = tilted_leg(one_leg, imu)
        drives = {"FH": 6 * leg, "TH": 6 * leg + 1, "other TH": 6 * (1 - leg) + 1}
        compare(0.0, heading)
        compare(error, heading)
        for restart in restarts:
            if restart == "imu":
                one_leg.legs.restart_heading(restarted)
                heading = turn
            elif restart == "compare":
                compare(error, heading)
            else:
                one_leg.legs.reference(drives[restart])
        compare(error, heading)
        assert one_leg.drifts() == pytest.approx([error], abs=2e-3)

    @pytest.mark.parametrize("imu", IMUS[1:])
    def test_restart_of_an_imu_with_another_heading_causes_no_finding(self, imu: str):
        robot, index = SimulatedRobot(), IMUS.index(imu)
        robot.run(100)
        robot.missing = {row(f"imu_{imu}")}
        robot.run(50)
        robot.missing = set()
        robot.checks.reference(f"IMU_{imu.upper()}")

        def turned(now: Signals) -> None:
            now.quaternion[index] = product(tilted(0.0, 0.0, 0.7), now.quaternion[index].tolist())

        assert [found for found in robot.run(500, turned) if found.dtc is Dtc.ENC_DRIFT] == []

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("axis", [0, 2])
    def test_slow_drift_about_the_other_axes_is_found(self, leg: int, axis: int):
        one_leg, allowed = OneLeg(leg), ROBOT.sensors.attitude_error
        for sample in range(3100):
            one_leg.show((0.0, 0.0, 0.0), [1e-5 * sample if k == axis else 0.0 for k in range(3)])
            one_leg.compare()
            assert bool(one_leg.drifts()) is (1e-5 * (sample - 3) > allowed)

    @pytest.mark.parametrize("leg", [0, 1])
    def test_heading_correction_of_the_other_leg_has_no_effect(self, leg: int):
        one_leg, other = OneLeg(leg), 1 - leg
        one_leg.now.position[6 * other + 1] = 0.02
        for _ in range(100):
            (one_leg.legs.check_left, one_leg.legs.check_right)[other](None)
        one_leg.show((0.0, 0.0, 0.0), (0.0, ROBOT.sensors.attitude_error + 1e-9, 0.0))
        one_leg.compare(4)
        assert len(one_leg.drifts()) == 1

    @pytest.mark.parametrize("rate", [0.035, 0.05, 0.2])
    def test_slow_drift_is_found_within_1000_cycles(self, rate: float):
        robot = SimulatedRobot()
        begin = robot.cycles

        def drift(now: Signals) -> None:
            now.position[8] += rate * PERIOD * (robot.cycles - begin) * GEAR[8]

        robot.until_found(Dtc.ENC_DRIFT, 1000, drift)


class TestEncoderError:
    @pytest.mark.parametrize("leg", [0, 1])
    def test_each_sample_writes_the_errors_of_its_leg(self, leg: int):
        one_leg = OneLeg(leg)
        one_leg.show((0.1, 0.2, 0.3), (0.02, -0.03, 0.04))
        one_leg.compare()
        hip, expected = 6 * leg, np.full(12, math.inf)
        expected[hip : hip + 4] = 0.02, -0.03, 0.04, 0.04
        assert one_leg.legs.encoder_error == pytest.approx(expected, abs=1e-9)

    def test_error_is_infinite_if_a_value_is_too_old(self):
        one_leg = OneLeg(0)
        one_leg.compare()
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.joint[1] = NEVER
        one_leg.compare(1, ages)
        assert np.isinf(one_leg.legs.encoder_error).all()
        one_leg.compare()
        assert np.isfinite(one_leg.legs.encoder_error[:4]).all()

    @staticmethod
    def silent(imu: int) -> Ages:
        """Return the ages of new values, except those of one IMU."""
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.imu[imu] = NEVER
        return ages

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("imu", ["pelvis", "tibia"])
    @pytest.mark.parametrize("restarts", [False, True])
    def test_leg_is_compared_after_a_status_message_of_an_imu_that_was_silent(self, leg: int, imu: str, restarts: bool):
        """The status message arrives in each of the waiting times of up to `SILENT_SAMPLES` samples."""
        for samples in range(SILENT_SAMPLES + 1):
            one_leg = OneLeg(leg)
            restarted, compare = tilted_leg(one_leg, imu)
            error = one_leg.legs.encoder_error[6 * leg : 6 * leg + 4]
            one_leg.compare(3, self.silent(restarted))
            compare(0.0, 0.0)
            assert np.isfinite(error).all(), "a leg is compared at once if it was never compared before"
            one_leg.compare(3, self.silent(restarted))
            for _ in range(samples):
                one_leg.compare()
                assert np.isinf(error).all()
            if restarts:
                one_leg.legs.restart_heading(restarted)
                compare(0.0, 0.9)
                assert one_leg.drifts() == []
                assert np.isfinite(error).all()
        if not restarts:
            compare(0.05, 0.0)
            assert one_leg.drifts() == pytest.approx([0.05], abs=2e-3)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("imu", ["pelvis", "tibia"])
    @pytest.mark.parametrize("samples", [2, 4, SILENT_SAMPLES + 1, SILENT_SAMPLES + 4])
    def test_imu_that_is_silent_again_and_again_does_not_hide_a_drift(self, leg: int, imu: str, samples: int):
        """The IMU is silent in one of `samples` samples. The leg waits again only after `DRIFT_SAMPLES` comparisons."""
        one_leg = OneLeg(leg)
        silent = PELVIS if imu == "pelvis" else TIBIAE[leg]
        one_leg.compare(DRIFT_SAMPLES)
        one_leg.show((0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
        compared = []
        for sample in range(5 * (SILENT_SAMPLES + DRIFT_SAMPLES)):
            one_leg.compare(1, self.silent(silent) if sample % samples == 0 else None)
            compared.append(math.isfinite(one_leg.legs.encoder_error[6 * leg]))
            if sample == SILENT_SAMPLES + 2 * DRIFT_SAMPLES:
                assert one_leg.drifts() == pytest.approx([0.05])
        waits = "".join("x" if one else " " for one in compared).split("x")
        assert len(max(waits)) <= SILENT_SAMPLES + 2
        assert sum(len(wait) > SILENT_SAMPLES for wait in waits) >= 2, "the leg waits again"

    @pytest.mark.parametrize("compared", [DRIFT_SAMPLES - 1, DRIFT_SAMPLES])
    def test_leg_waits_only_after_some_comparisons(self, compared: int):
        one_leg = OneLeg(0)
        one_leg.compare(compared)
        one_leg.compare(1, self.silent(PELVIS))
        one_leg.compare()
        assert math.isinf(one_leg.legs.encoder_error[0]) is (compared == DRIFT_SAMPLES)

    def test_leg_waits_from_the_end_of_a_long_silence(self):
        one_leg = OneLeg(0)
        one_leg.compare(DRIFT_SAMPLES)
        one_leg.compare(3 * SILENT_SAMPLES, self.silent(PELVIS))
        for sample in range(SILENT_SAMPLES + 1):
            one_leg.compare()
            assert math.isinf(one_leg.legs.encoder_error[0]) is (sample < SILENT_SAMPLES)

    def test_silent_imu_of_the_other_leg_has_no_effect(self):
        one_leg = OneLeg(0)
        one_leg.compare()
        one_leg.compare(1, self.silent(TIBIAE[1]))
        one_leg.compare(1, self.silent(IMUS.index("torso")))
        assert np.isfinite(one_leg.legs.encoder_error[:4]).all()


class TestExchange:
    """The encoders of a joint are exchanged between the legs, so each leg has the reading of the other leg."""

    ALLOWED = ROBOT.sensors.attitude_error

    @staticmethod
    def legs(
        angles: tuple[Sequence[float], Sequence[float]], readings: tuple[Sequence[float], Sequence[float]]
    ) -> OneLeg:
        """Return checks with the given true angles and encoder readings FH, TH, SH, SK of both legs [rad]."""
        legs = OneLeg(0)
        for leg, side in enumerate(("left", "right")):
            fh, th, sh, sk = angles[leg]
            legs.now.quaternion[IMUS.index(f"{side}_tibia")] = tibia_attitude(fh, th, sh + sk)
            legs.now.position[6 * leg : 6 * leg + 4] = readings[leg]
        return legs

    @staticmethod
    def found(legs: OneLeg) -> list[str]:
        return [finding.node for finding in legs.legs.findings() if finding.dtc is Dtc.TORQUE_DIRECTION]

    def exchanged(self, index: int, apart: float, share: float = 1.0) -> OneLeg:
        """Return checks of legs whose joint has exchanged encoders. The readings of the joint differ by `apart` [rad].

        Each leg has `share` times the error that an exchange causes.
        """
        left, right = [0.1, -0.05, 0.2, 0.3], [0.1, -0.05, 0.2, 0.3]
        right[index] += share * apart
        readings = list(left), list(right)
        readings[0][index], readings[1][index] = left[index] + apart, left[index]
        if share != 1.0:  # the errors of both legs are +-share * apart
            left[index], right[index] = left[index] + (1.0 - share) * apart, left[index] + share * apart
        return self.legs((left, right), readings)

    @pytest.mark.parametrize("index", range(4), ids=["FH", "TH", "SH", "SK"])
    @signs
    def test_exchange_is_found_from_the_second_sample_on(self, index: int, sign: float):
        for apart, expected in ((self.ALLOWED * (1.0 - 1e-6), False), (self.ALLOWED * (1.0 + 1e-6), True)):
            legs = self.exchanged(index, sign * apart)
            legs.compare()
            assert self.found(legs) == []
            legs.compare()
            joint = JOINTS[index].removeprefix("left_")
            assert self.found(legs) == ([f"LEFT_{joint}", f"RIGHT_{joint}"] if expected else [])

    @pytest.mark.parametrize("last", [0, 1])
    def test_both_legs_check_the_exchange(self, last: int):
        legs = self.exchanged(0, 0.05)
        checks = legs.legs.check_left, legs.legs.check_right
        checks[1 - last](None)
        checks[last](None)
        assert self.found(legs) == ["LEFT_FH", "RIGHT_FH"]
        assert [finding.value for finding in legs.legs.findings()] == pytest.approx([0.05, -0.05])

    @pytest.mark.parametrize(("share", "expected"), [(0.6, False), (0.7, True), (1.3, True), (1.4, False)])
    @signs
    def test_errors_must_agree_with_the_readings(self, share: float, expected: bool, sign: float):
        legs = self.exchanged(0, sign * 0.06, share)
        legs.compare(10)
        assert bool(self.found(legs)) is expected

    @pytest.mark.parametrize("errors", [(0.05, 0.1), (0.1, 0.05)])
    def test_the_errors_of_both_legs_must_agree_with_the_readings(self, errors: tuple[float, float]):
        angles = ([0.05 - errors[0], 0.0, 0.0, 0.0], [errors[1], 0.0, 0.0, 0.0])
        legs = self.legs(angles, ([0.05, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]))
        legs.compare(3)
        assert self.found(legs) == []

    @pytest.mark.parametrize("index", range(4), ids=["FH", "TH", "SH", "SK"])
    @pytest.mark.parametrize("share", [0.5, 1.0])
    @signs
    def test_errors_that_intact_sensors_may_have_are_no_exchange(self, index: int, share: float, sign: float):
        """The tibia IMUs are mounted askew in opposite directions, and the legs pass each other slowly."""
        error = sign * share * self.ALLOWED * (1.0 - 1e-6)
        for apart in np.linspace(-0.06, 0.06, 25).tolist():
            readings = ([0.1, -0.05, 0.2, 0.3], [0.1, -0.05, 0.2, 0.3])
            readings[0][index] += apart
            angles = tuple(list(leg) for leg in readings)
            angles[0][index] -= error
            angles[1][index] += error
            legs = self.legs((angles[0], angles[1]), readings)
            legs.compare(3)
            assert legs.legs.findings() == ()

    @pytest.mark.parametrize("checked", [0, 1])
    @pytest.mark.parametrize("leg", [0, 1])
    def test_the_errors_of_both_legs_must_exceed_the_error_of_intact_sensors(self, checked: int, leg: int):
        for error, expected in ((self.ALLOWED * (1.0 - 1e-6), False), (self.ALLOWED * (1.0 + 1e-6), True)):
            errors = [0.04, 0.04]
            errors[leg] = error
            legs = self.legs(([0.05 - errors[0], 0.0, 0.0, 0.0], [0.01 + errors[1], 0.0, 0.0, 0.0]),
                             ([0.05, 0.0, 0.0, 0.0], [0.01, 0.0, 0.0, 0.0]))  # fmt: skip
            legs.now.position[6 * checked + 2] = 0.1  # a drift of another joint, which is no exchange
            legs.leg = checked
            legs.compare(2)
            assert self.found(legs) == (["LEFT_FH", "RIGHT_FH"] if expected else [])

    @pytest.mark.parametrize("checked", [0, 1])
    @pytest.mark.parametrize("leg", [0, 1])
    def test_values_of_different_ages_extend_the_errors_of_intact_sensors(self, checked: int, leg: int):
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.joint[6 * leg] = 4
        allowed = self.ALLOWED + 4.0 * ROBOT.sensors.velocity_error * PERIOD
        for apart, expected in ((allowed * (1.0 - 1e-6), False), (allowed * (1.0 + 1e-6), True)):
            legs = self.exchanged(0, apart)
            legs.leg = checked
            legs.compare(2, ages)
            assert bool(self.found(legs)) is expected

    @pytest.mark.parametrize(("askew", "apart"), [(0.0, 1.72), (1.0, 2.86), (1.718, 4.91)])
    @signs
    def test_misaligned_imus_increase_the_difference_that_is_found(self, askew: float, apart: float, sign: float):
        """The IMUs are misaligned so that the errors of both legs are smaller than the difference. All angles in degrees."""
        for share, expected in ((0.995, False), (1.005, True)):
            left, right = math.radians(sign * share * apart), 0.0
            error = math.radians(sign * (share * apart - askew))
            legs = self.legs(([left - error, 0.0, 0.0, 0.0], [right + error, 0.0, 0.0, 0.0]),
                             ([left, 0.0, 0.0, 0.0], [right, 0.0, 0.0, 0.0]))  # fmt: skip
            legs.compare(2)
            assert bool(self.found(legs)) is expected

    @pytest.mark.parametrize("index", range(4), ids=["FH", "TH", "SH", "SK"])
    def test_drift_of_one_or_both_encoders_is_no_exchange(self, index: int):
        for drifts in ((0.1, 0.0), (0.0, 0.1), (0.1, -0.1), (0.1, 0.1)):
            angles = ([0.1, -0.05, 0.2, 0.3], [0.1, -0.05, 0.2, 0.3])
            readings = list(angles[0]), list(angles[1])
            for leg, drift in enumerate(drifts):
                readings[leg][index] += drift
            legs = self.legs(angles, readings)
            legs.compare(10)
            assert self.found(legs) == []

    def test_legs_with_different_angles_have_no_finding(self):
        angles = ([0.1, -0.05, 0.2, 0.3], [-0.1, 0.05, -0.2, 0.6])
        legs = self.legs(angles, angles)
        legs.compare(10)
        assert self.found(legs) == []

    def test_single_sample_does_not_count(self):
        legs = self.exchanged(0, 0.05)
        wrong = legs.now.position.copy()
        for _ in range(5):
            legs.now.position[:] = wrong
            legs.compare()
            legs.now.position[[0, 6]] = wrong[[6, 0]]
            legs.compare()
        assert self.found(legs) == []

    def test_values_that_are_too_old_neither_count_nor_restart_the_count(self):
        legs = self.exchanged(0, 0.05)
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        legs.compare()
        ages.joint[6] = NEVER
        legs.compare(5, ages)
        assert self.found(legs) == []
        legs.compare()
        assert self.found(legs) == ["LEFT_FH", "RIGHT_FH"]

    @pytest.mark.parametrize("joint", [0, 6])
    def test_finding_remains_until_a_drive_of_the_joint_restarts(self, joint: int):
        legs = self.exchanged(0, 0.05)
        legs.compare(2)
        legs.now.position[[0, 6]] = legs.now.position[[6, 0]]
        legs.compare(10)
        legs.legs.reference((joint + 1) % 12)
        assert self.found(legs) == ["LEFT_FH", "RIGHT_FH"]
        legs.legs.reference(joint)
        assert self.found(legs) == []

    @pytest.mark.parametrize("joint", [0, 6])
    def test_restart_of_a_drive_restarts_the_count(self, joint: int):
        legs = self.exchanged(0, 0.05)
        legs.compare(2)
        legs.legs.reference(joint)
        legs.compare()
        assert self.found(legs) == []
        legs.compare()
        assert self.found(legs) == ["LEFT_FH", "RIGHT_FH"]

    def test_restart_of_an_ankle_drive_changes_nothing(self):
        legs = self.exchanged(0, 0.05)
        legs.compare(2)
        legs.legs.reference(4)
        legs.legs.reference(11)
        assert self.found(legs) == ["LEFT_FH", "RIGHT_FH"]

    def test_heading_drift_of_the_imus_is_no_exchange(self):
        angles = ([0.0, 0.03, 0.0, 0.0], [0.0, -0.03, 0.0, 0.0])
        drifted = ([0.0, -0.03, 0.0, 0.0], [0.0, 0.03, 0.0, 0.0])
        legs = self.legs(angles, angles)
        # The IMUs turn the other way, as if the legs were exchanged.
        for heading in np.arange(0.0, 0.06, 9e-6).tolist():
            for leg, sign in enumerate((-1.0, 1.0)):
                legs.now.quaternion[TIBIAE[leg]] = tibia_attitude(0.0, angles[leg][1] + sign * heading, 0.0)
                (legs.legs.check_left, legs.legs.check_right)[leg](None)
        assert legs.legs.findings() == ()
        legs.now.position[:] = self.legs(angles, drifted).now.position
        legs.compare(2)
        assert self.found(legs) == ["LEFT_TH", "RIGHT_TH"]


class TestHeading:
    """The headings of the tibia IMUs drift relative to the pelvis IMU, while the pelvis is tilted and the legs move."""

    #: Three standard deviations of the relative drift of two emulated IMUs, in one sample of 32 cycles [rad].
    RATE = 3.0 * math.sqrt(2.0) * GROUND_PARAMETERS.imu.heading_drift * 32.0 * PERIOD
    #: Roll and pitch of the pelvis [rad]. The last robot lies upside down.
    TILTS = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.4), (0.3, -0.3), (2.6, 0.3))

    def drifted(self, leg: int, tilt: tuple[float, float], drift: float, samples: int) -> OneLeg:
        """Return checks after a heading drift without a finding.

        Args:
            leg: index of the leg under test.
            tilt: roll and pitch of the pelvis [rad].
            drift: heading drift in each sample [rad].
            samples: number of samples.
        """
        one_leg, pelvis = OneLeg(leg), tilted(*tilt)
        one_leg.now.quaternion[PELVIS] = pelvis
        postures = []
        for phase in np.linspace(0.0, 2.0 * math.pi, 50, endpoint=False):
            angles = 0.2 * math.sin(phase), 0.1 * math.cos(phase), 0.5 * math.sin(phase + 1.0)
            postures.append((angles, product(pelvis, tibia_attitude(*angles))))
        for sample in range(samples):
            angles, tibia = postures[sample % len(postures)]
            half = 0.5 * drift * sample
            one_leg.now.quaternion[TIBIAE[leg]] = turned_about_vertical(tibia, (math.cos(half), math.sin(half)))
            one_leg.now.position[6 * leg : 6 * leg + 3] = angles
            one_leg.compare()
            assert one_leg.legs.findings() == ()
        return one_leg

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("tilt", TILTS)
    @signs
    @pytest.mark.sample(7)
    def test_heading_drift_is_not_reported_and_later_drifts_of_encoders_are(
        self, leg: int, tilt: tuple[float, float], sign: float
    ):
        self.check(self.drifted(leg, tilt, sign * self.RATE, 12_000))

    @pytest.mark.exhaustive
    @pytest.mark.parametrize("tilt", TILTS[3:])
    def test_hours_of_heading_drift_are_not_reported(self, tilt: tuple[float, float]):
        self.check(self.drifted(0, tilt, self.RATE, 3 * 3600 * 1000 // 32))

    def check(self, one_leg: OneLeg) -> None:
        """Check that a drift of each encoder is found above the same threshold as without a heading drift."""
        joints, healthy = slice(6 * one_leg.leg, 6 * one_leg.leg + 3), one_leg.now.position.copy()
        for axis in range(3):
            for share, found in ((0.995, 0), (1.005, 1), (-0.995, 0), (-1.005, 1)):
                errors = np.zeros(3)
                errors[axis] = share * ROBOT.sensors.attitude_error
                one_leg.now.position[:] = healthy
                one_leg.now.position[joints] += errors
                one_leg.compare(3)
                assert one_leg.drifts() == []
                one_leg.compare()
                assert len(one_leg.drifts()) == found
                one_leg.now.position[:] = healthy
                one_leg.compare()

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("tilt", [(0.0, 0.0), *TILTS, (1.0, 0.5)])
    @pytest.mark.parametrize("fh", [0.0, 0.4, -0.4])
    @signs
    def test_estimate_follows_in_proportion_to_the_vertical_part_of_the_axis(
        self, leg: int, tilt: tuple[float, float], fh: float, sign: float
    ):
        one_leg, pelvis, half = OneLeg(leg), tilted(*tilt), sign * 0.5e-6
        one_leg.now.quaternion[PELVIS] = pelvis
        tibia = product(pelvis, tibia_attitude(fh, -0.2, 0.7))
        one_leg.now.quaternion[TIBIAE[leg]] = turned_about_vertical(tibia, (math.cos(half), math.sin(half)))
        one_leg.now.position[6 * leg : 6 * leg + 3] = fh, -0.2, 0.7
        w, x, y, z = pelvis
        axis = pinocchio.Quaternion(w, x, y, z) * np.array([0.0, -math.sin(fh), math.cos(fh)])
        one_leg.compare()
        assert one_leg.legs.heading[leg] == pytest.approx([1.0, -half * axis[2] ** 2], abs=1e-11)
        assert one_leg.legs.heading[1 - leg].tolist() == [1.0, 0.0]

    def test_attitude_is_turned_about_the_vertical(self):
        attitude, turn = tilted(0.3, -0.8), tilted(0.0, 0.0, 1.1)
        assert turned_about_vertical(attitude, (turn[0], turn[3])) == pytest.approx(product(turn, attitude))


class TestStandingEncoder:
    """The reading of an encoder is constant while the IMUs of pelvis and tibia turn. The drive produces no torque."""

    allowed = ROBOT.sensors.attitude_change / (1.0 - ROBOT.sensors.misalignment)

    @staticmethod
    def standing(joint: int) -> tuple[SimulatedRobot, Callable[[float], None]]:
        """Return a robot at rest, and a function that turns the joint without its encoder [rad]."""
        robot = SimulatedRobot(amplitude=0.0)
        turned = np.zeros(12)
        robot.position = lambda: MIDDLE + turned  # type: ignore[method-assign]
        robot.run(40)
        return robot, lambda angle: turned.__setitem__(joint, angle)

    @staticmethod
    def still(now: Signals) -> None:
        now.position[:] = MIDDLE * GEAR

    @staticmethod
    def swinging(joint: int, phase: int) -> tuple[SimulatedRobot, Callable[[Signals], None]]:
        """Return a robot whose joints swing without torque, and the change that keeps the reading of an encoder constant."""
        robot = SimulatedRobot(amplitude=0.1)
        robot.run(200 + phase, lambda now: now.torque.fill(0.0))
        stuck = float(robot.now.position[joint])

        def stick(now: Signals) -> None:
            now.position[joint] = stuck
            now.torque[:] = 0.0

        return robot, stick

    @joints_without_imu
    @pytest.mark.parametrize("phase", [0, 9, 24])
    @pytest.mark.sample(7)
    def test_stuck_encoder_of_a_joint_without_imu_is_not_found_without_torque(self, joint: int, phase: int):
        robot, stick = self.swinging(joint, phase)
        assert robot.run(400, stick) == ()

    @joints_above_imu
    @pytest.mark.parametrize("phase", [0, 9, 24])
    @pytest.mark.sample(7)
    def test_stuck_encoder_is_found_without_torque(self, joint: int, phase: int):
        robot, stick = self.swinging(joint, phase)
        robot.until_found(Dtc.ENC_STUCK, 80, stick)
        finding = only(robot.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.text == (
            f"the encoder of {JOINTS[joint]} has a constant reading "
            f"while its leg turned by {math.degrees(finding.value):+.2f} degrees"
        )
        robot.missing = {row(f"IMU_{JOINTS[joint].split('_')[0]}_tibia")}
        assert robot.run(9, stick)[0] is finding

    @joints_above_imu
    @signs
    def test_leg_turn_beyond_threshold_reports_stuck_encoder(self, joint: int, sign: float):
        robot, turn = self.standing(joint)
        turn(sign * 0.99 * self.allowed)
        assert robot.run(33, self.still) == ()
        robot, turn = self.standing(joint)
        turn(sign * 1.01 * self.allowed)
        assert 16 < robot.until_found(Dtc.ENC_STUCK, 48, self.still) <= 48
        # The IMUs cannot separate SH from SK.
        pair = {joint, joint ^ 1} if JOINTS[joint].endswith(("SH", "SK")) else {joint}
        assert [f.node for f in robot.checks.findings] == [JOINTS[one].upper() for one in sorted(pair)]
        # The check regards a small part of the turn as a drift of the IMU headings.
        heading = 1e-5 if JOINTS[joint].endswith("TH") else 0.0
        values = [sign * 1.01 * self.allowed] * len(pair)
        assert [f.value for f in robot.checks.findings] == pytest.approx(values, abs=heading or None)
        turn(0.0)
        assert robot.run(33, self.still) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize(("index", "axis"), [(0, 0), (1, 1), (2, 2), (3, 2)])
    def test_two_samples_of_leg_turn_report_stuck_encoder(self, leg: int, index: int, axis: int):
        one_leg, joint = OneLeg(leg, attitude_error=0.0), 6 * leg + index

        def sample(turned: float, change: float) -> list[float]:
            angles, errors = [0.1, -0.2, 0.3], [0.05, 0.06, -0.07]
            angles[axis] -= turned
            errors[axis] += change
            one_leg.show(angles, errors)
            one_leg.compare()
            found = one_leg.stuck()
            assert {f.node for f in found} <= {JOINTS[joint].upper()}
            return [f.value for f in found]

        for _ in range(2):
            one_leg.standing[joint] = 0
            assert [sample(0.5, 0.5), sample(0.0, 0.0)] == [[], []]  # the encoder moves
            one_leg.standing[joint] = 1
            assert sample(0.02, 0.02) == []
            assert sample(0.02, 0.02) == pytest.approx([-0.02])
            assert sample(-0.03, -0.03) == pytest.approx([0.03])
            assert [sample(0.0, 0.0), sample(0.02, 0.02)] == [[], []]
            # Nothing is reported if only the error changes, or if only the leg turns.
            assert [sample(0.0, 0.5), sample(0.0, 0.5), sample(0.0, 0.5)] == [[]] * 3
            assert [sample(0.5, 0.0), sample(0.5, 0.0), sample(0.5, 0.0)] == [[]] * 3

    def test_change_of_exactly_the_allowance_is_accepted(self):
        sensors = ROBOT.sensors
        for angle in (0.0, 0.125, 0.5):
            turned = hip_angles(IDENTITY, tibia_attitude(0.0, angle, 0.0))[1]
            allowed = sensors.attitude_change + sensors.misalignment * turned
            for change, found in ((allowed, False), (np.nextafter(allowed, 1.0), turned > 0.0)):
                one_leg = OneLeg(0, attitude_error=math.inf)
                one_leg.standing[0] = 0
                one_leg.compare()
                one_leg.standing[0] = 1
                one_leg.show([0.0, angle, 0.0], [float(change), 0.0, 0.0])
                one_leg.compare(2)
                assert bool(one_leg.legs.findings()) is found

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize(
        ("change", "ignored"), [(0.5, 2e-5), (2.1e-5, 2e-5), (1e-5, 1e-5), (-1e-5, -1e-5), (-0.5, -2e-5)]
    )
    @signs
    def test_change_per_sample_without_turn_is_ignored_up_to_its_limit(
        self, axis: int, change: float, ignored: float, sign: float
    ):
        self.check_ignored(axis, change, ignored, sign * float(np.nextafter(0.02, 1.0)))

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize(
        ("change", "ignored"), [(0.5, 2e-4), (2.1e-4, 2e-4), (1e-4, 1e-4), (-1e-4, -1e-4), (-0.5, -2e-4)]
    )
    @signs
    def test_larger_change_per_sample_is_ignored_while_gyros_agree_with_encoders(
        self, axis: int, change: float, ignored: float, sign: float
    ):
        self.check_ignored(axis, change, ignored, sign * 0.02)

    def check_ignored(self, axis: int, change: float, ignored: float, rate: float) -> None:
        """Check that the part `ignored` of a change of the error [rad] is ignored if the encoders turn at `rate` [rad/s].

        The gyros report no turn.
        """
        one_leg = OneLeg(0, attitude_error=0.0)
        angles, errors = [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]
        one_leg.now.velocity[axis] = rate

        def sample(turned: float, change: float) -> None:
            one_leg.show([angle + turned for angle in angles], [e + change * (i == axis) for i, e in enumerate(errors)])
            one_leg.compare()

        one_leg.standing[:] = 0
        sample(0.0, 0.0)
        one_leg.standing[axis] = 1
        sample(0.0, change)  # without a turn of the leg
        assert one_leg.stuck() == ()
        for _ in range(2):
            sample(0.5, 1.0)
        assert only(one_leg.stuck()).value == pytest.approx(ignored - 1.0, abs=1e-12)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("index", range(4))
    @pytest.mark.parametrize(
        ("difference", "ignored"), [(0.0199, 2e-4), (-0.0199, 2e-4), (0.0201, 2e-5), (-0.0201, 2e-5)]
    )
    def test_gyros_are_compared_with_encoders_of_a_turning_robot(
        self, leg: int, index: int, difference: float, ignored: float
    ):
        """Pelvis and joints turn fast. The heading of the tibia IMU has drifted. One encoder has another velocity."""
        # With a negative `attitude_error`, the estimated heading drift does not change.
        robot = replace(ROBOT, gear=np.full(12, 2.0), polarity=np.full(12, -1.0))
        one_leg, joint, axis = OneLeg(leg, robot=robot, attitude_error=-1.0), 6 * leg + index, min(index, 2)
        pelvis, angles, rates = tilted(0.3, -0.4, 0.9), (0.2, -0.3, 0.7), np.array([0.6, -0.8, 1.1, -0.4])
        turning, half = np.array([0.5, -0.7, 0.9]), 0.35
        x, y, z = np.eye(3)
        to_pelvis = pinocchio.Quaternion(*tibia_attitude(*angles)).toRotationMatrix()
        fh, th = (pinocchio.AngleAxis(angle, one).toRotationMatrix() for angle, one in ((0.2, x), (-0.3, z)))
        turned = x * rates[0] + fh @ z * rates[1] + fh @ th @ y * (rates[2] + rates[3])
        now = one_leg.now
        now.gyro[PELVIS], now.gyro[TIBIAE[leg]] = turning, to_pelvis.T @ (turning + turned)
        now.velocity[6 * leg : 6 * leg + 4] = rates
        now.velocity[joint] += difference
        now.velocity[:] *= -2.0
        one_leg.legs.heading[leg] = math.cos(half), math.sin(half)

        def sample(turned: float, change: float) -> float:
            shown, errors = list(angles), [0.0, 0.0, 0.0]
            shown[axis] -= turned
            errors[axis] += change
            one_leg.show(shown, errors)
            now.position[:] *= -2.0
            now.quaternion[PELVIS] = pelvis
            tibia = product(pelvis, now.quaternion[TIBIAE[leg]].tolist())
            now.quaternion[TIBIAE[leg]] = turned_about_vertical(tibia, (math.cos(half), -math.sin(half)))
            one_leg.compare()
            return sum(finding.value for finding in one_leg.stuck())

        one_leg.standing[joint] = 0
        sample(0.0, 0.0)
        one_leg.standing[joint] = 1
        assert [sample(0.0, 0.003), sample(0.03, 0.03)] == [0.0, 0.0]
        assert sample(0.03, 0.03) == pytest.approx(ignored - 0.03, abs=1e-9)

    @pytest.mark.parametrize("swing", [0.0, 0.1])
    def test_attitude_errors_of_intact_imus_report_nothing_while_encoders_are_constant(self, swing: float):
        """The drives are off for five minutes, with TH at its end stop. The robot swings with the crane."""
        parameters, generator = GROUND_PARAMETERS.imu, np.random.default_rng(0)
        drawn = 8  # samples of 16 cycles between two draws
        error = AttitudeError(parameters, len(IMUS), drawn * 16 * PERIOD, generator)
        one_leg = OneLeg(0)
        one_leg.standing[:4] = 1
        angles = (-0.01, 0.349, 0.2)
        one_leg.show(angles, (0.0, 0.0, 0.0))
        leg, now, both = tibia_attitude(*angles), one_leg.now, [PELVIS, TIBIAE[0]]
        for sample in range(int(300.0 / (16 * PERIOD))):
            if sample % drawn == 0:
                error.draw()
            phase = 3.0 * sample * 16 * PERIOD
            pelvis = tilted(swing * math.sin(phase), 0.0)
            attitudes = np.tile(IDENTITY, (len(IMUS), 1))
            attitudes[both] = pelvis, product(pelvis, leg)
            error.apply(sample % drawn / drawn, attitudes)
            turning = np.array([3.0 * swing * math.cos(phase), 0.0, 0.0])
            now.quaternion[:] = attitudes
            now.gyro[:] = parameters.gyro_noise * generator.standard_normal((len(IMUS), 3))
            now.gyro[PELVIS] += turning
            now.gyro[TIBIAE[0]] += pinocchio.Quaternion(*leg).inverse() * turning
            one_leg.compare()
            assert one_leg.legs.findings() == ()

    @pytest.mark.sample(7)
    @joints_above_imu
    @signs
    def test_slow_turn_of_a_joint_with_stuck_encoder_is_found(self, joint: int, sign: float):
        """The joint turns slowly, without torque. An even slower turn is found as a drift."""
        for speed, dtc, cycles in ((0.035, Dtc.ENC_STUCK, 240), (0.01, Dtc.ENC_DRIFT, 3300)):
            robot, turn = self.standing(joint)

            def still(now: Signals, robot: SimulatedRobot = robot, turn=turn, speed: float = speed) -> None:
                now.position[:] = MIDDLE * GEAR
                now.velocity[:] = 0.0
                turn(sign * speed * (robot.time - 0.04))

            assert robot.until_found(dtc, cycles, still) > 150
            assert {finding.dtc for finding in robot.checks.findings} == {dtc}

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize(
        ("index", "compared"), [(0, True), (1, True), (2, True), (3, True), (4, False), (5, False)]
    )
    def test_leg_with_constant_encoder_is_also_compared_in_the_other_turn(self, leg: int, index: int, compared: bool):
        one_leg = OneLeg(leg, attitude_error=math.inf)
        other = (one_leg.legs.check_right, one_leg.legs.check_left)[leg]
        one_leg.compare()
        one_leg.standing[6 * leg + index] = 1
        one_leg.show([0.1, 0.1, 0.1], [-0.1, -0.1, -0.1])
        assert [other(None), other(None)] == [False, compared]
        one_leg.standing[:] = 0
        assert not other(None)  # the encoder moves again

    def test_legs_with_old_values_are_not_compared(self):
        one_leg = OneLeg(0, attitude_error=math.inf)
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        one_leg.compare()
        one_leg.standing[:] = 1
        one_leg.show([0.1, 0.0, 0.0], [-0.1, 0.0, 0.0])
        ages.joint[0] = NEVER
        for _ in range(4):
            assert not one_leg.legs.check_left(ages)
            assert not one_leg.legs.check_right(ages)

    def test_one_sample_of_leg_turn_reports_nothing(self):
        robot, turn = self.standing(JOINTS.index("left_TH"))
        for _ in range(5):
            turn(0.1)
            assert robot.run(16, self.still) == ()
            turn(0.0)
            assert robot.run(16, self.still) == ()

    def test_misaligned_imu_of_turning_leg_reports_nothing(self):
        robot, turned = SimulatedRobot(amplitude=0.0), np.zeros(12)
        robot.position = lambda: MIDDLE + turned  # type: ignore[method-assign]
        askew = pinocchio.Quaternion(np.array([0.0, 0.0, math.sin(math.radians(0.4)), math.cos(math.radians(0.4))]))
        tibia, joint = IMUS.index("left_tibia"), JOINTS.index("left_SH")

        def mounted(now: Signals) -> None:
            w, x, y, z = now.quaternion[tibia]
            x, y, z, w = (pinocchio.Quaternion(np.array([x, y, z, w])) * askew).coeffs()
            now.quaternion[tibia] = w, x, y, z

        def turn(now: Signals) -> None:
            now.velocity[joint] = -1.25 * GEAR[joint]
            turned[joint] -= 1.25 * PERIOD
            mounted(now)

        assert robot.run(40, mounted) == ()
        assert robot.run(400, turn) == ()

    @pytest.mark.exhaustive
    def test_heading_drift_of_imu_at_standstill_reports_nothing(self):
        robot = SimulatedRobot(amplitude=0.0)

        def drift(now: Signals) -> None:
            half = 0.5 * 1.1e-3 * robot.time
            w, x, y, z = now.quaternion[1]
            c, s = math.cos(half), math.sin(half)
            now.quaternion[1] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w

        assert robot.run(6500, drift) == ()
