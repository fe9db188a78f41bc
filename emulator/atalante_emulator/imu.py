"""Four emulated IMUs: compute attitude, angular rate and specific force from the motion of their links.

The specific force is the change of the link velocity over the last millisecond plus gravity, in the sensor frame. The module
also draws the noise and the bias of the IMUs.
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
    """Noise, bias and temperature of the emulated IMUs. Noise and bias are given per axis. The sample rate is 1 kHz."""

    gyro_noise: float = 3.9e-3  # noise density 0.01 deg/s/sqrt(Hz) times the root of the bandwidth 500 Hz [rad/s rms]
    gyro_bias: float = 5.2e-5  # standard deviation of the bias over all devices [rad/s], equal to 0.003 deg/s
    accel_noise: float = 0.05  # noise [m/s2 rms]
    accel_bias: float = 0.02  # standard deviation of the bias over all devices [m/s2]
    temperature: float = 32.0  # constant temperature of all IMUs [degC]


class ImuSignals(NamedTuple):
    """Signals in the state frames of the IMUs. `Imus.sample` updates them."""

    quaternion: Vector  # attitude, wxyz from sensor to world with w >= 0, shape (4, 4)
    gyro: Vector  # angular rate in the sensor frame, shape (4, 3) [rad/s]
    accel: Vector  # specific force in the sensor frame, upwards at rest, shape (4, 3) [m/s2]


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
        # The matrix r rotates vectors from world axes into the sensor frame.
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
    """Emulated IMUs of the robot. Row i of the signals belongs to IMU i of `robot.IMUS`."""

    def __init__(self, parameters: ImuParameters, signals: ImuSignals) -> None:
        self._parameters, self._signals = parameters, signals
        self._count = len(signals.quaternion)
        self._before = np.zeros((self._count, 3))
        self._sample = compiled(_sample)
        # Compiles the kernel now, because compilation takes longer than a cycle.
        self.sample(np.zeros((self._count, LINK_STATE)))
        self._before.fill(math.nan)

    def sample(self, links: Vector) -> None:
        """Sample all IMUs. Must be called once per `PERIOD`.

        Args:
            links: attitude and velocities of each IMU after the last time step, as in `Body.imu`, shape (4, 10).
        """
        self._sample(links, self._before, *self._signals)

    def draw_bias(self, generator: np.random.Generator) -> tuple[Vector, Vector]:
        """Draw the constant biases of the IMUs.

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
        """Draw the noise of the IMUs for many cycles, and add their bias.

        Args:
            generator: source of the random numbers.
            bias: gyroscope and accelerometer biases from `draw_bias`.
            gyro: receives noise plus bias of the gyroscopes, shape (cycles, 12) [rad/s], in signal order.
            accel: receives noise plus bias of the accelerometers, shape (cycles, 12) [m/s2], in signal order.
        """
        parameters = self._parameters
        for out, scale, offset in ((gyro, parameters.gyro_noise, bias[0]), (accel, parameters.accel_noise, bias[1])):
            np.multiply(generator.standard_normal(out.shape), scale, out=out)
            np.add(out, offset, out=out)
