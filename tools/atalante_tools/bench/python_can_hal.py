"""Baseline of `hal_cycle`: a HAL cycle written with python-can and cantools.

This HAL processes the same frames as the Atalante HAL, but one frame at a time. The checks of CRC, counter and range,
the guide filter and the limiter are the same. The ages of values, the state machine, the telemetry record and HOLD are
missing, which saves time. The bus is the in-process `virtual` bus of python-can. The time in which the nodes send
frames is not measured.
"""

from __future__ import annotations

from binascii import crc_hqx
from typing import Any

import can
import cantools
import numpy as np

from atalante_dbc import DBC_FILE
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, LEG_JOINTS, SIDES
from atalante_hal.safety.limiter import Limiter
from atalante_hal.wire.cia402 import Controlword
from atalante_hal.wire.e2e import CRC_START, data_id_bytes
from atalante_tools.bench.nodes import FilterOnly, Recording, Walk, syncs


class VirtualNodes:
    """Replay of recorded node frames on a python-can `virtual` bus."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._bus = can.Bus(interface="virtual", channel="bench")

    def answer(self, cycles: int) -> list[int]:
        """Send the recorded frames of the next cycles to the HAL, and return the number of frames in each cycle.

        Frames that the HAL has sent are discarded.

        Args:
            cycles: number of cycles.
        """
        while self._bus.recv(0.0) is not None:
            pass
        return [self._answer_one() for _ in range(cycles)]

    def _answer_one(self) -> int:
        count = self._recording.play()
        for row in range(count):
            frame = self._recording.frames[row]
            data = frame["data"][: frame["len"]].tobytes()
            self._bus.send(
                can.Message(
                    arbitration_id=int(frame["can_id"]),
                    data=data,
                    is_extended_id=False,
                    is_fd=True,
                    bitrate_switch=True,
                )
            )
        return count

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()


class PythonCanHal:
    """HAL written with python-can and cantools. Each call of `cycle` runs one cycle and updates the public arrays."""

    def __init__(self, walk: Walk, recording: Recording, controller: FilterOnly) -> None:
        network, robot = walk.network, walk.robot
        self.recording = recording
        self._database = cantools.database.Database()
        self._database.add_dbc_file(str(DBC_FILE))
        self._signals = {m.frame_id: m.signals for m in self._database.messages}
        self._data_id = {m.frame_id: data_id_bytes(m.data_id) for m in network.messages}
        self._syncs = [m.frame_id for m in syncs(network)]
        self.bus = can.Bus(interface="virtual", channel="bench")
        self._legs = [network.message(f"COMMAND_{side.upper()}_LEG").frame_id for side in SIDES]
        self._haptics = network.message("HAPTICS_COMMAND").frame_id
        self._levels = [s.name for s in network.message("HAPTICS_COMMAND").signals if s.name.endswith("_Level")]
        self._cyclic = {m.frame_id for m in recording.cyclic}
        self._joint = {network.message(f"{name.upper()}_STATE").frame_id: i for i, name in enumerate(JOINTS)}
        self._imu = {network.message(f"IMU_{name.upper()}_STATE").frame_id: i for i, name in enumerate(IMUS)}
        self._foot = {network.message(f"FOOT_{name.upper()}_STATE").frame_id: i for i, name in enumerate(FEET)}
        self._per_turn = (robot.polarity / robot.gear).tolist()
        self._torque_max = robot.torque_max.tolist()
        self._limiter = Limiter(robot, 1e-3)
        self._controller = controller
        self._torque = np.zeros(len(JOINTS))
        self._last_counter: dict[int, int] = {}
        self._counter: dict[int, int] = {}
        self._cycle = 0
        self.rejected = 0
        joints = np.zeros((5, len(JOINTS)))
        self._motion = joints[:2]
        self.position, self.velocity, self.torque, self.temperature, self.drive_state = joints
        self.imu_quaternion, self.imu_gyro, self.imu_accel = (np.zeros((len(IMUS), n)) for n in (4, 3, 3))
        self.foot_force = np.zeros((len(FEET), len(CELLS), 3))
        self.slow: dict[int, dict[str, Any]] = {}
        self.pendant: dict[str, Any] = {}

    def cycle(self, count: int) -> None:
        """Run one cycle: send SYNC, receive frames, run the guide filter and the limiter, send commands.

        Args:
            count: number of frames that the nodes sent in this cycle.
        """
        self._cycle += 1
        for frame_id in self._syncs:
            self._send(frame_id, {"HalState": 2, "Cycle": self._cycle})
        missing = set(self._cyclic)
        for _ in range(count):
            message = self.bus.recv(0.0)
            if message is not None and self._receive(message):
                missing.discard(message.arbitration_id)
        self.rejected += len(missing)
        self._controller.filter(self._torque, *self.position[2:4].tolist(), *self.velocity[2:4].tolist())
        self._limiter.apply(self._torque, self._motion)
        torque = self._limiter.last.tolist()
        for side, frame_id in enumerate(self._legs):
            values: dict[str, float] = {}
            for i, joint in enumerate(LEG_JOINTS, start=side * len(LEG_JOINTS)):
                values[f"{joint}_Controlword"] = Controlword.ENABLE_OPERATION
                values[f"{joint}_TargetTorque"] = torque[i]
                values[f"{joint}_MaxTorque"] = self._torque_max[i]
            self._send(frame_id, values)
        self._send(self._haptics, dict.fromkeys(self._levels, 0.25))

    def _send(self, frame_id: int, values: dict[str, float]) -> None:
        counter = self._counter[frame_id] = (self._counter.get(frame_id, 255) + 1) & 0xFF
        values["Crc"], values["Counter"] = 0, counter
        data = bytearray(self._database.encode_message(frame_id, values))
        crc = crc_hqx(self._data_id[frame_id], crc_hqx(data[2:], CRC_START))
        data[:2] = crc.to_bytes(2, "little")
        self.bus.send(
            can.Message(arbitration_id=frame_id, data=data, is_extended_id=False, is_fd=True, bitrate_switch=True)
        )

    def _receive(self, message: can.Message) -> bool:
        frame_id, data = message.arbitration_id, message.data
        if crc_hqx(self._data_id[frame_id], crc_hqx(data[2:], CRC_START)) != data[0] | data[1] << 8:
            self.rejected += 1
            return False
        counter = data[2]
        last = self._last_counter.get(frame_id)
        self._last_counter[frame_id] = counter
        if last is not None and not 1 <= (counter - last) & 0xFF <= 5:
            self.rejected += 1
            return False
        values: Any = self._database.decode_message(frame_id, bytes(data), decode_choices=False)
        for signal in self._signals[frame_id]:
            if not signal.minimum <= values[signal.name] <= signal.maximum:
                self.rejected += 1
                return False
        self._store(frame_id, values)
        return True

    def _store(self, frame_id: int, values: dict[str, Any]) -> None:
        if (joint := self._joint.get(frame_id)) is not None:
            self.position[joint] = values["Position"] * self._per_turn[joint]
            self.velocity[joint] = values["Velocity"] * self._per_turn[joint]
            self.torque[joint] = values["Torque"]
            self.temperature[joint] = values["Temperature"]
            self.drive_state[joint] = values["DriveState"]
        elif (imu := self._imu.get(frame_id)) is not None:
            self.imu_quaternion[imu] = [values[f"Quaternion{axis}"] for axis in "WXYZ"]
            self.imu_gyro[imu] = [values[f"Gyro{axis}"] for axis in "XYZ"]
            self.imu_accel[imu] = [values[f"Accel{axis}"] for axis in "XYZ"]
        elif (foot := self._foot.get(frame_id)) is not None:
            self.foot_force[foot] = [[values[f"{cell}_Force{axis}"] for axis in "XYZ"] for cell in CELLS]
        elif frame_id in self._cyclic:
            self.pendant = values
        else:
            self.slow[frame_id] = values
