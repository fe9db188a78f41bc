"""The four IMUs: attitude, angular rate and specific force of the links they sit on, with noise and bias.

Acceleration is the difference of the link's velocity over the last millisecond plus gravity, turned into the sensor: it agrees
with the motion and needs no model. Three- and four-vectors are scalar Python: faster than arrays of that size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import GRAVITY, PERIOD, LinkState

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ImuParameters:
    """Noise of the emulated IMUs, each axis, at 1 kHz."""

    gyro_noise: float = 3.9e-3  # rad/s rms: 0.01 deg/s/sqrt(Hz) over 500 Hz
    gyro_bias: float = 5.2e-5  # rad/s rms over devices: 0.003 deg/s
    accel_noise: float = 0.05  # m/s2 rms
    accel_bias: float = 0.02  # m/s2 rms over devices
    temperature: float = 32.0  # degC


class ImuSignals(NamedTuple):
    """What the state frames will say: rewritten by `Imus.sample`."""

    quaternion: Vector  # (4, 4) wxyz, sensor to world, w >= 0
    gyro: Vector  # (4, 3) rad/s
    accel: Vector  # (4, 3) m/s2, specific force: +g upwards at rest


_FOUR = Struct("4d").pack_into
_THREE = Struct("3d").pack_into


class Imus:
    """The IMUs of a body; row i of the signals is IMU i of `robot.IMUS`."""

    def __init__(self, parameters: ImuParameters, signals: ImuSignals) -> None:
        self._parameters = parameters
        self._count = len(signals.quaternion)
        self._rows = [tuple(signal[imu].data for signal in signals) for imu in range(self._count)]
        self._velocity: list[Sequence[float] | None] = [None] * self._count
        self._seen: list[LinkState | None] = [None] * self._count

    def sample(self, links: Sequence[LinkState]) -> None:
        """Read the sensors; call once a `PERIOD`.

        Args:
            links: world pose and velocity of each IMU, after the step just made.
        """
        for imu, link in enumerate(links):
            # The same object again is a link that the body never moves.
            if link is not self._seen[imu]:
                self._sample_one(imu, link)

    def _sample_one(self, imu: int, link: LinkState) -> None:
        _, (x, y, z, w), (vx, vy, vz), (wx, wy, wz) = link
        before = self._velocity[imu]
        if before is None:
            ax, ay, az = 0.0, 0.0, GRAVITY
        else:
            bx, by, bz = before
            ax, ay, az = (vx - bx) / PERIOD, (vy - by) / PERIOD, (vz - bz) / PERIOD + GRAVITY
        # Rows of the matrix that turns world vectors into the sensor.
        x2, y2, z2 = x + x, y + y, z + z
        xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
        xw, yw, zw = w * x2, w * y2, w * z2
        r00, r01, r02 = 1.0 - yy - zz, xy + zw, xz - yw
        r10, r11, r12 = xy - zw, 1.0 - xx - zz, yz + xw
        r20, r21, r22 = xz + yw, yz - xw, 1.0 - xx - yy
        quaternion, gyro, accel = self._rows[imu]
        if w < 0.0:
            w, x, y, z = -w, -x, -y, -z
        _FOUR(quaternion, 0, w, x, y, z)
        _THREE(
            gyro,
            0,
            r00 * wx + r01 * wy + r02 * wz,
            r10 * wx + r11 * wy + r12 * wz,
            r20 * wx + r21 * wy + r22 * wz,
        )
        _THREE(
            accel,
            0,
            r00 * ax + r01 * ay + r02 * az,
            r10 * ax + r11 * ay + r12 * az,
            r20 * ax + r21 * ay + r22 * az,
        )
        self._velocity[imu] = link[2]
        self._seen[imu] = link

    def draw_bias(self, generator: np.random.Generator) -> tuple[Vector, Vector]:
        """Constant errors of these devices: of gyro and accelerometer. Shapes (12,) [rad/s], (12,) [m/s2]."""
        gyro, accel = generator.standard_normal((2, 3 * self._count))
        return gyro * self._parameters.gyro_bias, accel * self._parameters.accel_bias

    def draw_noise(
        self, generator: np.random.Generator, bias: tuple[Vector, Vector], gyro: Vector, accel: Vector
    ) -> None:
        """Noise and bias of many cycles. Shapes (cycles, 12) [rad/s] and (cycles, 12) [m/s2], signal order."""
        parameters = self._parameters
        for out, scale, offset in ((gyro, parameters.gyro_noise, bias[0]), (accel, parameters.accel_noise, bias[1])):
            np.multiply(generator.standard_normal(out.shape), scale, out=out)
            np.add(out, offset, out=out)
