from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.faults import Fault, FaultError
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.robot import CELLS, Robot
from atalante_hal.types import PERIOD
from atalante_hal.wire.cia402 import DriveState, controlword_towards_operation
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

CROUCHED = [0.0, 0.0, -0.4, 0.7, -0.1, 0.0] * 2
KNEE, HENKE = 3, 5  # of the left leg
ENABLED, HOLDING = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE
#: Cycle in which the faults of most tests begin. By then the drives are enabled and hold their pose.
BEGIN = 30


class PoseHolder:
    """A minimal HAL: enables the drives and holds the pose with a position loop."""

    def __init__(self, network: Network, robot: Robot, bus: PairBus) -> None:
        cyclic = [m for m in network.sent_by("HAL") if m.cycle_ms == 1]
        self.robot, self.bus, self.cycle = robot, bus, 0
        self.tx = TransmitImage(
            [m for m in cyclic if not m.name.startswith("SYNC_")] + [m for m in cyclic if m.name.startswith("SYNC_")]
        )
        received = network.received_by("HAL")
        self.fast, self.slow = (
            ReceiveImage([m for m in received if (m.cycle_ms == 1) is fast]) for fast in (True, False)
        )
        values, codec = self.tx.values, self.tx.codec
        self.word, self.target = values[codec.slice("Controlword")], values[codec.slice("TargetTorque")]
        values[codec.slice("MaxTorque")] = robot.torque_max
        self._sync_cycle = codec.slice("Cycle")
        self._names = {m.frame_id: m.name for m in network.messages} | {0: "flood"}
        self._buffer = new_frames(128)
        self.sent: list[list[str]] = []
        self.frames: list[Frames] = []
        self.states: list[list[int]] = []
        self.enabling = True

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle += 1
            self.tx.values[self._sync_cycle] = self.cycle
            self.bus.send(self.tx.seal())
            count = self.bus.receive(self._buffer)
            self.frames.append(self._buffer[:count].copy())
            self.sent.append([self._names[i] for i in self.frames[-1]["can_id"].tolist()])
            self.fast.accept(self._buffer, count)
            self.slow.new_cycle()
            self.slow.accept_each(self._buffer, count)
            self.states.append([int(s) for s in self.joints("DriveState")])
            if self.enabling:
                self.word[:] = [controlword_towards_operation(state) for state in self.states[-1]]
            position, velocity = (
                self.joints(s) / (self.robot.gear * self.robot.polarity) for s in ("Position", "Velocity")
            )
            self.target[:] = self.robot.hold_kp * (CROUCHED - position) - self.robot.hold_kd * velocity

    def joints(self, signal: str) -> np.ndarray:
        first = self.fast.codec.index("LEFT_FH_STATE", signal)
        return self.fast.values[first : first + 12].copy()

    def value(self, message: str, signal: str) -> float:
        image = self.fast if message in self.fast.codec.rows else self.slow
        return float(image.values[image.codec.index(message, signal)])

    def emergencies(self) -> list[tuple[int, str]]:
        """Return the cycle and the message name of every emergency."""
        return [(cycle, name) for cycle, names in enumerate(self.sent) for name in names if name.endswith("_EMCY")]


World = tuple[PoseHolder, Emulator]


@pytest.fixture
def world(network: Network, robot: Robot, urdf_text: str) -> Iterator[Callable[..., World]]:
    bodies: list[PyBulletBody] = []

    def build(*faults: Fault, cycles: int = 0, seed: int = 0) -> World:
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        body.reset(CROUCHED)
        bodies.append(body)
        emulator = Emulator(network, robot, body, theirs, seed=seed, operator=Operator(), faults=faults)
        ours.step = emulator.poll
        hal = PoseHolder(network, robot, ours)
        hal.run(cycles)
        return hal, emulator

    yield build
    for body in bodies:
        body.close()


Make = Callable[..., World]


def test_inactive_faults_do_not_change_any_byte(world: Make) -> None:
    plain, _ = world(cycles=150)
    waiting, _ = world(
        Fault("encoder_jump", "LEFT_SK", 10_000, by=1.0),
        Fault("imu_frozen", "IMU_TORSO", 10_000),
        Fault("drop", "LEFT_SK", 10_000),
        cycles=150,
    )
    assert [f.tobytes() for f in plain.frames] == [f.tobytes() for f in waiting.frames]
    assert set(plain.states[BEGIN]) == {ENABLED}


