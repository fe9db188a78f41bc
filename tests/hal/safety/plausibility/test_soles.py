"""Sole checks: a sole that lies flat on the floor is level, so an error of an ankle encoder tilts it."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest
from simulated_robot import DATA, GEAR, MIDDLE, MODEL, ROBOT, SimulatedRobot, attitudes, only, signals

from atalante_control.model import ExoskeletonParameters
from atalante_hal.robot import FEET, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.signals import Ages
from atalante_hal.safety.plausibility.soles import HENKE_AXIS, SOLE_SAMPLES, TOE_OUT, Soles, sole_tilt, stands_flat
from atalante_hal.wire.process_image import NEVER

LIMIT = ROBOT.sensors.sole_tilt
LOADED = 4.0 * ROBOT.sensors.cell_free
SA, HA = (JOINTS.index(f"left_{name}") for name in ("SA", "HA"))
SIDES = pytest.mark.parametrize("foot", [0, 1])


class Standing:
    """The sole checks of a robot that stands with straight legs, called directly."""

    def __init__(self, cell: float = 100.0) -> None:
        self.now = signals()
        self.now.quaternion[:] = attitudes(np.zeros(12))
        self.now.force[:, :, 2] = cell
        self.checks = Soles(ROBOT, self.now)

    def error(self, joint: int, angle: float) -> None:
        self.now.position[joint] = angle * GEAR[joint]

    def run(self, samples: int, ages: Ages | None = None) -> list[tuple[bool, bool]]:
        """Return the results of the checks of the left and the right sole in each sample."""
        return [(self.checks.check_left(ages), self.checks.check_right(ages)) for _ in range(samples)]

    def found(self, samples: int = SOLE_SAMPLES) -> bool:
        return any(any(result) for result in self.run(samples))


@pytest.mark.parametrize("seed", range(8))
@SIDES
def test_tilt_agrees_with_the_kinematic_model(seed: int, foot: int):
    rng = np.random.default_rng(seed)
    position = np.clip(MIDDLE + 0.2 * rng.standard_normal(12), ROBOT.position_min, ROBOT.position_max)
    q = pinocchio.neutral(MODEL.model)
    q[MODEL.q] = position
    pinocchio.framesForwardKinematics(MODEL.model, DATA, q)
    up = DATA.oMf[MODEL.model.getFrameId(f"{FEET[foot]}_foot")].rotation[2]
    tibia = attitudes(position)[2 + foot].tolist()
    tilt = sole_tilt(tibia, position[SA + 6 * foot], position[HA + 6 * foot], TOE_OUT if foot == 0 else -TOE_OUT)
    assert tilt == pytest.approx(tuple(up[:2]), abs=1e-9)


def test_ankle_geometry_is_that_of_the_exoskeleton():
    model = ExoskeletonParameters()
    assert model.toe_out == TOE_OUT
    assert (HENKE_AXIS[0], 0.0, HENKE_AXIS[1]) == model.ha_axis


@SIDES
@pytest.mark.parametrize(("joint", "share"), [(SA, 1.0), (HA, 0.788)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_error_of_an_ankle_encoder_is_reported_with_its_joint(foot: int, joint: int, share: float, sign: float):
    robot, joint = Standing(), joint + 6 * foot
    robot.error(joint, sign * 1.01 * LIMIT / share)
    waits, found = [(False, False)] * (SOLE_SAMPLES - 1), (foot == 0, True)
    for _ in range(2):
        assert robot.run(SOLE_SAMPLES + 1) == [*waits, found, (True, True)]
        finding = only(robot.checks.findings())
        assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.ENC_DRIFT, JOINTS[joint].upper(), True)
        assert finding.value == pytest.approx(1.01 * LIMIT, rel=0.01)
        level = f"the {FEET[foot]} sole must be level, because it is flat on the floor"
        assert finding.text == f"encoder of {JOINTS[joint]}: {level}, got a tilt of 2.0 degrees"
        robot.now.force[foot, :2, 2] = 0.0
        robot.run(1)
        assert robot.checks.findings() == ()
        robot.now.force[foot, :2, 2] = 100.0


@SIDES
@pytest.mark.parametrize(("joint", "share"), [(SA, 1.0), (HA, 0.788)])
def test_tilt_within_the_limit_is_accepted(foot: int, joint: int, share: float):
    robot = Standing()
    robot.error(joint + 6 * foot, 0.99 * LIMIT / share)
    assert not robot.found(20)


@pytest.mark.parametrize(
    ("cells", "flat"),
    [
        ([61.0, 60.0, 60.0, 60.0], True),
        ([60.0, 60.0, 60.0, 60.0], False),
        ([90.0, 90.0, 10.0, 10.0], False),  # light
        ([900.0, 900.0, 100.0, 100.0], True),  # on the limit
        ([901.0, 900.0, 100.0, 100.0], False),  # on its toes
        ([100.0, 100.0, 900.0, 901.0], False),  # on its heel
        ([600.0, -100.0, 600.0, -100.0], True),  # on the limit
        ([601.0, -100.0, 600.0, -100.0], True),
        ([601.0, -101.0, 600.0, -100.0], False),  # on its left edge
        ([-101.0, 600.0, -100.0, 601.0], False),  # on its right edge
        ([-100.0, 600.0, -100.0, 600.0], True),
    ],
)
def test_foot_stands_flat_if_the_centre_of_pressure_is_away_from_the_edges(cells: list[float], flat: bool):
    assert stands_flat(cells, LOADED) == flat


@SIDES
@pytest.mark.parametrize(
    "cells", [[400.0, 400.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [59.0, 59.0, 59.0, 59.0]], ids=["toes", "air", "light"]
)
def test_foot_that_does_not_stand_flat_may_be_tilted(foot: int, cells: list[float]):
    robot = Standing()
    robot.error(SA + 6 * foot, 0.1)
    robot.now.force[foot, :, 2] = cells
    assert not robot.found(20)
    assert robot.checks.findings() == ()


def test_both_soles_are_reported():
    robot = Standing()
    robot.error(SA, 0.1)
    robot.error(HA + 6, 0.1)
    assert robot.found()
    assert [finding.node for finding in robot.checks.findings()] == ["LEFT_SA", "RIGHT_HA"]
    robot.error(SA, 0.0)
    assert robot.run(1) == [(True, True)]
    assert only(robot.checks.findings()).node == "RIGHT_HA"


def test_interrupted_tilt_is_counted_from_zero():
    robot = Standing()
    for _ in range(3):
        robot.error(SA, 0.1)
        assert not robot.found(SOLE_SAMPLES - 1)
        robot.error(SA, 0.0)
        assert not robot.found(1)


@SIDES
def test_level_sole_under_a_tilted_shank_is_accepted(foot: int):
    """The shank is tilted forwards and sideways, and Newton's method finds the angles of the ankle for a level sole."""
    robot, position = Standing(), np.zeros(12)
    position[6 * foot], position[SA - 2 + 6 * foot] = 0.1, 0.25
    tibia = attitudes(position)[2 + foot]
    toe_out, ankle = TOE_OUT if foot == 0 else -TOE_OUT, np.zeros(2)
    for _ in range(5):
        tilt, step = np.array(sole_tilt(tibia.tolist(), *ankle, toe_out)), 1e-6
        slopes = [np.array(sole_tilt(tibia.tolist(), *(ankle + step * axis), toe_out)) - tilt for axis in np.eye(2)]
        ankle -= np.linalg.solve(np.array(slopes).T / step, tilt)
    robot.now.quaternion[2 + foot] = tibia
    robot.error(SA + 6 * foot, ankle[0])
    robot.error(HA + 6 * foot, ankle[1])
    assert not robot.found(20)


