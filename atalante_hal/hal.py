"""The hardware abstraction layer: `read()` a state, `write()` a command, once a cycle each.

    bus -> process image -> E2E + validity -> state -> supervisor -> [controller] -> limiter -> process image -> bus

The emulator and the robot differ in the bus handed to the constructor, in nothing else.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from atalante_dbc import Message, Network
from atalante_hal.bus import Bus, BusError
from atalante_hal.cia402 import Controlword, DriveState, controlword_towards_operation
from atalante_hal.codec import Vector, group_of
from atalante_hal.frame import Frames, new_frames
from atalante_hal.image import NEVER, ReceiveImage, TransmitImage
from atalante_hal.limiter import Limiter
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MOTORS, Robot
from atalante_hal.supervisor import HOLD_ON, Condition, next_state
from atalante_hal.telemetry.events import Event
from atalante_hal.telemetry.layout import Layout
from atalante_hal.types import Command, State, SupervisorState

PERIOD = 1e-3  # s, the SYNC period
#: Frames one `receive` can take; the cyclic set is about 20.
_RECEIVE_BUDGET = 128
#: Longest wait [s] for nodes of which none has been heard.
_FIRST_PATIENCE = 0.1
#: Cycles within which every drive must have followed to OPERATION ENABLED.
_ENABLE_CYCLES = 200

_JOINT_COUNT = len(JOINTS)
# What is judged every cycle, as plain integers: arithmetic on an IntFlag costs a microsecond an operation.
_NODES_WELL, _DRIVES_ENABLED = int(Condition.NODES_WELL), int(Condition.DRIVES_ENABLED)
_DEAD_MAN, _START_WANTED = int(Condition.DEAD_MAN), int(Condition.START_WANTED)
#: One number each at the head of the record.
HEADER_FIELDS = (
    "cycle", "time", "supervisor", "assistance_factor", "cost_us", "lateness_us",
    "overruns", "frames", "crc_errors", "dropped", "diagnostics",
)  # fmt: skip


class FrameTap(Protocol):
    """Sees every frame the HAL sends and receives, for a CAN log."""

    def sent(self, frames: Frames) -> None:
        """Frames just handed to the bus."""

    def received(self, frames: Frames, count: int) -> None:
        """`frames[:count]` as they came from the bus."""


class Hal:
    """One robot on one bus (or several joined to one).

    Args:
        network: of `atalante_dbc.load`.
        robot: joint limits and transmission.
        bus: owned by the caller, who closes it.
        patience: longest wait [s] for the nodes' answers to a SYNC. On the wall clock well under the period; in lock-step with
            another process long, so that the slowest machine still gives the same run.
        assistance_factor: Xi until the pendant sets another.
        controller_fields: (name, length) of what the controller wants recorded, see `types.Controller`.
        gait_hash: of the gait the controller walks, for HAL_STATUS.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        bus: Bus,
        *,
        patience: float = 0.5e-3,
        assistance_factor: float = 1.0,
        controller_fields: Sequence[tuple[str, int]] = (),
        gait_hash: int = 0,
        tap: FrameTap | None = None,
    ) -> None:
        if not 0.0 <= assistance_factor <= 1.0:
            raise ValueError(f"the assistance factor is between 0 and 1, not {assistance_factor}")
        self.network, self.robot, self.bus, self.tap = network, robot, bus, tap
        self.patience = patience
        #: What went wrong or changed, once, when it began.
        self.events: list[Event] = []
        self.conditions = Condition(0)
        #: Why the robot is in the state it is in, one sentence.
        self.reason = "nothing has happened yet"
        self._build_images(controller_fields)
        self._build_state(assistance_factor)
        self._build_status(gait_hash)
        self._limiter = Limiter(robot, PERIOD)
        self._enabling = False  # drives are being enabled, and torque is sent to those that are
        self._all_valid = False  # `state.valid` says so
        self._settled = False  # the supervisor stays where it is while the conditions stay as they are
        self._pending = 0  # conditions raised since the last read, judged in the next
        self._start_wanted = 0  # cycles left to reach ACTIVE, 0: nobody asked
        self._last_press: float | None = None
        self._send_failures = 0
        self._prepare_hold()

    # -- construction ------------------------------------------------------------------------------------------------

    def _build_images(self, controller_fields: Sequence[tuple[str, int]]) -> None:
        received = self.network.received_by("HAL")
        # In the order the buses deliver it, see `ReceiveImage.accept`.
        fast = [m for bus in self.network.buses for m in received if m.bus == bus and m.cycle_ms == 1]
        slow = [m for m in received if m.cycle_ms != 1]
        shape = ReceiveImage(fast)  # for its plan; the values must lie inside the record
        self.layout = Layout(_record_fields(shape, controller_fields))
        #: Everything known about this cycle, one contiguous vector described by `layout`.
        self.record = np.zeros(self.layout.size)
        first = self.layout["motor_position"].start
        self._rx = ReceiveImage(fast, self.record[first : first + shape.codec.size])
        self._slow = ReceiveImage(slow)
        self._slow_seen = 0  # cycle up to which the slow image's ages count
        self._scratch = new_frames(_RECEIVE_BUDGET)
        self._timeouts = np.array([m.timeout_ms for m in fast])
        self._needed = np.array([m.sender != "PENDANT" for m in fast])
        #: Message of each entry of `State.valid` and `State.age`.
        self.messages = tuple(m.name for m in fast)
        self._joint_rows = [row for row, m in enumerate(fast) if self.network.node(m.sender).kind == "drive"]
        self._sent_messages = [
            m for m in self.network.sent_by("HAL") if m.cycle_ms == 1 and not m.name.startswith("SYNC_")
        ]
        syncs = [m for m in self.network.sent_by("HAL") if m.name.startswith("SYNC_")]
        self._tx = TransmitImage([*self._sent_messages, *syncs])
        count = len(self._sent_messages)
        self._commands, self._syncs = self._tx.frames[:count], self._tx.frames[count:]
        codec = self._tx.codec
        self._tx_torque = self._tx.values[codec.slice("TargetTorque")]
        self._tx_control = self._tx.values[codec.slice("Controlword")]
        self._tx_level = self._tx.values[codec.slice("Level")]
        self._tx_state = self._tx.values[codec.slice("HalState")]
        self._tx_cycle = self._tx.values[codec.slice("Cycle")]
        self._tx.values[codec.slice("MaxTorque")] = self.robot.torque_max

    def _build_state(self, assistance_factor: float) -> None:
        record, layout, robot = self.record, self.layout, self.robot
        joint = record[layout["position"].start : layout["torque"].stop]
        self._joint_side = joint
        self._motion = joint[: 2 * _JOINT_COUNT].reshape(2, _JOINT_COUNT)  # position, velocity
        self._motor_side = record[layout["motor_position"].start : layout["motor_torque"].stop]
        per_turn = robot.polarity / robot.gear
        # Torque is at the joint on the wire, in both directions.
        self._to_joint = np.concatenate([per_turn, per_turn, np.ones(_JOINT_COUNT)])
        # A memoryview: half the price of an array, a number at a time.
        self._header = memoryview(record.data).cast("B").cast("d")[: len(HEADER_FIELDS)]
        self.state = State(
            cycle=0,
            time=0.0,
            supervisor=SupervisorState.OFF,
            assistance_factor=assistance_factor,
            position=record[layout["position"]],
            velocity=record[layout["velocity"]],
            torque=record[layout["torque"]],
            temperature=record[layout["temperature"]],
            drive_state=record[layout["drive_state"]],
            imu_quaternion=record[layout["imu_quaternion"]].reshape(len(IMUS), 4),
            imu_gyro=record[layout["imu_gyro"]].reshape(len(IMUS), 3),
            imu_accel=record[layout["imu_accel"]].reshape(len(IMUS), 3),
            foot_force=record[layout["foot_force"]].reshape(len(FEET), len(CELLS), 3),
            vibration=record[layout["vibration"]],
            valid=np.zeros(len(self._rx.check), np.bool_),
            age=self._rx.age,
            joints_valid=False,
        )
        self._torque_command = record[layout["torque_command"]]
        self._level_command = record[layout["vibration_command"]]
        self.controller_record = record[layout["vibration_command"].stop :]
        self._enabled_states = np.full(_JOINT_COUNT, float(DriveState.OPERATION_ENABLED)).tobytes()

        codec = self._rx.codec
        self._pendant_row = codec.rows["PENDANT_STATE"]
        places = [codec.index("PENDANT_STATE", name) for name in _PENDANT_SIGNALS]
        assert places == list(range(places[0], places[0] + len(places)))
        self._pendant = self._rx.values[places[0] : places[-1] + 1]
        self._pendant_said, self._pendant_found = b"", 0  # judged last, and what came of it
        slow = self._slow.codec
        self._amplitude = slow.slice("Amplitude")
        self._amplitude_row = slow.rows["HAPTICS_STATE"]
        self._status_rows = [
            slow.rows[f"{n.name}_STATUS"] for n in self.network.nodes if n.kind not in ("master", "pendant")
        ]
        self._hashes = [
            (m, slow.rows[m.name], slow.index(m.name, "DbcHash")) for m in slow.messages if m.name.endswith("_STATUS")
        ]
        self._nodes_known = False
        self._stranger: str | None = None  # a node that speaks another DBC
        self._hash_values = self._slow.values[slow.slice("DbcHash")]
        self._hashes_judged = b""

    def _build_status(self, gait_hash: int) -> None:
        self._status = TransmitImage([self.network.message("HAL_STATUS")])
        codec = self._status.codec
        self._status_index = {s.name: codec.index("HAL_STATUS", s.name) for _, s in codec.signals}
        for name, value in (
            ("DbcHash", self.network.hash32),
            ("ConfigHash", self.robot.hash32),
            ("GaitHash", gait_hash),
        ):
            self._status.values[self._status_index[name]] = value
        self._status_cycles = codec.messages[0].cycle_ms

    def _prepare_hold(self) -> None:
        """The HOLD frame: quick stop to every drive, no torque, motors still."""
        self._holding = True  # the command values are those of `hold`
        self._tx_control.fill(Controlword.QUICK_STOP)
        self._tx_state.fill(self.state.supervisor)
        self._no_level = np.zeros_like(self._tx_level)
        self._seal()
        self._written = True

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def read(self) -> State:
        """Send SYNC, take the nodes' answers, judge them. The state is the same object every cycle.

        A bus that fails does not raise here: it ends in HOLD like any other fault.
        """
        if not self._written:
            self._seal()
        self._written = False
        state = self.state
        state.cycle += 1
        state.time = state.cycle * PERIOD
        late = 0 if self._rx.all_fresh else self._receive(0)  # what the last cycle did not wait for
        self._send(self._syncs)
        count = self._receive(late, self.patience)
        before = self._rx.crc_errors
        foreign = self._rx.accept(self._scratch, count)
        if foreign:
            self._accept_slow(foreign)
        np.multiply(self._motor_side, self._to_joint, self._joint_side)
        self._supervise()
        header = self._header
        header[0], header[1] = state.cycle, state.time
        header[2], header[3] = state.supervisor, state.assistance_factor
        header[7] += count
        if self._rx.crc_errors != before:
            header[8] = self._rx.crc_errors + self._slow.crc_errors
        header[9], header[10] = self.bus.dropped, self.conditions
        return state

    def write(self, command: Command) -> Vector:
        """Limit and send a command; unless the supervisor is ACTIVE its torques are not used.

        Returns:
            The torques really sent, after the limits. Shape (12,) [Nm], valid until the next call.
        """
        if self.state.supervisor is not SupervisorState.ACTIVE:
            return self.hold()
        limited = self._limiter.apply(command.torque, self._motion)
        if not limited.finite:
            self._raise_condition(Condition.COMMAND_NOT_FINITE, "the controller asked for a torque that is not finite")
            return self.hold()
        np.maximum(command.vibration, self._no_level, out=self._level_command)  # the codec cuts at 1
        self._torque_command[:] = self._tx_torque[:] = self._limiter.last
        self._tx_level[:] = self._level_command
        if self._holding:
            self._tx_control.fill(Controlword.ENABLE_OPERATION)
            self._holding = False
        return self._send_command()

    def hold(self) -> Vector:
        """Send the HOLD frame; drives being enabled for a start get the next step of their state machine instead."""
        self._holding = True
        self._tx_torque.fill(0.0)
        self._tx_control.fill(Controlword.QUICK_STOP)
        self._tx_level.fill(0.0)
        if self._start_wanted and self.state.supervisor is SupervisorState.FAULT:
            # The operator acknowledged: clear the drives that have a fault, the others go on holding.
            self._tx_control[self.state.drive_state == DriveState.FAULT] = Controlword.FAULT_RESET
        elif self._start_wanted and self.state.supervisor in (SupervisorState.READY, SupervisorState.HOLD):
            self._tx_control[:] = [controlword_towards_operation(int(s)) for s in self.state.drive_state.tolist()]
            # What the drive holds with now, so that nothing sags between its hold and the controller's first torque.
            self._follow_drives()
            self._tx_torque[:] = self._limiter.last
        else:
            self._enabling = False
        self._torque_command[:] = self._tx_torque
        self._level_command.fill(0.0)
        return self._send_command()

    def _follow_drives(self) -> None:
        """Command what the drives exert by themselves, within all limits from the second cycle on."""
        if self._enabling:
            self._limiter.apply(self.state.torque, self._motion)
        else:
            self._limiter.restart(self.state.torque)
            self._enabling = True

    def fail(self, error: Exception) -> Vector:
        """The controller raised: HOLD in this same cycle."""
        self._raise_condition(Condition.CONTROLLER_ERROR, f"the controller raised {type(error).__name__}: {error}")
        return self.hold()

    def report(self, condition: Condition, text: str) -> None:
        """The loop noticed a fault of timing; judged in the next `read`."""
        self._raise_condition(condition, text)

    def stop(self, cycles: int = 10) -> None:
        """HOLD, and stay long enough for every drive to have followed. Call at the end, before closing the bus."""
        self._raise_condition(Condition.STOP_REQUESTED, "the program is ending")
        for _ in range(cycles):
            self.read()
            self.hold()

    @property
    def crc_errors(self) -> int:
        """Frames refused for their CRC so far."""
        return self._rx.crc_errors + self._slow.crc_errors

    def missing(self) -> list[str]:
        """Nodes that keep the robot out of READY: not heard in time, no status yet, or another DBC. For people."""
        late = (self._rx.age > self._timeouts) & self._needed
        names = {m.sender for m, gone in zip(self._rx.codec.messages, late.tolist(), strict=True) if gone}
        names |= {m.sender for m, row, at in self._hashes if self._speaks_another_dbc(row, at)}
        names |= {self._slow.codec.messages[row].sender for row in self._status_rows if self._slow.age[row] >= NEVER}
        return [node.name for node in self.network.nodes if node.name in names]

    # -- bus ---------------------------------------------------------------------------------------------------------

    def _seal(self) -> None:
        self._tx_cycle.fill(float((self.state.cycle + 1) & 0xFFFFFFFF))
        self._tx.seal()

    def _send_command(self) -> Vector:
        self._seal()
        self._written = True
        self._send(self._commands)
        if self.state.cycle % self._status_cycles == 0:
            self._send_status()
        return self._torque_command

    def _send(self, frames: Frames) -> None:
        try:
            self.bus.send(frames)
        except BusError as error:
            self._send_failures += 1
            if self._send_failures >= 5:
                self._raise_condition(Condition.BUS_DOWN, f"the bus {self.bus.name} refuses frames: {error}")
            return
        self._send_failures = 0
        if self.tap is not None:
            self.tap.sent(frames)

    def _receive(self, count: int, patience: float | None = None) -> int:
        """Append to the first `count` frames of the scratch buffer what the bus has.

        Args:
            patience: longest wait [s] for messages of this cycle; None: whatever is there at once.

        Returns:
            Frames in the buffer now.
        """
        bus, scratch, first = self.bus, self._scratch, count
        try:
            count += bus.receive(scratch[first:] if first else scratch)
            if patience is not None and (first or not self._rx.begins(scratch, count)):
                count = self._receive_rest(first, count, patience)
        except BusError as error:
            self._raise_condition(Condition.BUS_DOWN, f"the bus {bus.name} fails: {error}")
            count = first
        if self.tap is not None:
            self.tap.received(scratch[first:] if first else scratch, count - first)
        return count

    def _receive_rest(self, first: int, count: int, patience: float) -> int:
        """Wait until every message that is still alive has come after the `first` frames, at most `patience` [s]."""
        expected = {
            message.frame_id
            for message, age, timeout in zip(
                self._rx.codec.messages, self._rx.age.tolist(), self._timeouts.tolist(), strict=True
            )
            if age <= timeout
        }
        # Nobody heard yet: take whoever answers until they fall silent, so that no answer is left for the next cycle.
        nobody = not expected
        deadline = time.monotonic() + (min(patience, _FIRST_PATIENCE) if nobody else patience)
        while count < _RECEIVE_BUDGET:
            expected.difference_update(self._scratch["can_id"][first:count].tolist())
            remaining = deadline - time.monotonic()
            if remaining <= 0.0 or not (expected or nobody):
                break
            first = count
            got = self.bus.receive(self._scratch[count:], remaining)
            if got == 0:
                break
            count += got
        return count

    def _accept_slow(self, places: Sequence[int]) -> None:
        elapsed = self.state.cycle - self._slow_seen
        self._slow_seen = self.state.cycle
        in_row = isinstance(places, range)
        frames = self._scratch[slice(places[0], places[-1] + 1) if in_row else list(places)]
        self._slow.new_cycle(elapsed)
        self._slow.accept_each(frames, len(frames))
        if self._slow.check[self._amplitude_row] <= 1:
            self.state.vibration[:] = self._slow.values[self._amplitude]
        if not self._nodes_known:
            self._nodes_known = bool((self._slow.age[self._status_rows] < NEVER).all())
        hashes = self._hash_values.tobytes()
        if hashes != self._hashes_judged:
            self._hashes_judged = hashes
            self._stranger = next((m.sender for m, row, at in self._hashes if self._speaks_another_dbc(row, at)), None)

    def _speaks_another_dbc(self, row: int, at: int) -> bool:
        return bool(self._slow.age[row] < NEVER and self._slow.values[at] != self.network.hash32)

    # -- judgement ---------------------------------------------------------------------------------------------------

    def _supervise(self) -> None:
        state = self.state
        found = self._pending
        self._pending = 0
        if self._rx.all_fresh:
            if not self._all_valid:
                state.valid.fill(True)
                state.joints_valid = self._all_valid = True
            found |= _NODES_WELL if self._nodes_known else 0
        else:
            found |= self._judge_ages()
        found |= self._judge_pendant()
        if state.drive_state.tobytes() == self._enabled_states:
            found |= _DRIVES_ENABLED
        else:
            found |= self._judge_drives()
        if self._stranger is not None:
            found &= ~_NODES_WELL
        if self._start_wanted:
            found |= _START_WANTED
            self._start_wanted -= 1
            if found & HOLD_ON or not found & _DEAD_MAN:
                self._start_wanted = 0
            elif not self._start_wanted:
                self._note("START_FAILED", f"the drives were not enabled within {_ENABLE_CYCLES} cycles", "error")
        if self._settled and found == self.conditions:
            return
        self.conditions = Condition(found)
        before = state.supervisor
        after = next_state(before, self.conditions)
        self._settled = after is before
        if not self._settled:
            self._enter(before, after)

    def _enter(self, before: SupervisorState, after: SupervisorState) -> None:
        state = self.state
        state.supervisor = after
        self._tx_state.fill(after)
        if after is SupervisorState.ACTIVE:
            self._start_wanted = 0
            if not self._enabling:
                self._limiter.restart(state.torque)
        if (
            before is SupervisorState.ACTIVE
            and not self.conditions & HOLD_ON
            and not self.conditions & Condition.DRIVE_FAULT
        ):
            self._note("DEAD_MAN", "the dead-man was released or the pendant is lost", "warning", "PENDANT")
        severity = "error" if after is SupervisorState.FAULT else "info"
        self.events.append(Event(state.cycle, after.name, f"{before.name} -> {after.name}", severity, value=after))

    def _judge_ages(self) -> int:
        """The slow half of validity: something was not fresh this cycle."""
        ages = self._rx.age
        self._all_valid = False
        np.less_equal(self._rx.check, 1, out=self.state.valid)
        self.state.joints_valid = bool(self.state.valid[self._joint_rows].all())
        late = (ages > self._timeouts) & self._needed
        if not late.any():
            return _NODES_WELL if self._nodes_known else 0
        if self.state.supervisor is SupervisorState.ACTIVE:
            message = self._rx.codec.messages[int(np.argmax(late))]
            text = f"{message.sender} has not been heard for {message.timeout_ms} cycles"
            self._note("NODE_TIMEOUT", text, "error", message.sender, message.timeout_ms)
        return Condition.NODE_TIMEOUT

    def _judge_drives(self) -> int:
        found = Condition(0)
        for joint, drive in zip(JOINTS, self.state.drive_state.tolist(), strict=True):
            if (
                drive in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
                and self.state.supervisor is not SupervisorState.OFF
            ):
                found |= Condition.DRIVE_FAULT
                if self.state.supervisor is not SupervisorState.FAULT:
                    self._note("DRIVE_FAULT", f"the drive of {joint} reports a fault", "error", joint.upper(), drive)
            elif drive != DriveState.OPERATION_ENABLED and self.state.supervisor is SupervisorState.ACTIVE:
                found |= Condition.DRIVE_STATE
                text = f"the drive of {joint} left OPERATION ENABLED by itself"
                self._note("DRIVE_STATE", text, "error", joint.upper(), drive)
        return found

    def _judge_pendant(self) -> int:
        """Everything an operator can say."""
        row = self._pendant_row
        if not self._rx.all_fresh and self._rx.age[row] > self._timeouts[row]:
            return 0
        said = self._pendant.tobytes()
        if said == self._pendant_said:
            return self._pendant_found
        self._pendant_said = said
        dead_man, request, press, factor, factor_set = self._pendant.tolist()
        found = _DEAD_MAN if dead_man else 0
        if request in (2, 3):  # STOP, HOLD
            found |= Condition.STOP_REQUESTED
        if self._last_press is None:
            self._last_press = press
        elif press != self._last_press:
            self._last_press = press
            if request == 1:  # START
                self._start_wanted = _ENABLE_CYCLES
            elif self.state.supervisor is SupervisorState.ACTIVE:
                self._note("OPERATOR_STOP", "the operator asked to stop", "info", "PENDANT")
        if factor_set:
            self.state.assistance_factor = factor
        self._pendant_found = int(found)
        return self._pendant_found

    def _raise_condition(self, condition: Condition, text: str) -> None:
        """A fault found outside `_supervise`; told once while it lasts."""
        if not (self.conditions | self._pending) & condition:
            self._note(str(condition.name), text, "error")
        self._pending |= condition

    def _note(self, code: str, text: str, severity: str, node: str = "HAL", value: float = 0.0) -> None:
        self.events.append(Event(self.state.cycle, code, text, severity, node, value))
        self.reason = text

    def _send_status(self) -> None:
        values, at = self._status.values, self._status_index
        values[at["HalState"]] = self.state.supervisor
        values[at["AssistanceFactor"]] = self.state.assistance_factor
        values[at["Overruns"]] = self._header[6]
        values[at["DiagnosticCode"]] = self.conditions & 0xFFFF
        self._send(self._status.seal())


def _record_fields(image: ReceiveImage, controller_fields: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """The record of a cycle: header, joint side, every signal as received, commands, the controller's own."""
    signals: dict[str, int] = {}
    for message, signal in image.codec.signals:
        name = _field_name(message, group_of(signal.name))
        signals[name] = signals.get(name, 0) + 1
    return [
        *((name, 1) for name in HEADER_FIELDS),
        *((name, _JOINT_COUNT) for name in ("position", "velocity", "torque")),
        ("vibration", len(MOTORS)),
        *signals.items(),
        ("torque_command", _JOINT_COUNT),
        ("vibration_command", len(MOTORS)),
        *((f"controller.{name}", length) for name, length in controller_fields),
    ]


#: What the pendant says, in the order of the decoded values.
_PENDANT_SIGNALS = ("DeadMan", "Request", "RequestCounter", "AssistanceFactor", "AssistanceSet")

#: Quantity of the DBC -> field of the record, where the plain name would be ambiguous.
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
