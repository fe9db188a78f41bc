"""The fault memory: which diagnostics are active, since when, and the events that say so once.

`judgement, heartbeats, transceiver, plausibility, loop -> fault memory -> supervisor (confirmed codes), telemetry (events)`
"""

from __future__ import annotations

from dataclasses import dataclass

from atalante_hal.diagnostics import Dtc, Severity, event_code
from atalante_hal.telemetry.events import Event

#: A diagnostic that ends and begins again is told anew after so many cycles, pending or confirmed: a bad line does not fill
#: the log.
QUIET_PENDING, QUIET_CONFIRMED = 1000, 20


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
        self.events: list[Event] = []
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
