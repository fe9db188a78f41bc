"""Tests of the gait library: resuming, failures, processes. Synthetic gaits replace the optimiser."""

from __future__ import annotations

import itertools
import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from atalante_control.gait.gait import AIRWALK_GAIT, Gait, GaitError, load_gait, read_object, write_object
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization import library as library_module
from atalante_control.gait_optimization.library import Grid, Library, LibraryError
from atalante_control.gait_optimization.parallel import LostProcessError
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_control.gait_optimization.solve import code_version
from atalante_hal.robot import load_robot

ROBOT = load_robot()
AIRWALK = load_gait(AIRWALK_GAIT, ROBOT)
GRID = Grid((60.0, 70.0, 80.0), (1.6, 1.7, 1.8, 1.9), (0.1, 0.15, 0.2), (0.7, 0.8, 1.0), size=108)
POINTS = GRID.size
#: A corner of the grid, and the name of its file.
CORNER, CORNER_FILE = (2, 3, 0, 2, 0, 4), "m80_h1.9_l0.1_d1_t0.94_s1.06.json"
REASON = "no such gait: the speed of the swing knee cannot hold"


def synthetic(subject: Subject) -> SolvedGait:
    """Return a synthetic gait that depends on its subject."""
    share = 1.0 + 0.01 * (subject.step_length - 0.15)
    made = {"status": SOLVED, "version": code_version()}
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
        assert gait.solver == {"status": SOLVED, "version": code_version(), "checksum": gait.hash32}


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
    assert failed == {str(subject) for subject in map(GRID.subject, GRID.points()) if not failing(subject).solved}
    assert 10 < len(failed) < POINTS
    failures = Library(tmp_path).failures()
    assert set(failures.values()) == {REASON}
    assert {str(GRID.subject(index)) for index in failures} == failed
    assert set(library.missing()) == set(failures)
    assert len(list(library.generate(synthetic))) == len(failures)
    assert not library.failures()
    assert not library.missing()


def test_library_that_lost_its_empty_folders_keeps_gaits_and_failures(tmp_path: Path) -> None:
    (tmp_path / "grid.json").write_bytes(files(Library(tmp_path / "made", GRID).folder)["grid.json"])
    library = Library(tmp_path)
    failed = [subject for subject, solved in library.generate(failing) if not solved.solved]
    assert len(library.failures()) == len(failed) > 0
    assert len(library.gaits(ROBOT)) == POINTS - len(failed)


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
        '{"format": "atalante-library/1"}',
        json.dumps({"format": "atalante-library/2", "size": 100, "mass": 3}),
        json.dumps({"format": "atalante-library/2", "size": "all"}),
        json.dumps({"format": "atalante-library/2", "size": 100, "weight": [50, 60, 70]}),
        json.dumps({"format": "atalante-library/2", "size": 100, "mass": [50, 60, 10**400]}),
        "[" * 100_000,
    ],
)
def test_invalid_grid_file_is_rejected(tmp_path: Path, content: str) -> None:
    (tmp_path / "grid.json").write_text(content)
    with pytest.raises(LibraryError, match=r"grid\.json"):
        Library(tmp_path)


