"""Symbolic dynamics compared with Pinocchio: torques, ground wrench and kinematics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi
import numpy as np
import pinocchio
import pytest

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait_optimization.symbolic_dynamics import STANCE_FOOT, SWING_FOOT, Chain, bodies
from atalante_control.model import BASE_LINK, ExoskeletonParameters, Patient, links, pinocchio_model, urdf_text
from atalante_hal.robot import JOINTS, load_robot

PATIENT = Patient(91.0, 1.62, thigh_length=0.42)
UP = np.array([0.0, 0.0, 9.81])


@pytest.fixture(scope="module")
def chain() -> Chain:
    return Chain(links(ExoskeletonParameters(), Patient(75.0, 1.75)))


def inverse_dynamics(chain: Chain) -> Any:
    q, qd, qdd = (casadi.SX.sym(name, len(JOINTS)) for name in ("q", "qd", "qdd"))
    torque, ground = chain.inverse_dynamics(q, qd, qdd, casadi.DM(UP), casadi.SX(3, 1))
    return casadi.Function("inverse_dynamics", [q, qd, qdd, chain.symbols], [torque, ground.force, ground.moment])


def states(count: int) -> np.ndarray:
    return np.random.default_rng(4).normal(size=(count, 3, len(JOINTS))) * np.array([0.4, 1.0, 5.0])[:, None]


@pytest.mark.parametrize("patient", [None, PATIENT, Patient(45.0, 2.0)])
def test_torques_and_ground_wrench_match_pinocchio(chain: Chain, patient: Patient | None) -> None:
    worn = links(ExoskeletonParameters(), patient)
    # One set of expressions is valid for every patient; the exoskeleton without patient needs another set.
    expressions = chain if patient else Chain(worn)
    function, reference = inverse_dynamics(expressions), stance_dynamics(load_robot(), patient)
    for state in states(20):
        torque, force, moment = (np.array(value).ravel() for value in function(*state, expressions.values(worn)))
        expected = reference.forces(*state)
        np.testing.assert_allclose(torque, expected.torque, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(force, expected.force, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(moment, expected.moment, rtol=1e-9, atol=1e-9)


def test_kinematics_match_pinocchio(chain: Chain) -> None:
    worn = links(ExoskeletonParameters(), PATIENT)
    q, qd = casadi.SX.sym("q", len(JOINTS)), casadi.SX.sym("qd", len(JOINTS))
    frames = chain.frames(q, qd)
    articulated = pinocchio_model(urdf_text(worn, load_robot()))
    model, data = articulated.model, articulated.model.createData()
    stance, swing, pelvis = (model.getFrameId(name) for name in (STANCE_FOOT, SWING_FOOT, BASE_LINK))
    for position, velocity, _ in states(10):
        configuration, rate = np.zeros(model.nq), np.zeros(model.nv)
        configuration[articulated.q], rate[articulated.v] = position, velocity
        pinocchio.forwardKinematics(model, data, configuration, rate)
        pinocchio.updateFramePlacements(model, data)
        for index, frame in ((chain.swing_foot, swing), (chain.pelvis, pelvis)):
            outcome = casadi.Function(
                "f",
                [q, qd, chain.symbols],
                [frames[index].rotation, frames[index].position, frames[index].linear, frames[index].angular],
            )(position, velocity, chain.values(worn))
            rotation, origin, linear, angular = (np.array(value) for value in outcome)
            relative = data.oMf[stance].actInv(data.oMf[frame])
            np.testing.assert_allclose(rotation, relative.rotation, atol=1e-12)
            np.testing.assert_allclose(origin.ravel(), relative.translation, atol=1e-12)
            # The expressions are relative to the stance foot, which moves in this model, so its twist is subtracted.
            local = pinocchio.ReferenceFrame.LOCAL
            twist = pinocchio.getFrameVelocity(model, data, frame, local)
            carried = relative.actInv(pinocchio.getFrameVelocity(model, data, stance, local))
            np.testing.assert_allclose(linear.ravel(), (twist - carried).linear, atol=1e-12)
            np.testing.assert_allclose(angular.ravel(), (twist - carried).angular, atol=1e-12)


def test_ground_force_at_rest_is_the_weight(chain: Chain) -> None:
    worn = links(ExoskeletonParameters(), PATIENT)
    still = np.zeros(len(JOINTS))
    force = np.array(inverse_dynamics(chain)(states(1)[0, 0], still, still, chain.values(worn))[1]).ravel()
    np.testing.assert_allclose(force, UP * sum(link.inertia.mass for link in worn), rtol=1e-12, atol=1e-9)


def test_fixed_links_are_merged_into_their_body() -> None:
    worn = links(ExoskeletonParameters(), PATIENT)
    assert len(bodies(worn)) == 1 + len(JOINTS)
    assert sum(body.mass for body in bodies(worn)) == pytest.approx(sum(link.inertia.mass for link in worn), rel=1e-14)


def test_robot_with_other_axes_is_rejected(chain: Chain) -> None:
    worn = links(ExoskeletonParameters(ha_axis=(1.0, 0.0, 0.0)), PATIENT)
    with pytest.raises(ValueError, match=r"axis of body \w+ must be .* as in the reference robot, got"):
        chain.values(worn)


def test_robot_with_another_zero_length_is_rejected(chain: Chain) -> None:
    worn = [
        replace(link, origin=(link.origin[0], 0.01, link.origin[2])) if link.joint == "left_SH" else link
        for link in links(ExoskeletonParameters(), PATIENT)
    ]
    with pytest.raises(ValueError, match=r"must also be 0 in the given robot, got \[0\.01\]"):
        chain.values(worn)
