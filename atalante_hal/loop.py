"""Control loop at 1 kHz, on the wall clock or in lock-step: wait, read, update the controller, write, record."""

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

from atalante_hal.hal import Hal
from atalante_hal.record import COST, LATENESS, OVERRUNS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.types import PERIOD, Controller, State

#: Number of consecutive late cycles after which the robot goes to HOLD. A late cycle begins more than one period late.
OVERRUNS_TO_HOLD = 3
#: Lateness of a single cycle above which HOLD follows [s]. The watchdog of the drives has the same timeout.
GAP_TO_HOLD = 5e-3
#: Drift of the loop above which HOLD follows [s]. The drift is the growth of the delay of the loop within `DRIFT_CYCLES` cycles.
DRIFT_TO_HOLD = 5e-3
#: Number of cycles over which the growth of the loop's delay is measured, for the comparison with `DRIFT_TO_HOLD`.
DRIFT_CYCLES = 50
#: Number of bins of the histogram of computing times. Each bin is 1 us wide.
COST_BINS = 10_000


class Clock(Protocol):
    """Timing source of the loop."""

    def wait(self) -> float:
        """Wait for the beginning of the next cycle.

        Returns:
            Lateness of the cycle against its deadline [s]; 0 when it begins in time. Deadlines are one period apart. If a cycle
            is late by more than a period, its deadline and all later deadlines are moved by this lateness.
        """


class LockStep:
    """Clock for lock-step: a cycle begins as soon as the nodes have answered the SYNC of the previous cycle."""

    def wait(self) -> float:
        """Return a lateness of 0 s without waiting."""
        return 0.0


