"""What the controller tells of a cycle: every piece in its place, and the statistics of the guide."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.airwalk.telemetry import AirwalkStatistics, Step, Telemetry, write_telemetry
from atalante_control.guide.kernel import Joint
from atalante_control.structured import zeros

ROW = np.arange(24.0)


def told(errors: tuple[float, float], active: float = 0.1) -> tuple[np.ndarray, tuple[object, ...]]:
    joints, telemetry, step = zeros(Joint, 2), zeros(Telemetry, 1), zeros(Step, 1)
    joints["upper"], joints["lower"] = 0.1, 0.05
    joints["h"], joints["gate"] = (0.7, -0.2), (0.1, 0.4)
    step["stance"], step["completed"], step["cycles"], step["xi"], step["active"] = 1, 3, 800, 0.5, active
    said = write_telemetry(telemetry, step[0], joints, 200, ROW, errors)
    return telemetry[0], said


def test_every_piece_is_in_its_place():
    telemetry, _ = told((0.02, -0.01))
    expected = {
        "q_des": ROW[:12], "error": (0.02, -0.01), "q_bound": (0.1, 0.05), "guide": (0.1, 0.05), "h": (0.7, -0.2),
        "gate": (0.1, 0.4), "filter_active": (0.0, 1.0), "step": 3.0, "phase": 0.25, "stance": 1.0,
        "assistance_factor": 0.5,
    }  # fmt: skip
    assert tuple(expected) == telemetry.dtype.names
    for name, value in expected.items():
        np.testing.assert_array_equal(telemetry[name], value)


def test_the_worse_joint_counts():
    assert told((0.02, -0.01))[1] == ((0.1, 0.05), pytest.approx(0.2), -0.2, True)
    assert told((-0.03, 0.01))[1] == ((0.05, 0.1), pytest.approx(0.6), -0.2, True)
    assert told((0.0, 0.0), active=0.4)[1] == ((0.05, 0.05), 0.0, -0.2, False)


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
    assert statistics == AirwalkStatistics(1, 4, 3, 3, 1.5, 0.75)
    assert (statistics.inside_fraction, statistics.active_fraction) == (0.75, 0.75)


def test_a_ratio_that_is_no_number_is_not_inside():
    statistics = AirwalkStatistics(steps=1)
    statistics.count(1, math.nan, math.nan, False)
    assert statistics.inside == 0
