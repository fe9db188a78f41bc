"""Data types of fault scenarios: faults and operator actions with their timing, and the expected reaction of the HAL.

    row of the matrix -> scenario: its cases -> runner -> observation -> verdict

If a case does not define the expected state, the diagnostic code or a time limit, its row of the fault matrix gives the
value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import atalante_dbc
from atalante_emulator.faults import Fault
from atalante_hal.types import SupervisorState
from atalante_tools.console.options import PYBULLET

if TYPE_CHECKING:
    from atalante_tools.faults.observation import Observation

#: Default start of a case, as phase of the first walking step (0 to 1). The left leg swings fastest at this phase.
MID_SWING: Final = 0.35


@dataclass(frozen=True)
class HostFault:
    """Fault of the computer that runs the HAL.

    Kinds of faults:

    - `late`: the cycle begins `value` seconds late.
    - `slow`: each cycle takes `value` seconds instead of 1 ms.
    - `raise`, `raise_in_reset`: the controller raises the builtin exception named `value`.
    - `request`: the controller requests `value` Nm on every joint.
    - `full_torque`: the controller requests 1000 Nm on the joint named `value`, or -1000 Nm if the name starts with a minus sign.
    - `shake`: the controller adds a torque on the left hip that alternates between `value` Nm and -`value` Nm.
    - `shape`: the controller returns an array with `value` torques instead of one torque per joint.
    - `bus_down`, `bus_full`: the bus raises an error when the HAL sends frames.
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


def invalid_code(message: str, signal: str) -> int:
    """Return the unsigned raw code that a node sends when a signal has no value.

    The DBC defines this code.

    Args:
        message: name of the message.
        signal: name of a signal with such a code.
    """
    code = atalante_dbc.load().message(message).signal(signal).invalid_raw
    assert code is not None
    return code


def shifted(stimulus: Stimulus, cycles: int) -> Stimulus:
    """Return the same fault or action with a later start.

    Args:
        stimulus: fault or action.
        cycles: delay of the start [cycles].
    """
    start = stimulus.start + cycles
    return stimulus.starting(start) if isinstance(stimulus, Fault) else replace(stimulus, start=start)


#: Additional check of a run. The check returns None if it passes, and a sentence if it fails.
ObservationCheck = Callable[["Observation"], str | None]


@dataclass(frozen=True)
class Case:
    """Test case of a scenario: faults, operator actions and expected reaction of one run."""

    name: str  # unique name in the scenario
    stimuli: tuple[Stimulus, ...]  # faults and operator actions; `start` counts from the start of the case
    #: start of the case, as phase of the first walking step (0 to 1); None means power-on
    phase: float | None = MID_SWING
    first_faulty: int = 0  # first faulty cycle, counted from the start of the case
    state: SupervisorState | None = None  # expected final state of the HAL; None means as in the fault matrix
    dtc: str | None = None  # expected diagnostic code; "" means no code, None means as in the fault matrix
    detected: int | None = None  # time limit for the diagnostic [cycles]; None means as in the fault matrix
    reacted: int | None = None  # time limit for the reaction [cycles]; None means as in the fault matrix
    node: str | None = None  # node that the diagnostic must name; None means any node
    recovers: bool = True  # True: START after the fault must lead to ACTIVE; False: START must not lead to ACTIVE
    #: wait before START is pressed [cycles]. The wait begins when all faults have ended and the time limit `reacted` has passed.
    #: In a case with a permanent fault, the wait begins when the time limit `reacted` has passed.
    observed: int = 60
    seed: int = 0  # seed of the random numbers in the emulator
    checks: tuple[ObservationCheck, ...] = ()  # additional checks of the run
    engine: str = PYBULLET  # physics engine of the emulated robot
    #: True: run the case only with a suspended robot, because the case replaces the measured foot forces
    suspended: bool = False

    @property
    def ends(self) -> int | None:
        """Return the first cycle after all faults and actions, or None if a fault or an action is permanent.

        The cycle counts from the start of the case.
        """
        ends = [None if one.cycles is None else one.start + one.cycles for one in self.stimuli]
        return None if None in ends else max((end for end in ends if end is not None), default=0)


@dataclass(frozen=True)
class Scenario:
    """All test cases of one fault, which is one row of the fault matrix."""

    id: str
    cases: tuple[Case, ...]
    #: Case with a permanent fault. The endurance run shortens the fault until the walk continues. None means no endurance run.
    permanent: Case | None = None
