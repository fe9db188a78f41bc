"""Lean of the trunk and motion of the swing foot: dead zone, limits, symmetry, and the filter of the lean."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.structured import zeros
from atalante_control.walking.lean import Lean, LeanConfig, follow_lean, lean_target, leg_target
from atalante_hal.types import PERIOD

CONFIG = LeanConfig()
METRES = st.floats(-0.3, 0.3)


@given(st.floats(-CONFIG.dead_zone, CONFIG.dead_zone), METRES)
def test_small_error_causes_no_lean(error: float, dcm: float) -> None:
    assert lean_target(CONFIG, error, dcm, 1.0) == 0.0


@given(METRES, METRES)
def test_lean_over_the_right_foot_mirrors_that_over_the_left_foot(error: float, dcm: float) -> None:
    assert lean_target(CONFIG, error, dcm, 1.0) == -lean_target(CONFIG, -error, -dcm, -1.0)


@given(METRES, METRES)
def test_lean_stays_within_its_limits(error: float, dcm: float) -> None:
    assert -CONFIG.outward <= lean_target(CONFIG, error, dcm, 1.0) <= CONFIG.inward


def test_trunk_leans_over_the_stance_foot_while_the_dcm_is_beyond_it() -> None:
    assert lean_target(CONFIG, -0.03, -0.02, 1.0) == pytest.approx(-CONFIG.gain * 0.01)
    assert lean_target(CONFIG, -0.2, -0.1, 1.0) == -CONFIG.outward


def test_lean_ends_when_the_dcm_is_inside_the_stance_foot() -> None:
    assert lean_target(CONFIG, -0.06, CONFIG.inside - 0.01, 1.0) == pytest.approx(-CONFIG.gain * 0.01)
    assert lean_target(CONFIG, -0.06, CONFIG.inside, 1.0) == 0.0


def test_trunk_leans_less_to_the_side_of_the_swing_foot() -> None:
    assert lean_target(CONFIG, 0.025, 0.08, 1.0) == pytest.approx(CONFIG.gain * 0.005)
    assert lean_target(CONFIG, 0.2, 0.2, 1.0) == CONFIG.inward < CONFIG.outward


def test_lean_rises_faster_than_it_falls_and_its_acceleration_is_limited() -> None:
    lean, angles, speeds = zeros(Lean, 1)[0], [0.0], [0.0]
    for target in [0.2] * 1000 + [0.0] * 3000:
        follow_lean(CONFIG, lean, target)
        angles.append(float(lean.angle))
        speeds.append(float(lean.speed))
    changes = [abs(after - before) / PERIOD for before, after in pairwise(speeds)]
    assert max(changes) <= CONFIG.acceleration + 1e-6
    assert angles[1000] == pytest.approx(0.2, abs=1e-3)
    assert angles[-1] == pytest.approx(0.0, abs=1e-3)
    assert max(angles) < 0.2 + 1e-3
    assert max(speeds) > -1.5 * min(speeds)


@given(st.floats(-CONFIG.leg_zone, 0.3))
def test_swing_foot_stays_while_the_dcm_is_over_the_sole_or_inwards_of_it(dcm: float) -> None:
    assert leg_target(CONFIG, dcm, 1.0) == 0.0 == leg_target(CONFIG, -dcm, -1.0)


def test_swing_foot_moves_away_from_the_stance_foot_up_to_its_limit() -> None:
    assert leg_target(CONFIG, -CONFIG.leg_zone - 0.01, 1.0) == pytest.approx(0.01 * CONFIG.leg_gain)
    assert leg_target(CONFIG, CONFIG.leg_zone + 0.01, -1.0) == pytest.approx(-0.01 * CONFIG.leg_gain)
    assert leg_target(CONFIG, -0.3, 1.0) == CONFIG.leg == -leg_target(CONFIG, 0.3, -1.0)
