"""The empty exoskeleton, from one set of parameters: the URDF that PyBullet, Pinocchio and the viewer all load.

`ExoskeletonParameters -> links (left leg, right leg its mirror image) -> URDF text -> Pinocchio model`. A patient's
segments are to be fused between the second step and the third: a link keeps its inertia as a value. Frames follow
REP-103: x forward, y left, z up; a link's frame is its joint's frame, and all are parallel at the zero pose but the
feet, which toe out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_hal.robot import CELLS, JOINTS, LEG_JOINTS, SIDES, Robot

Vector3 = tuple[float, float, float]
ZERO: Vector3 = (0.0, 0.0, 0.0)

BASE_LINK = "pelvis"
#: Link moved by each joint of a leg; prefixed with the side.
LEG_LINKS = dict(zip(LEG_JOINTS, ("frontal_hip", "transverse_hip", "thigh", "shank", "ankle", "foot"), strict=True))


@dataclass(frozen=True)
class Box:
    """Homogeneous solid that stands for a link's mass: mass [kg], centre [m] and edge lengths [m] in the link frame."""

    mass: float
    centre: Vector3
    size: Vector3


@dataclass(frozen=True)
class ExoskeletonParameters:
    """An Atalante-like exoskeleton. Left side; the right side is its mirror image in the sagittal plane.

    Joint offsets, axes, masses, sole and sensor places are rounded public numbers; where in its link a mass sits is
    chosen here. Thigh and shank adjust to the patient.
    """

    thigh_length: float = 0.38  # m, SH to SK
    shank_length: float = 0.408  # m, SK to SA

    pelvis_mass: float = 16.5  # kg, pelvis and back
    frontal_hip_mass: float = 3.7  # kg, a side, like all below
    transverse_hip_mass: float = 4.4
    thigh_mass: float = 9.0
    shank_mass: float = 11.0
    ankle_mass: float = 1.7
    foot_mass: float = 3.2  # kg, with its force cells

    fh_offset: Vector3 = (0.0, 0.089, 0.0)  # m, in the pelvis
    th_offset: Vector3 = (-0.135, 0.169, 0.0)  # m, in the frontal hip
    sh_offset: Vector3 = (0.135, 0.0, 0.0)  # m, in the transverse hip
    knee_lateral: float = 0.005  # m, SK outwards of SH
    ankle_lateral: float = -0.169  # m, SA outwards of SK
    toe_out: float = math.radians(8.0)  # rad, foot about the vertical
    ha_axis: Vector3 = (0.788, 0.0, 0.616)  # henke axis in the foot frame, normalised in the URDF

    sole_size: tuple[float, float] = (0.275, 0.119)  # m, length and width
    sole_centre: tuple[float, float] = (0.06, -0.165)  # m, x and z from the ankle
    cell_x: tuple[float, float] = (0.178, -0.064)  # m, front and rear force cells from the ankle
    cell_y: float = 0.027  # m, either side of the foot's middle
    pad_radius: float = 0.005  # m, contact sphere under a cell, touching the sole plane
    pad_mass: float = 0.0015  # kg, taken from the foot

    torso_imu: Vector3 = (-0.14, 0.0, 0.50)  # m, in the pelvis link
    pelvis_imu: Vector3 = (-0.164, -0.015, 0.191)  # m, in the pelvis link
    tibia_imu: Vector3 = (-0.13, -0.074, -0.39)  # m, in the left shank

    def __post_init__(self) -> None:
        for name in ("thigh_length", "shank_length"):
            if not 0.2 < getattr(self, name) < 0.7:
                raise ValueError(f"{name} is a length in m between 0.2 and 0.7, not {getattr(self, name)!r}")
        if not 0.0 < 4 * self.pad_mass < 0.1 * self.foot_mass:
            raise ValueError(f"pad_mass is positive and four pads are under a tenth of the foot, not {self.pad_mass!r}")


@dataclass(frozen=True)
class Inertia:
    """Mass properties of a rigid body in a link frame."""

    mass: float  # kg
    centre: Vector3  # m, centre of mass
    tensor: tuple[float, float, float, float, float, float]  # kg m2 about it: xx, xy, xz, yy, yz, zz

    def mirrored(self) -> Inertia:
        """The same body reflected in the sagittal plane, y to -y."""
        xx, xy, xz, yy, yz, zz = self.tensor
        return Inertia(self.mass, mirrored(self.centre), (xx, -xy, xz, yy, -yz, zz))


@dataclass(frozen=True)
class Link:
    """One body of the tree with the joint that carries it. `joint` is one of `JOINTS`, or None for a fixed link."""

    name: str
    parent: str
    joint: str | None
    origin: Vector3  # m, in the parent's frame
    yaw: float  # rad, about the parent's z
    axis: Vector3  # in the link's own frame; unused when fixed
    inertia: Inertia
    box: Box | None = None  # drawn
    pad: float = 0.0  # m, radius of a contact sphere at the link's origin; 0: touches nothing


