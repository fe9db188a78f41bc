"""Tests of the Kalman filter of the heading."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.walking.heading import HeadingConfig, HeadingFilter
from atalante_hal.types import PERIOD

CONFIG = HeadingConfig()
SECONDS = 300


def heading_errors(generator: np.random.Generator, followed: bool) -> tuple[float, float]:
    """Return the final heading error [rad], and its integral [rad s], after a simulated walk with the errors of `CONFIG`."""
    time = CONFIG.interval * PERIOD
    filter_, error, total = HeadingFilter(CONFIG), 0.0, 0.0
    bias, reference = CONFIG.gyro_bias * generator.normal(), CONFIG.reference * generator.normal()
    start, keep = reference, math.exp(-time / CONFIG.reference_time)
    for _ in range(round(SECONDS / time)):
        error += bias * time + CONFIG.gyro_noise * math.sqrt(time) * generator.normal()
        reference = keep * reference + CONFIG.reference * math.sqrt(1.0 - keep**2) * generator.normal()
        for _ in range(CONFIG.interval if followed else 0):
            error += filter_.correction(reference - start, error)
        total += error * time
    return error, total


@pytest.mark.long
def test_the_heading_is_more_exact_than_gyro_and_reference_alone() -> None:
    """The position error of a walk is the integral of the heading error times the speed."""
    follow, drift = (
        np.array([heading_errors(np.random.default_rng(seed), followed) for seed in range(40)])
        for followed in (True, False)
    )
    assert follow[:, 0].std() < CONFIG.reference
    assert follow[:, 0].std() < 0.3 * drift[:, 0].std()
    # A heading that follows the reference at once has the error of the reference at the start during the whole walk.
    assert follow[:, 1].std() < 0.8 * CONFIG.reference * SECONDS
    assert follow[:, 1].std() < 0.4 * drift[:, 1].std()


def test_a_reset_forgets_the_estimated_bias() -> None:
    filter_ = HeadingFilter(CONFIG)
    first = [filter_.correction(0.01, 0.0) for _ in range(1000)]
    assert sum(map(bool, first)) == 10
    filter_.reset()
    assert [filter_.correction(0.01, 0.0) for _ in range(1000)] == first


def test_a_disturbed_reference_is_not_followed() -> None:
    """Iron near the magnetometer turns the measured heading by 20 degrees for 20 s. The bias of the gyro is estimated before."""
    filter_, heading, bias = HeadingFilter(CONFIG), 0.0, 0.5 * CONFIG.gyro_bias
    headings = []
    for second in range(240):
        disturbance = math.radians(20.0) if 100 <= second < 120 else 0.0
        for _ in range(round(1.0 / PERIOD)):
            heading += bias * PERIOD
            heading += filter_.correction(disturbance, heading)
        headings.append(heading)
    assert abs(headings[119] - headings[99]) < bias * 20.0
    assert abs(headings[-1]) < 0.25 * bias * 240.0
