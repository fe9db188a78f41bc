"""Conversion of the record of a control cycle to protobuf messages.

ring -> record -> [streams] -> bytes -> publisher and recorder

A stream is the series of all messages of one type. For example, the stream "imu" consists of `ImuStates` messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.record_layout import CONTROLLER, Layout, joined_bits
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MOTORS
from atalante_hal.safety.events import SEVERITIES, Event
from atalante_hal.telemetry.schema import message_class

#: Joints that the guide assists: sagittal hip (SH) and sagittal knee (SK) of the leg in the air.
#: Element 0: joints while the robot stands on the left leg. Element 1: joints while the robot stands on the right leg.
ASSISTED = (("right_SH", "right_SK"), ("left_SH", "left_SK"))
#: Key: field of the message `Guide`. Value: name of the same quantity in the telemetry of the controller.
_GUIDE_FIELDS = {"error": "error", "bound": "q_bound", "h": "h", "lambda": "lambda", "desired_position": "q_des"}
_GUIDE_OTHERS = ("filter_active", "step", "phase", "stance")


@dataclass(slots=True)
class Sample:
    """Record of one control cycle, with its time and the number of its run."""

    values: list[float]  # all fields of the record in one list; `record_layout.Layout` has the slice of each field
    cycle: int
    timestamp: int  # log time of the cycle [ns]
    run: int = 0  # number of the run in the session
    run_name: str = ""


@dataclass(frozen=True)
class Stream:
    """Series of messages of one type, which are published and recorded under one key."""

    key: str  # name of the stream, such as joint_states
    message: str  # name of the message type, such as JointStates
    encode: Callable[[Sample], bytes]  # function that returns the message of one cycle


class Encoder:
    """Encoder that converts each record to one message per stream.

    Args:
        layout: Layout of the records.
        diagnostics: Names of the bits of the field "diagnostics", lowest bit first.
    """

    def __init__(self, layout: Layout, diagnostics: Sequence[str] = ()) -> None:
        self.cycle_at, self.time_at = layout["cycle"].start, layout["time"].start
        #: Streams for which the layout has all fields. Without guide fields in the layout, there is no stream "guide".
        self.streams = _streams(layout, diagnostics)
        self.window = LoopWindow(layout)

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Return (key, message type) of every stream, including the loop statistics."""
        return [*((stream.key, stream.message) for stream in self.streams), (self.window.key, self.window.message)]

    def sample(
        self,
        record: npt.NDArray[np.float64],
        cycle: int,
        start_ns: int,
        run: int = 0,
        run_name: str = "",
        time_ns: int = 0,
    ) -> Sample:
        """Create a `Sample` from the record of one cycle.

        Args:
            record: Values of the record, shape (layout.size,).
            cycle: Cycle number.
            start_ns: Log time of cycle 0 of the run [ns].
            run: Number of the run in the session.
            run_name: Name of the run.
            time_ns: Log time of the cycle [ns]. With 0, the log time is `start_ns` plus the robot time.

        Returns:
            Sample for the streams.
        """
        return Sample(record.tolist(), cycle, self.log_time(record, start_ns, time_ns), run, run_name)

    def log_time(self, record: npt.NDArray[np.float64], start_ns: int, time_ns: int) -> int:
        """Return the log time of a cycle [ns], see `sample`."""
        return time_ns or start_ns + round(float(record[self.time_at]) * 1e9)

    def event(self, event: Event, timestamp: int) -> bytes:
        """Encode an `Event` message.

        Args:
            event: Event to encode.
            timestamp: Log time of the event [ns].

        Returns:
            Bytes of the message.
        """
        message = message_class("Event")(
            severity=SEVERITIES.index(event.severity),
            code=event.code,
            node=event.node,
            value=event.value,
            text=event.text,
            count=event.count,
        )
        _begin(message, Sample([], event.cycle, timestamp))
        return bytes(message.SerializeToString())


def _streams(layout: Layout, diagnostics: Sequence[str]) -> tuple[Stream, ...]:
    guide = all(CONTROLLER + name in layout for name in (*_GUIDE_FIELDS.values(), *_GUIDE_OTHERS))
    used = {CONTROLLER + name for name in (*_GUIDE_FIELDS.values(), *_GUIDE_OTHERS)} if guide else set()
    others = [name for name in layout if name.startswith(CONTROLLER) and name not in used]
    streams = [
        Stream("joint_states", "JointStates", _joint_states(layout)),
        Stream("imu", "ImuStates", _imu_states(layout)),
        Stream("foot_forces", "FootForces", _foot_forces(layout)),
        Stream("haptics", "Haptics", _haptics(layout)),
        Stream("system", "SystemState", _system_state(layout, diagnostics)),
    ]
    if guide:
        streams.append(Stream("guide", "Guide", _guide(layout)))
    if others:
        streams.append(Stream("controller", "Controller", _controller(layout, others)))
    return tuple(streams)


