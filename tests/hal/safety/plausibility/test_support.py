"""Support checks: load on a raised foot, and load on the leg from which the robot leans away."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest
from simulated_robot import DATA, GEAR, MIDDLE, MODEL, ROBOT, SimulatedRobot, attitudes, only, signals

from atalante_control.model import ExoskeletonParameters
from atalante_hal.robot import FEET, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.signals import Ages
from atalante_hal.safety.plausibility.support import (
    ANKLE_DISTANCE,
    HEIGHT_CYCLES,
    WEIGHT_CYCLES,
    Support,
    on_wrong_leg,
    posture_of,
)

KNEES = [JOINTS.index(f"{side}_SK") for side in FEET]
HIPS = [JOINTS.index(f"{side}_SH") for side in FEET]
STRAIGHT = np.zeros(12)


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions wxyz."""
    w, x, y, z = a
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


def rotation(axis: int, angle: float) -> np.ndarray:
    """Return the quaternion wxyz of a rotation about an axis of the world."""
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2.0), math.sin(angle / 2.0)
    return quaternion


def lifted(foot: int, knee: float) -> np.ndarray:
    """Return the joint positions with one bent leg, whose shank is tilted backwards by half the knee angle."""
    position = STRAIGHT.copy()
    position[KNEES[foot]], position[HIPS[foot]] = knee, -knee / 2.0
    return position


class Legs:
    """The support checks, called directly in every cycle."""

    def __init__(self) -> None:
        self.now = signals()
        self.checks = Support(ROBOT, self.now, 1)

    def pose(self, position: np.ndarray, roll: float = 0.0, yaw: float = 0.0) -> None:
        self.now.position[:] = position * GEAR
        turn = multiplied(rotation(2, yaw), rotation(0, roll))
        self.now.quaternion[:] = [multiplied(turn, attitude) for attitude in attitudes(position)]

    def run(self, cycles: int, left: float, right: float) -> list[bool]:
        self.now.force[0, :, 2], self.now.force[1, :, 2] = left / 4.0, right / 4.0
        return [self.checks.evaluate(None) for _ in range(cycles)]


class TestHeight:
    @pytest.mark.parametrize("foot", [0, 1])
    def test_load_on_a_raised_foot_is_reported_if_the_lower_foot_carries_none(self, foot: int):
        legs = Legs()
        legs.pose(lifted(foot, 0.8))
        loads = (800.0, 0.0) if foot == 0 else (0.0, 800.0)
        for _ in range(2):
            assert legs.run(HEIGHT_CYCLES + 1, *loads) == [False] * (HEIGHT_CYCLES - 1) + [True] * 2
            text = (
                f"the {FEET[foot]} foot reports load although it is 0.06 m above the other foot, which reports no load"
            )
            assert legs.checks.findings() == (
                Finding(Dtc.FOOT_CELL, f"FOOT_{FEET[foot].upper()}", pytest.approx(0.063, abs=0.001), True, text),
            )
            assert legs.run(1, *loads[::-1]) == [False]
            assert legs.checks.findings() == ()

    @pytest.mark.parametrize("foot", [0, 1])
    def test_raised_foot_may_carry_load_together_with_the_lower_foot(self, foot: int):
        """The raised foot stands on a step, so both feet carry load."""
        legs = Legs()
        legs.pose(lifted(foot, 0.8))
        assert not any(legs.run(300, 800.0, 800.0))

    @pytest.mark.parametrize("foot", [0, 1])
    def test_load_on_the_lower_foot_is_accepted(self, foot: int):
        legs = Legs()
        legs.pose(lifted(foot, 0.8))
        assert not any(legs.run(300, *((0.0, 800.0) if foot == 0 else (800.0, 0.0))))

    def test_raised_foot_with_one_loaded_cell_is_accepted(self):
        legs = Legs()
        legs.pose(lifted(0, 0.8))
        legs.now.force[0, 2, 2] = 500.0
        assert not any(legs.checks.evaluate(None) for _ in range(300))
        legs.now.force[0, 1, 2] = -ROBOT.sensors.cell_free - 1.0
        assert any(legs.checks.evaluate(None) for _ in range(300))

    @pytest.mark.parametrize(("knee", "found"), [(0.62, False), (0.66, True)])
    def test_height_of_four_centimetres_is_the_limit(self, knee: float, found: bool):
        legs = Legs()
        legs.pose(lifted(1, knee))
        assert any(legs.run(100, 0.0, 800.0)) == found

    def test_interrupted_time_is_counted_from_zero(self):
        legs = Legs()
        legs.pose(lifted(0, 0.8))
        for _ in range(3):
            assert not any(legs.run(HEIGHT_CYCLES - 1, 800.0, 0.0))
            assert not any(legs.run(1, 800.0, 700.0))
        for _ in range(3):
            assert not any(legs.run(HEIGHT_CYCLES - 1, 800.0, 0.0))
            assert not any(legs.run(1, 0.0, 0.0))


