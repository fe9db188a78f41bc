"""Telemetry of the airwalk controller: each value is in its field, and the statistics of the guide are correct."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.airwalk.telemetry import AirwalkStatistics, Step, Telemetry, write_telemetry
from atalante_control.guide.kernel import Guard
from atalante_control.structured import zeros

ROW = np.arange(24.0)


def write_one_row(
    errors: tuple[float, float], active: float = 0.1, *, assisted: bool = True
) -> tuple[np.ndarray, tuple[object, ...]]:
    guards, telemetry, step = zeros(Guard, 1), zeros(Telemetry, 1), zeros(Step, 1)
    guards["bounds"] = 0.1, 0.05, 0.2, 0.08
    guards["h"], guards["gate"] = -0.2, 0.4
    step["stance"], step["completed"], step["cycles"], step["xi"], step["active"] = 1, 3, 800, 0.5, active
    step["assisted"] = assisted
    ratios = write_telemetry(telemetry, step[0], guards[0], 200, ROW, errors)
    return telemetry[0], ratios


def test_every_value_is_written_to_its_field():
    telemetry, _ = write_one_row((0.02, -0.01))
    expected = {
        "q_des": ROW[:12], "error": (0.02, -0.01), "q_bound": (0.1, 0.08), "guide": (0.1, 0.05), "h": (-0.2, -0.2),
        "gate": (0.4, 0.4), "filter_active": (1.0, 1.0), "step": 3.0, "phase": 0.25, "stance": 1.0,
        "assistance_factor": 0.5,
    }  # fmt: skip
    assert tuple(expected) == telemetry.dtype.names
    for name, value in expected.items():
        np.testing.assert_array_equal(telemetry[name], value)


def test_ratio_is_that_of_the_joint_closest_to_its_bound():
    assert write_one_row((0.02, -0.01))[1] == ((0.1, 0.08), pytest.approx(0.2), True)
    assert write_one_row((-0.03, 0.01))[1] == ((0.05, 0.2), pytest.approx(0.6), True)
    assert write_one_row((0.0, 0.0), active=0.4)[1] == ((0.05, 0.08), 0.0, False)


def test_guide_is_not_active_in_a_step_without_guide():
    telemetry, (_, _, active) = write_one_row((0.02, -0.01), assisted=False)
    assert not active
    assert not telemetry["filter_active"].any()


def test_statistics_begin_with_the_first_completed_step():
    statistics = AirwalkStatistics()
    statistics.count(0, 5.0, -3.0, True)
    assert statistics == AirwalkStatistics()
    assert (statistics.inside_fraction, statistics.active_fraction) == (0.0, 0.0)
    statistics.steps = 1
    for cycle, ratio, h, acting in (
        (0, 0.5, 0.75, False),
        (1, 1.0, 0.0, True),
        (2, 1.5, -1.25, True),
        (0, 0.1, 0.9, True),
    ):
        statistics.count(cycle, ratio, h, acting)
    assert statistics == AirwalkStatistics(steps=1, cycles=4, inside=3, active=3, max_ratio=1.5, min_h_at_start=0.75)
    assert (statistics.inside_fraction, statistics.active_fraction) == (0.75, 0.75)


def test_nan_ratio_does_not_count_as_inside():
    statistics = AirwalkStatistics(steps=1)
    statistics.count(1, math.nan, math.nan, False)
    assert statistics.inside == 0
