"""The HAL on an embedded bus: start-up, what is sent, and every way into HOLD."""

from __future__ import annotations

from dataclasses import replace

import cantools
import numpy as np
import pytest

from atalante_dbc import DBC_FILE
from atalante_hal.bus import BusDown, BusFull
from atalante_hal.cia402 import Controlword, DriveState
from atalante_hal.hal import Hal
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
def test_a_bus_that_refuses_frames_ends_in_hold_and_raises_nothing(rig, error):
    rig.until(S.ACTIVE)

    def refuse(frames):
        raise error

    rig.bus.to_nodes = refuse
    assert rig.run(8).supervisor is S.HOLD
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
