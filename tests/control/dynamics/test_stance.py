from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from atalante_control.dynamics.gravity import Gravity
from atalante_control.dynamics.stance import STANCE_FOOT, StanceDynamics, stance_dynamics
from atalante_control.gait.gait import AIRWALK_GAIT, bezier, load_gait, motion
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import load_robot
from atalante_hal.types import GRAVITY

ROBOT = load_robot()
PATIENT = Patient(75.0, 1.75)
DYNAMICS = stance_dynamics(ROBOT, PATIENT)
SOLE = -ExoskeletonParameters().sole_centre[1]  # m, height of the ankle above the ground


def random_states(count: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(4)
    return [
        (rng.uniform(ROBOT.position_min, ROBOT.position_max), rng.normal(size=12), rng.normal(size=12) * 5.0)
        for _ in range(count)
    ]


class FixedFootEnergy:
    """Energy of the same robot with its right foot flat on the ground, computed without inverse dynamics."""

    def __init__(self) -> None:
        self.floating = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT, PATIENT), fixed_base=False)
        self.data = self.floating.model.createData()
        self.foot = self.floating.model.getFrameId(STANCE_FOOT)

    def configuration(self, q: np.ndarray) -> np.ndarray:
        full = pinocchio.neutral(self.floating.model)
        full[self.floating.q] = q
        pinocchio.framesForwardKinematics(self.floating.model, self.data, full)
        full[:7] = pinocchio.SE3ToXYZQUAT(self.data.oMf[self.foot].inverse())
        return full

    def energy(self, q: np.ndarray, qd: np.ndarray) -> float:
        full, step = self.configuration(q), 1e-6
        before, after = self.configuration(q - step * qd), self.configuration(q + step * qd)
        speed = pinocchio.difference(self.floating.model, before, after) / (2 * step)
        kinetic = pinocchio.computeKineticEnergy(self.floating.model, self.data, full, speed)
        return float(kinetic + pinocchio.computePotentialEnergy(self.floating.model, self.data, full))

    def power(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, step: float = 1e-4) -> float:
        ahead = self.energy(q + step * qd + 0.5 * step**2 * qdd, qd + step * qdd)
        behind = self.energy(q - step * qd + 0.5 * step**2 * qdd, qd - step * qdd)
        return (ahead - behind) / (2 * step)


def test_joint_power_is_the_change_of_the_energy() -> None:
    """The stance foot is at rest and takes no power, so the power of the joints is the change of the energy."""
    body = FixedFootEnergy()
    for q, qd, qdd in random_states(20):
        torque = DYNAMICS.forces(q, qd, qdd).torque
        assert torque @ qd == pytest.approx(body.power(q, qd, qdd), rel=1e-4, abs=1e-2)


def test_ground_wrench_at_rest_is_the_weight_at_the_centre_of_mass() -> None:
    body = FixedFootEnergy()
    for q, _, _ in random_states(20):
        torque, force, moment, _ = DYNAMICS.forces(q, np.zeros(12), np.zeros(12))
        full = body.configuration(q)
        mass = pinocchio.computeTotalMass(body.floating.model)
        np.testing.assert_allclose(force, [0.0, 0.0, mass * GRAVITY], atol=1e-9)
        centre = pinocchio.centerOfMass(body.floating.model, body.data, full)
        np.testing.assert_allclose(moment[:2], mass * GRAVITY * np.array([centre[1], -centre[0]]), atol=1e-9)
        gradient = [
            (body.energy(q + 1e-5 * unit, np.zeros(12)) - body.energy(q - 1e-5 * unit, np.zeros(12))) / 2e-5
            for unit in np.eye(12)
        ]
        np.testing.assert_allclose(torque, gradient, atol=1e-3)


def test_feedforward_and_suspended_gravity_give_the_walking_torque() -> None:
    gait = load_gait(AIRWALK_GAIT, ROBOT)
    slow = 3.0  # s, step duration; the airwalk gait at its own duration would need too large ground forces
    phase = np.linspace(0.0, 1.0, 41)
    q, qd, qdd = motion(gait.coefficients, slow, phase)
    fitted = pinocchio_model(urdf(ExoskeletonParameters().fitted(PATIENT), ROBOT))
    gravity = Gravity(fitted)
    u_g = np.array(
        [gravity.torque(q, DYNAMICS.forces(q, qd, qdd).pelvis).copy() for q, qd, qdd in zip(q, qd, qdd, strict=True)]
    )
    demanded = DYNAMICS.torques(q, qd, qdd)
    walked = u_g + bezier(DYNAMICS.feedforward(gait.coefficients, slow), phase)
    assert np.abs(walked - demanded).max() < 0.02 * np.abs(demanded).max()


def test_swing_leg_without_patient_needs_no_feedforward_at_rest() -> None:
    """Gravity loads the swing leg equally in stance and suspended, so u_g is the complete torque."""
    q = load_gait(AIRWALK_GAIT, ROBOT).tables().q[300]
    feedforward = stance_dynamics(ROBOT).feedforward(np.repeat(q[:, None], 8, axis=1), 1.0)
    assert np.abs(feedforward[:6]).max() < 1e-9
    assert np.abs(feedforward[6:]).max() > 10.0


def test_ground_force_includes_the_mass_of_the_patient() -> None:
    q = load_gait(AIRWALK_GAIT, ROBOT).tables().q[400]
    forces = [
        stance_dynamics(ROBOT, patient).forces(q, np.zeros(12), np.zeros(12)).force[2]
        for patient in (None, Patient(58.0, 1.75), Patient(91.0, 1.75))
    ]
    np.testing.assert_allclose(forces, [82.5 * GRAVITY, 140.5 * GRAVITY, 173.5 * GRAVITY])


def test_urdf_without_a_joint_is_rejected() -> None:
    text = urdf(ExoskeletonParameters(), ROBOT).replace('"right_HA"', '"spare"')
    with pytest.raises(ValueError, match="got no joint right_HA"):
        StanceDynamics(text, urdf(ExoskeletonParameters(), ROBOT))
