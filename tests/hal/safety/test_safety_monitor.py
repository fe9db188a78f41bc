"""Safety monitor of a HAL on an embedded bus: the start, and every transition to a safer state."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from atalante_dbc import Message, load
from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import FOOT_NODES
from atalante_hal.hal import BRIDGED_ERRORS, SATURATED_CYCLES
from atalante_hal.robot import CELLS, IMUS, JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.direction import DirectionProof
from atalante_hal.safety.hold_stability import REVERSALS
from atalante_hal.safety.limiter import Limited, Limiter
from atalante_hal.safety.safety_monitor import FINISH_STEP_CYCLES, RECALL_CYCLES
from atalante_hal.safety.start import ENABLE_CYCLES, STALLED_CYCLES, WALK_ENDS, stop_text
from atalante_hal.safety.torque_tracking import CONFIRM, SPAN
from atalante_hal.types import PERIOD, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import TransmitImage

S = SupervisorState
KNEE = JOINTS.index("left_SK")


def test_robot_stays_ready_without_a_start_press(make_rig):
    rig = make_rig(starts=False)
    state = rig.run(500)
    assert state.supervisor is S.READY
    assert (state.drive_state == DriveState.SWITCH_ON_DISABLED).all()


def test_start_without_dead_man_is_ignored(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    rig.operator.release()
    rig.run(20)
    rig.operator.start()
    assert rig.run(300).supervisor is S.READY


def test_start_without_dead_man_enables_no_drive(rig):
    rig.until(S.ACTIVE)
    rig.operator.release()
    rig.until(S.HOLD)
    rig.run(10)
    rig.operator.start()
    for _ in range(5):
        rig.cycle()
        assert rig.controlwords() == {Controlword.QUICK_STOP}


def test_start_of_a_second_sender_is_ignored_if_the_next_frame_is_missing(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.operator.start()
    rig.operator.release()
    rig.run(300)
    rig.operator.squeeze()
    rig.run(20)
    assert rig.hal.state.supervisor is S.HOLD
    second = TransmitImage([load().message("PENDANT_STATE")])
    index = second.codec.index("PENDANT_STATE", "DeadMan")
    second.values[index : index + 3] = 1, 1, 77  # dead-man, START, RequestCounter

    def before_the_pendant(frames: Frames) -> Frames:
        rogue = second.seal(rig.hal.state.cycle & 0xFF)
        return np.concatenate([rogue, frames])

    rig.bus.to_hal = before_the_pendant
    rig.cycle()
    rig.bus.to_hal = rig.drop(load().message("PENDANT_STATE").frame_id)
    rig.cycle()
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(20).supervisor is S.HOLD


def test_state_names_the_implausible_imus_until_their_readings_are_plausible_again(rig):
    rig.emulator.inject([Fault("imu_inverted", "IMU_PELVIS", 0, 300, axis="Z")])
    assert rig.run(60).implausible_imus == frozenset()
    assert rig.run(240).implausible_imus == {IMUS.index("pelvis")}
    assert rig.run(2500).implausible_imus == frozenset()


def test_imu_of_the_trunk_is_not_implausible_because_it_cannot_be_compared_with_the_other_one(rig):
    rig.until(S.ACTIVE)
    rig.emulator.inject([Fault("imu_invalid", "IMU_PELVIS")])
    assert rig.run(200).implausible_imus == frozenset()
    assert "IMU_IMPLAUSIBLE" in rig.codes()


def test_pendant_sets_the_assistance_factor(make_rig):
    rig = make_rig(assistance_factor=0.25)
    assert rig.until(S.ACTIVE).assistance_factor == 0.25
    rig.operator.assist(0.75)
    assert rig.run(2).assistance_factor == 0.75
    rig.operator.assist(None)
    assert rig.run(2).assistance_factor == 0.75


@pytest.mark.parametrize("word", ["stop", "hold", "release"])
def test_stop_hold_or_release_leads_to_hold_within_five_cycles(rig, word):
    rig.until(S.ACTIVE)
    getattr(rig.operator, word)()
    assert rig.run(5).supervisor is S.HOLD
    state = rig.run(5)
    assert (state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()
    assert rig.controlwords() == {Controlword.QUICK_STOP}


def test_recovery_from_hold_requires_start(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    assert rig.run(500).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


def test_start_with_enabled_drives_continues_from_their_torque(make_rig):
    rig = make_rig(starts=False)
    signals = rig.emulator.signals

    def enabled(_: int, values: np.ndarray) -> None:
        values[signals.slice("DriveState")] = DriveState.OPERATION_ENABLED
        values[signals.slice("Torque")] = 50.0

    rig.emulator.before_send.append(enabled)
    rig.until(S.READY)
    # The drives are off, so they cannot move their joints.
    rig.hal._safety_monitor.proof = DirectionProof(rig.hal.robot, ())
    rig.operator.start()
    rig.until(S.ACTIVE, 10 + RECALL_CYCLES)
    first = [v for c in rig.last_commands().values() for k, v in c.items() if k.endswith("TargetTorque")]
    lowest = 50.0 - rig.hal.robot.torque_rate_max * PERIOD
    assert (np.array(first) >= lowest - 0.1).all()


@pytest.mark.parametrize("cycles", [0, 1, 2])
def test_end_of_the_program_during_a_start_enables_no_drive(rig, cycles):
    while not rig.hal.conditions.start_wanted:
        rig.cycle()
    for _ in range(cycles):
        rig.cycle()
    rig.hal.end()
    rig.cycle()
    assert not rig.hal.conditions.start_wanted
    enabled = set()
    for _ in range(20):
        rig.operator.start()
        rig.cycle()
        enabled.update(rig.emulator.drives.state)
    assert rig.hal.state.supervisor is S.READY
    assert DriveState.OPERATION_ENABLED not in enabled


def test_pendant_loss_leads_to_hold_exactly_at_its_timeout(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(0x194)
    assert rig.run(4).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD


def test_drive_that_leaves_operation_leads_to_hold_in_one_cycle(rig):
    rig.until(S.ACTIVE)
    at = rig.emulator.signals.index("RIGHT_TH_STATE", "DriveState")
    rig.emulator.before_send.append(lambda _, values: values.__setitem__(at, DriveState.SWITCHED_ON))
    assert rig.cycle().supervisor is S.HOLD
    assert "RIGHT_TH" in rig.hal.reason


def test_start_in_hold_resets_a_drive_in_fault(rig):
    rig.until(S.ACTIVE)
    drives = rig.emulator.drives
    drives.supply(KNEE, 10.0)  # the power stage switches off, and the emergency of a voltage leads to HOLD
    rig.until(S.HOLD, 10)
    drives.leave(KNEE, DriveState.FAULT)
    drives.supply(KNEE, 48.0)
    rig.run(20)
    assert drives.state[KNEE] is DriveState.FAULT
    rig.operator.start()
    rig.until(S.ACTIVE, 150)


def test_drive_fault_is_latched_until_start(rig):
    rig.until(S.ACTIVE)
    drives = rig.emulator.drives
    drives.leave(7, DriveState.FAULT)
    assert rig.run(2).supervisor is S.FAULT
    assert rig.run(100).supervisor is S.FAULT
    assert drives.state[7] is DriveState.FAULT
    assert set(drives.state) == {DriveState.FAULT, DriveState.QUICK_STOP_ACTIVE}
    rig.operator.start()
    rig.until(S.HOLD, 30)
    assert rig.run(300).supervisor is S.HOLD  # one press leads to one change of state
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE
    assert [c for c in rig.codes() if c in S.__members__] == ["READY", "ACTIVE", "FAULT", "HOLD", "ACTIVE"]


def test_nodes_with_another_dbc_prevent_ready(make_rig, network):
    rig = make_rig(hal_network=replace(network, hash32=network.hash32 ^ 1))
    assert rig.run(400).supervisor is S.OFF
    assert set(rig.hal.missing()) == {n.name for n in network.nodes if n.kind != "master"}


def set_signal(rig, message: str, signal: str, value: float):
    """Replace a signal in all further frames of a node."""
    at = rig.emulator.signals.index(message, signal)
    rig.emulator.before_send.append(lambda _, values: values.__setitem__(at, value))


def test_long_torque_saturation_leads_to_full_assist(make_rig, monkeypatch):
    rig = make_rig(assistance_factor=0.5)
    rig.until(S.ACTIVE)
    apply, cut, cycles = Limiter.apply, Limited(finite=True, clamped=True), itertools.count(1)

    def cut_a_little(limiter, torque, motion):
        apply(limiter, torque, motion)
        limiter.saturated = next(cycles)
        return cut

    monkeypatch.setattr(Limiter, "apply", cut_a_little)
    assert rig.walk(SATURATED_CYCLES + 1).supervisor is S.ACTIVE
    assert rig.events_of("TORQUE_SATURATED") == [("TORQUE_SATURATED", "warning")] * 2  # pending, then confirmed
    assert rig.cycle().supervisor is S.FULL_ASSIST
    assert rig.hal.reason == "the limiter cuts the torque"


def into_full_assist(rig):
    rig.until(S.ACTIVE)
    rig.hal.report(Dtc.FOOT_CELL, "a cell is stuck")
    state = rig.walk(1)
    assert state.supervisor is S.FULL_ASSIST
    return state


def test_full_assist_ramps_up_and_start_ramps_back(make_rig):
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
    assert rig.walk(2).assistance_factor == 0.2  # without a ramp


def test_dial_has_no_effect_in_full_assist(make_rig):
    rig = make_rig(assistance_factor=0.9)
    into_full_assist(rig)
    rig.walk(150)
    rig.operator.assist(0.1)
    assert rig.walk(5).assistance_factor == 1.0


def finishing(rig, step: int | None):
    rig.until(S.ACTIVE)
    rig.walk(5, step=step)
    rig.hal.report(Dtc.SUPPLY_LOW, "the battery is nearly empty")
    return rig.walk(1, step=step)


def test_finish_step_ends_in_hold_at_the_step_change(rig):
    assert finishing(rig, 7).supervisor is S.FINISH_STEP
    assert rig.walk(100, step=7).supervisor is S.FINISH_STEP
    rig.hal.read()
    rig.hal.write(rig.hold_torque(step=8))
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_without_steps_leads_to_hold(rig):
    assert finishing(rig, None).supervisor is S.FINISH_STEP
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_times_out_in_hold(rig):
    finishing(rig, 7)
    assert rig.walk(FINISH_STEP_CYCLES - 1, step=7).supervisor is S.FINISH_STEP
    assert rig.walk(1, step=7).supervisor is S.HOLD


def walking_on_the_ground(rig):
    rig.until(S.ACTIVE)
    return rig.walk(5, step=7, walking=True)


@pytest.mark.parametrize("action", ["stop", "release"])
def test_stop_while_walking_on_the_ground_ends_the_walk_before_hold(rig, action: str):
    walking_on_the_ground(rig)
    getattr(rig.operator, action)()
    assert rig.walk(2, step=7, walking=True).supervisor is S.FINISH_STEP
    reason = stop_text(action == "stop") + WALK_ENDS
    assert rig.hal.reason == reason
    assert [event.text for event in rig.hal.events][-1] == f"ACTIVE -> FINISH_STEP: {reason}"
    assert rig.walk(1000, step=7, walking=True).supervisor is S.FINISH_STEP
    assert rig.walk(2, step=8).supervisor is S.HOLD
    assert "OPERATOR_STOP" in rig.codes()  # the action lasts until the walk is over


def test_stop_while_walking_on_the_ground_has_a_time_limit(rig):
    walking_on_the_ground(rig)
    rig.operator.stop()
    assert rig.walk(FINISH_STEP_CYCLES, step=7, walking=True).supervisor is S.FINISH_STEP
    assert rig.walk(3, step=7, walking=True).supervisor is S.HOLD


@pytest.mark.parametrize(
    ("imus", "expected"), [(("TORSO", "PELVIS"), S.FINISH_STEP), (("PELVIS", "LEFT_TIBIA"), S.FULL_ASSIST)]
)
@pytest.mark.parametrize(("kind", "cycles"), [("imu_invalid", 15), ("imu_saturated", 15), ("imu_frozen", 130)])
def test_rejected_values_of_both_trunk_imus_end_a_walk_on_the_ground(
    rig, kind: str, cycles: int, imus: tuple[str, ...], expected: S
):
    walking_on_the_ground(rig)
    rig.emulator.inject([Fault(kind, f"IMU_{imu}") for imu in imus])
    assert rig.walk(cycles, step=7, walking=True).supervisor is expected
    assert rig.walk(3, step=8, walking=True).supervisor is (S.HOLD if expected is S.FINISH_STEP else expected)


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ({"TORSO": "imu_invalid", "PELVIS": "imu_inverted"}, S.FINISH_STEP),
        ({"PELVIS": "imu_frozen", "TORSO": "imu_inverted"}, S.FINISH_STEP),
        ({"PELVIS": "imu_inverted", "TORSO": "imu_inverted"}, S.FINISH_STEP),
        ({"PELVIS": "imu_invalid", "LEFT_TIBIA": "imu_inverted"}, S.FULL_ASSIST),
    ],
)
def test_implausible_trunk_imu_without_the_other_one_ends_a_walk_on_the_ground(rig, kinds: dict[str, str], expected: S):
    """The accelerometer has the wrong sign along the vertical."""
    walking_on_the_ground(rig)
    axis = {"imu_inverted": {"axis": "Z"}}
    rig.emulator.inject([Fault(kind, f"IMU_{imu}", **axis.get(kind, {})) for imu, kind in kinds.items()])
    assert rig.walk(1100, step=7, walking=True).supervisor is expected
    assert rig.walk(3, step=8, walking=True).supervisor is (S.HOLD if expected is S.FINISH_STEP else expected)


@pytest.mark.parametrize("turn", [8, 24], ids=["left leg", "right leg"])
def test_values_in_the_cycle_of_the_boot_up_message_of_an_imu_may_have_another_heading(make_rig, turn: int):
    """In this cycle, a leg is checked. The schedule of the checks repeats every 32 cycles."""
    rig = make_rig(starts=False)
    boot = 32 * 12 + turn + 1
    rig.emulator.inject(
        [
            Fault("drop", "IMU_PELVIS_STATE", start=boot - 202, cycles=200),
            Fault("imu_turned", "IMU_PELVIS", start=boot - 3, axis="Z", degrees=40.0),
        ]
    )
    rig.run(boot - 1)
    row = rig.hal.state.imu_rows[IMUS.index("pelvis")]
    assert rig.hal.state.age[row] > 200
    rig.emulator._heartbeats.boot("IMU_PELVIS", rig.emulator.cycle)
    rig.run(1)
    assert rig.hal.state.age[row] == 0
    rig.run(300)
    assert "NODE_RESET" in rig.codes()
    assert "ENC_DRIFT" not in rig.codes()


def test_rejected_values_of_both_trunk_imus_lead_to_full_assistance_in_the_air(rig):
    rig.until(S.ACTIVE)
    rig.emulator.inject([Fault("imu_invalid", "IMU_TORSO"), Fault("imu_invalid", "IMU_PELVIS")])
    assert rig.walk(15, step=7).supervisor is S.FULL_ASSIST


def test_hold_request_while_walking_leads_directly_to_hold(rig):
    walking_on_the_ground(rig)
    rig.operator.stop()
    assert rig.walk(5, step=7, walking=True).supervisor is S.FINISH_STEP
    rig.operator.hold()
    assert rig.walk(2, step=7, walking=True).supervisor is S.HOLD


def test_silent_imu_ends_a_walk_on_both_feet(rig):
    walking_on_the_ground(rig)
    rig.bus.to_hal = rig.drop(load().message("IMU_PELVIS_STATE").frame_id)
    assert rig.walk(20, step=7, walking=True).supervisor is S.FINISH_STEP
    assert rig.walk(2, step=8).supervisor is S.HOLD
    assert "NODE_TIMEOUT" in rig.codes()


def test_invalid_codes_of_both_feet_end_a_walk_on_both_feet(rig):
    walking_on_the_ground(rig)
    invalid = {f"{cell}_ForceZ": -32768 for cell in CELLS}
    rig.emulator.inject([Fault("raw", f"{foot}_STATE", **invalid) for foot in FOOT_NODES])
    assert rig.walk(9, step=7, walking=True).supervisor is S.ACTIVE
    state = rig.walk(1, step=7, walking=True)
    assert state.supervisor is S.FINISH_STEP
    assert (state.age[list(state.foot_rows)] == 10).all()
    assert rig.events_of("SIGNAL_RANGE") == 2 * [("SIGNAL_RANGE", "warning")] + 2 * [("SIGNAL_RANGE", "error")]
    assert rig.walk(2, step=8).supervisor is S.HOLD
    assert "NODE_TIMEOUT" not in rig.codes()


@pytest.mark.parametrize("drive", ["LEFT_SK", "RIGHT_SK"])
def test_silent_drive_ends_a_walk_and_after_ten_cycles_the_motion(rig, drive: str):
    walking_on_the_ground(rig)
    rig.bus.to_hal = rig.drop(load().message(f"{drive}_STATE").frame_id)
    states = [rig.walk(1, step=7, walking=True).supervisor for _ in range(10)]
    assert states == [S.ACTIVE] * 7 + [S.FINISH_STEP] * 2 + [S.HOLD]


def test_five_consecutive_exceptions_of_write_in_a_walk_lead_to_hold(rig):
    walking_on_the_ground(rig)
    rig.walk(1, step=7, walking=True)
    for number in range(BRIDGED_ERRORS + 1):
        rig.hal.read()
        wrong = replace(rig.hold_torque(step=7, walking=True), vibration=np.zeros(3))
        with pytest.raises(ValueError, match="the vibration must have shape") as mistake:
            rig.hal.write(wrong)
        rig.hal.fail(mistake.value)
        last = number == BRIDGED_ERRORS
        assert rig.controlwords() == {Controlword.QUICK_STOP if last else Controlword.ENABLE_OPERATION}
    assert rig.hal.read().supervisor is S.HOLD
    assert "CONTROLLER_LOST" in rig.codes()


def test_exception_of_the_controller_in_a_walk_is_bridged_with_the_last_torques(rig):
    walking_on_the_ground(rig)
    rig.hal.read()
    sent = rig.hal.write(rig.hold_torque(step=7, walking=True)).copy()
    for number in range(BRIDGED_ERRORS):
        assert rig.hal.read().supervisor is (S.FINISH_STEP if number else S.ACTIVE)
        assert rig.hal.fail(ValueError("input")).tolist() == sent.tolist()
        assert rig.controlwords() == {Controlword.ENABLE_OPERATION}
    assert "CONTROLLER_LOST" not in rig.codes()
    assert rig.walk(1, step=7, walking=True).supervisor is S.FINISH_STEP
    for _ in range(BRIDGED_ERRORS):
        rig.hal.read()
        rig.hal.fail(ValueError("input"))
    rig.hal.read()
    assert not rig.hal.fail(ValueError("input")).any()
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    assert rig.hal.read().supervisor is S.HOLD
    assert "CONTROLLER_LOST" in rig.codes()


def test_exceptions_of_several_runs_are_not_counted_as_consecutive(rig):
    for _ in range(BRIDGED_ERRORS + 1):
        rig.until(S.ACTIVE)
        rig.hal.read()
        assert not rig.hal.fail(ValueError("input")).any()
        rig.until(S.HOLD)
        rig.operator.start()
    assert "CONTROLLER_LOST" not in rig.codes()


def test_end_of_the_program_while_walking_leads_directly_to_hold(rig):
    walking_on_the_ground(rig)
    rig.hal.end()
    assert rig.walk(1, step=7, walking=True).supervisor is S.HOLD


def test_walk_of_the_last_run_has_no_effect_on_the_next_start(rig):
    walking_on_the_ground(rig)
    rig.operator.hold()
    assert rig.walk(2, step=7, walking=True).supervisor is S.HOLD
    assert not rig.hal.conditions.walk_end_requested
    rig.operator.stop()
    assert rig.walk(2, step=7, walking=False).supervisor is S.HOLD
    assert not rig.hal.conditions.walk_end_requested


def with_encoder_fault():
    """Add an emergency of the left knee drive to the frames for the HAL."""
    emergency = TransmitImage([load().message("LEFT_SK_EMCY")])
    emergency.values[:] = 0.0
    emergency.values[emergency.codec.index("LEFT_SK_EMCY", "ErrorCode")] = 0x7305
    return lambda frames: np.concatenate([frames, emergency.seal()])


def test_joint_that_cannot_hold_is_lowered_and_the_others_hold(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = with_encoder_fault()
    assert rig.cycle().supervisor is S.LOWER
    rig.bus.to_hal = lambda frames: frames
    commands = rig.last_commands()
    words = {f"{side}_{k}": v for side, c in commands.items() for k, v in c.items() if k.endswith("Controlword")}
    assert words.pop("left_SK_Controlword") == Controlword.DISABLE_VOLTAGE
    assert set(words.values()) == {Controlword.QUICK_STOP}
    state = rig.run(50)
    assert state.supervisor is S.LOWER
    assert state.drive_state[3] == DriveState.SWITCH_ON_DISABLED
    assert (np.delete(state.drive_state, 3) == DriveState.QUICK_STOP_ACTIVE).all()
    rig.operator.start()
    rig.until(S.HOLD, 5)
    assert rig.run(300).supervisor is S.HOLD  # one press leads to one change of state
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE
    assert [c for c in rig.codes() if c in S.__members__][-3:] == ["LOWER", "HOLD", "ACTIVE"]


def shake(rig, joint="LEFT_SK"):
    """Let the state frames of a drive report a velocity that reverses every five cycles, until the drive is off."""
    signals = rig.emulator.signals
    velocity, drive = (signals.index(f"{joint}_STATE", name) for name in ("Velocity", "DriveState"))

    def report(cycle: int, values: np.ndarray) -> None:
        if values[drive] in (DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED):
            values[velocity] = 60.0 * (-1) ** (cycle // 5)

    rig.emulator.before_send.append(report)


def test_joint_that_oscillates_in_hold_is_lowered_until_the_next_start(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(10)
    shake(rig)
    rig.run(6 * REVERSALS)
    assert rig.hal.state.supervisor is S.LOWER
    assert "left_SK oscillates although its drive holds it" in rig.hal.reason
    state = rig.run(50)
    assert state.drive_state[KNEE] == DriveState.SWITCH_ON_DISABLED
    assert (np.delete(state.drive_state, KNEE) == DriveState.QUICK_STOP_ACTIVE).all()
    assert rig.codes().count("HOLD_UNSTABLE") == 1
    rig.operator.start()
    rig.until(S.HOLD, 5)
    state = rig.run(6 * REVERSALS)  # the drive stays off until the START that enables all drives
    assert (state.supervisor, state.drive_state[KNEE]) == (S.HOLD, DriveState.SWITCH_ON_DISABLED)
    shaking = rig.emulator.before_send.pop()  # during the start, the joint must not oscillate
    rig.operator.start()
    rig.until(S.ACTIVE, 150)
    rig.emulator.before_send.append(shaking)
    assert rig.run(6 * REVERSALS).supervisor is S.ACTIVE  # the controller moves the joint, its drive does not hold it
    rig.operator.hold()
    rig.until(S.LOWER, 6 * REVERSALS)
    rig.run(3)
    assert rig.hal.state.drive_state[KNEE] == DriveState.SWITCH_ON_DISABLED


def test_drive_that_reports_another_torque_is_switched_off_and_tested_at_the_next_start(rig):
    rig.until(S.ACTIVE)
    rig.run(2 * SPAN)
    set_signal(rig, "LEFT_SK_STATE", "Torque", 30.0)
    assert rig.run(CONFIRM - 1).supervisor is S.ACTIVE
    assert rig.run(1).supervisor is S.LOWER
    assert re.search(
        r"left_SK must follow the torque command of \S+ Nm, got a reported torque of 30\.0 Nm", rig.hal.reason
    )
    rig.emulator.before_send.clear()
    state = rig.run(50)
    assert state.drive_state[KNEE] == DriveState.SWITCH_ON_DISABLED
    assert (np.delete(state.drive_state, KNEE) == DriveState.QUICK_STOP_ACTIVE).all()
    rig.operator.start()
    rig.until(S.HOLD, 5)
    before = rig.codes().count("DIRECTIONS_PROVEN")
    rig.operator.start()
    rig.until(S.ACTIVE, 150)
    assert rig.codes().count("DIRECTIONS_PROVEN") == before + 1


def test_torques_are_compared_anew_after_each_start(rig):
    rig.until(S.ACTIVE)
    rig.run(2 * SPAN)
    set_signal(rig, "LEFT_SK_STATE", "Torque", 30.0)
    rig.run(CONFIRM - 1)
    rig.emulator.before_send.clear()
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.operator.start()
    rig.until(S.ACTIVE, 150)
    set_signal(rig, "LEFT_SK_STATE", "Torque", 30.0)
    rig.run(SPAN + CONFIRM - 4)
    assert "TORQUE_TRACKING" not in rig.codes()
    rig.run(4)
    assert "TORQUE_TRACKING" in rig.codes()


def test_joint_that_oscillates_before_active_is_switched_off(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    shake(rig)
    rig.operator.start()
    state = rig.run(150)
    assert "HOLD_UNSTABLE" in rig.codes()
    assert "ACTIVE" not in rig.codes()
    assert state.supervisor is S.READY
    assert (state.drive_state == DriveState.SWITCH_ON_DISABLED).all()


def test_start_without_progress_fails_and_names_the_drive(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    set_signal(rig, "LEFT_SK_STATE", "DriveState", DriveState.SWITCH_ON_DISABLED)
    rig.operator.start()
    rig.run(STALLED_CYCLES)
    assert "START_FAILED" not in rig.codes()
    rig.run(10)
    assert rig.codes().count("START_FAILED") == 1
    assert rig.hal.reason == (
        "the drives were not enabled and no drive changed its state for 10 cycles: left_SK is in SWITCH_ON_DISABLED"
    )
    assert rig.controlwords() == {Controlword.DISABLE_VOLTAGE}


def test_start_with_a_drive_that_toggles_fails_after_its_longest_time(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    at = rig.emulator.signals.index("LEFT_SK_STATE", "DriveState")

    def toggle(cycle: int, values: np.ndarray) -> None:
        values[at] = (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON)[cycle % 2]

    rig.emulator.before_send.append(toggle)
    rig.operator.start()
    rig.run(ENABLE_CYCLES)
    assert "START_FAILED" not in rig.codes()
    rig.run(3)
    assert rig.codes().count("START_FAILED") == 1
    assert rig.hal.reason.startswith("the drives were not enabled within 200 cycles: left_SK is in ")


def test_released_dead_man_ends_the_start(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    set_signal(rig, "LEFT_SK_STATE", "DriveState", DriveState.SWITCH_ON_DISABLED)
    rig.operator.start()
    rig.run(10)
    assert Controlword.SHUTDOWN in rig.controlwords()
    rig.operator.release()
    rig.run(3)
    assert rig.controlwords() == {Controlword.DISABLE_VOLTAGE}
    rig.operator.squeeze()
    rig.run(ENABLE_CYCLES)
    assert rig.controlwords() == {Controlword.DISABLE_VOLTAGE}
    assert "START_FAILED" not in rig.codes()


def test_change_of_state_contains_its_reason(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD, 5)
    assert rig.hal.events[-1].text == "ACTIVE -> HOLD: the operator asked to stop"
    assert rig.hal.reason == "the operator asked to stop"


ALL_WELL = "every required node answers and no diagnostic prevents a start"
STARTED = "the operator pressed START"
ACKNOWLEDGED = "the operator acknowledged the fault with START"


def hold_and_start(rig):
    rig.operator.hold()
    rig.until(S.HOLD, 5)
    rig.operator.start()
    rig.until(S.ACTIVE, 150)


def full_assist_and_start(rig):
    into_full_assist(rig)
    rig.operator.start()
    rig.walk(2)


def fault_and_start(rig):
    rig.emulator.drives.leave(7, DriveState.FAULT)
    rig.until(S.FAULT, 5)
    rig.run(50)
    rig.operator.start()
    rig.until(S.HOLD, 30)
    rig.run(300)
    rig.operator.start()
    rig.until(S.ACTIVE, 150)


def lower_and_start(rig):
    rig.bus.to_hal = with_encoder_fault()
    rig.until(S.LOWER, 5)
    rig.bus.to_hal = lambda frames: frames
    rig.run(50)
    rig.operator.start()
    rig.until(S.HOLD, 5)


def finish_step(rig):
    finishing(rig, None)
    rig.cycle()


@pytest.mark.parametrize(
    ("course", "expected"),
    [
        (hold_and_start, ["the operator asked to stop", STARTED]),
        (full_assist_and_start, ["a cell is stuck", STARTED]),
        (fault_and_start, ["RIGHT_TH: a drive is in FAULT and sent no emergency message", ACKNOWLEDGED, STARTED]),
        (lower_and_start, ["LEFT_SK: emergency of a node: encoder or another sensor (emergency 0x7305)", ACKNOWLEDGED]),
        (finish_step, ["the battery is nearly empty"] * 2),
    ],
)
def test_reason_is_that_of_the_present_state_after_every_transition(rig, course, expected):
    reasons, states, cycle = [], [S.OFF], rig.hal.read

    def read():
        state = cycle()
        if state.supervisor is not states[-1]:
            states.append(state.supervisor)
            reasons.append(rig.hal.reason)
        return state

    rig.hal.read = read
    rig.until(S.ACTIVE)
    course(rig)
    assert reasons == [ALL_WELL, STARTED, *expected], states


def test_reason_names_the_missing_node_after_ready_is_lost(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    rig.bus.to_hal = rig.drop(load().message("LEFT_SK_STATE").frame_id)
    rig.until(S.OFF, 20)
    assert "LEFT_SK" in rig.hal.reason
    rig.bus.to_hal = lambda frames: frames
    rig.until(S.READY, 100)
    assert rig.hal.reason == ALL_WELL


def own_frame(frames):
    foreign = frames[:1].copy()
    foreign["can_id"] = 0x100
    return np.concatenate([frames, foreign])


def test_second_hal_leads_to_hold_and_prevents_ready(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = own_frame
    assert rig.cycle().supervisor is S.HOLD
    assert rig.events_of("HAL_DUPLICATE") == [("HAL_DUPLICATE", "error")]
    new = make_rig()
    new.bus.to_hal = own_frame
    new.cycle()
    new.bus.to_hal = lambda frames: frames
    assert new.run(500).supervisor is S.OFF
    assert "HAL_DUPLICATE" in new.codes()
    new.operator.start()
    new.run(3)
    reason = "another HAL sent on this bus: end the other one, then start this one again"
    assert new.hal.events[-1].text == f"START refused: {reason}"


def hot(rig, **degrees: float):
    for node, value in degrees.items():
        set_signal(rig, f"{node}_STATE", "Temperature", value)


def test_hot_drive_is_derated_within_one_cycle_and_reported(rig):
    rig.until(S.ACTIVE)
    hot(rig, LEFT_SK=100.0, RIGHT_SK=100.0)
    assert rig.cycle().supervisor is S.ACTIVE
    limit = rig.hal.robot.torque_limit(rig.hal.state.temperature)
    assert limit[3] < rig.hal.robot.torque_max[3]
    commands = rig.last_commands()
    assert commands["left"]["SK_MaxTorque"] == pytest.approx(limit[3], abs=0.0125)
    assert commands["right"]["SH_MaxTorque"] == pytest.approx(rig.hal.robot.torque_max[8], abs=0.0125)
    derated = {e.node: e for e in rig.hal.events if e.code == "DERATED"}
    assert set(derated) == {"LEFT_SK", "RIGHT_SK"}
    assert derated["LEFT_SK"].value == pytest.approx(limit[3])
    assert derated["LEFT_SK"].severity == "warning"
    assert rig.run(20).supervisor is S.ACTIVE


@pytest.mark.parametrize("node", ["LEFT_SK", "RIGHT_SK"])
def test_drive_much_hotter_than_its_twin_leads_to_hold(rig, node):
    rig.until(S.ACTIVE)
    hot(rig, **{node: 115.0})
    assert rig.run(15).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD
    assert node in rig.hal.reason


def hot_in_every_nth_cycle(rig, every: int):
    at = rig.emulator.signals.index("LEFT_SK_STATE", "Temperature")
    count = itertools.count()

    def heat(_: int, values: np.ndarray) -> None:
        if next(count) % every == 0:
            values[at] = 115.0

    rig.emulator.before_send.append(heat)


def test_hot_samples_in_a_fifth_of_the_cycles_do_not_stop_the_robot(rig):
    rig.until(S.ACTIVE)
    hot_in_every_nth_cycle(rig, 5)
    assert rig.run(200).supervisor is S.ACTIVE
    assert rig.events_of("DERATED") == [("DERATED", "warning")]


def test_hot_samples_in_every_second_cycle_lead_to_hold_and_few_events(rig):
    rig.until(S.ACTIVE)
    hot_in_every_nth_cycle(rig, 2)
    assert rig.run(40).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD
    assert rig.run(400).supervisor is S.HOLD
    assert len(rig.events_of("DERATED")) == 2
    rig.operator.start()
    rig.run(30)
    assert rig.hal.state.supervisor is S.HOLD
    assert rig.hal.reason.startswith("START refused: LEFT_SK: its t")


def test_missing_heartbeat_is_reported_as_warning(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(0x704)
    assert rig.run(360).supervisor is S.ACTIVE
    assert rig.events_of("HEARTBEAT_LOST") == [("HEARTBEAT_LOST", "warning")]


# -- a press of START causes at most one change of state ---------------------------------------------------------------


HEAD_STARTS = (1, 5, 10, 15, 16, 17, 50, 100)
PENDANT_STATE = 0x194


def without_pendant(rig, cycles: int):
    """Lose the frames of the pendant for some cycles. The operator does not change the dead-man switch or the request."""
    rig.bus.to_hal = rig.drop(PENDANT_STATE)
    state = rig.run(cycles)
    rig.bus.to_hal = lambda frames: frames
    return state


def into(rig, state: S) -> None:
    """Bring a robot into READY, HOLD or FAULT. Its operator must not press START automatically (`starts=False`)."""
    rig.until(S.READY)
    if state is S.READY:
        return
    rig.operator.start()
    rig.until(S.ACTIVE, 150)
    if state is S.HOLD:
        rig.operator.hold()
    else:
        rig.emulator.drives.leave(7, DriveState.FAULT)
    rig.until(state, 5)


@pytest.mark.sample(3)
@pytest.mark.parametrize("cycles", HEAD_STARTS)
def test_press_in_off_has_no_effect_in_ready(make_rig, cycles: int):
    ready = make_rig(starts=False)
    ready.until(S.READY)
    rig = make_rig(starts=False)
    rig.run(max(2, ready.hal.state.cycle - cycles))
    assert rig.hal.state.supervisor is S.OFF
    rig.operator.start()
    rig.until(S.READY)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


@pytest.mark.parametrize("frames", HEAD_STARTS)
@pytest.mark.parametrize("state", [S.READY, S.HOLD])
@pytest.mark.sample(3)
def test_press_after_a_pendant_loss_counts_from_the_second_frame(make_rig, state: S, frames: int):
    rig = make_rig(starts=False)
    into(rig, state)
    assert without_pendant(rig, 50).supervisor is state
    rig.run(1 + frames)  # the first frame after a loss is rejected
    rig.operator.start()
    rig.until(S.ACTIVE, 150)
    moves = [code for code in rig.codes() if code in S.__members__]
    rig.walk(ENABLE_CYCLES + 50)
    assert [code for code in rig.codes() if code in S.__members__] == moves


@pytest.mark.parametrize("late", HEAD_STARTS)
@pytest.mark.parametrize("state", [S.READY, S.HOLD, S.FAULT])
@pytest.mark.sample(5)
def test_press_before_the_first_pendant_frame_starts_nothing(make_rig, state: S, late: int):
    rig = make_rig(starts=False)
    into(rig, state)
    without_pendant(rig, 10)
    rig.bus.to_hal = rig.drop(PENDANT_STATE)
    rig.operator.start()
    rig.run(late)
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(ENABLE_CYCLES + 50).supervisor is state


@pytest.mark.parametrize("word", ["release", "stop", "hold"])
def test_press_released_before_the_pendant_is_trusted_starts_nothing(make_rig, word: str):
    rig = make_rig(starts=False)
    into(rig, S.HOLD)
    without_pendant(rig, 10)
    rig.run(3)
    rig.operator.start()
    rig.run(3)
    getattr(rig.operator, word)()
    rig.run(3)
    rig.operator.squeeze()
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD


def test_press_before_ready_of_an_untrusted_pendant_starts_nothing(make_rig):
    ready = make_rig(starts=False)
    ready.until(S.READY)
    rig = make_rig(starts=False)
    without_pendant(rig, ready.hal.state.cycle - 6)
    rig.run(3)
    rig.operator.start()
    rig.until(S.READY, 5)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY


def test_one_press_in_fault_leads_only_to_hold(make_rig):
    rig = make_rig(starts=False)
    into(rig, S.FAULT)
    rig.operator.start()
    rig.until(S.HOLD, 20)
    without_pendant(rig, 10)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


def test_press_during_finish_step_starts_nothing(make_rig):
    rig = make_rig(starts=False)
    rig.until(S.READY)
    rig.operator.start()
    assert finishing(rig, 7).supervisor is S.FINISH_STEP
    rig.operator.start()
    rig.walk(3, step=7)
    rig.walk(2, step=8)
    assert rig.hal.state.supervisor is S.HOLD
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD


def test_missing_node_refuses_the_start_in_hold_with_the_reason(make_rig):
    rig = make_rig(starts=False)
    into(rig, S.HOLD)
    rig.bus.to_hal = rig.drop(0x184)
    rig.run(10)
    rig.operator.start()
    rig.run(2)
    assert "START_REFUSED" in rig.codes()
    assert rig.hal.reason.startswith("START refused: LEFT_SK: a node timed out")
    rig.bus.to_hal = lambda frames: frames
    rig.run(2)
    rig.operator.start()
    rig.run(2)
    assert rig.hal.reason == "START refused: no answer or not trusted yet: LEFT_SK"
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


@pytest.mark.parametrize("cycle", range(4))
def test_start_acknowledges_only_emergencies_of_earlier_cycles(make_rig, cycle: int):
    rig = make_rig(starts=False)
    into(rig, S.HOLD)
    emergency = TransmitImage([load().message("FOOT_LEFT_EMCY")])
    emergency.values[emergency.codec.index("FOOT_LEFT_EMCY", "ErrorCode")] = 0x8100
    rig.operator.start()
    started = []
    for each in range(4):
        rig.bus.to_hal = lambda frames, now=each == cycle: np.concatenate([frames, emergency.seal()]) if now else frames
        rig.cycle()
        started.append(rig.hal.conditions.start_wanted)
    assert rig.run(150).supervisor is (S.ACTIVE if cycle < started.index(True) else S.HOLD)


# -- two senders of one message ----------------------------------------------------------------------------------------


def resealed(frame: Frames, message: Message, signal: str, change: Callable[[int], int]) -> Frames:
    """Return the frame with a changed raw code of one signal and a correct CRC, shape (1,)."""
    other, where = frame.copy(), message.signal(signal)
    payload = int.from_bytes(other["data"][0].tobytes(), "little")
    mask = (1 << where.length) - 1
    code = change(payload >> where.start & mask) & mask
    payload = payload & ~(mask << where.start) | code << where.start
    data = bytearray(payload.to_bytes(64, "little"))
    data[:2] = crc(bytes(data[2 : message.length]), data_id_bytes(message.data_id)).to_bytes(2, "little")
    other["data"][0] = np.frombuffer(bytes(data), np.uint8)
    return other


class SecondSender:
    """A second sender of a message: it sends each frame again, with a changed raw code and a correct CRC.

    `order` states when its frame arrives: before the frames of the cycle, after them, alternately, or in the next cycle ("late").
    """

    def __init__(self, message: Message, order: str, signal: str, change: Callable[[int], int]) -> None:
        self._message, self._order, self._signal, self._change = message, order, signal, change
        self._late: Frames | None = None
        self._cycle = 0

    def __call__(self, frames: Frames) -> Frames:
        own = np.flatnonzero(frames["can_id"] == self._message.frame_id)
        if not len(own):
            return frames
        self._cycle += 1
        second = resealed(frames[own[:1]], self._message, self._signal, self._change)
        order = self._order if self._order != "alternately" else ("first", "after")[self._cycle % 2]
        if order == "first":
            return np.concatenate([second, frames])
        if order == "after":
            return np.concatenate([frames, second])
        late, self._late = self._late, second  # the frame arrives in the next cycle
        return frames if late is None else np.concatenate([late, frames])


ORDERS = ("first", "after", "alternately", "late")
#: Kind of node -> signal that can be changed without a range or plausibility fault.
OTHER_SIGNAL = {"drive": "Temperature", "imu": "Temperature", "foot": "Temperature", "pendant": "AssistanceFactor"}
CYCLIC = [m for m in load().received_by("HAL") if m.cycle_ms == 1]


@pytest.mark.sample(9)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("message", CYCLIC, ids=lambda message: message.name)
def test_f58_second_sender_of_any_node_leads_to_hold_within_five_cycles(make_rig, message: Message, order: str):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = SecondSender(message, order, OTHER_SIGNAL[load().node(message.sender).kind], lambda code: code ^ 1)
    assert rig.run(5).supervisor is S.HOLD
    assert rig.events_of("NODE_DUPLICATE") == [("NODE_DUPLICATE", "warning"), ("NODE_DUPLICATE", "error")]
    assert rig.hal.reason.startswith(f"{message.sender}: two senders of one message, {message.name}")
    rig.run(30)
    rig.operator.start()
    assert rig.run(150).supervisor is S.HOLD  # a start takes fewer cycles, as the last line shows
    rig.bus.to_hal = lambda frames: frames
    rig.run(20)
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("radians", [0.3, 3e-3])
@pytest.mark.sample(3)
def test_f58_second_drive_leads_to_hold_and_prevents_ready(make_rig, order: str, radians: float):
    message = load().message("LEFT_SK_STATE")
    off = round(radians * 100.0 / message.signal("Position").factor)  # on the motor side
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = SecondSender(message, order, "Position", lambda code: code + off)
    assert rig.run(5).supervisor is S.HOLD
    assert ("NODE_DUPLICATE", "error") in rig.events_of("NODE_DUPLICATE")
    new = make_rig()
    new.bus.to_hal = SecondSender(message, order, "Position", lambda code: code + off)
    assert {new.cycle().supervisor for _ in range(500)} == {S.OFF}
    assert new.hal.missing() == ["LEFT_SK"]
    assert ("NODE_DUPLICATE", "error") in new.events_of("NODE_DUPLICATE")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("signal", "code"), [("DeadMan", 0), ("Request", 2), ("Request", 3)], ids=["dead-man", "STOP", "HOLD"]
)
def test_f58_safest_pendant_frame_of_a_cycle_counts_in_that_cycle(make_rig, order: str, signal: str, code: int):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = SecondSender(load().message("PENDANT_STATE"), order, signal, lambda _: code)
    assert rig.run(2 if order == "late" else 1).supervisor is S.HOLD
    assert rig.events_of("OPERATOR_STOP") == [("OPERATOR_STOP", "info")]


@pytest.mark.parametrize("order", ORDERS)
def test_f58_second_pendant_does_not_hide_stop_of_the_first(make_rig, order: str):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.operator.stop()
    rig.bus.to_hal = SecondSender(load().message("PENDANT_STATE"), order, "Request", lambda _: 0)
    assert rig.cycle().supervisor is S.HOLD


@pytest.mark.parametrize("order", ORDERS)
def test_f58_start_press_of_one_of_two_pendants_does_not_count(make_rig, order: str):
    rig = make_rig(starts=False)
    into(rig, S.READY)
    pendant = load().message("PENDANT_STATE")

    def pressed(code: int) -> int:
        return code + 1

    presses = SecondSender(pendant, order, "Request", lambda _: 1)
    counts = SecondSender(pendant, order, "RequestCounter", pressed)

    def both(frames: Frames) -> Frames:
        """Add a frame of the second sender with the request START and a changed RequestCounter."""
        own = frames[frames["can_id"] == PENDANT_STATE]
        if not len(own):
            return frames
        second = resealed(resealed(own, pendant, "Request", lambda _: 1), pendant, "RequestCounter", pressed)
        return np.concatenate([second, frames] if order == "first" else [frames, second])

    rig.bus.to_hal = both if order in ("first", "after") else (presses if order == "late" else counts)
    rig.run(2)
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY


@pytest.mark.parametrize("alternating", [0, 4])
@pytest.mark.parametrize("overlap", [1, 3, 100])
def test_f58_exchange_of_the_pendant_in_hold_starts_nothing(make_rig, overlap: int, alternating: int):
    rig = make_rig(starts=False)
    into(rig, S.HOLD)
    other = TransmitImage([load().message("PENDANT_STATE")])
    index = other.codec.index("PENDANT_STATE", "DeadMan")
    other.values[index : index + 3] = 1, 1, 77  # dead-man, START, RequestCounter
    present = "both"

    def pendants(frames: Frames) -> Frames:
        frames = frames if present != "other" else rig.drop(PENDANT_STATE)(frames)
        second = other.seal(rig.hal.state.cycle & 0xFF)
        return frames if present == "first" or not len(frames) else np.concatenate([frames, second])

    rig.bus.to_hal = pendants
    rig.run(overlap)
    for cycle in range(alternating):  # each cycle loses the frame of one pendant
        present = ("first", "other")[cycle % 2]
        rig.cycle()
    present = "other"
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD
    other.values[index + 2] = 78
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


@pytest.mark.parametrize("ahead", [-3, -1, 1, 3, 20])
def test_f58_second_sender_with_its_own_counter_leads_to_hold(make_rig, ahead: int):
    message = load().message("LEFT_SK_STATE")
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = SecondSender(message, "after", "Counter", lambda code: code + ahead)
    assert rig.run(5).supervisor is S.HOLD
    assert ("NODE_DUPLICATE", "error") in rig.events_of("NODE_DUPLICATE")


def test_repeated_frame_is_not_a_second_sender(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = lambda frames: np.concatenate([frames, frames[np.isin(frames["can_id"], (0x184, PENDANT_STATE))]])
    assert rig.run(15).supervisor is S.ACTIVE
    assert rig.events_of("NODE_DUPLICATE") == []
    assert ("E2E_REPEATED", "info") in rig.events_of("E2E_REPEATED")


@pytest.mark.sample(5)
@pytest.mark.parametrize("imu", ["pelvis", "left_tibia"])
@pytest.mark.parametrize("boot", [*range(1200, 1300, 9), 1300])
def test_imu_whose_boot_up_message_is_lost_may_have_another_heading(make_rig, imu: str, boot: int):
    """The next status message shows the restart. It arrives up to 100 cycles later, and a leg is checked every 32 cycles."""
    rig = make_rig(starts=False)
    node = f"IMU_{imu.upper()}"
    first = rig.emulator.signals.index(f"{node}_STATE", "QuaternionW")

    def turn(cycle: int, values: np.ndarray) -> None:
        if cycle >= 1150:  # turn the attitude by 40 degrees about the vertical
            (w, x, y, z), c, s = (
                values[first : first + 4].copy(),
                math.cos(math.radians(20.0)),
                math.sin(math.radians(20.0)),
            )
            values[first : first + 4] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w

    rig.emulator.before_send.append(turn)
    rig.emulator.inject(
        [Fault("reset", node, start=1100, cycles=boot - 1100), Fault("drop", f"{node}_STATUS", start=boot, cycles=1)]
    )
    rig.run(boot + 400)
    assert not {"ENC_DRIFT", "ENC_STUCK"} & set(rig.codes())
    (reset,) = (event for event in rig.hal.events if event.code == "NODE_RESET")
    assert reset.node == node
    assert reset.cycle > boot + 1, "the boot-up message must be lost"
    rig.operator.start()
    assert rig.until(S.ACTIVE, 150).supervisor is S.ACTIVE


def test_offset_of_th_from_the_time_without_an_imu_that_did_not_restart_is_found(make_rig):
    rig = make_rig(starts=False)
    rig.emulator.inject(
        [
            Fault("drop", "IMU_PELVIS_STATE", start=1000, cycles=1100),
            Fault("encoder_drift", "LEFT_TH", start=1050, cycles=10_000, rate=0.05),
        ]
    )
    rig.run(2050)
    assert "ENC_DRIFT" not in rig.codes()
    rig.run(350)
    assert "LEFT_TH" in {event.node for event in rig.hal.events if event.code == "ENC_DRIFT"}