class TestDrives:
    @pytest.mark.parametrize("state", ["SWITCHED_ON", "READY_TO_SWITCH_ON", "FAULT", "QUICK_STOP_ACTIVE"])
    def test_drive_leaves_operation_for_the_requested_state(self, world: Make, state: str) -> None:
        hal, _ = world(Fault("leave_operation", "LEFT_SK", BEGIN, 3, state=state), cycles=BEGIN + 3)
        assert [row[KNEE] for row in hal.states[BEGIN - 1 :]] == [ENABLED] + [DriveState[state]] * 3
        assert {s for row in hal.states[BEGIN:] for d, s in enumerate(row) if d != KNEE} == {ENABLED}

    def test_slow_drive_is_enabled_later_than_the_others(self, world: Make) -> None:
        hal, _ = world(Fault("enable_delay", "LEFT_SK", 0, by=5), cycles=40)
        first = [[row[d] for row in hal.states].index(ENABLED) for d in range(12)]
        assert set(np.delete(first, KNEE)) == {first[0]}
        assert first[KNEE] - first[0] == 5

    @pytest.mark.parametrize(
        ("state", "after"), [("FAULT_REACTION_ACTIVE", "FAULT"), ("NOT_READY_TO_SWITCH_ON", "SWITCH_ON_DISABLED")]
    )
    def test_transitional_state_ends_in_its_cia402_successor(self, world: Make, state: str, after: str) -> None:
        hal, _ = world(Fault("leave_operation", "LEFT_SK", BEGIN, 2, state=state), cycles=BEGIN + 3)
        assert [row[KNEE] for row in hal.states[BEGIN:]] == [DriveState[state]] * 2 + [DriveState[after]]

    def test_push_moves_the_joint_while_it_lasts(self, world: Make) -> None:
        hal, emulator = world(Fault("push", "LEFT_SK", BEGIN, 100, torque=60.0), cycles=BEGIN + 60)
        _, quiet = world(cycles=BEGIN + 60)
        moved = emulator.body.position - quiet.body.position
        assert 0.5 < moved[KNEE] * hal.robot.hold_kp[KNEE] / 60.0 < 1.0
        assert np.abs(moved[6:]).max() < 1e-3
        hal.run(300)
        quiet_end = world(cycles=BEGIN + 360)[1].body.position
        assert emulator.body.position[KNEE] == pytest.approx(quiet_end[KNEE], abs=2e-3)

    def test_emergency_of_a_drive_starts_a_fault_reaction_and_ends_with_the_fault(self, world: Make) -> None:
        hal, emulator = world(Fault("emergency", "LEFT_HA", BEGIN, 50, code=0x7305), cycles=BEGIN + 1)
        assert hal.emergencies() == [(BEGIN, "LEFT_HA_EMCY")]
        sent = [hal.value("LEFT_HA_EMCY", signal) for signal in ("ErrorCode", "ErrorRegister")]
        assert sent == [0x7305, 0x21]
        assert hal.states[BEGIN][HENKE] == DriveState.FAULT_REACTION_ACTIVE
        hal.run(250)
        assert [name for _, name in hal.emergencies()] == ["LEFT_HA_EMCY"] * 2
        assert hal.value("LEFT_HA_EMCY", "ErrorCode") == 0
        assert emulator.drives.state[HENKE] is ENABLED  # the HAL acknowledges every fault

    def test_permanent_emergency_of_a_drive_cannot_be_reset(self, world: Make) -> None:
        hal, _ = world(Fault("emergency", "LEFT_HA", BEGIN, code=0x2310), cycles=BEGIN + 300)
        assert hal.states[-1][HENKE] == DriveState.FAULT
        assert len(hal.emergencies()) == 1

    def test_emergency_of_a_sensor_is_sent_at_its_begin_and_end(self, world: Make) -> None:
        hal, _ = world(Fault("emergency", "IMU_TORSO", BEGIN, 5, code=0x5000), cycles=BEGIN + 1)
        assert hal.value("IMU_TORSO_EMCY", "ErrorCode") == 0x5000
        hal.run(10)
        assert hal.emergencies() == [(BEGIN, "IMU_TORSO_EMCY"), (BEGIN + 5, "IMU_TORSO_EMCY")]
        assert hal.value("IMU_TORSO_EMCY", "ErrorCode") == 0

    def test_heartbeat_contains_the_error_register(self, world: Make) -> None:
        hal, _ = world(Fault("emergency", "LEFT_SK", BEGIN, code=0x2310), cycles=BEGIN + 120)
        assert hal.value("LEFT_SK_STATUS", "ErrorFlags") == 0x03
        assert hal.value("LEFT_SH_STATUS", "ErrorFlags") == 0

    def test_joint_with_weak_torque_sags_and_recovers(self, world: Make) -> None:
        hal, emulator = world(Fault("torque_weak", "LEFT_SK", BEGIN, 200, share=0.5), cycles=BEGIN + 100)
        sag = CROUCHED[KNEE] - emulator.body.position[KNEE]
        healthy, other = world(cycles=BEGIN + 100)
        assert sag > 1.5 * (CROUCHED[KNEE] - other.body.position[KNEE])
        assert hal.joints("Torque")[KNEE] > 1.2 * healthy.joints("Torque")[KNEE] > 0.0
        hal.run(400)
        assert CROUCHED[KNEE] - emulator.body.position[KNEE] < 0.9 * sag

    @pytest.mark.parametrize("share", [-1.0, 0.0, 0.5])
    def test_drive_with_a_wrong_torque_measures_it_until_the_fault_ends(self, world: Make, share: float) -> None:
        hal, emulator = world(Fault("torque_wrong", "LEFT_SK", BEGIN, 10, share=share), cycles=BEGIN + 8)
        wanted = emulator.drives.motors.wanted[KNEE]
        assert abs(wanted) > 5.0
        assert hal.joints("Torque")[KNEE] == pytest.approx(share * wanted, abs=0.3 * abs(wanted))
        hal.run(30)
        assert hal.joints("Torque")[KNEE] == pytest.approx(emulator.drives.motors.wanted[KNEE], abs=0.3 * abs(wanted))

    def test_torque_of_a_late_motor_arrives_late_until_the_fault_ends(self, world: Make) -> None:
        late, emulator = world(Fault("torque_late", "LEFT_SK", BEGIN, 200, by=7), cycles=BEGIN - 1)
        healthy, other = world(cycles=BEGIN - 1)
        wanted, torque = [], []
        for _ in range(200):
            late.run(1)
            wanted.append(emulator.drives.motors.wanted[KNEE])
            torque.append(late.joints("Torque")[KNEE])
        lags = [abs(np.subtract(torque[20:], wanted[20 - lag : 200 - lag])).sum() for lag in range(12)]
        assert int(np.argmin(lags)) == 7 + 1  # one cycle until the torque is measured and sent
        late.run(50)
        assert not emulator.drives.motors._dead_time.any()
        del healthy, other

    def test_over_temperature_lowers_the_joint_slowly(self, world: Make) -> None:
        hal, emulator = world(Fault("over_temperature", "LEFT_SK", BEGIN, 20, degrees=130.0), cycles=BEGIN + 1)
        assert hal.joints("Temperature")[KNEE] == 130.0
        assert hal.states[-1][KNEE] == DriveState.FAULT_REACTION_ACTIVE
        assert hal.value("LEFT_SK_EMCY", "ErrorCode") == 0x4310
        before = emulator.body.position[KNEE]
        hal.run(150)
        assert emulator.body.position[KNEE] < before - 0.005  # sinks
        assert np.abs(emulator.body.velocity).max() < 0.4  # slowly

    def test_temperature_rises_linearly_during_a_heat_ramp(self, world: Make) -> None:
        hal, _ = world(Fault("heat_ramp", "LEFT_SK", BEGIN, rate=1000.0, up_to=110.0), cycles=BEGIN + 40)
        assert hal.joints("Temperature")[KNEE] == pytest.approx(25.0 + 40.0, abs=1.0)
        hal.run(60)
        assert hal.joints("Temperature")[KNEE] == 110.0
        assert hal.states[-1][KNEE] == ENABLED

    def test_reset_drive_is_silent_then_boots_disabled(self, world: Make) -> None:
        hal, _ = world(Fault("reset", "LEFT_SK", BEGIN, 40), cycles=BEGIN + 100)
        mine = [[n for n in names if n.startswith("LEFT_SK_")] for names in hal.sent]
        assert mine[BEGIN - 1] == ["LEFT_SK_STATE"]
        assert mine[BEGIN : BEGIN + 40] == [[]] * 40
        assert mine[BEGIN + 40] == ["LEFT_SK_STATE", "LEFT_SK_STATUS"]
        status = next(f for f in hal.frames[BEGIN + 40] if int(f["can_id"]) == 0x704)
        assert (status["data"][2], status["data"][3]) == (0, 0)  # counter, BOOTUP
        assert hal.states[BEGIN + 42][KNEE] == DriveState.SWITCH_ON_DISABLED
        hal.run(100)
        assert hal.value("LEFT_SK_STATUS", "NodeState") == 5

    def test_haptics_node_in_reset_does_not_vibrate(self, world: Make) -> None:
        hal, emulator = world(Fault("reset", "HAPTICS", BEGIN, 300))
        hal.tx.values[hal.tx.codec.slice("Level")] = 1.0
        hal.run(BEGIN - 1)
        assert emulator.vibration.min() > 0.3
        hal.run(290)
        assert emulator.vibration.max() < 0.01
        hal.run(290)
        assert emulator.vibration.min() > 0.9

    def test_injected_over_temperature_lasts_although_the_drive_is_cool(self, world: Make) -> None:
        hal, _ = world(Fault("emergency", "LEFT_SK", BEGIN, 400, code=0x4310), cycles=BEGIN + 399)
        assert {states[KNEE] for states in hal.states[BEGIN + 1 :]} <= {
            DriveState.FAULT_REACTION_ACTIVE,
            DriveState.FAULT,
        }
        hal.run(1500)
        assert hal.states[-1][KNEE] == ENABLED

    @pytest.mark.parametrize("order", [1, -1])
    def test_end_of_a_fault_does_not_end_another_fault_of_the_same_drive(self, world: Make, order: int) -> None:
        faults = [Fault("push", "LEFT_SK", BEGIN, 50, torque=10.0), Fault("push", "LEFT_SK", BEGIN + 50, torque=30.0)]
        weak = [
            Fault("torque_weak", "LEFT_SK", BEGIN, 60, share=0.9),
            Fault("torque_weak", "LEFT_SK", BEGIN, share=0.5),
        ]
        alone, _ = world(Fault("push", "LEFT_SK", BEGIN, 50, torque=10.0), cycles=BEGIN + 300)
        both, _ = world(*faults[::order], cycles=BEGIN + 300)
        weaker, _ = world(*weak[::order], cycles=BEGIN + 300)
        at_alone, at_both, at_weaker = (hal.joints("Torque")[KNEE] for hal in (alone, both, weaker))
        assert at_both == pytest.approx(at_alone - 30.0, abs=4.0)
        assert abs(at_weaker) > 1.7 * abs(at_alone)

    def test_reset_sensor_is_silent_then_sends_bootup(self, world: Make) -> None:
        hal, _ = world(Fault("reset", "FOOT_LEFT", BEGIN, 5), cycles=BEGIN + 6)
        assert "FOOT_LEFT_STATE" not in hal.sent[BEGIN + 4]
        assert {"FOOT_LEFT_STATE", "FOOT_LEFT_STATUS"} <= set(hal.sent[BEGIN + 5])
        assert hal.value("FOOT_LEFT_STATUS", "NodeState") == 0


