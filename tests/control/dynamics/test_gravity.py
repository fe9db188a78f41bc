"""Gravity torque of the suspended exoskeleton, compared with Pinocchio's generalized gravity."""

from __future__ import annotations

import math

import numba
import numpy as np
import pinocchio
import pytest

from atalante_control.dynamics.gravity import Gravity
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.compiled import interpreted
from atalante_hal.robot import load_robot
from atalante_hal.types import read_only

ROBOT = load_robot()
URDF = urdf(ExoskeletonParameters(), ROBOT)
MODEL = pinocchio_model(URDF)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def test_gravity_of_a_level_pelvis_matches_pinocchio():
    rng, gravity, data = np.random.default_rng(5), Gravity(MODEL), MODEL.model.createData()
    for _ in range(20):
        q = rng.uniform(ROBOT.position_min, ROBOT.position_max)
        pin = np.empty(12)
        pin[MODEL.q] = q
        np.testing.assert_allclose(
            gravity.torque(q, LEVEL), pinocchio.computeGeneralizedGravity(MODEL.model, data, pin)[MODEL.v], atol=1e-12
        )


def test_gravity_of_a_tilted_pelvis_matches_a_floating_base():
    rng, gravity = np.random.default_rng(6), Gravity(MODEL)
    floating = pinocchio_model(URDF, fixed_base=False)
    data = floating.model.createData()
    for _ in range(20):
        q, attitude = rng.uniform(ROBOT.position_min, ROBOT.position_max), rng.normal(size=4)
        attitude /= np.linalg.norm(attitude)
        full = pinocchio.neutral(floating.model)
        full[3:7] = attitude[[1, 2, 3, 0]]
        full[floating.q] = q
        expected = pinocchio.computeGeneralizedGravity(floating.model, data, full)[floating.v]
        np.testing.assert_allclose(gravity.torque(q, tuple(attitude)), expected, atol=1e-9)


def test_gravity_uses_the_joint_map_of_the_model():
    order = np.random.default_rng(7).permutation(12)
    reordered = ArticulatedModel(MODEL.model, MODEL.q[order], MODEL.v[order])
    q = np.random.default_rng(8).uniform(ROBOT.position_min, ROBOT.position_max)
    expected = Gravity(MODEL).torque(q, LEVEL).copy()
    np.testing.assert_allclose(Gravity(reordered).torque(q[order], LEVEL), expected[order], atol=1e-12)


def test_gravity_does_not_change_its_model():
    gravity = Gravity(MODEL)
    gravity.torque(np.zeros(12), (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0))
    np.testing.assert_allclose(MODEL.model.gravity.linear, [0.0, 0.0, -9.81])


@pytest.mark.skipif(interpreted(Gravity.torque), reason="nothing is compiled")
def test_read_only_position_is_not_compiled_again():
    """The HAL gives read-only arrays to a controller. A compilation in the control loop would take seconds."""
    gravity = Gravity(pinocchio_model(urdf(ExoskeletonParameters(), load_robot())))
    gravity.torque(read_only(np.zeros(12)), (1.0, 0.0, 0.0, 0.0))
    arrays = [
        kind for signature in gravity._hold.signatures for kind in signature if isinstance(kind, numba.types.Array)
    ]
    assert arrays
    assert all(array.mutable for array in arrays)


def test_repeated_calls_do_not_add_up_the_force_on_the_pelvis():
    gravity, q = Gravity(MODEL), np.random.default_rng(9).uniform(ROBOT.position_min, ROBOT.position_max)
    for _ in range(3):
        gravity.torque(q, LEVEL)
    legs = sum(inertia.mass for inertia in MODEL.model.inertias[1:])
    np.testing.assert_allclose(gravity.links[0].force, [0.0, 0.0, 9.81 * legs], atol=1e-9)
