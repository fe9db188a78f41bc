"""Trace of a walk: foot prints, and the files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from atalante_control.structured import zeros
from atalante_control.walking.phases import Phase
from atalante_control.walking.telemetry import TELEMETRY_FIELDS, Telemetry
from atalante_tools.session.walk_trace import WalkTrace, foot_prints


@pytest.fixture
def trace() -> WalkTrace:
    """Return the trace of two steps; the left foot lands first."""
    telemetry: Any = zeros(Telemetry, 1)
    values = telemetry.view(np.float64)
    trace = WalkTrace(SimpleNamespace(telemetry=values, telemetry_fields=TELEMETRY_FIELDS))  # type: ignore[arg-type]
    for cycle in range(1200):
        step, record = cycle // 400, telemetry[0]
        record.phase = Phase.STEP if step else Phase.STAND
        if step:
            left, right = 0.16 * step, 0.16 * (step - 1)
            record.feet[:] = (left if step == 1 else 0.16), 0.1, right, -0.1
            record.q_bound[:], record.error[:] = 0.1, 0.02
            record.elapsed = 1e-3 * (cycle % 400)
            record.stance = step % 2
        trace.sample(cycle)
    return trace


def test_samples_are_taken_every_ten_cycles(trace: WalkTrace) -> None:
    columns = trace.columns()
    np.testing.assert_allclose(np.diff(columns["time"]), 0.01)
    assert len(columns["time"]) == 120
    assert columns["q_des"].shape == (120, 12)
    assert columns["error"].max() == 0.02


def test_each_landing_gives_one_foot_print(trace: WalkTrace) -> None:
    prints = [(side, x, y) for side, x, y, _ in foot_prints(trace.columns())]
    assert prints == [(0, 0.16, 0.1), (1, 0.0, -0.1), (1, 0.16, -0.1)]


def test_trace_writes_samples_and_figure(trace: WalkTrace, tmp_path: Path) -> None:
    assert trace.write(tmp_path) == ["trace.npz", "walk.png"]
    with np.load(tmp_path / "trace.npz") as stored:
        np.testing.assert_array_equal(stored["lambda"], trace.columns()["lambda"])
    assert (tmp_path / "walk.png").read_bytes().startswith(b"\x89PNG")


def test_walk_that_never_began_writes_an_empty_figure(tmp_path: Path) -> None:
    controller: Any = SimpleNamespace(telemetry=np.zeros(0), telemetry_fields=TELEMETRY_FIELDS)
    assert WalkTrace(controller).write(tmp_path) == ["trace.npz", "walk.png"]