@SIDES
@pytest.mark.parametrize(("sensor", "index"), [("joint", SA), ("joint", HA), ("imu", 2), ("foot", 0)])
def test_foot_is_not_checked_with_old_values(foot: int, sensor: str, index: int):
    robot = Standing()
    robot.error(SA + 6 * foot, 0.1)
    ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
    age, index = getattr(ages, sensor), index + (6 if sensor == "joint" else 1) * foot
    age[index] = NEVER
    assert robot.run(20, ages) == [(False, False)] * 20
    age[index] = NEVER - 1
    assert robot.run(SOLE_SAMPLES, ages)[-1] == (foot == 0, True)
    age[index] = NEVER
    robot.error(SA + 6 * foot, 0.0)
    assert robot.run(1, ages) == [(True, True)]  # the finding remains


def test_soles_are_checked_while_the_robot_stands():
    robot = SimulatedRobot(amplitude=0.0)

    def stand(now) -> None:
        now.position[:] = 0.0
        now.position[HA + 6] = math.radians(5.0) * GEAR[HA + 6]
        now.quaternion[:] = attitudes(np.zeros(12))
        now.force[:, :, 2] += 150.0

    robot.checks = type(robot.checks)(ROBOT, robot.image, 1e-3)
    assert robot.until_found(Dtc.ENC_DRIFT, 140, stand) <= 128
