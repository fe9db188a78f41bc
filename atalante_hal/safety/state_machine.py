"""State machine of the robot: the next state as a pure function of the last state and the conditions of this cycle.

Transitions to a worse state are automatic. Recovery requires the operator's START. The safe state is HOLD, in which every drive
holds its position without commands of the HAL, because a standing patient would fall if the drives were switched off.
`SUPERVISOR.md` is the generated table of this function.
"""

from __future__ import annotations

from dataclasses import dataclass

from atalante_hal.safety.diagnostics import Dtc, Reaction, worst
from atalante_hal.types import SupervisorState


@dataclass(frozen=True)
class Conditions:
    """Inputs of the state machine in one cycle: confirmed diagnostics, and the conditions for a start or a stop."""

    diagnostics: frozenset[Dtc] = frozenset()
    nodes_well: bool = False  # every required node is trusted and has sent its status
    drives_enabled: bool = False  # all twelve drives are in OPERATION ENABLED
    dead_man: bool = False  # the pendant has not timed out and its dead-man is pressed
    stop_requested: bool = False  # the operator requested STOP or HOLD, or the program is ending
    start_wanted: bool = False  # START was pressed, and this start has not ended yet
    step_finished: bool = False  # the walking step has ended, the robot does not walk, or FINISH_STEP took too long


_OFF, _READY, _ACTIVE = SupervisorState.OFF, SupervisorState.READY, SupervisorState.ACTIVE
_FULL_ASSIST, _FINISH_STEP = SupervisorState.FULL_ASSIST, SupervisorState.FINISH_STEP
_HOLD, _LOWER, _FAULT = SupervisorState.HOLD, SupervisorState.LOWER, SupervisorState.FAULT

#: States in which the HAL sends the controller's torques to the drives.
MOVING = frozenset({_ACTIVE, _FULL_ASSIST, _FINISH_STEP})
#: Reaction -> state that it demands of a moving robot. A reaction alone never changes the state to a better one.
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
    """Return the state of this cycle and the diagnostics that cause it.

    - any state -> FAULT if a diagnostic demands it
    - any state except OFF, READY and FAULT -> LOWER if a diagnostic demands it
    - ACTIVE, FULL_ASSIST, FINISH_STEP -> the state that the worst diagnostic demands, if it is worse than the present state; in
      these states a released dead-man or the operator's STOP raises `OPERATOR_STOP`
    - FINISH_STEP -> HOLD when the step is finished
    - OFF -> READY if all nodes are well and no diagnostic demands a reaction; otherwise READY -> OFF
    - only by START, after the cause has cleared: READY, HOLD, FULL_ASSIST -> ACTIVE; LOWER -> HOLD; FAULT -> LOWER or HOLD

    Args:
        state: state of the last cycle.
        conditions: diagnostics and other conditions of this cycle.

    Returns:
        The next state, and the diagnostics that demand the most severe reaction; these are empty if that reaction is INFO.
    """
    diagnostics = conditions.diagnostics
    if state in MOVING and (conditions.stop_requested or not conditions.dead_man):
        diagnostics |= {Dtc.OPERATOR_STOP}
    reaction = worst(diagnostics)
    reasons = frozenset(dtc for dtc in diagnostics if dtc.reaction is reaction and reaction is not Reaction.INFO)
    return _move(state, reaction, conditions), reasons


def _move(state: SupervisorState, reaction: Reaction, facts: Conditions) -> SupervisorState:
    if reaction is Reaction.FAULT:
        return _FAULT
    acknowledged = facts.start_wanted and facts.dead_man and not facts.stop_requested
    may_start = acknowledged and facts.nodes_well and facts.drives_enabled and reaction is Reaction.INFO
    if state in MOVING:
        demanded = _STATE_OF[reaction]
        if state is _FULL_ASSIST and demanded is _ACTIVE and may_start:
            return _ACTIVE
        if state is _FINISH_STEP and facts.step_finished:
            return max(demanded, _HOLD)
        return max(state, demanded)
    if state in (_OFF, _READY):
        if not facts.nodes_well or reaction is not Reaction.INFO:
            return _OFF
        return _ACTIVE if may_start and state is _READY else _READY
    if reaction is Reaction.LOWER:
        return _LOWER if state is not _FAULT or acknowledged else _FAULT
    if state is _HOLD:
        return _ACTIVE if may_start else _HOLD
    return _HOLD if acknowledged else state  # here the state is LOWER or FAULT, and no diagnostic demands it any longer
