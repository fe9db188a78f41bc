"""Guides of the airwalk controller: gains from the inertias, torque limits, and the filter of a step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.airwalk.assistance import Assistance
from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.step_guides import StepGuides, backup_torque_limits, guide_configs
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.shapes import CONSTANT
from atalante_control.joint.idealization import AssistedInertia
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot

ROBOT, CONFIG = load_robot(), AirwalkConfig()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
POSES = GAIT.tables().q
INERTIA = AssistedInertia(MODEL, POSES)
LIMITS = np.array([150.0, 120.0])


def test_gains_follow_from_inertia_natural_frequency_and_damping():
    configs = list(guide_configs(CONFIG, INERTIA, LIMITS))
    assert len(configs) == len(CONFIG.gentler) + 1
    for part, config in zip((*CONFIG.gentler, 1.0), configs, strict=True):
        for j, rate, limit, policy in zip(INERTIA.inertias, CONFIG.guide_rate, LIMITS, config.policies, strict=True):
            assert policy.torque_limit == limit
            assert math.sqrt(policy.kp / policy.inertia) == pytest.approx(part * rate)
            assert policy.kd / (2.0 * math.sqrt(policy.kp * j)) == pytest.approx(CONFIG.guide_damping)


def test_backup_torque_is_what_gravity_and_friction_leave():
    limits = backup_torque_limits(ROBOT, CONFIG, Gravity(MODEL), POSES)
    weight = np.abs([Gravity(MODEL).torque(pose, (1.0, 0.0, 0.0, 0.0)).copy() for pose in POSES[::20].copy()]).max(0)
    for i, joint in enumerate((2, 3)):
        assert limits[i] + weight[joint] + CONFIG.friction.torque(joint, 2.0) == pytest.approx(ROBOT.torque_max[joint])
    assert (limits > 0.0).all()


def test_filter_of_a_step_is_the_one_of_lowest_gains_that_is_certified_with_the_margin():
    deadbeat = Deadbeat(GAIT.duration, CONFIG.alpha)
    assistance = Assistance(INERTIA, GAIT, CONFIG.friction, decoupled=True, feedforward=False)
    limits = backup_torque_limits(ROBOT, CONFIG, Gravity(MODEL), POSES)
    guides = StepGuides(CONFIG, CONSTANT, GAIT, deadbeat, assistance, limits)
    chosen = [guides.filters.index(guides.at(xi)) for xi in np.linspace(0.0, 1.0, 21).tolist()]
    assert chosen == sorted(chosen)
    assert chosen[-1] == len(guides.filters) - 1
    assert guides.certificate(0.5).certified
    assert "only the baseline" in guides.certificate(1.0).reason
