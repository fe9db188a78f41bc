"""Tables of the walk: the downward motion of a swing foot that lands late."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.dynamics.gait_network import load_network
from atalante_control.gait.subject import STUDY_PATIENTS, Subject
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.reference import PhaseTable, Reach, step_table
from atalante_hal.robot import LEG_JOINTS, load_robot
from atalante_hal.types import PERIOD

ROBOT = load_robot()
CONFIG = WalkConfig()
_SK = LEG_JOINTS.index("SK")
LEFT, RIGHT = 0, 1


def table(patient: Patient, reach: Reach, stance: int) -> PhaseTable:
    exoskeleton = ExoskeletonParameters().fitted(patient)
    gait = load_network().gait(Subject(patient, 0.16, 0.8), ROBOT)
    kinematics = Kinematics(pinocchio_model(urdf(exoskeleton, ROBOT, patient)), exoskeleton)
    return step_table(gait, stance, (0.3, 0.5), reach, kinematics, exoskeleton.toe_out)


@pytest.mark.parametrize("patient", STUDY_PATIENTS, ids=str)
@pytest.mark.parametrize("stance", [LEFT, RIGHT])
def test_joints_stay_within_their_limits_while_a_late_foot_moves_down(patient: Patient, stance: int) -> None:
    knee = len(LEG_JOINTS) * (1 - stance) + _SK
    reach = Reach(CONFIG.reach_speed[0], CONFIG.reach_rate, CONFIG.reach_time, CONFIG.reach_knee)
    lowered = table(patient, reach, stance)
    assert np.abs(lowered.reach).max() == pytest.approx(CONFIG.reach_rate)
    assert CONFIG.reach_rate < ROBOT.velocity_max[knee]
    last = lowered.rows[-1, knee] + lowered.reach[1] * lowered.reach_cycles * PERIOD
    assert last == pytest.approx(CONFIG.reach_knee, abs=CONFIG.reach_rate * PERIOD)
    assert last > ROBOT.position_min[knee]


@pytest.mark.parametrize("stance", [LEFT, RIGHT])
def test_swing_ankle_moves_by_two_steps_and_starts_and_ends_at_the_height_of_a_standing_foot(stance: int) -> None:
    side = 1.0 if stance == RIGHT else -1.0
    ankle = table(STUDY_PATIENTS[4], Reach(0.3, CONFIG.reach_rate, CONFIG.reach_time, CONFIG.reach_knee), stance).ankle
    assert ankle[-1, 0] - ankle[0, 0] == pytest.approx(2 * 0.16, abs=0.01)
    assert np.all(side * ankle[:, 1] > 0.1)
    assert ankle[[0, -1], 2] == pytest.approx(-ExoskeletonParameters().sole_centre[1], abs=0.003)
    assert ankle[:, 2].max() - ankle[0, 2] > 0.04


def test_speed_of_the_late_foot_is_reduced_with_the_speeds_of_its_joints() -> None:
    patient, rate, time, knee = STUDY_PATIENTS[0], CONFIG.reach_rate, CONFIG.reach_time, CONFIG.reach_knee
    fast, slow = (table(patient, Reach(speed, rate, time, knee), RIGHT) for speed in (0.3, 0.01))
    assert slow.lowering == 0.01
    assert 0.01 < fast.lowering < 0.3
    assert fast.reach / fast.lowering == pytest.approx(slow.reach / slow.lowering)


def test_bound_of_the_speed_keeps_the_direction_and_a_slow_motion() -> None:
    patient, rate, time, knee = STUDY_PATIENTS[0], CONFIG.reach_rate, CONFIG.reach_time, CONFIG.reach_knee
    fast, slow = (table(patient, Reach(speed, rate, time, knee), RIGHT) for speed in (0.3, 0.01))
    assert np.abs(slow.reach).max() < 0.5 * rate
    assert fast.reach / np.abs(fast.reach).max() == pytest.approx(slow.reach / np.abs(slow.reach).max())
    assert slow.reach_cycles * PERIOD == pytest.approx(time)


def test_straight_knee_does_not_move_down() -> None:
    straight = table(STUDY_PATIENTS[0], Reach(0.3, CONFIG.reach_rate, CONFIG.reach_time, 1.0), RIGHT)
    assert straight.reach_cycles == 0
