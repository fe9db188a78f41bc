"""Four emulated IMUs: compute attitude, angular rate and specific force from the motion of the links that have an IMU.

The specific force is the mean acceleration of the link over the last millisecond plus 9.81 m/s2 upwards, in the sensor frame.
The module also draws the noise and the bias of the IMUs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from atalante_emulator.bodies import LINK_STATE
from atalante_hal.compiled import compiled
from atalante_hal.types import GRAVITY, PERIOD, Vector


@dataclass(frozen=True)
class ImuParameters:
    """Noise, bias, attitude errors and temperature of the emulated IMUs.

    The sample rate is 1 kHz. Noise and bias apply to each axis. Each IMU has its own random bias and its own random heading
    drift. Both stay constant during a run.
    """

    gyro_noise: float = 3.9e-3  # gyroscope noise [rad/s rms]: 0.01 deg/s/sqrt(Hz) over a bandwidth of 500 Hz
    gyro_bias: float = 5.2e-5  # standard deviation of the gyroscope bias [rad/s]; equals 0.003 deg/s
    accel_noise: float = 0.05  # accelerometer noise [m/s2 rms]
    accel_bias: float = 0.02  # standard deviation of the accelerometer bias [m/s2]
    attitude_error: float = 0.0  # random error of the reported attitude about each world axis [rad rms]
    attitude_time: float = 10.0  # time constant with which the random attitude error changes [s]
    heading_drift: float = 0.0  # standard deviation of the heading drift rate of an IMU [rad/s]
    temperature: float = 32.0  # constant temperature of all IMUs [degC]


class ImuSignals(NamedTuple):
    """Values that the four IMUs report to the HAL in their state frames. Row i of each array belongs to IMU i."""

    quaternion: Vector  # quaternion wxyz that turns a vector from sensor axes into world axes, w >= 0, shape (4, 4)
    gyro: Vector  # angular velocity in sensor axes, shape (4, 3) [rad/s]
    accel: Vector  # acceleration plus 9.81 m/s2 upwards (specific force), in sensor axes, shape (4, 3) [m/s2]


def _sample(links: Vector, before: Vector, quaternion: Vector, gyro: Vector, accel: Vector) -> None:
    """Compute the signals of all IMUs.

    Args:
        links: attitude and velocities of the links, as in `Body.imu`, shape (4, 10).
        before: velocities of the previous sample, shape (4, 3) [m/s]; NaN before the first sample. Updated here.
        quaternion: output for the attitudes, as in `ImuSignals`.
        gyro: output for the angular rates, as in `ImuSignals`.
        accel: output for the specific forces, as in `ImuSignals`.
    """
    for i in range(len(links)):
        x, y, z, w, vx, vy, vz, wx, wy, wz = links[i]
        if math.isnan(before[i, 0]):
            before[i] = vx, vy, vz
        ax, ay, az = (vx - before[i, 0]) / PERIOD, (vy - before[i, 1]) / PERIOD, (vz - before[i, 2]) / PERIOD + GRAVITY
        before[i] = vx, vy, vz
        # r00 to r22 are the elements of the rotation matrix that turns a vector from world axes into sensor axes.
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


class AttitudeError:
    """Errors of the attitudes that the IMUs report.

    The error of an IMU is a small rotation vector in world axes, from the true attitude to the reported attitude.
    Each component is a Gauss-Markov process of first order. The heading also drifts at a constant rate, because no sensor of an
    IMU measures the heading.
    """

    def __init__(self, parameters: ImuParameters, count: int, interval: float, generator: np.random.Generator) -> None:
        """Draw the initial attitude error and the heading drift rate of each IMU.

        The drift starts at zero.

        Args:
            parameters: size and time constant of the errors.
            count: number of IMUs.
            interval: time between two calls of `draw` [s].
            generator: source of the random numbers.
        """
        self.active = bool(parameters.attitude_error or parameters.heading_drift)
        self._generator, self._interval = generator, interval
        self._keep = math.exp(-interval / parameters.attitude_time)
        self._new = parameters.attitude_error * math.sqrt(1.0 - self._keep**2)
        self._slow = generator.standard_normal((count, 3)) * parameters.attitude_error
        self._rate = generator.standard_normal(count) * parameters.heading_drift
        self._heading = np.zeros(count)
        self._next = self._slow.copy()
        self._last = self._next
        self._turn = compiled(_turn)
        if self.active:  # compile `_turn` now: compiling in the first cycle would delay this cycle by more than 1 ms
            self.apply(0.0, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))

    def draw(self) -> None:
        """Start an interval: draw the attitude errors that the IMUs have at the end of the interval.

        During the interval, `apply` interpolates linearly between the errors at its start and at its end.
        """
        self._slow = self._keep * self._slow + self._new * self._generator.standard_normal(self._slow.shape)
        self._heading += self._rate * self._interval
        self._last, self._next = self._next, self._slow.copy()
        self._next[:, 2] += self._heading

    def apply(self, share: float, quaternion: Vector) -> None:
        """Rotate the attitudes by the attitude errors.

        Args:
            share: elapsed share of the current interval, 0 to 1.
            quaternion: attitudes wxyz, shape (count, 4). Updated here, with w >= 0.
        """
        self._turn(share, self._last, self._next, quaternion)


def _turn(share: float, last: Vector, following: Vector, quaternion: Vector) -> None:
    """Turn each attitude by a small rotation vector.

    The rotation vector is `last` at the start of an interval and `following` at its end, with linear interpolation between.

    Args:
        share: elapsed share of the interval, 0 to 1.
        last: rotation vectors at the start of the interval, in world axes, shape (count, 3) [rad].
        following: rotation vectors at the end of the interval, shape (count, 3) [rad].
        quaternion: attitudes wxyz, shape (count, 4). Updated here, with w >= 0.
    """
    for row in range(len(quaternion)):
        x = 0.5 * (last[row, 0] + share * (following[row, 0] - last[row, 0]))
        y = 0.5 * (last[row, 1] + share * (following[row, 1] - last[row, 1]))
        z = 0.5 * (last[row, 2] + share * (following[row, 2] - last[row, 2]))
        w, i, j, k = quaternion[row, 0], quaternion[row, 1], quaternion[row, 2], quaternion[row, 3]
        a, b = w - x * i - y * j - z * k, i + x * w + y * k - z * j
        c, d = j + y * w + z * i - x * k, k + z * w + x * j - y * i
        norm = math.copysign(math.sqrt(a * a + b * b + c * c + d * d), a)
        quaternion[row, 0], quaternion[row, 1] = a / norm, b / norm
        quaternion[row, 2], quaternion[row, 3] = c / norm, d / norm


class Imus:
    """Emulated IMUs of the robot. Row i of the signals belongs to IMU i of `robot.IMUS`."""

    def __init__(self, parameters: ImuParameters, signals: ImuSignals) -> None:
        self._parameters, self._signals = parameters, signals
        self._count = len(signals.quaternion)
        self._before = np.zeros((self._count, 3))
        self._sample = compiled(_sample)
        # Compile `_sample` now. A compilation in the first cycle would delay this cycle by more than 1 ms.
        self.sample(np.zeros((self._count, LINK_STATE)))
        self._before.fill(math.nan)

    def sample(self, links: Vector) -> None:
        """Sample all IMUs. The caller must call this method once in each cycle of 1 ms (`PERIOD`).

        Args:
            links: attitude and velocities of each IMU after the last time step, as in `Body.imu`, shape (4, 10).
        """
        self._sample(links, self._before, *self._signals)

    def attitude_error(self, interval: float, generator: np.random.Generator) -> AttitudeError:
        """Create the attitude errors of the IMUs.

        Args:
            interval: time between two calls of `AttitudeError.draw` [s].
            generator: source of the random numbers.
        """
        return AttitudeError(self._parameters, self._count, interval, generator)

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
        """Draw the noise of gyroscopes and accelerometers for many cycles, and add the constant bias of each axis.

        Args:
            generator: source of the random numbers.
            bias: gyroscope and accelerometer biases from `draw_bias`.
            gyro: output for noise plus bias of the gyroscopes, shape (cycles, 12) [rad/s], in signal order.
            accel: output for noise plus bias of the accelerometers, shape (cycles, 12) [m/s2], in signal order.
        """
        parameters = self._parameters
        for out, scale, offset in ((gyro, parameters.gyro_noise, bias[0]), (accel, parameters.accel_noise, bias[1])):
            np.multiply(generator.standard_normal(out.shape), scale, out=out)
            np.add(out, offset, out=out)
