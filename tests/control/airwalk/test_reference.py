"""Desired trajectories: the start motion, and the re-centred reference of each step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.airwalk.reference import GaitReference, StartMotion
from atalante_control.gait.gait import AIRWALK_GAIT, SWAP, Gait, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.joint.pid import LEFT, RIGHT
from atalante_hal.robot import load_robot

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
DEADBEAT = Deadbeat(GAIT.duration, 0.4)
OFFSET = math.radians(1.0)
RNG = np.random.default_rng(5)
TABLES = {RIGHT: GAIT.tables(), LEFT: GAIT.mirrored().tables()}


@pytest.mark.parametrize("stance", [LEFT, RIGHT])
def test_nominal_rows_are_those_of_the_gait_with_the_ankle_offset(stance: int):
    nominal = GaitReference(GAIT, DEADBEAT, OFFSET).nominal[stance]
    assert nominal.shape == (GAIT.cycles + 1, 24)
    added = OFFSET * np.isin(np.arange(12), (4, 10))
    np.testing.assert_allclose(nominal[:, :12], TABLES[stance].q + added, atol=1e-15)
    np.testing.assert_array_equal(nominal[:, 12:], TABLES[stance].qd)


@pytest.mark.parametrize("stance", [LEFT, RIGHT])
def test_step_starts_at_the_measured_motion_and_reaches_the_nominal_one(stance: int):
    reference, (q, qd) = GaitReference(GAIT, DEADBEAT, OFFSET), RNG.normal(size=(2, 12))
    deviation = reference.start_step(stance, q, qd)
    nominal = reference.nominal[stance]
    np.testing.assert_array_equal(deviation.angle, q - nominal[0, :12])
    np.testing.assert_array_equal(deviation.rate, qd - nominal[0, 12:])
    np.testing.assert_allclose(reference.row(stance, 0), [*q, *qd], atol=1e-12)
    end = round(DEADBEAT.end * 1e3)
    for cycle in (1, end // 2, end - 1, end, GAIT.cycles):
        s = DEADBEAT.s(np.array([cycle * 1e-3]), deviation.angle, deviation.rate)[0]
        np.testing.assert_allclose(reference.row(stance, cycle)[:12], nominal[cycle, :12] + s, atol=1e-12)
    np.testing.assert_allclose(reference.row(stance, end), nominal[end], atol=1e-12)


def test_new_step_does_not_depend_on_the_last_deviation():
    used, fresh = (GaitReference(GAIT, DEADBEAT, OFFSET) for _ in range(2))
    used.start_step(RIGHT, *RNG.normal(size=(2, 12)))
    motion = RNG.normal(size=(2, 12))
    for reference in (used, fresh):
        reference.start_step(RIGHT, *motion)
    for cycle in range(GAIT.cycles + 1):
        np.testing.assert_array_equal(used.row(RIGHT, cycle), fresh.row(RIGHT, cycle))


def test_left_stance_step_mirrors_the_right_one():
    reference = GaitReference(GAIT, DEADBEAT, 0.0)
    right, left = reference.nominal[RIGHT][:, :12], reference.nominal[LEFT][:, :12]
    np.testing.assert_allclose(np.abs(left), np.abs(right[:, SWAP]), atol=1e-15)


def test_start_motion_leads_from_rest_to_the_first_pose_and_speed():
    first, pose = RNG.normal(size=24), RNG.normal(size=12)
    motion = StartMotion(first, 0.5, np.full(12, 100.0))
    assert motion.cycles == 500
    motion.start(pose)
    np.testing.assert_allclose(motion.row(0), [*pose, *np.zeros(12)], atol=1e-15)
    np.testing.assert_allclose(motion.row(500), first, atol=1e-12)
    rows = np.array([motion.row(cycle).copy() for cycle in range(501)])
    rates = (rows[2:, :12] - rows[:-2, :12]) / 2e-3
    np.testing.assert_allclose(rows[1:-1, 12:], rates, atol=1e-3)


@pytest.mark.parametrize("gait", [GAIT, load_walk(DEFAULT_WALK, ROBOT).step], ids=["airwalk", "walk"])
@pytest.mark.parametrize("duration", [0.5, 2.0, 10.0])
def test_start_motion_stays_inside_the_position_limits(gait: Gait, duration: float):
    first = GaitReference(gait, Deadbeat(gait.duration, 0.4), OFFSET).nominal[RIGHT][0]
    motion = StartMotion(first, duration, ROBOT.velocity_max)
    for pose in (np.zeros(12), first[:12]):
        motion.start(pose)
        angles = np.array([motion.row(cycle)[:12].copy() for cycle in range(motion.cycles + 1)])
        assert (angles <= ROBOT.position_max).all()
        assert (angles >= ROBOT.position_min).all()


def test_start_motion_from_a_distant_pose_takes_longer_so_that_no_joint_exceeds_half_its_velocity_limit():
    first, limits = np.zeros(24), np.full(12, 4.0)
    limits[4] = 8.0
    motion = StartMotion(first, 0.5, limits)
    for joint in range(12):
        pose = np.zeros(12)
        pose[joint] = -1.5
        motion.start(pose)
        assert motion.cycles == math.ceil(1.875 * 1.5 / (0.5 * limits[joint]) * 1000)
        speeds = np.abs([motion.row(cycle)[12:].copy() for cycle in range(motion.cycles + 1)]).max(axis=0)
        assert 0.499 * limits[joint] < speeds[joint] <= 0.5 * limits[joint] * (1 + 1e-9)
        np.testing.assert_allclose(motion.row(motion.cycles), first, atol=1e-12)
    motion.start(np.full(12, 0.01))
    assert motion.cycles == 500
