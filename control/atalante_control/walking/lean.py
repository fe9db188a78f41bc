"""Reaction to sideways pushes: the trunk leans, and the swing foot moves outwards.

`DCM error -> lean, outward motion of the swing foot`

The ankle moves the centre of pressure only within the sole. If the divergent component of motion (DCM, `walking.dcm`) is moved
beyond the edge of the sole, the ankle alone cannot stop it. A trunk that accelerates its rotation in the direction of the push
moves the ground force further than the sole reaches. A lean by the angle a moves the DCM back by about J w^2 a / (m g), with the
moment of inertia J of the rotating parts about the hip, the natural frequency w and the weight m g. The first part of the motion
counts most, because a DCM error grows with exp(w t). The trunk therefore leans fast and returns slowly. The lean is an offset
of the frontal hip (FH) of the stance leg.

A push to the side of the stance foot makes the trunk lean over the stance foot. This lean requires that the DCM is near the
middle of the stance sole or beyond it: on the side of the swing foot, the DCM must be less than `inside` from the middle. On the
other side, the distance is not limited. A push to the side of the swing foot makes the trunk lean a little to the side of the
swing foot. This lean also lowers the swing foot.

If the DCM is beyond the middle of the stance sole by more than `leg_zone`, on the side away from the swing foot, the swing foot
also moves away from the stance foot. The swing leg then turns in the same direction as the trunk, and its mass moves away from
the DCM.
"""

from __future__ import annotations

from typing import NamedTuple

from atalante_hal.types import PERIOD


class LeanConfig(NamedTuple):
    """Parameters of the lean."""

    gain: float = 6.0  # rad/m, lean per metre of DCM error beyond `dead_zone`; with gain 0, the trunk does not lean
    dead_zone: float = 0.02  # m, sideways DCM error up to which the trunk does not lean
    #: m, sideways position of the DCM below which the trunk may lean over the stance foot.
    #: The DCM position is relative to the middle of the stance sole, and positive towards the swing foot.
    inside: float = 0.015
    outward: float = 0.22  # rad, largest lean over the stance foot
    inward: float = 0.08  # rad, largest lean to the side of the swing foot
    rise: float = 14.0  # rad/s, natural frequency of the lean motion (critically damped) while the trunk leans further
    fall: float = 5.0  # rad/s, natural frequency of the lean motion (critically damped) while the trunk returns
    acceleration: float = 25.0  # rad/s2, largest acceleration of the lean
    leg_gain: float = 8.0  # m/m, outward shift of the swing foot per metre of DCM beyond `leg_zone`; 0: no shift
    #: m, sideways position of the DCM above which the swing foot moves outwards.
    #: The DCM position is relative to the middle of the stance sole, and positive away from the swing foot.
    leg_zone: float = 0.02
    leg: float = 0.15  # m, largest shift of the swing foot away from the stance foot


class Lean:
    """State of the lean in the current step."""

    angle: float  # rad, lean to the left
    speed: float  # rad/s, speed of the lean


def lean_target(config: LeanConfig, error: float, dcm: float, side: float) -> float:
    """Return the requested lean to the left [rad].

    Args:
        config: parameters.
        error: sideways DCM error, positive to the left [m].
        dcm: sideways position of the DCM relative to the middle of the stance sole, positive to the left [m].
        side: direction from stance foot to swing foot: 1 left, -1 right.
    """
    outward = min(-side * error - config.dead_zone, config.inside - side * dcm)
    if outward > 0.0:
        return -side * min(config.gain * outward, config.outward)
    return side * min(max(config.gain * (side * error - config.dead_zone), 0.0), config.inward)


def follow_lean(config: LeanConfig, lean: Lean, target: float) -> None:
    """Move the lean towards its target, with limited acceleration.

    Args:
        config: parameters.
        lean: state; updated.
        target: requested lean [rad].
    """
    w = config.rise if abs(target) > abs(lean.angle) else config.fall
    pull = w * w * (target - lean.angle) - 2.0 * w * lean.speed
    lean.speed += PERIOD * min(max(pull, -config.acceleration), config.acceleration)
    lean.angle += PERIOD * lean.speed


def leg_target(config: LeanConfig, dcm: float, side: float) -> float:
    """Return the sideways shift of the swing foot away from the stance foot [m].

    The sign gives the direction: positive to the left, negative to the right. 0 means no shift.

    Args:
        config: parameters.
        dcm: sideways position of the DCM relative to the middle of the stance sole, positive to the left [m].
        side: direction from stance foot to swing foot: 1 left, -1 right.
    """
    return side * min(max(config.leg_gain * (-side * dcm - config.leg_zone), 0.0), config.leg)
