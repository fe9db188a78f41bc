"""Tasks of a campaign: single cases, endurance runs and pairs of faults.

    task -> runner -> verdict

Tasks and results are kept small, because they are sent between processes or computers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from atalante_emulator.faults import Fault
from atalante_tools.console.options import PYBULLET
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.false_alarms import Quiet, QuietTask
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.moments import MomentTask, MomentVerdict, random_pairs, single_tasks
from atalante_tools.faults.runner import observe
from atalante_tools.faults.scenario import Case, Stimulus, shifted
from atalante_tools.faults.verdict import (
    WALKING,
    Expectation,
    Verdict,
    automatic_improvements,
    evaluate,
    exception_sentence,
    limit_violations,
)

#: Longest duration of a fault in an endurance run [cycles]. It is longer than the duration of a walking step.
HORIZON: Final = 1000
#: Number of cycles between the first and the second fault of a pair.
PAIR_DELAY: Final = 3
#: Test cases for runs with two faults, as (fault ID, name of the test case). A campaign with pairs runs
#: every combination of two different test cases once.
REPRESENTATIVES: Final = (
    ("F03", "4 frames"),
    ("F04", "LEFT_SK"),
    ("F11", "several"),
    ("F13", "one leg"),
    ("F18", "restart after 2 cycles"),
    ("F25", "5 frames"),
    ("F28", "100 mrad for 100 cycles"),
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
    """Result of an endurance run: the longest fault duration that the walk survives."""

    id: str
    case: str
    survived: int | None  # longest fault duration that the walk survives [cycles]; None means at least `HORIZON`


@dataclass(frozen=True)
class PairVerdict:
    """Result of a run with two faults."""

    first: str
    second: str
    state: str  # final state of the HAL
    failures: tuple[str, ...]  # failed checks, one sentence each


@dataclass(frozen=True)
class CaseTask:
    """Task to run one case of a scenario."""

    id: str
    index: int
    engine: str = PYBULLET

    def __call__(self) -> Verdict:
        """Run the case and return the verdict."""
        return run_case(self.id, replace(SCENARIOS[self.id].cases[self.index], engine=self.engine))


@dataclass(frozen=True)
class EnduranceTask:
    """Task to measure the longest duration for which the walk survives the fault of `Scenario.permanent`."""

    id: str
    engine: str = PYBULLET

    def __call__(self) -> Endurance:
        """Repeat the case with shorter and shorter faults until the walk continues. Return the fault duration of the last run."""
        case = SCENARIOS[self.id].permanent
        assert case is not None
        case = replace(case, engine=self.engine)
        cycles = HORIZON
        while cycles and (walked := _cycles_until_stop(case, cycles)) is not None:
            cycles = min(cycles - 1, walked)
        return Endurance(self.id, case.name, None if cycles == HORIZON else cycles)


@dataclass(frozen=True)
class PairTask:
    """Task to run two cases of `REPRESENTATIVES` together. The second case begins `PAIR_DELAY` cycles after the first."""

    first: tuple[str, str]
    second: tuple[str, str]
    engine: str = PYBULLET

    def __call__(self) -> PairVerdict:
        """Run the two cases in one run and check the limits and the states of the HAL.

        No limit may be exceeded. The state must not become less severe without the operator. The final state must be at
        least as severe as the expected final state of each fault alone.
        """
        matrix = load_matrix()
        cases = [_case_of(*key) for key in (self.first, self.second)]
        expected = [
            Expectation.of(case, matrix[id_]) for case, (id_, _) in zip(cases, (self.first, self.second), strict=True)
        ]
        stimuli = (*cases[0].stimuli, *(shifted(stimulus, PAIR_DELAY) for stimulus in cases[1].stimuli))
        bound = max(one.reacted for one in expected) + PAIR_DELAY
        first, second = (f"{id_} {name}" for id_, name in (self.first, self.second))
        try:
            run = observe(Case(f"{first} and {second}", stimuli, engine=self.engine), bound, recovery=False)
        except Exception as error:  # noqa: BLE001 - any exception of the driver software is a failed check
            return PairVerdict(first, second, "-", (exception_sentence(error),))
        failures = [*limit_violations(run), *automatic_improvements(run, run.last)]
        state, worst = run.state(run.last), max(one.state for one in expected)
        if state < worst:
            failures.append(
                f"the final state must be at least {worst.name}, as after one fault alone, got {state.name}"
            )
        return PairVerdict(first, second, state.name, tuple(failures))


Task = CaseTask | EnduranceTask | PairTask | MomentTask | QuietTask
Result = Verdict | Endurance | PairVerdict | MomentVerdict | Quiet


def run_case(id_: str, case: Case) -> Verdict:
    """Run a test case and return the verdict. A test case that raises an exception has failed.

    Args:
        id_: fault ID, as in the fault matrix.
        case: case of the scenario with this fault ID.
    """
    row = load_matrix()[id_]
    expected = Expectation.of(case, row)
    try:
        run = observe(case, expected.reacted, recovery=not expected.walk_continues)
    except Exception as error:  # noqa: BLE001 - any exception of the driver software is a failed check
        return Verdict(id_, case.name, "-", None, expected.reacted, "", (exception_sentence(error),))
    return evaluate(row, case, run)


@dataclass(frozen=True)
class Scope:
    """Additional runs of a campaign, besides the cases of the fault matrix."""

    endurance: bool  # whether to run the endurance runs
    pairs: bool  # whether to run the pairs of `REPRESENTATIVES` during a walk
    moments: bool  # whether to run each case at each `Moment`
    random_pairs: int  # number of random pairs of cases that begin at random times
    seed: int  # seed of the random pairs


def plan(ids: Sequence[str], scope: Scope, engine: str = PYBULLET) -> list[Task]:
    """Return the tasks of a campaign. The long tasks come first.

    Args:
        ids: IDs of the scenarios.
        scope: further runs.
        engine: physics engine of the emulated robot.
    """
    chosen = [SCENARIOS[id_] for id_ in ids]
    tasks: list[Task] = []
    if scope.endurance:
        tasks += [EnduranceTask(scenario.id, engine) for scenario in chosen if scenario.permanent is not None]
    tasks += [CaseTask(scenario.id, index, engine) for scenario in chosen for index in range(len(scenario.cases))]
    if scope.pairs:
        tasks += [PairTask(*pair, engine) for pair in itertools.combinations(REPRESENTATIVES, 2)]
    if scope.moments:
        tasks += single_tasks(ids, engine)
    tasks += random_pairs(scope.random_pairs, scope.seed, engine)
    return tasks


def run_task(task: Task) -> Result:
    """Run a task. This function is called in a worker process.

    Args:
        task: task to run.
    """
    return task()


def _cycles_until_stop(case: Case, cycles: int) -> int | None:
    """Run a case whose permanent faults are limited to `cycles` cycles.

    Return the number of cycles until the walk stopped, or None if the walk continued.
    """
    shortened = replace(case, stimuli=tuple(limited(stimulus, cycles) for stimulus in case.stimuli))
    run = observe(shortened, cycles, recovery=False)
    for cycle in range(run.first, run.last + 1):
        if run.state(cycle) not in WALKING:
            return cycle - run.first
    return None


def _case_of(id_: str, name: str) -> Case:
    return next(case for case in SCENARIOS[id_].cases if case.name == name)


def limited(stimulus: Stimulus, cycles: int) -> Stimulus:
    """Limit a permanent fault or action to `cycles` cycles. Return any other fault or action unchanged."""
    if stimulus.cycles is not None:
        return stimulus
    if isinstance(stimulus, Fault):
        return Fault(stimulus.kind, stimulus.target, stimulus.start, cycles, **dict(stimulus.parameters))
    return replace(stimulus, cycles=cycles)