class TestEncoders:
    def test_stuck_encoder_repeats_its_position(self, world: Make) -> None:
        hal, emulator = world(Fault("encoder_stuck", "LEFT_SK", 0, 60), cycles=1)
        stuck_at = hal.joints("Position")[KNEE]
        emulator.body.reset([angle + 0.1 for angle in CROUCHED])
        for _ in range(58):
            hal.run(1)
            assert hal.joints("Position")[KNEE] == stuck_at
        hal.run(5)
        assert abs(hal.joints("Position")[KNEE] - stuck_at) > 0.05 * 100

    @pytest.mark.parametrize("by", [0.02, -0.02])
    def test_encoder_jump_shifts_one_position_while_it_lasts(self, world: Make, by: float) -> None:
        hal, _ = world(Fault("encoder_jump", "LEFT_SK", BEGIN, 1, by=by), cycles=BEGIN)
        before = hal.joints("Position")
        hal.run(1)
        moved = (hal.joints("Position") - before) / 100.0
        assert moved[KNEE] == pytest.approx(by, abs=2e-3)
        assert np.abs(np.delete(moved, KNEE)).max() < 2e-3
        hal.run(1)
        assert hal.joints("Position")[KNEE] == pytest.approx(before[KNEE], abs=0.5)

    def test_encoder_drift_grows_linearly(self, world: Make) -> None:
        hal, emulator = world(Fault("encoder_drift", "LEFT_SK", BEGIN, rate=0.5), cycles=BEGIN + 101)
        error = hal.joints("Position")[KNEE] / 100.0 - emulator.body.position[KNEE]
        assert error == pytest.approx(0.5 * 100 * PERIOD, abs=2e-3)

    def test_local_hold_of_a_drive_follows_its_drifting_encoder(self, world: Make) -> None:
        hal, emulator = world(Fault("encoder_drift", "LEFT_SK", BEGIN, rate=0.2), cycles=BEGIN)
        before = emulator.body.position.copy()
        hal.bus.step = None
        for _ in range(300):
            emulator.idle()
        moved = emulator.body.position - before
        assert moved[KNEE] == pytest.approx(-0.06, abs=0.01)


