"""What every gait has to keep, and what it is optimised for, as numbers. `Requirements -> step problem`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_control.gait.gait import VELOCITY_JUMP


@dataclass(frozen=True)
class Requirements:
    """What a gait has to keep, and what it is optimised for."""

    nodes: int = 17  # over a step, both ends included
    torque_share: float = 0.9  # of the joints' torque limits
    joint_margin: float = math.radians(2.0)  # rad, to the joints' stops
    knee_min: float = math.radians(11.0)  # rad, knees stay bent: a straight leg is singular
    speed_share: float = 0.9  # of the joints' speed limits
    friction: float = 0.5
    force_min: float = 300.0  # N, vertical ground force
    sole_share: float = 0.6  # of the sole, centre of pressure
    cell_share: float = 0.8  # of the rectangle of the force cells where that is narrower
    yaw_lever: float = 0.03  # m, yaw moment about the sole's centre over vertical force
    clearance: float = 0.05  # m, swing sole over the ground at mid-swing, sine squared
    corridor: tuple[float, float] = (0.17, 0.28)  # m, swing ankle to the side of the stance ankle
    roll: float = math.radians(5.0)  # rad, pelvis
    pitch: float = math.radians(6.0)
    yaw: float = math.radians(6.0)
    landing_speed: tuple[float, float] = (-0.03, -0.003)  # m/s, vertical
    landing_slide: float = 0.035  # m/s, along and across
    landing_turn: float = 0.2  # rad/s, about each axis
    impact_jump: float = 0.6 * VELOCITY_JUMP  # rad/s, of every joint's speed; the rest is the network's
    sinking: float = 0.01  # m/s, downward speed of the foot that leaves, after the impact
    # Weights against (100 Nm)^2. Without the last two the swing leg's motion is nearly free: it changes wildly from subject to
    # subject, and no network fits it.
    acceleration_weight: float = 3e-3  # of (rad/s2)^2
    tilt_weight: float = 5.0  # of (rad)^2, swing sole off the level
    pressure_weight: float = 20.0  # of (1500 N times m)^2, pressure moment about the sole's centre
