"""Fault memory, which contains the active diagnostics and logs an event for each new diagnostic.

`monitors, transceiver, plausibility, loop -> fault memory -> state machine (confirmed codes), telemetry (events)`

If a diagnostic toggles, its first event is logged at once. Repeats within `FOLD_CYCLES` are counted, and then one event with the
count is logged. So at most two events per second are logged for one diagnostic of one node: one for the pending diagnostic and
one for the confirmed diagnostic. Every occurrence is counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import islice

from atalante_hal.safety.diagnostics import (
    Dtc,
    Finding,
    Reaction,
    Severity,
    event_code,
    permits_walk_end,
    worst,
)
from atalante_hal.safety.events import Event

#: Time after a logged event in which equal events are only counted, not logged [cycles].
FOLD_CYCLES = 1000
#: Number of events that the log keeps. These events need about 2 MB of memory.
EVENTS_KEPT = 4096


class EventLog:
    """Log of the newest events, and number of all events.

    Events are numbered in the order in which they are appended, starting at 0. The number of an event never changes. The
    index of an event in the log changes when older events are dropped.

    Args:
        capacity: maximum number of events in the log.
    """

    def __init__(self, capacity: int = EVENTS_KEPT) -> None:
        self._kept: deque[Event] = deque(maxlen=capacity)
        #: Number of all events appended so far. `count` is also the number of the next event.
        self.count = 0

    def append(self, event: Event) -> None:
        """Append an event; drop the oldest event if the log is full."""
        self._kept.append(event)
        self.count += 1

    def since(self, number: int) -> list[Event]:
        """Return the logged events whose number is at least the given number, oldest first.

        Args:
            number: number of the first event to return, such as an earlier `count`.
        """
        wanted = min(self.count - number, len(self._kept))
        return list(islice(reversed(self._kept), max(0, wanted)))[::-1]

    @property
    def dropped(self) -> int:
        """Return the number of events dropped so far."""
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
    """Active diagnostic of one node."""

    confirmed: bool
    text: str
    value: float
    cycle: int  # cycle in which the diagnostic was last raised


@dataclass(slots=True)
class Window:
    """Counting window: time of `FOLD_CYCLES` after a logged event, in which equal events are only counted, not logged."""

    end: int  # first cycle after the window
    latest: Event  # newest of the equal events
    repeats: int = 0  # number of equal events that were counted in the window


class FaultMemory:
    """Set of active diagnostics of all nodes.

    Call `raise_dtc` for every fault that is present in a cycle, and then `close_cycle`. `close_cycle` ends every
    diagnostic that was not raised in this cycle. An event is logged when a diagnostic becomes active, and again when
    the diagnostic is confirmed.
    """

    def __init__(self) -> None:
        #: Logged events, in order of time.
        self.events = EventLog()
        self.active: dict[tuple[Dtc, str], Entry] = {}
        #: Bit set of all pending and confirmed codes, as updated by the last `close_cycle`, see `diagnostics.dtcs_of`.
        self.bits = 0
        self.confirmed: frozenset[Dtc] = frozenset()
        self._windows: dict[tuple[str, str, bool], Window] = {}  # key: code, node, whether the diagnostic is confirmed

    def raise_dtc(
        self, cycle: int, dtc: Dtc, node: str, *, value: float = 0.0, confirmed: bool = True, text: str = ""
    ) -> None:
        """Mark a diagnostic as active in this cycle. Log an event if the diagnostic, its confirmation or its error code is new.

        A pending fault does not change the value and text of a fault that is already confirmed in this cycle.

        Args:
            cycle: number of the current cycle.
            dtc: diagnostic trouble code.
            node: DBC name of the affected node.
            value: measured value. Its quantity and unit depend on the code.
            confirmed: True if the fault exceeds its limit, so that its reaction is due.
            text: one sentence for the operator; default: node name and meaning of the code.
        """
        entry = self.active.get((dtc, node))
        if entry is not None and entry.confirmed and entry.cycle == cycle and not confirmed:
            return
        before = (
            entry is not None
            and (entry.confirmed or not confirmed)
            and event_code(dtc, entry.value) == event_code(dtc, value)
        )
        if entry is None:
            entry = self.active[dtc, node] = Entry(confirmed, "", value, cycle)
        else:
            entry.confirmed, entry.value, entry.cycle = confirmed, value, cycle
        if not before or not entry.text:
            entry.text = text or f"{node}: {dtc.meaning}"
            self._log(cycle, dtc, node, entry)
        elif text:
            entry.text = text

    def raise_finding(self, cycle: int, finding: Finding) -> None:
        """Mark the diagnostic of a finding as active in this cycle, see `raise_dtc`.

        Args:
            cycle: number of the current cycle.
            finding: fault found in this cycle.
        """
        value, confirmed, text = finding.value, finding.confirmed, finding.text
        self.raise_dtc(cycle, finding.dtc, finding.node, value=value, confirmed=confirmed, text=text)

    def close_cycle(self, cycle: int) -> None:
        """Remove the diagnostics that were not raised in this cycle, update `bits` and `confirmed`, and log repeats."""
        self.active = {key: entry for key, entry in self.active.items() if entry.cycle == cycle}
        bits = 0
        for dtc, _ in self.active:
            bits |= dtc.bit
        self.bits = bits
        self.confirmed = frozenset(dtc for (dtc, _), entry in self.active.items() if entry.confirmed)
        if self.window_over(cycle):
            self.log_repeats(cycle)

    def worst(self) -> frozenset[Dtc]:
        """Return those confirmed codes that have the most severe reaction; empty if this reaction is INFO."""
        reaction = worst(self.confirmed)
        return frozenset(dtc for dtc in self.confirmed if dtc.reaction is reaction is not Reaction.INFO)

    def walk_ends(self, drives: Collection[str]) -> frozenset[Dtc]:
        """Return the confirmed codes that permit a walking robot to finish its walk before HOLD, see `permits_walk_end`.

        With these codes, the robot walks on until it stands on both feet, and then goes to HOLD. All other codes keep their
        reaction: a code with the reaction HOLD leads to HOLD at once. A code may be confirmed for several nodes. The code is
        returned only if all these nodes permit the end of the walk.

        Args:
            drives: DBC names of the drives.
        """
        confirmed = [key for key, entry in self.active.items() if entry.confirmed]
        return self.confirmed - {dtc for dtc, node in confirmed if not permits_walk_end(dtc, node in drives)}

    def nodes_of(self, dtcs: frozenset[Dtc]) -> list[str]:
        """Return the nodes for which one of the codes is confirmed."""
        return [node for (dtc, node), entry in self.active.items() if dtc in dtcs and entry.confirmed]

    def text_of(self, dtcs: frozenset[Dtc]) -> str:
        """Return the text of the first confirmed diagnostic with one of the codes; empty if none is confirmed."""
        return next((entry.text for (dtc, _), entry in self.active.items() if dtc in dtcs and entry.confirmed), "")

    def log(self, event: Event, *, confirmed: bool) -> None:
        """Log an event, or count it if an event with the same code and node was logged within `FOLD_CYCLES`.

        Args:
            event: event of the current cycle.
            confirmed: False for a pending diagnostic. Pending and confirmed diagnostics are counted separately.
        """
        key = event.code, event.node, confirmed
        window = self._windows.get(key)
        if window is None:
            self._windows[key] = Window(event.cycle + FOLD_CYCLES, event)
            self.events.append(event)
        else:
            window.latest, window.repeats = event, window.repeats + 1

    def window_over(self, cycle: int) -> bool:
        """Return whether any counting window has ended, so that `log_repeats` must be called.

        Args:
            cycle: number of the current cycle.
        """
        return any(cycle >= window.end for window in self._windows.values())

    def log_repeats(self, cycle: int, *, final: bool = False) -> None:
        """Remove each counting window that has ended, and log the number of equal events that were counted in this window.

        If no event was counted, nothing is logged. Otherwise one event with the number is logged and begins a new window.

        Args:
            cycle: number of the current cycle.
            final: True at the end of a run: all windows end, and no new window begins.
        """
        over = [(key, window) for key, window in self._windows.items() if final or cycle >= window.end]
        for key, window in over:
            del self._windows[key]
            if window.repeats:
                text = f"{window.latest.text} ({window.repeats} times since the last such event)"
                self.events.append(replace(window.latest, cycle=cycle, text=text, count=window.repeats))
                if not final:
                    self._windows[key] = Window(cycle + FOLD_CYCLES, window.latest)

    def _log(self, cycle: int, dtc: Dtc, node: str, entry: Entry) -> None:
        severity = dtc.severity if entry.confirmed else min(dtc.severity, Severity.WARNING, key=_SEVERITY_ORDER.index)
        event = Event(cycle, event_code(dtc, entry.value), entry.text, severity.value, node, entry.value)
        self.log(event, confirmed=entry.confirmed)


_SEVERITY_ORDER = list(Severity)
