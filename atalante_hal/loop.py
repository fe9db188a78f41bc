"""The 1 kHz loop: the flow of the stack in one screen, on the wall clock or in lock-step."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from atalante_hal.hal import PERIOD, Hal
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.types import Controller, State

#: Late cycles in a row, and longest gap between two cycles [s], that end in HOLD: the drives' own watchdog is as long.
OVERRUNS_TO_HOLD = 3
GAP_TO_HOLD = 5e-3
#: Time [s] the robot may fall behind the monotonic clock within `DRIFT_CYCLES` cycles. More ends in HOLD: every limit and timeout
#: that is counted in cycles would be too long.
DRIFT_TO_HOLD = 5e-3
DRIFT_CYCLES = 50
#: Bins of the histogram of cycle costs, 1 us each.
COST_BINS = 10_000


class Clock(Protocol):
    """When the next cycle begins."""

    def wait(self) -> float:
        """Wait for the next cycle.

        Returns:
            How late it begins [s], against deadlines one period apart; 0 when in time. A cycle that begins more than a period
            late moves its own and all later deadlines by that time.
        """


class LockStep:
    """As fast as it goes: the nodes answer each SYNC, and the next one is sent when they have."""

    def wait(self) -> float:
        """Never waits and is never late."""
        return 0.0


class WallClock:
    """Absolute monotonic deadlines one period apart.

    A cycle that begins up to a period late leaves the deadlines where they are. A later one moves them: a burst of catch-up
    cycles would command old states.
    """

    def __init__(
        self,
        period: float = PERIOD,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period, self._now, self._sleep = period, now, sleep
        self._next = now()

    def wait(self) -> float:
        """Sleep until the deadline; returns how late the cycle begins [s]."""
        self._next += self._period
        now = self._now()
        if now < self._next:
            self._sleep(self._next - now)
            now = self._now()
        late = max(0.0, now - self._next)
        if late > self._period:
            self._next = now
        return late


class Drift:
    """Time by which the robot, which counts cycles, falls behind the clock, over the last `DRIFT_CYCLES` cycles."""

    def __init__(self) -> None:
        self._lost = 0.0
        self._behind = deque([0.0] * DRIFT_CYCLES, maxlen=DRIFT_CYCLES)

    def add(self, late: float) -> float:
        """Add a cycle.

        Args:
            late: how late it begins [s], as `Clock.wait` returns it. A gap of more than `GAP_TO_HOLD` does not count: it is a
                diagnostic by itself.

        Returns:
            Time lost within the window [s].
        """
        if PERIOD < late <= GAP_TO_HOLD:
            self._lost += late
        behind = self._lost + (late if late <= PERIOD else 0.0)
        drift = behind - self._behind[0]
        self._behind.append(behind)
        return drift


@dataclass
class Statistics:
    """Timing of a run. Costs are of the whole cycle without the wait, with the emulator's share on an embedded bus."""

    cycles: int = 0
    overruns: int = 0  # cycles that began more than a period late
    lateness_max: float = 0.0  # s
    wall: float = 0.0  # s, first to last cycle
    #: Cycles that cost 0, 1, 2, ... us; the last entry counts all longer ones. Bounded, so that a run may last for days.
    costs: list[int] = field(default_factory=lambda: [0] * (COST_BINS + 1))

    @property
    def real_time_factor(self) -> float:
        """Simulated over elapsed time; 1 on the wall clock."""
        return self.cycles * PERIOD / self.wall if self.wall else 0.0

    def cost(self, percentile: float) -> float:
        """Return the cycle cost [s] that `percentile` percent of the cycles did not exceed, to 1 us; 10 ms stands for more."""
        total = np.cumsum(self.costs)
        return float(np.searchsorted(total, max(1.0, total[-1] * percentile / 100.0))) * 1e-6 if total[-1] else 0.0


def run(
    hal: Hal,
    controller: Controller,
    clock: Clock,
    *,
    until: Callable[[State], bool],
    record: Callable[[], None] = lambda: None,
) -> Statistics:
    """Run the controller on the robot until `until(state)` says so, then leave the robot in HOLD.

    Args:
        until: asked once a cycle, after the command was sent.
        record: called once a cycle with `hal.record` complete, e.g. a ring's `write`.

    Raises:
        ValueError: the HAL was made for other `controller_fields` than the controller's.
    """
    statistics = Statistics()
    costs, header = statistics.costs, hal.record
    late_in_row, drift = 0, Drift()
    active = False
    controller_record, telemetry = hal.controller_record, controller.telemetry
    if len(telemetry) != len(controller_record):
        raise ValueError(
            f"the controller's telemetry is {len(telemetry)} numbers and the HAL was made to record {len(controller_record)}: "
            "give it `controller_fields=controller.telemetry_fields`"
        )
    # What lives now lives as long as the run: the collector need not look at it again and again. Who froze it before keeps it so.
    frozen = gc.get_freeze_count() > 0
    if not frozen:
        gc.collect()
        gc.freeze()
    start = time.perf_counter()
    try:
        while True:
            late = clock.wait()
            begun = time.perf_counter()
            lost = drift.add(late)
            if late:
                late_in_row = _judge_lateness(hal, statistics, late, late_in_row, lost)
            state = hal.read()
            if hal.moving:
                try:
                    if not active:
                        controller.reset(state)
                    hal.write(controller.update(state))
                    controller_record[:] = telemetry
                except Exception as error:  # noqa: BLE001 - whatever a controller raises or asks for, the robot holds
                    hal.fail(error)
                active = True
            else:
                hal.hold()
                active = False
            cost = time.perf_counter() - begun
            costs[min(int(cost * 1e6), COST_BINS)] += 1
            statistics.cycles += 1
            header[4], header[5], header[6] = cost * 1e6, late * 1e6, statistics.overruns
            record()
            if until(state):
                break
    finally:
        statistics.wall = time.perf_counter() - start
        if not frozen:
            gc.unfreeze()
        hal.stop()
    return statistics


def _judge_lateness(hal: Hal, statistics: Statistics, late: float, in_row: int, drift: float) -> int:
    """Report a late cycle and a loop that falls behind; returns the number of late cycles in a row."""
    statistics.lateness_max = max(statistics.lateness_max, late)
    if drift > DRIFT_TO_HOLD:
        slow = f"the loop lost {drift * 1e3:.1f} ms within {DRIFT_CYCLES} cycles"
        hal.report(Dtc.OVERRUN, slow, value=drift)
    if late <= PERIOD:
        return 0
    in_row += 1
    statistics.overruns += 1
    gap = f"{late * 1e3:.1f} ms went by without a cycle"
    hal.report(Dtc.CYCLE_GAP, gap, confirmed=late > GAP_TO_HOLD, value=late)
    if drift <= DRIFT_TO_HOLD:
        many = f"{in_row} cycles in a row were more than {PERIOD * 1e3:.0f} ms late"
        hal.report(Dtc.OVERRUN, many, confirmed=in_row >= OVERRUNS_TO_HOLD, value=in_row)
    return in_row


def realtime(priority: int = 50) -> list[str]:
    """Ask for a quiet process: SCHED_FIFO and locked memory.

    Returns:
        One sentence for each wish the system refused, with what to type.
    """
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        refused.append(
            f"no real-time priority: run as root, or `ulimit -r {priority}` allowed by /etc/security/limits.conf"
        )
    lock_current_and_future = 3  # MCL_CURRENT | MCL_FUTURE
    if ctypes.CDLL(None, use_errno=True).mlockall(lock_current_and_future) != 0:
        refused.append("memory is not locked: run as root, or allow `ulimit -l unlimited`")
    return refused
