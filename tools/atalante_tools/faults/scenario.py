"""Scenarios as data: faults of a walking robot, their timing and the expected reaction.

    row of the matrix -> scenario: its cases -> runner -> observation -> verdict

State, code and bounds that a case leaves open are those of its row of the matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from atalante_emulator.faults import Fault
from atalante_hal.types import SupervisorState

if TYPE_CHECKING:
    from atalante_tools.faults.observation import Observation

#: Default phase of the first right-stance step at which faults begin: the swing leg is at its fastest.
MID_SWING: Final = 0.35


@dataclass(frozen=True)
class Host:
    """Fault of the computer that runs the HAL; times are in HAL cycles.

    Kinds of faults:

    - `late`: the cycle begins `value` seconds late.
    - `slow`: each cycle takes `value` seconds instead of its period.
    - `raise`, `raise_in_reset`: the controller raises the builtin exception named `value`.
    - `ask`: the controller requests `value` Nm on every joint.
    - `shake`: the controller alternates between `value` Nm more and `value` Nm less on the left hip.
    - `shape`: the controller requests an array of `value` torques.
    - `bus_down`, `bus_full`: the HAL's end of the bus raises an error on sending.
    """

    kind: str
    start: int = 0
    cycles: int | None = 1
    value: float | str = 0.0


@dataclass(frozen=True)
class Press:
    """Action of the operator in one cycle: a method of `atalante_emulator.pendant.Operator`, such as stop or release."""

    kind: str
    start: int = 0
    cycles: int | None = 1


Happening = Fault | Host | Press
#: Additional check of a run; returns one sentence if it fails, else None.
ObservationCheck = Callable[["Observation"], str | None]


@dataclass(frozen=True)
class Case:
    """One run of a scenario."""

    name: str  # name within the scenario
    happens: tuple[Happening, ...]  # faults and actions; `start` counts from the moment of the case
    phase: float | None = MID_SWING  # moment of the case, as phase of the first step; None: at power-on
    begins: int = 0  # first faulty cycle, counted from the moment of the case
    state: SupervisorState | None = None  # expected state; here and in the next three, None means the value of the row
    dtc: str | None = None  # expected diagnostic code; "" for none
    noticed: int | None = None  # bound of the diagnostic [cycles]
    reacted: int | None = None  # bound of the reaction [cycles]
    node: str | None = None  # node that the diagnostic must name; None: any
    recovers: bool = True  # whether the operator's START after the fault must lead to ACTIVE
    watched: int = 60  # cycles observed after the end of the fault, or after the bound of a permanent fault
    seed: int = 0  # seed of the emulator
    checks: tuple[ObservationCheck, ...] = ()  # additional checks

    @property
    def ends(self) -> int | None:
        """First cycle after all faults and actions, counted from the moment of the case; None if one is permanent."""
        ends = [None if one.cycles is None else one.start + one.cycles for one in self.happens]
        return None if None in ends else max((end for end in ends if end is not None), default=0)


@dataclass(frozen=True)
class Scenario:
    """Cases that prove one row of the matrix."""

    id: str
    cases: tuple[Case, ...]
    #: Permanent fault for the endurance run, which measures how long the walk survives it; None: no endurance run.
    lasting: Case | None = None
