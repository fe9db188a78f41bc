"""The 1 kHz loop: the flow of the stack in one screen, on the wall clock or in lock-step."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from atalante_hal.diagnostics import Dtc
from atalante_hal.hal import PERIOD, Hal
from atalante_hal.types import Controller, State

#: Late cycles in a row, and longest gap between two cycles [s], that end in HOLD: the drives' own watchdog is as long.
OVERRUNS_TO_HOLD = 3
GAP_TO_HOLD = 5e-3


class Clock(Protocol):
    """When the next cycle begins."""

    def wait(self) -> float:
        """Wait for the next cycle; returns how late it is [s], 0 when in time."""


class LockStep:
    """As fast as it goes: the nodes answer each SYNC, and the next one is sent when they have."""

    def wait(self) -> float:
        """Never waits and is never late."""
        return 0.0


class WallClock:
    """Absolute monotonic deadlines one period apart; a missed one is not made up for.

    After a late cycle the deadlines move on from now: a burst of catch-up cycles would command old states.
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
        """Sleep until the deadline; returns how late the wake-up was [s]."""
        self._next += self._period
        now = self._now()
        if now < self._next:
            self._sleep(self._next - now)
            now = self._now()
            if now <= self._next + self._period:
                return max(0.0, now - self._next)
        late = now - self._next
        self._next = now
        return late


@dataclass
class Statistics:
    """Timing of a run. Costs are of the whole cycle without the wait, with the emulator's share on an embedded bus."""

    cycles: int = 0
    overruns: int = 0  # cycles that began more than a period late
    lateness_max: float = 0.0  # s
    wall: float = 0.0  # s, first to last cycle
    costs: list[float] = field(default_factory=list)  # s, of every cycle

    @property
    def real_time_factor(self) -> float:
        """Simulated over elapsed time; 1 on the wall clock."""
        return self.cycles * PERIOD / self.wall if self.wall else 0.0

    def cost(self, percentile: float) -> float:
        """Percentile of the cycle cost [s]."""
        return float(np.percentile(self.costs, percentile)) if self.costs else 0.0


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
    late_in_row = 0
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
            if late:
                late_in_row = _judge_lateness(hal, statistics, late, late_in_row)
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
            costs.append(cost)
            header[4], header[5], header[6] = cost * 1e6, late * 1e6, statistics.overruns
            record()
            if until(state):
                break
    finally:
        statistics.cycles = len(costs)
        statistics.wall = time.perf_counter() - start
        if not frozen:
            gc.unfreeze()
        hal.stop()
    return statistics


def _judge_lateness(hal: Hal, statistics: Statistics, late: float, in_row: int) -> int:
    statistics.lateness_max = max(statistics.lateness_max, late)
    if late <= PERIOD:
        return 0
    in_row += 1
    statistics.overruns += 1
    gap = f"{late * 1e3:.1f} ms went by without a cycle"
    hal.report(Dtc.CYCLE_GAP, gap, confirmed=late > GAP_TO_HOLD, value=late)
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
