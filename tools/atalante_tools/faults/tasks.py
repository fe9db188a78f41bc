"""Tasks of a campaign: cases of a fault, endurance runs and pairs of faults.

    task -> runner -> verdict

Tasks and results are small data, so that they can be sent to another process or computer.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from atalante_emulator.faults import Fault
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.runner import observe
from atalante_tools.faults.scenario import Case, Happening
from atalante_tools.faults.verdict import WALKING, Expectation, Verdict, improved, judge, uncontrolled

#: Duration of the faults in endurance runs [cycles]; longer than a step.
HORIZON: Final = 1000
#: Cycles between the first and the second fault of a pair.
APART: Final = 3
#: Cases that are combined in pairs, one case for each kind of fault, as (row of the matrix, name of the case).
REPRESENTATIVES: Final = (
    ("F03", "4 frames"),
    ("F04", "LEFT_SK"),
    ("F11", "several"),
    ("F13", "one leg"),
    ("F18", "back after 2 cycles"),
    ("F25", "5 frames"),
    ("F28", "100 mrad for good"),
    ("F30", "IMU_LEFT_TIBIA"),
    ("F36", "250 cycles"),
    ("F38", "100 degC"),
    ("F39", "130 degC"),
    ("F44", "3 cycles"),
    ("F45", "ValueError"),
    ("F56", "dead-man released"),
)


@dataclass(frozen=True)
class Endurance:
    """Result of an endurance run."""

    id: str
    case: str
    survived: int | None  # cycles; None if the walk continued for the whole `HORIZON`


@dataclass(frozen=True)
class PairVerdict:
    """Result of a pair of faults."""

    first: str
    second: str
    state: str  # final state of the HAL
    failures: tuple[str, ...]  # one sentence each


@dataclass(frozen=True)
class CaseTask:
    """Task to run one case of a scenario."""

    id: str
    index: int

    def __call__(self) -> Verdict:
        """Run the case and return its verdict."""
        return attempt(self.id, SCENARIOS[self.id].cases[self.index])


@dataclass(frozen=True)
class EnduranceTask:
    """Task to measure how long the walk survives the permanent fault of a scenario."""

    id: str

    def __call__(self) -> Endurance:
        """Shorten the fault until the walk survives it, and return the largest number of cycles that it survives."""
        case = SCENARIOS[self.id].lasting
        assert case is not None
        cycles = HORIZON
        while cycles and (walked := _walked(case, cycles)) is not None:
            cycles = min(cycles - 1, walked)
        return Endurance(self.id, case.name, None if cycles == HORIZON else cycles)


@dataclass(frozen=True)
class PairTask:
    """Task to run two of the representatives, the second `APART` cycles after the first."""

    first: tuple[str, str]
    second: tuple[str, str]

    def __call__(self) -> PairVerdict:
        """Run the pair and check limits, states and the final state.

        No limit may be exceeded, and the state may not improve without the operator. The final state must be at least as severe
        as that of each fault alone.
        """
        matrix = load_matrix()
        cases = [_named(*which) for which in (self.first, self.second)]
        wanted = [
            Expectation.of(case, matrix[id_]) for case, (id_, _) in zip(cases, (self.first, self.second), strict=True)
        ]
        happens = (*cases[0].happens, *(_shifted(one, APART) for one in cases[1].happens))
        bound = max(one.reacted for one in wanted) + APART
        first, second = (f"{id_} {name}" for id_, name in (self.first, self.second))
        try:
            seen = observe(Case(f"{first} and {second}", happens), bound, recovery=False)
        except Exception as error:  # noqa: BLE001 - any exception of the stack is a finding
            return PairVerdict(first, second, "-", (_crash(error),))
        failures = [*uncontrolled(seen), *improved(seen, seen.last)]
        state, worst = seen.state(seen.last), max(one.state for one in wanted)
        if state < worst:
            failures.append(f"the final state must be at least {worst.name}, as of one fault alone, got {state.name}")
        return PairVerdict(first, second, state.name, tuple(failures))


Task = CaseTask | EnduranceTask | PairTask
Result = Verdict | Endurance | PairVerdict


def attempt(id_: str, case: Case) -> Verdict:
    """Run a case and return its verdict; a crash is a failed case.

    Args:
        id_: ID of the row of the matrix.
        case: case of its scenario.
    """
    row = load_matrix()[id_]
    wanted = Expectation.of(case, row)
    try:
        seen = observe(case, wanted.reacted, recovery=not wanted.walks_on)
    except Exception as error:  # noqa: BLE001 - any exception of the stack is a finding
        return Verdict(id_, case.name, "-", None, wanted.reacted, "", (_crash(error),))
    return judge(row, case, seen)


def plan(ids: Sequence[str], *, endurance: bool, pairs: bool) -> list[Task]:
    """Return the tasks of a campaign, the long ones first.

    Args:
        ids: IDs of the scenarios.
        endurance: whether to include endurance runs.
        pairs: whether to include the pairs of the representatives.
    """
    chosen = [SCENARIOS[id_] for id_ in ids]
    tasks: list[Task] = []
    if endurance:
        tasks += [EnduranceTask(scenario.id) for scenario in chosen if scenario.lasting is not None]
    tasks += [CaseTask(scenario.id, index) for scenario in chosen for index in range(len(scenario.cases))]
    if pairs:
        tasks += [PairTask(*pair) for pair in itertools.combinations(REPRESENTATIVES, 2)]
    return tasks


#: Lock for one run at a time, because the runs of a process share a controller and dask workers may have several threads.
_one_at_a_time = threading.Lock()


def run_task(task: Task) -> Result:
    """Run a task in a worker.

    Args:
        task: task to run.
    """
    with _one_at_a_time:
        return task()


def _walked(case: Case, cycles: int) -> int | None:
    """Run a permanent fault for `cycles`. Return the number of cycles until the walk ended, or None if it did not end."""
    lasting = replace(case, happens=tuple(_lasting(one, cycles) for one in case.happens))
    seen = observe(lasting, cycles, recovery=False)
    for cycle in range(seen.first, seen.last + 1):
        if seen.state(cycle) not in WALKING:
            return cycle - seen.first
    return None


def _named(id_: str, name: str) -> Case:
    return next(case for case in SCENARIOS[id_].cases if case.name == name)


def _lasting(one: Happening, cycles: int) -> Happening:
    """Return a permanent fault or action with its duration limited to `cycles`, and any other one unchanged."""
    if one.cycles is not None:
        return one
    if isinstance(one, Fault):
        return Fault(one.kind, one.target, one.start, cycles, **dict(one.parameters))
    return replace(one, cycles=cycles)


def _shifted(one: Happening, cycles: int) -> Happening:
    """Return the same fault or action, starting `cycles` later."""
    return one.starting(one.start + cycles) if isinstance(one, Fault) else replace(one, start=one.start + cycles)


def _crash(error: Exception) -> str:
    return f"crashed: {type(error).__name__}: {error}"
