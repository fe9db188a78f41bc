"""Random guide shapes: equal seeds give equal shapes of three kinds, and no push moves a joint out of a certified guide."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from atalante_control.guide.shapes import half_width
from atalante_tools.cli import cli
from atalante_tools.guide.random_shapes import KINDS, random_guide

PHASE = np.linspace(0.0, 1.0, 1001)


@pytest.mark.parametrize("number", range(30))
def test_random_shape_is_repeatable_and_within_the_half_width(number: int):
    shape, xi = random_guide(7, number)
    assert shape.name == f"{KINDS[number % 3]}-{number}"
    assert 0.0 <= xi < 1.0
    bounds = shape.bounds(PHASE, xi)
    np.testing.assert_array_equal(bounds, random_guide(7, number).shape.bounds(PHASE, xi))
    assert 0.02 * half_width(xi) < bounds.min() <= bounds.max() <= half_width(xi) * (1.0 + 1e-12)


def test_other_seeds_and_numbers_give_other_shapes():
    shapes = [random_guide(seed, number).shape.bounds(PHASE, 0.5) for seed in (0, 1) for number in (0, 3)]
    assert all(np.abs(a - b).max() > 0.0 for i, a in enumerate(shapes) for b in shapes[:i])


def test_notches_are_short_and_pieces_are_constant():
    notched, piecewise = (random_guide(0, number).shape.bounds(PHASE, 0.5)[0, :, 0] for number in (1, 2))
    assert np.mean(notched < notched.max()) < 0.25
    assert len(np.unique(piecewise)) <= 12


@pytest.mark.long
def test_command_repeats_the_check_of_one_shape():
    arguments = ["guide", "random", "--first", "3", "--count", "1", "--steps", "1", "--json"]
    first, second = (CliRunner().invoke(cli, arguments).stdout for _ in range(2))
    assert first == second
    assert json.loads(first)["shape"] == "smooth-3"


@pytest.mark.exhaustive
def test_no_push_moves_a_joint_out_of_a_certified_random_guide():
    done = CliRunner().invoke(cli, ["guide", "random", "--count", "6", "--steps", "40", "--json"])
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(verdicts) == 6
    assert sum(verdict["certified"] for verdict in verdicts) >= 3
    assert [v["shape"] for v in verdicts if v["certified"] and v["worst_ratio"] > 1.0] == []
    assert done.exit_code == 0, done.stderr
