"""Gait solver: residuals, determinism, warm starts, start and stop steps, and errors for infeasible gaits."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from atalante_control.gait.gait import (
    AIRWALK_GAIT,
    SIGN,
    SWAP,
    Gait,
    Kind,
    check_gait,
    load_gait,
    motion,
    write_gait,
)
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_control.gait_optimization.solve import RESIDUAL, code_version, solve
from atalante_control.gait_optimization.step_problem import TRANSITION
from atalante_control.model import Patient
from atalante_hal.robot import JOINTS, load_robot

SUBJECT = Subject(Patient(75.0, 1.75), 0.16, 0.8)
ROBOT = load_robot()


@pytest.fixture(scope="module")
def solved() -> SolvedGait:
    return solve(SUBJECT)


def test_solved_gait_has_residuals_below_the_limit(solved: SolvedGait) -> None:
    assert solved.status == SOLVED
    assert solved.max_residual < RESIDUAL
    assert all(residual.value < RESIDUAL for residual in solved.residuals.values())
    wanted = {"impact map", "swing clearance", "landing position", "torque limits", "centre of pressure along the sole"}
    assert wanted <= set(solved.residuals)


def test_solved_gait_is_valid_and_keeps_its_solver_record(solved: SolvedGait, tmp_path: Path) -> None:
    check_gait(solved.gait, ROBOT)
    path = tmp_path / "gait.json"
    write_gait(solved.gait, path)
    read = load_gait(path, ROBOT)
    assert read.hash32 == solved.gait.hash32
    assert read.parameters == SUBJECT.parameters()
    assert read.solver["version"] == code_version()
    assert read.solver["status"] == SOLVED
    assert read.solver["max_residual"] < RESIDUAL


def test_peak_torques_are_close_to_published_results(solved: SolvedGait) -> None:
    # Another optimiser, with other weights, gives 162, 86, 44, 99, 93, 29 Nm for the stance leg of this subject.
    stance = solved.peak_torque[6:]
    assert 120.0 < stance[JOINTS.index("right_FH") - 6] < 200.0
    assert (stance < np.array([200.0, 90.0, 80.0, 110.0, 100.0, 40.0])).all()
    assert (solved.peak_torque < 0.9 * ROBOT.torque_max).all()


def test_same_request_gives_the_same_gait(solved: SolvedGait) -> None:
    assert solve(SUBJECT).gait.hash32 == solved.gait.hash32


def test_warm_start_is_faster_and_gives_the_same_gait(solved: SolvedGait) -> None:
    other = Subject(Patient(78.0, 1.77), 0.15, 0.83)
    cold, warm = solve(other), solve(other, solved.gait)
    assert warm.solved
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.gait.coefficients, cold.gait.coefficients, atol=math.radians(0.01))


@pytest.mark.sample(2)
@pytest.mark.parametrize("kind", ["start", "stop"])
def test_start_and_stop_steps_join_the_periodic_gait(solved: SolvedGait, kind: Kind) -> None:
    step = solve(SUBJECT, kind=kind)
    assert step.solved
    assert step.gait.duration == TRANSITION
    ends = np.array([0.0, 1.0])
    q, qd, _ = motion(step.gait.coefficients, TRANSITION, ends)
    periodic_q, periodic_qd, _ = motion(solved.gait.coefficients, SUBJECT.step_duration, ends)
    joined, resting = (1, 0) if kind == "start" else (0, 1)
    np.testing.assert_allclose(q[joined], periodic_q[joined], atol=1e-9)
    np.testing.assert_allclose(qd[joined], periodic_qd[joined], atol=1e-9)
    np.testing.assert_allclose(qd[resting], 0.0, atol=1e-9)


def test_periodic_step_around_a_gait_is_rejected() -> None:
    with pytest.raises(ValueError, match="a periodic step must be solved without the argument `around`"):
        solve(SUBJECT, around=load_gait(AIRWALK_GAIT, ROBOT))


def test_gait_continues_in_the_mirrored_step(solved: SolvedGait) -> None:
    q, qd, _ = motion(solved.gait.coefficients, solved.gait.duration, np.array([0.0, 1.0]))
    np.testing.assert_allclose(q[1], SIGN * q[0][SWAP], atol=1e-9)
    np.testing.assert_allclose(qd[1], SIGN * qd[0][SWAP], atol=Requirements().impact_jump + 1e-9)


def test_step_out_of_reach_is_rejected_without_iterations() -> None:
    subject = Subject(Patient(110.0, 1.5), 0.4, 0.4)
    outcome = solve(subject)
    assert not outcome.solved
    assert outcome.iterations == 0
    assert outcome.status.startswith(f"no such gait for {subject}: with both feet flat on the ground")


@pytest.mark.long
def test_infeasible_gait_names_the_violated_constraint() -> None:
    outcome = solve(Subject(Patient(75.0, 1.75), 0.4, 0.4))
    assert not outcome.solved
    assert "is violated by" in outcome.status
    assert any(name in outcome.status for name in outcome.residuals)
    assert isinstance(outcome.gait, Gait)


def test_progress_is_called_in_every_iteration(solved: SolvedGait) -> None:
    seen: list[tuple[int, float]] = []
    watched = solve(SUBJECT, progress=lambda iteration, violation: seen.append((iteration, violation)))
    assert [iteration for iteration, _ in seen] == list(range(watched.iterations + 1))
    assert seen[-1][1] < 1e-8 < seen[0][1]
    assert watched.gait.hash32 == solved.gait.hash32
