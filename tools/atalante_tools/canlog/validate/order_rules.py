"""Rules for the order of frames in a cycle: first SYNC, then the state frames of all nodes before a deadline."""

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

#: Name prefix of the messages that start a cycle on a bus.
SYNC = "SYNC"


@dataclass
class _Bus:
    """Bus with a SYNC message. The last SYNC frame and the last state frames are stored for the check of the next chunk."""

    sync: int  # message index (position in the arrays of `Plan`) of the SYNC message
    states: list[int]  # message indices (positions in the arrays of `Plan`) of the state messages on the bus
    cycle_ns: float
    count: int = 0  # number of SYNC frames so far
    stamp: int = 0  # time stamp of the last SYNC frame [ns]
    #: Message index of a state message -> number of SYNC frames in the log before the last frame of this message.
    cycle_of: dict[int, int] = field(default_factory=dict)
    #: Message index of a state message -> number of SYNC frames between the last two frames of this message.
    jump_of: dict[int, int] = field(default_factory=dict)
    #: Message index of a state message -> time stamp [ns] of a state frame that perhaps came before the SYNC it answers.
    #: Only the next chunk shows whether the state frame came too early (see `_check_order`).
    doubtful: dict[int, int] = field(default_factory=dict)


class OrderRules:
    """Rules that check whether each state frame arrives in the right cycle, and early enough after the SYNC frame."""

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
        """Return the plan indices of the messages that the order rules check."""
        return {row for bus in self.buses for row in (bus.sync, *bus.states)}

    def check(self, stream: Stream, steps: Steps) -> None:
        """Check the order of SYNC and state frames in a chunk.

        Args:
            stream: frames of the chunk, sorted by message, shape (n,).
            steps: increment of the alive counter at each frame, shape (n,).
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
        """Report the state frames that were received late in their cycle.

        A state frame is late if it was received after the deadline, but less than one cycle time after the SYNC.
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

        The rule counts the state frames of one node per cycle. If a cycle with two frames precedes a cycle without a frame,
        the second frame was received before its SYNC. If a cycle without a frame precedes a cycle with two frames, the
        first of the two frames was late. If a SYNC is missing in the log, a cycle also has two state frames, but then the
        previous and the next cycle have one state frame each, and nothing is reported.

        The second frame of a cycle may be the last frame of its message in the chunk. Only the next chunk then shows whether
        the next cycle has no frame. Until then, `bus.doubtful` stores the time stamp of the second frame.

        Args:
            bus: bus of the state message.
            row: index of the state message in the plan.
            stamps: time stamp of each state frame [ns], shape (n,).
            steps: increment of the alive counter at each state frame, shape (n,).
            cycles: number of the cycle in which each state frame was received, shape (n,).
            begins: time stamp of the last SYNC before the chunk, then time stamps of all SYNCs in the chunk [ns], shape
                (m + 1,).
        """
        first = bus.cycle_of.get(row)
        jumps = cycles.copy()
        jumps[1:] -= cycles[:-1]
        jumps[0] = 1 if first is None else cycles[0] - first
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
    """Return, for each state frame, the number of earlier SYNC frames in the same chunk, shape (n,).

    Args:
        syncs: indices of the SYNC frames in the chunk, ascending, shape (m,).
        states: indices of the state frames in the chunk, ascending, shape (n,).
    """
    if len(syncs) == len(states) and bool((syncs < states).all()) and bool((states[:-1] < syncs[1:]).all()):
        return np.arange(1, len(states) + 1)
    return np.searchsorted(syncs, states)
