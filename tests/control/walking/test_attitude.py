"""Attitude observer on simulated motions of an IMU."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest

from atalante_control.walking.attitude import AttitudeObserver
from atalante_control.walking.heading import HeadingConfig
from atalante_control.walking.rotation import rotation_of, tilt_quaternion

GRAVITY = np.array([0.0, 0.0, -9.81])


def tilt_error(estimate: np.ndarray, rotation: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, float(estimate[2] @ rotation[2]))))


def sway(observer: AttitudeObserver, seconds: float, bias: float = 0.0, velocity_error: float = 0.0) -> list[float]:
    """Sway about a sole and return the errors of the tilt [deg]."""
    errors, lever, before = [], np.array([0.05, 0.02, 1.1]), np.zeros(3)
    for cycle in range(round(seconds * 1000)):
        t = cycle * 1e-3
        angles = np.array([0.06 * math.sin(4.0 * t), 0.05 * math.sin(8.0 * t + 1.0), 0.1 * math.sin(4.0 * t)])
        rotation = pinocchio.rpy.rpyToMatrix(angles)
        after = pinocchio.rpy.rpyToMatrix(
            np.array(
                [0.06 * math.sin(4.0 * t + 4e-3), 0.05 * math.sin(8.0 * t + 1.008), 0.1 * math.sin(4.0 * t + 4e-3)]
            )
        )
        gyro = pinocchio.log3(rotation.T @ after) * 1000.0
        velocity = rotation @ np.cross(gyro, lever)
        accel = rotation.T @ ((velocity - before) * 1000.0 * (cycle > 0) - GRAVITY)
        before = velocity
        observer.update(gyro + bias, accel, tuple(rotation.T @ velocity + velocity_error))
        errors.append(tilt_error(observer.rotation, after))
    return errors


def test_attitude_of_swaying_robot_converges() -> None:
    observer = AttitudeObserver()
    observer.reset((1.0, 0.0, 0.0, 0.0))
    assert max(sway(observer, 10.0)[6000:]) < 0.02


def test_wrong_initial_attitude_decays() -> None:
    observer = AttitudeObserver()
    observer.reset((math.cos(0.05), math.sin(0.05), 0.0, 0.0))
    errors = sway(observer, 6.0)
    assert errors[0] > 3.0
    assert max(errors[5000:]) < 0.05


def test_gyro_bias_causes_only_a_small_tilt() -> None:
    observer = AttitudeObserver()
    observer.reset((1.0, 0.0, 0.0, 0.0))
    assert max(sway(observer, 10.0, bias=math.radians(0.05))[5000:]) < 0.1


def test_reset_removes_the_heading_only() -> None:
    observer = AttitudeObserver()
    heading, tilt = (math.cos(0.4), 0.0, 0.0, math.sin(0.4)), (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
    x, y, z, w = pinocchio.Quaternion(rotation_of(heading) @ rotation_of(tilt)).coeffs().tolist()
    observer.reset((w, x, y, z))
    np.testing.assert_allclose(observer.rotation, rotation_of(tilt), atol=1e-12)


@pytest.mark.sample(4)
@pytest.mark.parametrize("start", [0.0, 3.0])
@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_a_heading_reference_stops_the_drift_of_the_heading(start: float, drift: float) -> None:
    """The gyro alone would turn the heading by 0.03 rad. The filter expects a smaller drift, so its correction is late."""
    observer, gyro = AttitudeObserver(), np.array([0.0, 0.0, drift])
    measured = (math.cos(0.5 * start), 0.0, 0.0, math.sin(0.5 * start))
    observer.reset(measured)
    for _ in range(300_000):
        observer.update(gyro, -GRAVITY, (0.0, 0.0, 0.0))
        observer.follow_heading(measured)
    assert 0.0 < math.copysign(1.0, drift) * math.atan2(observer.rotation[1, 0], observer.rotation[0, 0]) < 0.004
    np.testing.assert_allclose(observer.rotation @ observer.rotation.T, np.eye(3), atol=1e-5)


def test_a_heading_reference_turns_the_robot_on_the_short_way_and_keeps_the_tilt() -> None:
    observer = AttitudeObserver(
        heading=HeadingConfig(reference=1e-3, reference_time=1.0, gyro_noise=1.0, outlier=math.inf, interval=1)
    )
    tilt = (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
    observer.reset(tilt)
    turned = pinocchio.Quaternion(rotation_of((math.cos(1.6), 0.0, 0.0, math.sin(1.6))) @ rotation_of(tilt)).coeffs()
    x, y, z, w = turned.tolist()
    vertical = observer.rotation[2].copy()
    for _ in range(3000):
        observer.follow_heading((w, x, y, z))
    heading = math.atan2(observer.rotation[1, 0], observer.rotation[0, 0])
    assert heading == pytest.approx(3.2 - 2.0 * math.pi, abs=0.02)
    np.testing.assert_array_equal(observer.rotation[2], vertical)


def test_rotation_stays_orthogonal_for_minutes() -> None:
    observer, generator = AttitudeObserver(), np.random.default_rng(0)
    for _ in range(20_000):
        observer.update(generator.normal(0.0, 2.0, 3), generator.normal(0.0, 5.0, 3), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(observer.rotation @ observer.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("angles", [(0.2, -0.1, 0.0), (-0.5, 0.4, 1.2)])
def test_tilt_quaternion_has_the_vertical_of_the_attitude(angles: tuple[float, float, float]) -> None:
    rotation = pinocchio.rpy.rpyToMatrix(np.array(angles))
    quaternion = tilt_quaternion(rotation[2])
    assert math.hypot(*quaternion) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation_of(quaternion)[2], rotation[2], atol=1e-12)
