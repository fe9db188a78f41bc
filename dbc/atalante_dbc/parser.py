"""Strict parser of a DBC. It uses cantools, and reports each ambiguous or unsafe definition with its line number.

cantools accepts duplicate identifiers, duplicate names, factor 0 and signals without receiver. This parser rejects them.
"""

from __future__ import annotations

import math
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Database
from cantools.database.can import Message as RawMessage
from cantools.database.can import Signal as RawSignal
from cantools.database.errors import Error as CantoolsError

from atalante_dbc.attributes import missing, wrong_values
from atalante_dbc.network import (
    E2E_HEADER,
    FD_LENGTHS,
    LONGEST_SIGNAL,
    DbcError,
    Message,
    Network,
    Node,
    Signal,
    decoded_text,
)

_FD_FORMAT = "StandardCAN_FD"
_BO = re.compile(r"BO_\s+(\d+)\s+(\w+)\s*:\s*(\d+)\s+(\w+)")
_SG = re.compile(r"SG_\s+(\w+)\s*(\w*)\s*:")


def parse(path: Path) -> Network:
    """Parse and check a DBC file.

    Args:
        path: DBC file.

    Raises:
        DbcError: If the file cannot be read or parsed, or violates a rule (see `_problems`).
    """
    try:
        raw = path.read_bytes()
        text = decoded_text(raw)
        lines = _Lines(text)
        # These checks come first, because cantools removes duplicates and reports invalid values without a line number.
        _require_no_problems(path, chain(_duplicates(lines), wrong_values(text)))
        database = cantools.database.load_string(text, database_format="dbc", strict=False)
    except DbcError:
        raise
    except OSError as error:
        raise DbcError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, CantoolsError) as error:
        raise DbcError(f"{path}: {error}") from error
    assert isinstance(database, Database)
    _require_no_problems(path, missing(text))
    _require_no_problems(path, _problems(database, lines))
    return Network(
        nodes=tuple(
            Node(n.name, str(_attribute(n, "NodeKind")), int(_attribute(n, "NodeNumber"))) for n in database.nodes
        ),
        messages=tuple(_message(m) for m in database.messages),
        buses=tuple(_definitions(database)["Bus"].choices),
        nominal_bitrate=int(_global(database, "NominalBitrate")),
        data_bitrate=int(_global(database, "DataBitrate")),
        hash32=zlib.crc32(raw),
    )


def _require_no_problems(path: Path, found: Iterator[tuple[int, str]]) -> None:
    if problems := sorted(set(found)):
        raise DbcError("\n".join(f"{path}:{line}: {problem}" for line, problem in problems))


class _Lines:
    """Line numbers of messages and signals, because cantools does not store line numbers."""

    def __init__(self, text: str) -> None:
        self.messages: list[tuple[int, int, str]] = []  # (line, frame id, name) of each message, with duplicates
        self.signals: list[tuple[int, str, str, str]] = []  # (line, message, signal, multiplexer mark) of each signal
        for number, line in enumerate(text.splitlines(), start=1):
            if match := _BO.match(line.lstrip()):
                self.messages.append((number, int(match[1]), match[2]))
            elif (match := _SG.match(line.lstrip())) and self.messages:
                self.signals.append((number, self.messages[-1][2], match[1], match[2]))
        self._signal = {(message, name): number for number, message, name, _ in self.signals}
        self._message = {name: number for number, _, name in self.messages}

    def message(self, message: RawMessage) -> int:
        # If the definition of a message is spread over several lines, `_message` has no entry for it, and line 1 is returned.
        return self._message.get(message.name, 1)

    def signal(self, message: RawMessage, signal: RawSignal) -> int:
        return self._signal.get((message.name, signal.name), self.message(message))


def _problems(database: Database, lines: _Lines) -> Iterator[tuple[int, str]]:
    """Yield each violation of a rule as (line number, problem)."""
    data_ids: dict[int, str] = {}
    nodes = {node.name for node in database.nodes}
    for message in database.messages:
        line = lines.message(message)
        yield from ((line, f"{message.name} {problem}") for problem in _message_problems(message, nodes))
        data_id = int(_attribute(message, "E2EDataId"))
        if other := data_ids.get(data_id):
            yield line, f"{message.name} must have a unique E2EDataId, got {data_id}, which {other} also has"
        data_ids[data_id] = message.name
        for signal in message.signals:
            signal_line = lines.signal(message, signal)
            name = f"{message.name}.{signal.name}"
            yield from ((signal_line, f"{name} {problem}") for problem in _signal_problems(message, signal, nodes))
        yield from _overlaps(message, lines)
    yield from _sender_problems(database, lines)


