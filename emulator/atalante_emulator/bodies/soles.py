"""Soles of the robot as rigid plates on force cells: `URDF -> positions of cells and corners -> forces of the cells`.

The floor touches a sole at its corners. Four force cells connect the sole to the foot. The cells are equal springs in all three
directions. So the force of a cell is a linear function of the forces on the corners. Let the cells be at x = x0 +- a and
y = +- b. If a vertical force F acts at the point (x, y) of the sole, the force of a cell is
F / 4 (1 +- (x - x0) / a +- y / b), with the signs of the position of the cell. If the point (x, y) is near the corner opposite
to the cell, the force of the cell is negative: the cell is pulled.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np

from atalante_hal.robot import CELLS, FEET
from atalante_hal.types import Vector

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class Soles:
    """Positions on both soles, in the frame of each foot. Arrays have shape (2, 4, 3) [m], in the order of FEET and CELLS."""

    cell: Vector  # centres of the force cells
    corner: Vector  # points of the sole that touch the floor

    def plate(self) -> Vector:
        """Return the matrix from the forces on all corners to the forces of all cells, shape (24, 24).

        Rows and columns are in the order of arrays of shape (2, 4, 3).
        """
        count = 3 * len(CELLS)
        matrix = np.zeros((len(FEET) * count, len(FEET) * count))
        for foot in range(len(FEET)):
            rows = slice(foot * count, (foot + 1) * count)
            matrix[rows, rows] = _plate(self.cell[foot], self.corner[foot])
        return matrix

    def lowest(self, foot: int, position: Vector, attitude: Vector) -> float:
        """Return the height of the lowest corner of a sole in the world [m].

        Args:
            foot: index of the foot in FEET.
            position: position of the foot in the world, shape (3,) [m].
            attitude: quaternion xyzw from the foot frame to the world, shape (4,).
        """
        x, y, z, w = attitude
        up = np.array([2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)])
        return float(position[2] + (self.corner[foot] @ up).min())


def read_soles(urdf: str) -> Soles:
    """Read the positions of cells and corners from a URDF. Each force cell has one link (contact pad) with one contact sphere.

    Args:
        urdf: text of the URDF.

    Raises:
        ValueError: If the text is not a URDF, or a contact pad is missing.
    """
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ValueError(f"the URDF must be valid XML, got a text with an error: {error}") from error
    cell, corner = np.zeros((2, len(FEET), len(CELLS), 3))
    for i, foot in enumerate(FEET):
        for k, name in enumerate(CELLS):
            pad = f"{foot}_foot_{name}"
            mount = root.find(f"joint/child[@link='{pad}']/../origin")
            collision = root.find(f"link[@name='{pad}']/collision")
            sphere = None if collision is None else collision.find("geometry/sphere")
            if mount is None:
                raise ValueError(
                    f"contact pad {pad} must be the child link of a joint with an origin, got no such joint"
                )
            if collision is None or sphere is None:
                raise ValueError(f"contact pad {pad} must be a link with a collision sphere, got no such link")
            cell[i, k] = _numbers(mount)
            corner[i, k] = cell[i, k] + _numbers(collision.find("origin"))
            corner[i, k, 2] -= float(sphere.attrib["radius"])
    return Soles(cell, corner)


def total_mass(urdf: str) -> float:
    """Return the sum of the masses of all links [kg].

    Args:
        urdf: text of the URDF.
    """
    return sum(float(mass.attrib["value"]) for mass in ET.fromstring(urdf).iterfind("link/inertial/mass"))


def into_frame(attitude: Vector | Quaternion, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Transform a vector from world axes into the axes of a frame. Compiled kernels call this function.

    Args:
        attitude: quaternion xyzw from the frame to the world, shape (4,).
        x: component of the vector along x of the world.
        y: component of the vector along y of the world.
        z: component of the vector along z of the world.

    Returns:
        Components of the vector along x, y and z of the frame.
    """
    # Inverse rotation by the quaternion (w, u): v' = v - 2 w (u x v) + 2 u x (u x v).
    ux, uy, uz, w = attitude[0], attitude[1], attitude[2], attitude[3]
    cx, cy, cz = uy * z - uz * y, uz * x - ux * z, ux * y - uy * x
    return (
        x - 2.0 * (w * cx - (uy * cz - uz * cy)),
        y - 2.0 * (w * cy - (uz * cx - ux * cz)),
        z - 2.0 * (w * cz - (ux * cy - uy * cx)),
    )


def _numbers(origin: ET.Element | None) -> Vector:
    return np.zeros(3) if origin is None else np.array([float(word) for word in origin.attrib["xyz"].split()])


def _plate(cell: Vector, corner: Vector) -> Vector:
    """Return the matrix from the forces on the corners to the forces of the cells of one foot, shape (12, 12)."""
    centre = cell.mean(axis=0)
    (a, b), (x, y) = (cell - centre).T[:2], (corner - centre).T[:2]
    matrix = np.zeros((len(cell), 3, len(corner), 3))
    share = 1.0 / len(cell)
    matrix[:, 2, :, 2] = share + np.outer(a, x) / (a @ a) + np.outer(b, y) / (b @ b)
    # A horizontal force on the corner (x, y) has the yaw moment x F_y - y F_x about the centre of the plate. Horizontal forces of
    # the cells, proportional to the distance of each cell from the centre, carry this moment.
    polar = a @ a + b @ b
    matrix[:, 0, :, 0] = share + np.outer(b, y) / polar
    matrix[:, 0, :, 1] = -np.outer(b, x) / polar
    matrix[:, 1, :, 0] = -np.outer(a, y) / polar
    matrix[:, 1, :, 1] = share + np.outer(a, x) / polar
    return matrix.reshape(3 * len(cell), 3 * len(corner))
