"""DBC names of the drives, IMUs and feet, and of their cyclic messages."""

from __future__ import annotations

from atalante_hal.robot import FEET, IMUS, JOINTS

#: Names of the sensor messages, in the order of JOINTS, IMUS and FEET.
JOINT_MESSAGES = tuple(f"{joint.upper()}_STATE" for joint in JOINTS)
IMU_MESSAGES = tuple(f"IMU_{imu.upper()}_STATE" for imu in IMUS)
FOOT_MESSAGES = tuple(f"FOOT_{foot.upper()}_STATE" for foot in FEET)
#: Names of the nodes that send the sensor messages. The nodes of the joints are the drives.
JOINT_NODES, IMU_NODES, FOOT_NODES = (
    tuple(message.removesuffix("_STATE") for message in messages)
    for messages in (JOINT_MESSAGES, IMU_MESSAGES, FOOT_MESSAGES)
)
#: Names of the IMUs of the trunk.
TRUNK_NODES = tuple(IMU_NODES[IMUS.index(imu)] for imu in ("torso", "pelvis"))