def _sender_problems(database: Database, lines: _Lines) -> Iterator[tuple[int, str]]:
    """Yield each message that a node sends on an unexpected bus. The expected bus carries most messages of the node.

    Only the master may send on several buses.
    """
    masters = {node.name for node in database.nodes if _attribute(node, "NodeKind") == "master"}
    sent: dict[str, list[RawMessage]] = {}
    for message in database.messages:
        for sender in set(message.senders) - masters:
            sent.setdefault(sender, []).append(message)
    for sender, messages in sent.items():
        buses = Counter(str(_attribute(message, "Bus")) for message in messages)
        expected = buses.most_common(1)[0][0]
        for message in messages:
            if (bus := _attribute(message, "Bus")) != expected:
                yield (
                    lines.message(message),
                    f"{message.name} must be on {expected}, as most messages of {sender}, got {bus}",
                )


def _duplicates(lines: _Lines) -> Iterator[tuple[int, str]]:
    ids: dict[int, int] = {}
    names: dict[str, int] = {}
    for line, frame_id, name in lines.messages:
        if frame_id in ids:
            yield line, f"{name} must have a unique frame id, got {frame_id:#x}, which line {ids[frame_id]} also has"
        if name in names:
            yield line, f"the message name {name} must be unique, but line {names[name]} also has it"
        ids.setdefault(frame_id, line)
        names.setdefault(name, line)
    signals: dict[tuple[str, str], int] = {}
    for line, message, signal, multiplexer in lines.signals:
        if (message, signal) in signals:
            other = signals[message, signal]
            yield line, f"the signal name {message}.{signal} must be unique, but line {other} also has it"
        signals.setdefault((message, signal), line)
        if multiplexer:
            yield line, f"{message}.{signal} must not be multiplexed, because every message must have one layout"


def _message_problems(message: RawMessage, nodes: set[str]) -> Iterator[str]:
    if message.length not in FD_LENGTHS:
        yield f"must have a length of {', '.join(map(str, FD_LENGTHS))} bytes, got {message.length} bytes"
    if message.is_extended_frame:
        yield f"must have an 11-bit identifier, got the 29-bit identifier {message.frame_id:#x}"
    if _attribute(message, "VFrameFormat") != _FD_FORMAT:
        yield f"must be a CAN FD frame; set VFrameFormat to {_FD_FORMAT}"
    if not set(message.senders) <= nodes or len(message.senders) != 1:
        yield f"must have one sender from BU_, got {', '.join(message.senders) or 'none'}"
    for name, (start, length) in E2E_HEADER.items():
        found = next((s for s in message.signals if s.name == name), None)
        if found is None or (found.start, found.length, found.is_signed) != (start, length, False):
            yield f"must have the unsigned signal {name} : {start}|{length}@1+ of the E2E header"
    cyclic = _attribute(message, "GenMsgSendType") == "cyclic"
    if cyclic and not int(_attribute(message, "GenMsgCycleTime")):
        yield "is cyclic and must have a GenMsgCycleTime above 0"
    if cyclic and int(_attribute(message, "TimeoutTime")) <= int(_attribute(message, "GenMsgCycleTime")):
        yield "is cyclic and must have a TimeoutTime above its cycle time"
    if not cyclic and not int(_attribute(message, "GenMsgDelayTime")):
        yield "is an event and must have a GenMsgDelayTime (inhibit time) above 0, which limits its bus load"
    if not 1 <= (data_id := int(_attribute(message, "E2EDataId"))) <= 0xFFFF:
        yield f"must have an E2EDataId from 1 to 65535, got {data_id}"


def _signal_problems(message: RawMessage, signal: RawSignal, nodes: set[str]) -> Iterator[str]:
    if signal.byte_order != "little_endian":
        yield "must be little endian (@1), got big endian (@0)"
        return
    if signal.is_float:
        yield "must be a scaled integer, got a float"
    if signal.length > LONGEST_SIGNAL:
        yield f"must have at most {LONGEST_SIGNAL} bits, got {signal.length} bits"
    end = signal.start + signal.length
    if end > 8 * message.length:
        yield f"must end within the {8 * message.length} bits of the message, got end bit {end}"
    if signal.start // 64 != (end - 1) // 64:
        yield f"must not cross the 64-bit word boundary at bit {(end - 1) // 64 * 64}"
    if not signal.unit:
        yield 'must have a unit; write "1" for a number without unit'
    if not signal.receivers or not set(signal.receivers) <= nodes:
        yield f"must have receivers from BU_, got {', '.join(signal.receivers) or 'none'}"
    if not 0 < signal.scale < math.inf or not math.isfinite(signal.offset):
        yield f"must have a finite offset and a finite factor above 0, got factor {signal.scale} and offset {signal.offset}"
        return
    yield from _range_problems(signal)


