"""Supervision of a HAL on an embedded bus: the way from OFF to ACTIVE, and every way into a worse state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from atalante_hal.cia402 import Controlword, DriveState
from atalante_hal.diagnostics import Dtc
from atalante_hal.hal import PERIOD, SATURATED_CYCLES
from atalante_hal.limiter import Limited
from atalante_hal.supervision import ENABLE_CYCLES, FINISH_STEP_CYCLES
from atalante_hal.types import SupervisorState

S = SupervisorState


def test_nothing_starts_without_the_operator(make_rig):
    rig = make_rig(starts=False)
    state = rig.run(500)
    assert state.supervisor is S.READY
    assert (state.drive_state == DriveState.SWITCH_ON_DISABLED).all()


def test_a_start_without_dead_man_is_ignored(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    rig.operator.release()
    rig.run(20)
    rig.operator.start()
    assert rig.run(300).supervisor is S.READY


def test_the_pendant_sets_the_assistance_factor(make_rig):
    rig = make_rig(assistance_factor=0.25)
    assert rig.until(S.ACTIVE).assistance_factor == 0.25
    rig.operator.assist(0.75)
    assert rig.run(2).assistance_factor == 0.75
    rig.operator.assist(None)
    assert rig.run(2).assistance_factor == 0.75


@pytest.mark.parametrize("word", ["stop", "hold", "release"])
def test_the_operators_word_ends_in_hold_within_five_cycles(rig, word):
    rig.until(S.ACTIVE)
    getattr(rig.operator, word)()
    assert rig.run(5).supervisor is S.HOLD
    state = rig.run(5)
    assert (state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()
    assert rig.controlwords() == {Controlword.QUICK_STOP}


def test_recovery_from_hold_takes_the_operator(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    assert rig.run(500).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


def test_losing_the_pendant_is_a_stop_after_exactly_its_timeout(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(0x194)
    assert rig.run(4).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD


def test_a_drive_that_leaves_operation_is_noticed_at_once(rig):
    rig.until(S.ACTIVE)
    at = rig.emulator.signals.index("RIGHT_TH_STATE", "DriveState")
    rig.emulator.before_send.append(lambda _, values: values.__setitem__(at, DriveState.SWITCHED_ON))
    assert rig.cycle().supervisor is S.HOLD
    assert "RIGHT_TH" in rig.hal.reason


def test_a_drive_fault_is_latched_until_the_operator_starts_again(rig):
    rig.until(S.ACTIVE)
    drives = rig.emulator.drives
    drives.state[7] = DriveState.FAULT
    drives._states_changed()
    assert rig.run(2).supervisor is S.FAULT
    assert rig.run(100).supervisor is S.FAULT
    assert drives.state[7] is DriveState.FAULT
    assert set(drives.state) == {DriveState.FAULT, DriveState.QUICK_STOP_ACTIVE}
    rig.operator.start()
    assert rig.until(S.ACTIVE, 30).supervisor is S.ACTIVE
    assert [c for c in rig.codes() if c in S.__members__] == ["READY", "ACTIVE", "FAULT", "HOLD", "ACTIVE"]


def test_nodes_that_speak_another_dbc_keep_the_robot_out_of_ready(make_rig, network):
    rig = make_rig(hal_network=replace(network, hash32=network.hash32 ^ 1))
    assert rig.run(400).supervisor is S.OFF
    assert set(rig.hal.missing()) == {n.name for n in network.nodes if n.kind != "master"}


def set_signal(rig, message: str, signal: str, value: float):
    """Let a node say something else from now on."""
    at = rig.emulator.signals.index(message, signal)
    rig.emulator.before_send.append(lambda _, values: values.__setitem__(at, value))


def test_a_torque_that_is_cut_for_long_leads_the_assistance_factor_to_one(make_rig):
    rig = make_rig(assistance_factor=0.5)
    rig.until(S.ACTIVE)
    limiter, hal = rig.hal._limiter, rig.hal
    limiter.saturated = 0
    apply, cut = limiter.apply, Limited(finite=True, clamped=True)

    def cut_a_little(torque, motion):
        before = limiter.saturated
        apply(torque, motion)
        limiter.saturated = before + 1
        return cut

    limiter.apply = cut_a_little
    assert rig.walk(SATURATED_CYCLES + 1).supervisor is S.ACTIVE
    assert rig.seen("TORQUE_SATURATED") == [("TORQUE_SATURATED", "warning")] * 2  # pending, then confirmed
    assert rig.cycle().supervisor is S.FULL_ASSIST
    assert hal.reason == "the limiter cuts the torque"


def into_full_assist(rig):
    rig.until(S.ACTIVE)
    rig.hal._supervision.report(Dtc.FOOT_CELL, "a cell is stuck")
    state = rig.walk(1)
    assert state.supervisor is S.FULL_ASSIST
    return state


def test_full_assist_ramps_in_its_time_and_the_operator_ramps_back(make_rig):
    rig = make_rig(assistance_factor=0.5)
    state = into_full_assist(rig)
    ramp = rig.hal.robot.thresholds.full_assist_ramp
    cycles = round(ramp / PERIOD / 2)
    assert state.assistance_factor == pytest.approx(0.501)
    before = state.assistance_factor
    for _ in range(cycles - 1):
        state = rig.walk(1)
        assert 0.0 < state.assistance_factor - before <= PERIOD / ramp + 1e-12
        before = state.assistance_factor
    assert state.assistance_factor == 1.0
    assert rig.hal.record[rig.hal.layout["assistance_factor"]] == 1.0
    assert rig.walk(10).assistance_factor == 1.0
    rig.operator.start()
    assert rig.walk(2).supervisor is S.ACTIVE
    assert 0.99 < rig.hal.state.assistance_factor < 1.0
    assert rig.walk(cycles).assistance_factor == 0.5
    rig.operator.assist(0.2)
    assert rig.walk(2).assistance_factor == 0.2  # the dial acts at once


def test_the_dial_does_not_widen_the_guide_in_full_assist(make_rig):
    rig = make_rig(assistance_factor=0.9)
    into_full_assist(rig)
    rig.walk(150)
    rig.operator.assist(0.1)
    assert rig.walk(5).assistance_factor == 1.0


def finishing(rig, step: int | None):
    rig.until(S.ACTIVE)
    rig.walk(5, step=step)
    rig.hal._supervision.report(Dtc.SUPPLY_LOW, "the battery is nearly empty")
    return rig.walk(1, step=step)


def test_finish_step_ends_in_hold_when_the_feet_change(rig):
    assert finishing(rig, 7).supervisor is S.FINISH_STEP
    assert rig.walk(100, step=7).supervisor is S.FINISH_STEP
    rig.hal.read()
    rig.hal.write(rig.hold_torque(step=8))
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_of_a_controller_that_does_not_walk_is_hold(rig):
    assert finishing(rig, None).supervisor is S.FINISH_STEP
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_does_not_go_on_for_ever(rig):
    finishing(rig, 7)
    assert rig.walk(FINISH_STEP_CYCLES - 1, step=7).supervisor is S.FINISH_STEP
    assert rig.walk(1, step=7).supervisor is S.HOLD


def test_a_joint_that_cannot_hold_is_let_down_and_the_others_hold(rig):
    rig.until(S.ACTIVE)
    rig.hal._supervision._heartbeats.emergencies["LEFT_SK"] = Dtc.EMCY_ENCODER, 0x7305
    rig.hal._supervision._heartbeats.quiet = False
    rig.hal._supervision._steady = False
    assert rig.cycle().supervisor is S.LOWER
    commands = rig.last_commands()
    words = {f"{side}_{k}": v for side, c in commands.items() for k, v in c.items() if k.endswith("Controlword")}
    assert words.pop("left_SK_Controlword") == Controlword.DISABLE_VOLTAGE
    assert set(words.values()) == {Controlword.QUICK_STOP}
    state = rig.run(50)
    assert state.supervisor is S.LOWER
    assert state.drive_state[3] == DriveState.SWITCH_ON_DISABLED
    assert (np.delete(state.drive_state, 3) == DriveState.QUICK_STOP_ACTIVE).all()
    rig.operator.start()
    assert rig.until(S.ACTIVE, 50).supervisor is S.ACTIVE
    assert [c for c in rig.codes() if c in S.__members__][-3:] == ["LOWER", "HOLD", "ACTIVE"]


def test_a_start_the_drives_do_not_follow_is_given_up_and_said(rig):
    rig.operator._starts = False
    rig.until(S.READY)
    set_signal(rig, "LEFT_SK_STATE", "DriveState", DriveState.SWITCH_ON_DISABLED)
    rig.operator.start()
    rig.run(ENABLE_CYCLES)
    assert "START_FAILED" not in rig.codes()
    rig.run(3)
    assert "START_FAILED" in rig.codes()
    assert rig.hal.reason == "the drives were not enabled within 200 cycles"
    assert rig.controlwords() == {Controlword.QUICK_STOP}


def test_a_start_ends_when_the_dead_man_is_released(rig):
    rig.operator._starts = False
    rig.until(S.READY)
    set_signal(rig, "LEFT_SK_STATE", "DriveState", DriveState.SWITCH_ON_DISABLED)
    rig.operator.start()
    rig.run(10)
    assert Controlword.SHUTDOWN in rig.controlwords()
    rig.operator.release()
    rig.run(3)
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    rig.operator.squeeze()
    rig.run(ENABLE_CYCLES)
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    assert "START_FAILED" not in rig.codes()


def test_a_change_of_state_says_why(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD, 5)
    assert rig.hal.events[-1].text == "ACTIVE -> HOLD: the operator asked to stop"
    assert rig.hal.reason == "the operator asked to stop"


def own_frame(frames):
    alien = frames[:1].copy()
    alien["can_id"] = 0x100
    return np.concatenate([frames, alien])


def test_another_hal_ends_a_running_one_in_hold_and_keeps_a_new_one_off(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = own_frame
    assert rig.cycle().supervisor is S.HOLD
    assert rig.seen("HAL_DUPLICATE") == [("HAL_DUPLICATE", "error")]
    new = make_rig()
    new.bus.to_hal = own_frame
    new.cycle()
    new.bus.to_hal = lambda frames: frames
    assert new.run(500).supervisor is S.OFF
    assert "another HAL was there first" in new.hal._supervision.memory.text_of(frozenset({Dtc.HAL_DUPLICATE})) or (
        "HAL_DUPLICATE" in new.codes()
    )


def hot(rig, **degrees: float):
    for node, value in degrees.items():
        set_signal(rig, f"{node}_STATE", "Temperature", value)


def test_the_torque_limit_of_a_hot_drive_follows_within_a_cycle_and_is_told(rig):
    rig.until(S.ACTIVE)
    hot(rig, LEFT_SK=100.0, RIGHT_SK=100.0)
    assert rig.cycle().supervisor is S.ACTIVE
    limit = rig.hal.robot.torque_limit(rig.hal.state.temperature)
    assert limit[3] < rig.hal.robot.torque_max[3]
    commands = rig.last_commands()
    assert commands["left"]["SK_MaxTorque"] == pytest.approx(limit[3], abs=0.0125)
    assert commands["right"]["SH_MaxTorque"] == pytest.approx(rig.hal.robot.torque_max[8], abs=0.0125)
    told = {e.node: e for e in rig.hal.events if e.code == "DERATED"}
    assert set(told) == {"LEFT_SK", "RIGHT_SK"}
    assert told["LEFT_SK"].value == pytest.approx(limit[3])
    assert told["LEFT_SK"].severity == "warning"
    assert rig.run(20).supervisor is S.ACTIVE


@pytest.mark.parametrize("node", ["LEFT_SK", "RIGHT_SK"])
def test_a_drive_far_hotter_than_its_twin_holds_the_robot(rig, node):
    rig.until(S.ACTIVE)
    hot(rig, **{node: 115.0})
    assert rig.cycle().supervisor is S.HOLD
    assert node in rig.hal.reason


def test_a_heartbeat_that_fails_to_come_is_noticed_while_all_else_is_well(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(0x704)
    assert rig.run(360).supervisor is S.ACTIVE
    assert rig.seen("HEARTBEAT_LOST") == [("HEARTBEAT_LOST", "warning")]
