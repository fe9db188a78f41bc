"""Kinematics of soles and centre of mass, compared with Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.walking.kinematics import Kinematics
from atalante_hal.robot import SIDES, load_robot

PATIENT = Patient(75.0, 1.75)
EXOSKELETON = ExoskeletonParameters().fitted(PATIENT)
MODEL = pinocchio_model(urdf(EXOSKELETON, load_robot(), PATIENT))
KINEMATICS = Kinematics(MODEL, EXOSKELETON)
DATA = MODEL.model.createData()
FLOATING = pinocchio_model(urdf(EXOSKELETON, load_robot(), PATIENT), fixed_base=False)
FLOATING_DATA = FLOATING.model.createData()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_soles_and_centre_of_mass_agree_with_pinocchio(seed: int) -> None:
    generator = np.random.default_rng(seed)
    position, velocity = generator.uniform(-0.5, 0.5, 12), generator.uniform(-3.0, 3.0, 12)
    chain = KINEMATICS.update(position, velocity)
    q, v = np.zeros(MODEL.model.nq), np.zeros(MODEL.model.nv)
    q[MODEL.q], v[MODEL.v] = position, velocity
    pinocchio.forwardKinematics(MODEL.model, DATA, q, v)
    free, rates = pinocchio.neutral(FLOATING.model), np.zeros(FLOATING.model.nv)
    free[FLOATING.q], rates[FLOATING.v] = position, velocity
    pinocchio.centerOfMass(FLOATING.model, FLOATING_DATA, free, rates)
    np.testing.assert_allclose(chain.centre[0].position, FLOATING_DATA.com[0], atol=1e-12)
    np.testing.assert_allclose(chain.centre[0].velocity, FLOATING_DATA.vcom[0], atol=1e-12)
    x, z = EXOSKELETON.sole_centre
    for side, name in enumerate(SIDES):
        foot = MODEL.model.getFrameId(f"{name}_foot")
        placement = pinocchio.updateFramePlacement(MODEL.model, DATA, foot)
        frame = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        twist = pinocchio.getFrameVelocity(MODEL.model, DATA, foot, frame)
        lever = placement.rotation @ [x, 0.0, z]
        sole = chain.soles[side]
        np.testing.assert_allclose(sole.rotation, placement.rotation, atol=1e-12)
        np.testing.assert_allclose(sole.position, placement.translation + lever, atol=1e-12)
        np.testing.assert_allclose(sole.linear, twist.linear + np.cross(twist.angular, lever), atol=1e-12)
        np.testing.assert_allclose(sole.angular, twist.angular, atol=1e-12)


def test_mass_is_that_of_exoskeleton_and_patient() -> None:
    assert abs(KINEMATICS.mass - pinocchio.computeTotalMass(FLOATING.model)) < 1e-9
