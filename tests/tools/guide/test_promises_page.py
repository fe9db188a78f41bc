"""Generated table of the promises: it is complete, agrees with the certificates, and contains no broken promise."""

from __future__ import annotations

from pathlib import Path

import pytest

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_hal.robot import load_robot
from atalante_tools import guide

TABLE = Path(guide.__file__).with_name("PROMISES.md")
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLE.read_text().splitlines()[2:]]


def test_table_has_every_shape_at_every_factor():
    assert [(shape, float(xi)) for _, shape, xi, *_ in ROWS] == [(name, xi) for name in SHAPES for xi in guide.FACTORS]


@pytest.mark.parametrize("name", SHAPES)
def test_promises_are_those_of_the_certificates(name: str):
    """If this test fails, the law has changed: write the table again, see docs/reference/guide-promises.md."""
    robot = load_robot()
    controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES[name])
    for _, shape, xi, promise, *_ in ROWS:
        if shape == name:
            made = controller.certificate(float(xi)).promise
            assert promise == ("none" if made is None else f"{made.hip:.1f}, {made.knee:.1f}"), f"{name} at Xi {xi}"


def test_no_joint_left_a_guide_with_a_promise_in_at_least_60_steps():
    promised = [row for row in ROWS if row[3] != "none"]
    assert len(promised) >= 25
    for _, shape, xi, _, plant, robot, left_at, steps in promised:
        assert int(steps) >= 60, (shape, xi)
        assert 0.0 < float(plant) <= 1.0, (shape, xi)
        if robot != "-":
            assert 0.0 < float(robot) <= 1.0, (shape, xi)
            assert int(steps) >= 1560, (shape, xi)
        assert left_at == "-" or float(left_at) > 1.0, (shape, xi)