def _range_problems(signal: RawSignal) -> Iterator[str]:
    if signal.minimum is None or signal.maximum is None or not signal.minimum < signal.maximum:
        low, high = signal.minimum or 0, signal.maximum or 0  # cantools returns None for [0|0]
        yield f"must have a range [min|max] with min < max, got [{low}|{high}]"
        return
    low, high = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)
    )
    raw = sorted(((signal.minimum - signal.offset) / signal.scale, (signal.maximum - signal.offset) / signal.scale))
    if raw[0] < low - 1e-6 or raw[1] > high + 1e-6:
        yield (
            f"must have a range that fits {signal.length} bits with factor {signal.scale}, "
            f"got [{signal.minimum}|{signal.maximum}]"
        )
    invalid = _invalid_raw(signal)
    if invalid is not None:
        value = invalid - (1 << signal.length) if signal.is_signed and invalid >> signal.length - 1 else invalid
        if not 0 <= invalid < 1 << signal.length:
            yield f"must have an InvalidRaw of at most {signal.length} bits, got {invalid:#x}"
        elif raw[0] - 0.5 <= value <= raw[1] + 0.5:
            yield f"must have an InvalidRaw outside its valid range, got {invalid:#x}"


def _overlaps(message: RawMessage, lines: _Lines) -> Iterator[tuple[int, str]]:
    """Yield each signal that overlaps an earlier signal of the same message."""
    owner: dict[int, RawSignal] = {}
    for signal in sorted(message.signals, key=lambda s: lines.signal(message, s)):
        if signal.byte_order != "little_endian":
            continue
        bits = range(signal.start, signal.start + signal.length)
        if other := next((owner[bit] for bit in bits if bit in owner), None):
            yield lines.signal(message, signal), f"{message.name}.{signal.name} overlaps {other.name}"
        owner.update(dict.fromkeys(bits, signal))


def _message(message: RawMessage) -> Message:
    return Message(
        name=message.name,
        frame_id=message.frame_id,
        length=message.length,
        sender=message.senders[0],
        signals=tuple(_signal(s) for s in message.signals),
        bus=str(_attribute(message, "Bus")),
        send_type=str(_attribute(message, "GenMsgSendType")),
        cycle_ms=int(_attribute(message, "GenMsgCycleTime")),
        timeout_ms=int(_attribute(message, "TimeoutTime")),
        inhibit_ms=int(_attribute(message, "GenMsgDelayTime")),
        data_id=int(_attribute(message, "E2EDataId")),
        comment=message.comment or "",
    )


def _signal(signal: RawSignal) -> Signal:
    assert signal.minimum is not None
    assert signal.maximum is not None
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        signed=signal.is_signed,
        factor=float(signal.scale),
        offset=float(signal.offset),
        minimum=float(signal.minimum),
        maximum=float(signal.maximum),
        unit=signal.unit or "",
        invalid_raw=_invalid_raw(signal),
        choices={int(k): str(v) for k, v in (signal.choices or {}).items()},
        receivers=tuple(signal.receivers),
    )


def _invalid_raw(signal: RawSignal) -> int | None:
    text = str(_attribute(signal, "InvalidRaw"))
    return int(text, 0) if text else None


def _attribute(item: Any, name: str) -> int | str:
    """Return the value of an attribute, or its default if the value is not set. An enumeration value is returned by name."""
    attributes = item.dbc.attributes if item.dbc is not None else {}
    if name in attributes:
        definition, value = attributes[name].definition, attributes[name].value
    else:
        definition = item.dbc.attribute_definitions.get(name) if item.dbc is not None else None
        value = definition.default_value if definition is not None else ""
    if definition is not None and definition.choices and isinstance(value, int):
        return str(definition.choices[value])
    return value  # type: ignore[no-any-return]


def _definitions(database: Database) -> dict[str, Any]:
    return database.dbc.attribute_definitions if database.dbc is not None else {}


def _global(database: Database, name: str) -> Any:
    attributes = database.dbc.attributes if database.dbc is not None else {}
    return attributes[name].value if name in attributes else _definitions(database)[name].default_value
