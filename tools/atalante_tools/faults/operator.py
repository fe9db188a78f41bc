"""Scenarios of operator actions and pendant faults: STOP, HOLD, a released dead-man switch, and a lost pendant."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_tools.faults.scenario import Case, OperatorAction, Scenario

_PENDANT: Final = "PENDANT"

SCENARIOS: Final = (
    Scenario(
        "F56",
        (
            Case("STOP", (OperatorAction("stop"),), reacted=1, detected=1, node=_PENDANT),
            Case("HOLD", (OperatorAction("hold"),), reacted=1, detected=1, node=_PENDANT),
            Case(
                "dead-man released",
                (OperatorAction("release"), OperatorAction("squeeze", 100)),
                reacted=1,
                detected=1,
                node=_PENDANT,
            ),
            Case("pendant silent for 100 cycles", (Fault("drop", "PENDANT_STATE", 0, 100),), node=_PENDANT),
            Case("pendant silent, permanent", (Fault("silence", _PENDANT),), node=_PENDANT, recovers=False),
        ),
        permanent=Case("pendant silent", (Fault("drop", "PENDANT_STATE"),)),
    ),
)
