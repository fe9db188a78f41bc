"""The patient as four kinds of rigid segments: `mass, height (, thigh, shank) -> Winter's table -> body of a segment`.

The exoskeleton's links fuse these bodies into their own (`exoskeleton.links`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_control.model.rigid_body import Box, Inertia, Vector3

MASS_RANGE = (45.0, 110.0)  # kg
HEIGHT_RANGE = (1.50, 2.00)  # m
#: Thigh and shank [m] to which the exoskeleton's legs adjust; Winter's lengths of everybody in `HEIGHT_RANGE` are inside.
LEG_RANGE = (0.30, 0.55)
#: Ankle over the sole, over the patient's height.
ANKLE_HEIGHT = 0.039


@dataclass(frozen=True)
class Segment:
    """A row of Winter's table."""

    mass: float  # of the body's mass
    centre: float  # centre of mass from the proximal end, of the segment's length
    gyration: float  # radius about the centre of mass, any axis across the segment, of the segment's length
    length: float  # of the body's height
    density: float  # kg/m3


#: D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed. 2009: tables 4.1 (mass, centre, gyration, density)
#: and figure 4.1 (length, after Drillis and Contini). HAT is head, arms and trunk from the hips to the shoulders, its
#: density that of its parts together; thigh, shank and foot are of one side.
SEGMENTS = {
    "HAT": Segment(0.678, 0.626, 0.496, 0.288, 1050.0),
    "thigh": Segment(0.100, 0.433, 0.323, 0.245, 1050.0),
    "shank": Segment(0.0465, 0.433, 0.302, 0.246, 1090.0),
    "foot": Segment(0.0145, 0.5, 0.475, 0.152, 1100.0),
}


@dataclass(frozen=True)
class Patient:
    """Who wears the exoskeleton. Lengths left out are Winter's for the height.

    Raises:
        ValueError: a number outside its range; the message gives the range.
    """

    mass: float  # kg
    height: float  # m
    thigh_length: float | None = None  # m, hip to knee
    shank_length: float | None = None  # m, knee to ankle

    def __post_init__(self) -> None:
        for name, value, (low, high), unit in (
            ("mass", self.mass, MASS_RANGE, "kg"),
            ("height", self.height, HEIGHT_RANGE, "m"),
            ("thigh length", self.length("thigh"), LEG_RANGE, "m"),
            ("shank length", self.length("shank"), LEG_RANGE, "m"),
        ):
            if not low <= value <= high:
                raise ValueError(f"a patient's {name} is from {low:g} to {high:g} {unit}, not {value:g} {unit}")

    def length(self, segment: str) -> float:
        """Length of one of `SEGMENTS` [m]."""
        given = {"thigh": self.thigh_length, "shank": self.shank_length}.get(segment)
        return SEGMENTS[segment].length * self.height if given is None else given

    def body(self, segment: str, proximal: Vector3, axis: int, direction: int) -> tuple[Box, Inertia]:
        """One of `SEGMENTS` in the frame of a link: how to draw it, and its mass properties.

        The table gives the moments across the segment, m (gyration length)^2. Along it, where the table has none, they
        are those of the square prism of the segment's length and density, which is also what is drawn.

        Args:
            proximal: upper end of the segment, the heel of the foot, in the link frame [m].
            axis: axis of the link the segment lies along, 0 to 2.
            direction: +1 or -1, the way from the proximal end.
        """
        row, length = SEGMENTS[segment], self.length(segment)
        mass = row.mass * self.mass
        width = math.sqrt(mass / (row.density * length))
        across, along = mass * (row.gyration * length) ** 2, mass * width * width / 6.0
        xx, yy, zz = (along if i == axis else across for i in range(3))
        x, y, z = (length if i == axis else width for i in range(3))
        box = Box(mass, _moved(proximal, axis, 0.5 * direction * length), (x, y, z))
        centre = _moved(proximal, axis, row.centre * direction * length)
        return box, Inertia(mass, centre, (xx, 0.0, 0.0, yy, 0.0, zz))


def _moved(point: Vector3, axis: int, distance: float) -> Vector3:
    x, y, z = (value + distance * (i == axis) for i, value in enumerate(point))
    return (x, y, z)
