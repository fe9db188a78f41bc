"""CiA 402 state machine: every state with every controlword byte."""

from __future__ import annotations

import itertools

import pytest

from atalante_hal.wire.cia402 import Controlword, DriveState, controlword_towards_operation, next_state

S, C = DriveState, Controlword

#: Transitions of IEC 61800-7-201 that a controlword causes, by number. The drive makes transitions 0, 1, 13 and 14 itself.
STANDARD = {
    2: (S.SWITCH_ON_DISABLED, C.SHUTDOWN, S.READY_TO_SWITCH_ON),
    3: (S.READY_TO_SWITCH_ON, C.SWITCH_ON, S.SWITCHED_ON),
    4: (S.SWITCHED_ON, C.ENABLE_OPERATION, S.OPERATION_ENABLED),
    5: (S.OPERATION_ENABLED, C.SWITCH_ON, S.SWITCHED_ON),
    6: (S.SWITCHED_ON, C.SHUTDOWN, S.READY_TO_SWITCH_ON),
    7: (S.READY_TO_SWITCH_ON, C.DISABLE_VOLTAGE, S.SWITCH_ON_DISABLED),
    8: (S.OPERATION_ENABLED, C.SHUTDOWN, S.READY_TO_SWITCH_ON),
    9: (S.OPERATION_ENABLED, C.DISABLE_VOLTAGE, S.SWITCH_ON_DISABLED),
    10: (S.SWITCHED_ON, C.DISABLE_VOLTAGE, S.SWITCH_ON_DISABLED),
    11: (S.OPERATION_ENABLED, C.QUICK_STOP, S.QUICK_STOP_ACTIVE),
    12: (S.QUICK_STOP_ACTIVE, C.DISABLE_VOLTAGE, S.SWITCH_ON_DISABLED),
    15: (S.FAULT, C.FAULT_RESET, S.SWITCH_ON_DISABLED),
    16: (S.QUICK_STOP_ACTIVE, C.ENABLE_OPERATION, S.OPERATION_ENABLED),
}
#: Quick stop also causes transitions 7 and 10.
BY_QUICK_STOP = {S.READY_TO_SWITCH_ON: S.SWITCH_ON_DISABLED, S.SWITCHED_ON: S.SWITCH_ON_DISABLED}


@pytest.mark.parametrize("number", STANDARD)
def test_transitions_follow_the_standard(number: int):
    before, command, after = STANDARD[number]
    assert next_state(before, command) is after


def test_other_controlwords_change_no_state():
    moves = {(before, command): after for before, command, after in STANDARD.values()}
    moves |= {(before, C.QUICK_STOP): after for before, after in BY_QUICK_STOP.items()}
    for state, byte in itertools.product(S, range(256)):
        assert next_state(state, byte) is moves.get((state, byte), state)


def test_latched_drive_ignores_only_enable_operation():
    for state, byte in itertools.product(S, range(256)):
        after = next_state(state, byte, latched=True)
        assert after is (state if byte == C.ENABLE_OPERATION else next_state(state, byte))


def test_enable_sequence_reaches_operation_from_every_possible_state():
    for start in set(S) - {S.NOT_READY_TO_SWITCH_ON, S.FAULT_REACTION_ACTIVE}:
        state = start
        for _ in range(5):
            state = next_state(state, controlword_towards_operation(state))
        assert state is S.OPERATION_ENABLED
    for state in (S.NOT_READY_TO_SWITCH_ON, S.FAULT_REACTION_ACTIVE):
        assert controlword_towards_operation(state) is C.DISABLE_VOLTAGE


def test_state_values_are_masked_statusword_bits():
    assert all(state & 0x6F == state for state in S)
