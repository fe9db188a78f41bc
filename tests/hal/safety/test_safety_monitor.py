"""The safety monitor of a HAL on an embedded bus: the way from OFF to ACTIVE, and every way into a worse state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from atalante_dbc import Message, load
from atalante_hal.hal import SATURATED_CYCLES
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.limiter import Limited
from atalante_hal.safety.safety_monitor import FINISH_STEP_CYCLES
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.types import PERIOD, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import Frames

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


@pytest.mark.parametrize("cycles", [0, 1, 2])
def test_a_program_that_ends_during_a_start_enables_no_drive(rig, cycles):
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
    rig.until(S.HOLD, 30)
    assert rig.run(300).supervisor is S.HOLD  # one press, one move
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
    rig.hal._safety_monitor.report(Dtc.FOOT_CELL, "a cell is stuck")
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
    rig.hal._safety_monitor.report(Dtc.SUPPLY_LOW, "the battery is nearly empty")
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
    rig.hal._safety_monitor._heartbeats.emergencies["LEFT_SK"] = Dtc.EMCY_ENCODER, 0x7305
    rig.hal._safety_monitor._heartbeats.quiet = False
    rig.hal._safety_monitor._steady = False
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
    rig.until(S.HOLD, 5)
    assert rig.run(300).supervisor is S.HOLD  # one press, one move
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
    assert "another HAL was there first" in new.hal._safety_monitor.memory.text_of(frozenset({Dtc.HAL_DUPLICATE})) or (
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


# -- one press, one move -----------------------------------------------------------------------------------------------


HEAD_STARTS = (1, 5, 10, 15, 16, 17, 50, 100)
PENDANT_STATE = 0x194


def without_pendant(rig, cycles: int):
    """Lose the pendant's frames for a while; the emulated operator keeps its dead-man and its last request."""
    rig.bus.to_hal = rig.drop(PENDANT_STATE)
    state = rig.run(cycles)
    rig.bus.to_hal = lambda frames: frames
    return state


def into(rig, state: S) -> None:
    """Bring a robot whose operator presses nothing by itself into READY, HOLD or FAULT."""
    rig.until(S.READY)
    if state is S.READY:
        return
    rig.operator.start()
    rig.until(S.ACTIVE, 20)
    if state is S.HOLD:
        rig.operator.hold()
    else:
        rig.emulator.drives.state[7] = DriveState.FAULT
        rig.emulator.drives._states_changed()
    rig.until(state, 5)


@pytest.mark.parametrize("cycles", HEAD_STARTS)
def test_a_press_in_off_starts_nothing_later(make_rig, cycles: int):
    ready = make_rig(starts=False)
    ready.until(S.READY)
    rig = make_rig(starts=False)
    rig.run(max(2, ready.hal.state.cycle - cycles))
    assert rig.hal.state.supervisor is S.OFF
    rig.operator.start()
    rig.until(S.READY)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


@pytest.mark.parametrize("frames", HEAD_STARTS)
@pytest.mark.parametrize("state", [S.READY, S.HOLD])
def test_the_first_press_of_a_late_pendant_counts_from_its_second_frame_on(make_rig, state: S, frames: int):
    rig = make_rig(starts=False)
    into(rig, state)
    assert without_pendant(rig, 50).supervisor is state
    rig.run(1 + frames)  # the first frame after a loss is refused
    rig.operator.start()
    rig.until(S.ACTIVE, 30)
    moves = [code for code in rig.codes() if code in S.__members__]
    rig.walk(ENABLE_CYCLES + 50)
    assert [code for code in rig.codes() if code in S.__members__] == moves


@pytest.mark.parametrize("late", HEAD_STARTS)
@pytest.mark.parametrize("state", [S.READY, S.HOLD, S.FAULT])
def test_a_start_that_was_pressed_before_the_pendant_is_heard_moves_nothing(make_rig, state: S, late: int):
    rig = make_rig(starts=False)
    into(rig, state)
    without_pendant(rig, 10)
    rig.bus.to_hal = rig.drop(PENDANT_STATE)
    rig.operator.start()
    rig.run(late)
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(ENABLE_CYCLES + 50).supervisor is state


