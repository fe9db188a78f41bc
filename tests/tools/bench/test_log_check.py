"""Benchmarks of the validator: the work is complete; no time is checked."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from atalante_tools.bench import log_check
from atalante_tools.bench.measure import BenchmarkError, Effort, Measurement


@pytest.mark.parametrize("run", [log_check.judge_log, log_check.judge_against_mdf])
def test_both_sides_are_measured(run: Callable[[Effort], Measurement]) -> None:
    measured = run(Effort(quick=True))
    assert measured.remarks == ()
    assert measured.value is not None
    assert measured.baseline is not None
    assert 0.0 < measured.value < 1.0
    assert 0.0 < measured.baseline < 1.0


def test_benchmark_rejects_a_log_with_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repetitions without continuous alive counters give findings, so the time would not be that of a valid log."""
    monkeypatch.setattr(log_check, "COUNTER_BYTE", 4)
    with pytest.raises(BenchmarkError, match="must have no findings"):
        log_check.judge_log(Effort(quick=True))


def test_full_recording_repeats_without_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """A joint that sags during the recording would jump at the repetition."""
    monkeypatch.setattr(log_check, "_REPEATED", 2)
    with log_check._log(Effort()) as (path, frames):
        assert len(frames) > 2 * log_check._CYCLES
        assert log_check._validation(path, frames)() > 0.0
