"""Gravity torques u_g of the empty exoskeleton, suspended at the pelvis: `joint angles, pelvis attitude -> u_g`.

Statics of a tree of links, as in the recursive Newton-Euler algorithm (Featherstone, Rigid Body Dynamics Algorithms, 5.3). The
outward pass computes the direction of gravity in each link. The inward pass starts at the feet and sums the forces and moments
that are needed to hold the links against gravity. The joint torque is the component of the summed moment about the joint axis.
The tree of links comes from the Pinocchio model, which is also the reference in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import pinocchio

from atalante_control.model import ArticulatedModel
from atalante_control.structured import Records, zeros
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS
from atalante_hal.types import GRAVITY, Vector
from atalante_hal.vectors import cross, rotated

Attitude = tuple[float, float, float, float]  # unit quaternion wxyz


class LinkRecord:
    """Data of one link, in the frame of its joint. The last four fields depend on the pose. All other fields are constant."""

    joint: int  # index in JOINTS
    parent: int  # index of the parent link
    offset: Annotated[Vector, 3]  # m, position of the joint in the frame of the parent link
    # The rotation matrix from link to parent is turn[0] + sin(q) turn[1] + (1 - cos(q)) turn[2].
    turn: Annotated[Vector, (3, 3, 3)]
    axis: Annotated[Vector, 3]  # unit vector of the joint axis
    mass: float  # kg, mass of the link
    lever: Annotated[Vector, 3]  # m, position of the centre of mass
    rotation: Annotated[Vector, (3, 3)]  # rotation matrix from link to parent
    down: Annotated[Vector, 3]  # m/s2, gravitational acceleration
    # Force [N] and moment about the joint [Nm] that are needed to hold this link and all links below it against gravity.
    # In the record of the pelvis, `force` and `moment` include the weight of both legs, but not the weight of the pelvis.
    force: Annotated[Vector, 3]
    moment: Annotated[Vector, 3]


class Gravity:
    """Gravity torques u_g of the empty exoskeleton, suspended at the pelvis.

    Attributes:
        links: records for `hold`: first the pelvis, then the other links, each after its parent.
    """

    def __init__(self, articulated: ArticulatedModel) -> None:
        """Prepare the tree of links, and compile the function `hold`.

        Args:
            articulated: model of the empty exoskeleton with the pelvis fixed.
        """
        self.links, self._torque = _links(articulated), np.zeros(len(JOINTS))
        # Writable copy of the joint angles. For numba, read-only arrays and writable arrays have different types.
        # If `hold` got a read-only array in the control loop, numba would compile `hold` again.
        self._position = np.zeros(len(JOINTS))
        self._hold = compiled(hold)
        self.torque(np.zeros(len(JOINTS)), (1.0, 0.0, 0.0, 0.0))

    def torque(self, position: Vector, pelvis: Sequence[float]) -> Vector:
        """Compute the joint torques that hold the suspended exoskeleton at rest.

        Args:
            position: joint angles, shape (12,) [rad].
            pelvis: attitude measured by the pelvis IMU, unit quaternion wxyz, pelvis to world.

        Returns:
            Torques, shape (12,) [Nm]. The next call overwrites this array.
        """
        w, x, y, z = pelvis
        self._position[:] = position
        self._hold(self.links, self._position, (w, x, y, z), self._torque)
        return self._torque


def _links(articulated: ArticulatedModel) -> Records[LinkRecord]:
    """Return the records of the links of a model, each parent before its children. Record 0 is the pelvis."""
    model, into, _ = articulated
    data, neutral = model.createData(), pinocchio.neutral(model)
    joint_of = {int(q): joint for joint, q in enumerate(into)}
    links: Records[LinkRecord] = zeros(LinkRecord, model.njoints)
    for i in range(1, model.njoints):
        link, placement, inertia = links[i], model.jointPlacements[i], model.inertias[i]
        axis = pinocchio.computeJointJacobian(model, data, neutral, i)[3:, model.idx_vs[i]]
        cross = pinocchio.skew(axis)
        link.joint, link.parent = joint_of[model.idx_qs[i]], model.parents[i]
        link.offset[:], link.axis[:] = placement.translation, axis
        link.turn[:] = [placement.rotation @ part for part in (np.eye(3), cross, cross @ cross)]
        link.mass, link.lever[:] = inertia.mass, inertia.lever
    return links


def hold(links: Records[LinkRecord], position: Vector, pelvis: Attitude, torque: Vector) -> None:
    """Compute the gravity torques u_g and write them into `torque`.

    Args:
        links: `Gravity.links`; the fields that depend on the pose are overwritten.
        position: joint angles, shape (12,) [rad].
        pelvis: attitude of the pelvis IMU, unit quaternion wxyz, pelvis to world.
        torque: u_g, shape (12,) [Nm], overwritten.
    """
    w, x, y, z = pelvis
    base = links[0]
    for j in range(3):
        base.force[j], base.moment[j] = 0.0, 0.0  # the loop from feet to pelvis adds the forces and moments of the legs
    down = base.down
    down[0], down[1] = -GRAVITY * 2.0 * (x * z - w * y), -GRAVITY * 2.0 * (y * z + w * x)
    down[2] = -GRAVITY * (1.0 - 2.0 * (x * x + y * y))
    for i in range(1, len(links)):
        link = links[i]
        angle, turn, rotation = position[link.joint], link.turn, link.rotation
        sine, versine = math.sin(angle), 1.0 - math.cos(angle)
        for j in range(3):
            for k in range(3):
                rotation[j, k] = turn[0, j, k] + sine * turn[1, j, k] + versine * turn[2, j, k]
        down, force, moment, mass = link.down, link.force, link.moment, link.mass
        down[0], down[1], down[2] = rotated(rotation.T, links[link.parent].down)
        force[0], force[1], force[2] = -mass * down[0], -mass * down[1], -mass * down[2]
        moment[0], moment[1], moment[2] = cross(link.lever, force)
    for i in range(len(links) - 1, 0, -1):
        link = links[i]
        axis, moment = link.axis, link.moment
        torque[link.joint] = axis[0] * moment[0] + axis[1] * moment[1] + axis[2] * moment[2]
        pull, twist = rotated(link.rotation, link.force), rotated(link.rotation, moment)
        arm = cross(link.offset, pull)
        parent = links[link.parent]
        for j in range(3):
            parent.force[j] += pull[j]
            parent.moment[j] += twist[j] + arm[j]
