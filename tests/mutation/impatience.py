"""A pytest plugin for mutants, so that they die soon.

A test that takes much longer than it used to fails, where mutmut would wait for minutes. And of a test with many parameters one
comes first, then another one of each: most mutants are noticed by some test, whatever its parameters.
"""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator

import pytest
from mutmut.mutation.trampoline import get_mutant_under_test
from mutmut.state import state

#: In the name of every mutant.
MUTANT = "__mutmut_"

#: CPU time [s] a test may take, and times its usual duration on top.
AT_LEAST, TIMES = 2.0, 4.0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    before: Counter[str] = Counter()
    rank = {}
    for item in items:
        name = item.nodeid.partition("[")[0]
        rank[item] = before[name]
        before[name] += 1
    items.sort(key=rank.__getitem__)


def _fail(number: int, frame: object) -> None:
    pytest.fail("runs for ever")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    usual = state().duration_by_test.get(item.nodeid)
    # Not in the run without a mutant: how long a test took is from the last run, and it may have grown since.
    if usual and MUTANT in get_mutant_under_test():
        signal.signal(signal.SIGPROF, _fail)
        signal.setitimer(signal.ITIMER_PROF, AT_LEAST + TIMES * usual)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
