"""Result of a walk on the ground: the guide to which its promise refers."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.guide.shapes import SHAPES
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_hal.robot import load_robot
from atalante_tools.session.walk_result import WalkResult, guide_fields, show_result, weakest_guide


@pytest.fixture(scope="module")
def walked() -> WalkController:
    robot = load_robot()
    return WalkController(robot, Patient(75.0, 1.75), load_walk(DEFAULT_WALK, robot), 3, shape=SHAPES["asymmetric"])


def line(controller: WalkController, xi: float, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the line with the result of a walk in which both joints were inside the guide."""
    fields: dict[str, Any] = {field.name: 0.0 for field in dataclasses.fields(WalkResult)}
    guide = guide_fields(weakest_guide(controller, xi), controller.statistics.guide)
    show_result(WalkResult(**{**fields, **guide, "outcome": "stood", "xi": xi}))
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("factors", "text"), [({0.5}, "certified at Xi 0.5"), ({0.5, 0.975}, "NOT CERTIFIED at Xi 0.975")]
)
@pytest.mark.parametrize("xi", [0.5, 1.0])
def test_result_names_the_factor_of_the_weakest_guide(
    walked: WalkController, factors: set[float], text: str, xi: float, capsys: pytest.CaptureFixture[str]
) -> None:
    walked.statistics.guide.factors = factors
    walked.statistics.guide.count(0, 0.5, 1.0, False)
    assert f"; asymmetric ({text}): largest |e|/q_bound 0.500, 0 ms outside the guide" in line(walked, xi, capsys)


def test_without_a_guided_step_the_guide_of_the_options_applies(walked: WalkController) -> None:
    walked.statistics.guide.factors = set()
    certificate = weakest_guide(walked, 0.75)
    assert certificate is not None
    assert (certificate.shape, certificate.xi) == ("asymmetric", 0.75)
    assert weakest_guide(walked, 1.0) is None
