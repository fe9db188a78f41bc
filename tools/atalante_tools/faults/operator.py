"""Scenarios of operator actions and of a lost pendant."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_tools.faults.scenario import Case, Press, Scenario

_PENDANT: Final = "PENDANT"

SCENARIOS: Final = (
    Scenario(
        "F56",
        (
            Case("STOP", (Press("stop"),), reacted=1, noticed=1, node=_PENDANT),
            Case("HOLD", (Press("hold"),), reacted=1, noticed=1, node=_PENDANT),
            Case("dead-man released", (Press("release"), Press("squeeze", 100)), reacted=1, noticed=1, node=_PENDANT),
            Case("pendant silent", (Fault("drop", "PENDANT_STATE", 0, 100),), node=_PENDANT),
            Case("pendant gone", (Fault("silence", _PENDANT),), node=_PENDANT, recovers=False),
        ),
        lasting=Case("pendant silent", (Fault("drop", "PENDANT_STATE"),)),
    ),
)
