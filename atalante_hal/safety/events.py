"""Events, such as diagnostics and state changes, packed as records of a separate ring buffer.

Events are rare and small. Events have their own ring, so no event is dropped when the telemetry stream is full.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

#: Severity names, in the order of the enum `Severity` in messages.proto.
SEVERITIES = ("info", "warning", "error")
#: Packed fields: run number, cycle, value, count, severity, code, node, text.
_RECORD = struct.Struct("<qqdIB39s32s220s")
EVENT_BYTES = _RECORD.size
EVENT_SLOTS = 1024


@dataclass(frozen=True)
class Event:
    """Record of a single occurrence, such as a new diagnostic or a state change."""

    cycle: int
    code: str  # code of the event, e.g. NODE_TIMEOUT; cut to 39 bytes when packed
    text: str  # one sentence for the operator; cut to 220 bytes when packed
    severity: str = "info"  # severity of the event, one of `SEVERITIES`
    node: str = "HAL"  # DBC name of the node; cut to 32 bytes when packed
    value: float = 0.0  # measured value; quantity and unit depend on the code
    count: int = 1  # number of occurrences that this event reports

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise ValueError(
                f"the severity of event {self.code} must be one of {', '.join(SEVERITIES)}, got {self.severity!r}"
            )


def pack(event: Event, run: int) -> bytes:
    """Pack an event as bytes. Texts that are too long are cut.

    Args:
        event: event to pack.
        run: number of the run that the event belongs to.
    """
    return _RECORD.pack(
        run,
        event.cycle,
        event.value,
        event.count,
        SEVERITIES.index(event.severity),
        event.code.encode(),
        event.node.encode(),
        event.text.encode(),
    )


def unpack(packed: bytes) -> tuple[Event, int]:
    """Unpack an event and the number of its run."""
    run, cycle, value, count, severity, code, node, text = _RECORD.unpack(packed)
    return Event(cycle, _text(code), _text(text), SEVERITIES[severity], _text(node), value, count), run


def _text(packed: bytes) -> str:
    return packed.rstrip(b"\0").decode(errors="ignore")
