"""Impact detection: debounced foot force, and the end of a step by time."""

from __future__ import annotations

import pytest

from atalante_control.gait.gait import step_over
from atalante_control.walking.contact import ImpactConfig, ImpactDetector, contact_force

CONFIG = ImpactConfig(impact_force=80.0, release_force=30.0, debounce=5, earliest=0.5)


def run(detector: ImpactDetector, forces: list[float], phase: float = 0.8) -> int | None:
    """Return the cycle in which the step ends, or None."""
    return next((i for i, force in enumerate(forces) if detector.update(force, phase)), None)


def test_impact_counts_after_the_debounce_time():
    assert run(ImpactDetector(CONFIG), [0.0] + [100.0] * 10) == 5


def test_short_touches_do_not_count():
    assert run(ImpactDetector(CONFIG), [0.0] + ([100.0] * 4 + [50.0]) * 10) is None


def test_foot_must_leave_the_ground_before_an_impact():
    assert run(ImpactDetector(CONFIG), [100.0] * 50) is None
    assert run(ImpactDetector(CONFIG), [100.0] * 20 + [10.0] + [100.0] * 10) == 25


def test_large_force_is_an_impact_of_a_foot_that_reports_load_in_the_air():
    """The foot reports 100 N or 1000 N in the air. Its landing is noticed after the debounce time, but not early in the step."""
    for load in (100.0, 1000.0):
        assert run(ImpactDetector(CONFIG), [2000.0] * 3 + [load] * 20 + [load + 219.0] * 20) is None
        assert run(ImpactDetector(CONFIG), [2000.0] * 3 + [load] * 20 + [load + 220.0] * 10) == 27
        assert run(ImpactDetector(CONFIG), [load] * 20 + [load + 220.0] * 50, phase=0.49) is None
        assert run(ImpactDetector(CONFIG), [load] * 50) is None


def test_impact_early_in_the_step_does_not_count():
    detector = ImpactDetector(CONFIG)
    assert run(detector, [0.0] + [100.0] * 50, phase=0.49) is None
    assert run(detector, [100.0] * 10, phase=0.51) == 4


def test_new_step_resets_the_debounce():
    detector = ImpactDetector(CONFIG)
    assert run(detector, [0.0] + [100.0] * 4) is None
    detector.start_step()
    assert run(detector, [100.0] * 50) is None


def test_force_of_nan_is_no_impact():
    assert run(ImpactDetector(CONFIG), [0.0, *[float("nan")] * 50]) is None


def test_step_is_over_after_its_duration():
    assert [step_over(k, 800) for k in (0, 799, 800, 801)] == [False, False, True, True]


@pytest.mark.parametrize(
    "bad",
    [
        {"impact_force": 20.0},
        {"release_force": -1.0},
        {"certain_rise": 79.0},
        {"debounce": 0},
        {"earliest": 1.5},
        {"impact_force": float("inf")},
    ],
)
def test_invalid_configuration_is_rejected(bad: dict[str, float]):
    with pytest.raises(ValueError, match=r"got "):
        ImpactConfig(**bad)  # type: ignore[arg-type]


def read(cells: list[float]) -> float:
    """Return the contact force for the vertical forces on the cells FL, FR, RL, RR [N]."""
    front_left, front_right, rear_left, rear_right = cells
    return contact_force(sum(cells), front_left - front_right - rear_left + rear_right)


@pytest.mark.parametrize("wrong", range(4))
@pytest.mark.parametrize(
    ("along", "across"), [(0.0, 0.0), (1.1, 2.0), (-1.1, -2.0)], ids=["middle", "front left", "rear right"]
)
def test_cell_that_reads_too_much_does_not_change_the_contact_force(along: float, across: float, wrong: int) -> None:
    for force in (0.0, 200.0, 1000.0):
        cells = [0.25 * force * (1.0 + along * x + across * y) for x in (1, -1) for y in (1, -1)]
        assert read(cells) == pytest.approx(force)
        cells[wrong] += 400.0
        assert read(cells) == pytest.approx(force)


@pytest.mark.parametrize("dead", range(4))
def test_landing_is_detected_although_one_cell_is_dead(dead: int) -> None:
    cells = [250.0] * 4
    cells[dead] = 0.0
    assert read(cells) == pytest.approx(500.0)
    assert read(cells) > ImpactConfig().impact_force