def _begin(message: Any, sample: Sample) -> None:
    """Set the fields that every message has: timestamp and cycle."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(sample.timestamp, 1_000_000_000)
    message.cycle = sample.cycle & 0xFFFFFFFF


def _joint_states(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("JointStates")(name=JOINTS)
    targets = [
        (getattr(message, field), layout[name])
        for field, name in (
            ("position", "position"),
            ("velocity", "velocity"),
            ("effort", "torque"),
            ("commanded_effort", "torque_command"),
            ("temperature", "temperature"),
        )
    ]
    states, state_columns = message.drive_state, layout["drive_state"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        values = sample.values
        for field, columns in targets:
            field[:] = values[columns]
        states[:] = map(int, values[state_columns])
        return bytes(message.SerializeToString())

    return encode


def _imu_states(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("ImuStates")()
    sensors = [(imu.orientation, imu.angular_velocity, imu.linear_acceleration) for imu in _named(message.imu, IMUS)]
    attitude, gyro, accel = layout["imu_quaternion"], layout["imu_gyro"], layout["imu_accel"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        w_x_y_z, rates, forces = sample.values[attitude], sample.values[gyro], sample.values[accel]
        for index, (orientation, rate, force) in enumerate(sensors):
            orientation.w, orientation.x, orientation.y, orientation.z = w_x_y_z[4 * index : 4 * index + 4]
            rate.x, rate.y, rate.z = rates[3 * index : 3 * index + 3]
            force.x, force.y, force.z = forces[3 * index : 3 * index + 3]
        return bytes(message.SerializeToString())

    return encode


def _foot_forces(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("FootForces")()
    cells = []
    for foot in _named(message.foot, FEET):
        foot.cell.extend(CELLS)
        cells += [foot.force.add() for _ in CELLS]
    columns = layout["foot_force"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        forces = iter(sample.values[columns])
        for cell in cells:
            cell.x, cell.y, cell.z = next(forces), next(forces), next(forces)
        return bytes(message.SerializeToString())

    return encode


def _haptics(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("Haptics")(name=MOTORS)
    fields = ("vibration", "amplitude"), ("vibration_command", "commanded_amplitude")
    targets = [(getattr(message, field), layout[name]) for name, field in fields if name in layout]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        for field, columns in targets:
            field[:] = sample.values[columns]
        return bytes(message.SerializeToString())

    return encode


def _guide(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("Guide")()
    targets = [(getattr(message, field), layout[CONTROLLER + name]) for field, name in _GUIDE_FIELDS.items()]
    active, step, phase, stance = (layout[CONTROLLER + name] for name in _GUIDE_OTHERS)

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        values = sample.values
        for field, columns in targets:
            field[:] = values[columns]
        message.active[:] = [value > 0.5 for value in values[active]]
        message.phase = values[phase.start]
        message.step = max(0, _int_or_zero(values[step.start]))
        message.stance = _int_or_zero(values[stance.start])
        message.name[:] = ASSISTED[message.stance] if 0 <= message.stance < len(ASSISTED) else ()
        return bytes(message.SerializeToString())

    return encode


def _controller(layout: Layout, fields: Sequence[str]) -> Callable[[Sample], bytes]:
    message = message_class("Controller")()
    names = [name.removeprefix(CONTROLLER) for name in fields]
    targets = [(field.value, layout[name]) for field, name in zip(_named(message.field, names), fields, strict=True)]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        for field, columns in targets:
            field[:] = sample.values[columns]
        return bytes(message.SerializeToString())

    return encode


def _system_state(layout: Layout, diagnostics: Sequence[str]) -> Callable[[Sample], bytes]:
    message = message_class("SystemState")()
    supervisor, assistance, low, high = (
        layout[name].start for name in ("supervisor", "assistance_factor", "diagnostics", "diagnostics_high")
    )

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        message.run, message.run_name = sample.run, sample.run_name
        message.supervisor = int(sample.values[supervisor])
        message.assistance_factor = sample.values[assistance]
        message.diagnostics = found = joined_bits(sample.values[low], sample.values[high])
        message.diagnostic[:] = [name for bit, name in enumerate(diagnostics) if found >> bit & 1] if found else ()
        return bytes(message.SerializeToString())

    return encode


class LoopWindow:
    """Statistics of the cycles since the last `LoopStatistics` message.

    Args:
        layout: Layout of the records.
    """

    key = "loop"
    message = "LoopStatistics"

    def __init__(self, layout: Layout) -> None:
        self._cost, self._lateness = layout["cost_us"].start, layout["lateness_us"].start
        self._counts = [(name, layout[name].start) for name in ("overruns", "frames", "crc_errors", "dropped")]
        self._message = message_class("LoopStatistics")()
        self._clear()

    def _clear(self) -> None:
        self._cycles, self._cost_sum, self._cost_max, self._lateness_max = 0, 0.0, 0.0, 0.0

    def add(self, records: npt.NDArray[np.float64]) -> None:
        """Add the records of consecutive cycles to the statistics.

        Args:
            records: Values of the records, shape (n, layout.size).
        """
        if len(records):
            self._cycles += len(records)
            self._cost_sum += float(records[:, self._cost].sum())
            self._cost_max = max(self._cost_max, float(records[:, self._cost].max()))
            self._lateness_max = max(self._lateness_max, float(records[:, self._lateness].max()))

    def encode(self, sample: Sample, lost: int) -> bytes:
        """Encode the statistics as one message, and reset the statistics.

        Args:
            sample: Sample of the last cycle that was added. Its counters are copied to the message.
            lost: Number of cycles that telemetry has lost so far.

        Returns:
            Bytes of the message.
        """
        message = self._message
        _begin(message, sample)
        message.cycles = self._cycles
        message.cost_mean = self._cost_sum / self._cycles * 1e-6 if self._cycles else 0.0
        message.cost_max, message.lateness_max = self._cost_max * 1e-6, self._lateness_max * 1e-6
        for name, index in self._counts:
            setattr(message, name, int(sample.values[index]))
        message.telemetry_lost = lost
        self._clear()
        return bytes(message.SerializeToString())


def _int_or_zero(value: float) -> int:
    """Convert a value of a controller to an integer. Return 0 if it is not finite or does not fit into 32 bits."""
    return int(value) if abs(value) < 1 << 31 else 0


def _named(repeated: Any, names: Sequence[str]) -> list[Any]:
    """Append one sub-message per name to a repeated field, and return the sub-messages."""
    for name in names:
        repeated.add(name=name)
    return list(repeated)
