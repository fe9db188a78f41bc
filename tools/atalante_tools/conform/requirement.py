"""Requirements, and the examination that turns them into verdicts, one after the other on the same bench."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from atalante_tools.conform.bench import Bench, NotTested

#: Delay of a cycle [s] by which this computer, not the node, may have spoilt a test; and how often it is repeated then.
LATE: Final = 2e-3
ATTEMPTS: Final = 3


class Verdict(Enum):
    """What came of a requirement."""

    PASSED = "pass"
    FAILED = "FAIL"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class Outcome:
    """What a test found."""

    passed: bool
    measured: str  # in figures, with units


@dataclass(frozen=True)
class Requirement:
    """One line of the acceptance protocol."""

    id: str
    text: str  # what the node shall do
    how: str  # how it is tested
    source: str  # where the requirement comes from
    test: Callable[[Bench], Outcome]


@dataclass(frozen=True)
class Result:
    """A requirement and what came of it."""

    requirement: Requirement
    verdict: Verdict
    measured: str


def examine(bench: Bench, requirements: Sequence[Requirement]) -> Iterator[Result]:
    """Test one requirement after the other, in their order, which is that of the node's life."""
    for requirement in requirements:
        yield _result(bench, requirement)


def _result(bench: Bench, requirement: Requirement) -> Result:
    for _ in range(ATTEMPTS):
        bench.clock.late = 0.0
        try:
            outcome = requirement.test(bench)
        except NotTested as error:
            return Result(requirement, Verdict.NOT_TESTED, str(error))
        if outcome.passed:
            return Result(requirement, Verdict.PASSED, outcome.measured)
        if bench.clock.late < LATE:
            return Result(requirement, Verdict.FAILED, outcome.measured)
    reason = f"this computer was late by {bench.clock.late * 1e3:.1f} ms; it found: {outcome.measured}"
    return Result(requirement, Verdict.NOT_TESTED, reason)
