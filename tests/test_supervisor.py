"""The supervisor, exhaustively: every state with every combination of conditions."""

from __future__ import annotations

import pytest

from atalante_hal.supervisor import HOLD_ON, Condition, next_state
from atalante_hal.types import SupervisorState

C, S = Condition, SupervisorState
#: States this supervisor reaches.
REACHED = (S.OFF, S.READY, S.ACTIVE, S.HOLD, S.FAULT)
ALL = [Condition(bits) for bits in range(1 << len(Condition))]
GO = C.NODES_WELL | C.DRIVES_ENABLED | C.DEAD_MAN | C.START_WANTED
RUN = C.NODES_WELL | C.DRIVES_ENABLED | C.DEAD_MAN

TABLE = [
    (S.OFF, C(0), S.OFF),
    (S.OFF, C.NODES_WELL, S.READY),
    (S.OFF, GO, S.READY),
    (S.READY, C(0), S.OFF),
    (S.READY, C.NODES_WELL, S.READY),
    (S.READY, C.NODES_WELL | C.START_WANTED | C.DEAD_MAN, S.READY),
    (S.READY, GO, S.ACTIVE),
    (S.READY, GO & ~C.DEAD_MAN, S.READY),
    (S.ACTIVE, RUN, S.ACTIVE),
    (S.ACTIVE, RUN & ~C.DEAD_MAN, S.HOLD),
    (S.HOLD, RUN, S.HOLD),
    (S.HOLD, GO, S.ACTIVE),
    (S.HOLD, C(0), S.HOLD),
    (S.FAULT, RUN, S.FAULT),
    (S.FAULT, GO, S.HOLD),
    (S.FAULT, GO | C.DRIVE_FAULT, S.FAULT),
]


@pytest.mark.parametrize(("before", "conditions", "after"), TABLE)
def test_table(before: S, conditions: C, after: S):
    assert next_state(before, conditions) is after


@pytest.mark.parametrize("condition", [c for c in Condition if c & HOLD_ON], ids=lambda c: c.name)
def test_each_fault_ends_active_in_hold_at_once(condition: Condition):
    assert next_state(S.ACTIVE, RUN | condition) is S.HOLD
    assert next_state(S.READY, GO | condition) is S.READY
    assert next_state(S.HOLD, GO | condition) is S.HOLD


def test_laws_over_all_states_and_conditions():
    for state in REACHED:
        for conditions in ALL:
            after = next_state(state, conditions)
            assert after in REACHED
            if conditions & C.DRIVE_FAULT:
                assert after is S.FAULT
            if after is S.ACTIVE:
                assert conditions & C.DEAD_MAN
                assert not conditions & HOLD_ON
                assert state is S.ACTIVE or conditions & GO == GO
            # Recovery is the operator's: without START nothing gets better, but OFF to READY, which moves nothing.
            if not conditions & C.START_WANTED and (state, after) != (S.OFF, S.READY):
                assert after >= state or (state, after) == (S.READY, S.OFF)
            # A robot that held does not go limp.
            if state in (S.ACTIVE, S.HOLD, S.FAULT):
                assert after not in (S.OFF, S.READY)
