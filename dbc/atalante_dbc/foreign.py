"""Lenient loader for any DBC: message layouts for the validator and for bulk decoding.

`loader.load` is strict, because its result controls a robot. This loader accepts every DBC that cantools can parse. It uses the
attributes of this project if the file contains them. It rejects a message with an ambiguous layout, and stores the reason.
"""

from __future__ import annotations

import math
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Database
from cantools.database.can import Message as RawMessage
from cantools.database.can import Signal as RawSignal
from cantools.database.errors import Error as CantoolsError

from atalante_dbc.network import E2E_HEADER, DbcError, decoded_text

#: Longest payload of a CAN FD frame and of a classic CAN frame [byte].
_FRAME_BYTES, _CLASSIC_BYTES = 64, 8
_WORD = 64
_FLOAT_BITS = (16, 32, 64)
_LARGEST_DATA_ID = 0xFFFF
#: Values of GenMsgSendType for cyclic messages, in lower case. The empty text stands for a missing GenMsgSendType.
_CYCLIC = ("", "cyclic", "cyclicx", "periodic", "fixedperiodic", "fixed_periodic")
# Masks of the parameter group in a J1939 identifier. The PDU format (bits 16 to 23) selects the mask.
# `_PGN_PEER` is for a PDU format below `_PDU2`. Such an identifier also contains a destination address.
# `_PGN_BROADCAST` is for a PDU format of at least `_PDU2`. Such an identifier contains no destination address.
_PGN_PEER, _PGN_BROADCAST, _PDU2 = 0x03FF0000, 0x03FFFF00, 240
_QUOTED = re.compile(r'"[^"]*"')
_WRITTEN = re.compile(r"\bBO_\s+(\d+)\s+(\w+)\s*:|\bSG_\s+(\w+)\s+(M|m\d+M?)?\s*:")


@dataclass(frozen=True)
class Field:
    """Signal of any DBC: physical = raw * factor + offset."""

    name: str
    start: int  # start bit in DBC numbering: least significant bit for Intel, most significant bit for Motorola
    length: int  # length of the signal [bit]
    big_endian: bool  # True for Motorola byte order, False for Intel byte order
    kind: str  # "unsigned", "signed" or "float" (IEEE 754)
    factor: int | float
    offset: int | float
    minimum: float | None  # smallest valid physical value; None if the DBC has no range
    maximum: float | None  # largest valid physical value; None if the DBC has no range
    unit: str
    invalid_raw: int | None  # unsigned raw code that means "no value"; None if the signal has no such code
    choices: Mapping[int, str]  # name of each raw value; empty if the signal has no value table
    receivers: tuple[str, ...]
    #: Multiplexers of the signal, each with the raw values that select the signal; empty if the signal is in every frame.
    selectors: tuple[tuple[str, frozenset[int]], ...]

    @property
    def first_bit(self) -> int:
        """Return the number of payload bits before the start bit, counted in the byte order of the signal.

        The count starts at the least significant bit of byte 0 (Intel) or at the most significant bit of byte 0 (Motorola).
        """
        return self.start ^ 7 if self.big_endian else self.start

    @property
    def bits(self) -> range | tuple[int, ...]:
        """Return the payload bits of the signal, numbered from the least significant bit of byte 0."""
        bits = range(self.first_bit, self.first_bit + self.length)
        return tuple(bit ^ 7 for bit in bits) if self.big_endian else bits


@dataclass(frozen=True)
class Layout:
    """Layout of a message of any DBC."""

    name: str
    frame_id: int
    extended: bool  # True for a 29-bit identifier, False for an 11-bit identifier
    fd: bool | None  # True for a CAN FD frame; None if unknown
    bit_rate_switch: bool | None  # True if the payload is sent at the data bit rate; None if unknown
    length: int  # length of the payload [byte]
    sender: str | None
    fields: tuple[Field, ...]
    bus: str | None
    cyclic: bool  # True if the message is sent every `cycle_ms`, False for an event message
    cycle_ms: float | None
    timeout_ms: float | None
    inhibit_ms: float | None  # minimum time between two frames of an event message [ms]
    data_id: int | None  # Data ID of AUTOSAR E2E Profile 5; None if the message is not protected
    #: Mask of the identifier bits that distinguish the message from other messages.
    #: For a J1939 message, these bits are the parameter group. For any other message, these bits are the whole identifier.
    pgn_mask: int
    #: Name of each multiplexer -> its known raw values: values that select a signal, and values with a name.
    multiplexers: Mapping[str, frozenset[int]]

    def field(self, name: str) -> Field:
        """Return the signal with the given name.

        Raises:
            KeyError: If there is no such name; the error lists the valid names.
        """
        for field in self.fields:
            if field.name == name:
                return field
        raise KeyError(f"signal of {self.name} must be one of {', '.join(f.name for f in self.fields)}, got {name!r}")


