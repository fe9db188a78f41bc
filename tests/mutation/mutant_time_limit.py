"""Pytest plugin that shortens the test runs of mutants.

A test fails if it takes much longer than without a mutant. Without this plugin, mutmut would wait for minutes. The plugin also
sorts the tests: first one parameter set of every test, then the second parameter set of every test, and so on. Most mutants fail
with any parameters.
"""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator

import pytest
from mutmut.mutation.trampoline import get_mutant_under_test
from mutmut.state import state

#: Part of the name of every mutant.
MUTANT = "__mutmut_"

#: The time limit of a test is `CONSTANT` plus `MULTIPLE` times its usual duration [s of processor time].
CONSTANT, MULTIPLE = 2.0, 4.0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    before: Counter[str] = Counter()
    rank = {}
    for item in items:
        name = item.nodeid.partition("[")[0]
        rank[item] = before[name]
        before[name] += 1
    items.sort(key=rank.__getitem__)


def _fail(number: int, frame: object) -> None:
    pytest.fail("the test must end within its time limit")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    usual = state().duration_by_test.get(item.nodeid)
    # No time limit without a mutant: the usual duration is from an earlier run, and the test may be longer now.
    if usual and MUTANT in get_mutant_under_test():
        signal.signal(signal.SIGPROF, _fail)
        signal.setitimer(signal.ITIMER_PROF, CONSTANT + MULTIPLE * usual)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
