"""Foot placement and step timing: prediction of the DCM error, bounds, dead zone, symmetry, and the shift of the swing foot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.structured import zeros
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.placement import (
    Motion,
    Placement,
    PlacementConfig,
    beyond,
    follow,
    landing,
    late_landing,
    predicted,
    shift_foot,
)
from atalante_hal.robot import LEG_JOINTS, load_robot
from atalante_hal.types import PERIOD

CONFIG, GAIN, W = PlacementConfig(), WalkConfig().stabiliser, 3.3
ERRORS = st.floats(-0.3, 0.3)
EXPONENTS = st.floats(0.2, 2.5)
LEG = len(LEG_JOINTS)


def motion(x: float, y: float, exponent: float, side: float = 1.0) -> Motion:
    """Return a motion whose nominal DCM moves by 0.1 m forwards and outwards until the landing."""
    return Motion((x, y), (0.0, 0.06 * side), (0.1, 0.16 * side), exponent, side)


@pytest.mark.parametrize("gain", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("error", [-0.2, -0.05, -0.04, -0.03, 0.0, 0.01, 0.03, 0.0439, 0.0441, 0.1])
@pytest.mark.parametrize("time", [0.0, 0.2, 0.7])
def test_prediction_solves_the_equation_of_the_error(gain: float, error: float, time: float) -> None:
    limit, step, e = 0.044, 1e-4, error
    for _ in range(round(time / step)):
        e += step * W * (e - min(max(gain * e, -limit), limit))
    assert predicted(error, gain, limit, W * time) == pytest.approx(e, abs=2e-3 * abs(e) + 2e-4)


@given(ERRORS, EXPONENTS)
def test_prediction_is_odd_and_increasing(error: float, exponent: float) -> None:
    assert predicted(-error, GAIN, 0.044, exponent) == -predicted(error, GAIN, 0.044, exponent)
    assert predicted(error + 1e-3, GAIN, 0.044, exponent) > predicted(error, GAIN, 0.044, exponent)


def test_beyond_is_zero_inside_the_zone_and_continuous_at_its_border() -> None:
    assert beyond(0.01, 0.015) == beyond(-0.015, 0.015) == 0.0
    assert beyond(0.02, 0.015) == pytest.approx(0.005)
    assert beyond(-0.02, 0.015) == pytest.approx(-0.005)


@given(st.floats(-0.035, 0.035), st.floats(-0.015, 0.015), st.floats(0.1, 2.5))
def test_small_error_changes_nothing(x: float, y: float, exponent: float) -> None:
    if abs(predicted(x, GAIN, CONFIG.capacity[0], exponent)) <= CONFIG.dead_zone:
        assert landing(CONFIG, GAIN, motion(x, y, exponent)) == (0.0, 0.0, 1.0)


@given(ERRORS, ERRORS, EXPONENTS)
def test_landing_stays_within_its_bounds(x: float, y: float, exponent: float) -> None:
    forward, left, rate = landing(CONFIG, GAIN, motion(x, y, exponent))
    assert abs(forward) <= CONFIG.forward
    assert -CONFIG.inward <= left <= CONFIG.outward
    assert CONFIG.slowest <= rate <= CONFIG.fastest


@given(ERRORS, ERRORS, EXPONENTS)
def test_landing_of_the_right_foot_mirrors_that_of_the_left_foot(x: float, y: float, exponent: float) -> None:
    forward, left, rate = landing(CONFIG, GAIN, motion(x, y, exponent))
    assert landing(CONFIG, GAIN, motion(x, -y, exponent, side=-1.0)) == (forward, -left, rate)
    near, wide = late_landing(CONFIG, (x, y), 1.0)
    assert late_landing(CONFIG, (x, -y), -1.0) == (near, -wide)


def test_push_to_the_swing_side_hastens_the_step_and_widens_it() -> None:
    forward, left, rate = landing(CONFIG, GAIN, motion(0.0, 0.08, 1.5))
    assert forward == 0.0
    assert left > 0.0
    assert rate > 1.0


def test_push_to_the_stance_side_delays_the_landing_if_the_stance_foot_can_stop_it() -> None:
    _, left, rate = landing(CONFIG, GAIN, motion(0.0, -0.1, 1.5))
    assert abs(left) <= CONFIG.inward  # the delay alone can suffice
    assert rate < 0.8


def test_landing_after_a_large_push_to_the_stance_side_waits_longer_than_twice_the_nominal_time() -> None:
    assert landing(CONFIG, GAIN, motion(0.0, -0.12, 1.0))[2] < 0.5


def test_push_to_the_stance_side_hastens_the_landing_if_the_stance_foot_cannot_stop_it() -> None:
    _, left, rate = landing(CONFIG, GAIN, motion(0.0, -0.2, 1.5))
    assert left == -CONFIG.inward
    assert rate > 1.0


def test_push_forwards_lengthens_the_step() -> None:
    forward, left, rate = landing(CONFIG, GAIN, motion(0.11, 0.0, 1.5))
    expected = predicted(0.11, GAIN, CONFIG.capacity[0], 1.5 / rate) - CONFIG.dead_zone
    assert forward == pytest.approx(expected)
    assert 0.0 < forward < CONFIG.forward
    assert 1.0 <= rate < 1.2
    assert -CONFIG.inward <= left < 0.0  # the DCM has moved outwards less in a shorter step


def test_offset_of_an_immediate_landing_is_the_error_beyond_twice_the_dead_zone() -> None:
    assert late_landing(CONFIG, (0.03, -0.03), 1.0) == (0.0, 0.0)
    assert late_landing(CONFIG, (-0.05, 0.05), 1.0) == pytest.approx((-0.02, 0.02))
    assert late_landing(CONFIG, (1.0, 1.0), 1.0) == (CONFIG.forward, CONFIG.outward)
    assert late_landing(CONFIG, (-1.0, 1.0), -1.0) == (-CONFIG.forward, CONFIG.inward)


def test_offset_and_rate_reach_their_targets_with_limited_speed() -> None:
    placement = zeros(Placement, 1)[0]
    placement.pace, placement.target[:] = 1.0, (0.15, -0.1)
    offsets, rates = [placement.offset.copy()], [1.0]
    for _ in range(600):
        follow(CONFIG, placement, CONFIG.fastest)
        offsets.append(placement.offset.copy())
        rates.append(float(placement.pace))
    assert offsets[-1] == pytest.approx([0.15, -0.1], abs=1e-4)
    assert rates[-1] == pytest.approx(CONFIG.fastest)
    speed = np.diff(offsets, axis=0) / PERIOD
    assert np.abs(speed).max() <= CONFIG.speed + 1e-9
    assert np.abs(np.diff(speed, axis=0)).max() / PERIOD <= CONFIG.acceleration + 1e-6
    assert np.abs(np.diff(rates)).max() <= CONFIG.slew * PERIOD + 1e-12


@pytest.mark.parametrize("swing", [0, 1])
def test_shifted_ankle_reaches_its_goal_and_the_stance_leg_is_unchanged(swing: int) -> None:
    patient, robot = Patient(75.0, 1.75), load_robot()
    exoskeleton = ExoskeletonParameters().fitted(patient)
    kinematics = Kinematics(pinocchio_model(urdf(exoskeleton, robot, patient)), exoskeleton)
    pose = np.array([0.0, 0.0, -0.3, 0.55, -0.25, 0.0] * 2)
    link = kinematics.chain.soles[swing].link
    kinematics.update(pose, np.zeros(12))
    before = kinematics.chain.links[link - 1].origin.copy()
    x, y, z = before.tolist()
    placement, shift = zeros(Placement, 1)[0], (0.08, 0.06 if swing == 0 else -0.06, 0.0)
    placement.low[:], placement.high[:] = robot.position_min, robot.position_max
    for cycle in range(300):
        part = min(1.0, cycle / 200)
        desired = np.concatenate([pose, np.zeros(12)])
        goal = (x + shift[0] * part, y + shift[1] * part, z)
        shift_foot(placement, kinematics.chain.links, link - LEG + 1, desired, swing * LEG, goal)
    kinematics.update(desired[:12], np.zeros(12))
    moved = kinematics.chain.links[link - 1].origin - before
    assert moved == pytest.approx(shift, abs=1e-4)
    other = slice((1 - swing) * LEG, (2 - swing) * LEG)
    assert np.array_equal(desired[other], pose[other])
    assert np.all(desired[:12] >= robot.position_min)
    assert np.all(desired[:12] <= robot.position_max)


def test_position_ahead_and_height_are_reached_if_the_frontal_hip_is_at_its_limit() -> None:
    patient, robot = Patient(75.0, 1.75), load_robot()
    exoskeleton = ExoskeletonParameters().fitted(patient)
    kinematics = Kinematics(pinocchio_model(urdf(exoskeleton, robot, patient)), exoskeleton)
    pose = np.array([0.0, 0.0, -0.3, 0.55, -0.25, 0.0] * 2)
    link = kinematics.chain.soles[0].link
    kinematics.update(pose, np.zeros(12))
    x, y, z = kinematics.chain.links[link - 1].origin.tolist()
    placement = zeros(Placement, 1)[0]
    placement.low[:], placement.high[:] = robot.position_min, robot.position_max
    for _ in range(3000):
        desired = np.concatenate([pose, np.zeros(12)])
        shift_foot(placement, kinematics.chain.links, link - LEG + 1, desired, 0, (x + 0.05, y - 0.4, z + 0.02))
    kinematics.update(desired[:12], np.zeros(12))
    moved = kinematics.chain.links[link - 1].origin
    assert desired[0] == robot.position_min[0]
    assert moved[0] == pytest.approx(x + 0.05, abs=0.03)
    assert y - 0.4 < moved[1] < y - 0.1
    reached = desired.copy()
    for _ in range(100):
        desired = np.concatenate([pose, np.zeros(12)])
        shift_foot(placement, kinematics.chain.links, link - LEG + 1, desired, 0, (x + 0.05, y - 0.4, z + 0.02))
    assert desired[:12] == pytest.approx(reached[:12], abs=1e-6)


def test_straight_leg_is_not_shifted() -> None:
    patient, robot = Patient(75.0, 1.75), load_robot()
    exoskeleton = ExoskeletonParameters().fitted(patient)
    kinematics = Kinematics(pinocchio_model(urdf(exoskeleton, robot, patient)), exoskeleton)
    placement, desired = zeros(Placement, 1)[0], np.zeros(24)
    placement.low[:], placement.high[:] = robot.position_min, robot.position_max
    link = kinematics.chain.soles[0].link
    shift_foot(placement, kinematics.chain.links, link - LEG + 1, desired, 0, (0.0, 0.0, -0.1))
    assert np.array_equal(desired, np.zeros(24))


@pytest.mark.parametrize(
    ("placement", "sentence"),
    [
        (PlacementConfig(slowest=0.0), "placement.slowest must be above 0 and at most 1, got 0.0"),
        (PlacementConfig(slowest=1.1), "placement.slowest must be above 0 and at most 1, got 1.1"),
        (PlacementConfig(fastest=0.9), "placement.fastest must be finite and at least 1, got 0.9"),
        (PlacementConfig(fastest=math.inf), "placement.fastest must be finite and at least 1, got inf"),
        (PlacementConfig(frozen=0.0), "placement.frozen must be at least one cycle"),
        (PlacementConfig(frozen=math.nan), "placement.frozen must be at least one cycle"),
    ],
)
def test_invalid_parameter_is_rejected(placement: PlacementConfig, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        WalkConfig(placement=placement)
