"""IMUs against themselves: a quaternion is a unit, and no axis is at the end of its range. Against the encoders: see `legs`."""

from __future__ import annotations

import math

from atalante_hal.compiled import compiled
from atalante_hal.robot import IMUS, Robot, Vector
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import IMU_NODES, Finding, Signals
from atalante_hal.wire.codec import Codec

#: Cycles without a good value after which an IMU is given up.
IMU_CYCLES = 10


class Imus:
    """The four IMUs.

    Args:
        now: what was decoded in this cycle.
    """

    def __init__(self, robot: Robot, codec: Codec, now: Signals) -> None:
        self._now = now
        self._gyro_end, self._accel_end = (_end_of_range(codec, signal) for signal in ("GyroX", "AccelX"))
        self._norm_error = robot.sensors.quaternion_error
        #: IMUs whose quaternion is none, and of those at the end of their range; both by number with the value.
        self.no_attitude: dict[int, float] = {}
        self.saturated: dict[int, float] = {}
        self._given_up: dict[int, bool] = {}
        self._usable = compiled(usable)
        self.usable()  # is compiled now, not in a cycle

    def usable(self) -> bool:
        """Whether every quaternion is a unit, and no axis at the end of its range."""
        now = self._now
        return self._usable(now.quaternion, now.gyro, now.accel, self._norm_error, self._gyro_end, self._accel_end)

    def accept(self, imu: int, cycles: int, *, frozen: bool) -> bool:
        """Whether the new values of one IMU may be used.

        Args:
            cycles: from the last good ones to these.
            frozen: it repeats itself.
        """
        saturation, norm = self._saturation(imu), self._wrong_norm(imu)
        for value, standing in ((saturation, self.saturated), (norm, self.no_attitude)):
            if value is None:
                standing.pop(imu, None)
            else:
                standing[imu] = value
        usable = not frozen and saturation is None and norm is None
        self._given_up[imu] = not usable and cycles >= IMU_CYCLES
        return usable

    def _saturation(self, imu: int) -> float | None:
        """The largest reading of an IMU that is at the end of its range [rad/s or m/s2], None if none is."""
        for readings, end in ((self._now.gyro, self._gyro_end), (self._now.accel, self._accel_end)):
            if (most := largest(readings[imu])) >= end:
                return most
        return None

    def _wrong_norm(self, imu: int) -> float | None:
        """The norm of the quaternion of an IMU, None if it is a unit."""
        squared = squared_norm(self._now.quaternion[imu])
        return None if abs(squared - 1.0) <= self._norm_error else math.sqrt(squared)

    def findings(self) -> tuple[Finding, ...]:
        """What stands."""
        return (
            *(_no_attitude(imu, norm, self._given_up[imu]) for imu, norm in self.no_attitude.items()),
            *(_saturated(imu, value, self._given_up[imu]) for imu, value in self.saturated.items()),
        )


def usable(
    quaternion: Vector, gyro: Vector, accel: Vector, norm_error: float, gyro_end: float, accel_end: float
) -> bool:
    """Whether every IMU is.

    Args:
        quaternion, gyro, accel: shapes (4, 4), (4, 3) [rad/s], (4, 3) [m/s2].
        norm_error: what the square of a quaternion's norm may be off 1.
        gyro_end, accel_end: readings from here on are the end of the range.
    """
    for imu in range(len(quaternion)):
        if not abs(squared_norm(quaternion[imu]) - 1.0) <= norm_error:
            return False
        if largest(gyro[imu]) >= gyro_end or largest(accel[imu]) >= accel_end:
            return False
    return True


def squared_norm(quaternion: Vector) -> float:
    """Shape (4,)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return float(w * w + x * x + y * y + z * z)


def largest(readings: Vector) -> float:
    """The largest magnitude of three axes, shape (3,)."""
    return float(max(abs(readings[0]), abs(readings[1]), abs(readings[2])))


def _end_of_range(codec: Codec, name: str) -> float:
    """Readings from here on are the last step of the range, which is the same of all IMUs."""
    signal = next(signal for _, signal in codec.signals if signal.name == name)
    return signal.maximum - 0.5 * signal.factor


def _no_attitude(imu: int, norm: float, given_up: bool) -> Finding:
    text = f"the quaternion of the {IMUS[imu]} IMU has the norm {norm:.3f}, not 1"
    return Finding(Dtc.IMU_INVALID, IMU_NODES[imu], norm, given_up, text)


def _saturated(imu: int, value: float, given_up: bool) -> Finding:
    text = f"the {IMUS[imu]} IMU is at the end of its range, {value:.0f}"
    return Finding(Dtc.IMU_SATURATED, IMU_NODES[imu], value, given_up, text)
