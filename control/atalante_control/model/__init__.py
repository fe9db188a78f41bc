"""Model of exoskeleton and patient, shared by gait optimization, controller, emulator and viewers.

`ExoskeletonParameters, Patient -> links (the right leg mirrors the left leg) -> URDF text -> Pinocchio model`. Frames
follow REP-103: x forward, y left, z up. The frame of a link is the frame of its joint. At the zero pose all frames are parallel
except the frames of ankle, foot and contact pads, which are turned outwards by the toe-out angle.
"""

from atalante_control.model.articulated import ArticulatedModel, pinocchio_model
from atalante_control.model.exoskeleton import (
    BASE_LINK,
    LEG_LINKS,
    ExoskeletonParameters,
    imu_link,
    links,
    pad_link,
)
from atalante_control.model.patient import HEIGHT_RANGE, LEG_RANGE, MASS_RANGE, SEGMENTS, Patient
from atalante_control.model.rigid_body import Box, Inertia, Link, Vector3
from atalante_control.model.urdf_writer import urdf, urdf_text

__all__ = [
    "BASE_LINK",
    "HEIGHT_RANGE",
    "LEG_LINKS",
    "LEG_RANGE",
    "MASS_RANGE",
    "SEGMENTS",
    "ArticulatedModel",
    "Box",
    "ExoskeletonParameters",
    "Inertia",
    "Link",
    "Patient",
    "Vector3",
    "imu_link",
    "links",
    "pad_link",
    "pinocchio_model",
    "urdf",
    "urdf_text",
]
