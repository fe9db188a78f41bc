"""CiA 402 power drive state machine, as a pure function shared by the HAL (which commands it) and the emulated drive.

Names and transitions after IEC 61800-7-201 (CiA 402-2); mode of operation is cyclic synchronous torque. Quick stop option
code is 6: the drive stays in QUICK STOP ACTIVE and holds position, which is this robot's latched local hold.
"""

from __future__ import annotations

from enum import IntEnum


class DriveState(IntEnum):
    """State of a drive; the values are the statusword (object 0x6041) masked with 0x6F."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Controlword(IntEnum):
    """Commands of the controlword (object 0x6040)."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


_S, _C = DriveState, Controlword

#: (state, controlword) -> next state, for every command that moves; all others stay.
TRANSITIONS: dict[tuple[DriveState, Controlword], DriveState] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,
}

#: Transitions a drive makes by itself: 1 when it has started, 14 when its fault reaction is complete.
AUTOMATIC: dict[DriveState, DriveState] = {
    _S.NOT_READY_TO_SWITCH_ON: _S.SWITCH_ON_DISABLED,
    _S.FAULT_REACTION_ACTIVE: _S.FAULT,
}


def next_state(state: DriveState, controlword: int, *, latched: bool = False) -> DriveState:
    """State after one controlword; an unknown or not applicable command leaves the state as it is.

    Args:
        latched: the drive stopped by itself and nobody has acknowledged it with QUICK_STOP yet; ENABLE_OPERATION
            does not leave QUICK STOP ACTIVE then, so that a HAL which never noticed the stop cannot undo it.
    """
    if latched and state is DriveState.QUICK_STOP_ACTIVE and controlword == Controlword.ENABLE_OPERATION:
        return state
    try:
        return TRANSITIONS.get((state, Controlword(controlword)), state)
    except ValueError:
        return state


#: The way up: what to command in a state to come one step nearer to OPERATION ENABLED.
TOWARDS_OPERATION: dict[int, Controlword] = {
    _S.SWITCH_ON_DISABLED: _C.SHUTDOWN,
    _S.READY_TO_SWITCH_ON: _C.SWITCH_ON,
    _S.SWITCHED_ON: _C.ENABLE_OPERATION,
    _S.OPERATION_ENABLED: _C.ENABLE_OPERATION,
    _S.QUICK_STOP_ACTIVE: _C.ENABLE_OPERATION,
    _S.FAULT: _C.FAULT_RESET,
}


def controlword_towards_operation(state: int) -> Controlword:
    """Next command on the way to OPERATION ENABLED; a state without one (booting, fault reaction) gets DISABLE_VOLTAGE."""
    return TOWARDS_OPERATION.get(state, Controlword.DISABLE_VOLTAGE)
