"""Rules for the order of frames in a cycle: first SYNC, then the states of all nodes of the bus before a deadline."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from atalante_tools.canlog.plan import UNKNOWN, Plan
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.e2e_rules import Steps
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project

Indices = npt.NDArray[np.intp]

#: Name prefix of the messages that start the cycle of a bus.
SYNC = "SYNC"


@dataclass
class _Bus:
    """Bus with a SYNC message, and the state of the order check after the last chunk."""

    sync: int  # row of the SYNC message
    states: list[int]  # rows of the state messages
    cycle_ns: float
    count: int = 0  # SYNC frames so far
    stamp: int = 0  # time stamp of the last SYNC frame [ns]
    cycle_of: dict[int, int] = field(default_factory=dict)  # SYNC cycle of the last state frame, by row
    jump_of: dict[int, int] = field(default_factory=dict)  # SYNC cycles between the last two states, by row
    doubtful: dict[int, int] = field(
        default_factory=dict
    )  # time stamp of a second state frame in one cycle, if the next cycle is not known yet [ns], by row


class OrderRules:
    """Rules that check whether each state frame comes in the right SYNC cycle, and soon enough after its SYNC frame."""

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
    def checked(self) -> set[int]:
        """Return the rows of the messages that the order rules check."""
        return {row for bus in self.buses for row in (bus.sync, *bus.states)}

    def check(self, stream: Stream, steps: Steps) -> None:
        """Check the order of SYNC and state frames in a chunk.

        Args:
            stream: frames of the chunk by message, shape (n,).
            steps: increments of the alive counters, shape (n,).
        """
        for bus in self.buses:
            span = stream.of(bus.sync)
            indices, stamps = stream.indices[span], stream.stamps[span]
            begins = np.concatenate([[bus.stamp], stamps])
            for row in bus.states:
                of = stream.of(row)
                if of.start != of.stop:
                    number = _cycles(indices, stream.indices[of])
                    self._check_lateness(bus, row, stream.stamps[of], begins[number], number)
                    self._check_order(bus, row, stream.stamps[of], steps[of], number + bus.count, begins)
            if len(stamps):
                bus.count += len(stamps)
                bus.stamp = int(stamps[-1])

    def _check_lateness(
        self, bus: _Bus, row: int, stamps: npt.NDArray[np.int64], begins: npt.NDArray[np.int64], number: Indices
    ) -> None:
        """Report the state frames that were received after the deadline of their cycle, but before the next SYNC.

        `_check_order` reports the state frames that were received after the next SYNC.
        """
        after = stamps - begins
        late = (after > self._deadline * bus.cycle_ns) & (after < bus.cycle_ns)
        if not bus.count:
            late &= number > 0
        if bool(late.any()):
            self._report("state-late", row, stamps[late], after[late])

    def _check_order(
        self,
        bus: _Bus,
        row: int,
        stamps: npt.NDArray[np.int64],
        steps: Steps,
        cycles: Indices,
        begins: npt.NDArray[np.int64],
    ) -> None:
        """Report the state frames that were received in the wrong cycle.

        If a cycle has two states and the next cycle has none, the second state was received before its SYNC. If a cycle has no
        state and the next cycle has two, the first state was late. A SYNC that is missing in the log also gives two states in
        one cycle, but then the next cycle has one state.

        Args:
            bus: bus of the state message.
            row: row of the state message.
            stamps: time stamp of each state [ns], shape (n,).
            steps: increment of the alive counter of each state, shape (n,).
            cycles: number of the cycle of each state, shape (n,).
            begins: time stamps of the last SYNC before the chunk and of each SYNC in the chunk [ns], shape (m + 1,).
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


def _cycles(syncs: Indices, states: Indices) -> Indices:
    """Return the number of SYNC frames before each state frame, shape (n,).

    Args:
        syncs: indices of the SYNC frames in the chunk, ascending, shape (m,).
        states: indices of the state frames in the chunk, ascending, shape (n,).
    """
    if len(syncs) == len(states) and bool((syncs < states).all()) and bool((states[:-1] < syncs[1:]).all()):
        return np.arange(1, len(states) + 1)
    return np.searchsorted(syncs, states)
