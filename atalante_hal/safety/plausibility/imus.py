"""IMU checks, which detect quaternions without unit norm and readings at the end of the measuring range.

The module `legs` compares the IMUs with the encoders.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import IMU_NODES
from atalante_hal.robot import IMUS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.types import Vector
from atalante_hal.wire.codec import Codec

#: Time [cycles] without good values after which the diagnostic of the IMU is confirmed.
IMU_CYCLES = 10


class ImuLimits(NamedTuple):
    """Limits of the readings of an IMU. Readings outside these limits must not be used."""

    norm_error: float  # largest deviation of the squared norm of a quaternion from 1
    gyro_end: float  # smallest angular velocity at which a gyroscope is saturated [rad/s]
    accel_end: float  # smallest specific force at which an accelerometer is saturated [m/s2]


class Imus:
    """Checks of the four IMUs.

    Args:
        robot: sensor thresholds of the robot.
        codec: codec of the process image, source of the measuring ranges.
        now: signals decoded in this cycle.
    """

    def __init__(self, robot: Robot, codec: Codec, now: Signals) -> None:
        self._now = now
        gyro_end, accel_end = (_end_of_range(codec, signal) for signal in ("GyroX", "AccelX"))
        self.limits = ImuLimits(robot.sensors.quaternion_error, gyro_end, accel_end)
        #: Norm of each quaternion that does not have unit norm, by IMU index.
        self.no_attitude: dict[int, float] = {}
        #: Largest reading of each saturated IMU, by IMU index [rad/s or m/s2].
        self.saturated: dict[int, float] = {}
        self._confirmed: dict[int, bool] = {}
        #: Arguments of the function `usable`. The array objects are the same in every call.
        self._readings = now.quaternion, now.gyro, now.accel, self.limits
        self._usable = specialised(usable, *self._readings)

    def usable(self) -> bool:
        """Return whether every quaternion has unit norm and no IMU is saturated."""
        return self._usable(*self._readings)

    def accept(self, imu: int, cycles: int, *, frozen: bool) -> bool:
        """Check the new values of one IMU, and return whether the values may be used.

        Args:
            imu: index of the IMU in IMUS.
            cycles: time from the last good values of the IMU to the new values [cycles].
            frozen: True if the readings of the IMU do not change.
        """
        saturation, norm = self._saturation(imu), self._wrong_norm(imu)
        for value, found in ((saturation, self.saturated), (norm, self.no_attitude)):
            if value is None:
                found.pop(imu, None)
            else:
                found[imu] = value
        usable = not frozen and saturation is None and norm is None
        self._confirmed[imu] = not usable and cycles >= IMU_CYCLES
        return usable

    def tolerated(self, imu: int) -> Dtc | None:
        """Return why the values of an IMU were rejected, unless the fault is already confirmed.

        Args:
            imu: index of the IMU in IMUS.

        Returns:
            The pending diagnostic: `IMU_SATURATED` or `IMU_INVALID` (wrong norm of the quaternion). None if the diagnostic is
            confirmed, or if the values were rejected only because the readings do not change.
        """
        if self._confirmed[imu]:
            return None
        return Dtc.IMU_SATURATED if imu in self.saturated else Dtc.IMU_INVALID if imu in self.no_attitude else None

    def _saturation(self, imu: int) -> float | None:
        """Return the largest reading of a saturated IMU [rad/s or m/s2]; None if no axis is saturated."""
        for readings, end in ((self._now.gyro, self.limits.gyro_end), (self._now.accel, self.limits.accel_end)):
            if (most := largest(readings[imu])) >= end:
                return most
        return None

    def _wrong_norm(self, imu: int) -> float | None:
        """Return the norm of the quaternion of an IMU; None if the norm is 1 within the tolerance."""
        squared = squared_norm(self._now.quaternion[imu])
        return None if abs(squared - 1.0) <= self.limits.norm_error else math.sqrt(squared)

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the IMU checks."""
        return (
            *(_no_attitude(imu, norm, self._confirmed[imu]) for imu, norm in self.no_attitude.items()),
            *(_saturated(imu, value, self._confirmed[imu]) for imu, value in self.saturated.items()),
        )


def usable(quaternion: Vector, gyro: Vector, accel: Vector, limits: ImuLimits) -> bool:
    """Return whether the values of every IMU may be used.

    Args:
        quaternion: attitude of each IMU, shape (4, 4), wxyz.
        gyro: angular velocity of each IMU, shape (4, 3) [rad/s].
        accel: specific force at each IMU, shape (4, 3) [m/s2].
        limits: limits of the readings of an IMU.
    """
    every = True
    for imu in range(len(quaternion)):
        every = every and usable_one(quaternion[imu], gyro[imu], accel[imu], limits)
    return every


def usable_one(quaternion: Vector, gyro: Vector, accel: Vector, limits: ImuLimits) -> bool:
    """Return whether the values of one IMU may be used.

    Args:
        quaternion: attitude, shape (4,), wxyz.
        gyro: angular velocity, shape (3,) [rad/s].
        accel: specific force, shape (3,) [m/s2].
        limits: limits of the readings of an IMU.
    """
    if not abs(squared_norm(quaternion) - 1.0) <= limits.norm_error:
        return False
    return largest(gyro) < limits.gyro_end and largest(accel) < limits.accel_end


def squared_norm(quaternion: Vector) -> float:
    """Return the squared norm of one quaternion.

    Args:
        quaternion: attitude, shape (4,), wxyz.
    """
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return float(w * w + x * x + y * y + z * z)


def largest(readings: Vector) -> float:
    """Return the largest absolute value of three readings.

    Args:
        readings: reading of each axis, shape (3,).
    """
    return float(max(abs(readings[0]), abs(readings[1]), abs(readings[2])))


def _end_of_range(codec: Codec, name: str) -> float:
    """Return the saturation threshold of an IMU signal: the maximum of its range minus half of its resolution.

    A reading whose absolute value is at or above this threshold counts as saturated.
    """
    signal = next(signal for _, signal in codec.signals if signal.name == name)
    return signal.maximum - 0.5 * signal.factor


def _no_attitude(imu: int, norm: float, confirmed: bool) -> Finding:
    text = f"the quaternion of the {IMUS[imu]} IMU must have the norm 1, got {norm:.3f}"
    return Finding(Dtc.IMU_INVALID, IMU_NODES[imu], norm, confirmed, text)


def _saturated(imu: int, value: float, confirmed: bool) -> Finding:
    text = f"the {IMUS[imu]} IMU is saturated: its reading of {value:.0f} is at the end of the measuring range"
    return Finding(Dtc.IMU_SATURATED, IMU_NODES[imu], value, confirmed, text)
