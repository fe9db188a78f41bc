"""The limiter: nothing leaves outside the limits, and nothing inside them is touched."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from atalante_hal.limiter import Limiter
from atalante_hal.robot import load_robot

ROBOT = load_robot()
STEP = ROBOT.torque_rate_max * 1e-3


@given(st.lists(arrays(np.float64, 12, elements=st.floats(width=64)), min_size=1, max_size=20))
def test_nothing_leaves_above_torque_or_rate_limit(commands: list[np.ndarray]):
    limiter = Limiter(ROBOT, 1e-3)
    before = limiter.last.copy()
    for command in commands:
        result = limiter.apply(command)
        assert result.finite == np.isfinite(command).all()
        assert (np.abs(limiter.last) <= ROBOT.torque_max).all()
        assert (np.abs(limiter.last - before) <= STEP * (1 + 1e-12)).all()
        if not result.finite:
            assert np.array_equal(limiter.last, before)
        before = limiter.last.copy()


def test_a_command_inside_the_limits_keeps_its_bits():
    limiter = Limiter(ROBOT, 1e-3)
    rng = np.random.default_rng(0)
    torque = np.zeros(12)
    for _ in range(1000):
        torque = np.clip(torque + rng.uniform(-0.9, 0.9, 12) * STEP, -ROBOT.torque_max, ROBOT.torque_max)
        result = limiter.apply(torque)
        assert limiter.last.tobytes() == torque.tobytes()
        assert not result.clamped


def test_cutting_is_reported():
    limiter = Limiter(ROBOT, 1e-3)
    assert limiter.apply(np.full(12, 1e4)).clamped
    assert np.allclose(limiter.last, np.minimum(STEP, ROBOT.torque_max))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_bad_number_spoils_the_whole_command(bad: float):
    limiter = Limiter(ROBOT, 1e-3)
    for joint in range(12):
        torque = np.zeros(12)
        torque[joint] = bad
        assert not limiter.apply(torque).finite


def test_restart_counts_from_the_drives_own_torque_within_the_limits():
    limiter = Limiter(ROBOT, 1e-3)
    limiter.restart(np.full(12, 40.0))
    assert limiter.apply(np.full(12, 41.0)).clamped is False
    limiter.restart(np.array([np.nan, np.inf, *np.full(10, -1e6)]))
    assert (np.abs(limiter.last) <= ROBOT.torque_max).all()