class WallClock:
    """Clock with absolute deadlines, one period apart, on the monotonic clock.

    A cycle that is late by up to one period does not move the deadlines. A cycle that is late by more moves the
    deadlines, because a burst of catch-up cycles would send commands for old states.

    Args:
        period: Time between two deadlines [s].
        now: Function that returns the current time [s].
        sleep: Function that sleeps for a given time [s].
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
        """Sleep until the deadline and return the lateness of the cycle [s]."""
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
    """Drift of the loop: the growth of its delay against the clock within the last `DRIFT_CYCLES` cycles.

    Example: 50 cycles ago, the delay was 2 ms. Now the delay is 6 ms, so the drift is 4 ms.
    """

    def __init__(self) -> None:
        self._lost = 0.0
        self._behind = deque([0.0] * DRIFT_CYCLES, maxlen=DRIFT_CYCLES)

    def add(self, late: float) -> float:
        """Add the lateness of one cycle, and return the drift of the loop [s].

        Args:
            late: Lateness of the cycle [s], as `Clock.wait` returns it. A lateness above `GAP_TO_HOLD` is not added,
                because another diagnostic reports it.

        Returns:
            Delay of the loop now, minus its delay `DRIFT_CYCLES` cycles ago [s].
        """
        if PERIOD < late <= GAP_TO_HOLD:
            self._lost += late
        behind = self._lost + (late if late <= PERIOD else 0.0)
        drift = behind - self._behind[0]
        self._behind.append(behind)
        return drift


@dataclass
class Statistics:
    """Timing statistics of a run.

    The cost of a cycle is its computing time without the wait. On an embedded bus it includes the time of the emulator.
    """

    cycles: int = 0
    overruns: int = 0  # cycles that began more than a period late
    lateness_max: float = 0.0  # s
    wall: float = 0.0  # elapsed time from the first to the last cycle [s]
    #: Histogram: number of cycles with a cost of 0, 1, 2, ... us. The last element counts all longer cycles.
    costs: list[int] = field(default_factory=lambda: [0] * (COST_BINS + 1))

    @property
    def real_time_factor(self) -> float:
        """Return the simulated time divided by the elapsed time. With `WallClock`, the result is about 1."""
        return self.cycles * PERIOD / self.wall if self.wall else 0.0

    def cost(self, percentile: float) -> float:
        """Return a percentile of the cycle costs.

        Args:
            percentile: Share [%] of the cycles whose cost is at most the returned cost, 0 to 100.

        Returns:
            Cost [s] with a resolution of 1 us. A result of 10 ms means 10 ms or more.
        """
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
    """Run the controller on the robot until `until(state)` is true, then bring the robot to HOLD.

    Args:
        hal: Hardware abstraction layer of the robot.
        controller: Controller to run. An exception in it leads to HOLD, not to the end of the loop.
        clock: Timing source, `WallClock` or `LockStep`.
        until: Condition that ends the loop, called once per cycle after the command was sent.
        record: Function called once per cycle when `hal.record` is complete, e.g. `write` of a telemetry ring.

    Returns:
        Timing of the run.

    Raises:
        ValueError: If the HAL was constructed with `controller_fields` that differ from the fields of the controller.
    """
    statistics = Statistics()
    costs, header = statistics.costs, hal.record
    late_in_row, drift = 0, Drift()
    active = False
    controller_record, telemetry = hal.controller_record, controller.telemetry
    if len(telemetry) != len(controller_record):
        raise ValueError(
            f"controller.telemetry must have the length that the HAL records ({len(controller_record)}), got "
            f"{len(telemetry)}: construct the HAL with `controller_fields=controller.telemetry_fields`"
        )
    # All objects created before the run exist until the run ends. `freeze` excludes them from the scans of the garbage collector.
    frozen = gc.get_freeze_count() > 0
    if not frozen:
        gc.collect()
        gc.freeze()
    start = time.perf_counter()
    try:
        while True:
            late = clock.wait()
            began = time.perf_counter()
            lost = drift.add(late)
            late_in_row = _check_lateness(hal, statistics, late, late_in_row, lost) if late else 0
            state = hal.read()
            if hal.moving:
                try:
                    if not active:
                        controller.reset(state)
                    hal.write(controller.update(state))
                    controller_record[:] = telemetry
                except Exception as error:  # noqa: BLE001 - any exception of a controller leads to HOLD
                    hal.fail(error)
                active = True
            else:
                hal.hold()
                active = False
            cost = time.perf_counter() - began
            costs[min(int(cost * 1e6), COST_BINS)] += 1
            statistics.cycles += 1
            header[COST], header[LATENESS], header[OVERRUNS] = cost * 1e6, late * 1e6, statistics.overruns
            record()
            if until(state):
                break
    finally:
        statistics.wall = time.perf_counter() - start
        if not frozen:
            gc.unfreeze()
        hal.stop()
    return statistics


def _check_lateness(hal: Hal, statistics: Statistics, late: float, in_row: int, drift: float) -> int:
    """Report a late cycle or a delayed loop, and return the number of consecutive late cycles."""
    statistics.lateness_max = max(statistics.lateness_max, late)
    if drift > DRIFT_TO_HOLD:
        slow = f"the loop fell behind the clock by {drift * 1e3:.1f} ms within {DRIFT_CYCLES} cycles"
        hal.report(Dtc.OVERRUN, slow, value=drift)
    if late <= PERIOD:
        return 0
    in_row += 1
    statistics.overruns += 1
    gap = f"a cycle began {late * 1e3:.1f} ms late"
    hal.report(Dtc.CYCLE_GAP, gap, confirmed=late > GAP_TO_HOLD, value=late)
    if drift <= DRIFT_TO_HOLD:
        many = f"{in_row} consecutive cycles were more than {PERIOD * 1e3:.0f} ms late"
        hal.report(Dtc.OVERRUN, many, confirmed=in_row >= OVERRUNS_TO_HOLD, value=in_row)
    return in_row


def realtime(priority: int = 50) -> list[str]:
    """Request real-time scheduling (SCHED_FIFO) and locked memory for this process.

    Args:
        priority: SCHED_FIFO priority, 1 to 99.

    Returns:
        One sentence for each refused request, with the remedy; empty if both were granted.
    """
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        refused.append(
            f"real-time priority was refused: run as root, or allow `ulimit -r {priority}` in /etc/security/limits.conf"
        )
    lock_current_and_future = 3  # MCL_CURRENT | MCL_FUTURE
    if ctypes.CDLL(None, use_errno=True).mlockall(lock_current_and_future) != 0:
        refused.append("memory is not locked: run as root, or allow `ulimit -l unlimited` in /etc/security/limits.conf")
    return refused
