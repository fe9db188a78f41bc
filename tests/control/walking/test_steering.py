"""Steering by the soles."""

from __future__ import annotations

import math

import numpy as np
import pytest

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
