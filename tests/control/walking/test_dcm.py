"""Ankle stabiliser: decay of the DCM error, and statics of the foot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.dcm import Stabiliser, ankle_torques, dcm, pressure_shift, within_sole

EXOSKELETON = ExoskeletonParameters()
HENKE = np.array(EXOSKELETON.ha_axis) / np.linalg.norm(EXOSKELETON.ha_axis)
STABILISER = Stabiliser(2.5, 0.12, 0.05, float(HENKE[0]), EXOSKELETON.toe_out, -0.07, 0.19)


def test_dcm_is_position_plus_speed_over_frequency_in_walking_axes() -> None:
    assert dcm((0.1, 0.0, 0.9), (0.3, 0.0, 0.0), 0.0, 3.0) == pytest.approx((0.2, 0.0))
    assert dcm((0.0, 0.1, 0.9), (0.0, 0.3, 0.0), math.pi / 2, 3.0) == pytest.approx((0.2, 0.0))


def test_error_of_a_pendulum_decays_under_the_shift() -> None:
    frequency, error = 3.3, np.array([0.03, -0.01])
    for _ in range(1000):
        error = error + 1e-3 * frequency * (error - np.array(pressure_shift(STABILISER, error)))
    assert np.abs(error).max() < 3e-4


def test_shift_is_limited_to_the_sole() -> None:
    assert pressure_shift(STABILISER, np.array([1.0, -1.0])) == (0.12, -0.05)


@pytest.mark.parametrize("side", [0, 1])
def test_ankle_torques_balance_the_shifted_ground_force(side: int) -> None:
    shift, force = np.array([0.05, 0.02]), 1500.0
    sagittal, henke = ankle_torques(STABILISER, shift, force, side)
    yaw = -EXOSKELETON.toe_out if side else EXOSKELETON.toe_out
    c, s = math.cos(yaw), math.sin(yaw)
    point = np.array([c * shift[0] + s * shift[1], c * shift[1] - s * shift[0], 0.0])
    ground = np.cross(point, [0.0, 0.0, force])
    # The torque about a joint axis balances the component of the ground moment about this axis.
    assert sagittal == pytest.approx(-ground[1])
    assert henke == pytest.approx(-ground @ HENKE)


def test_foot_without_load_gets_no_torque() -> None:
    assert ankle_torques(STABILISER, np.array([0.1, 0.05]), -20.0, 0) == (0.0, 0.0)


@pytest.mark.parametrize(("torque", "edge"), [(-300.0, STABILISER.heel), (600.0, STABILISER.toe)])
def test_ankle_torque_keeps_the_centre_of_pressure_within_the_sole(torque: float, edge: float) -> None:
    limits = [within_sole(STABILISER, torque, load) for load in (0.0, 1500.0)]
    assert limits[1] - limits[0] == pytest.approx(1500.0 * edge)
    assert within_sole(STABILISER, torque, -20.0) == limits[0]
    assert within_sole(STABILISER, 0.5 * limits[1], 1500.0) == 0.5 * limits[1]


@pytest.mark.parametrize("edge", [-0.001, 0.11, math.nan])
def test_invalid_distance_from_the_edge_is_rejected(edge: float) -> None:
    with pytest.raises(ValueError, match=r"edge must be from 0 to 0\.1 m, got"):
        WalkConfig(edge=edge)
