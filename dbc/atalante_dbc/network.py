"""What a DBC says, as frozen data: nodes, messages, signals, and the bus load they add up to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar


@dataclass(frozen=True)
class Signal:
    """One field of a payload, little endian; physical = raw * factor + offset."""

    name: str
    start: int  # bit of the payload, least significant first
    length: int  # bits
    signed: bool
    factor: float
    offset: float
    minimum: float  # smallest valid physical value
    maximum: float  # largest valid physical value
    unit: str
    invalid_raw: int | None  # raw code (as unsigned bits) that says "no value"
    choices: Mapping[int, str]  # raw value -> name; empty when the signal is a number
    receivers: tuple[str, ...]


@dataclass(frozen=True)
class Message:
    """One CAN FD frame of the network."""

    name: str
    frame_id: int
    length: int  # bytes
    sender: str
    signals: tuple[Signal, ...]
    bus: str
    send_type: str  # "cyclic" or "event"
    cycle_ms: int  # 0 for an event
    timeout_ms: int  # 0: never times out
    inhibit_ms: int  # least time between two events
    data_id: int  # AUTOSAR E2E
    comment: str

    def signal(self, name: str) -> Signal:
        """The signal of that name.

        Raises:
            KeyError: with the names there are.
        """
        return _named(self.signals, name, f"signals of {self.name}")

    @property
    def receivers(self) -> tuple[str, ...]:
        """Nodes that read at least one signal, in DBC order."""
        return tuple(dict.fromkeys(node for signal in self.signals for node in signal.receivers))


@dataclass(frozen=True)
class Node:
    """A participant; `kind` is master, drive, imu, foot, haptics or pendant."""

    name: str
    kind: str
    number: int


@dataclass(frozen=True)
class Network:
    """The whole DBC. Messages are in file order."""

    nodes: tuple[Node, ...]
    messages: tuple[Message, ...]
    buses: tuple[str, ...]
    nominal_bitrate: int  # bit/s
    data_bitrate: int  # bit/s
    hash32: int  # CRC-32 of the file, as nodes report it in their status

    @cached_property
    def _by_name(self) -> dict[str, Message]:
        return {message.name: message for message in self.messages}

    def message(self, name: str) -> Message:
        """The message of that name.

        Raises:
            KeyError: with the names there are.
        """
        try:
            return self._by_name[name]
        except KeyError:
            raise KeyError(f"no message {name!r}; there are {', '.join(self._by_name)}") from None

    def node(self, name: str) -> Node:
        """The node of that name.

        Raises:
            KeyError: with the names there are.
        """
        return _named(self.nodes, name, "nodes")

    def of_kind(self, kind: str) -> tuple[Node, ...]:
        """Nodes of a kind, by number."""
        return tuple(sorted((n for n in self.nodes if n.kind == kind), key=lambda n: n.number))

    def sent_by(self, node: str) -> tuple[Message, ...]:
        """Messages a node sends."""
        return tuple(m for m in self.messages if m.sender == node)

    def received_by(self, node: str) -> tuple[Message, ...]:
        """Messages of which a node reads at least one signal."""
        return tuple(m for m in self.messages if node in m.receivers)

    def bus_load(self) -> dict[str, float]:
        """Worst-case share of each bus's time: cyclic messages at their cycle, events at their inhibit time."""
        load = dict.fromkeys(self.buses, 0.0)
        for message in self.messages:
            period = (message.cycle_ms or message.inhibit_ms) * 1e-3
            load[message.bus] += wire_time(message.length, self.nominal_bitrate, self.data_bitrate) / period
        return load


_T = TypeVar("_T", Signal, Node)


def wire_time(length: int, nominal_bitrate: float = 1e6, data_bitrate: float = 5e6) -> float:
    """Longest time [s] an 11-bit CAN FD frame of `length` payload bytes can take (ISO 11898-1), stuff bits included.

    Nominal phase with interframe space 33 bits; data phase s = 5 + 8 n bits, one dynamic stuff bit in four, and the
    fixed-stuffed CRC with its delimiters, 28 bits (33 above 16 bytes).
    """
    stuffed = 5 + 8 * length
    data_bits = stuffed + stuffed // 4 + (33 if length > 16 else 28)
    return 33 / nominal_bitrate + data_bits / data_bitrate


def _named(items: tuple[_T, ...], name: str, what: str) -> _T:
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f"no {name!r} in the {what}: {', '.join(item.name for item in items)}")
