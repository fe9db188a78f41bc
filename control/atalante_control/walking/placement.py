"""Foot placement and step timing: a push changes the landing position of the swing foot and the speed of the step.

The reaction follows from the error of the DCM.

DCM is the divergent component of motion (`walking.dcm`). Let e be the DCM error, w the natural frequency, k the gain of
the ankle stabiliser and L the largest shift of the centre of pressure by the ankle. With the ankle stabiliser, e obeys
e' = w (e - sat(k e, L)), where sat limits k e to the range from -L to L. An error below L decays, and a larger error
grows with exp(w t). `predicted` is the solution of this equation at the nominal landing.

The predicted error beyond a dead zone is removed in two ways, see `landing`:

- Foot placement. The landing is shifted by the error of the DCM at the landing. The DCM is then at its nominal position relative
  to the new stance foot.
- Step timing. The error depends on the time of the landing, because the DCM moves outwards during a step. The phase
  rate is the speed of the step relative to the gait. The phase rate with the lowest cost is used. The cost consists of
  the shift of the landing, the shift that the limits do not permit, and the change of the step duration. (After
  M. Khadiv et al., Walking control based on step timing adaptation, IEEE Transactions on Robotics 36, 2020. The authors
  solve a quadratic program. Here the phase rate is the only unknown, so no solver is needed.)

A push also moves and tilts the pelvis. With the joint angles of the gait, the swing foot would move with the pelvis:
sideways, forwards and away from the floor. From the first reaction until the landing, the ankle of the swing leg is
therefore held at its position relative to the stance foot (`shift_foot`): the nominal position plus the offset.

While the predicted error is inside the dead zone, the offset is exactly 0 and the phase rate exactly 1.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from atalante_control.structured import Records
from atalante_control.walking.kinematics import Link, turn_link
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import PERIOD, Vector
from atalante_hal.vectors import Vector3, cross, dot, rotated

Pair = tuple[float, float]

_FH, _SH, _SK = (LEG_JOINTS.index(name) for name in ("FH", "SH", "SK"))
#: Joints of the swing leg that move to shift the foot: frontal hip, sagittal hip, sagittal knee.
_SHIFTING = (_FH, _SH, _SK)
#: Number of joints from the pelvis to the ankle.
_LINKS = LEG_JOINTS.index("SA") + 1
#: Smallest absolute determinant of the ankle Jacobian [m3] for a shift of the foot.
#: If the determinant is smaller, the leg is almost straight (singular), and the foot is not shifted further.
_SINGULAR = 1e-3
#: `landing` compares the phase rate 1 and `_RATES` + 1 phase rates from `slowest` to `fastest`.
#: The ratio between neighbouring rates is constant.
_RATES = 32
_FASTEST = 3.0  # rad/s, largest desired speed of a joint that shifts the foot


class PlacementConfig(NamedTuple):
    """Parameters of foot placement and step timing.

    `capacity` differs from the limit of the ankle stabiliser, `WalkConfig.shift_limit` (0.12 m forwards, 0.05 m sideways).
    Forwards, `capacity` is smaller, because the PIDs of the stance leg act against the stabiliser. Sideways, `capacity` is
    larger, because the trunk leans in addition.
    """

    #: m, predicted DCM error at the landing up to which foot placement and step timing do not react.
    #: If `dead_zone` is infinite, foot placement and step timing are off.
    dead_zone: float = 0.015
    forward: float = 0.15  # m, largest shift of the landing position forwards and backwards
    outward: float = 0.22  # m, largest shift of the landing position away from the stance foot
    inward: float = 0.02  # m, largest shift of the landing position towards the stance foot
    slowest: float = 0.1  # smallest phase rate; the phase rate is the speed of the step relative to the gait
    fastest: float = 1.6  # largest phase rate
    #: s, time from the start of a step until the DCM error is used. Until then, the new stance foot is not yet at rest.
    settled: float = 0.08
    #: s, duration of the last part of a step, up to the nominal landing. In this part, the phase rate returns to 1.
    #: In the last part of a step, the landing offset follows from the present DCM error, not from a prediction (`late_landing`).
    frozen: float = 0.05
    #: m, largest DCM error (forwards, sideways) that ankle and trunk can reduce. A larger error grows until the landing.
    capacity: Pair = (0.10, 0.08)
    bandwidth: float = 25.0  # rad/s, natural frequency of the critically damped motion of the landing offset
    speed: float = 1.2  # m/s, largest speed at which the landing offset changes
    acceleration: float = 25.0  # m/s2, largest acceleration of the landing offset
    #: Weight in `_cost` of the squared excess of the needed landing offset over the limits `forward`, `outward` and `inward`.
    missed: float = 30.0
    #: m, weight in `_cost` of the change of the landing time. A change by the time dt costs as much as a landing offset of
    #: `timing` * w * dt, where w is the natural frequency.
    timing: float = 0.03
    #: s, time in which the goal of the swing leg changes from joint angles to foot positions, after the first reaction to a push.
    #: The foot positions are relative to the stance foot, so a tilt of the pelvis does not move the swing foot.
    hold: float = 0.1
    slew: float = 15.0  # 1/s, largest change per second of the phase rate, which is 1 at the nominal speed


class Placement:
    """State of foot placement and step timing in the current phase, and working memory of `shift_foot`."""

    clock: float  # position in the phase table, in rows; for example, 10.5 is between row 10 and row 11
    pace: float  # phase rate: rows of the phase table per cycle; 1 is the speed of the gait
    #: 0: the swing leg follows the joint angles of the gait. 1: the swing ankle follows positions relative to the stance foot.
    #: With a value between 0 and 1, the desired position of the swing ankle is a weighted mean of both.
    held: float
    target: Annotated[Vector, 2]  # m, requested landing offset in the walking frame: forwards, to the left
    offset: Annotated[Vector, 2]  # m, present landing offset, which follows `target` smoothly
    speed: Annotated[Vector, 2]  # m/s, speed at which `offset` changes
    change: Annotated[Vector, 3]  # rad, sum of the changes of FH, SH and SK by `shift_foot` in this phase
    low: Annotated[Vector, 12]  # rad, lower limits of the desired joint angles
    high: Annotated[Vector, 12]  # rad, upper limits of the desired joint angles
    rotation: Annotated[Vector, (3, 3)]  # rotation matrix from the ankle link to the pelvis
    origin: Annotated[Vector, (_LINKS, 3)]  # m, positions of the joints of the swing leg in the pelvis frame
    axis: Annotated[Vector, (_LINKS, 3)]  # joint axes of the swing leg in the axes of the pelvis


class Motion(NamedTuple):
    """Present DCM of a step, and data for the prediction of the DCM at the nominal landing."""

    error: Pair  # m, measured minus nominal DCM in the walking frame
    nominal: Pair  # m, nominal DCM now
    final: Pair  # m, nominal DCM at the nominal landing
    exponent: float  # product w t, above 0; w is the natural frequency, t is the time to the nominal landing
    side: float  # direction from stance foot to swing foot: 1 left, -1 right


def predicted(error: float, gain: float, limit: float, exponent: float) -> float:
    """Predict the DCM error at the landing [m].

    The ankle stabiliser acts until the landing, so the error is the solution of e' = w (e - sat(k e, L)). sat limits k e to the
    range from -L to L.

    Args:
        error: present error e [m].
        gain: gain k of the ankle stabiliser, at least 0. Between 0 and 1, the result is too small for an error that grows beyond
            L / k.
        limit: largest shift L of the centre of pressure [m].
        exponent: product w t of the natural frequency w and the time t to the landing.
    """
    size = abs(error)
    linear = limit / gain if gain > 0.0 else math.inf  # m, DCM error at which the ankle stabiliser reaches its limit
    if size > linear:
        if size >= limit:
            return math.copysign(limit + (size - limit) * math.exp(exponent), error)
        saturated = math.log((limit - linear) / (limit - size))
        if exponent <= saturated:
            return math.copysign(limit - (limit - size) * math.exp(exponent), error)
        size, exponent = linear, exponent - saturated
    return math.copysign(size * math.exp((1.0 - gain) * exponent), error)


def beyond(value: float, zone: float) -> float:
    """Return the part of a value outside the dead zone from -zone to zone.

    Args:
        value: value.
        zone: dead zone, at least 0.
    """
    return value - min(max(value, -zone), zone)


def landing(config: PlacementConfig, gain: float, motion: Motion) -> tuple[float, float, float]:
    """Return the landing offset (forwards, to the left) [m] and the phase rate that remove a DCM error.

    The landing offset is the shift of the landing position, in the walking frame. The phase rate is the speed of the step
    relative to the gait.

    The candidates for the phase rate are 1 and `_RATES` + 1 rates from `slowest` to `fastest`. The rate with the lowest cost is
    returned. This rate may jump between two cycles. `follow` limits the changes of offset and phase rate.

    Args:
        config: parameters.
        gain: gain of the ankle stabiliser.
        motion: present DCM, and data for the prediction.
    """
    x, y = _needed(config, gain, motion, 1.0)
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0, 1.0
    least, best = _cost(config, gain, motion, 1.0), 1.0
    for k in range(_RATES + 1):
        rate = config.slowest * (config.fastest / config.slowest) ** (k / _RATES)
        cost = _cost(config, gain, motion, rate)
        if cost < least:
            least, best = cost, rate
    x, y = _needed(config, gain, motion, best)
    x, y = _permitted(config, motion.side, x, y)
    return x, y, best


def _needed(config: PlacementConfig, gain: float, motion: Motion, rate: float) -> Pair:
    """Return the landing offset (forwards, to the left) that removes the DCM error at the landing [m].

    With this offset, the DCM at the landing has the nominal position relative to the new stance foot, except for the dead zone.
    Sideways, the centre of pressure c of the nominal motion is taken as constant until the landing, so the nominal DCM x obeys
    x(t) = c + (x(0) - c) exp(w t). c follows from the present nominal DCM x(0) and the nominal DCM at the nominal landing.
    Forwards, the ankle makes the DCM follow a faster or slower step.

    Args:
        config: parameters.
        gain: gain of the ankle stabiliser.
        motion: present DCM, and data for the prediction.
        rate: phase rate until the landing.
    """
    exponent, growth = motion.exponent / rate, math.exp(motion.exponent)
    centre = (motion.nominal[1] * growth - motion.final[1]) / (growth - 1.0)
    moved = centre + (motion.nominal[1] - centre) * math.exp(exponent) - motion.final[1] if rate != 1.0 else 0.0
    return (
        beyond(predicted(motion.error[0], gain, config.capacity[0], exponent), config.dead_zone),
        moved + beyond(predicted(motion.error[1], gain, config.capacity[1], exponent), config.dead_zone),
    )


def _permitted(config: PlacementConfig, side: float, x: float, y: float) -> Pair:
    """Clip a landing offset (x forwards, y to the left) to the permitted range, and return it [m]."""
    return (
        min(max(x, -config.forward), config.forward),
        side * min(max(side * y, -config.inward), config.outward),
    )


def _cost(config: PlacementConfig, gain: float, motion: Motion, rate: float) -> float:
    """Return the cost of a candidate phase rate for the rest of the step. The unit of the cost is m2.

    cost = permitted^2 + missed * (needed - permitted)^2 + (timing * w * dt)^2. `needed` is the needed landing offset, and
    `permitted` is the same offset within its limits. `missed` and `timing` are in `PlacementConfig`. w is the natural frequency,
    and dt is the change of the landing time due to the phase rate.
    """
    x, y = _needed(config, gain, motion, rate)
    forward, left = _permitted(config, motion.side, x, y)
    missed = (x - forward) ** 2 + (y - left) ** 2
    time = config.timing * (motion.exponent / rate - motion.exponent)
    return forward * forward + left * left + config.missed * missed + time * time


def late_landing(config: PlacementConfig, error: Pair, side: float) -> Pair:
    """Return the landing offset (forwards, to the left) for a foot that is about to land, in the walking frame [m].

    Args:
        config: parameters.
        error: measured minus nominal DCM in the walking frame [m].
        side: direction from stance foot to swing foot: 1 left, -1 right.
    """
    zone = 2.0 * config.dead_zone
    return _permitted(config, side, beyond(error[0], zone), beyond(error[1], zone))


def follow(config: PlacementConfig, placement: Placement, rate: float) -> None:
    """Move offset and phase rate towards their targets, with limited speed and acceleration.

    Args:
        config: parameters.
        placement: state; updated.
        rate: target of the phase rate.
    """
    w, change = config.bandwidth, config.slew * PERIOD
    for k in range(2):
        pull = w * w * (placement.target[k] - placement.offset[k]) - 2.0 * w * placement.speed[k]
        speed = placement.speed[k] + PERIOD * min(max(pull, -config.acceleration), config.acceleration)
        placement.speed[k] = min(max(speed, -config.speed), config.speed)
        placement.offset[k] += PERIOD * placement.speed[k]
    placement.pace += min(max(rate - placement.pace, -change), change)


def shift_foot(
    placement: Placement, links: Records[Link], first: int, desired: Vector, leg: int, goal: Vector3
) -> None:
    """Move the desired swing ankle towards a goal position, with one Newton step of the inverse kinematics.

    The Newton step changes the angles of frontal hip, sagittal hip and knee (FH, SH, SK). The attitude of the foot is not
    considered, because the ankle holds the sole level.

    Args:
        placement: state; `change` is updated.
        links: links of the robot, `Kinematics.chain`.
        first: index of the first link of the swing leg.
        desired: q_des [rad], then q_des' [rad/s], shape (24,); the elements of FH, SH and SK of the swing leg are updated.
        leg: index of the first joint of the swing leg.
        goal: position of the ankle in the pelvis frame [m].
    """
    for k in range(3):
        desired[leg + _SHIFTING[k]] += placement.change[k]
    now = ankle_position(placement, links, first, desired)
    missing = goal[0] - now[0], goal[1] - now[1], goal[2] - now[2]
    a, b, c = _column(placement, now, _FH), _column(placement, now, _SH), _column(placement, now, _SK)
    bc = cross(b, c)
    determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
    if abs(determinant) < _SINGULAR:
        return
    # The joints move in the order FH, SK, SH. If FH reaches a limit, SK and SH reduce the remaining error (least squares).
    # If SK reaches a limit, SH reduces the remaining error.
    moved = _step(placement, desired, leg, 0, dot(bc, missing) / determinant)
    missing = missing[0] - moved * a[0], missing[1] - moved * a[1], missing[2] - moved * a[2]
    bb, bd, dd = dot(b, b), dot(b, c), dot(c, c)
    moved = _step(placement, desired, leg, 2, (bb * dot(c, missing) - bd * dot(b, missing)) / (bb * dd - bd * bd))
    missing = missing[0] - moved * c[0], missing[1] - moved * c[1], missing[2] - moved * c[2]
    _step(placement, desired, leg, 1, dot(b, missing) / bb)


def _step(placement: Placement, desired: Vector, leg: int, k: int, step: float) -> float:
    """Change the desired angle of the joint `_SHIFTING[k]` within its limits of angle and speed. Return the change [rad]."""
    joint, rate = leg + _SHIFTING[k], len(desired) // 2 + leg + _SHIFTING[k]
    least, most = (-_FASTEST - desired[rate]) * PERIOD, (_FASTEST - desired[rate]) * PERIOD
    angle = desired[joint] + min(max(step, min(least, 0.0)), max(most, 0.0))
    step = min(max(angle, placement.low[joint]), placement.high[joint]) - desired[joint]
    desired[joint] += step
    desired[rate] += step / PERIOD
    placement.change[k] += step
    return step


def ankle_position(placement: Placement, links: Records[Link], first: int, desired: Vector) -> Vector3:
    """Return the position of the ankle in the pelvis frame [m]. Write joint positions and axes into `placement`."""
    rotation, position = placement.rotation, (0.0, 0.0, 0.0)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = 1.0 if i == j else 0.0
    for i in range(_LINKS):
        link = links[first + i]
        arm = rotated(rotation, link.offset)
        position = position[0] + arm[0], position[1] + arm[1], position[2] + arm[2]
        turn_link(rotation, link.turn, desired[link.joint], rotation)
        axis = rotated(rotation, link.axis)
        for k in range(3):
            placement.origin[i, k], placement.axis[i, k] = position[k], axis[k]
    return position


def _column(placement: Placement, ankle: Vector3, joint: int) -> Vector3:
    """Return the derivative of the ankle position with respect to the angle of a leg joint [m]."""
    origin = placement.origin[joint]
    return cross(placement.axis[joint], (ankle[0] - origin[0], ankle[1] - origin[1], ankle[2] - origin[2]))
