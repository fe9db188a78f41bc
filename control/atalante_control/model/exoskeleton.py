"""Links of the exoskeleton, with or without a patient: `exoskeleton parameters, optional patient -> links`.

The right leg is the mirror image of the left leg. Each segment of a patient is fused into the link that carries it. The joint
idealization of the controller uses the model of the empty exoskeleton. Gaits are computed with the patient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

from atalante_control.model.patient import ANKLE_HEIGHT, Patient
from atalante_control.model.rigid_body import ZERO, Box, Inertia, Link, Sphere, Vector3
from atalante_hal.robot import CELLS, LEG_JOINTS

BASE_LINK = "pelvis"
#: Name of the link moved by each joint of a leg, without the prefix of the side.
LEG_LINKS = dict(zip(LEG_JOINTS, ("frontal_hip", "transverse_hip", "thigh", "shank", "ankle", "foot"), strict=True))


@dataclass(frozen=True)
class ExoskeletonParameters:
    """Dimensions and masses of an Atalante-like exoskeleton, for the left side. The right side is the mirror image.

    Joint offsets, joint axes, masses, sole dimensions and sensor positions are rounded published values. The positions of the
    masses in their links are assumptions of this project. Thigh and shank are adjusted to the patient.
    """

    thigh_length: float = 0.38  # m, from SH to SK
    shank_length: float = 0.408  # m, from SK to SA

    pelvis_mass: float = 16.5  # kg, pelvis and back
    frontal_hip_mass: float = 3.7  # kg, frontal hip link of one leg; all following masses are also for one leg
    transverse_hip_mass: float = 4.4
    thigh_mass: float = 9.0
    shank_mass: float = 11.0
    ankle_mass: float = 1.7
    foot_mass: float = 3.2  # kg, foot of one leg with its force cells

    fh_offset: Vector3 = (0.0, 0.089, 0.0)  # m, position of joint FH in the pelvis frame
    th_offset: Vector3 = (-0.135, 0.169, 0.0)  # m, position of joint TH in the frontal hip frame
    sh_offset: Vector3 = (0.135, 0.0, 0.0)  # m, position of joint SH in the transverse hip frame
    knee_lateral: float = 0.005  # m, lateral offset of joint SK relative to SH, positive outwards
    ankle_lateral: float = -0.169  # m, lateral offset of joint SA relative to SK, positive outwards
    toe_out: float = math.radians(8.0)  # rad, outward rotation of the foot about the vertical
    ha_axis: Vector3 = (0.788, 0.0, 0.616)  # direction of the HA axis in the foot frame; need not be a unit vector

    sole_size: tuple[float, float] = (0.275, 0.119)  # m, length and width of the sole
    sole_centre: tuple[float, float] = (0.06, -0.165)  # m, x and z of the sole centre relative to the ankle
    cell_x: tuple[float, float] = (0.178, -0.064)  # m, x of front and rear force cells relative to the ankle
    cell_y: float = 0.027  # m, lateral distance of the force cells from the middle of the foot
    pad_radius: float = 0.005  # m, radius of the sphere in each corner of the sole; the spheres touch the sole plane
    pad_mass: float = 0.0015  # kg, mass of each of the 4 contact spheres of a foot; `foot_mass` includes the spheres

    torso_imu: Vector3 = (-0.14, 0.0, 0.50)  # m, position of the torso IMU in the pelvis frame
    pelvis_imu: Vector3 = (-0.164, -0.015, 0.191)  # m, position of the pelvis IMU in the pelvis frame
    #: m, position of the left tibia IMU: x and y relative to joint SK, z relative to joint SA
    tibia_imu: Vector3 = (-0.13, -0.074, 0.018)

    def __post_init__(self) -> None:
        for name in ("thigh_length", "shank_length"):
            if not 0.2 < getattr(self, name) < 0.7:
                raise ValueError(f"{name} must be between 0.2 and 0.7 m, got {getattr(self, name)!r}")
        if not 0.0 < 4 * self.pad_mass < 0.1 * self.foot_mass:
            raise ValueError(
                f"pad_mass must be above 0 and below {self.foot_mass / 40.0:g} kg (1/40 of foot_mass), got {self.pad_mass!r}"
            )

    def fitted(self, patient: Patient) -> ExoskeletonParameters:
        """Return the parameters with thigh and shank adjusted to a patient.

        Args:
            patient: patient whose leg lengths are used.
        """
        return replace(self, thigh_length=patient.length("thigh"), shank_length=patient.length("shank"))


def links(parameters: ExoskeletonParameters, patient: Patient | None = None) -> tuple[Link, ...]:
    """Return all links of the exoskeleton, each parent before its children: pelvis, IMUs of the pelvis, left leg, right leg.

    With a patient, thigh and shank of the exoskeleton get the lengths of the patient, and the segments of the patient
    are fused into the links. Head, arms and trunk are fused into the pelvis. Thigh, shank and foot are fused into
    thigh, shank and foot of the exoskeleton. The names of the links are the same as without a patient.

    Args:
        parameters: geometry and masses of the exoskeleton.
        patient: patient in the exoskeleton, or None for an empty exoskeleton.
    """
    p = parameters if patient is None else parameters.fitted(patient)
    pelvis = Box(p.pelvis_mass, (-0.13, 0.0, 0.12), (0.18, 0.36, 0.40))
    base = Link(BASE_LINK, "", None, ZERO, 0.0, ZERO, pelvis.inertia(), (pelvis,))
    imus = (_imu("torso", BASE_LINK, p.torso_imu), _imu("pelvis", BASE_LINK, p.pelvis_imu))
    left = _left_leg(p)
    if patient is not None:
        segments = _patient_segments(p, patient)
        base, *left = (link.fused(*segments[link.name]) if link.name in segments else link for link in (base, *left))
    return (base, *imus, *left, *(link.mirrored() for link in left))


def imu_link(imu: str) -> str:
    """Return the name of the link that represents an IMU.

    Args:
        imu: one of `IMUS`.
    """
    return f"imu_{imu}"


def pad_link(foot: str, cell: str) -> str:
    """Return the name of the link at a force cell. This link carries the contact sphere of the nearest sole corner.

    The axes of the link are parallel to the axes of the foot.

    Args:
        foot: left or right.
        cell: one of `CELLS`.
    """
    return f"{foot}_foot_{cell}"


def _patient_segments(p: ExoskeletonParameters, patient: Patient) -> dict[str, tuple[Box, Inertia]]:
    """Return the segments of the patient: link name -> box and mass properties of the segment that moves with this link.

    The hip of the patient is the intersection of the axes of FH and SH, the knee is on the axis of SK, and the ankle is at SA.
    The offset `knee_lateral` of the exoskeleton shifts the shank outwards relative to the thigh. The foot is
    centred along the sole.
    """
    hip = (-p.th_offset[0] - p.sh_offset[0], -p.th_offset[1] - p.sh_offset[1], -p.th_offset[2] - p.sh_offset[2])
    heel = (p.sole_centre[0] - 0.5 * patient.length("foot"), 0.0, -0.5 * ANKLE_HEIGHT * patient.height)
    return {
        BASE_LINK: patient.body("HAT", ZERO, axis=2, direction=1),
        "left_thigh": patient.body("thigh", hip, axis=2, direction=-1),
        "left_shank": patient.body("shank", (0.0, p.ankle_lateral, 0.0), axis=2, direction=-1),
        "left_foot": patient.body("foot", heel, axis=0, direction=1),
    }


def _left_leg(p: ExoskeletonParameters) -> list[Link]:
    norm = math.sqrt(math.fsum(a * a for a in p.ha_axis))
    ha_axis = (p.ha_axis[0] / norm, p.ha_axis[1] / norm, p.ha_axis[2] / norm)
    sk, sa = (0.0, p.knee_lateral, -p.thigh_length), (0.0, p.ankle_lateral, -p.shank_length)
    length, width = p.sole_size
    sole_x, sole_z = p.sole_centre
    # The box of each hip link, of the thigh and of the shank reaches to the next joint. The ankle box encloses the ankle motors.
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
    legs: list[Link] = []
    names = [BASE_LINK, *(f"left_{LEG_LINKS[joint]}" for joint in LEG_JOINTS)]
    for (parent, name), (joint, origin, yaw, axis, box) in zip(pairwise(names), chain, strict=True):
        legs.append(Link(name, parent, f"left_{joint}", origin, yaw, axis, box.inertia(), (box,)))
        if joint == "SK":
            x, y, over_ankle = p.tibia_imu
            legs.append(_imu("left_tibia", name, (x, y, over_ankle - p.shank_length)))
    pad = 0.4 * p.pad_mass * p.pad_radius**2
    pad_inertia = Inertia(p.pad_mass, ZERO, (pad, 0.0, 0.0, pad, 0.0, pad))
    for cell in CELLS:
        forward, left = 1 if cell[0] == "F" else -1, 1 if cell[1] == "L" else -1
        x, y = p.cell_x[0] if forward > 0 else p.cell_x[1], left * p.cell_y
        corner = (
            sole_x + forward * (0.5 * length - p.pad_radius) - x,
            left * (0.5 * width - p.pad_radius) - y,
            0.0,
        )
        origin = (x, y, sole_z + p.pad_radius)
        sphere = Sphere(p.pad_radius, corner)
        legs.append(Link(pad_link("left", cell), "left_foot", None, origin, 0.0, ZERO, pad_inertia, pad=sphere))
    return legs


def _imu(imu: str, parent: str, position: Vector3) -> Link:
    return Link(imu_link(imu), parent, None, position, 0.0, ZERO, Inertia(0.0, ZERO, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))


def _half(vector: Vector3) -> Vector3:
    return (0.5 * vector[0], 0.5 * vector[1], 0.5 * vector[2])
