"""Starts of the emulated robot with and without a motor fault: the test of the directions, its end, and its report."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.direction import (
    GROUPS,
    LATENCY,
    TRAVEL,
)
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState

ROBOT = load_robot()
S, D = SupervisorState, DriveState
KNEE, ANKLE = JOINTS.index("left_SK"), JOINTS.index("left_SA")
#: Longest test of the directions if every joint passes at once [cycles].
ONCE = sum(duration + LATENCY + 1 for _, duration in GROUPS)


def start_until_the_test(rig) -> None:
    """Press START, and run until the test of the directions begins."""
    rig.operator.start()
    while not rig.hal._safety_monitor.proof.running:
        rig.run(1)


def stop_during_the_test(rig, joint: int) -> None:
    """Press START, then STOP during the test of the directions. The drive of the joint must be off, and the joint at rest."""
    start_until_the_test(rig)
    rig.run(3)
    rig.operator.stop()
    anchor = rig.emulator.body.position[joint]
    rig.run(5)
    assert rig.hal.state.drive_state[joint] == D.SWITCH_ON_DISABLED
    assert abs(rig.emulator.body.position[joint] - anchor) < TRAVEL
    rig.run(200)
    assert not rig.events_of("OVERSPEED", "HOLD_UNSTABLE")


@pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
@pytest.mark.sample(3)
def test_start_with_a_reversed_motor_fails_and_names_the_joint(make_rig, joint: int):
    rig = make_rig(starts=False)
    rig.emulator.drives.motors.set_strength(joint, -1.0)
    rig.until(S.READY)
    rig.operator.start()
    anchor, moved = rig.emulator.body.position.copy(), np.zeros(12)
    for _ in range(2 * ONCE):
        rig.run(1)
        if "START_FAILED" in rig.codes():
            break
        np.maximum(moved, np.abs(rig.emulator.body.position - anchor), out=moved)
    failed = [event for event in rig.hal.events if event.code == "START_FAILED"]
    assert len(failed) == 1
    assert failed[0].text.startswith(JOINTS[joint])
    assert ("TORQUE_DIRECTION", "error") in rig.events_of("TORQUE_DIRECTION")
    assert moved.max() < 2.0 * TRAVEL
    rig.run(20)
    assert rig.hal.state.supervisor is S.READY
    assert rig.hal.state.drive_state[joint] == D.SWITCH_ON_DISABLED
    assert D.OPERATION_ENABLED not in rig.hal.state.drive_state.tolist()
    assert not any(event.code == "ACTIVE" for event in rig.hal.events)


@pytest.mark.parametrize("joint", [3, 4, 5], ids=[JOINTS[j] for j in (3, 4, 5)])
def test_start_with_a_dead_motor_fails(make_rig, joint: int):
    rig = make_rig()
    rig.emulator.drives.motors.set_strength(joint, 0.0)
    rig.run(600)
    assert [event.text.split()[0] for event in rig.hal.events if event.code == "START_FAILED"][:1] == [JOINTS[joint]]
    assert not any(event.code == "ACTIVE" for event in rig.hal.events)


def test_report_of_the_start_has_the_inertia_of_every_joint(rig):
    rig.until(S.ACTIVE)
    (proven,) = [event for event in rig.hal.events if event.code == "DIRECTIONS_PROVEN"]
    assert all(joint in proven.text for joint in JOINTS)
    assert len(proven.text.encode()) <= 220  # bytes of the text in an event record


@pytest.mark.parametrize("late", [0, 1, 2])
def test_state_has_the_delay_that_the_start_measured(make_rig, late: int):
    rig = make_rig()
    for joint in range(len(JOINTS)):
        rig.emulator.drives.motors.delay(joint, late)
    rig.until(S.ACTIVE)
    assert rig.hal.state.delay == late


@pytest.mark.parametrize("stop", ["hold", "release", "stop"])
def test_stop_during_the_test_ends_it_in_the_same_cycle(make_rig, stop: str):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    start_until_the_test(rig)
    rig.run(10)
    assert rig.controlwords() == {Controlword.ENABLE_OPERATION}
    getattr(rig.operator, stop)()
    rig.run(2)  # the pendant answers the next SYNC
    assert rig.controlwords() == {Controlword.DISABLE_VOLTAGE}
    rig.run(100)
    assert rig.hal.state.supervisor is S.READY
    assert set(rig.hal.state.drive_state) == {D.SWITCH_ON_DISABLED}
    assert not rig.hal._safety_monitor.proof.proven.any()


@pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
@pytest.mark.sample(3)
def test_reversed_motor_does_not_hold_if_the_first_start_is_stopped(make_rig, joint: int):
    rig = make_rig(starts=False)
    rig.emulator.drives.motors.set_strength(joint, -1.0)
    rig.until(S.READY)
    stop_during_the_test(rig, joint)
    assert rig.hal.state.supervisor is S.READY


@pytest.mark.parametrize("joint", [KNEE, ANKLE], ids=["left_SK", "left_SA"])
def test_reversed_motor_does_not_hold_if_the_first_start_after_a_fault_is_stopped(make_rig, joint: int):
    rig = make_rig(starts=False)
    rig.emulator.drives.motors.set_strength(joint, -1.0)
    rig.until(S.READY)
    rig.emulator.drives.leave(7, D.FAULT)
    rig.until(S.FAULT, 5)
    rig.operator.start()
    rig.until(S.HOLD, 20)
    rig.run(50)
    assert set(rig.hal.state.drive_state) == {D.SWITCH_ON_DISABLED}
    stop_during_the_test(rig, joint)
    assert rig.hal.state.supervisor is S.HOLD
    assert set(rig.hal.state.drive_state) == {D.SWITCH_ON_DISABLED}


def test_drives_hold_if_a_start_in_hold_is_stopped(rig):
    rig.until(S.ACTIVE)
    rig.operator.stop()
    rig.until(S.HOLD, 5)
    rig.run(100)
    start_until_the_test(rig)
    rig.run(10)
    rig.operator.stop()
    rig.run(20)
    assert rig.hal.state.supervisor is S.HOLD
    assert set(rig.hal.state.drive_state) == {D.QUICK_STOP_ACTIVE}


@pytest.mark.parametrize("joint", [KNEE, 5], ids=["left_SK", "left_HA"])
def test_drive_that_failed_the_test_stays_off_if_the_next_start_is_stopped(make_rig, joint: int):
    rig = make_rig(starts=False)
    rig.emulator.drives.motors.set_strength(joint, -1.0)
    rig.until(S.READY)
    rig.operator.start()
    rig.run(160)
    assert "START_FAILED" in rig.codes()
    stop_during_the_test(rig, joint)
    assert rig.hal.state.supervisor is S.READY


@pytest.mark.parametrize("check", ["torque_tracking", "torque_motion"])
def test_drive_with_a_wrong_torque_stays_off_if_the_next_start_is_stopped(rig, monkeypatch, check: str):
    rig.until(S.ACTIVE)
    rig.run(100)
    rig.emulator.drives.motors.set_strength(KNEE, -1.0)
    monitor = rig.hal._safety_monitor
    dtc = Dtc(check.upper())
    with monkeypatch.context() as patch:
        finding = Finding(dtc, JOINT_NODES[KNEE], 0.0, True, "wrong torque")
        checks = SimpleNamespace(check=lambda *_: (finding,), restart=lambda: None)
        patch.setattr(monitor, check, checks)
        rig.until(S.LOWER, 5)
    rig.run(1500)
    rig.operator.start()
    rig.until(S.HOLD, 5)
    rig.run(100)
    stop_during_the_test(rig, KNEE)
    assert rig.hal.state.supervisor is S.HOLD


def test_further_presses_of_start_do_not_restart_the_test(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    for _ in range(40):
        rig.operator.start()
        if rig.run(5).supervisor is S.ACTIVE:
            return
    raise AssertionError("the robot must be ACTIVE although START is pressed every 5 cycles")


@pytest.mark.parametrize("held", [20, 300])
def test_restart_from_hold_tests_all_joints_again(rig, held: int):
    rig.until(S.ACTIVE)
    rig.run(600)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(held)
    rig.operator.start()
    rig.run(30)
    assert rig.hal._safety_monitor.proof.running
    rig.until(S.ACTIVE, 100)
    assert rig.hal._safety_monitor.proof.proven.all()


@pytest.mark.parametrize("held", [1, 5, 10, 15, 20, 40])
@pytest.mark.sample(3)
def test_start_in_hold_switches_off_no_drive_although_a_joint_moves(rig, held: int):
    rig.until(S.ACTIVE)
    torque = np.zeros(12)
    torque[JOINTS.index("left_SH")] = -60.0
    for _ in range(60):
        rig.cycle(torque)
    rig.operator.hold()
    rig.until(S.HOLD)
    assert np.abs(rig.hal.state.velocity).max() > 1.0
    rig.run(held)
    rig.operator.start()
    rig.run(150)
    assert not {"START_FAILED", "LOWER"} & set(rig.codes())
    if "START_REFUSED" in rig.codes():
        assert rig.hal.state.supervisor is S.HOLD
        rig.operator.start()
        rig.until(S.ACTIVE, 150)
    assert rig.hal.state.supervisor is S.ACTIVE


def test_motor_that_is_reversed_in_hold_prevents_the_restart(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(300)
    start_until_the_test(rig)
    rig.emulator.drives.motors.set_strength(KNEE, -1.0)
    rig.run(200)
    assert [e.text.split()[0] for e in rig.hal.events if e.code == "START_FAILED"] == [JOINTS[KNEE]]
    assert rig.hal.state.drive_state[KNEE] == D.SWITCH_ON_DISABLED
    assert rig.hal.state.supervisor is S.LOWER
