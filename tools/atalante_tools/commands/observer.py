"""Passive observer of a bus: reads the frames of all nodes and reports their state.

frames -> process image of all messages -> Report
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from atalante_dbc import Message, Network, Node, wire_time
from atalante_hal.dbc_names import JOINT_MESSAGES
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import by_number
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Names of the signals that contain a node state. The report shows the first of these signals that the node sends.
_STATES: Final = ("HalState", "DriveState", "ImuState", "FootState", "NodeState")
#: Milliseconds per second.
MS: Final = 1000.0
#: Largest age of the last frame of the HAL or of the pendant [ms]. A sender with an older frame is considered lost.
LOST_AGE: Final = 500


@dataclass(frozen=True)
class NodeReport:
    """State of one node, read from its frames. A field is None until the node sends it."""

    node: str
    kind: str
    #: Time since the last frame of the messages with the shortest period (see `Observer._fast`) [ms].
    #: None before the first of these frames.
    age_ms: int | None
    late: bool  # whether `age_ms` exceeds the message timeout in the DBC
    #: Time since the last status message of the node [ms]. None before the first status message.
    status_age_ms: int | None
    status_late: bool  # whether `status_age_ms` exceeds the message timeout in the DBC
    state: str | None
    dbc_ok: bool | None
    supply_v: float | None
    temperature_degc: float | None
    error_flags: int | None
    emergency: str | None  # error code and error register of the last emergency


@dataclass(frozen=True)
class JointReport:
    """State of one joint, on the output side of its gear. A field is None until a frame is received."""

    joint: str
    position_deg: float | None
    velocity_deg_s: float | None
    torque_nm: float | None
    drive_state: str | None


@dataclass(frozen=True)
class Report:
    """State of all nodes and joints.

    The fields `load`, `frames`, `foreign`, `crc_errors` and `dropped` cover the time since the previous report.
    """

    seconds: float
    supervisor: str | None
    cycle: int | None
    assistance_factor: float | None
    overruns: int | None
    diagnostic: str | None  # most severe active diagnostic. None if no diagnostic is active.
    dead_man: bool | None
    nodes: tuple[NodeReport, ...]
    joints: tuple[JointReport, ...]
    load: dict[str, tuple[float, float]]  # bus -> (measured load, worst-case load computed from the DBC), each 0 to 1
    frames: int
    foreign: int  # number of frames with an identifier that is not in the DBC
    crc_errors: int
    dropped: int
    link: str = ""  # error message of the lost link to the bus; empty if the link works


class Observer:
    """Observer of a bus: collects the frames of all nodes and makes reports from them."""

    def __init__(self, network: Network, robot: Robot, now: float) -> None:
        """Start the observation of a bus.

        Args:
            network: Nodes and messages of the DBC.
            robot: Gear ratios and polarities, which convert motor values to joint values.
            now: Current time [s].
        """
        self._network, self._robot = network, robot
        self._image = ReceiveImage(network.messages)
        self._wire_time = {
            m.frame_id: (m.bus, wire_time(m.length, network.nominal_bitrate, network.data_bitrate))
            for m in network.messages
        }
        self._worst = network.bus_load()
        self.begin(now)

    def begin(self, now: float, dropped: int = 0) -> None:
        """Begin the measurement of ages, bus load and counts. Call this as soon as the bus is open.

        Args:
            now: Current time [s].
            dropped: Number of frames that the bus has already dropped. The reports do not count them.
        """
        self._aged_to = now
        self._begin(now, dropped)

    def _begin(self, now: float, dropped: int) -> None:
        self._since, self._dropped, self._crc_errors = now, dropped, self._image.crc_errors
        self._busy = dict.fromkeys(self._network.buses, 0.0)
        self._frames = self._foreign = 0

    def accept(self, frames: Frames, count: int, now: float) -> None:
        """Update the process image with received frames.

        Args:
            frames: Buffer with the new frames in its first `count` elements.
            count: Number of new frames.
            now: Current time [s].
        """
        elapsed = int((now - self._aged_to) * MS)
        self._aged_to += elapsed / MS
        self._image.new_cycle(elapsed)
        if not count:
            return
        foreign = self._image.accept_each(frames, count)
        self._frames += count
        self._foreign += len(foreign)
        for frame_id in frames["can_id"][:count].tolist():
            known = self._wire_time.get(frame_id)
            if known is not None:
                self._busy[known[0]] += known[1]

    def report(self, now: float, dropped: int = 0) -> Report:
        """Return the current report, and restart the measurement of bus load and counts.

        Args:
            now: Current time [s].
            dropped: Number of frames that the bus has dropped since it was opened.
        """
        hal = next(node for node in self._network.nodes if node.kind == "master")
        sync = max(self._fast(hal), key=lambda m: -self._age(m))
        pendant = self._network.message("PENDANT_STATE")
        diagnostic = self._value("HAL_STATUS", "DiagnosticCode")
        cycle, overruns = self._value(sync.name, "Cycle"), self._value("HAL_STATUS", "Overruns")
        dead_man = self._value(pendant.name, "DeadMan")
        seconds = max(now - self._since, 1e-9)
        report = Report(
            seconds=seconds,
            supervisor=self._choice(sync.name, "HalState"),
            cycle=None if cycle is None else int(cycle),
            assistance_factor=self._value("HAL_STATUS", "AssistanceFactor"),
            overruns=None if overruns is None else int(overruns),
            diagnostic=by_number(int(diagnostic or 0)),
            dead_man=None if dead_man is None or self._age(pendant) > LOST_AGE else bool(dead_man),
            nodes=tuple(self._node(node) for node in self._network.nodes),
            joints=tuple(self._joint(index) for index in range(len(JOINTS))),
            load={bus: (self._busy[bus] / seconds, self._worst[bus]) for bus in self._network.buses},
            frames=self._frames,
            foreign=self._foreign,
            crc_errors=self._image.crc_errors - self._crc_errors,
            dropped=dropped - self._dropped,
        )
        self._begin(now, dropped)
        return report

    def _fast(self, node: Node) -> list[Message]:
        """Return the messages of a node that have the shortest period of all its periodic messages.

        For the HAL, return only the SYNC messages. The commands have the same period, but the HAL does not always send commands.
        """
        cyclic = [m for m in self._network.sent_by(node.name) if m.cycle_ms]
        fastest = min(m.cycle_ms for m in cyclic)
        if node.kind == "master":
            return [m for m in cyclic if m.name.startswith("SYNC_")]
        return [m for m in cyclic if m.cycle_ms == fastest]

    def _age(self, message: Message) -> int:
        return int(self._image.age[self._image.codec.rows[message.name]])

    def _late(self, message: Message) -> bool:
        return self._age(message) > message.timeout_ms

    def _node(self, node: Node) -> NodeReport:
        message = min(self._fast(node), key=self._age)
        status = f"{node.name}_STATUS"
        age, status_age = self._age(message), self._age(self._network.message(status))
        states = [self._choice(m, s) for s in _STATES for m in (message.name, status)]
        received_hash = self._value(status, "DbcHash")
        flags = self._value(status, "ErrorFlags")
        return NodeReport(
            node=node.name,
            kind=node.kind,
            age_ms=None if age >= NEVER else age,
            late=self._late(message),
            status_age_ms=None if status_age >= NEVER else status_age,
            status_late=self._late(self._network.message(status)),
            state=next((state for state in states if state is not None), None),
            dbc_ok=None if received_hash is None else received_hash == self._network.hash32,
            supply_v=self._value(status, "SupplyVoltage"),
            temperature_degc=self._value(message.name, "Temperature"),
            error_flags=None if flags is None else int(flags),
            emergency=self._emergency(node),
        )

    def _emergency(self, node: Node) -> str | None:
        register, code = (self._value(f"{node.name}_EMCY", signal) for signal in ("ErrorRegister", "ErrorCode"))
        return None if register is None or code is None else f"0x{int(code):04X} (register 0x{int(register):02X})"

    def _joint(self, index: int) -> JointReport:
        message = JOINT_MESSAGES[index]
        ratio = float(self._robot.polarity[index] / self._robot.gear[index])
        position, velocity = self._value(message, "Position"), self._value(message, "Velocity")
        torque = self._value(message, "Torque")
        return JointReport(
            joint=JOINTS[index],
            position_deg=None if position is None else math.degrees(position * ratio),
            velocity_deg_s=None if velocity is None else math.degrees(velocity * ratio),
            torque_nm=None if torque is None else torque * float(self._robot.polarity[index]),
            drive_state=self._choice(message, "DriveState"),
        )

    def _value(self, message: str, signal: str) -> float | None:
        """Return the last valid value of a signal. Return None for an unknown signal or a message that was never received."""
        row = self._image.codec.rows.get(message)
        if row is None or self._image.age[row] >= NEVER:
            return None
        if not any(s.name == signal for s in self._network.message(message).signals):
            return None
        return float(self._image.values[self._image.codec.index(message, signal)])

    def _choice(self, message: str, signal: str) -> str | None:
        value = self._value(message, signal)
        if value is None:
            return None
        choices = self._network.message(message).signal(signal).choices
        return choices.get(int(value), f"{int(value)}?")


def as_json(report: Report) -> dict[str, Any]:
    """Convert a report to a JSON object.

    Args:
        report: Report to convert.
    """
    value = asdict(report)
    value["load"] = {bus: {"measured": load[0], "worst_case": load[1]} for bus, load in report.load.items()}
    return value
