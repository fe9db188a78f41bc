"""Events (diagnostics, changes of state) as records of a ring of their own: seldom, small, and never dropped for a stream."""

from __future__ import annotations

import struct
from dataclasses import dataclass

#: In the order of the enum `Severity` of messages.proto.
SEVERITIES = ("info", "warning", "error")
#: Number of the run, cycle, value, severity, code, node, text.
_RECORD = struct.Struct("<qqdB39s32s216s")
EVENT_BYTES = _RECORD.size
EVENT_SLOTS = 1024


@dataclass(frozen=True)
class Event:
    """Something that happened, once."""

    cycle: int
    code: str  # e.g. NODE_TIMEOUT; 39 bytes are carried
    text: str  # one sentence for people; 216 bytes are carried
    severity: str = "info"  # one of `SEVERITIES`
    node: str = "HAL"  # DBC name of the node; 32 bytes are carried
    value: float = 0.0  # what was measured; its meaning depends on the code

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise ValueError(
                f"the severity of event {self.code} is {self.severity!r}; valid are {', '.join(SEVERITIES)}"
            )


def pack(event: Event, run: int) -> bytes:
    """Bytes of an event of the run of that number. Too long texts are cut."""
    return _RECORD.pack(
        run,
        event.cycle,
        event.value,
        SEVERITIES.index(event.severity),
        event.code.encode(),
        event.node.encode(),
        event.text.encode(),
    )


def unpack(packed: bytes) -> tuple[Event, int]:
    """The event and the number of its run."""
    run, cycle, value, severity, code, node, text = _RECORD.unpack(packed)
    return Event(cycle, _text(code), _text(text), SEVERITIES[severity], _text(node), value), run


def _text(packed: bytes) -> str:
    return packed.rstrip(b"\0").decode(errors="ignore")
