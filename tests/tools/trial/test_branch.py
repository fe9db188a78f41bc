"""Branches of a run: continued copies, their answers and their ends."""

from __future__ import annotations

import os
import time

import pytest

from atalante_tools.trial.branch import Branch, Continuation, branch


def counted(until: int, at: int) -> tuple[int, Branch | None]:
    """Count to `until`, branch off at `at`, and add the request in a continued run."""
    count, added, found = 0, 0, None
    continuation = None
    while count < until:
        count += 1
        if count == at:
            one = branch()
            if isinstance(one, Continuation):
                continuation, added = one, one.request
            else:
                found = one
        count += added
    if continuation is not None:
        continuation.finish((count, os.getpid()))
    return count, found


def test_each_request_continues_the_run_from_the_branch_in_a_process_of_its_own() -> None:
    count, found = counted(10, 4)
    assert count == 10
    assert found is not None
    answers = [found.ask(step) for step in (0, 4, 0)]
    assert [count for count, _ in answers] == [10, 13, 10]
    assert len({pid for _, pid in answers} | {os.getpid()}) == 4


def test_continued_run_that_ends_without_an_answer_is_an_error() -> None:
    one = branch()
    if isinstance(one, Continuation):
        if one.request == "abandon":
            one.abandon()
        one.finish("here")
    assert isinstance(one, Branch)
    with pytest.raises(RuntimeError, match="must answer, but it ended with exit code 1"):
        one.ask("abandon")
    assert one.ask("answer") == "here"


def test_continued_run_ends_when_nobody_waits_for_its_answer() -> None:
    before = set(children())
    one = branch()
    if isinstance(one, Continuation):
        time.sleep(600.0)
        one.abandon()
    assert isinstance(one, Branch)
    (waiting,) = set(children()) - before
    one._channel.send("request")
    del one
    deadline = time.monotonic() + 60.0
    while os.waitpid(waiting, os.WNOHANG) == (0, 0):  # it first waits for the end of the continued run
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_waiting_process_ends_when_the_branch_is_dropped() -> None:
    before = set(children())
    _, found = counted(3, 2)
    assert found is not None
    (waiting,) = set(children()) - before
    del found
    deadline = time.monotonic() + 60.0
    while os.waitpid(waiting, os.WNOHANG) == (0, 0):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def children() -> list[int]:
    """Return the process IDs of the children of this process."""
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return [int(pid) for pid in file.read().split()]