class TestSupply:
    def test_under_voltage_of_one_drive_holds_only_this_drive(self, world: Make) -> None:
        hal, emulator = world(Fault("under_voltage", "LEFT_SK", BEGIN, 150, volts=30.0), cycles=BEGIN + 1)
        assert hal.emergencies() == [(BEGIN, "LEFT_SK_EMCY")]
        assert [s == HOLDING for s in hal.states[-1]] == [d == KNEE for d in range(12)]
        hal.run(110)
        assert hal.value("LEFT_SK_STATUS", "SupplyVoltage") == pytest.approx(30.0)
        assert hal.value("LEFT_SH_STATUS", "SupplyVoltage") == pytest.approx(48.0)
        hal.run(150)
        assert emulator.drives.voltage == [48.0] * 12
        assert hal.value("LEFT_SK_STATUS", "SupplyVoltage") == pytest.approx(48.0)

    def test_battery_removed_holds_the_drives_until_the_voltage_is_too_low(self, world: Make) -> None:
        hal, emulator = world(Fault("battery_removed", "battery", BEGIN, capacity=0.02), cycles=BEGIN)
        volts = [48.0]
        for _ in range(60):
            hal.run(10)
            volts.append(emulator.drives.voltage[0])
        assert volts == sorted(volts, reverse=True)
        assert volts[-1] < 20.0
        hold, dead = [cycle for cycle, name in hal.emergencies() if name == "LEFT_SK_EMCY"]
        assert set(hal.states[hold]) == {HOLDING}
        assert dead - hold > 150  # cycles for which the remaining voltage is sufficient to hold
        assert set(hal.states[dead]) == {DriveState.FAULT_REACTION_ACTIVE}

    def test_voltage_returns_when_the_battery_is_back(self, world: Make) -> None:
        _, emulator = world(Fault("battery_removed", "battery", BEGIN, 20, capacity=0.5), cycles=BEGIN + 21)
        assert emulator.drives.voltage == [48.0] * 12


