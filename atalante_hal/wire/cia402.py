"""CiA 402 power drive state machine as a pure function, used by the HAL and by the emulated drive.

Names and transitions follow IEC 61800-7-201 (CiA 402-2). The mode of operation is cyclic synchronous torque. The quick
stop option code is 6: after a quick stop the drive stays in QUICK STOP ACTIVE and holds its position. The robot uses
this state for HOLD.
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

#: Next state for each pair (state, controlword). A pair that is not listed leaves the state unchanged.
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

#: Transitions that need no controlword: transition 1 of CiA 402 after the start, transition 14 after the fault reaction.
AUTOMATIC: dict[DriveState, DriveState] = {
    _S.NOT_READY_TO_SWITCH_ON: _S.SWITCH_ON_DISABLED,
    _S.FAULT_REACTION_ACTIVE: _S.FAULT,
}


def next_state(state: DriveState, controlword: int, *, latched: bool = False) -> DriveState:
    """Return the state of a drive after one controlword.

    A controlword that is unknown, or has no transition in this state, leaves the state unchanged.

    Args:
        state: Current state.
        controlword: Received controlword.
        latched: True if the drive left OPERATION ENABLED without a command and the HAL has not yet acknowledged this. Then
            the drive ignores ENABLE_OPERATION, so that a HAL cannot cancel a stop that it has not detected.

    Returns:
        The next state.
    """
    if latched and controlword == Controlword.ENABLE_OPERATION:
        return state
    try:
        return TRANSITIONS.get((state, Controlword(controlword)), state)
    except ValueError:
        return state


#: Controlword for the next transition towards OPERATION ENABLED, by state.
TOWARDS_OPERATION: dict[int, Controlword] = {
    _S.SWITCH_ON_DISABLED: _C.SHUTDOWN,
    _S.READY_TO_SWITCH_ON: _C.SWITCH_ON,
    _S.SWITCHED_ON: _C.ENABLE_OPERATION,
    _S.OPERATION_ENABLED: _C.ENABLE_OPERATION,
    _S.QUICK_STOP_ACTIVE: _C.ENABLE_OPERATION,
    _S.FAULT: _C.FAULT_RESET,
}


def controlword_towards_operation(state: int) -> Controlword:
    """Return the next controlword on the path to OPERATION ENABLED.

    Args:
        state: Current state of the drive, a value of `DriveState`.

    Returns:
        The controlword. In NOT READY TO SWITCH ON and in FAULT REACTION ACTIVE it is DISABLE_VOLTAGE, because the drive leaves
        these states without a command.
    """
    return TOWARDS_OPERATION.get(state, Controlword.DISABLE_VOLTAGE)
