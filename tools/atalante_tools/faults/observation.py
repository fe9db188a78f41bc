"""Record of one run: states and events of the HAL, sent commands, and true values of the emulated robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_hal.robot import Robot
from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState, Vector
from atalante_tools.faults.command_check import Commands

#: Number of consecutive cycles in ACTIVE after which the walk counts as restarted. They last 0.8 s, one whole step.
RESTARTED: Final = 800


def restarted(states: Sequence[SupervisorState]) -> bool:
    """Return whether the last `RESTARTED` cycles were all in ACTIVE.

    Args:
        states: state of the HAL in each cycle.
    """
    return len(states) >= RESTARTED and set(states[-RESTARTED:]) == {SupervisorState.ACTIVE}


@dataclass(frozen=True)
class Observation:
    """Record of one run. The first HAL cycle of a run has the number 1. Row k of an array belongs to cycle k + 1."""

    network: Network
    robot: Robot
    first: int  # first faulty cycle
    over: int | None  # first cycle after the end of all faults and operator actions; None if a fault is permanent
    pressed: int | None  # cycle of the operator's START after the fault; None if there is no START
    states: tuple[SupervisorState, ...]  # state of each cycle
    events: tuple[Event, ...]  # events of the HAL
    commands: Commands  # commands that the HAL sent
    drive_state: Vector  # true `DriveState` of the drives, shape (cycles, 12)
    torque: Vector  # true torque of the motors [Nm], shape (cycles, 12)
    position: Vector  # true joint angles [rad], shape (cycles, 12)
    velocity: Vector  # true joint velocities [rad/s], shape (cycles, 12)
    temperature: Vector  # reported temperature of the drives [degC], shape (cycles, 12)
    age: npt.NDArray[np.int64]  # data age of each message in the HAL [cycles], shape (cycles, messages)
    #: largest distance by which an assisted joint is outside its guide [rad], shape (cycles,). A negative value means that all
    #: assisted joints are inside their guides.
    guide_exit: Vector
    messages: tuple[str, ...]  # name of the message in each column of `age`

    def state(self, cycle: int) -> SupervisorState:
        """Return the state of the HAL in a cycle.

        Args:
            cycle: HAL cycle, from 1.
        """
        return self.states[cycle - 1]

    @property
    def last_before_start(self) -> int:
        """Return the last cycle before the START that follows the fault.

        If START is not pressed after the fault, return the last cycle of the run.
        """
        return (self.pressed or self.last + 1) - 1

    @property
    def last(self) -> int:
        """Return the last cycle of the run."""
        return len(self.states)

    def latency(self, cycle: int) -> int:
        """Return the number of cycles from the first faulty cycle to the given cycle, including these two cycles.

        Args:
            cycle: HAL cycle.
        """
        return cycle - self.first + 1

    def codes(self) -> list[str]:
        """Return the diagnostic codes of the events since the first faulty cycle."""
        return [event.code for event in self.events if event.cycle >= self.first]
