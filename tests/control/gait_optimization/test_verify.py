"""Pinocchio's judgement of gaits: it agrees with the optimiser, and it finds what is wrong with a gait that was bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import Gait, motion
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.solve import solve
from atalante_control.gait_optimization.step_problem import KINDS, Kind, StepProblem
from atalante_control.gait_optimization.verify import Verifier
from atalante_control.model import Patient
from atalante_hal.robot import load_robot

ROBOT = load_robot()
SUBJECT = Subject(Patient(75.0, 1.75), 0.16, 0.8)


@pytest.fixture(scope="module")
def verifier() -> Verifier:
    return Verifier(ROBOT, SUBJECT.patient)


@pytest.fixture(scope="module")
def gait() -> Gait:
    return solve(SUBJECT).gait


@pytest.mark.parametrize("kind", KINDS)
def test_solved_steps_hold(verifier: Verifier, kind: Kind) -> None:
    failed = [check for check in verifier.verify(solve(SUBJECT, kind=kind).gait, kind) if not check.holds]
    assert not failed


def test_torques_at_the_nodes_are_the_optimisers(verifier: Verifier, gait: Gait) -> None:
    problem = StepProblem("periodic", ROBOT, Requirements())
    parameters = problem.parameters(SUBJECT.patient, SUBJECT.step_duration, SUBJECT.step_length)
    torques = problem.torques(problem.unknowns(gait.coefficients, parameters))
    states = zip(*motion(gait.coefficients, gait.duration, problem.phases), strict=True)
    np.testing.assert_allclose([verifier.loads(*state)[0] for state in states], torques, atol=1e-6)


def test_a_second_way_to_the_same_torques(verifier: Verifier, gait: Gait) -> None:
    witness = stance_dynamics(ROBOT, SUBJECT.patient)
    for state in zip(*motion(gait.coefficients, gait.duration, np.linspace(0.0, 1.0, 5)), strict=True):
        torque, wrench = verifier.loads(*state)
        forces = witness.forces(*state)
        np.testing.assert_allclose(torque, forces.torque, atol=1e-8)
        np.testing.assert_allclose(wrench, np.concatenate([forces.force, forces.moment]), atol=1e-8)


def test_impact_keeps_momentum_about_the_landing_foot_and_takes_energy(verifier: Verifier, gait: Gait) -> None:
    q, qd, _ = (values[1] for values in motion(gait.coefficients, gait.duration, np.array([0.0, 1.0])))
    fast = qd + 0.5 * np.random.default_rng(3).normal(size=len(qd))
    after, impulse, _ = verifier.impact(q, fast)
    again, none, _ = verifier.impact(q, np.zeros(len(qd)))
    assert not again.any()
    assert np.abs(none).max() < 1e-9
    # Linear in the velocity, and not the identity.
    np.testing.assert_allclose(verifier.impact(q, 2.0 * fast)[1], 2.0 * impulse, atol=1e-8)
    assert np.abs(after - fast).max() > 0.05


@pytest.mark.parametrize(
    ("control_point", "joint", "change", "named"),
    [
        (7, 3, 0.02, "height error of the landing foot"),
        (0, 1, 0.01, "angle jump at the step change"),
        (6, 2, 0.01, "speed error of the impact map"),
        (5, 2, 0.4, "depth of the swing sole in the ground"),
        (4, 6, 0.6, "centre of pressure across the sole"),
        (4, 10, 1.4, "joint angle beyond its limit"),
    ],
)
def test_a_bent_gait_is_found_out(
    verifier: Verifier, gait: Gait, control_point: int, joint: int, change: float, named: str
) -> None:
    bent = gait.coefficients.copy()
    bent[joint, control_point] += change
    assert named in [check.name for check in verifier.verify(replace(gait, coefficients=bent)) if not check.holds]


def test_a_hasty_gait_is_found_out(verifier: Verifier, gait: Gait) -> None:
    failed = [check.name for check in verifier.verify(replace(gait, duration=0.2)) if not check.holds]
    expected = {"joint speed relative to its limit", "joint torque relative to its limit"}
    expected |= {"unloaded fraction of the weight", "required friction coefficient"}
    assert expected <= set(failed)


def test_the_weight_is_the_models(verifier: Verifier) -> None:
    assert verifier.weight == pytest.approx((82.0 + 75.0) * 9.81, rel=0.01)
