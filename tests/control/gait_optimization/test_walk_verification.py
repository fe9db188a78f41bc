"""Verification of walks on the ground, and the walk file of the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from atalante_control.dynamics.gait_network import load_network
from atalante_control.gait.gait import GaitError
from atalante_control.gait.subject import Subject, patient_of
from atalante_control.gait.walk import DEFAULT_WALK, WalkGaits, load_walk
from atalante_control.gait_optimization.verify import INTERPOLATED, Verifier
from atalante_control.gait_optimization.walk import solve_walk
from atalante_control.gait_optimization.walk_verification import check_on_ground
from atalante_control.model import Patient
from atalante_hal.robot import load_robot

ROBOT = load_robot()
WALK = load_walk(DEFAULT_WALK, ROBOT)
PATIENT = patient_of(WALK.step.parameters)
SUBJECT = Subject(Patient(75.0, 1.75), 0.16, 0.8)


@pytest.mark.parametrize("name", WalkGaits._fields)
def test_default_walk_passes_the_checks_of_the_gaits_of_the_network(name: str) -> None:
    gait = getattr(WALK, name)
    checks = Verifier(ROBOT, PATIENT).verify(gait, gait.kind, INTERPOLATED)
    assert [check for check in checks if not check.holds] == []
    check_on_ground(WALK, PATIENT, ROBOT, "walk.json")


def test_periodic_step_of_the_default_walk_is_that_of_the_network() -> None:
    assert WALK.step.parameters == SUBJECT.parameters()
    gait = load_network().gait(SUBJECT, ROBOT)
    np.testing.assert_allclose(WALK.step.coefficients, gait.coefficients, rtol=0.0, atol=1e-12)
    assert WALK.step.feedforward is not None
    np.testing.assert_allclose(WALK.step.feedforward, gait.feedforward, rtol=0.0, atol=1e-6)


def test_start_and_stop_of_the_default_walk_are_those_of_the_solver() -> None:
    solved = solve_walk(SUBJECT, WALK.step)
    for name in ("start", "stop"):
        stored, new = getattr(WALK, name), getattr(solved, name)
        np.testing.assert_allclose(stored.coefficients, new.coefficients, rtol=0.0, atol=1e-5)


def test_walk_that_is_too_heavy_for_its_steps_is_refused_with_check_value_and_limit() -> None:
    heavy = Patient(110.0, 1.75)
    with pytest.raises(GaitError, match=r"^walk\.json: .+ in (start|step|stop) must be at most \S+.*, got \S+"):
        check_on_ground(WALK, heavy, ROBOT, "walk.json")


def test_gait_that_slides_at_the_landing_is_refused() -> None:
    # A speed of the landing leg that the impact does not stop.
    coefficients = WALK.step.coefficients.copy()
    coefficients[2, -2] += 0.01
    sliding = WALK._replace(step=replace(WALK.step, coefficients=coefficients))
    with pytest.raises(GaitError, match=r"in step must be at most"):
        check_on_ground(sliding, PATIENT, ROBOT, "walk.json")
