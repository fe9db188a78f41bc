"""Patient as a set of rigid segments. Winter's table gives mass, centre of mass and inertia of each segment.

The inputs are body mass and body height. The lengths of thigh and shank are optional.
`exoskeleton.links` fuses these segments into the links of the exoskeleton.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_control.model.rigid_body import Box, Inertia, Vector3

MASS_RANGE = (45.0, 110.0)  # kg, smallest and largest mass of a patient
HEIGHT_RANGE = (1.50, 2.00)  # m, smallest and largest height of a patient
#: Adjustment range of thigh and shank [m]. It contains Winter's lengths for every height in `HEIGHT_RANGE`.
LEG_RANGE = (0.30, 0.55)
#: Height of the ankle above the sole, as a fraction of the height of the patient.
ANKLE_HEIGHT = 0.039


@dataclass(frozen=True)
class Segment:
    """Segment of the human body, a row of Winter's table."""

    mass: float  # mass of the segment, as a fraction of the body mass
    centre: float  # distance of the centre of mass from the proximal end, as a fraction of the segment length
    gyration: float  # transverse radius of gyration about the centre of mass, as a fraction of the segment length
    length: float  # length of the segment, as a fraction of the body height
    density: float  # kg/m3, density of the segment


#: Body segments from D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed. 2009.
#: Mass, centre, gyration and density are from table 4.1, length is from figure 4.1 (after Drillis and Contini).
#: HAT is head, arms and trunk. Its length is from hips to shoulders. Its density is the mean of all parts.
#: Thigh, shank and foot are the segments of one side of the body.
SEGMENTS = {
    "HAT": Segment(0.678, 0.626, 0.496, 0.288, 1050.0),
    "thigh": Segment(0.100, 0.433, 0.323, 0.245, 1050.0),
    "shank": Segment(0.0465, 0.433, 0.302, 0.246, 1090.0),
    "foot": Segment(0.0145, 0.5, 0.475, 0.152, 1100.0),
}


@dataclass(frozen=True)
class Patient:
    """Patient in the exoskeleton. A length that is None is computed from the height with Winter's table.

    Raises:
        ValueError: If a number is outside its range; the message states the range.
    """

    mass: float  # kg, body mass
    height: float  # m, body height
    thigh_length: float | None = None  # m, distance from hip to knee
    shank_length: float | None = None  # m, distance from knee to ankle

    def __post_init__(self) -> None:
        for name, value, (low, high), unit in (
            ("mass", self.mass, MASS_RANGE, "kg"),
            ("height", self.height, HEIGHT_RANGE, "m"),
            ("thigh length", self.length("thigh"), LEG_RANGE, "m"),
            ("shank length", self.length("shank"), LEG_RANGE, "m"),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name} of the patient must be {low:g} to {high:g} {unit}, got {value:g} {unit}")

    def length(self, segment: str) -> float:
        """Return the length of a segment [m].

        Args:
            segment: one of `SEGMENTS`.
        """
        given = {"thigh": self.thigh_length, "shank": self.shank_length}.get(segment)
        return SEGMENTS[segment].length * self.height if given is None else given

    def body(self, segment: str, proximal: Vector3, axis: int, direction: int) -> tuple[Box, Inertia]:
        """Return the box (for viewers) and the mass properties of a segment, in the frame of the link that carries it.

        The moment of inertia about the transverse axes is m (`gyration` * length)^2. The table has no moment about the long
        axis of the segment. For this axis, the moment of a square prism with the length and density of the segment is
        used. The box is this prism.

        Args:
            segment: one of `SEGMENTS`.
            proximal: upper end of the segment, or the heel of the foot, in the link frame [m].
            axis: axis of the link parallel to the segment, 0 to 2.
            direction: direction along the axis from the proximal end, +1 or -1.
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