def box_inertia(box: Box) -> Inertia:
    """Mass properties of a homogeneous box with edges along the link's axes."""
    x, y, z = (edge * edge * box.mass / 12.0 for edge in box.size)
    return Inertia(box.mass, box.centre, (y + z, 0.0, 0.0, x + z, 0.0, x + y))


def mirrored(vector: Vector3) -> Vector3:
    """A polar vector reflected in the sagittal plane."""
    return (vector[0], -vector[1], vector[2])


def links(parameters: ExoskeletonParameters) -> tuple[Link, ...]:
    """Every body of the empty exoskeleton, parents first: pelvis, its IMUs, left leg, right leg."""
    p = parameters
    pelvis = Box(p.pelvis_mass, (-0.13, 0.0, 0.12), (0.18, 0.36, 0.40))
    base = Link(BASE_LINK, "", None, ZERO, 0.0, ZERO, box_inertia(pelvis), pelvis)
    imus = (_imu("torso", BASE_LINK, p.torso_imu), _imu("pelvis", BASE_LINK, p.pelvis_imu))
    left = _left_leg(p)
    return (base, *imus, *left, *(_mirror(link) for link in left))


def imu_link(imu: str) -> str:
    """Link whose origin and axes are those of an IMU of `IMUS`."""
    return f"imu_{imu}"


def pad_link(foot: str, cell: str) -> str:
    """Link of the contact pad under a force cell; its axes are the foot's."""
    return f"{foot}_foot_{cell}"


def urdf(parameters: ExoskeletonParameters, robot: Robot) -> str:
    """URDF of the empty exoskeleton.

    Joints are those of `JOINTS` in that order; limits come from `robot`. Bodies touch the world with the eight pads
    alone. IMU links are massless frames. The same parameters give the same text.

    Source: geometry and masses of `ExoskeletonParameters`; the inertia of a link is that of a homogeneous box.
    """
    return urdf_text(links(parameters), robot)


def urdf_text(bodies: Sequence[Link], robot: Robot) -> str:
    """URDF of a tree of links, parents first."""
    lines = ['<?xml version="1.0"?>', '<robot name="atalante_like">']
    for link in bodies:
        lines += _link_xml(link)
        if link.parent:
            lines += _joint_xml(link, robot)
    lines.append("</robot>")
    return "\n".join(lines) + "\n"


class ArticulatedModel(NamedTuple):
    """A Pinocchio model with the places of our joints in its vectors."""

    model: Any  # pinocchio.Model
    q: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a configuration vector
    v: npt.NDArray[np.intp]  # (12,) index of each of JOINTS in a velocity or torque vector


def pinocchio_model(urdf_text: str, fixed_base: bool = True) -> ArticulatedModel:
    """Pinocchio model of a URDF made here, gravity 9.81 m/s2 down; always index it through the joint map.

    Args:
        fixed_base: the pelvis is welded to the world at its origin; otherwise it floats on a `JointModelFreeFlyer`,
            which comes first in q and v.

    Raises:
        ValueError: a joint of `JOINTS` is not in the text.
    """
    if fixed_base:
        model = pinocchio.buildModelFromXML(urdf_text)
    else:
        model = pinocchio.buildModelFromXML(urdf_text, pinocchio.JointModelFreeFlyer())
    if missing := [name for name in JOINTS if not model.existJointName(name)]:
        raise ValueError(f"the URDF lacks joint {missing[0]}; it needs all of {', '.join(JOINTS)}")
    ids = [model.getJointId(name) for name in JOINTS]
    q, v = np.array([model.idx_qs[i] for i in ids], np.intp), np.array([model.idx_vs[i] for i in ids], np.intp)
    return ArticulatedModel(model, q, v)


