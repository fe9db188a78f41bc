"""The benchmark lines of the validator do their work; no figure is judged here."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from atalante_tools.bench.measure import Effort, Measurement, WorkError
from atalante_tools.validate import benchmark


@pytest.mark.parametrize("run", [benchmark.judge_log, benchmark.judge_against_mdf])
def test_both_sides_are_measured(run: Callable[[Effort], Measurement]) -> None:
    measured = run(Effort(quick=True))
    assert measured.remarks == ()
    assert measured.value is not None
    assert measured.baseline is not None
    assert 0.0 < measured.value < 1.0
    assert 0.0 < measured.baseline < 1.0


def test_a_log_that_is_not_clean_is_no_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seams without new counters would be findings: then the figures would not be those of a clean log."""
    monkeypatch.setattr(benchmark, "COUNTER_BYTE", 4)
    with pytest.raises(WorkError, match="not clean"):
        benchmark.judge_log(Effort(quick=True))


def test_a_repetition_of_the_full_length_joins_on_without_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    """A joint that has sagged since the recording began would jump back at the seam."""
    monkeypatch.setattr(benchmark, "_REPEATED", 2)
    with benchmark._log(Effort()) as (path, frames):
        assert len(frames) > 2 * benchmark._CYCLES
        assert benchmark._judging(path, frames)() > 0.0
