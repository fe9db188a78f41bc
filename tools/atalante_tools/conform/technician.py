"""Who does to the node what no frame can do: switch it on, heat it, press its buttons."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Protocol

from atalante_hal.robot import JOINTS
from atalante_tools.console.terminal import say

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator


class Action(Enum):
    """What can be asked for; the value is how a person is asked."""

    POWER_UP = "switch {node} off and on again"
    OVERHEAT = "make {node} believe it is too hot (its temperature input at the trip level)"
    COOL = "let {node} be cool again"
    RELEASE_DEAD_MAN = "let the dead-man of {node} go"
    SQUEEZE_DEAD_MAN = "press the dead-man of {node} and keep it pressed"
    PRESS_START = "press START on {node} once"
    PRESS_STOP = "press STOP on {node} once"
    PRESS_HOLD = "press HOLD on {node} once"
    TURN_DIAL = "turn the assistance dial of {node}"


class Technician(Protocol):
    """Does what is asked, now or within `patience`."""

    patience: float  # s a requirement waits for the action to show
    fresh: bool  # the node has just been switched on, when the examination begins
    certain: bool  # what is asked is done, whether it shows or not

    def please(self, action: Action, node: str) -> None:
        """Do it, or say that it is wanted."""


class Person:
    """Somebody at the bench who reads the terminal."""

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.fresh = False
        self.certain = False

    def please(self, action: Action, node: str) -> None:
        """Ask on stderr."""
        say(f"please {action.value.format(node=node)}  (waiting {self.patience:.0f} s)")


class EmulatorTechnician:
    """Reaches into an emulated robot in this process, which was started for this examination."""

    def __init__(self, emulator: Emulator, operator: Operator) -> None:
        self._emulator, self._operator = emulator, operator
        self.patience = 0.3
        self.fresh = True
        self.certain = True

    def please(self, action: Action, node: str) -> None:
        """Do it at once."""
        operator = self._operator
        match action:
            case Action.POWER_UP:
                pass  # it has just begun
            case Action.OVERHEAT | Action.COOL:
                drive = [joint.upper() for joint in JOINTS].index(node)
                self._emulator.drives.heat(drive, 150.0 if action is Action.OVERHEAT else 25.0)
            case Action.RELEASE_DEAD_MAN:
                operator.release()
            case Action.SQUEEZE_DEAD_MAN:
                operator.squeeze()
            case Action.PRESS_START:
                operator.start()
            case Action.PRESS_STOP:
                operator.stop()
            case Action.PRESS_HOLD:
                operator.hold()
            case Action.TURN_DIAL:
                operator.assist(0.25 if operator.signals.assistance_factor != 0.25 else 0.75)
