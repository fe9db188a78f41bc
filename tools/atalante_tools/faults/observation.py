"""What was seen in one run, from outside: states, events, what left on the wire, and what the drives and the body really did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import Robot
from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState
from atalante_tools.faults.witness import Commands

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """One run. Arrays have a row a cycle of the HAL, the first one is cycle 1.

    Cycles are the HAL's; the operator pressed START for the second time in cycle `pressed`.
    """

    network: Network
    robot: Robot
    first: int  # first faulty cycle
    over: int | None  # first cycle after all that happened; None: something lasts
    pressed: int | None  # None: the run ended before
    states: tuple[SupervisorState, ...]
    events: tuple[Event, ...]
    commands: Commands
    drive_state: Vector  # (cycles, 12) `DriveState` as the drives are, whatever they say
    torque: Vector  # (cycles, 12) Nm, of the motors
    position: Vector  # (cycles, 12) rad, of the body
    velocity: Vector  # (cycles, 12) rad/s
    temperature: Vector  # (cycles, 12) degC, as reported
    age: npt.NDArray[np.int64]  # (cycles, messages) of the HAL's data
    guide_exit: Vector  # (cycles,) rad by which the worse assisted joint was outside its guide
    messages: tuple[str, ...]  # columns of `age`

    def state(self, cycle: int) -> SupervisorState:
        """Of a cycle."""
        return self.states[cycle - 1]

    @property
    def quiet(self) -> int:
        """The last cycle before the operator's second START."""
        return (self.pressed or self.last + 1) - 1

    @property
    def last(self) -> int:
        """The last cycle."""
        return len(self.states)

    def latency(self, cycle: int) -> int:
        """Cycles from the first faulty one, which counts, to this one."""
        return cycle - self.first + 1

    def codes(self) -> list[str]:
        """Of the events since the fault began."""
        return [event.code for event in self.events if event.cycle >= self.first]
