"""Tests of the validator benchmarks: each benchmark checks the whole log. No time is asserted."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from atalante_tools.bench import log_check
from atalante_tools.bench.measure import BenchmarkError, Effort, Measurement


@pytest.mark.sample(2)
@pytest.mark.parametrize("run", [log_check.validate_against_mdf, log_check.validate_log])
def test_benchmark_measures_value_and_baseline(run: Callable[[Effort], Measurement]) -> None:
    measured = run(Effort(quick=True))
    assert measured.remarks == ()
    assert measured.value is not None
    assert measured.baseline is not None
    assert 0.0 < measured.value < 1.0
    assert 0.0 < measured.baseline < 1.0


def test_benchmark_rejects_a_log_with_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the alive counters are not continuous, the log has findings, so the time would not be that of a valid log."""
    monkeypatch.setattr(log_check, "COUNTER_BYTE", 4)
    with pytest.raises(BenchmarkError, match="must have no findings"):
        log_check.validate_log(Effort(quick=True))


def test_full_recording_repeats_without_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a joint sagged during the recording, its position would jump at each repetition of the recording."""
    monkeypatch.setattr(log_check, "_REPEATED", 2)
    with log_check._log(Effort()) as (path, frames):
        assert len(frames) > 2 * log_check._CYCLES
        assert log_check._validation(path, frames)() > 0.0
