"""Constraints and cost weights of every gait. `Requirements -> step problem`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_control.gait.gait import VELOCITY_JUMP


@dataclass(frozen=True)
class Requirements:
    """Constraints and cost weights of a gait."""

    nodes: int = 17  # number of nodes of a step, both ends included
    torque_share: float = 0.9  # usable fraction of the torque limits of the joints
    joint_margin: float = math.radians(2.0)  # rad, smallest distance to the limits of the joints
    knee_min: float = math.radians(11.0)  # rad, smallest knee angle, because a straight leg is singular
    speed_share: float = 0.9  # usable fraction of the speed limits of the joints
    friction: float = 0.5  # largest friction coefficient used
    force_min: float = 300.0  # N, smallest vertical ground force
    sole_share: float = 0.6  # fraction of the sole that may contain the centre of pressure
    cell_share: float = 0.8  # fraction of the rectangle of the force cells that may contain the centre of pressure
    yaw_lever: float = 0.03  # m, largest yaw moment about the centre of the sole over vertical force
    clearance: float = 0.05  # m, smallest height of the swing sole at mid-swing, scaled by sin(pi t / T)^2
    corridor: tuple[float, float] = (0.17, 0.28)  # m, lateral distance of the ankles
    roll: float = math.radians(5.0)  # rad, largest roll of the pelvis
    pitch: float = math.radians(6.0)  # rad, largest pitch of the pelvis
    yaw: float = math.radians(6.0)  # rad, largest yaw of the pelvis
    landing_speed: tuple[float, float] = (-0.03, -0.003)  # m/s, vertical speed of the foot at the landing
    landing_slide: float = 0.035  # m/s, largest horizontal speed of the foot at the landing, along and across
    landing_turn: float = 0.2  # rad/s, largest angular velocity of the foot at the landing, about each axis
    impact_jump: float = (
        0.6 * VELOCITY_JUMP
    )  # rad/s, largest speed jump of a joint; the rest is for errors of the network
    sinking: float = 0.01  # m/s, largest downward speed of the leaving foot after the impact
    # Weights relative to (100 Nm)^2. Without tilt and pressure weight the motion of the swing leg is almost undetermined. It then
    # differs strongly between similar subjects, and a network cannot fit it.
    acceleration_weight: float = 3e-3  # of (rad/s2)^2
    tilt_weight: float = 5.0  # of (rad)^2, tilt of the swing sole
    pressure_weight: float = 20.0  # of (1500 N times m)^2, pressure moment about the centre of the sole
