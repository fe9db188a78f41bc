"""State machine of the robot: a pure function computes the next state from the last state and the conditions of the cycle.

Transitions to a worse state are automatic. Recovery requires the operator's START. The safe state is HOLD, in which every drive
holds its position without commands of the HAL, because a standing patient would fall if the drives were switched off.
`SUPERVISOR.md` is a table of all transitions, generated from this function.
"""

from __future__ import annotations

from dataclasses import dataclass

from atalante_hal.safety.diagnostics import Dtc, Reaction
from atalante_hal.types import SupervisorState


@dataclass(frozen=True)
class Conditions:
    """Inputs of the state machine in one cycle: confirmed diagnostics, and the conditions for a start or a stop."""

    diagnostics: frozenset[Dtc] = frozenset()
    nodes_ready: bool = False  # every required node is trusted and has sent its status
    #: True if all twelve drives are in OPERATION ENABLED and the direction test of the joints has ended.
    #: In FULL_ASSIST, only the states of the drives count, because there is no direction test.
    drives_enabled: bool = False
    dead_man: bool = False  # the pendant has not timed out and its dead-man switch is pressed
    #: True if HOLD is requested, if STOP is requested outside a walk on the ground, or if the program is ending.
    stop_requested: bool = False
    start_wanted: bool = False  # START was pressed, and this press can still change the state
    #: True if the walking step has ended, if the robot does not walk, or if FINISH_STEP took too long.
    step_finished: bool = False
    #: True during a walk on the ground if STOP is requested, the dead-man switch is released, or the pendant has timed out.
    #: False if HOLD is requested.
    walk_end_requested: bool = False
    #: confirmed diagnostics that lead to FINISH_STEP instead of HOLD or FULL_ASSIST, because the robot walks on the ground
    walk_ends: frozenset[Dtc] = frozenset()


_OFF, _READY, _ACTIVE = SupervisorState.OFF, SupervisorState.READY, SupervisorState.ACTIVE
_FULL_ASSIST, _FINISH_STEP = SupervisorState.FULL_ASSIST, SupervisorState.FINISH_STEP
_HOLD, _LOWER, _FAULT = SupervisorState.HOLD, SupervisorState.LOWER, SupervisorState.FAULT

#: States in which the HAL sends the controller's torques to the drives.
MOVING = frozenset({_ACTIVE, _FULL_ASSIST, _FINISH_STEP})
#: State that each reaction of a diagnostic demands from a moving robot.
#: If the robot is already in a worse state (further down in this table), the state does not change.
_STATE_OF = {
    Reaction.INFO: _ACTIVE,
    Reaction.NOT_READY: _ACTIVE,
    Reaction.FULL_ASSIST: _FULL_ASSIST,
    Reaction.FINISH_STEP: _FINISH_STEP,
    Reaction.HOLD: _HOLD,
    Reaction.LOWER: _LOWER,
    Reaction.FAULT: _FAULT,
}


def next_state(state: SupervisorState, conditions: Conditions) -> tuple[SupervisorState, frozenset[Dtc]]:
    """Return the next state and the diagnostics that cause it.

    - any state -> FAULT if a diagnostic demands FAULT
    - any state except OFF, READY and FAULT -> LOWER if a diagnostic demands LOWER
    - ACTIVE, FULL_ASSIST, FINISH_STEP -> the state that the worst diagnostic demands, if this state is worse. In these
      three states, a released dead-man switch or `Conditions.stop_requested` adds the diagnostic `OPERATOR_STOP`
    - ACTIVE, FULL_ASSIST -> FINISH_STEP if the operator requests STOP or releases the dead-man switch while the robot walks on
      the ground. The diagnostics in `Conditions.walk_ends` demand FINISH_STEP instead of their reaction
    - FINISH_STEP -> HOLD when the step is finished
    - OFF -> READY if every required node is trusted and no diagnostic demands a reaction; otherwise READY -> OFF
    - only if START is pressed and the cause is gone: READY, HOLD, FULL_ASSIST -> ACTIVE; LOWER -> HOLD;
      FAULT -> LOWER or HOLD

    Args:
        state: state of the last cycle.
        conditions: diagnostics and other conditions of this cycle.

    Returns:
        The next state, and the diagnostics with the most severe reaction. The set of diagnostics is empty if this reaction is
        INFO. The set is also empty if the operator requested the end of the walk and this reaction is milder than FINISH_STEP.
    """
    diagnostics = conditions.diagnostics
    dead_man = conditions.dead_man or conditions.walk_end_requested
    if state in MOVING and (conditions.stop_requested or not dead_man):
        diagnostics |= {Dtc.OPERATOR_STOP}
    reactions = {dtc: Reaction.FINISH_STEP if dtc in conditions.walk_ends else dtc.reaction for dtc in diagnostics}
    reaction = max(reactions.values(), default=Reaction.INFO)
    walk_ends = state in MOVING and conditions.walk_end_requested
    if reaction is Reaction.INFO or (walk_ends and reaction < Reaction.FINISH_STEP):
        reasons: frozenset[Dtc] = frozenset()
    else:
        reasons = frozenset(dtc for dtc in diagnostics if reactions[dtc] is reaction)
    return _move(state, reaction, conditions), reasons


def _move(state: SupervisorState, reaction: Reaction, facts: Conditions) -> SupervisorState:
    if reaction is Reaction.FAULT:
        return _FAULT
    stopping = facts.stop_requested or facts.walk_end_requested
    acknowledged = facts.start_wanted and facts.dead_man and not stopping
    may_start = acknowledged and facts.nodes_ready and facts.drives_enabled and reaction is Reaction.INFO
    if state in MOVING:
        demanded = max(_STATE_OF[reaction], _FINISH_STEP if facts.walk_end_requested else _ACTIVE)
        if state is _FULL_ASSIST and demanded is _ACTIVE and may_start:
            return _ACTIVE
        if state is _FINISH_STEP and facts.step_finished:
            return max(demanded, _HOLD)
        return max(state, demanded)
    if state in (_OFF, _READY):
        if not facts.nodes_ready or reaction is not Reaction.INFO:
            return _OFF
        return _ACTIVE if may_start and state is _READY else _READY
    if reaction is Reaction.LOWER:
        return _LOWER if state is not _FAULT or acknowledged else _FAULT
    if state is _HOLD:
        return _ACTIVE if may_start else _HOLD
    return _HOLD if acknowledged else state  # the state is LOWER or FAULT, but no active diagnostic demands this state