class TestSensors:
    def test_invalid_imu_sends_invalid_codes_in_every_measured_signal(self, world: Make) -> None:
        hal, _ = world(Fault("imu_invalid", "IMU_TORSO", BEGIN, 2), cycles=BEGIN + 1)
        raw = next(f for f in hal.frames[-1] if int(f["can_id"]) == 397)["data"][8:30].tobytes()
        assert {raw[i : i + 2] for i in (*range(0, 14, 2), *range(16, 22, 2))} == {b"\x00\x80"}
        row = hal.fast.codec.rows["IMU_TORSO_STATE"]
        assert (hal.fast.check > 1).nonzero()[0].tolist() == [row]
        hal.run(2)
        assert hal.fast.check[row] <= 1

    def test_saturated_imu_sends_the_end_of_its_ranges(self, world: Make) -> None:
        hal, _ = world(Fault("imu_saturated", "IMU_PELVIS", BEGIN), cycles=BEGIN + 1)
        assert hal.value("IMU_PELVIS_STATE", "GyroX") == pytest.approx(40.95875)
        assert hal.value("IMU_PELVIS_STATE", "AccelZ") == pytest.approx(163.835)
        assert hal.value("IMU_PELVIS_STATE", "QuaternionW") == pytest.approx(1.0, abs=0.2)
        assert abs(hal.value("IMU_TORSO_STATE", "GyroX")) < 1.0

    def test_frozen_imu_repeats_its_measurement_with_new_counters(self, world: Make) -> None:
        hal, _ = world(Fault("imu_frozen", "IMU_TORSO", BEGIN, 20), cycles=BEGIN + 22)
        payloads = [next(f for f in frames if int(f["can_id"]) == 397)["data"] for frames in hal.frames[BEGIN - 1 :]]
        measured = [p[8:30].tobytes() for p in payloads]
        assert len(set(measured[1:21])) == 1
        assert len({measured[0], measured[1], measured[21]}) == 3
        assert len({int(p[2]) for p in payloads}) == len(payloads)

    def test_stuck_cell_reports_its_force_in_one_foot_only(self, world: Make) -> None:
        hal, _ = world(Fault("cell_stuck", "FOOT_RIGHT", BEGIN, cell="RL", force=321.0), cycles=BEGIN + 2)
        assert hal.value("FOOT_RIGHT_STATE", "RL_ForceZ") == pytest.approx(321.0)
        assert abs(hal.value("FOOT_RIGHT_STATE", "RR_ForceZ")) < 100.0
        assert abs(hal.value("FOOT_LEFT_STATE", "RL_ForceZ")) < 100.0


def forces(hal: PoseHolder, foot: str) -> np.ndarray:
    """Return the vertical forces on the cells of a foot in the last cycle [N]."""
    return np.array([hal.value(f"FOOT_{foot}_STATE", f"{cell}_ForceZ") for cell in CELLS])


def readings(hal: PoseHolder, imu: str) -> dict[str, np.ndarray]:
    """Return attitude wxyz, angular velocity [rad/s] and specific force [m/s2] of an IMU in the last cycle."""
    return {
        quantity: np.array([hal.value(f"IMU_{imu}_STATE", quantity + axis) for axis in axes])
        for quantity, axes in (("Quaternion", "WXYZ"), ("Gyro", "XYZ"), ("Accel", "XYZ"))
    }


