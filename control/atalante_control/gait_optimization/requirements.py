"""Constraints and cost weights of every gait: `Requirements -> step problem`."""

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
    friction: float = 0.5  # largest ratio of horizontal to vertical ground force
    force_min: float = 300.0  # N, smallest vertical ground force
    sole_share: float = 0.6  # fraction of length and width of the sole in which the centre of pressure must stay
    #: Fraction of length and width of the rectangle between the force cells of the foot.
    #: At each node, the centre of pressure must be inside the reduced rectangle.
    #: Between nodes, and in gaits from the gait network, the centre of pressure can be up to 3.2 mm outside this rectangle.
    cell_share: float = 0.7
    yaw_lever: float = 0.03  # m, largest ratio of yaw moment about the sole centre to vertical ground force
    #: m, smallest height of the swing sole at mid-swing.
    #: Smallest height at time t of a periodic step with duration T: clearance * sin(pi t / T)^2.
    #: Smallest height at time t of a start or stop step with duration T: clearance * sin(pi t / T)^4.
    clearance: float = 0.05
    corridor: tuple[float, float] = (0.17, 0.28)  # m, smallest and largest lateral distance between the ankles
    roll: float = math.radians(5.0)  # rad, largest roll of the pelvis
    pitch: float = math.radians(6.0)  # rad, largest pitch of the pelvis
    yaw: float = math.radians(6.0)  # rad, largest yaw of the pelvis
    #: m/s, range of the vertical speed of the ankle at the landing, upwards positive
    landing_speed: tuple[float, float] = -0.03, -0.003
    #: m/s, range of the vertical speed of each corner of the landing sole, upwards positive
    corner_speed: tuple[float, float] = -0.03, 0.0
    #: m/s, limit of the forward speed and of the lateral speed of each corner of the landing sole
    corner_slide: float = 0.025
    #: rad/s, largest jump of a joint speed at the impact.
    #: The gaits of the gait network keep 40 % of this jump (`fit.JUMP_KEPT`). The fit error adds to the jump.
    #: The sum of the kept jump and the fit error must be at most `VELOCITY_JUMP`.
    impact_jump: float = 0.6 * VELOCITY_JUMP
    sinking: float = 0.01  # m/s, largest downward speed of the rear foot after the impact
    # Weights of the cost. The sum of (joint torque / 100 Nm)^2 has weight 1.
    # With `tilt_weight` = 0 and `pressure_weight` = 0, similar subjects get very different swing motions.
    acceleration_weight: float = 3e-3  # weight of the sum of (joint acceleration / 1 rad/s2)^2
    tilt_weight: float = 5.0  # weight of sin(tilt of the swing sole)^2
    pressure_weight: float = 20.0  # weight of (horizontal ground moment about the sole centre / 1500 Nm)^2
