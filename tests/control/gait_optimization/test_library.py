"""Tests of the gait library: resuming, failures, processes. Synthetic gaits replace the optimiser."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization import library as library_module
from atalante_control.gait_optimization.library import Grid, Library, LibraryError
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_hal.robot import load_robot

ROBOT = load_robot()
AIRWALK = load_gait(AIRWALK_GAIT, ROBOT)
GRID = Grid((60.0, 70.0, 80.0), (1.6, 1.7, 1.8, 1.9), (0.1, 0.15, 0.2), (0.7, 0.8, 1.0))
POINTS = math.prod(GRID.shape)
REASON = "no such gait: the speed of the swing knee cannot hold"


def synthetic(subject: Subject) -> SolvedGait:
    """Return a synthetic gait that depends on its subject."""
    share = 1.0 + 0.01 * (subject.step_length - 0.15)
    made = {"status": SOLVED}
    gait = Gait(str(subject), subject.step_duration, AIRWALK.coefficients * share, None, subject.parameters(), made)
    return SolvedGait(gait, SOLVED, 1e-9, 0.01, 10)


def failing(subject: Subject) -> SolvedGait:
    """Return a failure for tall patients with a short step duration."""
    done = synthetic(subject)
    if subject.patient.height > 1.75 and subject.step_duration < 0.75:
        return replace(done, status=REASON)
    return done


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.json")}


def test_every_gait_file_has_parameters_and_solver_record(tmp_path: Path) -> None:
    library = Library(tmp_path, GRID)
    outcomes = list(library.generate(synthetic))
    assert len(outcomes) == POINTS
    assert all(solved.gait.parameters == subject.parameters() for subject, solved in outcomes)
    assert not library.missing()
    gaits = library.gaits(ROBOT)
    assert set(gaits) == set(GRID.points())
    for index, gait in gaits.items():
        assert gait.parameters == GRID.subject(index).parameters()
        assert gait.solver == {"status": SOLVED}


def test_interrupted_and_resumed_run_gives_the_same_files(tmp_path: Path) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    for _ in Library(once, GRID).generate(synthetic):
        pass
    interrupted = Library(twice, GRID).generate(synthetic)
    for _ in range(POINTS // 3):
        next(interrupted)
    interrupted.close()
    assert len(Library(twice).missing()) == POINTS - POINTS // 3
    assert len(list(Library(twice, GRID).generate(synthetic))) == POINTS - POINTS // 3
    assert files(once) == files(twice)


def test_two_processes_give_the_same_files(tmp_path: Path) -> None:
    for _ in Library(tmp_path / "one", GRID).generate(synthetic):
        pass
    for _ in Library(tmp_path / "two", GRID).generate(synthetic, jobs=2):
        pass
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_failures_are_listed_and_retried(tmp_path: Path) -> None:
    library = Library(tmp_path, GRID)
    failed = {str(subject) for subject, solved in library.generate(failing) if not solved.solved}
    assert len(failed) == 3 * 2 * 3
    failures = Library(tmp_path).failures()
    assert set(failures.values()) == {REASON}
    assert {str(GRID.subject(index)) for index in failures} == failed
    assert set(library.missing()) == set(failures)
    assert len(list(library.generate(synthetic))) == len(failures)
    assert not library.failures()
    assert not library.missing()


def test_exception_in_the_solver_is_raised(tmp_path: Path) -> None:
    def broken(subject: Subject) -> SolvedGait:
        raise ZeroDivisionError(str(subject))

    with pytest.raises(ZeroDivisionError):
        next(Library(tmp_path, GRID).generate(broken))
    assert not Library(tmp_path).failures()


def test_library_folder_rejects_another_grid(tmp_path: Path) -> None:
    Library(tmp_path, GRID)
    assert Library(tmp_path).grid == GRID
    with pytest.raises(LibraryError, match=r"grid of the library in .* must be Grid"):
        Library(tmp_path, Grid())
    with pytest.raises(LibraryError, match="contains no library"):
        Library(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"format": "atalante-library/2"}',
        json.dumps({"format": "atalante-library/1", "mass": 3}),
        json.dumps({"format": "atalante-library/1", "weight": [50, 60, 70]}),
    ],
)
def test_invalid_grid_file_is_rejected(tmp_path: Path, content: str) -> None:
    (tmp_path / "grid.json").write_text(content)
    with pytest.raises(LibraryError, match=r"grid\.json"):
        Library(tmp_path)


@pytest.mark.parametrize(
    ("levels", "sentence"),
    [
        ({"mass": (60.0, 70.0)}, "mass must have at least 3 ascending levels"),
        ({"step_duration": (0.7, 0.9, 0.8)}, "step_duration must have at least 3 ascending levels"),
        ({"height": (1.4, 1.6, 1.8)}, "height of the patient must be 1.5 to 2 m, got 1.4 m"),
        ({"step_length": (0.1, 0.2, 0.5)}, "step length must be 0.05 to 0.4 m, got 0.5 m"),
    ],
)
def test_invalid_grid_is_rejected(levels: dict[str, tuple[float, ...]], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        Grid(**levels)


def test_default_grid_covers_the_subjects_of_the_paper() -> None:
    grid = Grid()
    assert min(grid.shape) >= 3
    assert (grid.mass[0], grid.mass[-1]) == (58.0, 91.0)
    assert (grid.height[0], grid.height[-1]) == (1.62, 1.93)
    np.testing.assert_allclose(grid.subject((0, 0, 0, 0)).patient.length("thigh"), 0.245 * 1.62)


def test_gait_that_fails_verification_is_not_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The synthetic gait ignores the ground, so Pinocchio rejects it."""
    monkeypatch.setattr(library_module, "solve", lambda subject, machine_code=False: synthetic(subject))
    subject = GRID.subject((1, 1, 1, 1))
    for solve in (library_module.solve_subject, library_module.solve_compiled):
        outcome = solve(subject)
        assert not outcome.solved
        assert outcome.status.startswith(f"{subject}: ")
        assert " in the verification, got " in outcome.status


def test_failed_gait_is_not_verified() -> None:
    subject = GRID.subject((0, 3, 0, 0))
    failed = failing(subject)
    assert library_module.verified(subject, failed) is failed
