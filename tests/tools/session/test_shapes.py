"""Guide shapes on the command line: a name of the package, or a shape file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from atalante_control.guide.shape_file import ShapeError
from atalante_control.guide.shapes import SHAPES
from atalante_tools.cli import cli
from atalante_tools.session.shapes import SHAPE_NAMES, guide_shape, guide_shapes

WAIST = str(Path(__file__).parents[3] / "examples" / "waist.toml")


def test_names_in_the_help_are_those_of_the_package():
    assert SHAPE_NAMES.split(", ") == list(SHAPES)


def test_name_is_found_in_any_case():
    assert guide_shape(" Pinched") is SHAPES["pinched"]


def test_file_and_name_are_accepted_together():
    assert list(guide_shapes(["pinched", WAIST, WAIST])) == ["pinched", "waist"]


def test_unknown_name_lists_the_names_and_the_file_form():
    with pytest.raises(
        click.UsageError, match=r"guide shape \(or a file that ends in \.toml\) must be one of constant"
    ):
        guide_shape("waist")


def test_two_files_with_one_name_are_rejected(tmp_path: Path):
    other = tmp_path / "other.toml"
    other.write_text(Path(WAIST).read_text())
    with pytest.raises(click.UsageError, match="shapes from different files must have different names, got 'waist'"):
        guide_shapes([WAIST, str(other)])


def test_invalid_file_is_rejected(tmp_path: Path):
    with pytest.raises(ShapeError, match="cannot be read"):
        guide_shape(str(tmp_path / "none.toml"))


def test_demo_with_a_shape_file_is_certified(tmp_path: Path):
    done = CliRunner().invoke(cli, ["demo", "--shape", WAIST, "--steps", "1", "--json", "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.stderr
    assert re.search(r"^.*waist: promise at Xi 0.5: ", done.stderr, re.MULTILINE)
    result = json.loads(done.stdout.splitlines()[0])
    assert result["shape"] == "waist"
    assert result["certified"]


def test_airwalk_error_names_the_wrong_key_of_a_shape_file(tmp_path: Path):
    bad = tmp_path / "bad.toml"
    bad.write_text(Path(WAIST).read_text().replace("2.5, 2.5", "2.5, -2.5"))
    done = CliRunner().invoke(cli, ["airwalk", "--shape", str(bad), "--steps", "1", "--out", str(tmp_path / "run")])
    assert done.exit_code == 1
    assert f"CONFIG_INVALID: {bad}: SH.lower[2] must be a number of degrees above 0" in done.stderr