class TestMiswiredSensors:
    """The same seed gives the same noise, so a faulty run is compared with a run without a fault."""

    CYCLES = BEGIN + 2

    def both(self, world: Make, fault: Fault) -> tuple[PoseHolder, PoseHolder]:
        return world(cycles=self.CYCLES)[0], world(fault, cycles=self.CYCLES)[0]

    @pytest.mark.parametrize(("cell", "changed"), [("all", [True] * 4), ("FR", [False, True, False, False])])
    def test_offset_is_added_to_the_vertical_force(self, world: Make, cell: str, changed: list[bool]) -> None:
        good, bad = self.both(world, Fault("cell_offset", "FOOT_LEFT", BEGIN, cell=cell, force=-200.0))
        change = forces(bad, "LEFT") - forces(good, "LEFT")
        assert change == pytest.approx(np.where(changed, -200.0, 0.0), abs=0.1)
        assert forces(bad, "RIGHT").tolist() == forces(good, "RIGHT").tolist()

    @pytest.mark.parametrize(("cell", "sign"), [("all", [-1.0] * 4), ("RL", [1.0, 1.0, -1.0, 1.0])])
    def test_inverted_cell_has_the_opposite_force(self, world: Make, cell: str, sign: list[float]) -> None:
        good, bad = self.both(world, Fault("cell_inverted", "FOOT_RIGHT", BEGIN, cell=cell))
        assert forces(bad, "RIGHT") == pytest.approx(forces(good, "RIGHT") * sign, abs=0.1)
        assert np.abs(forces(good, "RIGHT")).max() > 1.0

    def test_inverted_axis_changes_gyroscope_and_accelerometer_but_not_the_attitude(self, world: Make) -> None:
        good, bad = (readings(hal, "TORSO") for hal in self.both(world, Fault("imu_inverted", "IMU_TORSO", axis="Z")))
        assert bad["Quaternion"].tolist() == good["Quaternion"].tolist()
        for quantity in ("Gyro", "Accel"):
            assert bad[quantity] == pytest.approx(good[quantity] * [1.0, 1.0, -1.0], abs=0.01)
        assert bad["Accel"][2] == pytest.approx(-9.81, abs=0.3)

    @pytest.mark.parametrize(
        ("axis", "degrees", "up"),
        [("X", 180.0, [0, 0, -1]), ("X", 90.0, [0, 1, 0]), ("Y", 90.0, [-1, 0, 0]), ("Z", -90.0, [0, 0, 1])],
    )
    def test_turned_imu_measures_in_its_own_axes(self, world: Make, axis: str, degrees: float, up: list[int]) -> None:
        hal, _ = world(Fault("imu_turned", "IMU_TORSO", axis=axis, degrees=degrees), cycles=self.CYCLES)
        seen = readings(hal, "TORSO")
        w, x, y, z = seen["Quaternion"]
        vertical = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
        assert vertical == pytest.approx(up, abs=1e-3)
        assert seen["Accel"] == pytest.approx(9.81 * np.array(up), abs=0.4)
        assert 2.0 * np.degrees(np.arccos(w)) == pytest.approx(abs(degrees), abs=0.1)
        assert w >= 0.0

    @pytest.mark.parametrize("axis", ["X", "Y", "Z"])
    def test_turn_about_an_axis_keeps_the_readings_of_this_axis(self, world: Make, axis: str) -> None:
        fault = Fault("imu_turned", "IMU_LEFT_TIBIA", BEGIN, axis=axis)
        good, bad = (readings(hal, "LEFT_TIBIA") for hal in self.both(world, fault))
        signs = np.where(np.array(["X", "Y", "Z"]) == axis, 1.0, -1.0)
        for quantity in ("Gyro", "Accel"):
            assert bad[quantity] == pytest.approx(good[quantity] * signs, abs=0.01)

    def test_swapped_imus_send_the_values_of_each_other(self, world: Make) -> None:
        good, bad = self.both(world, Fault("sensor_swapped", "IMU_PELVIS", BEGIN, other="IMU_RIGHT_TIBIA"))
        for one, other in (("PELVIS", "RIGHT_TIBIA"), ("RIGHT_TIBIA", "PELVIS"), ("TORSO", "TORSO")):
            for quantity, values in readings(bad, one).items():
                assert values.tolist() == readings(good, other)[quantity].tolist()
        assert readings(good, "PELVIS")["Quaternion"].tolist() != readings(good, "RIGHT_TIBIA")["Quaternion"].tolist()

    def test_swapped_feet_send_the_forces_of_each_other(self, world: Make) -> None:
        good, bad = self.both(world, Fault("sensor_swapped", "FOOT_LEFT", BEGIN, other="FOOT_RIGHT"))
        assert forces(bad, "LEFT").tolist() == forces(good, "RIGHT").tolist()
        assert forces(bad, "RIGHT").tolist() == forces(good, "LEFT").tolist()

    def test_swapped_encoders_show_the_position_of_each_other_while_the_fault_lasts(self, world: Make) -> None:
        hal, _ = world(Fault("encoder_swapped", "LEFT_SH", 0, 3, other="LEFT_SK"), cycles=3)
        position = hal.joints("Position") / (hal.robot.gear * hal.robot.polarity)
        expected = np.array(CROUCHED)
        expected[[2, 3]] = expected[[3, 2]]
        assert position == pytest.approx(expected, abs=0.01)
        hal.run(1)
        assert hal.joints("Position") / (hal.robot.gear * hal.robot.polarity) == pytest.approx(CROUCHED, abs=0.02)


def test_dbc_hash_fault_changes_the_hash_of_one_node_while_it_lasts(world: Make, network: Network) -> None:
    hal, _ = world(Fault("dbc_hash", "LEFT_SK", 0, 150, hash=7), cycles=140)
    assert hal.value("LEFT_SK_STATUS", "DbcHash") == 7
    assert hal.value("LEFT_SH_STATUS", "DbcHash") == network.hash32
    hal.run(130)
    assert hal.value("LEFT_SK_STATUS", "DbcHash") == network.hash32


def test_heartbeat_lost_suppresses_only_the_status_of_the_node(world: Make) -> None:
    hal, _ = world(Fault("heartbeat_lost", "LEFT_SK"), cycles=210)
    sent = {name for names in hal.sent for name in names}
    assert "LEFT_SK_STATUS" not in sent
    assert {"LEFT_SK_STATE", "LEFT_SH_STATUS"} <= sent


