"""Exhaustive searches over the pendant, its link to the HAL, and the HAL. Each transition is checked for safety properties.

There are two searches, and both visit all states of pendant reception and safety monitor. The search `stops` also counts the
cycles since the operator released the dead-man switch or pressed STOP or HOLD. The search `moves` also counts the presses of
START that have not begun a start yet. A single search with both counts would visit more states and prove nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from itertools import product
from typing import Final, NamedTuple

from atalante_emulator.pendant import Request
from atalante_hal.safety.diagnostics import Reaction
from atalante_hal.safety.state_machine import MOVING
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_tools.faults.reachability.hal_steps import (
    ENERGISING,
    LOST,
    NO_START,
    SILENT,
    Environment,
    HalSteps,
    Inputs,
    PendantFrame,
    Reception,
    Supervision,
)
from atalante_tools.faults.reachability.search import Exploration, Transition, explore

_S = SupervisorState
#: Stop actions of the operator: no stop action, dead-man switch released, STOP pressed, HOLD pressed.
NOTHING, RELEASED, STOPPED, HELD = range(4)
#: Value of `Inputs.stop` after the HAL has received HOLD. `HELD` (3) has another meaning: the operator has pressed HOLD.
RECEIVED_HOLD: Final = 2
#: Number of cycles for which the HAL may still enable a drive after a stop action, if no new pendant frame arrives.
SILENT_PENDANT: Final = LOST - 1
#: Ages of late pendant frames that the search tries [cycles].
#: At age `LOST` or above, the data of the frame has timed out. At age 16 or above, the E2E check rejects the frame.
_LATE: Final = (*range(1, LOST + 2), 16)
_BUTTONS: Final = (Request.START, Request.STOP, Request.HOLD)
#: Largest stored number of cycles since the stop action. Larger numbers are stored as `_LONG`.
_LONG: Final = 6
STOP_PROPERTY: Final = "no torque command after the dead-man switch is released, or after STOP or HOLD is pressed"
MOVE_PROPERTY: Final = "each press of START causes at most one change to a better state"
RESTART_PROPERTY: Final = "no change from HOLD, LOWER or FAULT to ACTIVE without a new START"


class Operator(NamedTuple):
    """Stop action of the operator, and number of cycles since this action.

    The search `stops` checks its property with these values.
    """

    stop: int = NOTHING  # stop action: `NOTHING`, `RELEASED`, `STOPPED` or `HELD`
    cycles: int = 0  # number of cycles since the stop action; numbers above `_LONG` are stored as `_LONG`


class Presses(NamedTuple):
    """Presses of START since the last change of the supervisor state.

    The search `moves` checks its properties with these values.
    """

    received: int = 0  # number of received presses of START that have not begun a start yet; 2 means two or more
    started: bool = False  # whether a start is in progress; a change of the supervisor state clears the flag


class StopState(NamedTuple):
    """State in the search `stops`: state of the HAL, and stop action of the operator.

    The search looks for torque commands after the stop action.
    """

    reception: Reception
    supervision: Supervision
    operator: Operator = Operator()


class MoveState(NamedTuple):
    """State in the search `moves`: state of the HAL, and presses of START.

    The search looks for a change to a better supervisor state without a press of START.
    """

    reception: Reception
    supervision: Supervision
    presses: Presses = Presses()


class Cycle(NamedTuple):
    """Inputs of one cycle, listed in the trace of a counterexample."""

    frames: tuple[PendantFrame, ...]
    environment: Environment
    operator: Operator = Operator()


#: Dictionary from each possible result of the reception in one cycle to one example of pendant frames with this result.
#: A result has three parts: state of the reception, inputs of the operator, and whether the HAL received a genuine START.
#: A genuine START is a press of START from the pendant, not from a second sender.
_Receptions = dict[tuple[Reception, Inputs, bool], tuple[PendantFrame, ...]]


class _Decided(NamedTuple):
    supervision: Supervision
    energises: bool  # whether the HAL sends ENABLE OPERATION to a drive
    entered: bool  # whether the supervisor state changed


#: Initial states of both searches: a moving robot, and a HAL after power-on.
_INITIAL: Final = (
    (Reception(), Supervision(_S.ACTIVE, NO_START)),
    (SILENT, Supervision(_S.OFF, NO_START)),
)


class OperatorPath:
    """Combined transition function of pendant, link and HAL."""

    def __init__(self, receives_like: OperatorPath | None = None) -> None:
        """Create the HAL that computes the transitions.

        Args:
            receives_like: path with stored results of the reception. The new path uses these results, because reception takes
                most of the time of a search. Both paths must receive frames in the same way. None means that the new
                path computes all results.
        """
        self._steps = HalSteps()
        self._received: Callable[[Reception, Operator], _Receptions]
        self._received = cache(self._receive) if receives_like is None else receives_like._received
        self._decided, self._commanded = cache(self._decide), cache(self._command)

    def stops(self) -> Exploration[StopState, Cycle]:
        """Search for a drive that the HAL enables although the operator's stop action is at least `SILENT_PENDANT` cycles old."""
        return explore([StopState(*state) for state in _INITIAL], self._stop_successors)

    def moves(self) -> Exploration[MoveState, Cycle]:
        """Search for a motion, or a change to a better supervisor state, without a press of START (see `is_move`)."""
        return explore([MoveState(*state) for state in _INITIAL], self._move_successors)

    def _stop_successors(self, state: StopState) -> Iterator[Transition[StopState, Cycle]]:
        before = state.operator
        if before.stop == NOTHING:
            options = [Operator(), Operator(RELEASED), Operator(STOPPED), Operator(HELD)]
        else:
            options = [Operator(before.stop, min(before.cycles + 1, _LONG))]
        for operator in options:
            for (reception, inputs, _), frames in self._received(state.reception, operator).items():
                suspended = operator.stop != NOTHING and inputs.stop != RECEIVED_HOLD
                for decided, environment in self._decided(state.supervision, inputs, suspended).items():
                    late = decided.energises and operator.stop != NOTHING and operator.cycles >= SILENT_PENDANT
                    after = self._steps.without_press(reception) if decided.entered else reception
                    yield Transition(
                        Cycle(frames, environment, operator),
                        StopState(after, decided.supervision, operator),
                        STOP_PROPERTY if late else "",
                    )

    def _move_successors(self, state: MoveState) -> Iterator[Transition[MoveState, Cycle]]:
        before = state.supervision.supervisor
        for (reception, inputs, pressed), frames in self._received(state.reception, Operator()).items():
            received = min(state.presses.received + pressed, 2)
            broken = MOVE_PROPERTY if inputs.started and not received else ""
            received = max(received - inputs.started, 0)
            started = state.presses.started or inputs.started
            for decided, environment in self._decided(state.supervision, inputs, False).items():
                after = decided.supervision.supervisor
                wrong = broken
                if is_move(before, after) and not started:
                    wrong = RESTART_PROPERTY if before >= _S.HOLD else MOVE_PROPERTY
                begun = started and not decided.entered and decided.supervision.start != NO_START
                yield Transition(
                    Cycle(frames, environment),
                    MoveState(
                        self._steps.without_press(reception) if decided.entered else reception,
                        decided.supervision,
                        Presses(received, begun),
                    ),
                    wrong,
                )

    def _receive(self, before: Reception, operator: Operator) -> _Receptions:
        """Return the possible results of receiving pendant frames. Each result is mapped to the frames that cause it."""
        results: _Receptions = {}
        for frames in arrivals(before, operator):
            presses = [
                frame for frame in frames if not frame.sender and frame.pressed and frame.request == Request.START
            ]
            for reception, inputs in self._steps.receive(before, frames):
                pressed = any(frame.age == reception.age for frame in presses)
                results.setdefault((reception, inputs, pressed), frames)
        return results

    def _decide(self, before: Supervision, inputs: Inputs, suspended: bool) -> dict[_Decided, Environment]:
        """Return the possible decisions of the HAL. Each decision is mapped to an `Environment` that causes this decision.

        Args:
            before: state of the safety monitor.
            inputs: inputs of the operator.
            suspended: True if the robot does not walk on the ground. During a walk on the ground, STOP, a released dead-man
                switch or a lost pendant leads to HOLD only after the walk is finished.
        """
        results: dict[_Decided, Environment] = {}
        for environment in environments(before, suspended):
            for decision in self._steps.decide(before, inputs, environment):
                energises, enabling = self._commanded(decision.after, decision.prevented)
                after = decision.after._replace(enabling=enabling)
                results.setdefault(_Decided(after, energises, decision.entered), environment)
        return results

    def _command(self, state: Supervision, prevented: bool) -> tuple[bool, bool]:
        """Return whether the HAL sends ENABLE OPERATION to a drive, and whether drives are being enabled."""
        sent = [self._steps.command(state, prevented, drive, "torque") for drive in DriveState]
        return any(word == ENERGISING for word, _ in sent), sent[0][1]


