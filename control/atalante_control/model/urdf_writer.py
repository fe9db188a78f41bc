"""Writer of the URDF that PyBullet, Pinocchio and viewers load: `links, robot limits -> URDF`."""

from __future__ import annotations

from collections.abc import Sequence

from atalante_control.model.exoskeleton import ExoskeletonParameters, links
from atalante_control.model.patient import Patient
from atalante_control.model.rigid_body import Link
from atalante_hal.robot import JOINTS, Robot


def urdf(parameters: ExoskeletonParameters, robot: Robot, patient: Patient | None = None) -> str:
    """Return the URDF of the exoskeleton, empty or with a patient.

    The URDF has the joints in `JOINTS`, in this order. Only the eight contact pads have collision shapes. The links of the IMUs
    have no mass. The same parameters give the same text, with all digits of every number.

    Args:
        parameters: geometry and masses of the exoskeleton; each link is a homogeneous box.
        robot: limits of the joints.
        patient: patient in the exoskeleton, or None for an empty exoskeleton.
    """
    return urdf_text(links(parameters, patient), robot)


def urdf_text(bodies: Sequence[Link], robot: Robot) -> str:
    """Return the URDF of a tree of links.

    Args:
        bodies: links of the tree, parents first.
        robot: limits of the joints.
    """
    lines = ['<?xml version="1.0"?>', '<robot name="atalante_like">']
    for link in bodies:
        lines += _link_xml(link)
        if link.parent:
            lines += _joint_xml(link, robot)
    lines.append("</robot>")
    return "\n".join(lines) + "\n"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    # repr() prints all digits. float() is needed, because repr() of a NumPy number also prints its type. Adding 0.0 removes -0.0.
    return repr(float(value) + 0.0)


def _link_xml(link: Link) -> list[str]:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    tensor = " ".join(f'{name}="{_number(value)}"' for name, value in zip(names, link.inertia.tensor, strict=True))
    lines = [
        f'  <link name="{link.name}">',
        "    <inertial>",
        f'      <origin xyz="{_numbers(link.inertia.centre)}"/>',
        f'      <mass value="{_number(link.inertia.mass)}"/>',
        f"      <inertia {tensor}/>",
        "    </inertial>",
    ]
    for box in link.boxes:
        lines += [
            "    <visual>",
            f'      <origin xyz="{_numbers(box.centre)}"/>',
            f'      <geometry><box size="{_numbers(box.size)}"/></geometry>',
            "    </visual>",
        ]
    if link.pad:
        lines += [
            "    <collision>",
            f'      <origin xyz="{_numbers(link.pad.centre)}"/>',
            f'      <geometry><sphere radius="{_number(link.pad.radius)}"/></geometry>',
            "    </collision>",
        ]
    return [*lines, "  </link>"]


def _joint_xml(link: Link, robot: Robot) -> list[str]:
    kind = "revolute" if link.joint else "fixed"
    lines = [
        f'  <joint name="{link.joint or link.name + "_mount"}" type="{kind}">',
        f'    <parent link="{link.parent}"/>',
        f'    <child link="{link.name}"/>',
        f'    <origin xyz="{_numbers(link.origin)}" rpy="0.0 0.0 {_number(link.yaw)}"/>',
    ]
    if link.joint:
        row = JOINTS.index(link.joint)
        low, high = _number(robot.position_min[row]), _number(robot.position_max[row])
        effort, speed = _number(robot.torque_max[row]), _number(robot.velocity_max[row])
        lines += [
            f'    <axis xyz="{_numbers(link.axis)}"/>',
            f'    <limit lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"/>',
        ]
    return [*lines, "  </joint>"]
