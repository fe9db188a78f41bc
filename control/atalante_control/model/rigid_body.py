"""Rigid bodies and links: mass properties, fusion of two bodies, and reflection in the sagittal plane.

`Box` (shape for viewers) -> `Inertia` (mass properties) -> `Link` (body, and the joint that moves this body).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import SIDES

Vector3 = tuple[float, float, float]
ZERO: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Box:
    """Homogeneous box that represents the mass of a link. Its edges are parallel to the axes of the link frame."""

    mass: float  # kg
    centre: Vector3  # m, in the link frame
    size: Vector3  # m, edge lengths along x, y and z

    def inertia(self) -> Inertia:
        """Return the mass properties of the box."""
        x, y, z = (edge * edge * self.mass / 12.0 for edge in self.size)
        return Inertia(self.mass, self.centre, (y + z, 0.0, 0.0, x + z, 0.0, x + y))


@dataclass(frozen=True)
class Sphere:
    """Sphere that touches the floor."""

    radius: float  # m, radius of the sphere
    centre: Vector3  # m, in the link frame


@dataclass(frozen=True)
class Inertia:
    """Mass properties of a rigid body in a link frame."""

    mass: float  # kg
    centre: Vector3  # m, position of the centre of mass in the link frame
    #: Inertia about the centre of mass: xx, xy, xz, yy, yz, zz [kg m2].
    tensor: tuple[float, float, float, float, float, float]

    def matrix(self) -> npt.NDArray[np.float64]:
        """Return the inertia tensor as a symmetric matrix, shape (3, 3) [kg m2]."""
        xx, xy, xz, yy, yz, zz = self.tensor
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def mirrored(self) -> Inertia:
        """Return the mass properties reflected in the sagittal plane (y becomes -y)."""
        xx, xy, xz, yy, yz, zz = self.tensor
        return Inertia(self.mass, mirrored(self.centre), (xx, -xy, xz, yy, -yz, zz))

    def fused(self, other: Inertia) -> Inertia:
        """Return the mass properties of this body together with a second body (parallel axis theorem).

        Args:
            other: mass properties of the second body in the same link frame.
        """
        mass = self.mass + other.mass
        (ax, ay, az), (bx, by, bz) = self.centre, other.centre
        share, reduced = other.mass / mass, self.mass * other.mass / mass
        x, y, z = bx - ax, by - ay, bz - az
        shift = (y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y)
        xx, xy, xz, yy, yz, zz = (
            one + two + reduced * term for one, two, term in zip(self.tensor, other.tensor, shift, strict=True)
        )
        return Inertia(mass, (ax + share * x, ay + share * y, az + share * z), (xx, xy, xz, yy, yz, zz))


@dataclass(frozen=True)
class Link:
    """Link of a tree of links, with the joint between the link and the parent link."""

    name: str
    parent: str  # name of the parent link, or "" for the root
    joint: str | None  # one of `JOINTS`, or None if the link is fixed to its parent
    origin: Vector3  # m, position of the joint in the frame of the parent link
    yaw: float  # rad, rotation from parent frame to link frame about the z axis, at joint angle 0
    axis: Vector3  # joint axis in the frame of the link; unused for a fixed link
    inertia: Inertia
    boxes: tuple[Box, ...] = ()  # shapes for viewers
    pad: Sphere | None = None  # sphere that touches the floor; None if the link has no contact

    def fused(self, box: Box, inertia: Inertia) -> Link:
        """Return a copy of the link that is fused with a second body.

        Args:
            box: shape of the second body, added for viewers.
            inertia: mass properties of the second body in the link frame.
        """
        return replace(self, inertia=self.inertia.fused(inertia), boxes=(*self.boxes, box))

    def mirrored(self) -> Link:
        """Return the mirror image of a link of the left leg, for the right leg.

        The joint axis is not mirrored. Instead, the sign of the joint angle changes (MIRROR_SIGN).
        """
        name = _right(self.name)
        if self.pad:  # mirroring swaps the left and the right force cells of a foot
            name = name[:-1] + {"L": "R", "R": "L"}[name[-1]]
        return Link(
            name,
            _right(self.parent),
            self.joint and _right(self.joint),
            mirrored(self.origin),
            -self.yaw,
            self.axis,
            self.inertia.mirrored(),
            tuple(Box(box.mass, mirrored(box.centre), box.size) for box in self.boxes),
            self.pad and replace(self.pad, centre=mirrored(self.pad.centre)),
        )


def mirrored(vector: Vector3) -> Vector3:
    """Return a polar vector reflected in the sagittal plane (y becomes -y).

    Args:
        vector: polar vector such as a position, x forward, y left, z up.
    """
    return (vector[0], -vector[1], vector[2])


def _right(name: str) -> str:
    return name.replace(SIDES[0], SIDES[1])