def _left_leg(p: ExoskeletonParameters) -> tuple[Link, ...]:
    norm = math.sqrt(math.fsum(a * a for a in p.ha_axis))
    ha_axis = (p.ha_axis[0] / norm, p.ha_axis[1] / norm, p.ha_axis[2] / norm)
    sk, sa = (0.0, p.knee_lateral, -p.thigh_length), (0.0, p.ankle_lateral, -p.shank_length)
    length, width = p.sole_size
    sole_x, sole_z = p.sole_centre
    # Slender boxes between a joint and the next; hip and ankle bodies enclose the motors at their joint.
    chain = (
        ("FH", p.fh_offset, 0.0, (1.0, 0.0, 0.0), Box(p.frontal_hip_mass, _half(p.th_offset), (0.17, 0.19, 0.12))),
        ("TH", p.th_offset, 0.0, (0.0, 0.0, 1.0), Box(p.transverse_hip_mass, _half(p.sh_offset), (0.20, 0.10, 0.12))),
        ("SH", p.sh_offset, 0.0, (0.0, 1.0, 0.0), Box(p.thigh_mass, _half(sk), (0.12, 0.09, p.thigh_length))),
        ("SK", sk, 0.0, (0.0, 1.0, 0.0), Box(p.shank_mass, _half(sa), (0.12, 0.12, p.shank_length))),
        ("SA", sa, p.toe_out, (0.0, 1.0, 0.0), Box(p.ankle_mass, (0.0, 0.0, -0.02), (0.09, 0.09, 0.08))),
        (
            "HA",
            ZERO,
            0.0,
            ha_axis,
            Box(p.foot_mass - 4 * p.pad_mass, (sole_x, 0.0, sole_z + 0.035), (length, width, 0.07)),
        ),
    )
    legs = []
    names = [BASE_LINK, *(f"left_{LEG_LINKS[joint]}" for joint in LEG_JOINTS)]
    for (parent, name), (joint, origin, yaw, axis, box) in zip(pairwise(names), chain, strict=True):
        legs.append(Link(name, parent, f"left_{joint}", origin, yaw, axis, box_inertia(box), box))
        if joint == "SK":
            legs.append(_imu("left_tibia", name, p.tibia_imu))
    pad = 0.4 * p.pad_mass * p.pad_radius**2
    pad_inertia = Inertia(p.pad_mass, ZERO, (pad, 0.0, 0.0, pad, 0.0, pad))
    for cell in CELLS:
        origin = (
            p.cell_x[0] if cell[0] == "F" else p.cell_x[1],
            p.cell_y if cell[1] == "L" else -p.cell_y,
            sole_z + p.pad_radius,
        )
        legs.append(Link(pad_link("left", cell), "left_foot", None, origin, 0.0, ZERO, pad_inertia, pad=p.pad_radius))
    return tuple(legs)


def _imu(imu: str, parent: str, place: Vector3) -> Link:
    return Link(imu_link(imu), parent, None, place, 0.0, ZERO, Inertia(0.0, ZERO, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))


def _half(vector: Vector3) -> Vector3:
    return (0.5 * vector[0], 0.5 * vector[1], 0.5 * vector[2])


def _mirror(link: Link) -> Link:
    """The link of the right leg. The axis stays: the mirrored joint's angle changes sign instead (MIRROR_SIGN)."""
    box = link.box and Box(link.box.mass, mirrored(link.box.centre), link.box.size)
    name = _right(link.name)
    if link.pad:  # the cell that lies in the mirror is named for its own side of the foot
        name = name[:-1] + {"L": "R", "R": "L"}[name[-1]]
    joint = link.joint and _right(link.joint)
    return Link(
        name,
        _right(link.parent),
        joint,
        mirrored(link.origin),
        -link.yaw,
        link.axis,
        link.inertia.mirrored(),
        box,
        link.pad,
    )


def _right(name: str) -> str:
    return name.replace(SIDES[0], SIDES[1])


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(value + 0.0) for value in values)  # + 0.0: no negative zero in the text


def _link_xml(link: Link) -> list[str]:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    tensor = " ".join(f'{name}="{value + 0.0!r}"' for name, value in zip(names, link.inertia.tensor, strict=True))
    lines = [
        f'  <link name="{link.name}">',
        "    <inertial>",
        f'      <origin xyz="{_numbers(link.inertia.centre)}"/>',
        f'      <mass value="{link.inertia.mass!r}"/>',
        f"      <inertia {tensor}/>",
        "    </inertial>",
    ]
    if link.box:
        lines += [
            "    <visual>",
            f'      <origin xyz="{_numbers(link.box.centre)}"/>',
            f'      <geometry><box size="{_numbers(link.box.size)}"/></geometry>',
            "    </visual>",
        ]
    if link.pad:
        lines.append(f'    <collision><geometry><sphere radius="{link.pad!r}"/></geometry></collision>')
    return [*lines, "  </link>"]


def _joint_xml(link: Link, robot: Robot) -> list[str]:
    kind = "revolute" if link.joint else "fixed"
    lines = [
        f'  <joint name="{link.joint or link.name + "_mount"}" type="{kind}">',
        f'    <parent link="{link.parent}"/>',
        f'    <child link="{link.name}"/>',
        f'    <origin xyz="{_numbers(link.origin)}" rpy="0.0 0.0 {link.yaw + 0.0!r}"/>',
    ]
    if link.joint:
        row = JOINTS.index(link.joint)
        low, high = float(robot.position_min[row]), float(robot.position_max[row])
        effort, speed = float(robot.torque_max[row]), float(robot.velocity_max[row])
        lines += [
            f'    <axis xyz="{_numbers(link.axis)}"/>',
            f'    <limit lower="{low!r}" upper="{high!r}" effort="{effort!r}" velocity="{speed!r}"/>',
        ]
    return [*lines, "  </joint>"]