@dataclass(frozen=True)
class Refused:
    """Rejected message of a DBC, and the reason why the message cannot be decoded."""

    name: str
    frame_id: int
    extended: bool
    reason: str


@dataclass(frozen=True)
class Catalogue:
    """Content of a DBC: layouts in file order, rejected messages, nodes and buses."""

    path: Path
    layouts: tuple[Layout, ...]
    refused: tuple[Refused, ...]
    nodes: Mapping[str, str]  # kind of each node, by the name of the node; "" if the DBC has no NodeKind
    buses: tuple[str, ...]
    nominal_bitrate: float | None  # bit rate of the arbitration phase [bit/s]
    data_bitrate: float | None  # bit rate of the data phase [bit/s]
    hash32: int  # CRC-32 of the file

    @cached_property
    def _by_name(self) -> dict[str, Layout]:
        return {layout.name: layout for layout in self.layouts}

    def layout(self, name: str) -> Layout:
        """Return the layout of the message with the given name.

        Raises:
            KeyError: If the message is rejected or unknown. The error states the reason or the valid names.
        """
        if name in self._by_name:
            return self._by_name[name]
        for refused in self.refused:
            if refused.name == name:
                raise KeyError(f"the message {name} is not decoded: {refused.reason}")
        raise KeyError(f"message must be one of {', '.join(self._by_name)}, got {name!r}")


