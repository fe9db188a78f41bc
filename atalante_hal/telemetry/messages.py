"""From the telemetry record to protobuf: one stream a message type, each with its key, made for one layout.

ring -> record -> [streams] -> bytes -> publisher and recorder
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.record_layout import CONTROLLER, Layout
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MOTORS
from atalante_hal.safety.events import SEVERITIES, Event
from atalante_hal.telemetry.schema import message_class

#: Assisted joints by stance: sagittal hip and knee of the swing leg. 0: left stance, 1: right stance.
ASSISTED = (("right_SH", "right_SK"), ("left_SH", "left_SK"))
#: Field of `Guide` <- field of the controller.
_GUIDE_FIELDS = {"error": "error", "bound": "q_bound", "h": "h", "lambda": "lambda", "desired_position": "q_des"}
_GUIDE_OTHERS = ("filter_active", "step", "phase", "stance")


@dataclass(slots=True)
class Sample:
    """One record on its way to messages."""

    values: list[float]  # the record, by its layout
    cycle: int
    timestamp: int  # ns
    run: int = 0
    run_name: str = ""


@dataclass(frozen=True)
class Stream:
    """One message type made from records: its key, its type, and how a sample becomes its bytes."""

    key: str
    message: str
    encode: Callable[[Sample], bytes]


class Encoder:
    """Everything that becomes of the records of one layout.

    Args:
        layout: of the records.
        diagnostics: names of the bits of the field "diagnostics", lowest first.
    """

    def __init__(self, layout: Layout, diagnostics: Sequence[str] = ()) -> None:
        self.cycle_at, self.time_at = layout["cycle"].start, layout["time"].start
        #: The streams that a record of this layout can fill.
        self.streams = _streams(layout, diagnostics)
        self.window = LoopWindow(layout)

    @property
    def keys(self) -> list[tuple[str, str]]:
        """(key, message type) of everything made from records."""
        return [*((stream.key, stream.message) for stream in self.streams), (self.window.key, self.window.message)]

    def sample(
        self, record: npt.NDArray[np.float64], cycle: int, start_ns: int, run: int = 0, run_name: str = ""
    ) -> Sample:
        """A record ready for the streams. Shape (layout.size,).

        Args:
            start_ns: log time of cycle 0 of the run.
        """
        return Sample(record.tolist(), cycle, start_ns + round(float(record[self.time_at]) * 1e9), run, run_name)

    def event(self, event: Event, timestamp: int) -> bytes:
        """Bytes of an `Event` message.

        Args:
            timestamp: ns.
        """
        message = message_class("Event")(
            severity=SEVERITIES.index(event.severity),
            code=event.code,
            node=event.node,
            value=event.value,
            text=event.text,
        )
        _begin(message, Sample([], event.cycle, timestamp))
        return bytes(message.SerializeToString())


def _streams(layout: Layout, diagnostics: Sequence[str]) -> tuple[Stream, ...]:
    guide = all(CONTROLLER + name in layout for name in (*_GUIDE_FIELDS.values(), *_GUIDE_OTHERS))
    used = {CONTROLLER + name for name in (*_GUIDE_FIELDS.values(), *_GUIDE_OTHERS)} if guide else set()
    others = [name for name in layout if name.startswith(CONTROLLER) and name not in used]
    made = [
        Stream("joint_states", "JointStates", _joint_states(layout)),
        Stream("imu", "ImuStates", _imu_states(layout)),
        Stream("foot_forces", "FootForces", _foot_forces(layout)),
        Stream("haptics", "Haptics", _haptics(layout)),
        Stream("system", "SystemState", _system_state(layout, diagnostics)),
    ]
    if guide:
        made.append(Stream("guide", "Guide", _guide(layout)))
    if others:
        made.append(Stream("controller", "Controller", _controller(layout, others)))
    return tuple(made)


def _begin(message: Any, sample: Sample) -> None:
    """Set what every message begins with."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(sample.timestamp, 1_000_000_000)
    message.cycle = sample.cycle & 0xFFFFFFFF