@pytest.mark.parametrize("word", ["release", "stop", "hold"])
def test_a_press_that_is_taken_back_before_the_pendant_is_trusted_moves_nothing(make_rig, word: str):
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


def test_a_press_before_ready_of_a_pendant_that_is_trusted_after_it_moves_nothing(make_rig):
    ready = make_rig(starts=False)
    ready.until(S.READY)
    rig = make_rig(starts=False)
    without_pendant(rig, ready.hal.state.cycle - 6)
    rig.run(3)
    rig.operator.start()
    rig.until(S.READY, 5)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY


def test_one_press_in_fault_ends_in_hold_whatever_the_pendant_goes_through(make_rig):
    rig = make_rig(starts=False)
    into(rig, S.FAULT)
    rig.operator.start()
    rig.until(S.HOLD, 20)
    without_pendant(rig, 10)
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


def test_a_press_during_the_last_step_starts_nothing_after_it(rig):
    rig.operator._starts = False
    rig.until(S.READY)
    rig.operator.start()
    assert finishing(rig, 7).supervisor is S.FINISH_STEP
    rig.operator.start()
    rig.walk(3, step=7)
    rig.walk(2, step=8)
    assert rig.hal.state.supervisor is S.HOLD
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD


def test_a_start_in_hold_is_refused_with_the_reason_while_a_node_is_missing(make_rig):
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
    assert rig.hal.reason == "START refused: not heard or not trusted yet: LEFT_SK"
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


# -- two senders of one message ----------------------------------------------------------------------------------------


def resealed(frame: Frames, message: Message, signal: str, change: Callable[[int], int]) -> Frames:
    """The frame with another raw code of a signal and the right CRC. Shape (1,)."""
    other, where = frame.copy(), message.signal(signal)
    payload = int.from_bytes(other["data"][0].tobytes(), "little")
    mask = (1 << where.length) - 1
    code = change(payload >> where.start & mask) & mask
    payload = payload & ~(mask << where.start) | code << where.start
    data = bytearray(payload.to_bytes(64, "little"))
    data[:2] = crc(bytes(data[2 : message.length]), data_id_bytes(message.data_id)).to_bytes(2, "little")
    other["data"][0] = np.frombuffer(bytes(data), np.uint8)
    return other


class Ghost:
    """A second sender of a message: each frame is the true one of the cycle with another raw code and the right CRC."""

    def __init__(self, message: Message, order: str, signal: str, change: Callable[[int], int]) -> None:
        self._message, self._order, self._signal, self._change = message, order, signal, change
        self._late: Frames | None = None
        self._cycle = 0

    def __call__(self, frames: Frames) -> Frames:
        mine = np.flatnonzero(frames["can_id"] == self._message.frame_id)
        if not len(mine):
            return frames
        self._cycle += 1
        ghost = resealed(frames[mine[:1]], self._message, self._signal, self._change)
        order = self._order if self._order != "alternately" else ("first", "after")[self._cycle % 2]
        if order == "first":
            return np.concatenate([ghost, frames])
        if order == "after":
            return np.concatenate([frames, ghost])
        late, self._late = self._late, ghost  # the HAL has finished its cycle when it comes
        return frames if late is None else np.concatenate([late, frames])


