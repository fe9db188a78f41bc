"""Knee checks: opposite drifts of SH and SK are found in a walking motion, by the accelerometers of pelvis and tibiae."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pinocchio
import pytest
from simulated_robot import GEAR, PERIOD, ROBOT, SimulatedRobot, only, row, signals

from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import IMUS, JOINTS, SIDES
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.knees import (
    FRONTAL_HIP,
    PELVIS_IMU,
    TIBIA_IMU,
    TRANSVERSE_HIP,
    Knees,
    Readings,
    motion,
)
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.safety.plausibility.support import SEGMENT
from atalante_hal.types import GRAVITY

MODEL = ExoskeletonParameters()
PELVIS, TIBIA = IMUS.index("pelvis"), IMUS.index("left_tibia")
SH, SK = ([JOINTS.index(f"{side}_{joint}") for side in SIDES] for joint in ("SH", "SK"))
#: Middle, amplitude and phase of each joint of a leg in a walking motion [rad].
MIDDLE = np.array([0.0, 0.0, -0.3, 0.7, -0.3, 0.0])
AMPLITUDE = np.array([0.05, 0.05, 0.3, 0.3, 0.1, 0.0])
PHASE = np.array([0.0, 1.0, 0.0, 2.0, 0.0, 0.0])
#: Duration of two steps [cycles].
STRIDE = 1600
#: Drift of the encoders in one cycle [rad].
RATE = math.radians(2.5) * PERIOD
LIMIT = 2.0 * math.degrees(ROBOT.sensors.attitude_error)


@dataclass
class Walk:
    """Healthy signals of a walking motion, which repeats after `STRIDE` cycles. The pelvis is turned and swings."""

    position: np.ndarray  # (STRIDE, 12) rad
    quaternion: np.ndarray  # (STRIDE, 4, 4)
    accel: np.ndarray  # (STRIDE, 4, 3) m/s2

    def write(self, now: Signals, cycle: int) -> None:
        """Write the signals of a cycle."""
        now.position[:] = self.position[cycle % STRIDE] * GEAR
        now.quaternion[:], now.accel[:] = self.quaternion[cycle % STRIDE], self.accel[cycle % STRIDE]


@cache
def walk(amplitude: float = 1.0, lengths: tuple[float, float] = (MODEL.thigh_length, MODEL.shank_length)) -> Walk:
    """Return the signals of a walking motion, computed with Pinocchio.

    Args:
        amplitude: multiple of the amplitudes of all joints.
        lengths: lengths of thigh and shank [m].
    """
    model = pinocchio_model(urdf(ExoskeletonParameters(*lengths), ROBOT))
    data, frames = model.model.createData(), [model.model.getFrameId(f"imu_{imu}") for imu in IMUS]
    position, place, turn = np.zeros((STRIDE, 12)), np.zeros((STRIDE, 4, 3)), np.zeros((STRIDE, 4, 3, 3))
    quaternion = np.zeros((STRIDE, 4, 4))
    for cycle in range(STRIDE):
        phase = 2.0 * math.pi * cycle / STRIDE
        legs = [MIDDLE + amplitude * AMPLITUDE * np.sin(phase + PHASE + leg * math.pi) for leg in range(2)]
        position[cycle] = np.concatenate(legs)
        q = pinocchio.neutral(model.model)
        q[model.q] = position[cycle]
        pinocchio.framesForwardKinematics(model.model, data, q)
        swing = amplitude * 0.05 * math.sin(phase)
        world = (
            pinocchio.utils.rotate("z", 2.0) @ pinocchio.utils.rotate("y", swing) @ pinocchio.utils.rotate("x", swing)
        )
        for imu, frame in enumerate(frames):
            place[cycle, imu] = world @ data.oMf[frame].translation
            turn[cycle, imu] = world @ data.oMf[frame].rotation
            x, y, z, w = pinocchio.Quaternion(turn[cycle, imu]).coeffs()
            quaternion[cycle, imu] = w, x, y, z
    force = (np.roll(place, -1, 0) - 2.0 * place + np.roll(place, 1, 0)) / PERIOD**2 + [0.0, 0.0, GRAVITY]
    return Walk(position, quaternion, np.einsum("nikj,nik->nij", turn, force))


class Walking:
    """The check of a robot that walks, called directly.

    Args:
        healthy: signals of the walk.
        drift: final error of SK and, with the opposite sign, of SH [deg], for each leg. The encoders drift by 2.5 deg/s.
    """

    def __init__(self, healthy: Walk | None = None, drift: tuple[float, float] = (0.0, 0.0)) -> None:
        self.walk, self.drift, self.error = healthy or walk(), drift, np.zeros(2)
        self.now = signals()
        self.now.quaternion[:, 0] = 1.0
        self.heading = np.tile([1.0, 0.0], (2, 1))
        self.tilt = self.heading.copy()
        self.checks = Knees(ROBOT, self.now, self.heading, self.tilt, PERIOD)
        self.cycles = 0

    def change(self) -> None:
        """Change the signals of a cycle."""

    def run(self, cycles: int) -> list[int]:
        """Return the cycles in which the findings changed."""
        changed = []
        for cycle in range(cycles):
            self.walk.write(self.now, self.cycles)
            self.error += np.clip(np.radians(self.drift) - self.error, -RATE, RATE)
            self.now.position[SK] += self.error * GEAR[SK]
            self.now.position[SH] -= self.error * GEAR[SH]
            self.change()
            if self.checks.follow():
                changed.append(cycle)
            self.cycles += 1
        return changed


@pytest.mark.sample(3)
@pytest.mark.parametrize("leg", [0, 1])
@pytest.mark.parametrize("drift", [6.0, -6.0])
def test_opposite_drifts_of_hip_and_knee_are_found_and_the_finding_ends_after_the_repair(leg: int, drift: float):
    robot = Walking()
    assert robot.run(3000) == []
    robot.drift = (drift, 0.0) if leg == 0 else (0.0, drift)
    cycles = next(cycle for cycle in range(3000) if robot.run(1))
    assert cycles >= 1300
    finding = only(robot.checks.findings())
    assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.ENC_DRIFT, f"{SIDES[leg].upper()}_SK", True)
    assert math.copysign(1.0, finding.value) == math.copysign(1.0, drift)
    assert LIMIT < abs(math.degrees(finding.value)) < 5.5
    assert finding.text == (
        f"encoder of {SIDES[leg]}_SK: its angle differs by {math.degrees(finding.value):+.1f} degrees from the accelerometers of "
        f"pelvis and {SIDES[leg]} tibia"
    )
    robot.drift = (0.0, 0.0)
    robot.run(4000)
    assert robot.checks.findings() == ()


def test_drifts_of_both_legs_are_found():
    robot = Walking(drift=(5.0, -5.0))
    robot.run(4000)
    assert [finding.node for finding in robot.checks.findings()] == ["LEFT_SK", "RIGHT_SK"]


@pytest.mark.sample(5)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("lengths", [(0.36, 0.38), (0.4, 0.4), (0.45, 0.45)])
@pytest.mark.parametrize(("drift", "found"), [(0.0, False), (0.3 * LIMIT, False), (1.8 * LIMIT, True)])
def test_drift_above_the_limit_is_found_with_legs_of_each_length(
    sign: float, lengths: tuple[float, float], drift: float, found: bool
):
    robot = Walking(walk(1.0, lengths), drift=(sign * drift, sign * drift))
    robot.run(5000)
    assert len(robot.checks.findings()) == 2 * found


@pytest.mark.parametrize(("drift", "found"), [(0.8 * LIMIT, False), (1.2 * LIMIT, True)])
def test_limit_of_the_error_is_twice_that_of_the_attitudes(drift: float, found: bool):
    robot = Walking(walk(1.0, (SEGMENT, SEGMENT)), drift=(drift, -drift))
    assert bool(robot.run(6000)) == found


@pytest.mark.parametrize(("amplitude", "found"), [(0.75, True), (0.4, False)])
def test_slow_motion_is_not_evaluated(amplitude: float, found: bool):
    assert bool(Walking(walk(amplitude), drift=(8.0, 8.0)).run(4000)) == found


def test_finding_remains_while_the_robot_is_at_rest():
    robot = Walking(drift=(5.0, 0.0))
    robot.run(4000)
    remains = robot.checks.findings()
    assert remains
    robot.walk = walk(0.0)
    robot.checks.restart()
    assert robot.run(4000) == []
    assert robot.checks.findings() == remains


def test_nothing_is_found_while_the_filters_settle():
    robot = Walking(drift=(20.0, 20.0))
    assert robot.run(2000) == []
    assert robot.run(600) != []


@pytest.mark.sample(5)
@pytest.mark.parametrize("imu", [PELVIS, TIBIA])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.1), (1.1, 0.0), (0.9, 0.0)])
@pytest.mark.parametrize("axis", range(3))
def test_wrong_accelerometer_is_not_reported_as_drift(imu: int, scale: float, offset: float, axis: int):
    robot = Walking()

    def change() -> None:
        robot.now.accel[imu, axis] = scale * robot.now.accel[imu, axis] + offset

    robot.change = change  # type: ignore[method-assign]
    assert robot.run(5000) == []


@pytest.mark.parametrize(("drift", "corrected", "found"), [(0.0, True, []), (6.0, True, [0, 1]), (6.0, False, [])])
def test_drift_is_found_after_a_heading_drift_of_the_tibia_imus(drift: float, corrected: bool, found: list[int]):
    """The pelvis sways by 3 cm. After 1.5 rad of heading drift, the tibia IMUs measure this motion in another direction."""
    robot, healthy = Walking(drift=(drift, -drift)), walk()
    turn = pinocchio.Quaternion(pinocchio.AngleAxis(1.5, np.array([0.0, 0.0, 1.0])))
    frequency = 2.0 * math.pi / (STRIDE * PERIOD)
    quaternion, accel = healthy.quaternion.copy(), healthy.accel.copy()
    for cycle in range(STRIDE):
        sway = np.array([0.03, 0.0, 0.0]) * frequency**2 * math.sin(frequency * cycle * PERIOD + 1.0)
        for imu in (PELVIS, TIBIA, TIBIA + 1):
            w, x, y, z = quaternion[cycle, imu]
            attitude = pinocchio.Quaternion(w, x, y, z)
            accel[cycle, imu] += attitude.inverse() * sway
            if imu != PELVIS:
                quaternion[cycle, imu] = (turn * attitude).coeffs()[[3, 0, 1, 2]]
    robot.walk = Walk(healthy.position, quaternion, accel)
    if corrected:
        robot.heading[:] = turn.inverse().coeffs()[[3, 2]]
    robot.run(5000)
    assert [SIDES.index(finding.node.split("_")[0].lower()) for finding in robot.checks.findings()] == found


@pytest.mark.sample(2)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("corrected", "drift", "found"), [(False, 2.5, 1), (True, 2.5, 0), (True, 6.0, 2)])
def test_tibia_imus_askew_within_the_tolerance_do_not_change_the_error_of_the_knee(
    sign: float, corrected: bool, drift: float, found: int
):
    """The tibia IMUs are turned about y by `attitude_error`, in opposite directions."""
    robot, healthy = Walking(drift=(sign * drift, sign * drift)), walk()
    quaternion, accel = healthy.quaternion.copy(), healthy.accel.copy()
    for leg, angle in enumerate((ROBOT.sensors.attitude_error, -ROBOT.sensors.attitude_error)):
        turn = pinocchio.Quaternion(pinocchio.AngleAxis(angle, np.array([0.0, 1.0, 0.0])))
        accel[:, TIBIA + leg] = accel[:, TIBIA + leg] @ turn.matrix()
        for cycle in range(STRIDE):
            w, x, y, z = quaternion[cycle, TIBIA + leg]
            quaternion[cycle, TIBIA + leg] = (pinocchio.Quaternion(w, x, y, z) * turn).coeffs()[[3, 0, 1, 2]]
        if corrected:
            robot.tilt[leg] = turn.inverse().coeffs()[[3, 1]]
    robot.walk = Walk(healthy.position, quaternion, accel)
    robot.run(5000)
    assert len(robot.checks.findings()) == found


class TestMotion:
    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("cycle", range(0, STRIDE, 400))
    def test_position_agrees_with_the_kinematic_model(self, leg: int, cycle: int):
        robot, step = walk(1.0, (SEGMENT, SEGMENT)), 1e-6

        def true(knee: float = 0.0, length: float = SEGMENT) -> np.ndarray:
            """Return the position of the tibia IMU relative to the pelvis IMU, in world axes; SK + `knee`, SH - `knee`."""
            model = pinocchio_model(urdf(ExoskeletonParameters(length, length), ROBOT))
            data = model.model.createData()
            q, position = pinocchio.neutral(model.model), robot.position[cycle].copy()
            position[SK[leg]] += knee
            position[SH[leg]] -= knee
            q[model.q] = position
            pinocchio.framesForwardKinematics(model.model, data, q)
            pelvis, tibia = (data.oMf[model.model.getFrameId(f"imu_{IMUS[imu]}")] for imu in (PELVIS, TIBIA + leg))
            w, x, y, z = robot.quaternion[cycle, PELVIS]
            return pinocchio.Quaternion(w, x, y, z) * (tibia.translation - pelvis.translation)

        now = signals()
        robot.write(now, cycle)
        now.accel[:] = np.random.default_rng(cycle).standard_normal((4, 3))
        turn = pinocchio.Quaternion(pinocchio.AngleAxis(0.7, np.array([0.0, 0.0, 1.0])))
        w, x, y, z = now.quaternion[TIBIA + leg]
        askew = pinocchio.Quaternion(pinocchio.AngleAxis(0.4, np.array([0.0, 1.0, 0.0])))
        mounted = pinocchio.Quaternion(w, x, y, z) * askew.inverse()
        now.quaternion[TIBIA + leg] = (turn.inverse() * mounted).coeffs()[[3, 0, 1, 2]]
        heading, tilt = np.zeros((2, 2)), np.zeros((2, 2))
        heading[leg], tilt[leg] = turn.coeffs()[[3, 2]], askew.coeffs()[[3, 1]]
        readings = Readings(now.position, 1.0 / GEAR, now.quaternion, now.accel, heading, tilt)
        position, lever, growth, accel = motion(leg, readings)
        now.quaternion[TIBIA + leg] = mounted.coeffs()[[3, 0, 1, 2]]
        np.testing.assert_allclose(position, true(), atol=1e-9)
        np.testing.assert_allclose(lever, (true(step) - true(-step)) / (2.0 * step), atol=1e-8)
        np.testing.assert_allclose(growth, (true(length=SEGMENT + 1e-3) - true()) / 1e-3, atol=1e-8)
        world = []
        for imu in (PELVIS, TIBIA + leg):
            w, x, y, z = now.quaternion[imu]
            world.append(pinocchio.Quaternion(w, x, y, z) * now.accel[imu])
        np.testing.assert_allclose(accel, world[1] - world[0], atol=1e-9)

    def test_lengths_are_those_of_the_exoskeleton(self):
        assert MODEL.pelvis_imu == PELVIS_IMU
        assert MODEL.fh_offset == (0.0, FRONTAL_HIP, 0.0)
        assert MODEL.th_offset == (*TRANSVERSE_HIP, 0.0)
        assert MODEL.sh_offset == (-TRANSVERSE_HIP[0], 0.0, 0.0)
        x, y, z = MODEL.tibia_imu
        assert (x, pytest.approx(y + MODEL.knee_lateral), z) == TIBIA_IMU


class WalkingRobot(SimulatedRobot):
    """A simulated robot whose joints perform the walking motion."""

    def position(self) -> np.ndarray:
        return walk().position[self.cycles % STRIDE]


class TestInTheCycle:
    """The checks run in each cycle in which all values are at most four cycles old. Older values restart the filters."""

    def drifted(self, **changes: dict[int, int]) -> WalkingRobot:
        """Return a robot that walked with drifts of all hips and knees."""
        robot = WalkingRobot(**changes)
        robot.run(4000, lambda now: self.drift(robot, now))
        return robot

    def drift(self, robot: WalkingRobot, now: Signals) -> None:
        walk().write(now, robot.cycles)
        drift = min(robot.cycles * RATE, math.radians(6.0))
        now.position[SK] += drift * GEAR[SK]
        now.position[SH] -= drift * GEAR[SH]

    def nodes(self, robot: WalkingRobot) -> set[str]:
        return {finding.node for finding in robot.checks.findings if "accelerometers of pelvis" in finding.text}

    def found(self, **changes: dict[int, int]) -> bool:
        return bool(self.nodes(self.drifted(**changes)))

    def test_a_drive_of_hip_or_knee_that_restarts_ends_the_finding_of_its_leg(self):
        robot = self.drifted()
        for node, left in (
            ("LEFT_SA", {"LEFT_SK", "RIGHT_SK"}), ("IMU_PELVIS", {"LEFT_SK", "RIGHT_SK"}), ("LEFT_SH", {"RIGHT_SK"}),
            ("RIGHT_SK", set()),
        ):  # fmt: skip
            robot.checks.reference(node)
            robot.run(1, lambda now: self.drift(robot, now))
            assert self.nodes(robot) == left
        robot.run(4000, lambda now: self.drift(robot, now))
        assert self.nodes(robot) == {"LEFT_SK", "RIGHT_SK"}

    @pytest.mark.parametrize(("imu", "found"), [("torso", True), ("pelvis", False), ("right_tibia", False)])
    def test_only_restarts_of_its_imus_restart_the_check(self, imu: str, found: bool):
        """The IMU restarts every 1.5 s. After each restart of the check, its filters settle for 2 s."""
        robot = WalkingRobot()
        for _ in range(3):
            robot.run(1500, lambda now: self.drift(robot, now))
            robot.checks.reference(f"IMU_{imu.upper()}")
        assert bool(self.nodes(robot)) is found

    def test_drift_is_found(self):
        assert self.found()

    @pytest.mark.sample(5)
    @pytest.mark.parametrize("sensor", ["left_FH", "left_TH", "right_SK", "IMU_pelvis", "IMU_right_tibia"])
    def test_late_values_are_used_and_old_values_are_not(self, sensor: str):
        assert self.found(late={row(sensor): 4})
        assert not self.found(late={row(sensor): 5})

    def test_late_values_of_other_sensors_have_no_effect(self):
        assert self.found(late={row("left_SA"): 5, row("IMU_torso"): 5, row("foot_left"): 5})

    @pytest.mark.parametrize("imu", [PELVIS, TIBIA])
    def test_impact_beyond_the_measuring_range_is_not_reported_as_drift(self, imu: int):
        """Each landing accelerates an IMU by 300 m/s2 for 2 ms, which saturates it, and then by -100 m/s2 for 6 ms."""
        robot = WalkingRobot()

        def land(now: Signals) -> None:
            walk().write(now, robot.cycles)
            since = robot.cycles % (STRIDE // 2)
            if since < 8:
                now.accel[imu, 0] += 300.0 if since < 2 else -100.0

        for _ in range(5000):
            robot.cycle(land)
            assert self.nodes(robot) == set()
