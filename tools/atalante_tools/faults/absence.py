"""Clock of the HAL loop. While the loop is late or sends no SYNC, the clock keeps the emulated robot running.

In lock-step, the emulated robot runs one cycle per SYNC. Without this clock, the robot would stand still while a fault of the
host suppresses the SYNC or delays the loop, and a robot on the ground would not fall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from atalante_emulator.drive import WATCHDOG
from atalante_hal.types import PERIOD

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator
    from atalante_tools.faults.disturbed import DisturbedClock


class Absence:
    """Clock of the HAL loop. While the loop is late or sends no SYNC, this clock keeps the emulated robot running."""

    def __init__(self, clock: DisturbedClock, emulator: Emulator) -> None:
        """Start the cycle counts of HAL and robot at 0.

        Args:
            clock: clock that injects the delays of the loop.
            emulator: emulated robot.
        """
        self._clock, self._emulator = clock, emulator
        self._begun = 0  # number of HAL cycles that have begun
        # Time by which the deadlines of the HAL cycles have moved [s].
        # A cycle that is late by more than one period moves all later deadlines by its whole delay.
        # A cycle that is late by one period or less moves no deadline.
        self._skipped = 0.0
        self._seen = 0  # cycle number of the robot at the end of the last call of `wait`
        self._alone = 0  # number of robot cycles since the last SYNC

    def wait(self) -> float:
        """Advance the robot to the start of the current HAL cycle. Return the delay [s] of this HAL cycle."""
        late = self._clock.wait()
        if self._emulator.cycle > self._seen:
            self._alone = 0
        # Add 1 ns, because rounding may put the sum of the delays just below a whole number of periods.
        due = self._begun + int((self._skipped + late + 1e-9) / PERIOD)
        while self._emulator.cycle < due:
            if self._alone < WATCHDOG:
                self._emulator.run_without_sync()
            else:
                self._emulator.idle()
            self._alone += 1
        if late > PERIOD:
            self._skipped += late
        self._begun += 1
        self._seen = self._emulator.cycle
        return late
