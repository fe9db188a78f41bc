"""Kinematics of the soles and of the centre of mass, relative to the pelvis: `joint angles and speeds -> Chain`.

All results are in the axes of the pelvis frame and relative to the origin of this frame. The results do not contain the motion of
the pelvis in the world. The attitude of the pelvis comes from the attitude observer. The velocity of the pelvis follows from the
sole that is at rest (`walking.attitude`).
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
import pinocchio

from atalante_control.model import ArticulatedModel, ExoskeletonParameters
from atalante_control.structured import Records, zeros
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, SIDES
from atalante_hal.types import Vector
from atalante_hal.vectors import Vector3, cross, rotated


class Link:
    """Data of one link. The first seven fields are constant. The last four fields change with the motion."""

    joint: int  # index in JOINTS
    parent: int  # index of the parent link
    offset: Annotated[Vector, 3]  # m, position of the joint in the frame of the parent link
    # Three matrices: the rotation matrix from link to parent is turn[0] + sin(q) turn[1] + (1 - cos(q)) turn[2].
    turn: Annotated[Vector, (3, 3, 3)]
    axis: Annotated[Vector, 3]  # unit vector of the joint axis in the frame of the link
    mass: float  # kg
    lever: Annotated[Vector, 3]  # m, centre of mass in the frame of the link
    rotation: Annotated[Vector, (3, 3)]  # rotation matrix from link to pelvis
    origin: Annotated[Vector, 3]  # m, position of the joint
    angular: Annotated[Vector, 3]  # rad/s, angular velocity
    linear: Annotated[Vector, 3]  # m/s, velocity of the joint


#: Index of the link of a foot minus the index of the link of its tibia: SA and HA are between foot and tibia.
FOOT_TO_TIBIA = 2


class Sole:
    """Data of one sole. The first two fields are constant. The last four fields change with the motion."""

    link: int  # index of the link of the foot
    middle: Annotated[Vector, 3]  # m, centre of the sole in the frame of the foot
    rotation: Annotated[Vector, (3, 3)]  # rotation matrix from foot to pelvis
    position: Annotated[Vector, 3]  # m, centre of the sole
    linear: Annotated[Vector, 3]  # m/s, velocity of the centre of the sole
    angular: Annotated[Vector, 3]  # rad/s, angular velocity of the foot


class Centre:
    """Centre of mass of the robot and the patient together."""

    mass: float  # kg, total mass
    position: Annotated[Vector, 3]  # m
    velocity: Annotated[Vector, 3]  # m/s


class Chain(NamedTuple):
    """Records of `move`: links, soles and centre of mass."""

    links: Records[Link]  # (13,) pelvis and moving links; each parent is before its children
    soles: Records[Sole]  # (2,) left, right
    centre: Records[Centre]  # (1,)


class Kinematics:
    """Kinematics of the robot with the patient.

    Attributes:
        chain: records of `move`.
    """

    def __init__(self, articulated: ArticulatedModel, exoskeleton: ExoskeletonParameters) -> None:
        """Prepare the tree of links, and compile the kernel.

        Args:
            articulated: model of the robot with the patient, with a fixed pelvis.
            exoskeleton: geometry of the soles.
        """
        links = _links(articulated)
        soles: Records[Sole] = zeros(Sole, len(SIDES))
        centre: Records[Centre] = zeros(Centre, 1)
        x, z = exoskeleton.sole_centre
        names = [str(name) for name in articulated.model.names]
        for side, name in enumerate(SIDES):
            soles[side].link = names.index(f"{name}_HA")
            soles[side].middle[:] = x, 0.0, z
        centre[0].mass = sum(links[i].mass for i in range(len(links)))
        self.chain = Chain(links, soles, centre)
        self._move = compiled(move)
        self.update(np.zeros(len(JOINTS)), np.zeros(len(JOINTS)))

    def update(self, position: Vector, velocity: Vector) -> Chain:
        """Compute the motion of soles and centre of mass.

        Args:
            position: joint angles, shape (12,) [rad].
            velocity: joint speeds, shape (12,) [rad/s].

        Returns:
            The records. The next call overwrites them.
        """
        self._move(self.chain, position, velocity)
        return self.chain

    @property
    def mass(self) -> float:
        """Return the total mass of robot and patient [kg]."""
        return float(self.chain.centre[0].mass)


def _links(articulated: ArticulatedModel) -> Records[Link]:
    """Return the pelvis and the moving links of a model; each parent is before its children."""
    model, into, _ = articulated
    data, neutral = model.createData(), pinocchio.neutral(model)
    joint_of = {int(q): joint for joint, q in enumerate(into)}
    links: Records[Link] = zeros(Link, model.njoints)
    for i in range(model.njoints):
        link, inertia = links[i], model.inertias[i]
        link.mass, link.lever[:] = inertia.mass, inertia.lever
        if i == 0:  # the pelvis
            link.rotation[:] = np.eye(3)
            continue
        placement = model.jointPlacements[i]
        axis = pinocchio.computeJointJacobian(model, data, neutral, i)[3:, model.idx_vs[i]]
        cross = pinocchio.skew(axis)
        link.joint, link.parent = joint_of[model.idx_qs[i]], model.parents[i]
        link.offset[:], link.axis[:] = placement.translation, axis
        link.turn[:] = [placement.rotation @ part for part in (np.eye(3), cross, cross @ cross)]
    return links


def turn_link(parent: Vector, turn: Vector, angle: float, rotation: Vector) -> None:
    """Compute the rotation of a link from the rotation of its parent.

    Args:
        parent: rotation of the parent, shape (3, 3).
        turn: `Link.turn` of the link, shape (3, 3, 3).
        angle: joint angle [rad].
        rotation: output for the rotation of the link, shape (3, 3). It may be the array `parent`.
    """
    sine, versine = math.sin(angle), 1.0 - math.cos(angle)
    first, second, third = (
        _turn_column(turn, sine, versine, 0),
        _turn_column(turn, sine, versine, 1),
        _turn_column(turn, sine, versine, 2),
    )
    for row in range(3):
        x, y, z = parent[row, 0], parent[row, 1], parent[row, 2]
        rotation[row, 0] = x * first[0] + y * first[1] + z * first[2]
        rotation[row, 1] = x * second[0] + y * second[1] + z * second[2]
        rotation[row, 2] = x * third[0] + y * third[1] + z * third[2]


def _turn_column(turn: Vector, sine: float, versine: float, column: int) -> Vector3:
    """Return a column of the rotation of a link relative to its parent."""
    return (
        turn[0, 0, column] + sine * turn[1, 0, column] + versine * turn[2, 0, column],
        turn[0, 1, column] + sine * turn[1, 1, column] + versine * turn[2, 1, column],
        turn[0, 2, column] + sine * turn[1, 2, column] + versine * turn[2, 2, column],
    )


def move(chain: Chain, position: Vector, velocity: Vector) -> None:
    """Compute the motion of links, soles and centre of mass, and write the results into `chain`.

    Args:
        chain: records to update.
        position: joint angles, shape (12,) [rad].
        velocity: joint speeds, shape (12,) [rad/s].
    """
    links, soles, centre = chain.links, chain.soles, chain.centre[0]
    for k in range(3):
        first = links[0]
        centre.position[k], centre.velocity[k] = first.mass * first.lever[k], 0.0
    for i in range(1, len(links)):
        link, parent = links[i], links[links[i].parent]
        rotation, rate = link.rotation, velocity[link.joint]
        turn_link(parent.rotation, link.turn, position[link.joint], rotation)
        arm = rotated(parent.rotation, link.offset)
        swept = cross(parent.angular, arm)
        spin = rotated(rotation, link.axis)
        for k in range(3):
            link.origin[k] = parent.origin[k] + arm[k]
            link.linear[k] = parent.linear[k] + swept[k]
            link.angular[k] = parent.angular[k] + spin[k] * rate
        lever = rotated(rotation, link.lever)
        moved = cross(link.angular, lever)
        for k in range(3):
            centre.position[k] += link.mass * (link.origin[k] + lever[k])
            centre.velocity[k] += link.mass * (link.linear[k] + moved[k])
    for k in range(3):
        centre.position[k] /= centre.mass
        centre.velocity[k] /= centre.mass
    for side in range(len(soles)):
        sole, foot = soles[side], links[soles[side].link]
        lever = rotated(foot.rotation, sole.middle)
        moved = cross(foot.angular, lever)
        for k in range(3):
            sole.position[k], sole.linear[k] = foot.origin[k] + lever[k], foot.linear[k] + moved[k]
            sole.angular[k] = foot.angular[k]
            for column in range(3):
                sole.rotation[k, column] = foot.rotation[k, column]