def _joint_states(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("JointStates")(name=JOINTS)
    places = [
        (getattr(message, field), layout[name])
        for field, name in (
            ("position", "position"),
            ("velocity", "velocity"),
            ("effort", "torque"),
            ("commanded_effort", "torque_command"),
            ("temperature", "temperature"),
        )
    ]
    states, state_place = message.drive_state, layout["drive_state"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        values = sample.values
        for field, place in places:
            field[:] = values[place]
        states[:] = map(int, values[state_place])
        return bytes(message.SerializeToString())

    return encode


def _imu_states(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("ImuStates")()
    sensors = [(imu.orientation, imu.angular_velocity, imu.linear_acceleration) for imu in _named(message.imu, IMUS)]
    attitude, gyro, accel = layout["imu_quaternion"], layout["imu_gyro"], layout["imu_accel"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        w_x_y_z, rates, forces = sample.values[attitude], sample.values[gyro], sample.values[accel]
        for place, (orientation, rate, force) in enumerate(sensors):
            orientation.w, orientation.x, orientation.y, orientation.z = w_x_y_z[4 * place : 4 * place + 4]
            rate.x, rate.y, rate.z = rates[3 * place : 3 * place + 3]
            force.x, force.y, force.z = forces[3 * place : 3 * place + 3]
        return bytes(message.SerializeToString())

    return encode


def _foot_forces(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("FootForces")()
    cells = []
    for foot in _named(message.foot, FEET):
        foot.cell.extend(CELLS)
        cells += [foot.force.add() for _ in CELLS]
    place = layout["foot_force"]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        forces = iter(sample.values[place])
        for cell in cells:
            cell.x, cell.y, cell.z = next(forces), next(forces), next(forces)
        return bytes(message.SerializeToString())

    return encode


def _haptics(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("Haptics")(name=MOTORS)
    fields = ("vibration", "amplitude"), ("vibration_command", "commanded_amplitude")
    places = [(getattr(message, field), layout[name]) for name, field in fields if name in layout]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        for field, place in places:
            field[:] = sample.values[place]
        return bytes(message.SerializeToString())

    return encode


def _guide(layout: Layout) -> Callable[[Sample], bytes]:
    message = message_class("Guide")()
    places = [(getattr(message, field), layout[CONTROLLER + name]) for field, name in _GUIDE_FIELDS.items()]
    active, step, phase, stance = (layout[CONTROLLER + name] for name in _GUIDE_OTHERS)

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        values = sample.values
        for field, place in places:
            field[:] = values[place]
        message.active[:] = [value > 0.5 for value in values[active]]
        message.phase = values[phase.start]
        message.step, message.stance = max(0, int(values[step.start])), int(values[stance.start])
        message.name[:] = ASSISTED[message.stance] if 0 <= message.stance < len(ASSISTED) else ()
        return bytes(message.SerializeToString())

    return encode


def _controller(layout: Layout, fields: Sequence[str]) -> Callable[[Sample], bytes]:
    message = message_class("Controller")()
    names = [name.removeprefix(CONTROLLER) for name in fields]
    places = [(field.value, layout[name]) for field, name in zip(_named(message.field, names), fields, strict=True)]

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        for field, place in places:
            field[:] = sample.values[place]
        return bytes(message.SerializeToString())

    return encode


def _system_state(layout: Layout, diagnostics: Sequence[str]) -> Callable[[Sample], bytes]:
    message = message_class("SystemState")()
    supervisor, assistance, bits = (layout[name].start for name in ("supervisor", "assistance_factor", "diagnostics"))

    def encode(sample: Sample) -> bytes:
        _begin(message, sample)
        message.run, message.run_name = sample.run, sample.run_name
        message.supervisor = int(sample.values[supervisor])
        message.assistance_factor = sample.values[assistance]
        message.diagnostics = found = int(sample.values[bits])
        message.diagnostic[:] = [name for bit, name in enumerate(diagnostics) if found >> bit & 1] if found else ()
        return bytes(message.SerializeToString())

    return encode


class LoopWindow:
    """Statistics of the cycles between two `LoopStatistics` messages."""

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
        """Take in the records of some cycles. Shape (n, layout.size)."""
        if len(records):
            self._cycles += len(records)
            self._cost_sum += float(records[:, self._cost].sum())
            self._cost_max = max(self._cost_max, float(records[:, self._cost].max()))
            self._lateness_max = max(self._lateness_max, float(records[:, self._lateness].max()))

    def encode(self, sample: Sample, lost: int) -> bytes:
        """The message up to this sample, whose counts it takes; the next window begins.

        Args:
            lost: cycles that telemetry has not seen so far.
        """
        message = self._message
        _begin(message, sample)
        message.cycles = self._cycles
        message.cost_mean = self._cost_sum / self._cycles * 1e-6 if self._cycles else 0.0
        message.cost_max, message.lateness_max = self._cost_max * 1e-6, self._lateness_max * 1e-6
        for name, place in self._counts:
            setattr(message, name, int(sample.values[place]))
        message.telemetry_lost = lost
        self._clear()
        return bytes(message.SerializeToString())


def _named(repeated: Any, names: Sequence[str]) -> list[Any]:
    """One sub-message a name."""
    for name in names:
        repeated.add(name=name)
    return list(repeated)