ORDERS = ("first", "after", "alternately", "late")
#: A signal of each kind of node whose other value is inside its range, and nothing a plausibility check minds.
OTHER_SIGNAL = {"drive": "Temperature", "imu": "Temperature", "foot": "Temperature", "pendant": "AssistanceFactor"}
CYCLIC = [m for m in load().received_by("HAL") if m.cycle_ms == 1]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("message", CYCLIC, ids=lambda message: message.name)
def test_f58_a_second_sender_of_any_node_ends_in_hold_within_five_cycles(make_rig, message: Message, order: str):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = Ghost(message, order, OTHER_SIGNAL[load().node(message.sender).kind], lambda code: code ^ 1)
    assert rig.run(5).supervisor is S.HOLD
    assert rig.seen("NODE_DUPLICATE") == [("NODE_DUPLICATE", "warning"), ("NODE_DUPLICATE", "error")]
    assert rig.hal.reason.startswith(f"{message.sender}: two senders of one message, {message.name}")
    rig.run(30)
    rig.operator.start()
    assert rig.run(300).supervisor is S.HOLD
    rig.bus.to_hal = lambda frames: frames
    rig.run(20)
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("radians", [0.3, 3e-3])
def test_f58_a_ghost_drive_is_noticed_in_five_cycles_and_at_boot_keeps_the_robot_out_of_ready(
    make_rig, order: str, radians: float
):
    message = load().message("LEFT_SK_STATE")
    off = round(radians * 100.0 / message.signal("Position").factor)  # at the motor, behind the gear
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = Ghost(message, order, "Position", lambda code: code + off)
    assert rig.run(5).supervisor is S.HOLD
    assert ("NODE_DUPLICATE", "error") in rig.seen("NODE_DUPLICATE")
    new = make_rig()
    new.bus.to_hal = Ghost(message, order, "Position", lambda code: code + off)
    assert {new.cycle().supervisor for _ in range(500)} == {S.OFF}
    assert new.hal.missing() == ["LEFT_SK"]
    assert ("NODE_DUPLICATE", "error") in new.seen("NODE_DUPLICATE")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("signal", "code"), [("DeadMan", 0), ("Request", 2), ("Request", 3)], ids=["dead-man", "STOP", "HOLD"]
)
def test_f58_the_safest_pendant_frame_of_a_cycle_wins_in_that_cycle(make_rig, order: str, signal: str, code: int):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = Ghost(load().message("PENDANT_STATE"), order, signal, lambda _: code)
    assert rig.run(2 if order == "late" else 1).supervisor is S.HOLD
    assert rig.seen("OPERATOR_STOP") == [("OPERATOR_STOP", "info")]


@pytest.mark.parametrize("order", ORDERS)
def test_f58_the_true_pendants_stop_is_not_hidden_by_a_second_one(make_rig, order: str):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.operator.stop()
    rig.bus.to_hal = Ghost(load().message("PENDANT_STATE"), order, "Request", lambda _: 0)
    assert rig.cycle().supervisor is S.HOLD


@pytest.mark.parametrize("order", ORDERS)
def test_f58_a_start_that_one_of_two_pendants_presses_does_not_count(make_rig, order: str):
    rig = make_rig(starts=False)
    into(rig, S.READY)
    pendant = load().message("PENDANT_STATE")

    def pressed(code: int) -> int:
        return code + 1

    presses = Ghost(pendant, order, "Request", lambda _: 1)
    counts = Ghost(pendant, order, "RequestCounter", pressed)

    def both(frames: Frames) -> Frames:
        """START and its counter, in one frame of the ghost."""
        mine = frames[frames["can_id"] == PENDANT_STATE]
        if not len(mine):
            return frames
        ghost = resealed(resealed(mine, pendant, "Request", lambda _: 1), pendant, "RequestCounter", pressed)
        return np.concatenate([ghost, frames] if order == "first" else [frames, ghost])

    rig.bus.to_hal = both if order in ("first", "after") else (presses if order == "late" else counts)
    rig.run(2)
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(ENABLE_CYCLES + 50).supervisor is S.READY


@pytest.mark.parametrize("ahead", [-3, -1, 1, 3, 20])
def test_f58_a_second_sender_with_a_counter_of_its_own_ends_in_hold_within_five_cycles(make_rig, ahead: int):
    message = load().message("LEFT_SK_STATE")
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = Ghost(message, "after", "Counter", lambda code: code + ahead)
    assert rig.run(5).supervisor is S.HOLD
    assert ("NODE_DUPLICATE", "error") in rig.seen("NODE_DUPLICATE")


def test_a_frame_that_comes_twice_is_a_repetition_as_ever(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = lambda frames: np.concatenate([frames, frames[np.isin(frames["can_id"], (0x184, PENDANT_STATE))]])
    assert rig.run(100).supervisor is S.ACTIVE
    assert rig.seen("NODE_DUPLICATE") == []
    assert ("E2E_REPEATED", "info") in rig.seen("E2E_REPEATED")
