"""A pytest plugin for mutants: a test that takes much longer than it used to fails, where mutmut would wait for minutes."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest
from mutmut.state import state

#: CPU time [s] a test may take, and times its usual duration on top.
AT_LEAST, TIMES = 2.0, 4.0


def _fail(number: int, frame: object) -> None:
    pytest.fail("runs for ever")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    if usual := state().duration_by_test.get(item.nodeid):
        signal.signal(signal.SIGPROF, _fail)
        signal.setitimer(signal.ITIMER_PROF, AT_LEAST + TIMES * usual)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
