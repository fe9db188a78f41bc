"""Idealization: friction and inertia of the coupled pair, compared with Pinocchio."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.joint.idealization import AssistedInertia, Friction, law_of, merge
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
    diagonal = np.array([[mass_matrix(p)[HIP, HIP], mass_matrix(p)[KNEE, KNEE]] for p in SWING[::50]])
    np.testing.assert_allclose(inertia.inertias, diagonal.max(axis=0), rtol=0.02)


def test_torques_give_the_accelerations_of_separate_inertias():
    inertia, rng = AssistedInertia(MODEL, SWING), np.random.default_rng(9)
    for pose in SWING[::100]:
        v = np.zeros(12)
        v[[HIP, KNEE]] = rng.normal(size=2) * 2.0
        u = rng.normal(size=2) * 50.0
        tau = inertia.torques(float(pose[KNEE]), float(v[HIP]), float(v[KNEE]), (float(u[0]), float(u[1])))
        # With the other joints at rest, inverse dynamics must give tau for the accelerations of these two.
        a = np.zeros(12)
        a[[HIP, KNEE]] = u / np.array(inertia.inertias)
        pin_q, pin_v, pin_a = np.empty(12), np.empty(12), np.empty(12)
        pin_q[MODEL.q], pin_v[MODEL.v], pin_a[MODEL.v] = pose, v, a
        data = MODEL.model.createData()
        asked = pinocchio.rnea(MODEL.model, data, pin_q, pin_v, pin_a)
        asked -= pinocchio.computeGeneralizedGravity(MODEL.model, data, pin_q)
        np.testing.assert_allclose(tau, asked[MODEL.v][[HIP, KNEE]], atol=0.02 * np.abs(u).max() + 0.2)


@given(st.floats(0.0, 1.9), *[st.floats(-3.0, 3.0)] * 2, *[st.floats(-100.0, 100.0)] * 2)
def test_ideal_is_the_inverse_function_of_torques(knee: float, hip_rate: float, knee_rate: float, u1: float, u2: float):
    inertia = AssistedInertia(MODEL, SWING)
    tau = inertia.torques(knee, hip_rate, knee_rate, (u1, u2))
    np.testing.assert_allclose(inertia.ideal(knee, hip_rate, knee_rate, tau), (u1, u2), atol=1e-8)


@pytest.mark.parametrize("leg", [0, 6])
@pytest.mark.parametrize("decoupled", [False, True])
def test_merge_is_the_weighted_mean_of_baseline_and_assistance(leg: int, decoupled: bool):
    friction, inertia, rng = Friction(), AssistedInertia(MODEL, SWING), np.random.default_rng(11)
    law, u = law_of(friction, inertia, decoupled), (30.0, -20.0)
    baseline, gravity, q, qd = rng.normal(size=(4, 12))
    hip, knee = leg + HIP, leg + KNEE
    real = inertia.torques(q[knee], qd[hip], qd[knee], u) if decoupled else u
    for w in (0.0, 0.3, 1.0):
        torque = baseline.copy()
        merge(law, leg, w, u, q, qd, gravity, torque)
        expected = baseline.copy()
        for i, joint in enumerate((hip, knee)):
            assisted = gravity[joint] + friction.torque(joint % 6, qd[joint]) + real[i]
            expected[joint] = w * baseline[joint] + (1.0 - w) * assisted
        np.testing.assert_allclose(torque, expected, atol=1e-12)
