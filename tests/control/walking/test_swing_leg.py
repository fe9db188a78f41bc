"""Swing leg of a step on the ground: torque of the gait and of the model."""

from __future__ import annotations

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import motion
from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.joint.idealization import Friction
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.swing_leg import swing_leg
from atalante_hal.robot import load_robot

ROBOT, PATIENT = load_robot(), Patient(75.0, 1.75)
EXOSKELETON = ExoskeletonParameters().fitted(PATIENT)
STEP = load_walk(DEFAULT_WALK, ROBOT).step
WORN, EMPTY = (pinocchio_model(urdf(EXOSKELETON, ROBOT, patient)) for patient in (PATIENT, None))
SWING = swing_leg(STEP, 0.5, WORN, Kinematics(WORN, EXOSKELETON), Gravity(EMPTY), Friction())


def test_swing_leg_torque_equals_that_of_the_stance_dynamics() -> None:
    phase = np.linspace(0.0, 1.0, 5)
    torques = stance_dynamics(ROBOT, PATIENT).torques(*motion(STEP.coefficients, STEP.duration, phase))
    found = SWING.leg.torque()[np.rint(phase * STEP.cycles).astype(int)]
    np.testing.assert_allclose(found, torques[:, 2:4], atol=3.0)  # u_f in the file is a fitted polynomial


def test_swing_leg_ends_with_the_step() -> None:
    leg = SWING.leg
    assert len(leg.time) == len(SWING.unmodelled) == STEP.cycles + 1
    np.testing.assert_allclose(leg.q, STEP.tables().q[:, 2:4], atol=1e-12)


def test_mass_matrix_includes_the_leg_of_the_patient() -> None:
    hip, knee = SWING.leg.inertia.inertias
    assert 9.6 < hip < 12.5
    assert 2.0 < knee < 2.6