class TestWeight:
    LEAN = 0.08  # rad

    @pytest.mark.parametrize("side", [1.0, -1.0])
    @pytest.mark.parametrize("yaw", [0.0, 2.0])
    def test_load_on_the_wrong_leg_is_reported(self, side: float, yaw: float):
        legs = Legs()
        legs.pose(STRAIGHT, 0.0, yaw)
        # Both legs lean to one side, while the pelvis is level: the hips turn the legs.
        position = STRAIGHT.copy()
        position[[0, 6]] = side * self.LEAN
        legs.pose(position, 0.0, yaw)
        wrong = (1000.0, 400.0) if side > 0.0 else (400.0, 1000.0)
        for _ in range(2):
            assert legs.run(WEIGHT_CYCLES + 1, *wrong) == [False] * (WEIGHT_CYCLES - 1) + [True] * 2
            finding = only(legs.checks.findings())
            assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.CONTACT_IMPLAUSIBLE, "FOOT_LEFT", True)
            assert finding.value == pytest.approx(-side * self.LEAN, abs=0.002)
            assert finding.text == (
                f"the feet are exchanged: the robot leans 5 degrees to the {'right' if side > 0 else 'left'}, but the load is "
                f"{wrong[0]:.0f} N on the left and {wrong[1]:.0f} N on the right foot"
            )
            assert legs.run(1, *wrong[::-1]) == [False]
        for _ in range(3):
            assert not any(legs.run(WEIGHT_CYCLES - 1, *wrong))
            assert not any(legs.run(1, 700.0, 700.0))
        for _ in range(3):
            assert not any(legs.run(WEIGHT_CYCLES - 1, *wrong))
            assert not any(legs.run(1, 0.0, 0.0))
        assert not any(legs.run(300, *wrong[::-1]))
        assert not any(legs.run(300, *((1000.0, 0.0) if side > 0.0 else (0.0, 1000.0))))

    @pytest.mark.parametrize(
        ("lean", "left", "right", "wrong"),
        [
            (0.06, 400.0, 1000.0, True),
            (-0.06, 1000.0, 400.0, True),
            (0.06, 1000.0, 400.0, False),
            (-0.06, 400.0, 1000.0, False),
            (0.05, 400.0, 1000.0, False),
            (0.051, 400.0, 1000.0, True),
            (-0.049, 1000.0, 400.0, False),
            (0.06, 700.0, 1300.0, False),
            (0.06, 699.0, 1301.0, True),
            (-0.06, 1300.0, 700.0, False),
        ],
    )
    def test_limits_of_lean_and_load(self, lean: float, left: float, right: float, wrong: bool):
        assert on_wrong_leg(lean, left, right) == wrong


class TestPosture:
    @pytest.mark.parametrize("seed", range(8))
    def test_height_and_lean_agree_with_the_kinematic_model(self, seed: int):
        rng = np.random.default_rng(seed)
        position = np.clip(MIDDLE + 0.1 * rng.standard_normal(12), ROBOT.position_min, ROBOT.position_max)
        turn = multiplied(rotation(2, rng.uniform(-3.0, 3.0)), rotation(0, rng.uniform(-0.1, 0.1)))
        q = pinocchio.neutral(MODEL.model)
        q[MODEL.q] = position
        pinocchio.forwardKinematics(MODEL.model, DATA, q)
        w, x, y, z = turn
        world = pinocchio.Quaternion(w, x, y, z).toRotationMatrix()
        ankles = [world @ DATA.oMi[MODEL.model.getJointId(f"{side}_SA")].translation for side in FEET]
        shanks = [world @ DATA.oMi[MODEL.model.getJointId(f"{side}_SK")].rotation[:, 2] for side in FEET]
        left = world[:2, 1] / np.linalg.norm(world[:2, 1])
        imus = [multiplied(turn, attitude).tolist() for attitude in attitudes(position)]
        posture = posture_of(imus[1], imus[2:], position[KNEES].tolist())
        assert posture.height == pytest.approx(ankles[0][2] - ankles[1][2], abs=0.012)
        assert posture.lean == pytest.approx(np.mean([shank[:2] @ left for shank in shanks]), abs=1e-9)

    def test_distance_of_the_ankles_is_that_of_the_exoskeleton(self):
        model = ExoskeletonParameters()
        lateral = model.fh_offset[1] + model.th_offset[1] + model.knee_lateral + model.ankle_lateral
        assert 2.0 * lateral == pytest.approx(ANKLE_DISTANCE)


class TestAges:
    @pytest.mark.parametrize("sensor", ["joint", "imu", "foot"])
    def test_load_is_not_compared_with_old_values(self, sensor: str):
        legs = Legs()
        legs.pose(lifted(0, 0.8))
        legs.run(HEIGHT_CYCLES - 1, 800.0, 0.0)
        old = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        getattr(old, sensor)[KNEES[1] if sensor == "joint" else -1] = 1
        assert not legs.checks.evaluate(old)
        getattr(old, sensor)[:] = 0
        old.joint[0] = 50  # only the knees are used
        assert legs.checks.evaluate(old)
        getattr(old, sensor)[-1 if sensor != "joint" else KNEES[0]] = 1
        assert legs.checks.evaluate(old)  # the finding remains


def test_support_is_checked_while_the_robot_moves():
    robot = SimulatedRobot(amplitude=0.0)
    position = lifted(1, 1.0)

    def raise_right(now) -> None:
        now.position[:] = position * GEAR
        now.quaternion[:] = attitudes(position)
        now.force[1, :, 2] += 150.0

    robot.checks = type(robot.checks)(ROBOT, robot.image, 1e-3)
    assert robot.until_found(Dtc.FOOT_CELL, 100, raise_right) <= 96
