"""Four emulated IMUs: attitude, angular rate and specific force of the links that carry them, with noise and bias.

The acceleration is the change of the link velocity over the last millisecond plus gravity, rotated into the sensor frame. It
is consistent with the motion and needs no model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from atalante_emulator.body import GRAVITY, LINK_STATE
from atalante_hal.compiled import compiled
from atalante_hal.types import PERIOD, Vector


@dataclass(frozen=True)
class ImuParameters:
    """Noise, bias and temperature of the emulated IMUs, per axis at 1 kHz."""

    gyro_noise: float = 3.9e-3  # rad/s rms: 0.01 deg/s/sqrt(Hz) over 500 Hz
    gyro_bias: float = 5.2e-5  # rad/s rms over devices: 0.003 deg/s
    accel_noise: float = 0.05  # m/s2 rms
    accel_bias: float = 0.02  # m/s2 rms over devices
    temperature: float = 32.0  # degC


class ImuSignals(NamedTuple):
    """Signals of the IMUs' state frames; `Imus.sample` rewrites them."""

    quaternion: Vector  # (4, 4) wxyz, sensor to world, w >= 0
    gyro: Vector  # (4, 3) rad/s
    accel: Vector  # (4, 3) m/s2, specific force: +g upwards at rest


def _sample(links: Vector, before: Vector, quaternion: Vector, gyro: Vector, accel: Vector) -> None:
    """Compute the signals of all IMUs.

    Args:
        links: attitude and velocities of the links, as in `Body.imu`, shape (4, 10).
        before: velocities of the previous sample, shape (4, 3) [m/s]; NaN if there is none. Updated here.
        quaternion: receives the attitudes, as in `ImuSignals`.
        gyro: receives the angular rates, as in `ImuSignals`.
        accel: receives the specific forces, as in `ImuSignals`.
    """
    for i in range(len(links)):
        x, y, z, w, vx, vy, vz, wx, wy, wz = links[i]
        if math.isnan(before[i, 0]):
            before[i] = vx, vy, vz
        ax, ay, az = (vx - before[i, 0]) / PERIOD, (vy - before[i, 1]) / PERIOD, (vz - before[i, 2]) / PERIOD + GRAVITY
        before[i] = vx, vy, vz
        # Rows of the matrix that rotates world vectors into the sensor frame.
        x2, y2, z2 = x + x, y + y, z + z
        xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
        xw, yw, zw = w * x2, w * y2, w * z2
        r00, r01, r02 = 1.0 - yy - zz, xy + zw, xz - yw
        r10, r11, r12 = xy - zw, 1.0 - xx - zz, yz + xw
        r20, r21, r22 = xz + yw, yz - xw, 1.0 - xx - yy
        sign = -1.0 if w < 0.0 else 1.0
        quaternion[i] = sign * w, sign * x, sign * y, sign * z
        gyro[i] = r00 * wx + r01 * wy + r02 * wz, r10 * wx + r11 * wy + r12 * wz, r20 * wx + r21 * wy + r22 * wz
        accel[i] = r00 * ax + r01 * ay + r02 * az, r10 * ax + r11 * ay + r12 * az, r20 * ax + r21 * ay + r22 * az


class Imus:
    """IMUs of a body; row i of the signals belongs to IMU i of `robot.IMUS`."""

    def __init__(self, parameters: ImuParameters, signals: ImuSignals) -> None:
        self._parameters, self._signals = parameters, signals
        self._count = len(signals.quaternion)
        self._before = np.zeros((self._count, 3))
        self._sample = compiled(_sample)
        # The first call compiles the kernel, which would be too slow within a cycle.
        self.sample(np.zeros((self._count, LINK_STATE)))
        self._before.fill(math.nan)

    def sample(self, links: Vector) -> None:
        """Read the sensors; call once per `PERIOD`.

        Args:
            links: attitude and velocities of each IMU after the last step, as in `Body.imu`, shape (4, 10).
        """
        self._sample(links, self._before, *self._signals)

    def draw_bias(self, generator: np.random.Generator) -> tuple[Vector, Vector]:
        """Draw the constant biases of the devices.

        Args:
            generator: source of the random numbers.

        Returns:
            Gyroscope biases, shape (12,) [rad/s], and accelerometer biases, shape (12,) [m/s2].
        """
        gyro, accel = generator.standard_normal((2, 3 * self._count))
        return gyro * self._parameters.gyro_bias, accel * self._parameters.accel_bias

    def draw_noise(
        self, generator: np.random.Generator, bias: tuple[Vector, Vector], gyro: Vector, accel: Vector
    ) -> None:
        """Draw the noise of many cycles and add the bias.

        Args:
            generator: source of the random numbers.
            bias: gyroscope and accelerometer biases from `draw_bias`.
            gyro: receives the gyroscope errors, shape (cycles, 12) [rad/s], in signal order.
            accel: receives the accelerometer errors, shape (cycles, 12) [m/s2], in signal order.
        """
        parameters = self._parameters
        for out, scale, offset in ((gyro, parameters.gyro_noise, bias[0]), (accel, parameters.accel_noise, bias[1])):
            np.multiply(generator.standard_normal(out.shape), scale, out=out)
            np.add(out, offset, out=out)
