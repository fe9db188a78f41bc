"""IMUs against themselves: a quaternion is a unit, and no axis is at the end of its range. Against the encoders: see `legs`."""

from __future__ import annotations

import math

from atalante_hal.codec import Codec
from atalante_hal.diagnostics import Dtc
from atalante_hal.plausibility.finding import IMU_NODES, Finding, Signals
from atalante_hal.robot import IMUS, Robot

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
        self._surely = min(self._gyro_end, self._accel_end) ** 2
        self._norm_error = robot.sensors.quaternion_error
        # Half of what one may err: the others do so by the precision of the wire.
        self._least, self._most = len(IMUS) - 0.5 * self._norm_error, len(IMUS) + 0.5 * self._norm_error
        #: IMUs whose quaternion is none, and of those at the end of their range; both by number with the value.
        self.no_attitude: dict[int, float] = {}
        self.saturated: dict[int, float] = {}
        self._given_up = [False] * len(IMUS)

    def usable(self) -> bool:
        """Whether every quaternion is a unit, unless two err the opposite way, and no axis is at the end of its range.

        No axis is if the sum of all squares is under the square of that end: one product for most cycles.
        """
        quaternions, inertial = self._now.quaternions, self._now.inertial
        if not self._least <= quaternions.dot(quaternions) <= self._most:
            return False
        return bool(inertial.dot(inertial) < self._surely) or not any(map(self.saturation, range(len(IMUS))))

    def saturation(self, imu: int) -> float | None:
        """The largest reading of an IMU that is at the end of its range [rad/s or m/s2], None if none is."""
        gyro = max(map(abs, self._now.gyro[imu].tolist()))
        accel = max(map(abs, self._now.accel[imu].tolist()))
        return gyro if gyro >= self._gyro_end else accel if accel >= self._accel_end else None

    def accept(self, imu: int, cycles: int, *, frozen: bool) -> bool:
        """Whether the new values of one IMU may be used.

        Args:
            cycles: from the last good ones to these.
            frozen: it repeats itself.
        """
        saturation, norm = self.saturation(imu), self._wrong_norm(imu)
        for value, standing in ((saturation, self.saturated), (norm, self.no_attitude)):
            if value is None:
                standing.pop(imu, None)
            else:
                standing[imu] = value
        usable = not frozen and saturation is None and norm is None
        self._given_up[imu] = not usable and cycles >= IMU_CYCLES
        return usable

    def _wrong_norm(self, imu: int) -> float | None:
        """The norm of the quaternion of an IMU, None if it is a unit."""
        w, x, y, z = self._now.quaternion[imu].tolist()
        squared = w * w + x * x + y * y + z * z
        return None if abs(squared - 1.0) <= self._norm_error else math.sqrt(squared)

    def judge_norms(self, whole: bool) -> bool:
        """Look at each quaternion by itself; returns whether one is none.

        Args:
            whole: every node was heard in this cycle; otherwise `accept` looks at those that were.
        """
        if whole:
            norms = ((imu, self._wrong_norm(imu)) for imu in range(len(IMUS)))
            self.no_attitude.update((imu, norm) for imu, norm in norms if norm is not None)
        return bool(self.no_attitude)

    def findings(self) -> tuple[Finding, ...]:
        """What stands."""
        return (
            *(_no_attitude(imu, norm, self._given_up[imu]) for imu, norm in self.no_attitude.items()),
            *(_saturated(imu, value, self._given_up[imu]) for imu, value in self.saturated.items()),
        )


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
