"""Ankle stabiliser: ankle torques that lead the robot back to its nominal motion after a disturbance.

`DCM error -> shift of the centre of pressure -> torques of sagittal and henke ankle (SA, HA)`. The henke ankle tilts the foot
sideways about an oblique axis, the henke axis.

The divergent component of motion (DCM) of an inverted pendulum is a point on the ground, see `dcm`. It moves away from the centre
of pressure with the rate w. A shift of the centre of pressure by k times the DCM error makes this error decay with the rate
(k - 1) w. Let F be the vertical force on a foot. The SA torque F d shifts the centre of pressure forwards by d. The HA torque
-F d a shifts the centre of pressure sideways by d, where a is the forward component of the unit henke axis. F is measured, so a
foot without load gets no torque.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from atalante_hal.types import Vector

Pair = tuple[float, float]

#: Nm, torque of the sagittal ankle that is permitted even without load on the foot, for example while the foot bounces.
#: `within_sole` adds this torque to the limits that follow from the load.
_UNLOADED = 10.0


class Stabiliser(NamedTuple):
    """Parameters of the ankle stabiliser."""

    gain: float  # m/m, shift of the centre of pressure per DCM error; a gain above 1 makes the DCM error decay
    forward: float  # m, largest shift of the centre of pressure forwards and backwards
    sideways: float  # m, largest shift of the centre of pressure to each side
    henke: float  # forward component (foot frame) of the unit vector along the axis of the henke ankle
    toe_out: float  # rad, toe-out of the left foot, positive to the left
    heel: float  # m, rearmost permitted centre of pressure relative to the ankle, negative
    toe: float  # m, foremost permitted centre of pressure relative to the ankle, positive


class Balance:
    """Balance in one cycle: divergent component of motion (DCM), and reaction of the ankle stabiliser.

    The vectors are in the walking frame, with x forward and y to the left.
    """

    dcm: Annotated[Vector, 2]  # m, measured DCM
    error: Annotated[Vector, 2]  # m, DCM error: measured minus nominal DCM
    shift: Annotated[Vector, 2]  # m, shift of the centre of pressure that the ankle stabiliser requests
    heading: float  # rad, yaw angle of the walking frame in the world


def dcm(lever: tuple[float, float, float], speed: tuple[float, float, float], heading: float, frequency: float) -> Pair:
    """Return the divergent component of motion (DCM) in the walking frame [m].

    Args:
        lever: position of the centre of mass relative to the centre of the stance sole, or to the middle between both soles
            while standing, in world axes [m]. The DCM is relative to the same point.
        speed: velocity of the centre of mass in world axes [m/s].
        heading: heading of the walking frame [rad].
        frequency: natural frequency w of the pendulum [rad/s].
    """
    x, y = lever[0] + speed[0] / frequency, lever[1] + speed[1] / frequency
    c, s = math.cos(heading), math.sin(heading)
    return c * x + s * y, c * y - s * x


def pressure_shift(parameters: Stabiliser, error: Vector) -> Pair:
    """Return the shift of the centre of pressure in the walking frame, forwards and to the left [m].

    Args:
        parameters: gain and limits.
        error: measured minus nominal DCM, shape (2,) [m].
    """
    x, y = parameters.gain * error[0], parameters.gain * error[1]
    return (
        min(max(x, -parameters.forward), parameters.forward),
        min(max(y, -parameters.sideways), parameters.sideways),
    )


def within_sole(parameters: Stabiliser, torque: float, load: float) -> float:
    """Limit the torque of the sagittal ankle so that the centre of pressure stays within the sole, and return the torque [Nm].

    With a larger torque, the foot would turn about its heel or its toes. The ankle of a foot that stands on an edge moves only
    the small inertia of the foot, so that the stiff stance gains would make the foot oscillate.

    Args:
        parameters: geometry of the foot.
        torque: requested torque of the sagittal ankle, all parts [Nm].
        load: measured vertical force on the foot [N]; a negative force counts as zero.
    """
    force = max(load, 0.0)
    return min(max(torque, force * parameters.heel - _UNLOADED), force * parameters.toe + _UNLOADED)


def ankle_torques(parameters: Stabiliser, shift: Vector, load: float, side: int) -> Pair:
    """Return the torques of sagittal and henke ankle that shift the centre of pressure of one foot [Nm].

    The henke ankle tilts the foot sideways about an oblique axis.

    Args:
        parameters: geometry of the foot.
        shift: shift of the centre of pressure in the walking frame, shape (2,) [m].
        load: measured vertical force on the foot [N]; a negative force counts as zero.
        side: foot, 0 left, 1 right.
    """
    yaw = -parameters.toe_out if side else parameters.toe_out
    c, s = math.cos(yaw), math.sin(yaw)
    forward, sideways = c * shift[0] + s * shift[1], c * shift[1] - s * shift[0]
    force = max(load, 0.0)
    return force * forward, -force * sideways * parameters.henke
