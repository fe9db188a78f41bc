"""The library: order, warm starts, resuming, failures, processes; solved by arithmetic instead of an optimiser."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from atalante_control.gait import HANG_GAIT, Gait, load_gait
from atalante_control.generation.library import Grid, Library, LibraryError
from atalante_control.generation.solved import SOLVED, SolvedGait
from atalante_control.subject import Subject
from atalante_hal.robot import load_robot

ROBOT = load_robot()
HANG = load_gait(HANG_GAIT, ROBOT)
GRID = Grid((60.0, 70.0, 80.0), (1.6, 1.7, 1.8, 1.9), (0.1, 0.15, 0.2), (0.7, 0.8, 1.0))
POINTS = math.prod(GRID.shape)


def drawn(subject: Subject, warm_start: Gait | None) -> SolvedGait:
    """A gait that depends on its subject, and says what it was started from."""
    share = 1.0 + 0.01 * (subject.step_length - 0.15)
    started = dict(warm_start.parameters) if warm_start else None
    solver = {"status": SOLVED, "started_from": started}
    gait = Gait(str(subject), subject.step_duration, HANG.coefficients * share, None, subject.parameters(), solver)
    return SolvedGait(gait, SOLVED, 1e-9, 0.01, 10)


def stubborn(subject: Subject, warm_start: Gait | None) -> SolvedGait:
    """Tall people in a hurry cannot do it."""
    done = drawn(subject, warm_start)
    if subject.patient.height > 1.75 and subject.step_duration < 0.75:
        return SolvedGait(done.gait, "the swing knee cannot keep its speed limit", 0.3, 0.01, 99)
    return done


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.json")}


def test_rings_hold_every_point_once_and_start_from_the_ring_before() -> None:
    rings = list(GRID.rings())
    assert sum(map(len, rings)) == POINTS
    assert len({index for ring in rings for index in ring}) == POINTS
    assert len(rings[0]) == 1
    assert GRID.nearer(rings[0][0]) is None
    for before, ring in pairwise(rings):
        for index in ring:
            nearer = GRID.nearer(index)
            assert nearer in before
            assert sum(a != b for a, b in zip(nearer, index, strict=True)) == 1


def test_every_gait_is_on_the_disk_started_from_its_neighbour(tmp_path: Path) -> None:
    library = Library(tmp_path, GRID)
    subjects = [subject for subject, _ in library.generate(drawn, ROBOT)]
    assert len(subjects) == POINTS
    assert not library.missing()
    gaits = library.gaits(ROBOT)
    for index, gait in gaits.items():
        assert gait.parameters == GRID.subject(index).parameters()
        nearer = GRID.nearer(index)
        assert gait.solver["started_from"] == (GRID.subject(nearer).parameters() if nearer else None)


def test_interrupted_and_resumed_gives_the_same_files(tmp_path: Path) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    for _ in Library(once, GRID).generate(drawn, ROBOT):
        pass
    interrupted: Iterator[tuple[Subject, SolvedGait]] = Library(twice, GRID).generate(drawn, ROBOT)
    for _ in range(POINTS // 3):
        next(interrupted)
    interrupted.close()
    assert len(Library(twice).missing()) == POINTS - POINTS // 3
    rest = list(Library(twice, GRID).generate(drawn, ROBOT))
    assert len(rest) == POINTS - POINTS // 3
    assert files(once) == files(twice)


def test_processes_give_the_same_files(tmp_path: Path) -> None:
    for _ in Library(tmp_path / "one", GRID).generate(drawn, ROBOT):
        pass
    for _ in Library(tmp_path / "two", GRID).generate(drawn, ROBOT, jobs=2):
        pass
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_failures_are_listed_tried_again_and_skipped_as_starts(tmp_path: Path) -> None:
    library = Library(tmp_path, GRID)
    for _ in library.generate(stubborn, ROBOT):
        pass
    failures = library.failures()
    assert len(failures) == 3 * 2 * 3
    assert all(failure.subject.patient.height > 1.75 for failure in failures)
    assert {failure.status for failure in failures} == {"the swing knee cannot keep its speed limit"}
    assert len(library.missing()) == len(failures)
    assert len(list(library.generate(drawn, ROBOT))) == len(failures)
    assert not library.failures()
    tallest = library.gait((1, 3, 1, 0), ROBOT)
    assert tallest is not None
    assert tallest.solver["started_from"]["step_duration"] == 0.7  # its neighbour, which has succeeded by now


def test_a_failed_neighbour_is_stepped_over(tmp_path: Path) -> None:
    library = Library(tmp_path, GRID)
    started: dict[str, Gait | None] = {}

    def noting(subject: Subject, warm_start: Gait | None) -> SolvedGait:
        started[str(subject)] = warm_start
        done = drawn(subject, warm_start)
        return SolvedGait(done.gait, "no", 1.0, 0.0, 1) if subject.step_length == 0.1 else done

    for _ in library.generate(noting, ROBOT):
        pass
    index = (0, 2, 0, 1)
    neighbour = GRID.nearer(index)
    assert neighbour is not None
    assert GRID.subject(neighbour).step_length in (0.1, 0.15)
    warm = started[str(GRID.subject((0, 0, 0, 0)))]
    assert warm is not None
    assert warm.parameters["step_length"] == 0.15


def test_a_folder_keeps_its_grid(tmp_path: Path) -> None:
    Library(tmp_path, GRID)
    assert Library(tmp_path).grid == GRID
    with pytest.raises(LibraryError, match="holds a library over another grid"):
        Library(tmp_path, Grid())
    with pytest.raises(LibraryError, match="holds no library"):
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
def test_a_grid_file_that_is_none_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "grid.json").write_text(content)
    with pytest.raises(LibraryError, match=r"grid\.json"):
        Library(tmp_path)


@pytest.mark.parametrize(
    ("levels", "sentence"),
    [
        ({"mass": (60.0, 70.0)}, "mass has at least 3 levels that rise"),
        ({"step_duration": (0.7, 0.9, 0.8)}, "step_duration has at least 3 levels that rise"),
        ({"height": (1.4, 1.6, 1.8)}, "a patient's height is from 1.5 to 2 m, not 1.4 m"),
        ({"step_length": (0.1, 0.2, 0.5)}, "a step length is from 0.05 to 0.4 m, not 0.5 m"),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(levels: dict[str, tuple[float, ...]], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        Grid(**levels)


def test_the_default_grid_encloses_the_paper_s_subjects() -> None:
    grid = Grid()
    assert min(grid.shape) >= 3
    assert (grid.mass[0], grid.mass[-1]) == (58.0, 91.0)
    assert (grid.height[0], grid.height[-1]) == (1.62, 1.93)
    np.testing.assert_allclose(grid.subject((0, 0, 0, 0)).patient.length("thigh"), 0.245 * 1.62)
