"""The supervisor: which state the robot is in, as a pure function of the last state and what holds this cycle.

Moves to a worse state are automatic, recovery is the operator's. A standing patient cannot be dropped: the safe state is
HOLD, where every drive holds its position by itself. `SUPERVISOR.md` is the table of this function.
"""

from __future__ import annotations

from dataclasses import dataclass

from atalante_hal.safety.diagnostics import Dtc, Reaction, worst
from atalante_hal.types import SupervisorState


@dataclass(frozen=True)
class Conditions:
    """What holds in a cycle: the confirmed diagnostics, and the facts a start or a stop hangs on."""

    diagnostics: frozenset[Dtc] = frozenset()
    nodes_well: bool = False  # every node was heard, speaks this DBC and is trusted
    drives_enabled: bool = False  # all twelve drives are in OPERATION ENABLED
    dead_man: bool = False  # the pendant is heard and its dead-man is pressed
    stop_requested: bool = False  # the operator, or the program's end, asks for STOP or HOLD
    start_wanted: bool = False  # the operator pressed START and the drives are being enabled for it
    step_finished: bool = False  # since FINISH_STEP began the controller has changed feet, or may not go on any longer


_OFF, _READY, _ACTIVE = SupervisorState.OFF, SupervisorState.READY, SupervisorState.ACTIVE
_FULL_ASSIST, _FINISH_STEP = SupervisorState.FULL_ASSIST, SupervisorState.FINISH_STEP
_HOLD, _LOWER, _FAULT = SupervisorState.HOLD, SupervisorState.LOWER, SupervisorState.FAULT

#: States in which the controller's torques are used.
MOVING = frozenset({_ACTIVE, _FULL_ASSIST, _FINISH_STEP})
#: What a reaction makes of a robot that moves; a better state than the present one is never taken.
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
    """State of this cycle, and the diagnostics that demand the worst: why it is not a better one.

    - any -> FAULT, LOWER when a diagnostic demands it (LOWER: of a robot that is not OFF or READY)
    - ACTIVE, FULL_ASSIST, FINISH_STEP -> what the worst diagnostic demands, if that is worse; a robot that moves without
      dead-man, or against the operator's STOP, has `OPERATOR_STOP`
    - FINISH_STEP -> HOLD when the step is finished
    - OFF <-> READY as the nodes are well, and nothing keeps the robot from being ready, or not
    - by START alone: READY, HOLD, FULL_ASSIST -> ACTIVE; LOWER -> HOLD; FAULT -> LOWER or HOLD; each when its cause is gone
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
    return _HOLD if acknowledged else state  # LOWER and FAULT, whose cause is gone
