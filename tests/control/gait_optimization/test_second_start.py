"""Tests of the second start of the optimiser, with functions in place of the optimiser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_control.gait_optimization.second_start import (
    MODERATE,
    joints_at_limits,
    solve_with_second_start,
    with_status,
)
from atalante_control.model import Patient
from atalante_hal.robot import JOINTS, load_robot

ROBOT = load_robot()
AIRWALK = load_gait(AIRWALK_GAIT, ROBOT)
PATIENT = Patient(70.0, 1.7)
SUBJECT = Subject(PATIENT, 0.3, 0.8)
MODERATE_SUBJECT = Subject(PATIENT, *MODERATE)
UNMET = "no such gait: the constraint 'torque' is violated by 3 Nm"


def result(subject: Subject, status: str = SOLVED, iterations: int = 10) -> SolvedGait:
    gait = Gait(
        str(subject), subject.step_duration, AIRWALK.coefficients, None, subject.parameters(), {"status": status}
    )
    return SolvedGait(gait, status, 1e-9, 0.01, iterations)


class Attempts:
    """Attempts with given results: `solved` contains each pair of subject and warm start that has a gait."""

    def __init__(self, *solved: tuple[Subject, bool], iterations: int = 10) -> None:
        self.solved, self.iterations = solved, iterations
        self.calls: list[tuple[Subject, bool]] = []

    def __call__(self, subject: Subject, warm_start: Gait | None) -> SolvedGait:
        if warm_start is not None:
            assert warm_start.parameters == MODERATE_SUBJECT.parameters()
        call = subject, warm_start is not None
        self.calls.append(call)
        return result(subject, SOLVED if call in self.solved else UNMET, self.iterations)


def test_first_success_needs_no_second_start() -> None:
    attempts = Attempts((SUBJECT, False))
    assert solve_with_second_start(SUBJECT, attempts).solved
    assert attempts.calls == [(SUBJECT, False)]


def test_second_start_uses_the_gait_with_a_moderate_step() -> None:
    attempts = Attempts((MODERATE_SUBJECT, False), (SUBJECT, True))
    solved = solve_with_second_start(SUBJECT, attempts)
    assert solved.solved
    assert solved.gait.parameters == SUBJECT.parameters()
    assert solved.gait.solver == {"status": SOLVED, "start": f"gait of {MODERATE_SUBJECT}"}
    assert attempts.calls == [(SUBJECT, False), (MODERATE_SUBJECT, False), (SUBJECT, True)]


def test_two_failures_state_both_reasons() -> None:
    solved = solve_with_second_start(SUBJECT, Attempts((MODERATE_SUBJECT, False)))
    assert solved.status == solved.gait.solver["status"]
    assert solved.status.startswith(f"{UNMET}; joints at a limit: ")
    assert solved.status.endswith(f"; second start from a step of 0.15 m in 0.9 s: {UNMET}")


def test_failure_of_the_moderate_step_ends_the_search() -> None:
    attempts = Attempts()
    solved = solve_with_second_start(SUBJECT, attempts)
    assert solved.status.endswith(f"; no second start, {UNMET}")
    assert len(attempts.calls) == 2


def test_moderate_step_has_no_second_start() -> None:
    attempts = Attempts()
    solved = solve_with_second_start(MODERATE_SUBJECT, attempts)
    assert not solved.solved
    assert len(attempts.calls) == 1


def test_refused_subject_has_no_second_start() -> None:
    attempts = Attempts(iterations=0)
    assert solve_with_second_start(SUBJECT, attempts).status == UNMET
    assert len(attempts.calls) == 1


def test_status_is_the_same_in_result_and_record() -> None:
    changed = with_status(result(SUBJECT), UNMET)
    assert (changed.status, changed.gait.solver["status"]) == (UNMET, UNMET)


@pytest.mark.parametrize("joint", range(len(JOINTS)))
def test_joint_at_its_limit_is_named(joint: int) -> None:
    inside = replace(result(SUBJECT), peak_torque=np.zeros(len(JOINTS)))
    assert joints_at_limits(inside) == joints_at_limits(result(SUBJECT))
    loaded = replace(inside, peak_torque=np.eye(len(JOINTS))[joint] * ROBOT.torque_max[joint])
    assert set(joints_at_limits(loaded)) - set(joints_at_limits(inside)) == {f"torque of {JOINTS[joint]}"}
    coefficients = AIRWALK.coefficients.copy()
    coefficients[joint] = ROBOT.position_max[joint]
    bent = replace(inside, gait=replace(inside.gait, coefficients=coefficients))
    assert f"angle of {JOINTS[joint]}" in joints_at_limits(bent)
    coefficients = AIRWALK.coefficients.copy()
    coefficients[joint] = np.linspace(-1.0, 1.0, 8) * ROBOT.velocity_max[joint]  # constant speed, above the limit
    fast = replace(inside, gait=replace(inside.gait, coefficients=coefficients))
    assert f"speed of {JOINTS[joint]}" in joints_at_limits(fast)
