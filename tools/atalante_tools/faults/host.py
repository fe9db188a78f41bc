"""Fault scenarios of the computer that runs the HAL: late cycles, bus errors and controller errors."""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.types import SupervisorState
from atalante_tools.faults.checks import full_queue_is_confirmed, no_joint_is_too_fast
from atalante_tools.faults.scenario import MID_SWING, Case, HostFault, Scenario

_ACTIVE: Final = SupervisorState.ACTIVE
#: Exceptions that the faulty controller raises.
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
            Case("for 200 cycles", (HostFault("bus_down", 0, 200),)),
            Case("for 5 cycles", (HostFault("bus_down", 0, 5),)),
            Case("permanent", (HostFault("bus_down", 0, None),), recovers=False),
        ),
        permanent=Case("permanent", (HostFault("bus_down", 0, None),)),
    ),
    Scenario(
        "F17",
        (
            Case("for 1 cycle", (HostFault("bus_full", 0, 1),), state=_ACTIVE),
            Case("for 5 cycles", (HostFault("bus_full", 0, 5),), checks=(full_queue_is_confirmed,)),
            Case("for 200 cycles", (HostFault("bus_full", 0, 200),), checks=(full_queue_is_confirmed,)),
        ),
        permanent=Case("permanent", (HostFault("bus_full", 0, None),)),
    ),
    Scenario(
        "F37",
        (
            *(Case(f"{value} Nm", (HostFault("request", 0, 3, value),)) for value in (math.nan, math.inf, -math.inf)),
            *(
                Case(f"{value:g} Nm", (HostFault("request", 0, 3, value),), state=_ACTIVE, dtc="")
                for value in (1e3, -1e300)
            ),
        ),
    ),
    Scenario(
        "F73",
        tuple(
            Case(
                f"{'-' if sign else '+'}{joint} at {phase:.0%} of a step",
                (HostFault("full_torque", 0, 60, f"{sign}left_{joint}"),),
                phase,
                checks=(no_joint_is_too_fast,),
            )
            for joint in ("TH", "SK", "SA", "HA")
            for sign in ("", "-")
            for phase in (0.1, MID_SWING, 0.7)
        ),
    ),
    Scenario(
        "F43",
        (
            Case("4 ms", (HostFault("late", 0, 1, 4e-3),), state=_ACTIVE, detected=1),
            Case("6 ms", (HostFault("late", 0, 1, 6e-3),), reacted=1, detected=1),
            Case("2 s", (HostFault("late", 0, 1, 2.0),), reacted=1, detected=1),
        ),
        permanent=None,
    ),
    Scenario(
        "F44",
        (
            Case("2 cycles", (HostFault("late", 0, 2, 1.5e-3),), state=_ACTIVE, dtc=""),
            Case("3 cycles", (HostFault("late", 0, 3, 1.5e-3),), reacted=3),
            Case("cycles of 1.9 ms", (HostFault("slow", 0, 100, 1.9e-3),)),
            Case("cycles of 1.05 ms", (HostFault("slow", 0, 100, 1.05e-3),), state=_ACTIVE, dtc=""),
        ),
        permanent=Case("1.5 ms late in every cycle", (HostFault("late", 0, None, 1.5e-3),)),
    ),
    Scenario(
        "F45",
        (
            Case("at the reset of the controller", (HostFault("raise_in_reset", 0, 800, "ValueError"),), phase=None),
            *(
                Case(f"at {phase:.1%} of a step", (HostFault("raise", value="ValueError"),), phase)
                for phase in (0.0, 0.5, 0.999, 1.0)
            ),
            *(Case(error, (HostFault("raise", value=error),)) for error in _ERRORS),
            *(Case(f"{count} torques instead of 12", (HostFault("shape", value=count),)) for count in (0, 3, 13)),
        ),
    ),
)
