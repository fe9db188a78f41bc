"""Rigid-body model of both legs for the HAL: `exoskeleton, patient -> LegModel`.

From the model and the measured motion, the HAL computes the torque of each joint, and compares it with the sent torque.
"""

from __future__ import annotations

import math

import numpy as np

from atalante_control.joint.idealization import Friction
from atalante_control.model import BASE_LINK, ExoskeletonParameters, Inertia, Link, Patient, imu_link, links, pad_link
from atalante_hal.leg_model import LegModel
from atalante_hal.robot import CELLS, LEG_JOINTS, SIDES
from atalante_hal.types import Vector


def leg_model(
    exoskeleton: ExoskeletonParameters | None = None,
    patient: Patient | None = None,
    friction: Friction | None = None,
) -> LegModel:
    """Return the model of both legs.

    Args:
        exoskeleton: geometry and masses of the exoskeleton. With None, the default values are used.
        patient: patient in the exoskeleton; None for an empty exoskeleton.
        friction: friction of the joints. With None, the identified friction is used.
    """
    friction = friction or Friction()
    tree = {link.name: link for link in links(exoskeleton or ExoskeletonParameters(), patient)}
    imu = tree[imu_link("pelvis")]
    size = (len(SIDES), len(LEG_JOINTS))
    model = LegModel(
        offset=np.zeros((*size, 3)),
        turn=np.zeros((*size, 3, 3, 3)),
        axis=np.zeros((*size, 3)),
        mass=np.zeros(size),
        centre=np.zeros((*size, 3)),
        inertia=np.zeros((*size, 3, 3)),
        cell=np.array(
            [[tree[pad_link(side, cell)].origin for cell in CELLS] for side in SIDES],
        ),
        dry=np.array([friction.coulomb] * len(SIDES)),
        viscous=np.array([friction.viscous] * len(SIDES)),
        friction_speed=friction.smoothing,
    )
    moved_by = {link.joint: link for link in tree.values() if link.joint}
    for leg, side in enumerate(SIDES):
        for row, joint in enumerate(LEG_JOINTS):
            link = moved_by[f"{side}_{joint}"]
            origin = np.array(link.origin) - (np.array(imu.origin) if link.parent == BASE_LINK else 0.0)
            inertia = _fused(link, tree)
            model.offset[leg, row] = origin
            model.turn[leg, row] = _turn(link)
            model.axis[leg, row] = link.axis
            model.mass[leg, row], model.centre[leg, row] = inertia.mass, inertia.centre
            x, y, z = inertia.centre
            lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            model.inertia[leg, row] = inertia.matrix() - inertia.mass * lever @ lever
    return model


def _fused(link: Link, tree: dict[str, Link]) -> Inertia:
    """Return the mass properties of a link together with the contact spheres that are fixed to it."""
    inertia = link.inertia
    for child in tree.values():
        if child.parent == link.name and child.pad is not None:
            x, y, z = (a + b for a, b in zip(child.origin, child.inertia.centre, strict=True))
            inertia = inertia.fused(Inertia(child.inertia.mass, (x, y, z), child.inertia.tensor))
    return inertia


def _turn(link: Link) -> Vector:
    """Return the three matrices from which the HAL computes the rotation of a link (`LegModel.turn`), shape (3, 3, 3).

    The rotation matrix from link to parent is turn[0] + sin(q) turn[1] + (1 - cos(q)) turn[2].
    """
    cos, sin = math.cos(link.yaw), math.sin(link.yaw)
    fixed = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    x, y, z = link.axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.array([fixed, fixed @ cross, fixed @ cross @ cross])
