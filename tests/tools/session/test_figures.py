"""Figure of guide shapes: only complete steps are drawn, however the run ended."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from atalante_tools.session import figures

RIGHT, LEFT = 1, 0


def samples(*steps: tuple[int, int, float]) -> Iterator[tuple[str, Any, float, float]]:
    """Yield the guide samples of these steps (number, stance, final phase)."""
    for number, stance, end in steps:
        for phase in np.arange(0.0, end, 0.01).tolist():
            guide = SimpleNamespace(
                name=["left_SH" if stance == RIGHT else "right_SH"],
                stance=stance,
                step=number,
                phase=phase,
                error=[0.01 * number],
                desired_position=[0.0, 0.0, math.sin(phase)],
            )
            yield "pinched", guide, 0.1, 0.1


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return a function that draws a run. It returns the title of the figure, and label and final phase of each line."""
    kept: list[Any] = []
    monkeypatch.setattr(figures.plt, "close", kept.append)

    def draw(*steps: tuple[int, int, float]) -> tuple[str, list[tuple[str, float]]]:
        monkeypatch.setattr(figures, "_guide_samples", lambda _: samples(*steps))
        figures.guide_shapes(tmp_path / "recording.mcap", tmp_path / "guide_shapes.png")
        (axis,) = kept.pop().axes
        lines = [(line.get_label().lstrip("_")[:5], float(line.get_xdata()[-1])) for line in axis.lines]
        return axis.get_title(), lines

    return draw


WHOLE = pytest.approx(0.99, abs=0.011)
GUIDE = [("measu", WHOLE), ("desir", WHOLE), ("guide", WHOLE), ("child", WHOLE)]


def test_run_stopped_within_a_step_draws_the_last_complete_guide(drawn: Any) -> None:
    title, lines = drawn((0, RIGHT, 1.0), (1, LEFT, 1.0), (1, RIGHT, 1.0), (2, LEFT, 1.0), (2, RIGHT, 0.3))
    assert title == "pinched: 2 right-stance steps"
    assert lines[0][1] == WHOLE
    assert lines[1:] == GUIDE


def test_run_ended_outside_a_right_stance_step_draws_all_steps(drawn: Any) -> None:
    for ends in ([], [(2, LEFT, 0.4)]):
        title, lines = drawn((0, RIGHT, 1.0), (1, LEFT, 1.0), (1, RIGHT, 0.95), *ends)
        assert title == "pinched: 2 right-stance steps"
        assert [line[0] for line in lines] == ["child", "measu", "desir", "guide", "child"]
        assert lines[-1][1] == pytest.approx(0.95, abs=0.011)


def test_an_incomplete_step_is_drawn_if_it_is_the_only_one(drawn: Any) -> None:
    title, lines = drawn((0, RIGHT, 0.5))
    assert title == "pinched: 1 right-stance step"
    assert lines[0][1] == pytest.approx(0.49, abs=0.011)
