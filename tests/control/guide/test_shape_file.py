"""Shape files: the loaded shape has the bounds of the file, and an invalid file is rejected with its key or line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.guide.shape_file import ShapeError, load_shape
from atalante_control.guide.shapes import SHAPES, half_width

ROOT = Path(__file__).parents[3]
VALID = """\
format = "atalante-guide-shape/1"
name = "own"
phase = [0, 0.5, 1.0]
[SH]
upper = [7.5, 3.0, 7.5]
lower = [6.0, 3, 6.0]
[SK]
upper = [4.0, 4.0, 4.0]
lower = [5.0, 5.0, 1.0]
"""
PHASE = np.linspace(0.0, 1.0, 401)


def load(tmp_path: Path, text: str):
    path = tmp_path / "own.toml"
    path.write_text(text)
    return load_shape(path)


def test_bounds_at_the_knots_are_those_of_the_file(tmp_path: Path):
    bounds = np.degrees(load(tmp_path, VALID).bounds(np.array([0.0, 0.5, 1.0]), 0.0))
    np.testing.assert_allclose(bounds[0], [[7.5, 6.0], [3.0, 3.0], [7.5, 6.0]])
    np.testing.assert_allclose(bounds[1], [[4.0, 5.0], [4.0, 5.0], [4.0, 1.0]])


def test_bounds_between_knots_follow_the_interpolation(tmp_path: Path):
    quarter = np.array([0.125])
    linear = np.degrees(load(tmp_path, VALID).bounds(quarter, 0.0))[0, 0, 0]
    cosine = np.degrees(load(tmp_path, 'interpolation = "cosine"\n' + VALID).bounds(quarter, 0.0))[0, 0, 0]
    assert linear == pytest.approx(7.5 - 4.5 * 0.25)
    assert cosine == pytest.approx(7.5 - 4.5 * (0.5 - 0.5 * np.cos(0.25 * np.pi)))


@given(xi=st.floats(0.0, 1.0))
def test_proportional_bounds_scale_with_the_half_width(xi: float, tmp_path_factory: pytest.TempPathFactory):
    shape = load(tmp_path_factory.mktemp("shape"), VALID)
    np.testing.assert_allclose(
        shape.bounds(PHASE, xi), shape.bounds(PHASE, 0.0) * half_width(xi) / half_width(0.0), rtol=1e-12
    )


@given(xi=st.floats(0.0, 1.0))
def test_capped_bounds_are_at_most_the_half_width(xi: float, tmp_path_factory: pytest.TempPathFactory):
    shape = load(tmp_path_factory.mktemp("shape"), 'scaling = "cap"\n' + VALID)
    np.testing.assert_allclose(
        shape.bounds(PHASE, xi), np.minimum(shape.bounds(PHASE, 0.0), half_width(xi)), rtol=1e-12
    )


def test_file_can_describe_a_shape_of_the_package(tmp_path: Path):
    text = VALID.replace("[7.5, 3.0, 7.5]", "[7.5, 7.5, 7.5]").replace("[6.0, 3, 6.0]", "[4.5, 4.5, 4.5]")
    text = text.replace("[4.0, 4.0, 4.0]", "[7.5, 7.5, 7.5]").replace("[5.0, 5.0, 1.0]", "[4.5, 4.5, 4.5]")
    shape = load(tmp_path, text)
    for xi in (0.0, 0.5, 0.9):
        np.testing.assert_allclose(shape.bounds(PHASE, xi), SHAPES["asymmetric"].bounds(PHASE, xi), rtol=1e-12)


def test_example_is_valid():
    bounds = np.degrees(load_shape(ROOT / "examples" / "waist.toml").bounds(np.array([0.45]), 0.5))
    np.testing.assert_allclose(bounds, [[[3.0, 2.5]], [[4.0, 3.5]]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('format = "atalante-guide-shape/1"\n', "", "format is missing; required keys are format, name, phase, SH, SK"),
        ("shape/1", "shape/2", "format must be 'atalante-guide-shape/1', got 'atalante-guide-shape/2'"),
        ('name = "own"', 'name = "Own shape"', r"name must start with a lower-case letter, .* got 'Own shape'"),
        ('name = "own"', 'name = "pinched"', r"name must differ from the names of this package's shapes .* got 'pinched'"),
        ('name = "own"', 'name = "own"\nwidth = 3', "width is unknown; valid keys are format, name, phase, SH, SK"),
        ('name = "own"', 'name = "own"\nsummary = 3', "summary must be a text, got 3"),
        ('name = "own"', 'name = "own"\nscaling = "none"', "scaling must be one of proportional, cap, got 'none'"),
        ('name = "own"', 'name = "own"\ninterpolation = 1', "interpolation must be one of linear, cosine, got 1"),
        ("[0, 0.5, 1.0]", "[0, 0.5, 0.9]", r"phase must start at 0 and end at 1, got 0 and 0\.9"),
        ("[0, 0.5, 1.0]", "[0, 0, 1.0]", r"phase\[1\] must be above phase\[0\] \(0\), got 0"),
        ("[0, 0.5, 1.0]", "[0, nan, 1.0]", "phase must be a list of at least 2 numbers"),
        ("[0, 0.5, 1.0]", "[0]", "phase must be a list of at least 2 numbers"),
        ("[7.5, 3.0, 7.5]", "[7.5, 3.0]", r"SH\.upper must be a list of 3 numbers, one for each phase"),
        ("[6.0, 3, 6.0]", "[6.0, -3, 6.0]", r"SH\.lower\[1\] must be a number of degrees above 0 and at most 90, got -3"),
        ("[6.0, 3, 6.0]", "[6.0, 0.0, 6.0]", r"SH\.lower\[1\] must be .*, got 0\.0"),
        ("[6.0, 3, 6.0]", "[6.0, nan, 6.0]", r"SH\.lower\[1\] must be .*, got nan"),
        ("[6.0, 3, 6.0]", "[6.0, inf, 6.0]", r"SH\.lower\[1\] must be .*, got inf"),
        ("[6.0, 3, 6.0]", "[6.0, true, 6.0]", r"SH\.lower\[1\] must be .*, got True"),
        ("[5.0, 5.0, 1.0]", "[5.0, 5.0, 90.5]", r"SK\.lower\[2\] must be .*, got 90\.5"),
        ("[5.0, 5.0, 1.0]", "[5.0, 5.0, 1e-9]", r"bounds of the guide shape 'own' must be .* \(SK, lower\) at phase 1"),
        ("lower = [5.0, 5.0, 1.0]\n", "", r"SK\.lower is missing; required keys are upper, lower"),
        ("lower = [5.0, 5.0, 1.0]\n", "lower = [5.0, 5.0, 1.0]\nwide = 1\n", r"SK\.wide is unknown"),
        ("[SK]", "[KNEE]", "KNEE is unknown"),
        ("[SH]\nupper = [7.5, 3.0, 7.5]\nlower = [6.0, 3, 6.0]", "SH = 3", "SH must be a table with the lists upper and lower"),
        ("[6.0, 3, 6.0]", "[6.0, 3, 6.0", r"line 7"),
    ],
)  # fmt: skip
def test_invalid_file_is_rejected_with_its_key(tmp_path: Path, old: str, new: str, message: str):
    assert old in VALID
    with pytest.raises(ShapeError, match=message) as refused:
        load(tmp_path, VALID.replace(old, new))
    assert str(refused.value).startswith(f"{tmp_path / 'own.toml'}")


def test_missing_file_is_rejected(tmp_path: Path):
    with pytest.raises(ShapeError, match=r"none\.toml cannot be read: No such file or directory"):
        load_shape(tmp_path / "none.toml")


def test_file_that_is_not_text_is_rejected(tmp_path: Path):
    (tmp_path / "own.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ShapeError, match=r"own\.toml: "):
        load_shape(tmp_path / "own.toml")
