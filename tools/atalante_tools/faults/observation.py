"""Record of one run: states and events of the HAL, commands on the wire, and true values of the drives and the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import Robot
from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState
from atalante_tools.faults.command_check import Commands

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """Record of one run. Arrays have one row per HAL cycle; the first row is cycle 1. All cycles are HAL cycles."""

    network: Network
    robot: Robot
    first: int  # first faulty cycle
    over: int | None  # first cycle after all faults and actions; None if one is permanent
    pressed: int | None  # cycle of the operator's START after the fault; None if the run ended before
    states: tuple[SupervisorState, ...]  # state of each cycle
    events: tuple[Event, ...]  # events of the HAL
    commands: Commands  # commands on the wire
    drive_state: Vector  # (cycles, 12) `DriveState`, true state of the drives
    torque: Vector  # (cycles, 12) Nm, of the motors
    position: Vector  # (cycles, 12) rad, of the body
    velocity: Vector  # (cycles, 12) rad/s
    temperature: Vector  # (cycles, 12) degC, as reported
    age: npt.NDArray[np.int64]  # (cycles, messages) age of the HAL's data [cycles]
    guide_exit: Vector  # (cycles,) rad by which the worse assisted joint was outside its guide
    messages: tuple[str, ...]  # columns of `age`

    def state(self, cycle: int) -> SupervisorState:
        """Return the state of a cycle.

        Args:
            cycle: HAL cycle, from 1.
        """
        return self.states[cycle - 1]

    @property
    def quiet(self) -> int:
        """Last cycle before the operator's START after the fault."""
        return (self.pressed or self.last + 1) - 1

    @property
    def last(self) -> int:
        """Last cycle of the run."""
        return len(self.states)

    def latency(self, cycle: int) -> int:
        """Return the number of cycles from the first faulty cycle to a cycle, both included.

        Args:
            cycle: HAL cycle.
        """
        return cycle - self.first + 1

    def codes(self) -> list[str]:
        """Return the codes of the events since the fault began."""
        return [event.code for event in self.events if event.cycle >= self.first]
