"""Record of one cycle: a contiguous vector of all its values. The controller's `State` consists of views of this vector.

The process image of the 1 ms messages decodes directly into the record. The whole record is copied to a telemetry ring at once.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from atalante_dbc import Message
from atalante_hal.dbc_names import FOOT_MESSAGES, IMU_MESSAGES, JOINT_MESSAGES
from atalante_hal.record_layout import Layout
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MOTORS
from atalante_hal.types import State, SupervisorState, read_only
from atalante_hal.wire.codec import Codec, group_of

#: Names of the first fields of the record. Each field is one number.
#: The fields "diagnostics" and "diagnostics_high" have one bit per active `Dtc`, see `record_layout.split_bits`.
HEADER_FIELDS = (
    "cycle", "time", "supervisor", "assistance_factor", "cost_us", "lateness_us",
    "overruns", "frames", "crc_errors", "dropped", "diagnostics", "diagnostics_high",
)  # fmt: skip
#: Index of each header field in the record.
(
    CYCLE, TIME, SUPERVISOR, ASSISTANCE_FACTOR, COST, LATENESS,
    OVERRUNS, FRAMES, CRC_ERRORS, DROPPED, DIAGNOSTICS, DIAGNOSTICS_HIGH,
) = range(len(HEADER_FIELDS))  # fmt: skip


class Record:
    """Vector of all values of a cycle, and views of its parts.

    Args:
        codec: Codec of the 1 ms messages, whose values are a part of the record.
        controller_fields: Name and length of each field that the controller records, see `types.Controller`.
    """

    def __init__(self, codec: Codec, controller_fields: Sequence[tuple[str, int]]) -> None:
        self.layout = Layout(_fields(codec, controller_fields))
        self._joint_rows = tuple(codec.rows[message] for message in JOINT_MESSAGES)
        self._imu_rows = tuple(codec.rows[message] for message in IMU_MESSAGES)
        self._foot_rows = tuple(codec.rows[message] for message in FOOT_MESSAGES)
        self.values = np.zeros(self.layout.size)
        # Access to one number of a memoryview takes half as long as access to one number of an array.
        self.header = memoryview(self.values.data).cast("B").cast("d")[: len(HEADER_FIELDS)]
        first = self.layout["motor_position"].start
        self.signals = self.values[first : first + codec.size]
        self.joint_side = self.values[self.layout["position"].start : self.layout["torque"].stop]
        self.motor_side = self.values[self.layout["motor_position"].start : self.layout["motor_torque"].stop]
        #: Position [rad] and velocity [rad/s] of the joints, shape (2, 12).
        self.motion = self.joint_side[: 2 * len(JOINTS)].reshape(2, len(JOINTS))
        #: State and temperature of the drives, shape (24,), in one view, so that one comparison detects any change.
        self.drive_side = self.values[self.layout["drive_state"].start : self.layout["temperature"].stop]
        assert self.drive_side.size == 2 * len(JOINTS)
        self.torque_command = self.values[self.layout["torque_command"]]
        self.level_command = self.values[self.layout["vibration_command"]]
        self.vibration = self.values[self.layout["vibration"]]
        self.controller = self.values[self.layout["vibration_command"].stop :]

    def state(self, assistance_factor: float, messages: int) -> State:
        """Create the state that a controller reads, as read-only views of the record.

        Args:
            assistance_factor: Initial assistance factor Xi, 0 to 1.
            messages: Number of messages monitored every cycle.

        Returns:
            State in OFF, with all messages invalid.
        """
        values, layout = read_only(self.values), self.layout
        return State(
            cycle=0,
            time=0.0,
            supervisor=SupervisorState.OFF,
            assistance_factor=assistance_factor,
            position=values[layout["position"]],
            velocity=values[layout["velocity"]],
            torque=values[layout["torque"]],
            temperature=values[layout["temperature"]],
            drive_state=values[layout["drive_state"]],
            imu_quaternion=values[layout["imu_quaternion"]].reshape(len(IMUS), 4),
            imu_gyro=values[layout["imu_gyro"]].reshape(len(IMUS), 3),
            imu_accel=values[layout["imu_accel"]].reshape(len(IMUS), 3),
            foot_force=values[layout["foot_force"]].reshape(len(FEET), len(CELLS), 3),
            vibration=values[layout["vibration"]],
            valid=np.zeros(messages, np.bool_),
            age=np.zeros(messages, np.int64),
            joints_valid=False,
            joint_rows=self._joint_rows,
            imu_rows=self._imu_rows,
            foot_rows=self._foot_rows,
        )


def _fields(codec: Codec, controller_fields: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return (name, length) of each record field: header, joint-side values, received signals, commands, controller fields."""
    signals: dict[str, int] = {}
    for message, signal in codec.signals:
        name = _field_name(message, group_of(signal.name))
        signals[name] = signals.get(name, 0) + 1
    return [
        *((name, 1) for name in HEADER_FIELDS),
        *((name, len(JOINTS)) for name in ("position", "velocity", "torque")),
        ("vibration", len(MOTORS)),
        *signals.items(),
        ("torque_command", len(JOINTS)),
        ("vibration_command", len(MOTORS)),
        *((f"controller.{name}", length) for name, length in controller_fields),
    ]


#: Quantity in a DBC signal name -> name of its record field. The field name begins with the device that measures the quantity.
_FIELD_NAMES = {
    "Position": "motor_position",
    "Velocity": "motor_velocity",
    "Torque": "motor_torque",
    "Quaternion": "imu_quaternion",
    "Gyro": "imu_gyro",
    "Accel": "imu_accel",
    "Force": "foot_force",
}


def _field_name(message: Message, group: str) -> str:
    if group == "Temperature" and not any(s.name == "DriveState" for s in message.signals):
        return "sensor_temperature"
    if group in _FIELD_NAMES:
        return _FIELD_NAMES[group]
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", group).lower()
    return f"pendant_{name}" if message.name == "PENDANT_STATE" and group not in ("Crc", "Counter") else name
