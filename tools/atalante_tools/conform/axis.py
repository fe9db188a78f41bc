"""The joint of a drive under test, and the state machine it owes: written down here from IEC 61800-7-201.

Not taken from `atalante_hal.wire.cia402`, which the emulated drive uses too.
"""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.robot import JOINTS
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard

_S, _C = DriveState, Controlword

#: (state, command) -> next state, with the number of the standard's transition; no other command moves.
LEGAL: Final[dict[tuple[DriveState, Controlword], tuple[int, DriveState]]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): (2, _S.READY_TO_SWITCH_ON),
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): (3, _S.SWITCHED_ON),
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): (4, _S.OPERATION_ENABLED),
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): (5, _S.SWITCHED_ON),  # the command is DISABLE OPERATION here
    (_S.SWITCHED_ON, _C.SHUTDOWN): (6, _S.READY_TO_SWITCH_ON),
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): (7, _S.SWITCH_ON_DISABLED),
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): (7, _S.SWITCH_ON_DISABLED),
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): (8, _S.READY_TO_SWITCH_ON),
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): (9, _S.SWITCH_ON_DISABLED),
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): (10, _S.SWITCH_ON_DISABLED),
    (_S.SWITCHED_ON, _C.QUICK_STOP): (10, _S.SWITCH_ON_DISABLED),
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): (11, _S.QUICK_STOP_ACTIVE),
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): (12, _S.SWITCH_ON_DISABLED),
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): (16, _S.OPERATION_ENABLED),
}
#: States a command can bring about, each with the way there from SWITCH ON DISABLED.
ROUTES: Final[dict[DriveState, tuple[Controlword, ...]]] = {
    _S.SWITCH_ON_DISABLED: (),
    _S.READY_TO_SWITCH_ON: (_C.SHUTDOWN,),
    _S.SWITCHED_ON: (_C.SHUTDOWN, _C.SWITCH_ON),
    _S.OPERATION_ENABLED: (_C.SHUTDOWN, _C.SWITCH_ON, _C.ENABLE_OPERATION),
    _S.QUICK_STOP_ACTIVE: (_C.SHUTDOWN, _C.SWITCH_ON, _C.ENABLE_OPERATION, _C.QUICK_STOP),
}

#: Cycles a drive may take for a transition.
FOLLOW: Final = 50
#: Cycles for which a command that must not move is repeated.
STAY: Final = 8
#: Cycles from a command to the state frame that shows it, at the most, when nothing has to switch.
SHOWN: Final = 3
#: Difference of measured and wanted torque that is noise [Nm].
NOISE: Final = 0.3


class Axis:
    """The joint of a drive under test: commands to it, the other five of its leg switched off."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.joint = [joint.upper() for joint in JOINTS].index(bench.node.name)
        self._prefix = bench.node.name.rsplit("_", 1)[1]
        self._own = bench.network.message(bench.command.message.name)
        self.other_data_id = next(
            m.data_id for m in bench.network.sent_by("HAL") if m.length == self._own.length and m is not self._own
        )

    def signal(self, name: str) -> str:
        """A signal of the command, this joint's."""
        return f"{self._prefix}_{name}"

    def word(
        self,
        controlword: Controlword,
        torque: float = 0.0,
        limit: float | None = None,
        *,
        raw: dict[str, int] | None = None,
        counter: int | None = None,
        data_id: int | None = None,
        length: int | None = None,
        flip: int | None = None,
    ) -> Frames:
        """A command. `raw` names this joint's quantities; see `Outgoing.frame` for the defects."""
        values = {
            self.signal("Controlword"): float(controlword),
            self.signal("TargetTorque"): torque,
            self.signal("MaxTorque"): self.bench.limits.torque if limit is None else limit,
        }
        codes = {self.signal(name): code for name, code in (raw or {}).items()}
        return self.bench.command.frame(values, raw=codes, counter=counter, data_id=data_id, length=length, flip=flip)

    def push(
        self,
        *,
        counter: int | None = None,
        data_id: int | None = None,
        length: int | None = None,
        flip: int | None = None,
    ) -> Frames:
        """A defective command that would make all the torque there may be."""
        push = self.bench.limits.torque
        return self.word(_C.ENABLE_OPERATION, push, counter=counter, data_id=data_id, length=length, flip=flip)

    def run(
        self, cycles: int, controlword: Controlword, torque: float = 0.0, limit: float | None = None
    ) -> list[Heard]:
        """The same command for some cycles; the states heard."""
        return [h for _ in range(cycles) for h in self.send(self.word(controlword, torque, limit))]

    def send(self, command: Frames) -> list[Heard]:
        """One cycle with a command; the states heard."""
        return self.bench.states(self.bench.cycle(command))

    def follow(self, controlword: Controlword, goal: DriveState, cycles: int = FOLLOW) -> int | None:
        """Repeat a command until the drive is in `goal`; cycles it took, None if it never was."""
        for number in range(1, cycles + 1):
            if any(state_of(h) == goal for h in self.send(self.word(controlword))):
                return number
        return None

    def go(self, goal: DriveState) -> None:
        """Bring the drive to a state, by the way of the standard.

        Raises:
            NotTested: it does not follow.
        """
        if self.follow(_C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED) is None:
            self.follow(_C.FAULT_RESET, _S.SWITCH_ON_DISABLED)
        state = _S.SWITCH_ON_DISABLED
        for controlword in ROUTES[goal]:
            state = LEGAL[state, controlword][1]
            if self.follow(controlword, state) is None:
                raise NotTested(f"the drive cannot be brought to {state.name}")

    def enable(self) -> None:
        """OPERATION ENABLED with no torque. Raises `NotTested`."""
        self.go(_S.OPERATION_ENABLED)
        self.run(4, _C.ENABLE_OPERATION)


def state_of(heard: Heard) -> int:
    """DriveState of a state frame."""
    return int(heard.values["DriveState"])


def name_of(state: int) -> str:
    """As the standard calls it."""
    try:
        return DriveState(state).name
    except ValueError:
        return f"{state:#04x}, which is no state"


def torque_of(heard: list[Heard]) -> float:
    """Largest measured torque [Nm], with its sign; 0 without frames."""
    return max((h.values["Torque"] for h in heard), key=abs, default=0.0)


def mean_torque(heard: list[Heard]) -> float:
    """Mean of the measured torque [Nm]; NaN without frames."""
    return sum(h.values["Torque"] for h in heard) / len(heard) if heard else math.nan


def names_of(heard: list[Heard]) -> str:
    """The states of some frames, each once, in order."""
    return " -> ".join(dict.fromkeys(name_of(state_of(h)) for h in heard)) or "no state frame"


def always(heard: list[Heard], state: DriveState) -> bool:
    """Every frame says that state, and there is one."""
    return bool(heard) and all(state_of(h) == state for h in heard)


def emergencies_of(bench: Bench, first: int) -> list[int]:
    """Error codes of the emergencies of the node since the frame of that number."""
    return [
        int(h.values["ErrorCode"])
        for h in bench.heard[first:]
        if h.message is bench.emergency_message and h.values and h.values["ErrorCode"]
    ]


def codes_of(codes: list[int]) -> str:
    """Error codes as CiA 301 writes them."""
    return ", ".join(f"{code:#06x}" for code in codes) or "none"
