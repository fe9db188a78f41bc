"""Trunk check, which detects exchanged IMUs of torso and pelvis.

Both IMUs are on one rigid body with equal axes, so their attitudes and angular velocities are equal. Only the vertical distance
`TORSO_HEIGHT` distinguishes them: an angular acceleration of the body accelerates the torso IMU more than the pelvis IMU. So the
integral of the difference of their accelerometers is the angular velocity times this distance:

    integral of a_torso - a_pelvis, along x = height * angular velocity about y
    integral of a_torso - a_pelvis, along y = - height * angular velocity about x

Both sides pass the same high-pass of second order, with the time constant `_FILTER_TIME`, because the integral of a constant
error of an accelerometer has no limit. Centrifugal accelerations are neglected; they are small and of twice the frequency. The
height is the mean product of the filtered integral and the filtered angular velocity, with the signs of these equations, divided
by the mean square of the filtered angular velocity. If the IMUs are exchanged, the height is negative. The check needs an angular
velocity above `_LEAST_RATE`, so it cannot decide while the pelvis is at rest.
The angular velocity is the mean of both gyroscopes, so a gyroscope with a wrong sign does not lead to a wrong decision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import IMU_NODES
from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Signals
from atalante_hal.types import Vector

#: Height of the torso IMU above the pelvis IMU [m].
TORSO_HEIGHT = 0.309
#: Time constant of both high-pass filters [s].
_FILTER_TIME = 0.1
#: Time constant of the running means in `Filters.moments` [s].
_MEAN_TIME = 0.25
#: Time that the filters need to settle after the start [s]. `Filters.moments` is updated only after this time.
_SETTLING_TIME = 0.3
#: Filtered angular velocity of the trunk above which the check decides [rad/s rms].
#: At rest, the noise of the gyroscopes is up to 0.004 rad/s rms.
_LEAST_RATE = 0.008
#: The IMUs count as exchanged if the height of the torso IMU, computed from the motion, is less than -`_SHARE` * `TORSO_HEIGHT`.
#: In walks, pushes and falls of a healthy robot, this computed height is at least 0.6 * `TORSO_HEIGHT`.
_SHARE = 0.5
_TORSO, _PELVIS = IMUS.index("torso"), IMUS.index("pelvis")


class Filters(NamedTuple):
    """State of the filters.

    Speed is the velocity of the torso IMU relative to the pelvis IMU, and rate is the mean angular velocity of both IMUs.
    The first four arrays have one element for each axis: element 0 for the acceleration along x, element 1 along y.
    The rate of element 0 is the angular velocity about y. The rate of element 1 is minus the angular velocity about x.

    The filtered rate is rate - `slow_rate` - `slower_rate`. The filtered speed is `speed` - `slow_speed`.
    The height of the torso IMU above the pelvis IMU is `moments[0]` / `moments[1]`.
    """

    speed: Vector  # (2,) decaying integral of torso acceleration minus pelvis acceleration, time constant `_FILTER_TIME` [m/s]
    slow_speed: Vector  # (2,) low-pass of `speed` [m/s]
    slow_rate: Vector  # (2,) low-pass of the rate [rad/s]
    slower_rate: Vector  # (2,) low-pass of (rate - `slow_rate`) [rad/s]
    time: Vector  # (1,) time since the start, up to `_SETTLING_TIME` [s]
    #: (2,) running means. Element 0: filtered speed * filtered rate, the sum over both axes [m/s2].
    #: Element 1: square of the filtered rate, the sum over both axes [rad2/s2].
    moments: Vector


class Trunk:
    """Check whether the IMUs of torso and pelvis are exchanged.

    Args:
        now: signals decoded in this cycle.
        period: cycle time [s].
    """

    def __init__(self, now: Signals, period: float) -> None:
        speed, slow_speed, slow_rate, slower_rate, moments = np.zeros((5, 2))
        filters = Filters(speed, slow_speed, slow_rate, slower_rate, np.zeros(1), moments)
        #: Arguments of the function `follow`. The array objects are the same in every call.
        self._arguments = now.gyro, now.accel, filters, period
        self._follow = specialised(follow, *self._arguments)
        for values in filters:
            values.fill(0.0)
        self._found: tuple[Finding, ...] = ()

    def follow(self) -> bool:
        """Update the filters and the finding by one cycle. Both IMUs must have new values.

        Returns:
            Whether the finding has changed.
        """
        height = self._follow(*self._arguments)
        if (height > 0.0) if self._found else (height < 0.0):
            self._found = () if self._found else (_exchanged(height),)
            return True
        return False

    def findings(self) -> tuple[Finding, ...]:
        """Return the finding about exchanged IMUs, if there is one."""
        return self._found


def follow(gyro: Vector, accel: Vector, filters: Filters, period: float) -> float:
    """Update the filters by one cycle, and return the height of the torso IMU above the pelvis IMU.

    Args:
        gyro: angular velocity of each IMU, shape (4, 3) [rad/s].
        accel: specific force at each IMU, shape (4, 3) [m/s2].
        filters: values of the filters. Updated here.
        period: cycle time [s].

    Returns:
        The height [m]. It is 0 if the trunk hardly turns, or if the magnitude of the height is too small.
    """
    share, product, square = period / _FILTER_TIME, 0.0, 0.0
    for axis in range(2):
        sign, other = 0.5 - axis, 1 - axis
        rate = sign * (gyro[_TORSO, other] + gyro[_PELVIS, other])
        filters.speed[axis] += (accel[_TORSO, axis] - accel[_PELVIS, axis]) * period - share * filters.speed[axis]
        filters.slow_speed[axis] += share * (filters.speed[axis] - filters.slow_speed[axis])
        filters.slow_rate[axis] += share * (rate - filters.slow_rate[axis])
        rate -= filters.slow_rate[axis]
        filters.slower_rate[axis] += share * (rate - filters.slower_rate[axis])
        rate -= filters.slower_rate[axis]
        product += (filters.speed[axis] - filters.slow_speed[axis]) * rate
        square += rate * rate
    if filters.time[0] < _SETTLING_TIME:
        filters.time[0] += period
        return 0.0
    share = period / _MEAN_TIME
    filters.moments[0] += share * (product - filters.moments[0])
    filters.moments[1] += share * (square - filters.moments[1])
    if filters.moments[1] <= _LEAST_RATE**2 or abs(filters.moments[0]) <= _SHARE * TORSO_HEIGHT * filters.moments[1]:
        return 0.0
    return float(filters.moments[0] / filters.moments[1])


def _exchanged(height: float) -> Finding:
    text = "the IMUs of torso and pelvis are exchanged: when the robot turns, the torso IMU measures the smaller acceleration"
    return Finding(Dtc.IMU_IMPLAUSIBLE, IMU_NODES[_TORSO], height, True, text)
