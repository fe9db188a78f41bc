"""Rigid-body model of both legs: the data from which the HAL computes joint torques from the motion.

The controller package creates the model from the exoskeleton and the patient, and the HAL gets it as an argument. So masses
and dimensions are defined only once.
"""

from __future__ import annotations

from typing import NamedTuple

from atalante_hal.types import Vector


class LegModel(NamedTuple):
    """Links and friction of both legs. The first dimension of each array is the leg, left leg first.

    The second dimension is the joint and its link, in the order of `LEG_JOINTS`; in `cell`, it is the force cell. The frame of a
    link is the frame of its joint. The frame of the pelvis IMU is the parent of the first link.
    """

    offset: Vector  # (2, 6, 3) m, position of the joint in the frame of the parent link
    #: (2, 6, 3, 3, 3) three matrices T[0], T[1], T[2] of shape (3, 3) for each joint.
    #: At the joint angle q, the rotation matrix from link to parent is T[0] + sin(q) T[1] + (1 - cos(q)) T[2].
    turn: Vector
    axis: Vector  # (2, 6, 3) unit vector of the joint axis in the frame of the link
    mass: Vector  # (2, 6) kg, mass of each link
    centre: Vector  # (2, 6, 3) m, position of the centre of mass in the frame of the link
    inertia: Vector  # (2, 6, 3, 3) kg m2, inertia about the origin of the link frame
    cell: Vector  # (2, 4, 3) m, position of each force cell in the frame of the foot, which is the last link
    dry: Vector  # (2, 6) Nm, dry friction of the joints
    viscous: Vector  # (2, 6) Nm s/rad, viscous friction of the joints
    friction_speed: float  # rad/s, joint speed at which the dry friction has tanh(1) = 76 % of its full value
