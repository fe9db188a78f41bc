"""Joint of the drive under test, and the CiA 402 state machine that the drive must have (IEC 61800-7-201).

This module does not use the transition table of `atalante_hal.wire.cia402`. The emulated drive uses that table, so a test with
the same table would not detect an error in the table.
"""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.safety.start import STALLED_CYCLES
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested

_S, _C = DriveState, Controlword

#: Legal transitions of a drive: (state, command) -> (transition number in CiA 402, next state).
#: A command that has no transition in the current drive state must leave the drive state unchanged.
LEGAL: Final[dict[tuple[DriveState, Controlword], tuple[int, DriveState]]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): (2, _S.READY_TO_SWITCH_ON),
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): (3, _S.SWITCHED_ON),
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): (4, _S.OPERATION_ENABLED),
    # In OPERATION ENABLED, the command with the code 0x07 (SWITCH_ON) has the CiA 402 name DISABLE OPERATION.
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): (5, _S.SWITCHED_ON),
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
#: Drive state -> commands that bring the drive from SWITCH ON DISABLED to this state, in the order of sending.
ROUTES: Final[dict[DriveState, tuple[Controlword, ...]]] = {
    _S.SWITCH_ON_DISABLED: (),
    _S.READY_TO_SWITCH_ON: (_C.SHUTDOWN,),
    _S.SWITCHED_ON: (_C.SHUTDOWN, _C.SWITCH_ON),
    _S.OPERATION_ENABLED: (_C.SHUTDOWN, _C.SWITCH_ON, _C.ENABLE_OPERATION),
    _S.QUICK_STOP_ACTIVE: (_C.SHUTDOWN, _C.SWITCH_ON, _C.ENABLE_OPERATION, _C.QUICK_STOP),
}

#: Longest accepted duration of a state transition of a drive [cycles]. If a transition takes longer, the HAL aborts the START.
FOLLOW: Final = STALLED_CYCLES
#: If a command must leave the drive state unchanged, the test sends the command in `STAY` consecutive cycles.
STAY: Final = 8
#: Longest accepted time from a command to the first state frame that shows the effect of the command [cycles].
SHOWN: Final = 3
#: Largest accepted difference between the measured and the expected torque in a torque test [Nm].
NOISE: Final = 0.3


