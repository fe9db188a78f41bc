"""A scenario as data: what happens to a walking robot, when, and what has to come of it.

    row of the matrix -> scenario: its cases -> runner -> observation -> verdict

What a case does not say, its row of the matrix does: state, code and bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from atalante_emulator.faults import Fault
from atalante_hal.types import SupervisorState

if TYPE_CHECKING:
    from atalante_tools.faults.observation import Observation

#: Where in the first right-stance step a fault begins unless a case says otherwise: the swing leg is at its fastest.
MID_SWING: Final = 0.35


@dataclass(frozen=True)
class Host:
    """A fault of the computer the HAL runs on, in the HAL's cycles.

    `late`: the cycle begins `value` seconds late. `slow`: each cycle takes `value` seconds instead of its period.
    `raise`, `raise_in_reset`: the controller raises the builtin exception `value`.
    `ask`: it asks for `value` Nm on every joint. `shake`: it asks the left hip for `value` Nm more and less in turn. `shape`: it
    asks for `value` torques. `bus_down`, `bus_full`: the HAL's end of the bus raises on sending.
    """

    kind: str
    start: int = 0
    cycles: int | None = 1
    value: float | str = 0.0


@dataclass(frozen=True)
class Press:
    """What the operator does in one cycle: a method of `atalante_emulator.pendant.Operator`, such as stop or release."""

    kind: str
    start: int = 0
    cycles: int | None = 1


Happening = Fault | Host | Press
#: A further judgement of a run: one sentence when it fails.
Check = Callable[["Observation"], str | None]


@dataclass(frozen=True)
class Case:
    """One run."""

    name: str  # what sets it apart from the other cases of its scenario
    happens: tuple[Happening, ...]  # `start` counts from the moment of the case
    phase: float | None = MID_SWING  # of the first step; None: from switching on
    begins: int = 0  # first faulty cycle, counted from the moment of the case
    state: SupervisorState | None = None  # None: the row's, as for the three below
    dtc: str | None = None  # "": nothing to notice
    noticed: int | None = None  # cycles
    reacted: int | None = None  # cycles
    node: str | None = None  # that the diagnostic names; None: whichever
    recovers: bool = True  # ACTIVE again after the operator's START, once it is over
    watched: int = 60  # cycles after the end of what happens, or after the bound of what does not end
    seed: int = 0
    checks: tuple[Check, ...] = ()

    @property
    def ends(self) -> int | None:
        """First cycle after everything that happens, counted from the moment of the case; None: something lasts for good."""
        ends = [None if one.cycles is None else one.start + one.cycles for one in self.happens]
        return None if None in ends else max((end for end in ends if end is not None), default=0)


@dataclass(frozen=True)
class Scenario:
    """The proof of one row of the matrix."""

    id: str
    cases: tuple[Case, ...]
    #: What of it may last for a while, as one case: how long does the walk survive it? None: nothing does.
    lasting: Case | None = None
