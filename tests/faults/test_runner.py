"""The runner: a walk in which nothing happens, faults in their cycles, the operator's START, and the same bytes every time."""

from __future__ import annotations

import numpy as np

from atalante_emulator.faults import Fault
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.runner import CONFIG, RESTARTED, first_walk_cycle, observe
from atalante_tools.faults.scenario import Case, HostFault, OperatorAction
from atalante_tools.faults.verdict import limit_violations

S = SupervisorState
KNEE = JOINTS.index("left_SK")


def test_a_walk_in_which_nothing_happens() -> None:
    seen = observe(Case("nothing", (), phase=0.25, observed=300), 1, recovery=False)
    assert seen.first == first_walk_cycle() + 200
    assert (seen.over, seen.pressed, seen.last_before_start) == (seen.first, None, seen.last)
    assert seen.last == seen.first + 300
    active = seen.states.index(S.ACTIVE) + 1
    assert active + round(CONFIG.startup * 1000) == first_walk_cycle()
    assert set(seen.states[active - 1 :]) == {S.ACTIVE}
    assert limit_violations(seen) == []
    assert np.ptp(seen.position[seen.first - 1 :, KNEE]) > 0.3
    assert (seen.drive_state[seen.first - 1 :] == DriveState.OPERATION_ENABLED).all()
    assert seen.guide_exit[seen.first - 1 :].max() < 0.0
    assert seen.age[-1].tolist() == [0] * len(seen.messages)
    assert seen.commands.words(seen.first) == [Controlword.ENABLE_OPERATION] * 12


def test_faults_begin_in_the_first_faulty_cycle_of_the_hal() -> None:
    seen = observe(Case("one frame", (Fault("drop", "LEFT_SK_STATE", 0, 2),)), 1, recovery=False)
    ages = seen.age[:, seen.messages.index("LEFT_SK_STATE")]
    assert ages[seen.first - 3 : seen.first + 3].tolist() == [0, 0, 1, 2, 0, 0]


def test_the_operator_does_as_told_and_starts_again_when_it_is_over() -> None:
    seen = observe(Case("stop", (OperatorAction("stop", 5),)), 20)
    assert seen.states[seen.first + 3] is S.ACTIVE
    assert seen.states[seen.first + 4] is S.HOLD
    assert seen.pressed == seen.first + 20 + 60
    assert {*seen.states[seen.first + 4 : seen.last_before_start]} == {S.HOLD}
    assert [*seen.states[-RESTARTED - 1 :]] == [S.HOLD] + [S.ACTIVE] * RESTARTED


def test_a_fault_of_the_host_is_judged_from_where_it_struck() -> None:
    seen = observe(
        Case("in reset", (HostFault("raise_in_reset", 0, 800, "ValueError"),), phase=None), 1, recovery=False
    )
    assert seen.state(seen.first) is S.ACTIVE
    assert seen.first > 1


def test_two_runs_are_the_same(robot: Robot) -> None:
    case = Case("noise", (Fault("drop", "left_leg", 0, 50, p=0.05),), seed=3)
    one, two = (observe(case, 1, recovery=False) for _ in range(2))
    for joint in range(len(JOINTS)):
        assert one.commands.torque_of(joint)[1].tobytes() == two.commands.torque_of(joint)[1].tobytes()
    assert one.position.tobytes() == two.position.tobytes()