class Axis:
    """Joint of the drive under test. Commands go to this joint; the other five joints of the leg stay switched off."""

    def __init__(self, tester: NodeTester) -> None:
        self.tester = tester
        self.joint = JOINT_NODES.index(tester.node.name)
        self._prefix = tester.node.name.rsplit("_", 1)[1]
        self._own = tester.network.message(tester.command.message.name)
        self.other_data_id = next(
            m.data_id for m in tester.network.sent_by("HAL") if m.length == self._own.length and m is not self._own
        )

    def signal(self, name: str) -> str:
        """Return the full name of a signal of this joint, for example "SK_TargetTorque" for "TargetTorque"."""
        return f"{self._prefix}_{name}"

    def command(
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
        """Return a command frame for this joint. Shape (1,).

        Args:
            controlword: CiA 402 command.
            torque: target torque [Nm].
            limit: largest torque [Nm]; None means `Limits.torque`.
            raw: raw code for each named signal of this joint, which replaces the encoded value of the signal.
            counter: alive counter of the frame; None means the next alive counter.
            data_id: E2E Data ID for the CRC; None means the Data ID of the message.
            length: payload length [byte]; None means the length in the DBC.
            flip: payload bit that is inverted after the CRC is written; None means no bit.
        """
        values = {
            self.signal("Controlword"): float(controlword),
            self.signal("TargetTorque"): torque,
            self.signal("MaxTorque"): self.tester.limits.torque if limit is None else limit,
        }
        codes = {self.signal(name): code for name, code in (raw or {}).items()}
        return self.tester.command.frame(values, raw=codes, counter=counter, data_id=data_id, length=length, flip=flip)

    def bad_command(
        self,
        *,
        counter: int | None = None,
        data_id: int | None = None,
        length: int | None = None,
        flip: int | None = None,
    ) -> Frames:
        """Return a defective command frame, shape (1,).

        The command is ENABLE OPERATION with the largest permitted torque, `Limits.torque`. A drive that accepts the defective
        frame produces this torque.

        Args:
            counter: alive counter of the frame; None means the next alive counter.
            data_id: E2E Data ID for the CRC; None means the Data ID of the message.
            length: payload length [byte]; None means the length in the DBC.
            flip: payload bit that is inverted after the CRC is written; None means no bit.
        """
        torque = self.tester.limits.torque
        return self.command(_C.ENABLE_OPERATION, torque, counter=counter, data_id=data_id, length=length, flip=flip)

    def run(
        self, cycles: int, controlword: Controlword, torque: float = 0.0, limit: float | None = None
    ) -> list[ReceivedFrame]:
        """Send the same command for a number of cycles and return the state frames received."""
        return [frame for _ in range(cycles) for frame in self.send(self.command(controlword, torque, limit))]

    def send(self, command: Frames) -> list[ReceivedFrame]:
        """Run one cycle with a command and return the state frames received."""
        return self.tester.states(self.tester.cycle(command))

    def follow(self, controlword: Controlword, goal: DriveState, cycles: int = FOLLOW) -> int | None:
        """Repeat a command until the drive reaches the state `goal`.

        Return the number of cycles; None if `goal` is not reached.
        """
        for number in range(1, cycles + 1):
            if any(state_of(frame) == goal for frame in self.send(self.command(controlword))):
                return number
        return None

    def go(self, goal: DriveState) -> None:
        """Bring the drive to the state `goal` through the transitions of CiA 402.

        Raises:
            NotTested: If the drive does not follow.
        """
        if self.follow(_C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED) is None:
            self.follow(_C.FAULT_RESET, _S.SWITCH_ON_DISABLED)
        state = _S.SWITCH_ON_DISABLED
        for controlword in ROUTES[goal]:
            state = LEGAL[state, controlword][1]
            if self.follow(controlword, state) is None:
                raise NotTested(
                    f"the drive must reach {state.name} within {FOLLOW} cycles, but the drive did not reach this state"
                )

    def enable(self) -> None:
        """Bring the drive to OPERATION ENABLED with a torque command of 0.

        Raises:
            NotTested: If the drive does not follow.
        """
        self.go(_S.OPERATION_ENABLED)
        self.run(4, _C.ENABLE_OPERATION)


def state_of(received: ReceivedFrame) -> int:
    """Return the value of the signal `DriveState` in a state frame."""
    return int(received.values["DriveState"])


def name_of(state: int) -> str:
    """Return the CiA 402 name of a drive state, or a text that shows the number of an undefined state."""
    try:
        return DriveState(state).name
    except ValueError:
        return f"{state:#04x} (undefined state)"


def torque_of(received: list[ReceivedFrame]) -> float:
    """Return the measured torque with the largest magnitude [Nm]; 0 if there are no frames."""
    return max((frame.values["Torque"] for frame in received), key=abs, default=0.0)


def mean_torque(received: list[ReceivedFrame]) -> float:
    """Return the mean measured torque [Nm]; NaN if there are no frames."""
    return sum(frame.values["Torque"] for frame in received) / len(received) if received else math.nan


def names_of(received: list[ReceivedFrame]) -> str:
    """Return the names of all drive states in the frames, each name once, in order of first appearance."""
    return " -> ".join(dict.fromkeys(name_of(state_of(frame)) for frame in received)) or "no state frame"


def all_in(received: list[ReceivedFrame], state: DriveState) -> bool:
    """Return whether there is at least one frame and every frame reports `state`."""
    return bool(received) and all(state_of(frame) == state for frame in received)


def emergencies_of(tester: NodeTester, first: int) -> list[int]:
    """Return the error codes of the emergency messages in `tester.received`, starting at the index `first`."""
    return [
        int(frame.values["ErrorCode"])
        for frame in tester.received[first:]
        if frame.message is tester.emergency_message and frame.values and frame.values["ErrorCode"]
    ]


def codes_of(codes: list[int]) -> str:
    """Return error codes as hexadecimal text."""
    return ", ".join(f"{code:#06x}" for code in codes) or "none"
