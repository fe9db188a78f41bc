"""Verification of gaits: it agrees with the optimiser, and changed gaits fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio
import pytest

from atalante_control.dynamics.stance import STANCE_FOOT, SWING_FOOT, stance_dynamics
from atalante_control.gait.gait import KINDS, Gait, Kind, motion
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.solve import solve
from atalante_control.gait_optimization.step_problem import StepProblem
from atalante_control.gait_optimization.verify import Verifier
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_hal.robot import load_robot

ROBOT = load_robot()
SUBJECT = Subject(Patient(75.0, 1.75), 0.16, 0.8)


@pytest.fixture(scope="module")
def verifier() -> Verifier:
    return Verifier(ROBOT, SUBJECT.patient)


@pytest.fixture(scope="module")
def gait() -> Gait:
    return solve(SUBJECT).gait


@pytest.mark.sample(3)
@pytest.mark.parametrize("kind", KINDS)
def test_solved_steps_pass_the_verification(verifier: Verifier, kind: Kind) -> None:
    failed = [check for check in verifier.verify(solve(SUBJECT, kind=kind).gait, kind) if not check.holds]
    assert not failed


def test_torques_at_the_nodes_match_the_optimiser(verifier: Verifier, gait: Gait) -> None:
    problem = StepProblem("periodic", ROBOT, Requirements())
    parameters = problem.parameters(SUBJECT.patient, SUBJECT.step_duration, SUBJECT.step_length)
    torques = problem.torques(problem.unknowns(gait.coefficients, parameters))
    states = zip(*motion(gait.coefficients, gait.duration, problem.phases), strict=True)
    np.testing.assert_allclose([verifier.loads(*state)[0] for state in states], torques, atol=1e-6)


def test_torques_match_the_stance_dynamics(verifier: Verifier, gait: Gait) -> None:
    witness = stance_dynamics(ROBOT, SUBJECT.patient)
    for state in zip(*motion(gait.coefficients, gait.duration, np.linspace(0.0, 1.0, 5)), strict=True):
        torque, wrench = verifier.loads(*state)
        forces = witness.forces(*state)
        np.testing.assert_allclose(torque, forces.torque, atol=1e-8)
        np.testing.assert_allclose(wrench, np.concatenate([forces.force, forces.moment]), atol=1e-8)


def test_impact_changes_momentum_only_at_the_landing_foot_and_loses_energy(verifier: Verifier, gait: Gait) -> None:
    q, qd, _ = (values[1] for values in motion(gait.coefficients, gait.duration, np.array([0.0, 1.0])))
    fast = qd + 0.5 * np.random.default_rng(3).normal(size=len(qd))
    after, impulse, twist = verifier.impact(q, fast)
    model, q_index, v_index = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT, SUBJECT.patient), fixed_base=False)
    data, configuration = model.createData(), pinocchio.neutral(model)
    configuration[q_index] = q
    upper = np.triu(pinocchio.crba(model, data, configuration))
    mass = upper + np.triu(upper, 1).T
    jacobians = [
        pinocchio.computeFrameJacobian(
            model, data, configuration, model.getFrameId(foot), pinocchio.ReferenceFrame.LOCAL
        ).copy()
        for foot in (STANCE_FOOT, SWING_FOOT)
    ]

    def speed(joints: np.ndarray, resting: np.ndarray) -> np.ndarray:
        """Return the speed of the floating robot, one foot of which is at rest."""
        full = np.zeros(model.nv)
        full[v_index] = joints
        full[:6] = -np.linalg.solve(resting[:, :6], resting @ full)
        return full

    leaving, landing = jacobians
    before, landed = speed(fast, leaving), speed(after, landing)
    np.testing.assert_allclose(mass @ (landed - before), landing.T @ impulse, atol=1e-8)
    np.testing.assert_allclose(leaving @ landed, twist, atol=1e-9)
    lost = 0.5 * (before @ mass @ before - landed @ mass @ landed)
    assert lost == pytest.approx(
        0.5 * (before - landed) @ mass @ (before - landed), rel=1e-9
    )  # Carnot, inelastic impact
    assert lost > 0.1  # J
    again, none, _ = verifier.impact(q, np.zeros(len(qd)))
    assert not again.any()
    assert np.abs(none).max() < 1e-9
    # The impulse is linear in the velocity.
    np.testing.assert_allclose(verifier.impact(q, 2.0 * fast)[1], 2.0 * impulse, atol=1e-8)
    assert np.abs(after - fast).max() > 0.05


@pytest.mark.parametrize(
    ("control_point", "joint", "change", "named"),
    [
        (7, 3, 0.02, "height error of the landing foot"),
        (0, 1, 0.01, "angle jump at the stance change"),
        (6, 2, 0.01, "speed error of the impact map"),
        (5, 2, 0.4, "depth of the swing sole in the ground"),
        (3, 3, -0.1, "swing sole below its intended height"),
        (6, 4, -0.02, "slide of a sole corner at the landing"),
        (6, 4, 0.02, "upward speed of a sole corner at the landing"),
        (6, 3, -0.04, "downward speed of a sole corner at the landing"),
        (4, 6, 0.6, "centre of pressure across the sole"),
        (4, 10, 1.4, "joint angle beyond its limit"),
    ],
)
def test_gait_with_a_moved_control_point_fails(
    verifier: Verifier, gait: Gait, control_point: int, joint: int, change: float, named: str
) -> None:
    bent = gait.coefficients.copy()
    bent[joint, control_point] += change
    assert named in [check.name for check in verifier.verify(replace(gait, coefficients=bent)) if not check.holds]


def test_gait_with_a_short_duration_fails(verifier: Verifier, gait: Gait) -> None:
    failed = [check.name for check in verifier.verify(replace(gait, duration=0.2)) if not check.holds]
    expected = {"joint speed relative to its limit", "joint torque relative to its limit"}
    expected |= {"unloaded fraction of the weight", "required friction coefficient"}
    assert expected <= set(failed)


def test_weight_is_the_sum_of_robot_and_patient(verifier: Verifier) -> None:
    assert verifier.weight == pytest.approx((82.0 + 75.0) * 9.81, rel=0.01)
