"""Injected faults inside the nodes: faults of drives, supply, encoders, status messages and sensor values.

body -> NodeFaults.begin -> encoders, drives -> true values + noise -> NodeFaults.rewrite -> frames
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from atalante_dbc import Network
from atalante_emulator.drive import NODES, Drives
from atalante_emulator.emergency import ERROR_RESET, Emergency, register_of
from atalante_emulator.faults import ALL_CELLS, NODE_KINDS, SENSOR_KINDS, Fault, FaultError, nodes_of
from atalante_emulator.haptics import Haptics
from atalante_emulator.heartbeat import Heartbeats
from atalante_emulator.supply import HoldUp
from atalante_hal.robot import CELLS, Robot
from atalante_hal.types import PERIOD, Vector
from atalante_hal.wire.cia402 import AUTOMATIC, DriveState
from atalante_hal.wire.codec import Codec, group_of

Nodes = Sequence[str]

#: Quantities that IMUs and feet measure.
_MEASURED: Final = ("Quaternion", "Gyro", "Accel", "Force")


class NodeFaults:
    """Node faults and sensor faults of one emulator. `begin` and `rewrite` apply the faults in each cycle."""

    def __init__(
        self,
        faults: Sequence[Fault],
        network: Network,
        robot: Robot,
        codec: Codec,
        drives: Drives,
        haptics: Haptics,
        heartbeats: Heartbeats,
        outbox: list[Emergency],
    ) -> None:
        """Connect the faults to the nodes.

        Args:
            faults: faults to inject. Faults that are neither node faults nor sensor faults are ignored.
            network: nodes and messages of the DBC.
            robot: torque limits of the joints, from which the energy consumption of the drives is computed.
            codec: codec of the 1 ms messages.
            drives: emulated drives.
            haptics: emulated haptics node.
            heartbeats: status messages of all nodes.
            outbox: list to which the emergency messages of nodes other than drives are appended.

        Raises:
            FaultError: If a target does not exist or is not emulated, or the fault does not apply to this kind of node.
        """
        self._network, self._robot, self._codec = network, robot, codec
        self._haptics_nodes = [node.name for node in network.of_kind("haptics")]
        self._drives, self._haptics, self._heartbeats, self._outbox = drives, haptics, heartbeats, outbox
        self._faults = [(fault, nodes_of(fault, network)) for fault in faults if fault.kind in NODE_KINDS]
        self._sensors = [(fault, nodes_of(fault, network)[0]) for fault in faults if fault.kind in SENSOR_KINDS]
        for fault, nodes in self._faults:
            if missing := set(nodes) - heartbeats.nodes:
                raise FaultError(f"{fault.kind}: the target must be an emulated node, got {', '.join(sorted(missing))}")
        self.rewrites = bool(self._sensors)
        self._position: Vector = np.zeros(len(NODES))  # joint positions that the encoders measure [rad]
        self._stuck_at: dict[Fault, float] = {}
        self._frozen: dict[Fault, Vector] = {}
        self._hold_up: dict[Fault, HoldUp] = {}

    def begin(self, cycle: int, position: Vector) -> Vector:
        """Apply the active node faults, and end each fault in the cycle `fault.end`.

        Args:
            cycle: number of the cycle.
            position: true joint positions, shape (12,) [rad].

        Returns:
            Joint positions that the encoders measure, including the encoder faults, shape (12,) [rad].
        """
        self._position = position.copy()
        ending = [(fault, nodes) for fault, nodes in self._faults if cycle == fault.end]
        active = [(fault, nodes) for fault, nodes in self._faults if fault.start <= cycle < fault.end]
        # First end the faults of `ending`, then apply the faults of `active`.
        # Otherwise the end of a fault could cancel an active fault of the same node.
        for fault, nodes in ending + active:
            _EFFECTS[fault.kind](self, fault, nodes, cycle)
        return self._position

    def rewrite(self, cycle: int, values: Vector) -> None:
        """Apply the active sensor faults to the values of this cycle, before these values are sent.

        Args:
            cycle: number of the cycle.
            values: values of the 1 ms messages in DBC units, shape (codec.size,). Updated here.
        """
        for fault, node in self._sensors:
            if fault.start <= cycle < fault.end:
                _SENSOR_EFFECTS[fault.kind](self, fault, node, values)

    # -- drives ------------------------------------------------------------------------------------------------------

    def _emergency(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        (node,), code = nodes, fault["code"]
        if node in NODES:
            if cycle < fault.end:
                # Repeat the error in each cycle: the drive itself can end the error, for example when its winding is cool.
                self._drives.fail(NODES.index(node), code, persists=True)
            else:
                self._drives.recover(NODES.index(node), code)
        elif cycle == fault.start:
            self._outbox.append(Emergency(node, register_of([code]), code))
        elif cycle == fault.end:
            self._outbox.append(Emergency(node, register_of([]), ERROR_RESET))

    def _leave_operation(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        drive = _drive(nodes)
        if cycle < fault.end:
            self._drives.leave(drive, DriveState[fault["state"]])
        elif self._drives.state[drive] in AUTOMATIC:
            self._drives.leave(drive, AUTOMATIC[self._drives.state[drive]])

    def _enable_delay(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._drives.enable_delay[_drive(nodes)] = fault["by"] if cycle < fault.end else 0

    def _reset(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        """Keep a node in reset during the fault, and boot the node at the end of the fault.

        During the fault, `link` drops the frames of the node. A drive or the haptics node is also reset in each cycle.
        """
        (node,) = nodes
        if cycle == fault.end:
            self._heartbeats.boot(node, cycle)
        elif node in NODES:
            self._drives.reset(NODES.index(node))
        elif node in self._haptics_nodes:
            self._haptics.reset()

    def _push(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._drives.motors.push(_drive(nodes), fault["torque"] if cycle < fault.end else 0.0)

    def _torque_weak(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._drives.motors.set_strength(_drive(nodes), fault["share"] if cycle < fault.end else 1.0)

    def _torque_wrong(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._drives.motors.set_gain(_drive(nodes), fault["share"] if cycle < fault.end else 1.0)

    def _torque_late(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._drives.motors.delay(_drive(nodes), fault["by"] if cycle < fault.end else 0)

    def _over_temperature(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            self._drives.heat(_drive(nodes), fault["degrees"])

    def _heat_ramp(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            temperature = float(self._drives.motors.temperature[_drive(nodes)])
            self._drives.heat(_drive(nodes), min(temperature + fault["rate"] * PERIOD, fault["up_to"]))

    # -- supply ------------------------------------------------------------------------------------------------------

    def _under_voltage(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        self._supply(nodes, fault["volts"] if cycle < fault.end else self._drives.parameters.supply)

    def _battery_removed(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        voltage = self._drives.parameters.supply
        if cycle < fault.end:
            link = self._hold_up.setdefault(fault, HoldUp(self._robot, fault["capacity"], voltage))
            voltage = link.draw(self._drives.signals.torque, self._drives.encoders.speed)
        self._supply(nodes, voltage)

    def _supply(self, nodes: Nodes, voltage: float) -> None:
        for node in nodes:
            self._drives.supply(NODES.index(node), voltage)
            self._heartbeats.set(node, "SupplyVoltage", voltage)

    # -- encoders ----------------------------------------------------------------------------------------------------

    def _encoder_stuck(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            drive = _drive(nodes)
            self._position[drive] = self._stuck_at.setdefault(fault, float(self._position[drive]))

    def _encoder_jump(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            self._position[_drive(nodes)] += fault["by"]

    def _encoder_drift(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            self._position[_drive(nodes)] += fault["rate"] * (cycle - fault.start) * PERIOD

    def _encoder_swapped(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        if cycle < fault.end:
            pair = [_drive(nodes), NODES.index(fault["other"])]
            self._position[pair] = self._position[pair[::-1]]

    # -- status of a node --------------------------------------------------------------------------------------------

    def _dbc_hash(self, fault: Fault, nodes: Nodes, cycle: int) -> None:
        (node,) = nodes
        self._heartbeats.set(node, "DbcHash", fault["hash"] if cycle < fault.end else self._network.hash32)

    # -- sensors -----------------------------------------------------------------------------------------------------

    def _measured(self, node: str) -> list[int]:
        """Return the signal indices of the values that an IMU or a foot measures."""
        return [
            index
            for index, (message, signal) in enumerate(self._codec.signals)
            if message.sender == node and group_of(signal.name) in _MEASURED
        ]

    def _imu_invalid(self, fault: Fault, node: str, values: Vector) -> None:
        values[self._measured(node)] = np.nan

    def _imu_saturated(self, fault: Fault, node: str, values: Vector) -> None:
        for index in self._measured(node):
            signal = self._codec.signals[index][1]
            if not signal.name.startswith("Quaternion"):
                values[index] = signal.maximum

    def _imu_frozen(self, fault: Fault, node: str, values: Vector) -> None:
        indices = self._measured(node)
        values[indices] = self._frozen.setdefault(fault, values[indices])

    def _cell_stuck(self, fault: Fault, node: str, values: Vector) -> None:
        values[self._codec.index(f"{node}_STATE", f"{fault['cell']}_ForceZ")] = fault["force"]

    def _cells(self, fault: Fault, node: str) -> list[int]:
        """Return the signal indices of the vertical forces that a fault affects."""
        cells = CELLS if fault["cell"] == ALL_CELLS else (fault["cell"],)
        return [self._codec.index(f"{node}_STATE", f"{cell}_ForceZ") for cell in cells]

    def _cell_offset(self, fault: Fault, node: str, values: Vector) -> None:
        values[self._cells(fault, node)] += fault["force"]

    def _cell_inverted(self, fault: Fault, node: str, values: Vector) -> None:
        values[self._cells(fault, node)] *= -1.0

    def _imu_inverted(self, fault: Fault, node: str, values: Vector) -> None:
        for quantity in ("Gyro", "Accel"):
            values[self._codec.index(f"{node}_STATE", quantity + fault["axis"])] *= -1.0

    def _imu_turned(self, fault: Fault, node: str, values: Vector) -> None:
        """Change the readings of an IMU as if the IMU were turned in its mount."""
        indices = self._measured(node)
        quaternion, gyro, accel = np.split(values[indices], [4, 7])
        angle, axis = math.radians(fault["degrees"]), np.eye(3)["XYZ".index(fault["axis"])]
        cosine, sine = math.cos(angle / 2.0), math.sin(angle / 2.0) * axis
        w, vector = quaternion[0], quaternion[1:]
        attitude = np.array([w * cosine - vector @ sine, *(w * sine + cosine * vector + np.cross(vector, sine))])
        values[indices] = np.concatenate(
            [
                math.copysign(1.0, attitude[0]) * attitude,
                *(
                    math.cos(angle) * seen
                    + math.sin(angle) * np.cross(seen, axis)
                    + (1.0 - math.cos(angle)) * (axis @ seen) * axis
                    for seen in (gyro, accel)
                ),
            ]
        )

    def _sensor_swapped(self, fault: Fault, node: str, values: Vector) -> None:
        mine, others = self._measured(node), self._measured(fault["other"])
        values[[*mine, *others]] = values[[*others, *mine]]


def _drive(nodes: Nodes) -> int:
    (node,) = nodes
    return NODES.index(node)


_EFFECTS: Final[dict[str, Callable[[NodeFaults, Fault, Nodes, int], None]]] = {
    "emergency": NodeFaults._emergency,
    "leave_operation": NodeFaults._leave_operation,
    "enable_delay": NodeFaults._enable_delay,
    "reset": NodeFaults._reset,
    "push": NodeFaults._push,
    "torque_weak": NodeFaults._torque_weak,
    "torque_wrong": NodeFaults._torque_wrong,
    "torque_late": NodeFaults._torque_late,
    "over_temperature": NodeFaults._over_temperature,
    "heat_ramp": NodeFaults._heat_ramp,
    "under_voltage": NodeFaults._under_voltage,
    "battery_removed": NodeFaults._battery_removed,
    "encoder_stuck": NodeFaults._encoder_stuck,
    "encoder_jump": NodeFaults._encoder_jump,
    "encoder_drift": NodeFaults._encoder_drift,
    "encoder_swapped": NodeFaults._encoder_swapped,
    "dbc_hash": NodeFaults._dbc_hash,
}
_SENSOR_EFFECTS: Final[dict[str, Callable[[NodeFaults, Fault, str, Vector], None]]] = {
    "imu_invalid": NodeFaults._imu_invalid,
    "imu_saturated": NodeFaults._imu_saturated,
    "imu_frozen": NodeFaults._imu_frozen,
    "cell_stuck": NodeFaults._cell_stuck,
    "cell_offset": NodeFaults._cell_offset,
    "cell_inverted": NodeFaults._cell_inverted,
    "imu_inverted": NodeFaults._imu_inverted,
    "imu_turned": NodeFaults._imu_turned,
    "sensor_swapped": NodeFaults._sensor_swapped,
}
