"""Content of a DBC as frozen data: nodes, messages and signals, with the worst-case bus load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

#: Payload lengths that CAN FD supports (ISO 11898-1) [byte].
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
#: Largest signal length [bit]. The rounding of the codec is exact for integers of at most `LONGEST_SIGNAL` bits.
LONGEST_SIGNAL = 51
#: E2E Profile 5 header at the start of a payload: name of each signal -> (start bit, number of bits).
E2E_HEADER = {"Crc": (0, 16), "Counter": (16, 8)}


class DbcError(ValueError):
    """Error of an invalid DBC. Each line of the error text states a problem and its line number in the DBC."""

    code = "DBC_INVALID"


def decoded_text(content: bytes, errors: str = "strict") -> str:
    """Decode a DBC file as UTF-8, or as Windows-1252 if its bytes are not valid UTF-8. Remove a byte order mark.

    Args:
        content: bytes of the file.
        errors: treatment of bytes that are invalid in both encodings, see `bytes.decode`.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors)


@dataclass(frozen=True)
class Signal:
    """Signal of a payload, little endian: physical = raw * factor + offset."""

    name: str
    start: int  # index of the least significant bit in the payload
    length: int  # length of the signal [bit]
    signed: bool
    factor: float
    offset: float
    minimum: float  # smallest valid physical value
    maximum: float  # largest valid physical value
    unit: str
    invalid_raw: int | None  # unsigned raw code that means "no value"; None if the signal has no such code
    choices: Mapping[int, str]  # name of each raw value; empty if the signal is a number
    receivers: tuple[str, ...]  # nodes that receive the signal


@dataclass(frozen=True)
class Message:
    """CAN FD message of the network."""

    name: str
    frame_id: int  # 11-bit CAN identifier
    length: int  # length of the payload [byte]
    sender: str
    signals: tuple[Signal, ...]
    bus: str
    send_type: str  # "cyclic" or "event"
    cycle_ms: int  # period of a cyclic message [ms]; 0 for an event message
    timeout_ms: int  # timeout of the message at its receivers [ms]; 0 if the message has no timeout
    inhibit_ms: int  # minimum time between two frames of an event message [ms]
    data_id: int  # AUTOSAR E2E Data ID
    comment: str

    def signal(self, name: str) -> Signal:
        """Return the signal with the given name.

        Raises:
            KeyError: If there is no such name; the error lists the valid names.
        """
        return _named(self.signals, name, f"signal of {self.name}")

    @property
    def receivers(self) -> tuple[str, ...]:
        """Return the nodes that receive at least one signal of the message, in DBC order."""
        return tuple(dict.fromkeys(node for signal in self.signals for node in signal.receivers))


@dataclass(frozen=True)
class Node:
    """Node of the network. `kind` is master, drive, imu, foot, haptics or pendant."""

    name: str
    kind: str
    number: int


@dataclass(frozen=True)
class Network:
    """CAN network of the robot. Nodes and messages are in file order."""

    nodes: tuple[Node, ...]
    messages: tuple[Message, ...]
    buses: tuple[str, ...]
    nominal_bitrate: int  # bit rate of the arbitration phase [bit/s]
    data_bitrate: int  # bit rate of the data phase [bit/s]
    hash32: int  # CRC-32 of the DBC file. Each node sends this CRC in its heartbeat (DbcHash).

    @cached_property
    def _by_name(self) -> dict[str, Message]:
        return {message.name: message for message in self.messages}

    def message(self, name: str) -> Message:
        """Return the message with the given name.

        Raises:
            KeyError: If there is no such name; the error lists the valid names.
        """
        try:
            return self._by_name[name]
        except KeyError:
            raise KeyError(f"message must be one of {', '.join(self._by_name)}, got {name!r}") from None

    def node(self, name: str) -> Node:
        """Return the node with the given name.

        Raises:
            KeyError: If there is no such name; the error lists the valid names.
        """
        return _named(self.nodes, name, "node")

    def of_kind(self, kind: str) -> tuple[Node, ...]:
        """Return the nodes of a kind, ordered by number."""
        return tuple(sorted((n for n in self.nodes if n.kind == kind), key=lambda n: n.number))

    def sent_by(self, node: str) -> tuple[Message, ...]:
        """Return the messages that a node sends."""
        return tuple(m for m in self.messages if m.sender == node)

    def received_by(self, node: str) -> tuple[Message, ...]:
        """Return the messages that have at least one signal for a node."""
        return tuple(m for m in self.messages if node in m.receivers)

    def bus_load(self) -> dict[str, float]:
        """Return the worst-case load of each bus, 0 to 1. An event message is assumed to be sent once per inhibit time."""
        load = dict.fromkeys(self.buses, 0.0)
        for message in self.messages:
            period = (message.cycle_ms or message.inhibit_ms) * 1e-3
            load[message.bus] += wire_time(message.length, self.nominal_bitrate, self.data_bitrate) / period
        return load


_T = TypeVar("_T", Signal, Node)


def wire_time(length: int, nominal_bitrate: float = 1e6, data_bitrate: float = 5e6) -> float:
    """Return the longest time [s] for which a CAN FD frame with an 11-bit identifier occupies the bus, including stuff bits.

    The bit counts come from ISO 11898-1. The nominal phase with the interframe space has 33 bits. The data phase has 5 + 8 n
    bits for n payload bytes, and one stuff bit per four of these bits. The CRC with its fixed stuff bits and the delimiters adds
    28 bits, or 33 bits if n is above 16.

    Args:
        length: payload length n [byte].
        nominal_bitrate: bit rate of the nominal phase [bit/s].
        data_bitrate: bit rate of the data phase [bit/s].
    """
    stuffed = 5 + 8 * length
    data_bits = stuffed + stuffed // 4 + (33 if length > 16 else 28)
    return 33 / nominal_bitrate + data_bits / data_bitrate


def _named(items: tuple[_T, ...], name: str, kind: str) -> _T:
    for item in items:
        if item.name == name:
            return item
    raise KeyError(f"{kind} must be one of {', '.join(item.name for item in items)}, got {name!r}")
