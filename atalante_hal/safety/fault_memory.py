"""The fault memory: which diagnostics are active, since when, and the events that say so once.

`message monitor, heartbeats, transceiver, plausibility, loop -> fault memory -> supervisor (confirmed codes), telemetry (events)`
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

from atalante_hal.safety.diagnostics import Dtc, Reaction, Severity, event_code, worst
from atalante_hal.safety.events import Event

#: A diagnostic that ends and begins again is told anew after so many cycles, pending or confirmed: a bad line does not fill
#: the log.
QUIET_PENDING, QUIET_CONFIRMED = 1000, 20


#: Newest events that are kept: about 2 MB, in a process whose memory is locked.
EVENTS_KEPT = 4096


class EventLog:
    """Keep the newest events and count all of them.

    Events are numbered from 0 in the order they are appended. The number of an event stays the same when older ones are
    dropped; its index among those that are kept does not.

    Args:
        capacity: largest number of events that are kept.
    """

    def __init__(self, capacity: int = EVENTS_KEPT) -> None:
        self._kept: deque[Event] = deque(maxlen=capacity)
        #: Events appended so far, which is the number of the next one.
        self.count = 0

    def append(self, event: Event) -> None:
        """Add an event; the oldest is dropped if the log is full."""
        self._kept.append(event)
        self.count += 1

    def since(self, number: int) -> list[Event]:
        """Return the events from a number on, oldest first, as far as they are kept.

        Args:
            number: of the first event, such as an earlier `count`.
        """
        wanted = min(self.count - number, len(self._kept))
        return list(islice(reversed(self._kept), max(0, wanted)))[::-1]

    @property
    def dropped(self) -> int:
        """Events that are not kept any more."""
        return self.count - len(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Event]:
        return iter(self._kept)

    def __getitem__(self, index: int) -> Event:
        return self._kept[index]

    def __repr__(self) -> str:
        return repr(list(self._kept))


@dataclass(slots=True)
class Entry:
    """One diagnostic of one node while it is active."""

    confirmed: bool
    text: str
    value: float
    cycle: int  # raised last


class FaultMemory:
    """Everything that is raised in a cycle, then `close_cycle`: what was not raised again is over.

    A diagnostic is noted as an event when it begins, and again when it is confirmed.
    """

    def __init__(self) -> None:
        #: What began, in order.
        self.events = EventLog()
        self.active: dict[tuple[Dtc, str], Entry] = {}
        #: Bits of the active codes, of the confirmed ones: `diagnostics.dtcs_of`.
        self.bits = 0
        self.confirmed: frozenset[Dtc] = frozenset()
        self._noted: dict[tuple[Dtc, str, bool], int] = {}

    def raise_dtc(
        self, cycle: int, dtc: Dtc, node: str, *, value: float = 0.0, confirmed: bool = True, text: str = ""
    ) -> None:
        """A diagnostic holds in this cycle.

        Args:
            node: DBC name of the node it is about.
            value: what was measured; its meaning depends on the code.
            confirmed: its bound is passed and its reaction is due.
            text: one sentence for people; the code's meaning unless given.
        """
        entry = self.active.get((dtc, node))
        before = entry is not None and (entry.confirmed or not confirmed)
        if entry is None:
            entry = self.active[dtc, node] = Entry(confirmed, "", value, cycle)
        entry.confirmed = confirmed or (entry.confirmed and entry.cycle == cycle)
        entry.value, entry.cycle = value, cycle
        if not before or not entry.text:
            entry.text = text or f"{node}: {dtc.meaning}"
            self._note(cycle, dtc, node, entry)

    def close_cycle(self, cycle: int) -> None:
        """Forget what did not hold in this cycle, and sum up what did."""
        self.active = {key: entry for key, entry in self.active.items() if entry.cycle == cycle}
        bits = 0
        for dtc, _ in self.active:
            bits |= dtc.bit
        self.bits = bits
        self.confirmed = frozenset(dtc for (dtc, _), entry in self.active.items() if entry.confirmed)

    def worst(self) -> frozenset[Dtc]:
        """Return the confirmed codes that demand the worst reaction; empty when none demands any."""
        reaction = worst(self.confirmed)
        return frozenset(dtc for dtc in self.confirmed if dtc.reaction is reaction is not Reaction.INFO)

    def nodes_of(self, dtcs: frozenset[Dtc]) -> list[str]:
        """Nodes one of these codes is confirmed for."""
        return [node for (dtc, node), entry in self.active.items() if dtc in dtcs and entry.confirmed]

    def text_of(self, dtcs: frozenset[Dtc]) -> str:
        """What is said about the first of these codes; empty when none is active."""
        return next((entry.text for (dtc, _), entry in self.active.items() if dtc in dtcs), "")

    def _note(self, cycle: int, dtc: Dtc, node: str, entry: Entry) -> None:
        key = dtc, node, entry.confirmed
        last = self._noted.get(key)
        if last is not None and cycle - last < (QUIET_CONFIRMED if entry.confirmed else QUIET_PENDING):
            return
        self._noted[key] = cycle
        severity = dtc.severity if entry.confirmed else min(dtc.severity, Severity.WARNING, key=_LOUDNESS.index)
        self.events.append(Event(cycle, event_code(dtc, entry.value), entry.text, severity.value, node, entry.value))


_LOUDNESS = list(Severity)
