"""Supervisor state machine: every state with every reaction and condition, and invariants over sets of codes."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_hal.safety.diagnostics import Dtc, Reaction, worst
from atalante_hal.safety.state_machine import MOVING, Conditions, next_state
from atalante_hal.types import SupervisorState

S, R = SupervisorState, Reaction
FACTS = (
    "nodes_ready",
    "drives_enabled",
    "dead_man",
    "stop_requested",
    "start_wanted",
    "step_finished",
    "walk_end_requested",
)
#: One code per reaction. These codes represent all codes, because the next state depends only on the most severe reaction.
ONE_OF = {reaction: next(d for d in Dtc if d.reaction is reaction) for reaction in Reaction}
RUN = {"nodes_ready": True, "drives_enabled": True, "dead_man": True}
GO = RUN | {"start_wanted": True}
EVERYTHING = [
    (state, reaction, Conditions(frozenset({ONE_OF[reaction]}), *facts))
    for state, reaction, facts in product(S, R, product((False, True), repeat=len(FACTS)))
]


def after(state: S, *dtcs: Dtc, **facts: bool) -> S:
    return next_state(state, Conditions(frozenset(dtcs), **facts))[0]


TABLE = [
    (S.OFF, {}, S.OFF),
    (S.OFF, {"nodes_ready": True}, S.READY),
    (S.OFF, GO, S.READY),
    (S.READY, {}, S.OFF),
    (S.READY, {"nodes_ready": True}, S.READY),
    (S.READY, GO | {"drives_enabled": False}, S.READY),
    (S.READY, GO | {"dead_man": False}, S.READY),
    (S.READY, GO | {"stop_requested": True}, S.READY),
    (S.READY, GO, S.ACTIVE),
    (S.ACTIVE, RUN, S.ACTIVE),
    (S.ACTIVE, RUN | {"dead_man": False}, S.HOLD),
    (S.ACTIVE, RUN | {"stop_requested": True}, S.HOLD),
    (S.FULL_ASSIST, RUN, S.FULL_ASSIST),
    (S.FULL_ASSIST, GO, S.ACTIVE),
    (S.FULL_ASSIST, RUN | {"dead_man": False}, S.HOLD),
    (S.ACTIVE, RUN | {"walk_end_requested": True}, S.FINISH_STEP),
    (S.ACTIVE, GO | {"walk_end_requested": True}, S.FINISH_STEP),
    (S.ACTIVE, RUN | {"walk_end_requested": True, "dead_man": False}, S.FINISH_STEP),
    (S.ACTIVE, RUN | {"walk_end_requested": True, "dead_man": False, "stop_requested": True}, S.HOLD),
    (S.FULL_ASSIST, RUN | {"walk_end_requested": True}, S.FINISH_STEP),
    (S.FINISH_STEP, RUN | {"walk_end_requested": True}, S.FINISH_STEP),
    (S.FINISH_STEP, RUN | {"walk_end_requested": True, "step_finished": True}, S.HOLD),
    (S.HOLD, GO | {"walk_end_requested": True}, S.HOLD),
    (S.READY, GO | {"walk_end_requested": True}, S.READY),
    (S.FINISH_STEP, RUN, S.FINISH_STEP),
    (S.FINISH_STEP, GO, S.FINISH_STEP),
    (S.FINISH_STEP, RUN | {"step_finished": True}, S.HOLD),
    (S.FINISH_STEP, RUN | {"stop_requested": True}, S.HOLD),
    (S.HOLD, RUN, S.HOLD),
    (S.HOLD, GO, S.ACTIVE),
    (S.HOLD, GO | {"nodes_ready": False}, S.HOLD),
    (S.HOLD, {}, S.HOLD),
    (S.LOWER, RUN, S.LOWER),
    (S.LOWER, GO, S.HOLD),
    (S.LOWER, GO | {"dead_man": False}, S.LOWER),
    (S.FAULT, RUN, S.FAULT),
    (S.FAULT, GO, S.HOLD),
    (S.FAULT, {"start_wanted": True, "dead_man": True}, S.HOLD),
    (S.FAULT, GO | {"stop_requested": True}, S.FAULT),
]


@pytest.mark.parametrize(("before", "facts", "then"), TABLE)
def test_next_state_without_diagnostics(before: S, facts: dict[str, bool], then: S):
    assert after(before, **facts) is then


WORSE = {
    R.INFO: (S.ACTIVE, S.FULL_ASSIST, S.FINISH_STEP),
    R.NOT_READY: (S.ACTIVE, S.FULL_ASSIST, S.FINISH_STEP),
    R.FULL_ASSIST: (S.FULL_ASSIST, S.FULL_ASSIST, S.FINISH_STEP),
    R.FINISH_STEP: (S.FINISH_STEP, S.FINISH_STEP, S.FINISH_STEP),
    R.HOLD: (S.HOLD, S.HOLD, S.HOLD),
    R.LOWER: (S.LOWER, S.LOWER, S.LOWER),
    R.FAULT: (S.FAULT, S.FAULT, S.FAULT),
}


@pytest.mark.parametrize("dtc", Dtc)
def test_each_code_leads_a_moving_robot_to_its_reaction(dtc: Dtc):
    assert tuple(after(s, dtc, **RUN) for s in (S.ACTIVE, S.FULL_ASSIST, S.FINISH_STEP)) == WORSE[dtc.reaction]


@pytest.mark.parametrize("dtc", [d for d in Dtc if d.reaction is not R.INFO])
def test_every_code_except_information_prevents_the_start(dtc: Dtc):
    assert after(S.OFF, dtc, **GO) is (S.FAULT if dtc.reaction is R.FAULT else S.OFF)
    assert after(S.READY, dtc, **GO) is (S.FAULT if dtc.reaction is R.FAULT else S.OFF)
    assert after(S.HOLD, dtc, **GO) is {R.LOWER: S.LOWER, R.FAULT: S.FAULT}.get(dtc.reaction, S.HOLD)
    assert after(S.FULL_ASSIST, dtc, **GO) is not S.ACTIVE


@pytest.mark.parametrize(
    ("before", "facts", "then"), [(S.FAULT, RUN, S.FAULT), (S.FAULT, GO, S.LOWER), (S.LOWER, GO, S.LOWER)]
)
def test_start_does_not_end_lower_while_its_cause_lasts(before: S, facts: dict[str, bool], then: S):
    assert after(before, Dtc.OVER_TEMP, **facts) is then


def test_start_does_not_end_fault_while_its_cause_lasts():
    assert after(S.FAULT, Dtc.DRIVE_FAULT, **GO) is S.FAULT


def test_finished_step_leads_to_hold_or_a_safer_state():
    assert after(S.FINISH_STEP, Dtc.SUPPLY_LOW, **RUN, step_finished=True) is S.HOLD
    assert after(S.FINISH_STEP, Dtc.OVER_TEMP, **RUN, step_finished=True) is S.LOWER


def test_invariants_hold_for_all_states_reactions_and_facts():
    for before, reaction, conditions in EVERYTHING:
        check_laws(before, reaction, conditions)


#: Transitions for which `next_state` returns no diagnostic. `test_safety_monitor.py` tests the texts of their reasons.
WITHOUT_REASON = {
    (S.OFF, S.READY),
    (S.READY, S.OFF),
    *((before, S.ACTIVE) for before in (S.READY, S.FULL_ASSIST, S.HOLD)),
    *((before, S.HOLD) for before in (S.FINISH_STEP, S.LOWER, S.FAULT)),
    *((before, S.FINISH_STEP) for before in (S.ACTIVE, S.FULL_ASSIST)),
}


def test_transitions_without_a_diagnostic_are_those_of_the_table():
    found = set()
    for before, _, conditions in EVERYTHING:
        then, reasons = next_state(before, conditions)
        if then is not before and not reasons:
            found.add((before, then))
    assert found == WITHOUT_REASON


def check_laws(before: S, reaction: R, c: Conditions):
    then, _ = next_state(before, c)
    if reaction is R.FAULT:
        assert then is S.FAULT
    if then in MOVING:
        assert c.dead_man or c.walk_end_requested
        assert not c.stop_requested
        assert reaction < R.HOLD
    if then in MOVING and before not in MOVING:
        assert then is S.ACTIVE
        assert c.start_wanted
        assert not c.walk_end_requested
        assert c.nodes_ready
        assert c.drives_enabled
        assert reaction is R.INFO
    # Only START of the operator leads to a less safe state. Exception: OFF to READY, in which nothing moves.
    if not (c.start_wanted and c.dead_man and not c.stop_requested) and (before, then) != (S.OFF, S.READY):
        assert then >= before or (before, then) == (S.READY, S.OFF)
    # STOP and a released dead-man switch end the walk with the current step or earlier.
    if before in MOVING and c.walk_end_requested:
        assert then >= S.FINISH_STEP
    # After a motion, the state machine does not return to OFF or READY, in which the drives are not enabled.
    if before not in (S.OFF, S.READY):
        assert then not in (S.OFF, S.READY)
    # The next state of a moving robot is at least as safe as the reaction demands.
    if before in MOVING and reaction > R.NOT_READY:
        assert then >= S[reaction.name]


@pytest.mark.parametrize("before", MOVING)
def test_hold_waits_for_the_end_of_the_walk_only_if_every_diagnostic_permits_it(before: S):
    codes = frozenset({Dtc.E2E_REPEAT_RATE, Dtc.NODE_TIMEOUT})
    facts = Conditions(codes, **RUN, walk_ends=codes)
    assert next_state(before, facts) == (S.FINISH_STEP, codes)
    assert next_state(before, replace(facts, walk_ends=frozenset({Dtc.NODE_TIMEOUT}))) == (
        S.HOLD,
        frozenset({Dtc.E2E_REPEAT_RATE}),
    )
    assert next_state(before, replace(facts, diagnostics=codes | {Dtc.OVER_TEMP})) == (
        S.LOWER,
        frozenset({Dtc.OVER_TEMP}),
    )


@pytest.mark.parametrize("reaction", R)
def test_end_of_walk_hides_only_less_severe_codes(reaction: R):
    code = ONE_OF[reaction]
    _, reasons = next_state(S.ACTIVE, Conditions(frozenset({code}), **RUN, walk_end_requested=True))
    assert reasons == (frozenset({code}) if reaction >= R.FINISH_STEP else frozenset())


@given(st.sampled_from(S), st.frozensets(st.sampled_from(Dtc), max_size=6), st.tuples(*[st.booleans()] * len(FACTS)))
def test_most_severe_code_determines_the_next_state_and_its_reasons(before, dtcs, facts):
    then, reasons = next_state(before, Conditions(dtcs, *facts))
    representative, _ = next_state(before, Conditions(frozenset({ONE_OF[worst(dtcs)]}), *facts))
    assert then is representative
    stopped = before in MOVING and (not (facts[2] or facts[6]) or facts[3])
    expected = worst([*dtcs, *([Dtc.OPERATOR_STOP] if stopped else [])])
    if before in MOVING and facts[6] and expected < R.FINISH_STEP:
        expected = R.INFO  # the end of the walk that the operator requested is more severe than the diagnostics
    assert {d.reaction for d in reasons} == ({expected} if expected is not R.INFO else set())
    assert reasons == {d for d in dtcs | ({Dtc.OPERATOR_STOP} if stopped else set()) if d.reaction is expected} or not (
        reasons or expected is not R.INFO
    )


@given(st.sampled_from(S), st.frozensets(st.sampled_from(Dtc), max_size=5), st.sampled_from(Dtc))
def test_additional_code_never_leads_to_a_less_safe_state(before, dtcs, more):
    fewer, _ = next_state(before, Conditions(dtcs, **GO))
    then, _ = next_state(before, Conditions(dtcs | {more}, **GO))
    assert before not in MOVING or then >= fewer


def test_state_settles_under_constant_conditions():
    for before, _, conditions in EVERYTHING:
        then = before
        for _ in range(3):
            then, _ = next_state(then, conditions)
        assert next_state(then, conditions)[0] is then
