"""Definition of the faults that the emulator can inject. A `Fault` has a kind, a target, a start, a duration and parameters.

`link` applies communication faults to the frames on the wire. `node_faults` applies faults inside the nodes. The constructor of
`Fault` checks the parameters. The emulator checks the names of messages, nodes, buses and signals. All faults act outside the
HAL, so the HAL cannot distinguish an injected fault from a real fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from atalante_dbc import Message, Network
from atalante_dbc.network import FD_LENGTHS
from atalante_emulator.motor import MOST_LATE
from atalante_hal.robot import CELLS
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import ID_MASK

Value = float | int | str


class FaultError(ValueError):
    """Error for an invalid fault. Its text lists the valid values."""


@dataclass(frozen=True)
class Parameter:
    """Definition of a fault parameter: its valid values and its default."""

    valid: str  # description of the valid values, for error messages
    holds: Callable[[Any], bool]  # function that returns whether a value is valid
    default: Value | None = None  # value of the parameter if a fault does not set it; None if each fault must set it


@dataclass(frozen=True)
class Kind:
    """Definition of a kind of fault: its effect, its valid targets and its parameters."""

    does: str  # effect of the fault as text of one line
    targets: str  # valid targets as text: types of target such as "message, node or bus", or kinds of nodes such as "imu or foot"
    parameters: Mapping[str, Parameter] = field(default_factory=dict)  # name of each parameter -> definition
    #: Whether a fault of this kind can set signals of the target message by parameters such as Position=0.3.
    signals: bool = False


def _number(low: float, high: float, unit: str = "", *, default: float | None = None) -> Parameter:
    """Return the definition of a parameter whose value is a number in [low, high]."""
    text = f"a number from {low:g} to {high:g}" + (f" {unit}" if unit else "")
    return Parameter(text, lambda value: _is_number(value) and low <= value <= high, default)


def _whole(low: int, high: int, *, default: int | None = None) -> Parameter:
    """Return the definition of a parameter whose value is an integer in [low, high]."""
    return Parameter(
        f"an integer from {low} to {high}", lambda value: type(value) is int and low <= value <= high, default
    )


def _fd_length(*, default: int | None = None) -> Parameter:
    text = f"a CAN FD payload length in bytes: {', '.join(map(str, FD_LENGTHS))}"
    return Parameter(text, lambda value: type(value) is int and value in FD_LENGTHS, default)


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def _choice(names: Sequence[str], *, default: str | None = None) -> Parameter:
    return Parameter(f"one of {', '.join(names)}", lambda value: value in names, default)


_P = _number(0.0, 1.0, default=1.0)
_MESSAGE = Parameter("the name of a message", lambda value: isinstance(value, str))
_OTHER = Parameter("the name of another node of the same kind", lambda value: isinstance(value, str))
#: Value of the fault parameter `cell` that selects all force cells of a foot.
ALL_CELLS: Final = "all"
_CELL: Final = (*CELLS, ALL_CELLS)
_AXES: Final = ("X", "Y", "Z")
#: Target name for supply faults that affect all drives. No node has this name.
BATTERY: Final = "battery"
_SUPPLIED: Final = f"drive or {BATTERY}"
_ANY_TARGET: Final = "message, node or bus"

#: Kinds of communication faults: name of the kind -> definition.
#: The parameter `p` of a fault is the probability (0 to 1) that the fault affects a frame of its target.
LINK_KINDS: Final[Mapping[str, Kind]] = {
    "drop": Kind("frames are lost", _ANY_TARGET, {"p": _P}),
    "duplicate": Kind("frames are repeated", _ANY_TARGET, {"p": _P, "copies": _whole(1, 16, default=1)}),
    "delay": Kind("frames arrive `by` cycles late", _ANY_TARGET, {"p": _P, "by": _whole(1, 1000, default=1)}),
    "reorder": Kind(
        "frames of a message arrive in pairs, in reverse order, in the cycle of the later frame", _ANY_TARGET
    ),
    "flip": Kind("random bits of the payload are inverted", _ANY_TARGET, {"p": _P, "bits": _whole(1, 512, default=1)}),
    "freeze_counter": Kind("the alive counter does not change, the CRC is correct", _ANY_TARGET),
    "masquerade": Kind(
        "frames have a CRC with the Data ID of the message `like`", _ANY_TARGET, {"p": _P, "like": _MESSAGE}
    ),
    "length": Kind(
        "frames have another length, cut or padded with 0, with a correct CRC",
        _ANY_TARGET,
        {"p": _P, "bytes": _fd_length()},
    ),
    "flags": Kind(
        "frames have other flags; without FDF they are cut to 8 bytes", _ANY_TARGET, {"p": _P, "flags": _whole(0, 7)}
    ),
    "value": Kind("signals have other values, with a correct CRC", "message", {"p": _P}, signals=True),
    "raw": Kind("signals have other raw codes, with a correct CRC", "message", {"p": _P}, signals=True),
    "inject": Kind(
        "a second sender sends the last frame with other signals and its counter plus `ahead`, `count` times per cycle",
        "message",
        {"count": _whole(1, 64, default=1), "ahead": _whole(0, 255, default=1)},
        signals=True,
    ),
    "foreign": Kind(
        "frames with an identifier outside the network arrive, `count` per cycle, before all others",
        "bus",
        {
            "can_id": _whole(0, ID_MASK),
            "bytes": _fd_length(default=8),
            "count": _whole(1, 64, default=1),
        },
    ),
    "silence": Kind("a node sends nothing", "node"),
    "heartbeat_lost": Kind("a node sends its messages except the status message", "node"),
    "reset": Kind(
        "a node is off, then restarts with a boot-up heartbeat; a drive that is off brakes its joint", "node"
    ),
    "flood": Kind(
        "frames of one identifier flood a bus and take a share of its time from all lower priorities",
        "bus",
        {
            "can_id": _whole(0, 0x7FF, default=0),
            "bytes": _fd_length(default=8),
            "load": _number(0.0, 1.0, default=1.0),
        },
    ),
    "error_frame": Kind(
        "the HAL's controller reports errors (class bits of linux/can/error.h)", "bus", {"error": _whole(1, 0x1FF)}
    ),
    "bus_off": Kind(
        "the HAL's controller goes bus-off: it reports one error frame, then neither sends nor receives", "bus"
    ),
}

#: Kinds of faults inside the nodes: name of the kind -> definition.
NODE_KINDS: Final[Mapping[str, Kind]] = {
    "reset": LINK_KINDS["reset"],
    "emergency": Kind(
        "a node reports an error; a drive also starts the reaction to that class of error",
        "node",
        {"code": _whole(1, 0xFFFF)},
    ),
    "leave_operation": Kind(
        "a drive enters a given state in every cycle, without a command",
        "drive",
        {"state": _choice([state.name for state in DriveState])},
    ),
    "enable_delay": Kind(
        "a drive enters OPERATION ENABLED only after more than `by` commands ENABLE_OPERATION in a row",
        "drive",
        {"by": _whole(1, 100_000)},
    ),
    "push": Kind("an external torque acts on a joint", "drive", {"torque": _number(-500.0, 500.0, "Nm")}),
    "torque_weak": Kind(
        "a motor produces a multiple of the torque it measures; a negative multiple reverses it",
        "drive",
        {"share": _number(-2.0, 2.0)},
    ),
    "torque_wrong": Kind(
        "a drive produces a multiple of the commanded torque, and measures the torque that it produces",
        "drive",
        {"share": _number(-2.0, 2.0)},
    ),
    "torque_late": Kind("a motor produces its torque `by` cycles late", "drive", {"by": _whole(1, MOST_LATE)}),
    "over_temperature": Kind("a drive has a given temperature", "drive", {"degrees": _number(-40.0, 214.0, "degC")}),
    "heat_ramp": Kind(
        "the temperature of a drive rises at a given rate up to a limit",
        "drive",
        {"rate": _number(0.0, 1e5, "K/s"), "up_to": _number(-40.0, 214.0, "degC", default=214.0)},
    ),
    "under_voltage": Kind(
        "one drive or all drives have a given supply voltage", _SUPPLIED, {"volts": _number(0.0, 60.0, "V")}
    ),
    "battery_removed": Kind(
        "the drives run on the charge of the DC link", BATTERY, {"capacity": _number(1e-3, 10.0, "F", default=0.1)}
    ),
    "encoder_stuck": Kind("an encoder keeps reporting the position at the start of the fault", "drive"),
    "encoder_jump": Kind("an encoder has a constant error", "drive", {"by": _number(-7.0, 7.0, "rad")}),
    "encoder_drift": Kind(
        "the error of an encoder grows", "drive", {"rate": _number(-10.0, 10.0, "rad/s of the joint")}
    ),
    "encoder_swapped": Kind("two encoders are connected to each other's drive", "drive", {"other": _OTHER}),
    "dbc_hash": Kind(
        "a node reports the hash of another DBC", "node", {"hash": _whole(0, 0xFFFF_FFFF, default=0xDEADBEEF)}
    ),
}

#: Kinds of sensor faults: name of the kind -> definition. A sensor fault changes signal values that already contain noise.
SENSOR_KINDS: Final[Mapping[str, Kind]] = {
    "imu_invalid": Kind("an IMU sends the invalid code in all measured signals", "imu"),
    "imu_saturated": Kind("gyroscope and accelerometer report the end of their range", "imu"),
    "imu_frozen": Kind("an IMU repeats its last values, with a running counter", "imu"),
    "cell_stuck": Kind(
        "a force cell reports a constant vertical force; 0 is a dead cell",
        "foot",
        {"cell": _choice(CELLS), "force": _number(-3000.0, 3000.0, "N", default=0.0)},
    ),
    "cell_offset": Kind(
        "the vertical force of one cell or of all cells of a foot has a constant error",
        "foot",
        {"cell": _choice(_CELL, default=ALL_CELLS), "force": _number(-3000.0, 3000.0, "N")},
    ),
    "cell_inverted": Kind(
        "the vertical force of one cell or of all cells of a foot has the wrong sign",
        "foot",
        {"cell": _choice(_CELL, default=ALL_CELLS)},
    ),
    "imu_inverted": Kind(
        "gyroscope and accelerometer of an IMU have the wrong sign about one axis, its attitude is correct",
        "imu",
        {"axis": _choice(_AXES)},
    ),
    "imu_turned": Kind(
        "an IMU is mounted with a rotation about one of its axes",
        "imu",
        {"axis": _choice(_AXES), "degrees": _number(-180.0, 180.0, "deg", default=180.0)},
    ),
    "sensor_swapped": Kind("two IMUs or both feet send the values of each other", "imu or foot", {"other": _OTHER}),
}

KINDS: Final[Mapping[str, Kind]] = {**LINK_KINDS, **NODE_KINDS, **SENSOR_KINDS}


@dataclass(frozen=True, init=False)
class Fault:
    """Fault to inject: kind, target, first cycle, duration and parameters.

    Examples: `Fault("drop", "LEFT_SK_STATE", 1000, 5)`, `Fault("value", "LEFT_SK_STATE", 1000, 1, Position=0.3)`.
    """

    kind: str
    target: str
    start: int
    cycles: int | None
    parameters: tuple[tuple[str, Value], ...]  # (name, value), with defaults

    def __init__(self, kind: str, target: str, start: int = 0, cycles: int | None = None, **parameters: Value) -> None:
        """Create a fault, and check its kind, time and parameters.

        Args:
            kind: name of the kind, a key of `KINDS`.
            target: name of a message, node or bus, or `BATTERY`.
            start: first cycle of the fault, as a cycle number of the emulator.
            cycles: duration in cycles. With None, the fault is permanent.
            **parameters: parameters of the kind. Some kinds also take signals of the target message, as signal name = value.

        Raises:
            FaultError: If the kind or a parameter is unknown, or a value is invalid.
        """
        if kind not in KINDS:
            raise FaultError(f"the kind of fault must be one of {', '.join(KINDS)}, got {kind!r}")
        if type(start) is not int or start < 0:
            raise FaultError(f"the start of a fault must be an integer of at least 0 [cycles], got {start!r}")
        if cycles is not None and (type(cycles) is not int or cycles < 1):
            raise FaultError(
                f"the duration of a fault must be an integer of at least 1 [cycles], or None, got {cycles!r}"
            )
        for name, value in (
            ("kind", kind),
            ("target", target),
            ("start", start),
            ("cycles", cycles),
            ("parameters", _checked(kind, parameters)),
        ):
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> Any:
        """Return the value of a parameter."""
        return dict(self.parameters)[name]

    @property
    def end(self) -> float:
        """Number of the first cycle after the fault; infinity if the fault is permanent."""
        return math.inf if self.cycles is None else self.start + self.cycles

    @property
    def signals(self) -> dict[str, float]:
        """Values of the signals that the fault sets, by signal name."""
        known = KINDS[self.kind].parameters
        return {name: float(value) for name, value in self.parameters if name not in known}

    def starting(self, cycle: int) -> Fault:
        """Return a copy of the fault with another first cycle.

        Args:
            cycle: first cycle of the new fault.
        """
        parameters: Any = dict(self.parameters)
        return Fault(self.kind, self.target, cycle, self.cycles, **parameters)

    def __str__(self) -> str:
        """Return kind, target and parameters as text."""
        return " ".join([self.kind, self.target, *(f"{name}={value}" for name, value in self.parameters)])


def _checked(kind: str, given: Mapping[str, Value]) -> tuple[tuple[str, Value], ...]:
    """Check the given parameters of a fault. Return all parameters as (name, value), with defaults for omitted parameters."""
    rule = KINDS[kind]
    known = rule.parameters
    for name, value in given.items():
        if name in known:
            if not known[name].holds(value):
                raise FaultError(f"{kind}: the parameter {name!r} must be {known[name].valid}, got {value!r}")
        elif not rule.signals:
            raise FaultError(f"{kind}: unknown parameter {name!r}; valid parameters: {', '.join(known) or 'none'}")
        elif not _is_number(value):
            raise FaultError(f"{kind}: signal {name} must be a finite number, got {value!r}")
    for name, parameter in known.items():
        if name not in given and parameter.default is None:
            raise FaultError(f"{kind}: the parameter {name!r} must be {parameter.valid}, got no value")
    defaults = {name: parameter.default for name, parameter in known.items() if parameter.default is not None}
    if kind in ("value", "raw") and not given.keys() - known.keys():
        raise FaultError(f"{kind}: the fault must set a signal, for example Position=0.3, got no signal")
    return tuple({**defaults, **given}.items())


def messages_of(fault: Fault, network: Network) -> tuple[Message, ...]:
    """Return the messages that a communication fault affects.

    Args:
        fault: communication fault. A node as target means all its messages, a bus means all messages on the bus.
        network: nodes and messages of the DBC.

    Raises:
        FaultError: If the target or a signal of the fault is not in the network.
    """
    wanted = LINK_KINDS[fault.kind].targets
    targets: dict[str, tuple[Message, ...]] = {}
    if "message" in wanted:
        targets |= {message.name: (message,) for message in network.messages}
    if fault.kind == "heartbeat_lost":
        targets = {m.sender: (m,) for m in network.messages if m.name.endswith("_STATUS")}
    elif "node" in wanted:
        targets |= {node.name: network.sent_by(node.name) for node in network.nodes}
    if "bus" in wanted:
        targets |= {bus: tuple(m for m in network.messages if m.bus == bus) for bus in network.buses}
    _check_target(fault, wanted, list(targets))
    messages = targets[fault.target]
    if "like" in dict(fault.parameters) and fault["like"] not in (known := [m.name for m in network.messages]):
        raise FaultError(
            f"{fault.kind}: the parameter 'like' must be the name of a message, got {fault['like']!r}; valid: {', '.join(known)}"
        )
    for signal in fault.signals:
        if signal not in (known := [s.name for s in messages[0].signals]):
            raise FaultError(
                f"{fault.kind}: unknown signal {signal!r} of {fault.target}; valid signals: {', '.join(known)}"
            )
    return messages


def nodes_of(fault: Fault, network: Network) -> tuple[str, ...]:
    """Return the nodes that a node fault or sensor fault affects. A fault of the battery affects all drives.

    Args:
        fault: node fault or sensor fault.
        network: nodes and messages of the DBC.

    Raises:
        FaultError: If the target is not a node of a kind to which the fault applies.
    """
    wanted = KINDS[fault.kind].targets
    drives = tuple(node.name for node in network.of_kind("drive"))
    targets: dict[str, tuple[str, ...]] = {
        node.name: (node.name,)
        for node in network.nodes
        if node.kind in wanted or (wanted == "node" and node.kind != "master")
    }
    if BATTERY in wanted:
        targets[BATTERY] = drives
    _check_target(fault, wanted, list(targets))
    if "other" in dict(fault.parameters):
        kind = next(node.kind for node in network.nodes if node.name == fault.target)
        others = [node.name for node in network.of_kind(kind) if node.name != fault.target]
        if fault["other"] not in others:
            raise FaultError(
                f"{fault.kind}: the parameter 'other' must be another {kind}, got {fault['other']!r}; valid: {', '.join(others)}"
            )
    return targets[fault.target]


def _check_target(fault: Fault, wanted: str, targets: Sequence[str]) -> None:
    if fault.target not in targets:
        raise FaultError(
            f"{fault.kind}: the target must be of type {wanted}, got {fault.target!r}; valid targets: {', '.join(targets)}"
        )