def catalogue(path: Path) -> Catalogue:
    """Load the message layouts of a DBC file; messages with an ambiguous layout are in `refused`.

    Raises:
        DbcError: If the file cannot be read or is not a DBC.
    """
    try:
        raw = path.read_bytes()
        text = decoded_text(raw, errors="replace")
        database = cantools.database.load_string(text, database_format="dbc", strict=False)
    except (OSError, ValueError, KeyError, IndexError, CantoolsError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DbcError(f"{path} cannot be read as a DBC: {reason}") from error
    assert isinstance(database, Database)
    dbc_text = _DbcText(text)
    reasons = [(m, next(_unsupported(m, dbc_text), "")) for m in database.messages]
    data_bitrate = _number(_of(database, "DataBitrate")) or _number(_of(database, "BaudrateCANFD"))
    return Catalogue(
        path=path,
        layouts=tuple(_layout(m, data_bitrate) for m, reason in reasons if not reason),
        refused=tuple(Refused(m.name, m.frame_id, m.is_extended_frame, reason) for m, reason in reasons if reason),
        nodes={node.name: _text(_of(node, "NodeKind")) for node in database.nodes},
        buses=tuple(_definitions(database)["Bus"].choices or ()) if "Bus" in _definitions(database) else (),
        nominal_bitrate=_number(_of(database, "NominalBitrate")) or _number(_of(database, "Baudrate")),
        data_bitrate=data_bitrate,
        hash32=zlib.crc32(raw),
    )


class _DbcText:
    """Identifiers, names and multiplexer marks of a DBC text, including the duplicates that cantools removes."""

    def __init__(self, text: str) -> None:
        self.ids: Counter[int] = Counter()
        self.names: Counter[str] = Counter()
        self.signals: dict[int, Counter[str]] = {}
        self.multiplexed: Counter[int] = Counter()  # frame id -> number of signals with a multiplexer mark m0, m1, ...
        current = -1
        for match in _WRITTEN.finditer(_QUOTED.sub('""', text)):
            if match[1]:
                current = int(match[1])
                self.ids[current] += 1
                self.names[match[2]] += 1
                self.signals.setdefault(current, Counter())
            elif current >= 0:
                self.signals[current][match[3]] += 1
                self.multiplexed[current] += (match[4] or "").startswith("m")


def _unsupported(message: RawMessage, dbc_text: _DbcText) -> Iterator[str]:
    """Yield every reason to reject a message."""
    key = message.frame_id | message.is_extended_frame << 31
    if dbc_text.ids[key] > 1:
        yield f"its identifier {message.frame_id:#x} is used by {dbc_text.ids[key]} messages"
    if dbc_text.names[message.name] > 1:
        yield f"its name is used by {dbc_text.names[message.name]} messages"
    if message.length > (_CLASSIC_BYTES if message.protocol == "j1939" else _FRAME_BYTES):
        yield f"its {message.length} bytes do not fit one frame (transport protocols are not supported)"
    if repeated := [name for name, count in dbc_text.signals.get(key, Counter()).items() if count > 1]:
        yield f"the signal name {repeated[0]} is used twice"
    if dbc_text.multiplexed[key] != sum(bool(s.multiplexer_ids) for s in message.signals):
        yield "a multiplexed signal has no multiplexer (M); extended multiplexing needs SG_MUL_VAL_"
    for signal in message.signals:
        yield from _unsupported_signal(message, signal)
    yield from _overlaps(message)


def _unsupported_signal(message: RawMessage, signal: RawSignal) -> Iterator[str]:
    name, is_float = signal.name, signal.conversion.is_float
    if is_float and signal.length not in _FLOAT_BITS:
        yield f"{name} is a float of {signal.length} bits, but a float must have 16, 32 or 64 bits"
    if signal.length > _WORD:
        yield f"{name} has {signal.length} bits, but at most 64 are supported"
    first = _first_bit(signal)
    if first + signal.length > 8 * message.length:
        yield f"{name} ends at bit {first + signal.length}, after the end of the message at bit {8 * message.length}"
    if not all(math.isfinite(x) for x in (signal.scale, signal.offset)):
        yield f"factor and offset of {name} must be finite, got {signal.scale} and {signal.offset}"
    if signal.is_multiplexer and (is_float or signal.scale != 1 or signal.offset != 0):
        yield f"the multiplexer {name} is scaled or a float, but must be an integer with factor 1 and offset 0"


def _overlaps(message: RawMessage) -> Iterator[str]:
    """Yield the first overlap of two signals that can be in the same frame."""
    owners: dict[int, list[tuple[str, dict[str, frozenset[int]]]]] = {}
    selectors = _selectors(message)
    for signal in message.signals:
        own = dict(selectors[signal.name])
        first = _first_bit(signal)
        for bit in range(first, first + signal.length):
            index = bit ^ 7 if signal.byte_order == "big_endian" else bit
            for other, others in owners.setdefault(index, []):
                if all(own[m] & others[m] for m in own.keys() & others.keys()):
                    yield f"{signal.name} overlaps {other}"
                    return
            owners[index].append((signal.name, own))


def _first_bit(signal: RawSignal) -> int:
    return signal.start ^ 7 if signal.byte_order == "big_endian" else signal.start


def _selectors(message: RawMessage) -> dict[str, tuple[tuple[str, frozenset[int]], ...]]:
    """Return the multiplexers of each signal, with the raw values that select the signal.

    Multiplexers can be nested. The outermost multiplexer is the first element.
    """
    by_name = {s.name: s for s in message.signals}

    def of(signal: RawSignal, depth: int = 0) -> tuple[tuple[str, frozenset[int]], ...]:
        parent = by_name.get(signal.multiplexer_signal or "")
        if parent is None or depth > len(by_name):
            return ()
        return (*of(parent, depth + 1), (parent.name, frozenset(signal.multiplexer_ids or ())))

    return {s.name: of(s) for s in message.signals}


def _multiplexers(message: RawMessage) -> dict[str, frozenset[int]]:
    """Return the known raw values of each multiplexer: values that select a signal, and values with a name."""
    known: dict[str, frozenset[int]] = {}
    for multiplexer in (s for s in message.signals if s.is_multiplexer):
        values = {int(value) for value in multiplexer.choices or {}}
        for signal in message.signals:
            if signal.multiplexer_signal == multiplexer.name:
                values.update(signal.multiplexer_ids or ())
        if values:
            known[multiplexer.name] = frozenset(values)
    return known


def _layout(message: RawMessage, data_bitrate: float | None) -> Layout:
    selectors = _selectors(message)
    send_type = _text(_of(message, "GenMsgSendType")).lower()
    cycle = _number(_of(message, "GenMsgCycleTime"))
    fd = message.is_fd or message.length > _CLASSIC_BYTES or (None if _of(message, "VFrameFormat") is None else False)
    switch = _text(_of(message, "CANFD_BRS"))
    return Layout(
        name=message.name,
        frame_id=message.frame_id,
        extended=message.is_extended_frame,
        fd=fd,
        bit_rate_switch=(switch not in ("0", "")) if switch else (True if fd and data_bitrate else None),
        length=message.length,
        sender=message.senders[0] if message.senders else None,
        fields=tuple(_field(s, selectors[s.name]) for s in message.signals),
        bus=_text(_of(message, "Bus")) or None,
        cyclic=bool(cycle) and send_type in _CYCLIC,
        cycle_ms=cycle,
        timeout_ms=_number(_of(message, "TimeoutTime")),
        inhibit_ms=_number(_of(message, "GenMsgDelayTime")),
        data_id=_data_id(message),
        pgn_mask=_pgn_mask(message),
        multiplexers=_multiplexers(message),
    )


def _data_id(message: RawMessage) -> int | None:
    """Return the E2E Data ID of a message; None if the message has no Profile 5 header or no Data ID of 16 bits."""
    data_id = _number(_of(message, "E2EDataId"))
    header = {s.name: (s.start, s.length) for s in message.signals if s.byte_order == "little_endian"}
    has_header = all(header.get(name) == bits for name, bits in E2E_HEADER.items())
    return int(data_id) if data_id and data_id <= _LARGEST_DATA_ID and has_header else None


def _pgn_mask(message: RawMessage) -> int:
    if message.protocol != "j1939" or not message.is_extended_frame:
        return 0x1FFFFFFF
    return _PGN_PEER if message.frame_id >> 16 & 0xFF < _PDU2 else _PGN_BROADCAST


def _field(signal: RawSignal, selectors: tuple[tuple[str, frozenset[int]], ...]) -> Field:
    is_float = signal.conversion.is_float
    return Field(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        kind="float" if is_float else "signed" if signal.is_signed else "unsigned",
        factor=signal.scale,
        offset=signal.offset,
        minimum=None if signal.minimum is None else float(signal.minimum),
        maximum=None if signal.maximum is None else float(signal.maximum),
        unit=signal.unit or "",
        invalid_raw=_invalid_raw(signal),
        choices={int(k): str(v) for k, v in (signal.choices or {}).items()},
        receivers=tuple(signal.receivers),
        selectors=selectors,
    )


def _invalid_raw(signal: RawSignal) -> int | None:
    """Return the raw code that means "no value"; None if the signal has no such code.

    The default of the attribute is ignored: a default of 0 would make the value 0 of every signal invalid.
    """
    if signal.dbc is None or "InvalidRaw" not in (signal.dbc.attributes or {}):
        return None
    try:
        value = int(_text(_of(signal, "InvalidRaw")), 0)
    except ValueError:
        return None
    return value if 0 <= value < 1 << signal.length else None


def _definitions(database: Database) -> Mapping[str, Any]:
    return database.dbc.attribute_definitions if database.dbc is not None else {}


def _of(item: Any, name: str) -> object:
    """Return the value of an attribute, or its default if the value is not set; None if the attribute is not defined."""
    if item.dbc is None:
        return None
    attributes, definitions = item.dbc.attributes or {}, item.dbc.attribute_definitions or {}
    definition = definitions.get(name)
    if definition is None:
        return None
    value = attributes[name].value if name in attributes else definition.default_value
    if definition.choices and isinstance(value, int) and 0 <= value < len(definition.choices):
        return str(definition.choices[value])
    found: object = value
    return found


def _number(value: object) -> float | None:
    """Return an attribute value as a number; None if it is not a positive number. In a DBC, 0 means "not set"."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return number if number > 0 and math.isfinite(number) else None


def _text(value: object) -> str:
    return "" if value is None else str(value)
