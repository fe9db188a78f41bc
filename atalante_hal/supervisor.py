"""The supervisor: which state the robot is in, as a pure function of the last state and what holds this cycle.

Moves to a worse state are automatic, recovery is the operator's. A standing patient cannot be dropped: the safe state is
HOLD, where every drive holds its position by itself.
"""

from __future__ import annotations

from enum import IntFlag

from atalante_hal.types import SupervisorState


class Condition(IntFlag):
    """What holds in a cycle. Conditions that demand a reaction are named after the fault, the others after the fact."""

    NODES_WELL = 1 << 0  # every node is heard in time and reports this network's DBC
    DRIVES_ENABLED = 1 << 1  # all twelve drives are in OPERATION ENABLED
    DEAD_MAN = 1 << 2  # the pendant is heard and its dead-man is pressed
    START_WANTED = 1 << 3  # the operator pressed START and the drives are being enabled for it
    STOP_REQUESTED = 1 << 4  # the operator asks for STOP or HOLD
    NODE_TIMEOUT = 1 << 5  # a drive, IMU or foot was not heard in time
    DRIVE_STATE = 1 << 6  # a drive left OPERATION ENABLED unasked
    DRIVE_FAULT = 1 << 7  # a drive reports a fault
    CONTROLLER_ERROR = 1 << 8  # the controller raised
    COMMAND_NOT_FINITE = 1 << 9  # the controller asked for NaN or infinity
    CYCLE_GAP = 1 << 10  # more than 5 ms went by between two cycles
    OVERRUN = 1 << 11  # three cycles in a row were late
    BUS_DOWN = 1 << 12  # the bus refuses frames


#: Any of these ends ACTIVE in HOLD.
HOLD_ON = (
    Condition.STOP_REQUESTED
    | Condition.NODE_TIMEOUT
    | Condition.DRIVE_STATE
    | Condition.CONTROLLER_ERROR
    | Condition.COMMAND_NOT_FINITE
    | Condition.CYCLE_GAP
    | Condition.OVERRUN
    | Condition.BUS_DOWN
)
_MAY_START = Condition.NODES_WELL | Condition.DEAD_MAN | Condition.START_WANTED | Condition.DRIVES_ENABLED

_OFF, _READY, _ACTIVE = SupervisorState.OFF, SupervisorState.READY, SupervisorState.ACTIVE
_HOLD, _FAULT = SupervisorState.HOLD, SupervisorState.FAULT


def next_state(state: SupervisorState, conditions: Condition) -> SupervisorState:
    """State of this cycle.

    - any -> FAULT when a drive reports a fault; FAULT -> HOLD when it is gone and the operator starts again
    - OFF <-> READY as the nodes are well or not
    - READY, HOLD -> ACTIVE when the operator started, holds the dead-man, and every drive is enabled
    - ACTIVE -> HOLD on `HOLD_ON`, or when the dead-man is released or lost
    """
    if conditions & Condition.DRIVE_FAULT:
        return _FAULT
    may_start = (conditions & _MAY_START) == _MAY_START and not conditions & HOLD_ON
    if state is _ACTIVE:
        return _HOLD if conditions & HOLD_ON or not conditions & Condition.DEAD_MAN else _ACTIVE
    if state in (_OFF, _READY):
        if not conditions & Condition.NODES_WELL:
            return _OFF
        return _ACTIVE if may_start and state is _READY else _READY
    if state is _HOLD:
        return _ACTIVE if may_start else _HOLD
    if conditions & Condition.START_WANTED:  # FAULT, and nothing reports one any more
        return _HOLD
    return state
