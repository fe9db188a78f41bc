"""Outputs of a run that need a processor core of their own, and the error of an incomplete recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from atalante_hal.telemetry.process import Recording
from atalante_tools.console.outcome import Failed
from atalante_tools.session.recording import Outputs, require_complete, telemetry_cores


@pytest.mark.parametrize(
    ("outputs", "cores"),
    [
        (None, 0),
        (Outputs(Path("recording.mcap"), 100, None, {}), 0),
        (Outputs(None, 100, Path("can.log"), {}), 1),
        (Outputs(Path("recording.mcap"), 1000, None, {}), 1),
    ],
)
def test_can_log_and_fast_recording_need_a_core_for_telemetry(outputs: Outputs | None, cores: int) -> None:
    assert telemetry_cores(outputs) == cores


@pytest.mark.parametrize(
    ("files", "missing", "sentence"),
    [
        ((), 3, "the recording is missing: no file was written"),
        (("recording.mcap",), 3, "the recording is incomplete: 3 cycles are missing in recording.mcap"),
        (
            ("recording.mcap", "recording-1.mcap"),
            0,
            "the recording must be one file, but the telemetry process was restarted and wrote several: "
            "recording.mcap, recording-1.mcap",
        ),
        (("recording.mcap",), 0, "the recording is incomplete: recording.mcap may have no index"),
    ],
)
def test_incomplete_recording_is_rejected_with_its_reason(files: tuple[str, ...], missing: int, sentence: str) -> None:
    with pytest.raises(Failed) as refusal:
        require_complete(Recording(files, complete=False, missing_cycles=missing))
    assert str(refusal.value) == sentence


def test_run_without_a_recording_or_with_a_complete_recording_is_accepted() -> None:
    require_complete(None)
    require_complete(Recording(("recording.mcap",), complete=True, missing_cycles=0))
