"""Breadth-first search over all states that a transition function can reach."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

S = TypeVar("S", bound=Hashable)
L = TypeVar("L")


class Transition(NamedTuple, Generic[S, L]):
    """Transition of one cycle."""

    label: L  # inputs of the cycle
    state: S  # state after the cycle
    broken: str  # name of the property that this transition violates; empty if it violates none


@dataclass(frozen=True)
class Exploration(Generic[S, L]):
    """Result of a search. `trace` lists inputs and state of each cycle up to the first violation; empty without violation."""

    states: int
    transitions: int
    broken: str
    trace: tuple[tuple[L, S], ...]


def explore(initial: Iterable[S], successors: Callable[[S], Iterable[Transition[S, L]]]) -> Exploration[S, L]:
    """Visit all reachable states, or stop at the first violation. The trace to the violation has the fewest possible cycles.

    Args:
        initial: states from which the search begins.
        successors: function that returns all transitions from a state.

    Returns:
        Number of states and transitions, and the trace to the first violation.
    """
    before: dict[S, tuple[L, S] | None] = dict.fromkeys(initial)
    queue, transitions = deque(before), 0
    while queue:
        state = queue.popleft()
        for label, after, broken in successors(state):
            transitions += 1
            if broken:
                return Exploration(len(before), transitions, broken, (*_trace(before, state), (label, after)))
            if after not in before:
                before[after] = label, state
                queue.append(after)
    return Exploration(len(before), transitions, "", ())


def _trace(before: dict[S, tuple[L, S] | None], state: S) -> list[tuple[L, S]]:
    """Return one pair (inputs, state after the cycle) for each cycle from an initial state to the given state."""
    trace: list[tuple[L, S]] = []
    while (step := before[state]) is not None:
        label, origin = step
        trace.append((label, state))
        state = origin
    return trace[::-1]
