"""Clock `Absence`: the emulated robot moves on while the HAL sends nothing or is late."""

from __future__ import annotations

from typing import Any, cast

import pytest

from atalante_emulator.drive import WATCHDOG
from atalante_tools.faults.absence import Absence


class Robot:
    """Emulated robot that counts its cycles with and without SYNC."""

    def __init__(self) -> None:
        self.cycle = self.without_sync = self.local_hold = 0

    def run_without_sync(self) -> None:
        self.cycle, self.without_sync = self.cycle + 1, self.without_sync + 1

    def idle(self) -> None:
        self.cycle, self.local_hold = self.cycle + 1, self.local_hold + 1


class Clock:
    """Clock with given delays of the cycles [s]."""

    def __init__(self, delays: list[float]) -> None:
        self.delays = iter(delays)

    def wait(self) -> float:
        return next(self.delays)


def moved(delays: list[float], synced: list[bool]) -> Robot:
    """Return the robot after HAL cycles with these delays; the HAL sends a SYNC in some of them."""
    robot = Robot()
    clock = Absence(cast(Any, Clock(delays)), cast(Any, robot))
    for delay, sync in zip(delays, synced, strict=True):
        assert clock.wait() == delay
        robot.cycle += sync
    return robot


def test_robot_with_a_sync_in_each_cycle_has_no_further_cycles() -> None:
    robot = moved([0.0] * 20, [True] * 20)
    assert (robot.cycle, robot.without_sync, robot.local_hold) == (20, 0, 0)


def test_robot_moves_on_without_sync_and_holds_after_the_watchdog() -> None:
    robot = moved([0.0] * 21, [True] * 10 + [False] * 10 + [True])
    assert (robot.cycle, robot.without_sync, robot.local_hold) == (21, WATCHDOG, 10 - WATCHDOG)


def test_watchdog_starts_again_after_a_sync() -> None:
    lost = [False] * (WATCHDOG - 1)
    robot = moved([0.0] * (3 + 2 * len(lost)), [True, *lost, True, *lost, True])
    assert (robot.without_sync, robot.local_hold) == (2 * len(lost), 0)


@pytest.mark.parametrize(("delays", "cycles"), [([2.0], 2000), ([4e-3], 4), ([0.9e-3], 0), ([1.5e-3] * 3, 4)])
def test_robot_moves_during_a_delay_of_the_loop(delays: list[float], cycles: int) -> None:
    count = len(delays) + 2
    robot = moved([0.0, *delays, 0.0], [True] * count)
    assert robot.without_sync + robot.local_hold == cycles
    assert robot.cycle == count + cycles
