"""Impact: debounced foot force, and the change by time."""

from __future__ import annotations

import pytest

from atalante_control.gait.gait import step_over
from atalante_control.walking.contact import ImpactConfig, ImpactDetector

CONFIG = ImpactConfig(impact_force=80.0, release_force=30.0, debounce=5, earliest=0.5)


def run(detector: ImpactDetector, forces: list[float], phase: float = 0.8) -> int | None:
    """Cycle on which the step ends."""
    return next((i for i, force in enumerate(forces) if detector.update(force, phase)), None)


def test_an_impact_counts_after_the_debounce():
    assert run(ImpactDetector(CONFIG), [0.0] + [100.0] * 10) == 5


def test_a_shorter_touch_does_not_count_and_does_not_add_up():
    assert run(ImpactDetector(CONFIG), [0.0] + ([100.0] * 4 + [50.0]) * 10) is None


def test_the_foot_has_to_leave_the_ground_first():
    assert run(ImpactDetector(CONFIG), [100.0] * 50) is None
    assert run(ImpactDetector(CONFIG), [100.0] * 20 + [10.0] + [100.0] * 10) == 25


def test_nothing_counts_early_in_the_step():
    detector = ImpactDetector(CONFIG)
    assert run(detector, [0.0] + [100.0] * 50, phase=0.49) is None
    assert run(detector, [100.0] * 10, phase=0.51) == 4


def test_a_new_step_starts_from_nothing():
    detector = ImpactDetector(CONFIG)
    assert run(detector, [0.0] + [100.0] * 4) is None
    detector.start_step()
    assert run(detector, [100.0] * 50) is None


def test_a_force_that_is_no_number_is_no_impact():
    assert run(ImpactDetector(CONFIG), [0.0, *[float("nan")] * 50]) is None


def test_step_over_by_time():
    assert [step_over(k, 800) for k in (0, 799, 800, 801)] == [False, False, True, True]


@pytest.mark.parametrize(
    "bad",
    [
        {"impact_force": 20.0},
        {"release_force": -1.0},
        {"debounce": 0},
        {"earliest": 1.5},
        {"impact_force": float("inf")},
    ],
)
def test_refuses_a_configuration_that_is_none(bad: dict[str, float]):
    with pytest.raises(ValueError, match=r"got "):
        ImpactConfig(**bad)  # type: ignore[arg-type]
