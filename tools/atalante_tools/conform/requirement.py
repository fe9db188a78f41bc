"""Requirements, and the examination that tests them one after the other and gives each a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from atalante_tools.conform.bench import NodeTester, NotTested

#: Cycle delay [s]. After a longer delay, a failed test may be the fault of this computer, not of the node.
LATE: Final = 2e-3
#: Number of attempts for a test that fails after a longer delay.
ATTEMPTS: Final = 3


class Verdict(Enum):
    """Verdict on a requirement."""

    PASSED = "pass"
    FAILED = "FAIL"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class Outcome:
    """Outcome of one test."""

    passed: bool
    measured: str  # measured values with units


@dataclass(frozen=True)
class Requirement:
    """One line of the acceptance protocol."""

    id: str
    text: str  # required behaviour of the node
    how: str  # how it is tested
    source: str  # document the requirement comes from
    test: Callable[[NodeTester], Outcome]


@dataclass(frozen=True)
class Result:
    """Requirement with its verdict and the measured values."""

    requirement: Requirement
    verdict: Verdict
    measured: str


def examine(tester: NodeTester, requirements: Sequence[Requirement]) -> Iterator[Result]:
    """Test the requirements in their order, from start-up on, and yield each result."""
    for requirement in requirements:
        yield _result(tester, requirement)


def _result(tester: NodeTester, requirement: Requirement) -> Result:
    for _ in range(ATTEMPTS):
        tester.clock.delay = 0.0
        try:
            outcome = requirement.test(tester)
        except NotTested as error:
            return Result(requirement, Verdict.NOT_TESTED, str(error))
        if outcome.passed:
            return Result(requirement, Verdict.PASSED, outcome.measured)
        if tester.clock.delay < LATE:
            return Result(requirement, Verdict.FAILED, outcome.measured)
    reason = f"this computer was late by {tester.clock.delay * 1e3:.1f} ms; measured: {outcome.measured}"
    return Result(requirement, Verdict.NOT_TESTED, reason)
