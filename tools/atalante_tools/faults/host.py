"""Faults of the computer the HAL runs on: its time, its bus, its controller."""

from __future__ import annotations

from typing import Final

from atalante_hal.types import SupervisorState
from atalante_tools.faults.scenario import Case, Host, Scenario

_ACTIVE: Final = SupervisorState.ACTIVE
#: Errors of every family: arithmetic, look-up, type, memory, and what numpy raises.
_ERRORS: Final = (
    "ValueError",
    "ZeroDivisionError",
    "KeyError",
    "TypeError",
    "MemoryError",
    "RecursionError",
    "StopIteration",
)

SCENARIOS: Final = (
    Scenario(
        "F16",
        (
            Case("for 200 cycles", (Host("bus_down", 0, 200),)),
            Case("for 5 cycles", (Host("bus_down", 0, 5),)),
            Case("for good", (Host("bus_down", 0, None),), recovers=False),
        ),
        lasting=Case("down", (Host("bus_down", 0, None),)),
    ),
    Scenario(
        "F44",
        (
            Case("2 cycles", (Host("late", 0, 2, 1.5e-3),), state=_ACTIVE, dtc=""),
            Case("3 cycles", (Host("late", 0, 3, 1.5e-3),)),
        ),
        lasting=Case("1.5 ms late in every cycle", (Host("late", 0, None, 1.5e-3),)),
    ),
    Scenario(
        "F45",
        (
            Case("when it starts", (Host("raise_in_reset", 0, 800, "ValueError"),), phase=None),
            *(
                Case(f"at {phase:.1%} of a step", (Host("raise", value="ValueError"),), phase)
                for phase in (0.0, 0.5, 0.999, 1.0)
            ),
            *(Case(error, (Host("raise", value=error),)) for error in _ERRORS),
        ),
    ),
)
