"""The HAL on an embedded bus: start-up, what is sent, and every way into HOLD."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cantools
import numpy as np
import pytest

from atalante_dbc import DBC_FILE
from atalante_hal.bus import BusDown, BusFull
from atalante_hal.cia402 import Controlword, DriveState
from atalante_hal.diagnostics import Dtc, dtcs_of, number_of
from atalante_hal.hal import ENABLE_CYCLES, FINISH_STEP_CYCLES, PERIOD, SATURATED_CYCLES, Hal
from atalante_hal.limiter import Limited
from atalante_hal.robot import JOINTS
from atalante_hal.types import Command, SupervisorState

S = SupervisorState
ORACLE = cantools.database.load_file(str(DBC_FILE))


def last_commands(rig) -> dict[str, dict[str, float]]:
    """What cantools reads in the newest command frames."""
    frames = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x100)
    return {
        side: ORACLE.decode_message(int(f["can_id"]), f["data"][: f["len"]].tobytes(), decode_choices=False)
        for side, f in zip(("left", "right"), frames[:2], strict=True)
    }


def controlwords(rig) -> set[int]:
    return {int(v) for c in last_commands(rig).values() for k, v in c.items() if k.endswith("Controlword")}


def torques(rig) -> np.ndarray:
    commands = last_commands(rig)
    return np.array([commands[j.split("_")[0]][f"{j.split('_')[1]}_TargetTorque"] for j in JOINTS])


def drop(*ids: int):
    return lambda frames: frames[~np.isin(frames["can_id"], ids)]


def test_start_up_walks_off_ready_active(rig):
    assert rig.cycle().supervisor is S.OFF
    rig.until(S.READY)
    assert controlwords(rig) == {Controlword.QUICK_STOP}
    state = rig.until(S.ACTIVE)
    assert (state.drive_state == DriveState.OPERATION_ENABLED).all()
    rig.cycle()
    assert controlwords(rig) == {Controlword.ENABLE_OPERATION}
    assert [c for c in rig.codes() if c in S.__members__] == ["READY", "ACTIVE"]


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


def test_what_write_returns_is_what_is_on_the_wire(rig):
    rig.until(S.ACTIVE)
    rng = np.random.default_rng(0)
    for _ in range(50):
        rig.hal.read()
        sent = rig.hal.write(Command(rng.uniform(-400, 400, 12), np.zeros(8)))
        assert np.abs(torques(rig) - sent).max() <= 0.0125 / 2 + 1e-9
        assert (np.abs(torques(rig)) <= rig.hal.robot.torque_max).all()


def test_torques_are_not_used_outside_active(rig):
    rig.until(S.READY)
    sent = rig.hal.write(Command(np.full(12, 50.0), np.ones(8)))
    assert not sent.any()
    assert controlwords(rig) == {Controlword.QUICK_STOP}


def test_the_record_says_what_the_state_says(rig):
    state = rig.until(S.ACTIVE)
    hal = rig.hal
    for name in (
        "position",
        "velocity",
        "torque",
        "drive_state",
        "imu_quaternion",
        "imu_gyro",
        "imu_accel",
        "foot_force",
    ):
        assert np.array_equal(hal.record[hal.layout[name]], np.ravel(getattr(state, name))), name
    assert hal.record[hal.layout["cycle"]] == state.cycle
    assert hal.record[hal.layout["supervisor"]] == S.ACTIVE
    assert hal.record[hal.layout["frames"]] > 19 * state.cycle
    assert np.array_equal(hal.record[hal.layout["torque_command"]], torques(rig)) or np.abs(
        hal.record[hal.layout["torque_command"]] - torques(rig)).max() < 0.00626  # fmt: skip


def test_joint_side_is_motor_side_over_gear(rig):
    state = rig.until(S.ACTIVE)
    record, layout = rig.hal.record, rig.hal.layout
    assert np.allclose(record[layout["motor_position"]] / 100.0, state.position, rtol=1e-12)
    assert np.allclose(rig.emulator.body.position, state.position, atol=5e-3)  # one millisecond later
    assert np.allclose(np.linalg.norm(state.imu_quaternion, axis=1), 1.0, atol=1e-3)
    assert state.imu_accel[1] == pytest.approx([0, 0, 9.81], abs=0.5)


def test_the_pendant_sets_the_assistance_factor(make_rig):
    rig = make_rig(assistance_factor=0.25)
    assert rig.until(S.ACTIVE).assistance_factor == 0.25
    rig.operator.assist(0.75)
    assert rig.run(2).assistance_factor == 0.75
    rig.operator.assist(None)
    assert rig.run(2).assistance_factor == 0.75


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan")])
def test_an_assistance_factor_outside_its_range_is_refused(factor, network, robot, rig):
    with pytest.raises(ValueError, match="between 0 and 1"):
        Hal(network, robot, rig.bus, assistance_factor=factor)


@pytest.mark.parametrize("word", ["stop", "hold", "release"])
def test_the_operators_word_ends_in_hold_within_five_cycles(rig, word):
    rig.until(S.ACTIVE)
    getattr(rig.operator, word)()
    assert rig.run(5).supervisor is S.HOLD
    state = rig.run(5)
    assert (state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()
    assert controlwords(rig) == {Controlword.QUICK_STOP}


def test_recovery_from_hold_takes_the_operator(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    assert rig.run(500).supervisor is S.HOLD
    rig.operator.start()
    assert rig.until(S.ACTIVE, 20).supervisor is S.ACTIVE


def test_losing_the_pendant_is_a_stop_after_exactly_its_timeout(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = drop(0x194)
    assert rig.run(4).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD


@pytest.mark.parametrize("joint", JOINTS)
def test_a_silent_drive_is_noticed_after_exactly_five_lost_frames(rig, joint, network):
    message = network.message(f"{joint.upper()}_STATE")
    rig.until(S.ACTIVE)
    rig.bus.to_hal = drop(message.frame_id)
    assert rig.run(message.timeout_ms - 1).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD
    assert message.sender in rig.hal.reason
    assert rig.hal.missing() == [message.sender]


def test_four_lost_frames_are_ridden_through(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = drop(0x183)
    state = rig.run(4)
    assert not state.joints_valid
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(10).supervisor is S.ACTIVE, rig.hal.events
    assert rig.hal.state.joints_valid


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_torque_that_is_not_finite_sends_the_hold_frame_in_the_same_cycle(rig, bad):
    rig.until(S.ACTIVE)
    torque = np.zeros(12)
    torque[4] = bad
    rig.cycle(torque)
    assert controlwords(rig) == {Controlword.QUICK_STOP}
    assert not torques(rig).any()
    assert rig.cycle().supervisor is S.HOLD
    assert "finite" in rig.hal.reason


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


@pytest.mark.parametrize("error", [BusDown("the interface is down"), BusFull("the queue is full")])
def test_a_bus_that_refuses_frames_ends_in_hold_and_raises_nothing(make_rig, monkeypatch, error):
    rig = make_rig(patience=60.0)
    rig.until(S.ACTIVE)
    receive, waits = rig.bus.receive, []

    def refuse(frames):
        raise error

    def wait(frames, timeout=0.0):
        waits.append(timeout)
        return receive(frames, timeout)

    rig.bus.to_nodes = refuse
    with monkeypatch.context() as patch:
        patch.setattr(rig.bus, "receive", wait)
        assert rig.run(8).supervisor is S.HOLD
    assert 0.0 < max(waits) <= 0.1  # for the answers to a SYNC that was not sent
    rig.bus.to_nodes = lambda frames: frames
    assert rig.run(50).supervisor is S.HOLD


def test_stop_leaves_every_drive_holding(rig):
    rig.until(S.ACTIVE)
    rig.hal.stop()
    assert rig.hal.state.supervisor is S.HOLD
    assert (rig.hal.state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()


def test_damaged_frames_are_counted_and_not_used(rig):
    rig.until(S.ACTIVE)

    def damage(frames):
        frames["data"][frames["can_id"] == 0x183, 6] ^= 0x40
        return frames

    rig.bus.to_hal = damage
    before = rig.hal.state.position[2]
    state = rig.cycle()
    assert rig.hal.crc_errors == 1
    assert rig.hal.record[rig.hal.layout["crc_errors"]] == 1
    assert state.position[2] == before


def test_every_frame_sent_decodes_with_cantools(rig):
    rig.until(S.ACTIVE)
    rig.run(300)
    seen = set()
    for batch in rig.sent:
        for frame in batch:
            message = ORACLE.get_message_by_frame_id(int(frame["can_id"]))
            assert frame["len"] == message.length
            message.decode(frame["data"][: message.length].tobytes())
            seen.add(message.name)
    assert {"SYNC_LEFT_LEG", "SYNC_RIGHT_SENSE", "COMMAND_LEFT_LEG", "HAPTICS_COMMAND", "HAL_STATUS"} <= seen


# -- reactions ---------------------------------------------------------------------------------------------------------


def seen(rig, *codes: str) -> list[tuple[str, str]]:
    return [(e.code, e.severity) for e in rig.hal.events if e.code in codes]


def set_signal(rig, message: str, signal: str, value: float):
    """Let a node say something else from now on."""
    at = rig.emulator.signals.index(message, signal)
    rig.emulator.before_send.append(lambda _, values: values.__setitem__(at, value))


def hold_torque(rig, outside: bool = False, step: int | None = None) -> Command:
    robot, state = rig.hal.robot, rig.hal.state
    torque = robot.hold_kp * (rig._anchor - state.position) - robot.hold_kd * state.velocity
    return Command(torque, np.zeros(8), step=step, outside=outside)


def walk(rig, cycles: int, **command):
    """A controller that holds its pose, for a while."""
    for _ in range(cycles):
        rig.hal.read()
        rig.hal.write(hold_torque(rig, **command))
    return rig.hal.state


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
    assert walk(rig, SATURATED_CYCLES + 1).supervisor is S.ACTIVE
    assert seen(rig, "TORQUE_SATURATED") == [("TORQUE_SATURATED", "warning")] * 2  # pending, then confirmed
    assert rig.cycle().supervisor is S.FULL_ASSIST
    assert hal.reason == "the limiter cuts the torque"


def test_a_controller_is_told_what_the_limits_left_of_its_last_command(rig):
    rig.until(S.ACTIVE)
    state = rig.hal.read()
    asked = state.torque_sent + 1e3
    rig.hal.write(Command(asked, np.zeros(8)))
    assert (rig.hal.read().torque_sent < asked).all()
    assert np.array_equal(state.torque_sent, rig.hal._limiter.last)
    little = state.torque_sent - 0.1
    rig.hal.write(Command(little, np.zeros(8)))
    assert rig.hal.read().torque_sent.tobytes() == little.tobytes()


def into_full_assist(rig):
    rig.until(S.ACTIVE)
    rig.hal._report(Dtc.FOOT_CELL, "a cell is stuck")
    state = walk(rig, 1)
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
        state = walk(rig, 1)
        assert 0.0 < state.assistance_factor - before <= PERIOD / ramp + 1e-12
        before = state.assistance_factor
    assert state.assistance_factor == 1.0
    assert rig.hal.record[rig.hal.layout["assistance_factor"]] == 1.0
    assert walk(rig, 10).assistance_factor == 1.0
    rig.operator.start()
    assert walk(rig, 2).supervisor is S.ACTIVE
    assert 0.99 < rig.hal.state.assistance_factor < 1.0
    assert walk(rig, cycles).assistance_factor == 0.5
    rig.operator.assist(0.2)
    assert walk(rig, 2).assistance_factor == 0.2  # the dial acts at once


def test_the_dial_does_not_widen_the_guide_in_full_assist(make_rig):
    rig = make_rig(assistance_factor=0.9)
    into_full_assist(rig)
    walk(rig, 150)
    rig.operator.assist(0.1)
    assert walk(rig, 5).assistance_factor == 1.0


def finishing(rig, step: int | None):
    rig.until(S.ACTIVE)
    walk(rig, 5, step=step)
    rig.hal._report(Dtc.SUPPLY_LOW, "the battery is nearly empty")
    return walk(rig, 1, step=step)


def test_finish_step_ends_in_hold_when_the_feet_change(rig):
    assert finishing(rig, 7).supervisor is S.FINISH_STEP
    assert walk(rig, 100, step=7).supervisor is S.FINISH_STEP
    rig.hal.read()
    rig.hal.write(hold_torque(rig, step=8))
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_of_a_controller_that_does_not_walk_is_hold(rig):
    assert finishing(rig, None).supervisor is S.FINISH_STEP
    assert rig.cycle().supervisor is S.HOLD


def test_finish_step_does_not_go_on_for_ever(rig):
    finishing(rig, 7)
    assert walk(rig, FINISH_STEP_CYCLES - 1, step=7).supervisor is S.FINISH_STEP
    assert walk(rig, 1, step=7).supervisor is S.HOLD


def test_a_joint_that_cannot_hold_is_let_down_and_the_others_hold(rig):
    rig.until(S.ACTIVE)
    rig.hal._heartbeats.emergencies["LEFT_SK"] = Dtc.EMCY_ENCODER, 0x7305
    rig.hal._heartbeats.quiet = False
    rig.hal._steady = False
    assert rig.cycle().supervisor is S.LOWER
    commands = last_commands(rig)
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
    assert controlwords(rig) == {Controlword.QUICK_STOP}


def test_a_start_ends_when_the_dead_man_is_released(rig):
    rig.operator._starts = False
    rig.until(S.READY)
    set_signal(rig, "LEFT_SK_STATE", "DriveState", DriveState.SWITCH_ON_DISABLED)
    rig.operator.start()
    rig.run(10)
    assert Controlword.SHUTDOWN in controlwords(rig)
    rig.operator.release()
    rig.run(3)
    assert controlwords(rig) == {Controlword.QUICK_STOP}
    rig.operator.squeeze()
    rig.run(ENABLE_CYCLES)
    assert controlwords(rig) == {Controlword.QUICK_STOP}
    assert "START_FAILED" not in rig.codes()


def test_a_joint_outside_the_guide_is_told_and_nothing_else(rig):
    rig.until(S.ACTIVE)
    assert walk(rig, 5, outside=True).supervisor is S.ACTIVE
    assert seen(rig, "GUIDE_OUTSIDE") == [("GUIDE_OUTSIDE", "info")]


# -- what the world is told --------------------------------------------------------------------------------------------


def test_active_diagnostics_are_in_the_record_and_the_worst_in_the_status(rig):
    rig.until(S.ACTIVE)
    diagnostics = rig.hal.layout["diagnostics"]
    assert rig.hal.record[diagnostics] == 0
    rig.bus.to_hal = drop(0x183)
    rig.run(5)
    assert dtcs_of(int(rig.hal.record[diagnostics][0])) == (Dtc.NODE_TIMEOUT,) or Dtc.NODE_TIMEOUT in dtcs_of(
        int(rig.hal.record[diagnostics][0])
    )
    rig.run(100)
    status = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x700)
    said = ORACLE.decode_message(0x700, status["data"][0, :24].tobytes(), decode_choices=False)
    assert said["DiagnosticCode"] == number_of(Dtc.NODE_TIMEOUT.bit)
    assert said["HalState"] == S.HOLD
    assert (said["DbcHash"], said["ConfigHash"]) == (rig.hal.network.hash32, rig.hal.robot.hash32)


def test_the_status_carries_the_hash_of_the_gait_and_the_step(make_rig):
    rig = make_rig(gait_hash=0xCAFE)
    rig.until(S.ACTIVE)
    walk(rig, 120, step=70000)
    status = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x700)
    said = ORACLE.decode_message(0x700, status["data"][0, :24].tobytes(), decode_choices=False)
    assert (said["GaitHash"], said["Step"]) == (0xCAFE, 70000 & 0xFFFF)


def test_a_change_of_state_says_why(rig):
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD, 5)
    assert rig.hal.events[-1].text == "ACTIVE -> HOLD: the operator asked to stop"
    assert rig.hal.reason == "the operator asked to stop"


# -- when things go wrong ----------------------------------------------------------------------------------------------


def test_an_exception_sends_the_prepared_hold_frame_under_the_next_counter(rig):
    rig.until(S.ACTIVE)
    rig.cycle(np.full(12, 10.0))
    before = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x100)["data"][0, 2]
    rig.hal.read()
    with pytest.raises(ValueError, match="broadcast") as mistake:
        rig.hal.write(Command(np.full(3, 10.0), np.zeros(8)))
    rig.hal._commands.torque.fill(np.nan)  # whatever else was written before it raised
    sent = rig.hal.fail(mistake.value)
    assert not sent.any()
    frames = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x100)
    assert (frames["data"][:, 2] == (int(before) + 1) & 0xFF).all()
    assert controlwords(rig) == {Controlword.QUICK_STOP}
    assert not torques(rig).any()


def test_the_cycle_after_an_exception_is_whole(rig):
    rig.until(S.ACTIVE)
    rig.hal.read()
    rig.hal.fail(ValueError("a mistake"))
    assert rig.cycle().supervisor is S.HOLD
    state = rig.run(5)
    assert (state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()
    assert state.valid.all()
    assert not [e for e in rig.hal.events if e.code.startswith("E2E")]


def test_a_gap_drops_what_piled_up_and_holds(rig):
    rig.until(S.ACTIVE)
    rig.hal.report(Dtc.CYCLE_GAP, "2000 ms went by without a cycle", value=2.0)
    assert rig.cycle().supervisor is S.HOLD
    event = next(e for e in rig.hal.events if e.code == "CYCLE_GAP")
    assert (event.cycle, event.value, event.severity) == (rig.hal.state.cycle, 2.0, "error")


def test_a_short_gap_is_noted(rig):
    rig.until(S.ACTIVE)
    rig.hal.report(Dtc.CYCLE_GAP, "4 ms went by without a cycle", confirmed=False, value=0.004)
    assert rig.cycle().supervisor is S.ACTIVE
    assert seen(rig, "CYCLE_GAP") == [("CYCLE_GAP", "warning")]


def own_frame(frames):
    alien = frames[:1].copy()
    alien["can_id"] = 0x100
    return np.concatenate([frames, alien])


def test_another_hal_ends_a_running_one_in_hold_and_keeps_a_new_one_off(make_rig):
    rig = make_rig()
    rig.until(S.ACTIVE)
    rig.bus.to_hal = own_frame
    assert rig.cycle().supervisor is S.HOLD
    assert seen(rig, "HAL_DUPLICATE") == [("HAL_DUPLICATE", "error")]
    new = make_rig()
    new.bus.to_hal = own_frame
    new.cycle()
    new.bus.to_hal = lambda frames: frames
    assert new.run(500).supervisor is S.OFF
    assert "another HAL was there first" in new.hal._memory.text_of(frozenset({Dtc.HAL_DUPLICATE})) or (
        "HAL_DUPLICATE" in new.codes()
    )


def test_stopping_on_a_dead_bus_takes_a_bounded_time(network, robot, monkeypatch):
    """A clock that the bus moves on: nobody ever answers, and every wait is waited to its end."""
    import atalante_hal.hal as module
    import atalante_hal.transceiver as transceiver

    class Dead:
        name, dropped, stamps, now = "dead", 0, np.zeros(128, np.int64), 0.0

        def send(self, frames):
            pass

        def receive(self, frames, timeout=0.0):
            self.now += timeout
            return 0

        def close(self):
            pass

    bus = Dead()
    for one in (module, transceiver):
        monkeypatch.setattr(one.time, "monotonic", lambda: bus.now)
    hal = Hal(network, robot, bus, patience=2.0)
    hal._image.age.fill(0)  # everybody was there a moment ago
    hal.stop()
    assert bus.now <= module.STOP_PATIENCE + 0.01
    assert hal.patience == 2.0


def test_listening_before_the_start_sends_nothing(rig):
    rig.bus.to_hal = lambda frames: frames[:0]
    rig.hal.listen()
    assert rig.sent == []


def test_the_bus_and_the_tap_can_be_changed(rig):
    assert rig.hal.bus is rig.bus
    tap = rig.hal.tap
    rig.hal.tap = None
    rig.cycle()
    assert rig.sent == []
    rig.hal.tap = tap
    rig.cycle()
    assert rig.sent
    rig.hal.bus = rig.bus
    assert rig.hal.bus is rig.bus
    assert not rig.hal.silent


def hot(rig, **degrees: float):
    for node, value in degrees.items():
        set_signal(rig, f"{node}_STATE", "Temperature", value)


def test_the_torque_limit_of_a_hot_drive_follows_within_a_cycle_and_is_told(rig):
    rig.until(S.ACTIVE)
    hot(rig, LEFT_SK=100.0, RIGHT_SK=100.0)
    assert rig.cycle().supervisor is S.ACTIVE
    limit = rig.hal.robot.torque_limit(rig.hal.state.temperature)
    assert limit[3] < rig.hal.robot.torque_max[3]
    commands = last_commands(rig)
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


def test_reading_without_writing_goes_on_with_the_next_sync(rig):
    for _ in range(3):
        rig.hal.read()
    syncs = [int(f["data"][0, 2]) for f in rig.sent if f["can_id"][0] == 0x10]
    assert [b - a & 0xFF for a, b in itertools.pairwise(syncs)] == [1, 1]
    assert rig.hal.state.valid.shape == (19,)


def test_a_heartbeat_that_fails_to_come_is_noticed_while_all_else_is_well(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = drop(0x704)
    assert rig.run(360).supervisor is S.ACTIVE
    assert seen(rig, "HEARTBEAT_LOST") == [("HEARTBEAT_LOST", "warning")]
