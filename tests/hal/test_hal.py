"""HAL on an embedded bus: start-up, sent frames, and every transition to HOLD."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import re
from copy import deepcopy
from dataclasses import fields

import numpy as np
import pytest
from command_limits import database

from atalante_hal.bus import BusDown, BusFull
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, dtcs_of, number_of
from atalante_hal.transceiver import RECEIVE_BUDGET
from atalante_hal.types import Command, State, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

S = SupervisorState
KNEE = JOINTS.index("left_SK")


def torques(rig) -> np.ndarray:
    commands = rig.last_commands()
    return np.array([commands[j.split("_")[0]][f"{j.split('_')[1]}_TargetTorque"] for j in JOINTS])


def test_start_passes_off_ready_and_active(rig):
    assert rig.cycle().supervisor is S.OFF
    rig.until(S.READY)
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    state = rig.until(S.ACTIVE)
    assert (state.drive_state == DriveState.OPERATION_ENABLED).all()
    rig.cycle()
    assert rig.controlwords() == {Controlword.ENABLE_OPERATION}
    assert [c for c in rig.codes() if c in S.__members__] == ["READY", "ACTIVE"]


def test_write_returns_the_torque_that_is_sent(rig):
    rig.until(S.ACTIVE)
    rng = np.random.default_rng(0)
    for _ in range(50):
        rig.hal.read()
        sent = rig.hal.write(Command(rng.uniform(-400, 400, 12), np.zeros(8)))
        assert np.abs(torques(rig) - sent).max() <= 0.0125 / 2 + 1e-9
        assert (np.abs(torques(rig)) <= rig.hal.robot.torque_max).all()


def test_torques_are_ignored_outside_active(rig):
    rig.until(S.READY)
    sent = rig.hal.write(Command(np.full(12, 50.0), np.ones(8)))
    assert not sent.any()
    assert rig.controlwords() == {Controlword.QUICK_STOP}


def test_record_contains_the_values_of_the_state(rig):
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
    assert np.abs(hal.record[hal.layout["torque_command"]] - torques(rig)).max() < 0.00626  # resolution on the wire


def test_joint_position_is_motor_position_over_gear(rig):
    state = rig.until(S.ACTIVE)
    record, layout = rig.hal.record, rig.hal.layout
    assert np.allclose(record[layout["motor_position"]] / 100.0, state.position, rtol=1e-12)
    assert np.allclose(rig.emulator.body.position, state.position, atol=5e-3)  # the body has moved for another 1 ms
    assert np.allclose(np.linalg.norm(state.imu_quaternion, axis=1), 1.0, atol=1e-3)
    assert state.imu_accel[1] == pytest.approx([0, 0, 9.81], abs=0.5)


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan")])
def test_assistance_factor_out_of_range_is_rejected(factor, network, robot, rig):
    with pytest.raises(ValueError, match="between 0 and 1"):
        Hal(network, robot, rig.bus, assistance_factor=factor)


@pytest.mark.sample(4)
@pytest.mark.parametrize("joint", JOINTS)
def test_silent_drive_leads_to_hold_after_exactly_five_lost_frames(rig, joint, network):
    message = network.message(f"{joint.upper()}_STATE")
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(message.frame_id)
    assert rig.run(message.timeout_ms - 1).supervisor is S.ACTIVE
    assert rig.cycle().supervisor is S.HOLD
    assert message.sender in rig.hal.reason
    assert rig.hal.missing() == [message.sender]


def test_four_lost_frames_are_tolerated(rig):
    rig.until(S.ACTIVE)
    rig.bus.to_hal = rig.drop(0x183)
    state = rig.run(4)
    assert not state.joints_valid
    rig.bus.to_hal = lambda frames: frames
    assert rig.run(10).supervisor is S.ACTIVE, rig.hal.events
    assert rig.hal.state.joints_valid


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_torque_of_nan_or_infinity_sends_hold_in_the_same_cycle(rig, bad):
    rig.until(S.ACTIVE)
    torque = np.zeros(12)
    torque[4] = bad
    rig.cycle(torque)
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    assert not torques(rig).any()
    assert rig.cycle().supervisor is S.HOLD
    assert "finite" in rig.hal.reason


@pytest.mark.parametrize("error", [BusDown("the interface is down"), BusFull("the queue is full")])
def test_failing_bus_leads_to_hold_and_raises_nothing(make_rig, monkeypatch, error):
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
    assert 0.0 < max(waits) <= 0.1  # the wait for answers is short, because the SYNC was not sent
    rig.bus.to_nodes = lambda frames: frames
    assert rig.run(50).supervisor is S.HOLD


def test_reason_in_hold_follows_the_error_of_the_bus(rig):
    rig.until(S.ACTIVE)

    def refuse(frames):
        raise error

    rig.bus.to_nodes = refuse
    for text in ("can0 is down", "can0 was removed"):
        error = BusDown(text)
        assert rig.run(3).supervisor is S.HOLD
        assert rig.hal.reason.endswith(text)
    rig.bus.to_nodes = lambda frames: frames
    rig.run(50)
    assert rig.hal.reason.endswith("can0 was removed")


def test_stop_leaves_every_drive_holding(rig):
    rig.until(S.ACTIVE)
    rig.hal.stop()
    assert rig.hal.state.supervisor is S.HOLD
    assert (rig.hal.state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()


def test_damaged_frames_are_counted_and_rejected(rig):
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
            message = database().get_message_by_frame_id(int(frame["can_id"]))
            assert frame["len"] == message.length
            message.decode(frame["data"][: message.length].tobytes())
            seen.add(message.name)
    assert {"SYNC_LEFT_LEG", "SYNC_RIGHT_SENSE", "COMMAND_LEFT_LEG", "HAPTICS_COMMAND", "HAL_STATUS"} <= seen


def test_state_contains_the_limited_torque_of_the_last_command(rig):
    rig.until(S.ACTIVE)
    state = rig.hal.read()
    requested = state.torque_sent + 1e3
    rig.hal.write(Command(requested, np.zeros(8)))
    assert (rig.hal.read().torque_sent < requested).all()
    before = state.torque_sent.copy()
    little = before - 0.1
    sent = rig.hal.write(Command(little, np.zeros(8)))
    assert sent.tobytes() == little.tobytes()
    assert state.torque_sent.tobytes() == before.tobytes(), "the state of a cycle changes only with the next read"
    assert rig.hal.read().torque_sent.tobytes() == little.tobytes()


@pytest.mark.parametrize(
    "name",
    [field.name for field in dataclasses.fields(State) if "Vector" in str(field.type) or "NDArray" in str(field.type)],
)
def test_controller_cannot_write_into_the_arrays_that_the_hal_checks(name, rig):
    rig.until(S.ACTIVE)
    state = rig.hal.read()
    requested = state.torque_sent + 0.1
    before = getattr(state, name).copy()
    with pytest.raises(ValueError, match="read-only"):
        getattr(state, name)[:] = 0
    assert getattr(state, name).tobytes() == before.tobytes()
    assert rig.hal.write(Command(requested, np.zeros(8))).tobytes() == requested.tobytes()


def test_controller_that_resets_the_ages_does_not_delay_a_timeout(rig):
    """With the ages of the HAL set to 0 in each cycle, a silent drive was reported 11 cycles later."""

    class Careless:
        telemetry, telemetry_fields = np.zeros(0), ()

        def reset(self, state: State) -> None:
            rig.bus.to_hal = rig.drop(0x184)
            self.torque = state.torque.copy()

        def update(self, state: State) -> Command:
            with contextlib.suppress(ValueError):
                state.age[:] = 0
            return Command(self.torque, np.zeros(8))

    run(rig.hal, Careless(), LockStep(), until=lambda state: state.supervisor is S.HOLD or state.cycle > 1000)
    assert rig.hal.reason == "LEFT_SK: a node timed out; its data is 5 cycles old"


@pytest.mark.parametrize("field", [field.name for field in fields(State)])
def test_controller_that_assigns_to_a_field_of_the_state_does_not_change_a_check(rig, field: str):
    """The field keeps its value of the first cycle, as after `state.age = state.age + 0` in that cycle."""

    class Careless:
        telemetry, telemetry_fields = np.zeros(0), ()

        def reset(self, state: State) -> None:
            rig.bus.to_hal = rig.drop(0x184)
            self.torque, self.first = state.torque.copy(), deepcopy(getattr(state, field))
            self.calls = 0

        def update(self, state: State) -> Command:
            self.calls += 1
            setattr(state, field, self.first)
            return Command(self.torque, np.zeros(8))

    controller, cycles = Careless(), itertools.count()
    run(rig.hal, controller, LockStep(), until=lambda _: "NODE_TIMEOUT" in rig.codes() or next(cycles) > 1000)
    assert rig.hal.reason == "LEFT_SK: a node timed out; its data is 5 cycles old"
    assert controller.calls == 5
    first = rig.hal.state.cycle
    rig.hal.read()
    assert rig.hal.state.cycle == first + 1


def test_hot_drive_is_noticed_if_the_controller_replaces_its_temperature(rig):
    class Careless:
        telemetry, telemetry_fields = np.zeros(0), ()

        def reset(self, state: State) -> None:
            self.torque = state.torque.copy()

        def update(self, state: State) -> Command:
            state.temperature = state.temperature - 0.5
            rig.emulator.drives.motors.temperature[KNEE] = 115.0
            return Command(self.torque, np.zeros(8))

    cycles = itertools.count()
    run(rig.hal, Careless(), LockStep(), until=lambda _: "DERATED" in rig.codes() or next(cycles) > 1000)
    assert next(cycles) < 1000


def test_write_into_the_state_leads_to_hold_with_a_reason(rig):
    class Careless:
        telemetry, telemetry_fields = np.zeros(0), ()

        def reset(self, state: State) -> None:
            pass

        def update(self, state: State) -> Command:
            state.position -= 0.1  # changes the array, as `error = state.position; error -= rest` does
            return Command(state.position, np.zeros(8))

    run(rig.hal, Careless(), LockStep(), until=lambda state: "CONTROLLER_ERROR" in rig.codes() or state.cycle > 1000)
    assert rig.hal.reason == "the controller raised ValueError: output array is read-only"


def test_joint_outside_the_guide_is_pending_and_outside_for_long_leads_to_full_assist(rig):
    rig.until(S.ACTIVE)
    assert rig.walk(5, outside=True).supervisor is S.ACTIVE
    assert rig.events_of("GUIDE_OUTSIDE") == [("GUIDE_OUTSIDE", "warning")]
    assert rig.walk(5, outside=True, guide_left=True).supervisor is S.FULL_ASSIST
    assert rig.events_of("GUIDE_OUTSIDE")[-1] == ("GUIDE_OUTSIDE", "warning")


def test_text_of_a_negative_safety_value_does_not_claim_that_a_joint_is_outside(rig):
    rig.until(S.ACTIVE)
    rig.walk(1, outside=True)
    (text,) = (event.text for event in rig.hal.events if event.code == "GUIDE_OUTSIDE")
    assert (
        text
        == "h < 0: a joint is outside the virtual guide, or is predicted to exceed its guide, torque or speed limit"
    )


def test_step_start_outside_the_hand_over_box_is_pending(rig):
    rig.until(S.ACTIVE)
    assert rig.walk(5, hand_over_exceeded=True).supervisor is S.ACTIVE
    assert rig.events_of("GUIDE_OUTSIDE") == [("GUIDE_OUTSIDE", "warning")]


def test_record_lists_diagnostics_and_status_the_most_severe(rig):
    rig.until(S.ACTIVE)
    diagnostics = rig.hal.layout["diagnostics"]
    assert rig.hal.record[diagnostics] == 0
    rig.bus.to_hal = rig.drop(0x183)
    rig.run(5)
    assert Dtc.NODE_TIMEOUT in dtcs_of(int(rig.hal.record[diagnostics][0]))
    rig.run(100)
    status = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x700)
    status_values = database().decode_message(0x700, status["data"][0, :24].tobytes(), decode_choices=False)
    assert status_values["DiagnosticCode"] == number_of(Dtc.NODE_TIMEOUT.bit)
    assert status_values["HalState"] == S.HOLD
    assert (status_values["DbcHash"], status_values["ConfigHash"]) == (rig.hal.network.hash32, rig.hal.robot.hash32)


def test_status_contains_gait_hash_and_step(make_rig):
    rig = make_rig(gait_hash=0xCAFE)
    rig.until(S.ACTIVE)
    rig.walk(120, step=70000)
    status = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x700)
    status_values = database().decode_message(0x700, status["data"][0, :24].tobytes(), decode_choices=False)
    assert (status_values["GaitHash"], status_values["Step"]) == (0xCAFE, 70000 & 0xFFFF)


@pytest.mark.parametrize("vibration", [np.zeros(7), np.zeros((2, 8)), np.zeros(()), 0.5])
def test_vibration_of_another_shape_is_rejected(vibration, rig):
    rig.until(S.ACTIVE)
    rig.hal.read()
    shape = str(np.shape(vibration))
    with pytest.raises(ValueError, match=rf"the vibration must have shape \(8,\), got {re.escape(shape)}"):
        rig.hal.write(Command(rig.hal.state.torque_sent, vibration))


def test_exception_sends_the_prepared_hold_frame(rig):
    rig.until(S.ACTIVE)
    rig.cycle(np.full(12, 10.0))
    before = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x100)["data"][0, 2]
    rig.hal.read()
    with pytest.raises(ValueError, match=r"the torque must have shape \(12,\), got \(3,\)") as mistake:
        rig.hal.write(Command(np.full(3, 10.0), np.zeros(8)))
    rig.hal._commands.torque.fill(np.nan)  # an exception may leave any values in the transmit buffer
    sent = rig.hal.fail(mistake.value)
    assert not sent.any()
    frames = next(f for f in reversed(rig.sent) if f["can_id"][0] == 0x100)
    assert (frames["data"][:, 2] == (int(before) + 1) & 0xFF).all()
    assert rig.controlwords() == {Controlword.QUICK_STOP}
    assert not torques(rig).any()


def test_cycle_after_an_exception_is_complete(rig):
    rig.until(S.ACTIVE)
    rig.hal.read()
    rig.hal.fail(ValueError("a mistake"))
    assert rig.cycle().supervisor is S.HOLD
    state = rig.run(5)
    assert (state.drive_state == DriveState.QUICK_STOP_ACTIVE).all()
    assert state.valid.all()
    assert not [e for e in rig.hal.events if e.code.startswith("E2E")]


def test_long_cycle_gap_leads_to_hold(rig):
    rig.until(S.ACTIVE)
    rig.hal.report(Dtc.CYCLE_GAP, "no cycle began for 2000 ms", value=2.0)
    assert rig.cycle().supervisor is S.HOLD
    event = next(e for e in rig.hal.events if e.code == "CYCLE_GAP")
    assert (event.cycle, event.value, event.severity) == (rig.hal.state.cycle, 2.0, "error")


def test_emergency_and_unknown_frame_in_a_long_cycle_gap_are_processed_and_old_answers_are_dropped(rig):
    messages = [rig.hal.network.message(name) for name in ("LEFT_SK_STATE", "LEFT_SK_EMCY")]
    image = TransmitImage(messages)
    image.values[image.codec.index("LEFT_SK_EMCY", "ErrorCode")] = 0x2310
    queued = np.concatenate([image.seal().copy(), new_frames(1)])
    queued["can_id"][2] = 0x7FF
    rig.until(S.ACTIVE)
    rig.bus.to_hal = lambda frames: queued
    rig.hal.report(Dtc.CYCLE_GAP, "no cycle began for 2000 ms", value=2.0)
    rig.bus.to_hal = lambda frames: frames
    assert rig.cycle().supervisor is S.FAULT
    assert sorted(rig.events_of("EMCY_2310", "FRAME_UNKNOWN", "CYCLE_GAP")) == [
        ("CYCLE_GAP", "error"),
        ("EMCY_2310", "error"),
        ("FRAME_UNKNOWN", "warning"),
    ]
    assert not [code for code in rig.codes() if code.startswith("E2E")]
    assert rig.hal.state.valid.all()


@pytest.mark.parametrize("code", [0, 0x3210], ids=["no fault", "emergency"])
def test_start_that_is_pressed_in_a_long_cycle_gap_starts_nothing(rig, code: int):
    """The operator could not see the faults of the gap yet. The next press counts."""
    rig.until(S.ACTIVE)
    rig.operator.hold()
    rig.until(S.HOLD)
    rig.run(50)
    rig.operator.start()
    image = TransmitImage([rig.hal.network.message("LEFT_SK_EMCY")])
    image.values[image.codec.index("LEFT_SK_EMCY", "ErrorCode")] = code
    queued = image.seal().copy()
    rig.bus.to_hal = lambda frames: queued
    rig.hal.report(Dtc.CYCLE_GAP, "no cycle began for 50 ms", value=0.05)
    rig.bus.to_hal = lambda frames: frames
    for _ in range(400):
        assert rig.cycle().supervisor is S.HOLD
    assert ("EMCY_3210" in rig.codes()) == (code != 0)
    rig.operator.start()
    rig.until(S.ACTIVE)


def test_flood_in_a_long_cycle_gap_is_processed_in_bounded_work(rig, monkeypatch):
    """Each unknown identifier is reported once, and only so many slow messages are processed as one cycle may receive."""
    rig.until(S.ACTIVE)
    image = TransmitImage([rig.hal.network.message("LEFT_SK_EMCY")])
    flood = np.concatenate([image.seal().copy(), new_frames(1)] * (RECEIVE_BUDGET // 2))
    flood["can_id"][1::2] = 0x7FF
    accepted: list[int] = []
    accept_each = ReceiveImage.accept_each

    def count(image: ReceiveImage, frames, number, tag=None):
        accepted.append(number)
        return accept_each(image, frames, number, tag)

    monkeypatch.setattr(ReceiveImage, "accept_each", count)
    rig.bus.to_hal = lambda frames: flood
    rig.hal.report(Dtc.CYCLE_GAP, "no cycle began for 50 ms", value=0.05)
    rig.bus.to_hal = lambda frames: frames
    assert sum(accepted) <= RECEIVE_BUDGET
    rig.cycle()
    assert rig.events_of("FRAME_UNKNOWN") == [("FRAME_UNKNOWN", "warning")]


def test_short_cycle_gap_is_reported_as_warning(rig):
    rig.until(S.ACTIVE)
    rig.hal.report(Dtc.CYCLE_GAP, "no cycle began for 4 ms", confirmed=False, value=0.004)
    assert rig.cycle().supervisor is S.ACTIVE
    assert rig.events_of("CYCLE_GAP") == [("CYCLE_GAP", "warning")]


def test_stop_on_a_dead_bus_takes_a_bounded_time(network, robot, monkeypatch):
    """No node answers. Simulated time passes only while the HAL waits."""
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
    hal._image.age.fill(0)  # all nodes were alive before
    hal.stop()
    assert bus.now <= module.STOP_PATIENCE + 0.01
    assert hal.patience == 2.0


def test_listen_sends_nothing(rig):
    rig.bus.to_hal = lambda frames: frames[:0]
    rig.hal.listen()
    assert rig.sent == []


def test_bus_and_tap_can_be_replaced(rig):
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


def test_read_without_write_sends_the_next_sync(rig):
    for _ in range(3):
        rig.hal.read()
    syncs = [int(f["data"][0, 2]) for f in rig.sent if f["can_id"][0] == 0x10]
    assert [b - a & 0xFF for a, b in itertools.pairwise(syncs)] == [1, 1]
    assert rig.hal.state.valid.shape == (19,)
