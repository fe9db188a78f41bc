"""Geometry of the two soles, and the forces that they pass on to the force cells.

A sole is a rigid plate below four force cells. `read_soles` reads the positions of cells and sole corners from a URDF.
`Soles.plate` computes how forces on the corners load the cells.

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
    """Positions of force cells and sole corners. Each position is in the frame of its own foot link.

    Both arrays have shape (2, 4, 3) [m]. The indices count the foot (order FEET), the cell or corner (order CELLS) and the axis.
    """

    cell: Vector  # centre of each force cell, shape (2, 4, 3) [m]
    corner: Vector  # sole corner next to each force cell: point that touches the floor, shape (2, 4, 3) [m]

    def plate(self) -> Vector:
        """Return the matrix P of `cell forces = P @ corner forces` for both feet, shape (24, 24).

        Cell forces and corner forces are flattened arrays of shape (2, 4, 3): foot, cell or corner, axis.
        """
        count = 3 * len(CELLS)
        matrix = np.zeros((len(FEET) * count, len(FEET) * count))
        for foot in range(len(FEET)):
            rows = slice(foot * count, (foot + 1) * count)
            matrix[rows, rows] = _plate(self.cell[foot], self.corner[foot])
        return matrix

    def lowest(self, foot: int, position: Vector, attitude: Vector) -> float:
        """Return the world height of the lowest corner of one sole [m].

        Args:
            foot: index of the foot in FEET.
            position: position of the foot in the world, shape (3,) [m].
            attitude: quaternion xyzw from the foot frame to the world, shape (4,).
        """
        x, y, z, w = attitude
        up = np.array([2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)])
        return float(position[2] + (self.corner[foot] @ up).min())


def read_soles(urdf: str) -> Soles:
    """Read the positions of force cells and sole corners from a URDF.

    The URDF has one link (contact pad) at each force cell. The pad carries one sphere. Its lowest point is the sole corner.

    Args:
        urdf: text of the URDF.

    Raises:
        ValueError: If the text is not a URDF, or a contact pad is missing.
    """
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ValueError(f"the URDF must be valid XML, got invalid XML: {error}") from error
    cell, corner = np.zeros((2, len(FEET), len(CELLS), 3))
    for i, foot in enumerate(FEET):
        for k, name in enumerate(CELLS):
            pad = f"{foot}_foot_{name}"
            mount = root.find(f"joint/child[@link='{pad}']/../origin")
            collision = root.find(f"link[@name='{pad}']/collision")
            sphere = None if collision is None else collision.find("geometry/sphere")
            if mount is None:
                raise ValueError(
                    f"in the URDF, contact pad {pad} must be attached by a joint with an origin, got no such joint"
                )
            if collision is None or sphere is None:
                raise ValueError(
                    f"in the URDF, contact pad {pad} must be a link with a collision sphere, got no such link"
                )
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
    """Convert a vector from world axes to the axes of a rotated frame.

    Numba-compiled functions call this function.

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
    """Return the matrix P of `cell forces = P @ corner forces` for one foot, shape (12, 12).

    Cell forces and corner forces are flattened arrays of shape (4, 3): cell or corner, axis.
    """
    centre = cell.mean(axis=0)
    (a, b), (x, y) = (cell - centre).T[:2], (corner - centre).T[:2]
    matrix = np.zeros((len(cell), 3, len(corner), 3))
    share = 1.0 / len(cell)
    matrix[:, 2, :, 2] = share + np.outer(a, x) / (a @ a) + np.outer(b, y) / (b @ b)
    # A horizontal force (F_x, F_y) on the corner (x, y) exerts the yaw moment x F_y - y F_x about the centre of the plate.
    # Each cell resists the moment by a horizontal force. The force is proportional to the distance of the cell from the centre.
    polar = a @ a + b @ b
    matrix[:, 0, :, 0] = share + np.outer(b, y) / polar
    matrix[:, 0, :, 1] = -np.outer(b, x) / polar
    matrix[:, 1, :, 0] = -np.outer(a, y) / polar
    matrix[:, 1, :, 1] = share + np.outer(a, x) / polar
    return matrix.reshape(3 * len(cell), 3 * len(corner))