@pytest.mark.parametrize(
    ("levels", "sentence"),
    [
        ({"mass": (60.0, 70.0)}, "mass must have at least 3 levels, got"),
        ({"step_duration": (0.7, 0.9, 0.8)}, "levels of step_duration must be in ascending order, got"),
        ({"height": (1.4, 1.6, 1.8)}, "height of the patient must be 1.5 to 2 m, got 1.4 m"),
        ({"step_duration": (0.7, 0.80005, 0.9)}, "step duration must be a whole number of milliseconds, got 0.80005 s"),
        ({"size": 63}, "size must be at least 64, the number of corners of the grid, got 63"),
        ({"step_length": (0.1, 0.2, 0.5)}, "step length must be 0.05 to 0.4 m, got 0.5 m"),
    ],
)
def test_invalid_grid_is_rejected(levels: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        Grid(**levels)


def test_default_grid_covers_the_subjects_of_the_paper() -> None:
    grid = Grid()
    assert min(grid.shape) >= 3
    assert (grid.mass[0], grid.mass[-1]) == (58.0, 91.0)
    assert (grid.height[0], grid.height[-1]) == (1.62, 1.93)
    np.testing.assert_allclose(grid.subject((0, 0, 0, 0, 2, 2)).patient.length("thigh"), 0.245 * 1.62)


def test_selected_points_are_the_corners_and_an_even_sample_of_the_grid() -> None:
    points = Grid().points()
    assert points == Grid().points()
    assert len(set(points)) == len(points) == Grid().size
    ends = [(0, levels - 1) for levels in Grid().shape]
    assert set(itertools.product(*ends)) == set(points[: 2 ** len(ends)])
    inner = np.array(points[2 ** len(ends) :])
    for column, levels in zip(inner.T, Grid().shape, strict=True):
        counts = np.bincount(column, minlength=levels)
        assert counts.min() > 0.7 * counts.mean()
    assert np.abs(np.corrcoef(inner.T) - np.eye(len(ends))).max() < 0.1


def test_larger_library_contains_the_points_of_a_smaller_one() -> None:
    small, large = Grid(size=100).points(), Grid(size=300).points()
    assert large[: len(small)] == small


def test_all_points_are_selected_if_the_grid_has_no_more() -> None:
    levels = (0.96, 1.0, 1.04)
    grid = Grid((60.0, 70.0, 80.0), (1.6, 1.7, 1.8), (0.1, 0.15, 0.2), (0.7, 0.8, 1.0), levels, levels, size=729)
    assert grid.points() == list(itertools.product(range(3), repeat=6))


def test_gait_that_fails_verification_is_not_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The synthetic gait ignores the ground, so Pinocchio rejects it."""
    monkeypatch.setattr(library_module, "solve", lambda subject, warm_start, machine_code=False: synthetic(subject))
    subject = GRID.subject((1, 1, 1, 1, 1, 1))
    for solve in (library_module.solve_subject, library_module.solve_compiled):
        outcome = solve(subject)
        assert not outcome.solved
        assert outcome.gait.solver["status"] == outcome.status
        assert outcome.status.startswith(f"{subject}: ")
        assert " in the verification, got " in outcome.status


def test_failed_gait_is_not_verified() -> None:
    subject = GRID.subject((0, 3, 0, 0, 0, 0))
    failed = failing(subject)
    assert library_module.verified(subject, failed) is failed


@pytest.fixture
def solved_library(tmp_path: Path) -> Library:
    library = Library(tmp_path, GRID)
    assert len(list(library.generate(synthetic))) == POINTS
    return library


def change(path: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    """Edit the JSON object of a file."""
    document = read_object(path)
    edit(document)
    write_object(document, path)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def change_one_number(path: Path) -> None:
    change(path, lambda document: document["joints"]["left_SK"].__setitem__(3, 0.5))


#: Damage to a gait file, and the words of the reason.
DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (truncate, "Expecting|Unterminated"),
    "empty": (lambda path: path.write_bytes(b""), "Expecting value"),
    "binary": (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is not a gait file: a gait file is text"),
    "list": (lambda path: path.write_text("[]"), "must be a JSON object"),
    "key missing": (lambda path: change(path, lambda d: d.pop("joints")), "joints is missing"),
    "number changed": (change_one_number, "solver.checksum must be"),
    "checksum missing": (lambda path: change(path, lambda d: d["solver"].pop("checksum")), "solver.checksum must be"),
    "duration changed": (lambda path: change(path, lambda d: d.update(duration=0.9)), "solver.checksum must be"),
    "other version": (lambda path: change(path, lambda d: d["solver"].update(version="0.0.1+0")), "solver.version must be"),
    "other status": (lambda path: change(path, lambda d: d["solver"].update(status=REASON)), "solver.status must be"),
    "other patient": (lambda path: change(path, lambda d: d["parameters"].update(patient_mass=61.0)), "parameters must be"),
    "other shank": (lambda path: change(path, lambda d: d["parameters"].update(shank_length=0.4)), "parameters must be"),
}  # fmt: skip


@pytest.mark.sample(6)
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_gait_file_is_rejected_with_a_reason_and_solved_again(solved_library: Library, damage: str) -> None:
    library, index = solved_library, CORNER
    intact = files(library.folder)
    path = next(library.folder.glob(f"gaits/{CORNER_FILE}"))
    spoil, reason = DAMAGES[damage]
    spoil(path)
    assert files(library.folder) != intact
    with pytest.raises(GaitError, match=reason):
        library.gait(index)
    assert library.missing() == [index]
    assert list(library.rejected()) == [index]
    assert library.rejected()[index].startswith(str(path))
    assert index not in library.gaits(ROBOT)
    assert [subject for subject, _ in library.generate(synthetic)] == [GRID.subject(index)]
    assert files(library.folder) == intact
    assert not library.rejected()


def test_gait_file_of_another_subject_is_rejected(solved_library: Library) -> None:
    folder = solved_library.folder / "gaits"
    (folder / "m60_h1.6_l0.1_d0.7_t0.94_s0.94.json").write_bytes((folder / CORNER_FILE).read_bytes())
    assert list(solved_library.rejected()) == [(0, 0, 0, 0, 0, 0)]
    assert "parameters must be" in solved_library.rejected()[0, 0, 0, 0, 0, 0]


def test_unfinished_file_is_not_a_gait(solved_library: Library) -> None:
    """A process that is killed while it writes leaves the file under its temporary name."""
    path = next(solved_library.folder.glob(f"gaits/{CORNER_FILE}"))
    path.rename(path.with_name(f"{path.name}.new"))
    assert solved_library.missing() == [CORNER]
    assert not solved_library.rejected()


@pytest.mark.parametrize(("content", "reason"), [("{", "Expecting"), ("{}", "status is missing")])
def test_damaged_record_of_a_failure_gives_its_reason(tmp_path: Path, content: str, reason: str) -> None:
    library = Library(tmp_path, GRID)
    for path in {index: library._path("failed", index) for index in library.missing()[:2]}.values():
        path.write_text(content)
    failures = library.failures()
    assert len(failures) == 2
    assert all(reason in found for found in failures.values())


def killed_once(marker: Path, subject: Subject) -> SolvedGait:
    """End the process at the first call for one subject."""
    if subject == GRID.subject((0, 0, 0, 2, 0, 0)) and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return synthetic(subject)


def killed_always(subject: Subject) -> SolvedGait:
    """End the process at each call for one subject."""
    if subject == GRID.subject((0, 0, 0, 2, 0, 0)):
        os.kill(os.getpid(), signal.SIGKILL)
    return synthetic(subject)


def test_gaits_of_a_killed_process_are_solved_again(tmp_path: Path) -> None:
    messages: list[str] = []
    library = Library(tmp_path / "library", GRID)
    solve = partial(killed_once, tmp_path / "marker")
    assert len(list(library.generate(solve, jobs=2, on_lost=messages.append))) == POINTS
    assert not library.missing()
    assert len(messages) == 1
    assert messages[0].startswith("a process ended unexpectedly")
    assert messages[0].endswith("they are repeated in new processes")


@pytest.mark.long
def test_gait_that_always_ends_its_process_is_recorded_as_failed(tmp_path: Path) -> None:
    messages: list[str] = []
    library = Library(tmp_path, GRID)
    with pytest.raises(LostProcessError, match="repeat the command, if necessary with fewer --jobs"):
        list(library.generate(killed_always, jobs=2, on_lost=messages.append))
    assert len(messages) == 3
    failures = library.failures()
    (reason,) = failures.values()
    assert reason.startswith(f"no result for {GRID.subject((0, 0, 0, 2, 0, 0))}: a process ended unexpectedly")
    assert library.missing() == list(failures) == [(0, 0, 0, 2, 0, 0)]
    assert len(list(library.generate(synthetic))) == 1
    assert not library.failures()
