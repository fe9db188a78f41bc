"""What can go wrong, as data: a `Fault` is a kind, a target, when, and a few numbers.

    Fault -> link (frames on the wire) or nodes (what is inside them) -> emulator

A fault is checked when it is made, against what its kind takes, and again when it is put on a network, against the names there
are. All are the emulator's: the HAL never knows that a fault is a staged one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from atalante_dbc import Message, Network
from atalante_hal.robot import CELLS
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import FD_LENGTHS

Value = float | int | str


class FaultError(ValueError):
    """No such fault; one sentence that says what is valid."""


@dataclass(frozen=True)
class Parameter:
    """One number or name a kind of fault takes; `default` None: it has to be given."""

    valid: str  # what a message says is valid
    holds: Callable[[Any], bool]
    default: Value | None = None


@dataclass(frozen=True)
class Kind:
    """What faults of one kind have in common."""

    does: str  # one line for a list of kinds
    targets: str  # message, node, bus, or a kind of node: what a target may name
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    signals: bool = False  # takes signals of the target's message as further parameters


def _number(low: float, high: float, unit: str = "", *, default: float | None = None) -> Parameter:
    """A number in [low, high]."""
    text = f"a number from {low:g} to {high:g}" + (f" {unit}" if unit else "")
    return Parameter(text, lambda value: _is_number(value) and low <= value <= high, default)


def _whole(low: int, high: int, *, default: int | None = None) -> Parameter:
    """A whole number in [low, high]."""
    return Parameter(
        f"a whole number from {low} to {high}", lambda value: type(value) is int and low <= value <= high, default
    )


def _fd_length(*, default: int | None = None) -> Parameter:
    text = f"a length CAN FD can carry, {', '.join(map(str, FD_LENGTHS))}"
    return Parameter(text, lambda value: type(value) is int and value in FD_LENGTHS, default)


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def _choice(names: Sequence[str]) -> Parameter:
    return Parameter(f"one of {', '.join(names)}", lambda value: value in names)


_P = _number(0.0, 1.0, default=1.0)
_MESSAGE = Parameter("the name of a message", lambda value: isinstance(value, str))
#: Target that is no node: what feeds all drives.
BATTERY: Final = "battery"
_SUPPLIED: Final = f"drive or {BATTERY}"
_PLACES: Final = "message, node or bus"

#: Faults of the wire. `p` is the chance of each frame to be hit.
LINK_KINDS: Final[Mapping[str, Kind]] = {
    "drop": Kind("frames are lost", _PLACES, {"p": _P}),
    "duplicate": Kind("frames come more than once", _PLACES, {"p": _P, "copies": _whole(1, 16, default=1)}),
    "delay": Kind("frames come `by` cycles late", _PLACES, {"p": _P, "by": _whole(1, 1000, default=1)}),
    "reorder": Kind("of two frames of a message the later comes first, both in the later's cycle", _PLACES),
    "flip": Kind("random bits of the payload are turned over", _PLACES, {"p": _P, "bits": _whole(1, 512, default=1)}),
    "freeze_counter": Kind("the alive counter stands still under a right CRC", _PLACES),
    "masquerade": Kind("sealed with the Data ID of the message `like`", _PLACES, {"p": _P, "like": _MESSAGE}),
    "length": Kind(
        "another length, cut or filled with 0, under a right CRC", _PLACES, {"p": _P, "bytes": _fd_length()}
    ),
    "flags": Kind("other frame flags; without FDF cut to 8 bytes", _PLACES, {"p": _P, "flags": _whole(0, 7)}),
    "value": Kind("signals have other values, under a right CRC", "message", {"p": _P}, signals=True),
    "raw": Kind("signals have other raw codes, under a right CRC", "message", {"p": _P}, signals=True),
    "inject": Kind(
        "a second sender: the last frame with other signals, its counter `ahead`, `count` a cycle, before the true one",
        "message",
        {"count": _whole(1, 64, default=1), "ahead": _whole(0, 255, default=1)},
        signals=True,
    ),
    "foreign": Kind(
        "frames that are no message of the network, `count` a cycle, before all others",
        "bus",
        {
            "can_id": _whole(0, 0x1FFF_FFFF),
            "bytes": _fd_length(default=8),
            "count": _whole(1, 64, default=1),
        },
    ),
    "silence": Kind("a node says nothing", "node"),
    "heartbeat_lost": Kind("a node sends its state, but no status", "node"),
    "reset": Kind("a node is off, then begins anew with a boot-up heartbeat; a drive brakes meanwhile", "node"),
    "flood": Kind(
        "somebody babbles: frames of one identifier take a share of the bus's time from all that are less urgent",
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
    "bus_off": Kind("the HAL's controller goes bus-off: one error frame, then neither sends nor receives", "bus"),
}

#: Faults inside the nodes.
NODE_KINDS: Final[Mapping[str, Kind]] = {
    "reset": LINK_KINDS["reset"],
    "emergency": Kind(
        "a node tells an error and, being a drive, does what it does about its class",
        "node",
        {"code": _whole(1, 0xFFFF)},
    ),
    "leave_operation": Kind(
        "a drive goes to a state unasked, every cycle",
        "drive",
        {"state": _choice([state.name for state in DriveState])},
    ),
    "push": Kind("somebody pushes: an external torque on a joint", "drive", {"torque": _number(-500.0, 500.0, "Nm")}),
    "torque_weak": Kind("a motor makes a share of the torque it measures", "drive", {"share": _number(0.0, 1.0)}),
    "over_temperature": Kind("a drive is this hot", "drive", {"degrees": _number(-40.0, 214.0, "degC")}),
    "heat_ramp": Kind(
        "a drive grows hotter",
        "drive",
        {"rate": _number(0.0, 1e5, "K/s"), "up_to": _number(-40.0, 214.0, "degC", default=214.0)},
    ),
    "under_voltage": Kind(
        "the supply of one drive or of all is this low", _SUPPLIED, {"volts": _number(0.0, 60.0, "V")}
    ),
    "battery_removed": Kind(
        "the drives live on the charge of the DC link", BATTERY, {"capacity": _number(1e-3, 10.0, "F", default=0.1)}
    ),
    "encoder_stuck": Kind("an encoder shows the joint where it was", "drive"),
    "encoder_jump": Kind("an encoder is off by an angle of the joint", "drive", {"by": _number(-7.0, 7.0, "rad")}),
    "encoder_drift": Kind("an encoder goes off", "drive", {"rate": _number(-10.0, 10.0, "rad/s of the joint")}),
    "dbc_hash": Kind("a node reports another network", "node", {"hash": _whole(0, 0xFFFF_FFFF, default=0xDEADBEEF)}),
}

#: Faults of what sensors say, noise and all.
SENSOR_KINDS: Final[Mapping[str, Kind]] = {
    "imu_invalid": Kind("an IMU sends the invalid code for all it measures", "imu"),
    "imu_saturated": Kind("gyroscope and accelerometer stand at the end of their range", "imu"),
    "imu_frozen": Kind("an IMU says the same again and again, with a live counter", "imu"),
    "cell_stuck": Kind(
        "a force cell reads this vertically; 0 is a dead one",
        "foot",
        {"cell": _choice(CELLS), "force": _number(-3000.0, 3000.0, "N", default=0.0)},
    ),
}

KINDS: Final[Mapping[str, Kind]] = {**LINK_KINDS, **NODE_KINDS, **SENSOR_KINDS}


@dataclass(frozen=True, init=False)
class Fault:
    """A fault of one kind, from cycle `start` of the emulator on, for `cycles` cycles; None: for good.

    Parameters of its kind, and for kinds that take signals those of the message, are given by name:
    `Fault("drop", "LEFT_SK_STATE", 1000, 5)`, `Fault("value", "LEFT_SK_STATE", 1000, 1, Position=0.3)`.
    """

    kind: str
    target: str
    start: int
    cycles: int | None
    parameters: tuple[tuple[str, Value], ...]  # all there are, by name

    def __init__(self, kind: str, target: str, start: int = 0, cycles: int | None = None, **parameters: Value) -> None:
        """Make a fault.

        Raises:
            FaultError: unknown kind or parameter, or a value that is not valid; says what is.
        """
        if kind not in KINDS:
            raise FaultError(f"no fault {kind!r}; there are {', '.join(KINDS)}")
        if type(start) is not int or start < 0:
            raise FaultError(f"a fault starts in cycle 0 or later, not {start!r}")
        if cycles is not None and (type(cycles) is not int or cycles < 1):
            raise FaultError(f"a fault lasts 1 cycle or longer, or None for good, not {cycles!r}")
        for name, value in (
            ("kind", kind),
            ("target", target),
            ("start", start),
            ("cycles", cycles),
            ("parameters", _checked(kind, parameters)),
        ):
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> Any:
        """A parameter, as given or its default."""
        return dict(self.parameters)[name]

    @property
    def end(self) -> float:
        """First cycle after it."""
        return math.inf if self.cycles is None else self.start + self.cycles

    @property
    def signals(self) -> dict[str, float]:
        """Signals it sets, by name."""
        known = KINDS[self.kind].parameters
        return {name: float(value) for name, value in self.parameters if name not in known}

    def starting(self, cycle: int) -> Fault:
        """The same fault from another cycle on."""
        parameters: Any = dict(self.parameters)
        return Fault(self.kind, self.target, cycle, self.cycles, **parameters)

    def __str__(self) -> str:
        """As one would type it."""
        return " ".join([self.kind, self.target, *(f"{name}={value}" for name, value in self.parameters)])


def _checked(kind: str, given: Mapping[str, Value]) -> tuple[tuple[str, Value], ...]:
    """The parameters of a fault, defaults filled in."""
    rule = KINDS[kind]
    known = rule.parameters
    for name, value in given.items():
        if name in known:
            if not known[name].holds(value):
                raise FaultError(f"{kind}: {name} is {known[name].valid}, not {value!r}")
        elif not rule.signals:
            raise FaultError(f"{kind}: no parameter {name!r}; there are {', '.join(known) or 'none'}")
        elif not _is_number(value):
            raise FaultError(f"{kind}: signal {name} is a finite number, not {value!r}")
    for name, parameter in known.items():
        if name not in given and parameter.default is None:
            raise FaultError(f"{kind}: {name} has to be given, {parameter.valid}")
    defaults = {name: parameter.default for name, parameter in known.items() if parameter.default is not None}
    if kind in ("value", "raw") and not given.keys() - known.keys():
        raise FaultError(f"{kind}: name a signal of the message and what it is, as Position=0.3")
    return tuple({**defaults, **given}.items())


def messages_of(fault: Fault, network: Network) -> tuple[Message, ...]:
    """The messages a fault of the wire is about: itself, what a node sends, or all of a bus.

    Raises:
        FaultError: the network has no such message, node, bus or signal; names those there are.
    """
    wanted = LINK_KINDS[fault.kind].targets
    places: dict[str, tuple[Message, ...]] = {}
    if "message" in wanted:
        places |= {message.name: (message,) for message in network.messages}
    if fault.kind == "heartbeat_lost":
        places = {m.sender: (m,) for m in network.messages if m.name.endswith("_STATUS")}
    elif "node" in wanted:
        places |= {node.name: network.sent_by(node.name) for node in network.nodes}
    if "bus" in wanted:
        places |= {bus: tuple(m for m in network.messages if m.bus == bus) for bus in network.buses}
    _check_target(fault, wanted, list(places))
    messages = places[fault.target]
    if "like" in dict(fault.parameters) and fault["like"] not in (known := [m.name for m in network.messages]):
        raise FaultError(f"{fault.kind}: like is a message, not {fault['like']!r}; there are {', '.join(known)}")
    for signal in fault.signals:
        if signal not in (known := [s.name for s in messages[0].signals]):
            raise FaultError(f"{fault.kind}: no signal {signal!r} in {fault.target}; there are {', '.join(known)}")
    return messages


def nodes_of(fault: Fault, network: Network) -> tuple[str, ...]:
    """The nodes a fault inside nodes is about; of the battery: all drives.

    Raises:
        FaultError: the network has no such node of the kind it takes; names those there are.
    """
    wanted = KINDS[fault.kind].targets
    drives = tuple(node.name for node in network.of_kind("drive"))
    places: dict[str, tuple[str, ...]] = {
        node.name: (node.name,)
        for node in network.nodes
        if node.kind in wanted or (wanted == "node" and node.kind != "master")
    }
    if BATTERY in wanted:
        places[BATTERY] = drives
    _check_target(fault, wanted, list(places))
    return places[fault.target]


def _check_target(fault: Fault, wanted: str, places: Sequence[str]) -> None:
    if fault.target not in places:
        raise FaultError(f"{fault.kind}: {fault.target!r} is no {wanted}; there are {', '.join(places)}")
