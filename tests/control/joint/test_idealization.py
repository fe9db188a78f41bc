"""Idealization: friction and inertia of the coupled pair, compared with Pinocchio."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.joint.idealization import AssistedInertia, Friction, idealization, law_of, mass
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import JOINTS, load_robot

ROBOT = load_robot()
URDF = urdf(ExoskeletonParameters(), ROBOT)
MODEL = pinocchio_model(URDF)
SWING = load_gait(AIRWALK_GAIT, ROBOT).tables().q
HIP, KNEE = JOINTS.index("left_SH"), JOINTS.index("left_SK")


@given(st.integers(0, 5), st.floats(-10.0, 10.0))
def test_friction_is_odd_and_approaches_the_formula_of_the_paper(joint: int, velocity: float):
    friction = Friction()
    torque = friction.torque(joint, velocity)
    assert torque == pytest.approx(-friction.torque(joint, -velocity), abs=1e-12)
    paper = friction.coulomb[joint] * math.copysign(1.0, velocity) + friction.viscous[joint] * velocity
    assert abs(torque) <= abs(paper) + 1e-12
    if abs(velocity) > 5 * friction.smoothing:
        assert torque == pytest.approx(paper, rel=1e-3, abs=1e-3)


def test_friction_at_rest_is_zero_and_continuous():
    friction = Friction()
    assert friction.torque(2, 0.0) == 0.0
    assert abs(friction.torque(2, 1e-6) - friction.torque(2, -1e-6)) < 1e-3


@pytest.mark.parametrize("bad", [{"coulomb": (1.0,)}, {"viscous": (-1.0,) * 6}, {"smoothing": 0.0}])
def test_invalid_friction_is_rejected(bad: dict[str, object]):
    with pytest.raises(ValueError, match=r"finite|positive"):
        Friction(**bad)  # type: ignore[arg-type]


def mass_matrix(q: np.ndarray) -> np.ndarray:
    pin = np.empty(12)
    pin[MODEL.q] = q
    upper = np.triu(pinocchio.crba(MODEL.model, MODEL.model.createData(), pin))
    return (upper + np.triu(upper, 1).T)[np.ix_(MODEL.v, MODEL.v)]


def test_assisted_inertia_matches_the_mass_matrix_along_the_step():
    inertia = AssistedInertia(MODEL, SWING)
    for pose in SWING[::50]:
        m = mass_matrix(pose)
        m11, m12, m22 = inertia.block(float(pose[KNEE]))
        np.testing.assert_allclose([m11, m12, m22], [m[HIP, HIP], m[HIP, KNEE], m[KNEE, KNEE]], rtol=0.02)
        np.testing.assert_allclose(mass(inertia.fit, float(pose[KNEE])), (m11, m12, m22))


def test_velocity_torques_and_mass_give_the_inverse_dynamics():
    inertia, rng = AssistedInertia(MODEL, SWING), np.random.default_rng(9)
    for pose in SWING[::100]:
        v, a = np.zeros(12), np.zeros(12)
        v[[HIP, KNEE]], a[[HIP, KNEE]] = rng.normal(size=2) * 2.0, rng.normal(size=2) * 10.0
        m11, m12, m22 = mass(inertia.fit, float(pose[KNEE]))
        tau = np.array([[m11, m12], [m12, m22]]) @ a[[HIP, KNEE]]
        tau += inertia.velocity_torques(float(pose[KNEE]), float(v[HIP]), float(v[KNEE]))
        # With the other joints at rest, inverse dynamics must give tau for the accelerations of SH and SK.
        pin_q, pin_v, pin_a = np.empty(12), np.empty(12), np.empty(12)
        pin_q[MODEL.q], pin_v[MODEL.v], pin_a[MODEL.v] = pose, v, a
        data = MODEL.model.createData()
        asked = pinocchio.rnea(MODEL.model, data, pin_q, pin_v, pin_a)
        asked -= pinocchio.computeGeneralizedGravity(MODEL.model, data, pin_q)
        np.testing.assert_allclose(tau, asked[MODEL.v][[HIP, KNEE]], atol=0.02 * np.abs(tau).max() + 0.2)


def test_idealization_is_gravity_velocity_torque_and_friction():
    friction, inertia = Friction(), AssistedInertia(MODEL, SWING)
    law = law_of(friction, inertia)[0]
    found = idealization(law, 0.7, 0.4, -1.1, (12.0, -3.0))
    velocity = inertia.velocity_torques(0.7, 0.4, -1.1)
    expected = 12.0 + velocity[0] + friction.torque(2, 0.4), -3.0 + velocity[1] + friction.torque(3, -1.1)
    np.testing.assert_allclose(found, expected)
