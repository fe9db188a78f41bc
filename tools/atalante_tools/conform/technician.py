"""Manual actions on the node under test, such as power-up, overheating and button presses."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Protocol

from atalante_hal.dbc_names import JOINT_NODES
from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator


class Action(Enum):
    """Manual action on the node. The value is the instruction for the technician."""

    POWER_UP = "switch {node} off and on again"
    OVERHEAT = "set the temperature input of {node} to its trip level"
    COOL = "set the temperature input of {node} back to normal"
    RELEASE_DEAD_MAN = "release the dead-man switch of {node}"
    SQUEEZE_DEAD_MAN = "press the dead-man switch of {node} and keep it pressed"
    PRESS_START = "press START on {node} once"
    PRESS_STOP = "press STOP on {node} once"
    PRESS_HOLD = "press HOLD on {node} once"
    TURN_DIAL = "turn the assistance dial of {node}"


class Technician(Protocol):
    """Person or program that carries out manual actions on the node."""

    patience: float  # longest wait for the effect of an action [s]
    #: whether the node was powered on just before the tests; NODE-01 then does not request a power-up
    fresh: bool
    certain: bool  # True for a program, which carries out every action; False for a person, who may ignore a request

    def request(self, action: Action, node: str) -> None:
        """Carry out the action, or ask a person to carry out the action."""


class HumanTechnician:
    """Person beside the node. The terminal shows this person the instruction for each action."""

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.fresh = False
        self.certain = False

    def request(self, action: Action, node: str) -> None:
        """Print the instruction for the action on stderr."""
        print_message(f"please {action.value.format(node=node)}  (waiting {self.patience:.0f} s)")


class EmulatorTechnician:
    """Program that carries out manual actions on an emulated robot.

    The emulated robot is powered on when the examination starts.
    """

    def __init__(self, emulator: Emulator, operator: Operator) -> None:
        self._emulator, self._operator = emulator, operator
        self.patience = 0.3
        self.fresh = True
        self.certain = True

    def request(self, action: Action, node: str) -> None:
        """Carry out an action on the emulated node immediately."""
        operator = self._operator
        match action:
            case Action.POWER_UP:
                pass  # nothing to do, because the emulated robot is powered on at the start of the examination
            case Action.OVERHEAT | Action.COOL:
                drive = JOINT_NODES.index(node)
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
