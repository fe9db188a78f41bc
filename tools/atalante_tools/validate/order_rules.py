"""Order within the cycle: SYNC first, then every state of its bus, before the deadline."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from atalante_tools.validate.e2e_rules import Steps
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import UNKNOWN, Plan
from atalante_tools.validate.project import Project
from atalante_tools.validate.stream import Stream

Places = npt.NDArray[np.intp]

#: A message of this name, and of the cycle of the states, begins the cycle of its bus.
SYNC = "SYNC"


@dataclass
class _Bus:
    """One bus with a SYNC, and what the chunks before left behind."""

    sync: int  # row
    states: list[int]  # rows
    cycle_ns: float
    count: int = 0  # SYNCs so far
    stamp: int = 0  # of the last one
    cycle_of: dict[int, int] = field(default_factory=dict)  # row -> cycle of its last state
    jump_of: dict[int, int] = field(default_factory=dict)  # row -> how far that was from the one before
    doubtful: dict[int, int] = field(default_factory=dict)  # row -> stamp of a second state in its cycle


class OrderRules:
    """Counts the SYNCs of each bus and asks in which cycle, and how long after its SYNC, each state came."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._findings = findings
        self._deadline = project.number("state-late", "deadline")
        self.buses: list[_Bus] = []
        for row, layout in enumerate(plan.layouts):
            if not layout.name.upper().startswith(SYNC) or not plan.cycle_ns[row]:
                continue
            same = [
                r for r, m in enumerate(plan.layouts) if m.bus == layout.bus and plan.cycle_ns[r] == plan.cycle_ns[row]
            ]
            states = [r for r in same if plan.sender_of_row[r] not in (UNKNOWN, plan.sender_of_row[row])]
            self.buses.append(_Bus(row, states, float(plan.cycle_ns[row])))

    @property
    def judged(self) -> set[int]:
        """Rows that are judged."""
        return {row for bus in self.buses for row in (bus.sync, *bus.states)}

    def judge(self, stream: Stream, steps: Steps) -> None:
        """Judge a chunk. `steps` of the alive counters, shape (n,)."""
        for bus in self.buses:
            span = stream.of(bus.sync)
            places, stamps = stream.places[span], stream.stamps[span]
            begins = np.concatenate([[bus.stamp], stamps])
            for row in bus.states:
                of = stream.of(row)
                if of.start != of.stop:
                    number = _cycles(places, stream.places[of])
                    self._judge_lateness(bus, row, stream.stamps[of], begins[number], number)
                    self._judge_order(bus, row, stream.stamps[of], steps[of], number + bus.count, begins)
            if len(stamps):
                bus.count += len(stamps)
                bus.stamp = int(stamps[-1])

    def _judge_lateness(
        self, bus: _Bus, row: int, stamps: npt.NDArray[np.int64], begins: npt.NDArray[np.int64], number: Places
    ) -> None:
        """Within the cycle; what comes even later is in the next cycle, see `_judge_order`."""
        after = stamps - begins
        late = (after > self._deadline * bus.cycle_ns) & (after < bus.cycle_ns)
        if not bus.count:
            late &= number > 0
        if bool(late.any()):
            self._report("state-late", row, stamps[late], after[late])

    def _judge_order(
        self,
        bus: _Bus,
        row: int,
        stamps: npt.NDArray[np.int64],
        steps: Steps,
        cycles: Places,
        begins: npt.NDArray[np.int64],
    ) -> None:
        """Two states in one cycle and none in the next: the second came before its SYNC. None, then two: the first was late.

        A SYNC that is missing from the log makes two in one cycle as well, but then the cycle after it has its one.
        """
        first = bus.cycle_of.get(row)
        jumps = np.diff(cycles, prepend=cycles[0] - 1 if first is None else first)
        before = np.concatenate([[bus.jump_of.get(row, 1)], jumps[:-1]])
        if (stamp := bus.doubtful.pop(row, None)) is not None and jumps[0] == 2:
            self._report("sync-order", row, np.array([stamp]), np.zeros(1))
        bus.cycle_of[row], bus.jump_of[row] = int(cycles[-1]), int(jumps[-1])
        second = np.flatnonzero((jumps == 0) & (steps == 1))
        if not len(second):
            return
        late = second[before[second] == 2]
        early = second[before[second] != 2]
        if len(late):
            sync = np.maximum(cycles[late] - bus.count - 1, 0)
            after = stamps[np.maximum(late - 1, 0)] - begins[sync]
            self._report("state-late", row, stamps[np.maximum(late - 1, 0)], after)
        if len(early) and early[-1] == len(stamps) - 1:
            bus.doubtful[row] = int(stamps[-1])
            early = early[:-1]
        early = early[jumps[early + 1] == 2]
        if len(early):
            self._report("sync-order", row, stamps[early], np.zeros(len(early)))

    def _report(self, rule: str, row: int, stamps: npt.NDArray[np.int64], after: npt.NDArray[np.generic]) -> None:
        shown = None if rule == "sync-order" else after.astype(np.float64) * 1e-6
        self._findings.add_rows(rule, np.full(len(stamps), row), stamps, shown=shown)


def _cycles(syncs: Places, states: Places) -> Places:
    """How many SYNCs of the chunk came before each state. Places in the log, shapes (m,) and (n,)."""
    if len(syncs) == len(states) and bool((syncs < states).all()) and bool((states[:-1] < syncs[1:]).all()):
        return np.arange(1, len(states) + 1)
    return np.searchsorted(syncs, states)