def is_move(before: SupervisorState, after: SupervisorState) -> bool:
    """Return True if a state change starts motion, or leads from a state worse than ACTIVE to a better state.

    The numbers of `SupervisorState` increase from the best to the worst state.
    """
    return (after in MOVING and before not in MOVING) or (after < before and before > _S.ACTIVE)


def environments(before: Supervision, suspended: bool = False) -> Iterator[Environment]:
    """Yield all inputs of the safety monitor that do not come from the pendant. Inputs without effect are left out.

    Args:
        before: state of the safety monitor.
        suspended: True if the robot does not walk on the ground.
    """
    moving = before.supervisor in MOVING
    for reaction, nodes_ready, enabled in product(Reaction, (True, False), (True, False)):
        for mine in (False, True) if reaction is Reaction.LOWER else (False,):
            for walking in (False, True) if moving and not suspended else (False,):
                for finished in (True, False) if before.supervisor is _S.FINISH_STEP else (True,):
                    yield Environment(reaction, mine, nodes_ready, enabled, walking, finished)


def arrivals(before: Reception, operator: Operator) -> Iterator[tuple[PendantFrame, ...]]:
    """Yield all sets of pendant frames that can arrive in a cycle.

    A frame can be in time, lost, doubled, late or damaged. A frame of a second sender can arrive, too. The first set
    contains one frame that is in time.

    Args:
        before: state of the reception.
        operator: stop action of the operator. Frames that were sampled since this action report the action.
    """
    current = [frame for frame in _contents(before, 0) if _agrees(frame, operator)]
    yield from ((frame,) for frame in current)
    yield ()
    for age in _LATE:
        late = [frame for frame in _contents(before, age) if _agrees(frame, operator)]
        yield from ((frame,) for frame in late)
        yield from ((frame, frame) for frame in late[:1])
        if age == 1 <= before.age:  # a late frame and the current frame arrive together
            yield from ((first, second) for first in late for second in current)
    for frame in current:
        yield frame, frame
        yield (frame._replace(sender="damaged"),)
        if frame.pressed:
            continue  # frames of a second sender are tried only in cycles in which no button of the pendant is pressed
        for request, pressed in ((Request.START, True), (before.own_request, False), (Request.STOP, True)):
            rogue = PendantFrame(0, True, request, pressed, "rogue")
            yield frame, rogue
            yield rogue, frame
            yield frame, rogue._replace(age=2)
            yield rogue._replace(age=2), frame


def _contents(before: Reception, age: int) -> Iterator[PendantFrame]:
    for dead_man in (True, False):
        yield PendantFrame(age, dead_man, before.own_request, False)
        for request in _BUTTONS:
            yield PendantFrame(age, dead_man, request, True)


def _agrees(frame: PendantFrame, operator: Operator) -> bool:
    """Return whether the pendant can have sent a frame with this content.

    If the pendant read its switches after the operator's stop action, its frame must report the action. An earlier frame may have
    any content.
    """
    if frame.age > operator.cycles:
        return True  # the pendant read its switches before the stop action
    return {
        NOTHING: True,
        RELEASED: not frame.dead_man,
        STOPPED: frame.request == Request.STOP,
        HELD: frame.request == Request.HOLD,
    }[operator.stop]
