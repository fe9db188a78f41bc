"""What a plausibility check found, and where in the process image the signals it looks at are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, Vector
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.process_image import NEVER

Cycles = npt.NDArray[np.int64]

#: Messages of the sensors, in the order of JOINTS, IMUS and FEET.
JOINT_MESSAGES = tuple(f"{joint.upper()}_STATE" for joint in JOINTS)
IMU_MESSAGES = tuple(f"IMU_{imu.upper()}_STATE" for imu in IMUS)
FOOT_MESSAGES = tuple(f"FOOT_{foot.upper()}_STATE" for foot in FEET)
#: Nodes that send them.
JOINT_NODES, IMU_NODES, FOOT_NODES = (
    tuple(message.removesuffix("_STATE") for message in messages)
    for messages in (JOINT_MESSAGES, IMU_MESSAGES, FOOT_MESSAGES)
)


@dataclass(frozen=True)
class Finding:
    """One implausibility that stands."""

    dtc: Dtc
    node: str  # DBC name
    value: float  # what was measured; its meaning depends on the code
    confirmed: bool  # False: noticed and not used, but short enough to ride through
    text: str  # one sentence for people


class Signals(NamedTuple):
    """Views of the measured signals in a vector of decoded values; motor side where there is a motor."""

    position: Vector  # (12,) rad
    velocity: Vector  # (12,) rad/s
    torque: Vector  # (12,) Nm at the joint
    quaternion: Vector  # (4, 4) wxyz
    gyro: Vector  # (4, 3) rad/s
    accel: Vector  # (4, 3) m/s2
    force: Vector  # (2, 4, 3) N
    motion: Vector  # (2, 12) position and velocity
    forces: Vector  # (24,) force


class Ages(NamedTuple):
    """Ages of the sensors' values in cycles; from `NEVER` on: too old to be compared with anything."""

    joint: Cycles  # (12,)
    imu: Cycles  # (4,)
    foot: Cycles  # (2,)


class Rows:
    """Rows of the sensors' messages in the image.

    Args:
        codec: of the image; the timeouts of its messages bound the age at which values are still compared.
    """

    def __init__(self, codec: Codec) -> None:
        #: Shapes (12,), (4,), (2,).
        self.joint, self.imu, self.foot = (
            np.array(rows_of(codec, messages)) for messages in (JOINT_MESSAGES, IMU_MESSAGES, FOOT_MESSAGES)
        )
        #: Timeout of each row of the image [cycles].
        self.timeout = np.array([message.timeout_ms for message in codec.messages])

    def ages(self, age: Cycles) -> Ages:
        """Return the ages of the sensors' values.

        Args:
            age: of each row of the image [cycles], shape (rows,).
        """
        usable = np.where(age < self.timeout, age, np.maximum(age, NEVER))
        return Ages(usable[self.joint], usable[self.imu], usable[self.foot])


def measured(codec: Codec) -> slice:
    """Where the measured signals are in the decoded values: signed quantities come first, one after the other."""
    return slice(codec.slice("Position").start, codec.slice("Force").stop)


def signals_of(codec: Codec, values: Vector) -> Signals:
    """Views of `values`, shape (codec.size,) or cut to `measured`."""
    position, velocity, torque, quaternion, gyro, accel, force = (
        codec.slice(quantity) for quantity in ("Position", "Velocity", "Torque", "Quaternion", "Gyro", "Accel", "Force")
    )
    return Signals(
        values[position],
        values[velocity],
        values[torque],
        values[quaternion].reshape(len(IMUS), 4),
        values[gyro].reshape(len(IMUS), 3),
        values[accel].reshape(len(IMUS), 3),
        values[force].reshape(len(FEET), len(CELLS), 3),
        values[position.start : velocity.stop].reshape(2, len(JOINTS)),
        values[force],
    )


def rows_of(codec: Codec, messages: tuple[str, ...]) -> list[int]:
    """Rows of messages in the image."""
    return [codec.rows[message] for message in messages]