class TestWire:
    """Reactions of the drives to lost, damaged and additional frames."""

    def test_lost_command_is_reported_and_the_drives_stay_enabled(self, world: Make) -> None:
        hal, emulator = world(Fault("drop", "COMMAND_LEFT_LEG", BEGIN, 1), cycles=BEGIN + 5)
        reports = hal.emergencies()
        assert {cycle for cycle, _ in reports} == {BEGIN + 1}
        assert len(reports) == 6
        assert hal.value("LEFT_SK_EMCY", "ErrorCode") == 0x8110
        assert set(emulator.drives.state) == {ENABLED}

    def test_damaged_command_is_reported_by_its_leg(self, world: Make) -> None:
        hal, _ = world(Fault("flip", "COMMAND_RIGHT_LEG", BEGIN, 1), cycles=BEGIN + 1)
        assert hal.value("RIGHT_SK_EMCY", "ErrorCode") == 0x8200
        assert {name[:5] for _, name in hal.emergencies()} == {"RIGHT"}

    @pytest.mark.parametrize(("lost", "state"), [(4, ENABLED), (5, HOLDING)])
    def test_leg_holds_after_five_lost_commands_and_not_after_four(
        self, world: Make, lost: int, state: DriveState
    ) -> None:
        hal, emulator = world(Fault("drop", "COMMAND_LEFT_LEG", BEGIN, lost), cycles=BEGIN + lost + 2)
        assert set(emulator.drives.state[:6]) == {state}
        assert set(emulator.drives.state[6:]) == {ENABLED}
        assert hal.value("LEFT_SK_EMCY", "ErrorCode") == (0x8250 if lost == 5 else 0x8110)

    @pytest.mark.parametrize(("lost", "state"), [(4, ENABLED), (5, HOLDING)])
    @pytest.mark.parametrize("kind", ["drop", "flip"])
    def test_leg_holds_after_five_lost_syncs_and_not_after_four(
        self, world: Make, kind: str, lost: int, state: DriveState
    ) -> None:
        hal, emulator = world(Fault(kind, "SYNC_LEFT_LEG", BEGIN, lost), cycles=BEGIN + lost + 2)
        assert emulator.cycle == BEGIN + lost + 2
        assert not any(name.endswith("LEFT_SK_STATE") for names in hal.sent[BEGIN : BEGIN + lost] for name in names)
        assert set(emulator.drives.state[:6]) == {state}
        assert set(emulator.drives.state[6:]) == {ENABLED}
        assert lost != 5 or hal.value("LEFT_SK_EMCY", "ErrorCode") == 0x8130

    @pytest.mark.parametrize(("lost", "state"), [(4, ENABLED), (5, HOLDING)])
    @pytest.mark.parametrize("kind", ["drop", "flip"])
    def test_every_leg_holds_after_five_cycles_without_any_sync(
        self, world: Make, kind: str, lost: int, state: DriveState
    ) -> None:
        faults = [
            Fault(kind, f"SYNC_{bus}", BEGIN, lost) for bus in ("LEFT_LEG", "RIGHT_LEG", "LEFT_SENSE", "RIGHT_SENSE")
        ]
        hal, emulator = world(*faults, cycles=BEGIN + lost)
        assert emulator.cycle == BEGIN + lost
        assert not any(
            name.endswith("_STATE") and name != "HAPTICS_STATE" for names in hal.sent[BEGIN:] for name in names
        )
        hal.run(2)
        assert set(emulator.drives.state) == {state}
        assert lost != 5 or hal.value("RIGHT_SK_EMCY", "ErrorCode") == 0x8130

    def test_flood_of_one_bus_holds_only_its_leg(self, world: Make) -> None:
        hal, emulator = world(Fault("flood", "left_leg", BEGIN, 20), cycles=BEGIN + 20)
        assert emulator.cycle == BEGIN + 20
        assert set(emulator.drives.state[:6]) == {HOLDING}
        assert set(emulator.drives.state[6:]) == {ENABLED}
        for names, frames in zip(hal.sent[BEGIN:], hal.frames[BEGIN:], strict=True):
            assert frames["can_id"].tolist()[:17] == [0] * 17
            assert not any(name.startswith("LEFT_SK") for name in names)
            assert "RIGHT_SK_STATE" in names
        hal.run(10)
        assert "LEFT_SK_STATE" in hal.sent[-1]
        assert hal.value("LEFT_SK_EMCY", "ErrorCode") == 0x8130
        assert 0 not in hal.frames[-1]["can_id"].tolist()

    def test_flood_of_every_bus_holds_all_drives_while_cycles_continue(self, world: Make, network: Network) -> None:
        hal, emulator = world(*(Fault("flood", bus, BEGIN) for bus in network.buses), cycles=BEGIN + 20)
        assert emulator.cycle == BEGIN + 20
        assert set(emulator.drives.state) == {HOLDING}
        assert {int(i) for frames in hal.frames[BEGIN:] for i in frames["can_id"]} == {0}

    def test_second_sender_of_a_command_latches_the_hold_of_its_leg(self, world: Make) -> None:
        hal, emulator = world(Fault("inject", "COMMAND_LEFT_LEG", BEGIN, 1, SK_TargetTorque=100.0), cycles=BEGIN + 2)
        assert hal.value("LEFT_SK_EMCY", "ErrorCode") == 0x8150
        assert {cycle for cycle, _ in hal.emergencies()} == {BEGIN}
        assert set(emulator.drives.state[:6]) == {HOLDING}
        assert all(emulator.drives.latched[:6])

    def test_duplicated_command_is_not_reported_as_a_second_sender(self, world: Make) -> None:
        hal, emulator = world(Fault("duplicate", "COMMAND_LEFT_LEG", BEGIN, 10, copies=3), cycles=BEGIN + 12)
        assert hal.emergencies() == []
        assert set(emulator.drives.state) == {ENABLED}


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (
            Fault("encoder_stuck", "IMU_TORSO"),
            "encoder_stuck: the target must be of type drive, got 'IMU_TORSO'; valid targets: LEFT_FH, .*, RIGHT_HA$",
        ),
        (
            Fault("imu_frozen", "LEFT_SK"),
            "imu_frozen: the target must be of type imu, got 'LEFT_SK'; valid targets: IMU_TORSO, .*, IMU_RIGHT_TIBIA$",
        ),
        (
            Fault("cell_stuck", "IMU_TORSO", cell="FL"),
            "type foot, got 'IMU_TORSO'; valid targets: FOOT_LEFT, FOOT_RIGHT$",
        ),
        (
            Fault("reset", "HAL", 0, 5),
            "reset: the target must be of type node, got 'HAL'; valid targets: LEFT_FH, .*, PENDANT$",
        ),
        (
            Fault("battery_removed", "LEFT_SK"),
            "battery_removed: the target must be of type battery, got 'LEFT_SK'; valid targets: battery$",
        ),
        (
            Fault("under_voltage", "HAPTICS", volts=1.0),
            "target must be of type drive or battery, got 'HAPTICS'; valid targets: LEFT_FH, .*, battery$",
        ),
        (
            Fault("sensor_swapped", "LEFT_SK", other="FOOT_LEFT"),
            "target must be of type imu or foot, got 'LEFT_SK'; valid targets: IMU_TORSO, .*, FOOT_RIGHT$",
        ),
        (
            Fault("sensor_swapped", "FOOT_LEFT", other="IMU_TORSO"),
            "sensor_swapped: the parameter 'other' must be another foot, got 'IMU_TORSO'; valid: FOOT_RIGHT$",
        ),
        (
            Fault("encoder_swapped", "LEFT_SK", other="LEFT_SK"),
            "encoder_swapped: the parameter 'other' must be another drive, got 'LEFT_SK'; valid: LEFT_FH, .*, RIGHT_HA$",
        ),
        (
            Fault("heartbeat_lost", "left_leg"),
            "heartbeat_lost: the target must be of type node, got 'left_leg'; valid targets: HAL, LEFT_FH, ",
        ),
    ],
    ids=str,
)
def test_fault_with_a_wrong_target_type_is_rejected_with_the_valid_targets(
    world: Make, fault: Fault, expected: str
) -> None:
    with pytest.raises(FaultError, match=expected):
        world(fault)


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        (
            "leave_operation",
            {"state": "LIMP"},
            "leave_operation: the parameter 'state' must be one of NOT_READY_TO_SWITCH_ON, .*, got 'LIMP'",
        ),
        ("cell_stuck", {"cell": "FLL"}, "cell_stuck: the parameter 'cell' must be one of FL, FR, RL, RR, got 'FLL'"),
        ("torque_weak", {}, "torque_weak: the parameter 'share' must be a number from -2 to 2, got no value"),
        ("emergency", {"code": 0}, "emergency: the parameter 'code' must be an integer from 1 to 65535, got 0"),
        (
            "under_voltage",
            {"volts": -1.0},
            re.escape("under_voltage: the parameter 'volts' must be a number from 0 to 60 V, got -1.0"),
        ),
    ],
)
def test_invalid_parameter_error_lists_the_valid_ones(kind: str, options: dict, expected: str) -> None:
    with pytest.raises(FaultError, match=expected):
        Fault(kind, "LEFT_SK", **options)


def test_fault_inside_a_node_of_another_process_is_rejected(network: Network, robot: Robot, urdf_text: str) -> None:
    body = PyBulletBody(urdf_text)
    for kind, options in (("reset", {}), ("emergency", {"code": 0x8130}), ("dbc_hash", {})):
        with pytest.raises(FaultError, match=f"{kind}: the target must be an emulated node, got PENDANT"):
            Emulator(network, robot, body, lockstep_pair()[1], faults=[Fault(kind, "PENDANT", BEGIN, **options)])
    body.close()


def test_bytes_under_faults_are_reproducible_for_one_seed_and_differ_for_another(world: Make) -> None:
    faults = (
        Fault("drop", "left_leg", 10, p=0.2),
        Fault("flip", "IMU_TORSO", 5, p=0.5),
        Fault("encoder_drift", "LEFT_SK", 20, rate=1.0),
    )
    one, again, other = (world(*faults, cycles=100, seed=seed)[0] for seed in (3, 3, 4))
    assert [f.tobytes() for f in one.frames] == [f.tobytes() for f in again.frames]
    assert [f.tobytes() for f in one.frames] != [f.tobytes() for f in other.frames]
