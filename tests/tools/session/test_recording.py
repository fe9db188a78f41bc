"""Outputs of a run that need a processor core of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from atalante_tools.session.recording import Outputs, telemetry_cores


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
