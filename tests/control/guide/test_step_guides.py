"""Guides of a walk: gains, and the filter of a step."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.swing_leg import OVERLAP, swing_leg
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.certificate import PromiseLimits
from atalante_control.guide.shapes import CONSTANT, SHAPES, GuideShape
from atalante_control.guide.step_guides import StepGuides, filter_config, policies
from atalante_control.joint.idealization import AssistedInertia
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import JOINTS, load_robot

ROBOT, CONFIG = load_robot(), AirwalkConfig()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
INERTIA = AssistedInertia(MODEL, GAIT.tables().q)
LEG = swing_leg(CONFIG, GAIT, INERTIA, Gravity(MODEL))


def test_stiffness_of_the_policies_is_that_of_the_configuration():
    found = policies(CONFIG, INERTIA)
    assert len(found) == len(CONFIG.gentler) + 1
    for part, policy in zip((*CONFIG.gentler, 1.0), found, strict=True):
        np.testing.assert_allclose(policy.stiffness, part * np.array(CONFIG.stiffness))
        assert policy.damping == CONFIG.damping


def test_limits_of_the_filter_follow_from_the_limits_of_the_robot():
    found = filter_config(CONFIG, ROBOT)
    hip = JOINTS.index("left_SH")
    assert found.torque_limit == ROBOT.torque_max[hip] - CONFIG.torque_reserve
    assert found.rate_limit == ROBOT.torque_rate_max[hip] * 1e-3
    assert found.speed_limit == ROBOT.velocity_max[hip] - CONFIG.speed_reserve
    assert found.worst_speed_limit == ROBOT.velocity_max[hip] + ROBOT.envelope.velocity_margin
    weak = ROBOT.torque_max.copy()
    weak[JOINTS.index("left_SK")] = 100.0
    assert filter_config(CONFIG, replace(ROBOT, torque_max=weak)).torque_limit == 100.0 - CONFIG.torque_reserve


@pytest.mark.parametrize("bad", [{"torque_reserve": -1.0}, {"speed_reserve": math.nan}])
def test_a_negative_reserve_is_rejected(bad: dict[str, float]):
    with pytest.raises(ValueError, match="reserve must be finite"):
        replace(CONFIG, **bad)


def test_filter_of_a_step_gets_stiffer_with_the_assistance_factor():
    blend = np.linspace(1.0, 0.0, 20)
    guides = StepGuides(CONFIG, ROBOT, CONSTANT, LEG, blend, OVERLAP)
    chosen = [guides.filters.index(guides.at(xi).guide) for xi in np.linspace(0.0, 1.0, 11).tolist()]
    assert chosen == sorted(chosen)
    assert guides.certificate(0.5).certified
    assert "only the baseline" in guides.certificate(1.0).reason


@pytest.mark.parametrize("shape", SHAPES)
def test_prepared_guides_need_no_computation_when_the_assistance_factor_changes(
    shape: str, monkeypatch: pytest.MonkeyPatch
):
    guides = StepGuides(CONFIG, ROBOT, SHAPES[shape], LEG, np.linspace(1.0, 0.0, 20), OVERLAP)
    exact = guides.at(0.37)
    guides.prepare()
    monkeypatch.setattr(PromiseLimits, "at", lambda *_: pytest.fail("a promise was computed in the loop"))
    for raw in range(10001):
        assert guides.at(raw * 0.0001).guide in guides.filters  # decoded as on the bus
    assert guides.at(0.37) == guides.at(37 * 100 * 0.0001) == exact


@pytest.mark.parametrize("shape", SHAPES)
def test_guide_of_any_assistance_factor_is_certified_like_that_of_the_next_hundredth(shape: str):
    guides = StepGuides(CONFIG, ROBOT, SHAPES[shape], LEG, np.linspace(1.0, 0.0, 20), OVERLAP)
    for xi in (0.0001, 0.4951, 0.735, 0.9312, 0.9899, 0.98999999, 0.9901):
        rounded = math.ceil(xi * 100) / 100
        assert guides.at(xi) == guides.at(rounded)
        if rounded < 1.0:  # at Xi = 1, there is no promise
            assert guides.certificate(xi).promise == guides.certificate(rounded).promise


@pytest.mark.parametrize(("hip", "certified"), [(0.9, False), (1.1, True)])
def test_filter_makes_a_promise_only_if_its_certificate_does(hip: float, certified: bool):
    config = replace(CONFIG, promise=(hip, 0.6 * hip))
    guides = StepGuides(config, ROBOT, CONSTANT, LEG, np.linspace(1.0, 0.0, 20), OVERLAP)
    assert guides.certificate(0.5).certified is certified
    assert guides.at(0.5).promise == float(certified)


def test_a_wider_guide_than_those_of_the_package_promises_less():
    """In a wider guide, the knee can reach angles at which the leg accelerates faster."""
    promises = []
    for degrees in (7.5, 10.0, 15.0, 30.0, 60.0):
        share = degrees / 7.5
        shape = GuideShape("wide", "", lambda phase, _, share=share: (np.full(phase.shape, share),) * 2)
        guides = StepGuides(CONFIG, ROBOT, shape, LEG, np.linspace(1.0, 0.0, 20), OVERLAP)
        assert guides.certificate(0.5).certified
        promises.append(guides.at(0.5).promise)
    assert promises[0] == 1.0
    assert (np.diff(promises) < 0.0).all()
