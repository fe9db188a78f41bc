"""Speed changes of the walking controller, on a body without a bus."""

from __future__ import annotations

import functools

import pytest

from atalante_control.dynamics.gait_network import load_network
from atalante_control.gait.subject import Subject
from atalante_control.gait.walk import WalkGaits
from atalante_control.gait_optimization.walk import solve_walk
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_control.walking.section import Section
from tests.control.walking.ideal_robot import PATIENT, ROBOT, WALK, walk_with

SHORT, LONG = (0.12, 0.9), (0.18, 0.8)  # step length [m] and step duration [s]


@functools.cache
def gaits(step: tuple[float, float]) -> WalkGaits:
    subject = Subject(PATIENT, *step)
    return solve_walk(subject, load_network().gait(subject, ROBOT))


def changing(first: tuple[float, float], second: tuple[float, float], steps: int = 4) -> WalkController:
    """Return a controller that walks `steps` steps with the first gait, then as many with the second."""
    return WalkController(ROBOT, PATIENT, gaits(first), steps, then=[Section(gaits(second), steps)])


@pytest.mark.parametrize("xi", [1.0, 0.5])
@pytest.mark.parametrize(("first", "second"), [(SHORT, LONG), (LONG, SHORT)], ids=["faster", "slower"])
@pytest.mark.long
def test_speed_changes_within_a_walk(first: tuple[float, float], second: tuple[float, float], xi: float) -> None:
    controller = changing(first, second)
    assert walk_with(controller, "mujoco", xi=xi) == list(Phase)
    statistics, guide = controller.statistics, controller.statistics.guide
    assert (controller.steps_wanted, statistics.steps) == (8, 8)
    assert controller.steering.distance == pytest.approx(4.5 * (0.12 + 0.18), abs=0.12)
    assert abs(controller.steering.lateral) < 0.05
    assert controller.max_dcm_error < 0.035
    certificates = controller.certificates(xi)
    assert len(certificates) == 2
    assert all(certificate.certified == (xi < 1.0) for certificate in certificates)
    # The first step of each leg with the second gait is fully assisted.
    guided = 0.0 if xi == 1.0 else 4 * 1000.0 * first[1] + 2 * 1000.0 * second[1]
    assert guide.cycles == pytest.approx(guided, rel=0.03)
    assert guide.inside == guide.cycles
    assert guide.hand_overs == (0 if xi == 1.0 else 4 + 2)
    assert guide.hand_overs_exceeded == 0


@pytest.mark.long
def test_stop_before_the_speed_change_is_the_stop_step_of_the_first_gait() -> None:
    distances = []
    for then in ([], [Section(gaits(SHORT), 5)]):
        controller = WalkController(ROBOT, PATIENT, WALK, 5, then=then)
        assert walk_with(controller, "mujoco", finish_after=1)[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
        assert controller.statistics.steps <= 2
        distances.append(controller.steering.distance)
    assert distances[0] == distances[1]


@pytest.mark.long
def test_second_walk_begins_with_the_first_gait_again() -> None:
    controller = changing(SHORT, LONG, steps=1)
    distances = []
    for _ in range(2):
        walk_with(controller, "mujoco")
        distances.append(controller.steering.distance)
    assert distances[0] == pytest.approx(distances[1], abs=1e-6)


def test_section_without_a_step_is_refused() -> None:
    with pytest.raises(ValueError, match="a section must have at least one step, got 0"):
        WalkController(ROBOT, PATIENT, WALK, 3, then=[Section(WALK, 0)])
