"""The promise on the ideal plant: exactly the printed torques, wrong models, and any start in the hand-over box."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_control.airwalk.config import AirwalkConfig
from tests.control.guide.ideal_leg import Start, Truth, attacks, controller, path_of, run

SHAPES = ["constant", "widening", "narrowing", "pinched", "asymmetric"]
TRUTHS = [Truth(), Truth(0.9, 0.8), Truth(1.1, 1.2), Truth(0.9, 1.2), Truth(1.0, 1.0, 2), Truth(0.9, 0.8, 2)]


def worst(shape: str, xi: float, factor: float, count: int, seed: int = 0) -> float:
    walking, rng = controller(shape), np.random.default_rng(seed)
    guide, scale = walking.choice(xi)
    promise = walking.certificate(xi).promise
    assert promise is not None
    pair, box = factor * np.array([promise.hip, promise.knee]), AirwalkConfig().hand_over
    largest = 0.0
    for truth in TRUTHS:
        for pushes, mode in attacks(guide, pair, rng, count):
            a, b, c, d, e, f = rng.choice([-1.0, 1.0], 6).tolist()
            corner = Start(
                (a * box.deviation, b * box.deviation),
                (c * box.rate, d * box.rate),
                (e * box.torque[0], f * box.torque[1]),
            )
            for start in (Start(), corner):
                guide.start_step(xi, start.deviation, start.rate, scale)
                ratio, _, _ = run(guide.tables, path_of(guide, start, walking.guided_blend), truth, pushes, mode)
                largest = max(largest, ratio)
    return largest


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("xi", [0.5, 0.75])
@pytest.mark.long
def test_joints_stay_inside_under_the_promised_torque(shape: str, xi: float):
    assert worst(shape, xi, 1.0, 1) <= 1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("xi", [0.0, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99])
def test_joints_stay_inside_under_the_promised_torque_at_every_factor(shape: str, xi: float):
    if controller(shape).certificate(xi).certified:
        assert 0.5 < worst(shape, xi, 1.0, 10, seed=1) <= 1.0


@pytest.mark.long
@pytest.mark.parametrize("shape", ["constant", "pinched"])
def test_push_of_twice_the_promise_leaves_a_narrow_guide(shape: str):
    assert worst(shape, 0.9, 2.0, 4) > 1.0
