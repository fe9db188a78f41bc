"""Walk files: start step, periodic step and stop step."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from atalante_control.gait.gait import GaitError
from atalante_control.gait.walk import DEFAULT_WALK, WalkGaits, check_walk, load_walk, write_walk
from atalante_hal.robot import load_robot

ROBOT = load_robot()
WALK = load_walk(DEFAULT_WALK, ROBOT)


def test_walk_file_returns_the_same_numbers(tmp_path: Path) -> None:
    write_walk(WALK, tmp_path / "walk.json")
    for read, written in zip(load_walk(tmp_path / "walk.json", ROBOT), WALK, strict=True):
        np.testing.assert_array_equal(read.coefficients, written.coefficients)
        np.testing.assert_array_equal(read.feedforward, written.feedforward)
        assert read.duration == written.duration


def test_walk_begins_and_ends_at_rest() -> None:
    for gait, row in ((WALK.start, 0), (WALK.stop, -1)):
        assert np.abs(gait.tables().qd[row]).max() < 1e-9


@pytest.mark.parametrize("kind", WalkGaits._fields)
def test_missing_step_is_refused(tmp_path: Path, kind: str) -> None:
    write_walk(WALK, tmp_path / "walk.json")
    document = json.loads((tmp_path / "walk.json").read_text())
    del document[kind]
    (tmp_path / "walk.json").write_text(json.dumps(document))
    with pytest.raises(GaitError, match="keys of a walk file must be format, start, step, stop"):
        load_walk(tmp_path / "walk.json", ROBOT)


@pytest.mark.parametrize("kind", ["start", "stop"])
def test_step_that_does_not_fit_the_gait_is_refused(kind: str) -> None:
    gait = getattr(WALK, kind)
    moved = replace(gait, coefficients=gait.coefficients + 0.01)
    with pytest.raises(GaitError, match=rf"walk: jump of joints\.\w+ between {kind} and step must be at most 0\.1 deg"):
        check_walk(WALK._replace(**{kind: moved}), ROBOT)


def test_step_beyond_a_limit_is_refused() -> None:
    coefficients = WALK.start.coefficients.copy()
    coefficients[3, 3] = 9.0
    with pytest.raises(GaitError, match=r"start: angle of joints\.left_SK must be"):
        check_walk(WALK._replace(start=replace(WALK.start, coefficients=coefficients)), ROBOT)
