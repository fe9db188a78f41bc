"""Scenarios as data: faults and operator actions with their timing, and the expected reaction.

    row of the matrix -> scenario: its cases -> runner -> observation -> verdict

State, code and bounds that a case does not define are taken from its row of the matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from atalante_emulator.faults import Fault
from atalante_hal.types import SupervisorState

if TYPE_CHECKING:
    from atalante_tools.faults.observation import Observation

#: Default start of a case, as phase of the first walking step (0 to 1). At this phase, the left leg swings fastest.
MID_SWING: Final = 0.35


@dataclass(frozen=True)
class HostFault:
    """Fault of the computer that runs the HAL.

    Kinds of faults:

    - `late`: the cycle begins `value` seconds late.
    - `slow`: each cycle takes `value` seconds instead of its period.
    - `raise`, `raise_in_reset`: the controller raises the builtin exception named `value`.
    - `request`: the controller requests `value` Nm on every joint.
    - `shake`: the controller adds a torque on the left hip that alternates between `value` Nm and -`value` Nm.
    - `shape`: the controller requests an array of `value` torques.
    - `bus_down`, `bus_full`: the bus of the HAL raises an error when it sends.
    """

    kind: str
    start: int = 0
    cycles: int | None = 1
    value: float | str = 0.0


@dataclass(frozen=True)
class OperatorAction:
    """Action of the operator: `kind` is a method of `atalante_emulator.pendant.Operator`, such as stop or release."""

    kind: str
    start: int = 0
    cycles: int | None = 1


Stimulus = Fault | HostFault | OperatorAction
#: Additional check of a run. It returns None if it passes, and a sentence if it fails.
ObservationCheck = Callable[["Observation"], str | None]


@dataclass(frozen=True)
class Case:
    """Case of a scenario: stimuli and expected reaction of one run."""

    name: str  # unique name in the scenario
    stimuli: tuple[Stimulus, ...]  # faults and operator actions; `start` counts from the start of the case
    phase: float | None = MID_SWING  # start of the case, as phase of the first walking step (0 to 1); None: power-on
    first_faulty: int = 0  # first faulty cycle, counted from the start of the case
    state: SupervisorState | None = None  # expected final state; None: as in the matrix
    dtc: str | None = None  # expected diagnostic code; "": no code; None: as in the matrix
    detected: int | None = None  # time limit for the diagnostic [cycles]; None: as in the matrix
    reacted: int | None = None  # time limit for the reaction [cycles]; None: as in the matrix
    node: str | None = None  # node that the diagnostic must name; None: any node
    recovers: bool = True  # True: START after the fault must lead to ACTIVE; False: it must not
    observed: int = 60  # cycles from the end of the fault (of a permanent fault: from its reaction limit) to START
    seed: int = 0  # seed of the random numbers in the emulator
    checks: tuple[ObservationCheck, ...] = ()  # additional checks of the run

    @property
    def ends(self) -> int | None:
        """Return the first cycle after all stimuli, counted from the start of the case. None if a stimulus is permanent."""
        ends = [None if one.cycles is None else one.start + one.cycles for one in self.stimuli]
        return None if None in ends else max((end for end in ends if end is not None), default=0)


@dataclass(frozen=True)
class Scenario:
    """All cases that prove one row of the matrix."""

    id: str
    cases: tuple[Case, ...]
    #: Case with a permanent fault, for the endurance run; None: no endurance run.
    permanent: Case | None = None
