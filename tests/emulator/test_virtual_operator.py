from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_emulator.bodies import ENGINES, Body, Pose
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.virtual_operator import DEADBAND, VirtualOperator
from atalante_hal.robot import load_robot

STANDING = [0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2
TEXT = urdf(ExoskeletonParameters(), load_robot(), Patient(75.0, 1.75))


@pytest.fixture(params=ENGINES)
def body(request: pytest.FixtureRequest) -> Iterator[Body]:
    made = Mechanics(TEXT, request.param, Ground()).make_body(STANDING)
    yield made
    made.close()


def lean(body: Body, roll: float, pitch: float) -> None:
    x, y = np.sin(0.5 * roll), np.sin(0.5 * pitch)
    body.reset(STANDING, Pose((0.0, 0.0, 1.3), (x, y, 0.0, np.sqrt(1.0 - x * x - y * y))))


def test_upright_pelvis_gets_no_force(body: Body) -> None:
    operator = VirtualOperator(body, 100.0)
    for pitch in (0.0, 0.9 * DEADBAND, -0.9 * DEADBAND):
        lean(body, 0.0, pitch)
        assert not operator(2).any()
    assert operator.interventions == []


@pytest.mark.parametrize("angle", [0.12, 0.5, 1.0])
def test_leaning_pelvis_gets_a_bounded_force_against_the_lean(body: Body, angle: float, caplog) -> None:
    caplog.set_level(logging.INFO)
    for roll, pitch, direction in (
        (0.0, angle, (-1, 0)),
        (0.0, -angle, (1, 0)),
        (angle, 0.0, (0, 1)),
        (-angle, 0.0, (0, -1)),
    ):
        operator = VirtualOperator(body, 100.0)
        lean(body, roll, pitch)
        force = operator(2)
        assert not force[2:].any()
        assert force[:2] @ direction == pytest.approx(np.hypot(*force[:2]), rel=1e-3)
        assert 0.0 < np.hypot(*force[:2]) <= 100.0 + 1e-9
        assert len(operator.interventions) == 1
        assert operator.interventions[0].largest == pytest.approx(np.hypot(*force[:2]))
        assert operator.interventions[0].impulse == pytest.approx(np.hypot(*force[:2]) * 1e-3)
    assert "the virtual operator holds the robot" in caplog.text


def test_interventions_with_a_pause_are_counted_separately(body: Body) -> None:
    operator = VirtualOperator(body, 100.0)
    for cycles, pitch in ((10, 0.5), (150, 0.0), (10, 0.5), (300, 0.0), (10, 0.5)):
        lean(body, 0.0, pitch)
        for _ in range(cycles):
            operator(2)
    assert [(i.start, i.end) for i in operator.interventions] == [(0, 169), (470, 479)]


def test_force_that_is_not_positive_is_rejected(body: Body) -> None:
    with pytest.raises(ValueError, match="the largest force of the virtual operator must be above 0 N"):
        VirtualOperator(body, 0.0)
