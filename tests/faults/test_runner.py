"""Tests of the runner: a walk without a fault, faults in their cycles, START of the operator, and reproducible bytes."""

from __future__ import annotations

import numpy as np

from atalante_emulator.faults import Fault
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.observation import RESTARTED
from atalante_tools.faults.runner import CONFIG, milestones, observe
from atalante_tools.faults.scenario import Case, HostFault, OperatorAction
from atalante_tools.faults.verdict import limit_violations

S = SupervisorState
KNEE = JOINTS.index("left_SK")


def test_walk_without_a_fault_stays_active_within_every_limit() -> None:
    observation = observe(Case("nothing", (), phase=0.25, observed=300), 1, recovery=False)
    assert observation.first == milestones().walk + 200
    assert (observation.over, observation.pressed, observation.last_before_start) == (
        observation.first,
        None,
        observation.last,
    )
    assert observation.last == observation.first + 300
    active = observation.states.index(S.ACTIVE) + 1
    assert active + round(CONFIG.startup * 1000) == milestones().walk
    assert set(observation.states[active - 1 :]) == {S.ACTIVE}
    assert limit_violations(observation) == []
    assert np.ptp(observation.position[observation.first - 1 :, KNEE]) > 0.2
    assert (observation.drive_state[observation.first - 1 :] == DriveState.OPERATION_ENABLED).all()
    assert observation.guide_exit[observation.first - 1 :].max() < 0.0
    assert observation.age[-1].tolist() == [0] * len(observation.messages)
    assert observation.commands.words(observation.first) == [Controlword.ENABLE_OPERATION] * 12


def test_fault_starts_in_the_first_observed_cycle_of_the_hal() -> None:
    observation = observe(Case("one frame", (Fault("drop", "LEFT_SK_STATE", 0, 2),)), 1, recovery=False)
    ages = observation.age[:, observation.messages.index("LEFT_SK_STATE")]
    assert ages[observation.first - 3 : observation.first + 3].tolist() == [0, 0, 1, 2, 0, 0]


def test_operator_stops_and_presses_start_after_the_case() -> None:
    observation = observe(Case("stop", (OperatorAction("stop", 5),)), 20)
    assert observation.states[observation.first + 3] is S.ACTIVE
    assert observation.states[observation.first + 4] is S.HOLD
    assert observation.pressed == observation.first + 20 + 60
    assert {*observation.states[observation.first + 4 : observation.last_before_start]} == {S.HOLD}
    assert [*observation.states[-RESTARTED - 1 :]] == [S.HOLD] + [S.ACTIVE] * RESTARTED
    assert limit_violations(observation) == []


def test_observation_starts_in_the_first_active_cycle_of_a_host_fault() -> None:
    observation = observe(
        Case("in reset", (HostFault("raise_in_reset", 0, 800, "ValueError"),), phase=None), 1, recovery=False
    )
    assert observation.state(observation.first) is S.ACTIVE
    assert observation.first > 1


def test_two_runs_with_the_same_seed_are_identical(robot: Robot) -> None:
    case = Case("noise", (Fault("drop", "left_leg", 0, 50, p=0.05),), seed=3)
    one, two = (observe(case, 1, recovery=False) for _ in range(2))
    for joint in range(len(JOINTS)):
        assert one.commands.torque_of(joint)[1].tobytes() == two.commands.torque_of(joint)[1].tobytes()
    assert one.position.tobytes() == two.position.tobytes()
