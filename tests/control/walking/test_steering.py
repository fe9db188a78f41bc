"""Steering by the soles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.walking.config import WalkConfig
from atalante_control.walking.steering import Steering

GAINS = 0.5, 0.15, math.radians(3.0)
STRAIGHT = np.zeros(2)


def walk(steering: Steering, steps: int, heading: float) -> None:
    """Land alternately with steps of 0.16 m along a heading, left foot first."""
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-math.sin(heading), math.cos(heading)])
    for step in range(steps):
        side = step % 2
        to_right = (0.16 if side else -0.16) * forward - 0.2 * left
        steering.land(side, np.array([*to_right, 0.0]), np.full(2, heading))


def test_straight_walk_needs_no_steering() -> None:
    steering = Steering(GAINS)
    steering.begin(np.array([0.0, -0.2, 0.0]), STRAIGHT)
    walk(steering, 10, 0.0)
    assert steering.lateral == pytest.approx(0.0, abs=1e-12)
    assert steering.distance == pytest.approx(0.8 + 0.72)
    assert steering.offset() == pytest.approx(0.0, abs=1e-12)


def test_line_has_the_heading_of_the_start() -> None:
    steering, heading = Steering(GAINS), 0.3
    steering.begin(0.2 * np.array([math.sin(heading), -math.cos(heading), 0.0]), np.full(2, heading))
    walk(steering, 10, heading)
    assert steering.lateral == pytest.approx(0.0, abs=1e-12)
    assert steering.yaw == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("heading", [0.02, -0.02])
def test_offset_turns_back_towards_the_line(heading: float) -> None:
    steering = Steering(GAINS)
    steering.begin(np.array([0.0, -0.2, 0.0]), STRAIGHT)
    walk(steering, 6, heading)
    assert steering.lateral * heading > 0.0
    assert steering.offset() * heading < 0.0


def test_offset_is_limited() -> None:
    steering = Steering(GAINS)
    steering.begin(np.array([0.0, -0.2, 0.0]), STRAIGHT)
    walk(steering, 2, 1.0)
    assert steering.offset() == -GAINS[2]


@pytest.mark.parametrize("turn", [0.05, -0.03])
def test_turn_of_the_line_keeps_the_deviation_and_rotates_the_feet(turn: float) -> None:
    steering, straight = Steering(GAINS, turn), Steering(GAINS)
    step, headings = np.array([0.16, -0.2, 0.0]), np.zeros(2)
    for each in (steering, straight):
        each.begin(step, headings)
        each.land(0, -step, headings)
    lateral, distance = steering.lateral, steering.distance
    steering.turn()
    assert steering.lateral == pytest.approx(lateral, abs=1e-12)
    assert steering.distance == pytest.approx(distance, abs=1e-12)
    assert steering.yaw == pytest.approx(-turn)
    between = steering.feet[1] - steering.feet[0]
    assert math.atan2(between[1], between[0]) == pytest.approx(
        math.atan2(*(straight.feet[1] - straight.feet[0])[::-1]) - turn, abs=1e-12
    )
    # Both soles are parallel. In a steady turn, their mean heading would be half a turn behind.
    expected = turn - GAINS[0] * 0.5 * turn - GAINS[1] * lateral
    limit = GAINS[2] + abs(turn)
    assert steering.offset() == pytest.approx(min(max(expected, -limit), limit), abs=1e-12)


@pytest.mark.parametrize("turn", [0.053, -0.053, 0.1, math.nan])
def test_turn_beyond_the_limit_is_rejected(turn: float) -> None:
    with pytest.raises(ValueError, match=r"turn must be from -0\.0524 to 0\.0524 rad, got"):
        WalkConfig(turn=turn)
