"""Views of the checked signals in the process image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.dbc_names import FOOT_MESSAGES, IMU_MESSAGES, JOINT_MESSAGES
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS
from atalante_hal.types import Vector
from atalante_hal.wire.codec import Codec, group_of
from atalante_hal.wire.process_image import NEVER

Cycles = npt.NDArray[np.int64]

#: Quantities of a joint or IMU message that are rejected together if one of them is implausible.
#: Reason: checks and controllers need values that were measured at the same time.
#: Joints: the limiter, the velocity check and the controllers need position and velocity that were measured at the same time.
#: IMUs: the inertial, trunk, knee and motion checks compare attitude, angular velocity and specific force with each other.
#: All other signals of the frame are used. So a failed or hot drive causes its reaction even if its encoder is wrong.
#: If a position is rejected, the torque of its frame is still used, because no check needs position and torque of the same cycle:
#: - `Stillness` uses the torque only in cycles in which the position was accepted.
#: - `HoldStability` accepts a position that is up to four cycles older than the torque.
#: - All other checks compare the reported torque with the commands, or with the drive state of the same frame.
JUDGED = frozenset({"Position", "Velocity", "Quaternion", "Gyro", "Accel"})


class Signals(NamedTuple):
    """Views of the measured signals in the decoded values. Joint positions and velocities are on the motor side."""

    position: Vector  # (12,) rad
    velocity: Vector  # (12,) rad/s
    torque: Vector  # (12,) Nm at the joint
    quaternion: Vector  # (4, 4) wxyz
    gyro: Vector  # (4, 3) rad/s
    accel: Vector  # (4, 3) m/s2
    force: Vector  # (2, 4, 3) N
    motion: Vector  # (2, 12) `position` and `velocity` as one array
    forces: Vector  # (24,) all components of `force` as one array


class Ages(NamedTuple):
    """Ages of the sensor values [cycles]. A value with an age of at least `NEVER` is too old for any check."""

    joint: Cycles  # (12,)
    imu: Cycles  # (4,)
    foot: Cycles  # (2,)


class Rows:
    """Rows and timeouts of the sensor messages in the process image.

    A check uses only values that are younger than the timeout of their message.

    Args:
        codec: codec of the process image.
    """

    def __init__(self, codec: Codec) -> None:
        #: Rows of the joint messages, shape (12,), the IMU messages, shape (4,), and the foot messages, shape (2,).
        self.joint, self.imu, self.foot = (
            np.array(rows_of(codec, messages)) for messages in (JOINT_MESSAGES, IMU_MESSAGES, FOOT_MESSAGES)
        )
        #: Timeout of each row of the process image [cycles], shape (rows,).
        self.timeout = np.array([message.timeout_ms for message in codec.messages])

    def ages(self, age: Cycles) -> Ages:
        """Return the ages of the sensor values.

        Args:
            age: age of each row of the process image [cycles], shape (rows,).
        """
        usable = np.where(age < self.timeout, age, np.maximum(age, NEVER))
        return Ages(usable[self.joint], usable[self.imu], usable[self.foot])


def measured(codec: Codec) -> slice:
    """Return the slice of the measured signals in the decoded values.

    Args:
        codec: codec of the process image.
    """
    return slice(codec.slice("Position").start, codec.slice("Force").stop)


def signals_of(codec: Codec, values: Vector) -> Signals:
    """Return views of the measured signals.

    Args:
        codec: codec of the process image.
        values: decoded values, shape (codec.size,). An array with only the slice `measured(codec)` is accepted, too.
    """
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


def judged(codec: Codec, row: int) -> npt.NDArray[np.intp]:
    """Return the indices of the signals of a message that have a quantity in `JUDGED`, shape (n,).

    Args:
        codec: codec of the process image.
        row: row of the message.
    """
    own = np.flatnonzero(codec.row_of == row)
    return own[[group_of(codec.signals[index][1].name) in JUDGED for index in own.tolist()]]


def rows_of(codec: Codec, messages: tuple[str, ...]) -> list[int]:
    """Return the rows of messages in the process image."""
    return [codec.rows[message] for message in messages]
