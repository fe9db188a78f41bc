from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest

from atalante_control.model import imu_link, pinocchio_model
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_hal.robot import IMUS
from atalante_hal.types import GRAVITY, PERIOD


def signals() -> ImuSignals:
    return ImuSignals(np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((4, 3)))


def links(
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
    velocity: tuple[float, ...] = (0.0,) * 3,
    rate: tuple[float, ...] = (0.0,) * 3,
) -> np.ndarray:
    """Return the link states of four links with the same motion: quaternion xyzw, velocity [m/s], rate [rad/s], shape (4, 10)."""
    return np.tile([*rotation, *velocity, *rate], (4, 1))


def test_specific_force_at_rest_points_up() -> None:
    out = signals()
    Imus(ImuParameters(), out).sample(links())
    assert out.quaternion.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 4
    assert not out.gyro.any()
    assert out.accel.tolist() == [[0.0, 0.0, GRAVITY]] * 4


def test_gravity_is_measured_in_sensor_axes() -> None:
    """If the sensor is pitched by +30 degrees (nose down), its x axis points 30 degrees below the horizon."""
    out = signals()
    half = math.radians(15.0)
    Imus(ImuParameters(), out).sample(links((0.0, math.sin(half), 0.0, math.cos(half))))
    np.testing.assert_allclose(out.accel[0], [-0.5 * GRAVITY, 0.0, math.sqrt(0.75) * GRAVITY])


def test_scalar_part_of_the_quaternion_is_not_negative() -> None:
    out = signals()
    half = math.radians(20.0)
    Imus(ImuParameters(), out).sample(links((-math.sin(half), 0.0, 0.0, -math.cos(half))))
    np.testing.assert_allclose(out.quaternion[2], [math.cos(half), math.sin(half), 0.0, 0.0])


def test_rotating_sensor_measures_its_centripetal_acceleration() -> None:
    """A sensor that turns at rate w about a vertical axis at distance r measures r w^2 inwards, and the rate w."""
    out = signals()
    imus = Imus(ImuParameters(), out)
    radius, rate = 0.5, 2.0
    for step in range(20):
        angle = rate * step * PERIOD
        turned = 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)
        velocity = -radius * rate * math.sin(angle), radius * rate * math.cos(angle), 0.0
        imus.sample(links(turned, velocity, (0.0, 0.0, rate)))
    np.testing.assert_allclose(out.accel[1], [-radius * rate**2, 0.0, GRAVITY], atol=3e-3)
    np.testing.assert_allclose(out.gyro[1], [0.0, 0.0, rate], atol=1e-12)


def test_specific_force_in_free_fall_is_zero() -> None:
    out = signals()
    imus = Imus(ImuParameters(), out)
    for step in range(3):
        imus.sample(links((0.1, 0.2, 0.3, math.sqrt(0.86)), (0.0, 0.0, -GRAVITY * PERIOD * step)))
    np.testing.assert_allclose(out.accel, 0.0, atol=1e-12)


def test_signals_of_a_moving_robot_agree_with_pinocchio(urdf_text: str) -> None:
    model, q_index, v_index = pinocchio_model(urdf_text)
    data = model.createData()
    body, out = PyBulletBody(urdf_text), signals()
    imus = Imus(ImuParameters(), out)
    centre = np.array([0.0, 0.0, -0.3, 0.6, -0.1, 0.0] * 2)
    body.reset(centre.tolist())
    imus.sample(body.imu)
    errors = []
    for step in range(400):  # a leg swing as fast as in walking
        reference = centre + np.array([0, 0, 0.25, 0.3, 0, 0, 0, 0, -0.25, -0.3, 0, 0]) * np.sin(5.0 * step * PERIOD)
        torque = 400.0 * (reference - body.position) - 20.0 * body.velocity
        q, v, a = np.zeros((3, 12))
        before = body.velocity.copy()
        body.step(torque.tolist())
        imus.sample(body.imu)
        q[q_index], v[v_index] = body.position, body.velocity
        a[v_index] = (body.velocity - before) / PERIOD
        pinocchio.forwardKinematics(model, data, q, v, a)
        pinocchio.updateFramePlacements(model, data)
        for imu, name in enumerate(IMUS):
            frame = model.getFrameId(imu_link(name))
            rotation = data.oMf[frame].rotation
            motion = pinocchio.getFrameVelocity(model, data, frame, pinocchio.LOCAL)
            acceleration = pinocchio.getFrameClassicalAcceleration(model, data, frame, pinocchio.LOCAL).linear
            w, x, y, z = out.quaternion[imu]
            np.testing.assert_allclose(pinocchio.Quaternion(w, x, y, z).matrix(), rotation, atol=1e-6)
            np.testing.assert_allclose(out.gyro[imu], motion.angular, atol=1e-6)
            if step > 100:
                errors.append(np.abs(out.accel[imu] - acceleration - rotation.T @ [0.0, 0.0, GRAVITY]).max())
    body.close()
    assert body.velocity.max() > 0.5
    # The tolerance is larger, because the velocity difference over a millisecond is the acceleration half a millisecond ago.
    assert max(errors) < 0.02
    assert float(np.median(errors)) < 2e-3


def test_noise_and_bias_are_reproducible_and_have_the_configured_size() -> None:
    parameters = ImuParameters()
    imus = Imus(parameters, signals())

    def draw(seed: int) -> tuple[np.ndarray, np.ndarray]:
        generator = np.random.default_rng(seed)
        bias = imus.draw_bias(generator)
        gyro, accel = np.zeros((2, 4000, 12))
        imus.draw_noise(generator, bias, gyro, accel)
        np.testing.assert_allclose(accel.mean(axis=0), bias[1], atol=4 * parameters.accel_noise / math.sqrt(4000))
        np.testing.assert_allclose(gyro.mean(axis=0), bias[0], atol=4 * parameters.gyro_noise / math.sqrt(4000))
        assert np.abs(bias[1]).max() < 5 * parameters.accel_bias
        return gyro, accel

    gyro, accel = draw(7)
    np.testing.assert_allclose(gyro.std(axis=0), parameters.gyro_noise, rtol=0.1)
    np.testing.assert_allclose(accel.std(axis=0), parameters.accel_noise, rtol=0.1)
    again, _ = draw(7)
    other, _ = draw(8)
    assert gyro.tobytes() == again.tobytes() != other.tobytes()


@pytest.mark.parametrize("moved", range(4))
def test_each_imu_measures_only_its_own_link(moved: int) -> None:
    out = signals()
    imus = Imus(ImuParameters(), out)
    imus.sample(links())
    moving = links()
    moving[moved] = (0.0, 0.0, 0.0, 1.0, 0.001, 0.002, 0.003, 0.5, 0.6, 0.7)
    imus.sample(moving)
    assert out.gyro[moved].tolist() == [0.5, 0.6, 0.7]
    np.testing.assert_allclose(out.accel[moved], [1.0, 2.0, 3.0 + GRAVITY])
    assert not np.delete(out.gyro, moved, axis=0).any()
    assert (np.delete(out.accel, moved, axis=0) == [0.0, 0.0, GRAVITY]).all()


def test_first_sample_of_a_moving_link_has_no_acceleration() -> None:
    out = signals()
    Imus(ImuParameters(), out).sample(links(velocity=(1.0, -2.0, 0.5)))
    assert (out.accel == [0.0, 0.0, GRAVITY]).all()
