"""Requirements for a node, and `examine`, which tests each requirement and yields a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from atalante_tools.conform.node_tester import NodeTester, NotTested

#: Smallest delay of a cycle start for which this computer counts as late [s]. A test that fails while this computer is late
#: does not count and is repeated.
LATE: Final = 2e-3
#: Largest number of attempts per test. If this computer is late in every attempt and every attempt fails, the verdict is
#: "not tested".
ATTEMPTS: Final = 3
#: Standard of the counter and the CRC, for the text of the requirements.
E2E: Final = "AUTOSAR E2E Profile 5"


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
    """Required behaviour of a node, with the function that tests it."""

    id: str
    text: str  # required behaviour of the node
    how: str  # how the behaviour is tested
    source: str  # document that contains the requirement
    test: Callable[[NodeTester], Outcome]


@dataclass(frozen=True)
class Result:
    """Tested requirement with its verdict and the measured values."""

    requirement: Requirement
    verdict: Verdict
    measured: str


def examine(tester: NodeTester, requirements: Sequence[Requirement]) -> Iterator[Result]:
    """Test the requirements in the given order and yield each result."""
    for requirement in requirements:
        yield _result(tester, requirement)


def _result(tester: NodeTester, requirement: Requirement) -> Result:
    for _ in range(ATTEMPTS):
        tester.clock.delay = 0.0
        frames, cycle = tester.frame_count, tester.cycle_number
        try:
            outcome = requirement.test(tester)
        except NotTested as error:
            silence = _silence(tester, frames, cycle)
            return Result(requirement, Verdict.NOT_TESTED, silence + str(error))
        silence = _silence(tester, frames, cycle)
        measured = silence + outcome.measured
        if outcome.passed:
            # Some tests pass if a forbidden frame is absent. A node without power must not pass such a test.
            return Result(requirement, Verdict.NOT_TESTED if silence else Verdict.PASSED, measured)
        if tester.clock.delay < LATE:
            return Result(requirement, Verdict.FAILED, measured)
    reason = f"this computer was late by {tester.clock.delay * 1e3:.1f} ms; measured: {measured}"
    return Result(requirement, Verdict.NOT_TESTED, reason)


def _silence(tester: NodeTester, frames: int, cycle: int) -> str:
    """Return a remark if the test received no frame of the node, otherwise an empty text.

    A test that runs no cycles evaluates the frames received before the test. For such a test, these frames count as received.

    Args:
        tester: tester of the node.
        frames: `tester.frame_count` at the start of the test.
        cycle: `tester.cycle_number` at the start of the test.
    """
    received = tester.frame_count > frames if tester.cycle_number > cycle else tester.received
    return "" if received else f"no frame of {tester.node.name} received; "
