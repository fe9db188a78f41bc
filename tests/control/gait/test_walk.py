"""Walk files: start step, periodic step and stop step."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from atalante_control.dynamics.gait_network import DEFAULT_NETWORK
from atalante_control.gait.gait import Gait, GaitError, gait_object, write_gait
from atalante_control.gait.walk import DEFAULT_WALK, WalkGaits, check_walk, load_gaits, load_walk, write_walk
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


@pytest.mark.parametrize("key", WalkGaits._fields)
def test_step_of_another_kind_is_refused(key: str) -> None:
    other = "stop" if key == "start" else "start"
    moved = replace(getattr(WALK, key), kind=other)
    with pytest.raises(GaitError, match=rf"walk: {key}: kind must be (start|periodic|stop), got {other}"):
        check_walk(WALK._replace(**{key: moved}), ROBOT)


def test_one_reader_for_gait_files_and_walk_files(tmp_path: Path) -> None:
    file = tmp_path / "gait.json"
    write_gait(WALK.step, file)
    read = load_gaits(file, ROBOT)
    assert isinstance(read, Gait)
    assert read.hash32 == WALK.hash32
    walk = load_gaits(DEFAULT_WALK, ROBOT)
    assert isinstance(walk, WalkGaits)
    assert [gait.kind for gait in walk] == ["start", "periodic", "stop"]


def _truncated(content: bytes) -> bytes:
    return content[:1000]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_truncated, "is damaged or not a gait file: "),
        (lambda _: b"", "is damaged or not a gait file: "),
        (lambda _: DEFAULT_NETWORK.read_bytes(), "is not a gait file: a gait file is text in JSON"),
        (lambda content: content + b" " * 1_000_000, "is not a gait file: a gait file has at most 1000000 bytes"),
        (lambda _: b'{"format": "other/1"}', "format must be 'atalante-gait/1' or 'atalante-walk/1', got 'other/1'"),
        (lambda _: b'{"name": "other"}', "format must be 'atalante-gait/1' or 'atalante-walk/1', got None"),
        (
            lambda content: content.replace(b'"periodic"', b'"hop"'),
            "step: kind must be periodic, start or stop, got 'hop'",
        ),
        (lambda _: json.dumps(gait_object(WALK.stop)).encode(), "kind must be periodic, got stop"),
    ],
)
def test_file_that_is_not_a_gait_gives_one_sentence(
    tmp_path: Path, change: Callable[[bytes], bytes], message: str
) -> None:
    file = tmp_path / "walk.json"
    file.write_bytes(change(DEFAULT_WALK.read_bytes()))
    with pytest.raises(GaitError) as error:
        load_gaits(file, ROBOT)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
