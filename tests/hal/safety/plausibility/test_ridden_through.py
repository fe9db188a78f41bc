"""Faults are found although one message is disturbed in a way that the HAL tolerates.

    signals -> frames -> disturbance -> process image -> plausibility

Under a permanent disturbance of one message, each check finds its fault within the bound of FAULTS.md. The disturbance alone
raises nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio
import pytest
from simulated_robot import UNEVEN, specific_force

import atalante_dbc
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import IMUS, JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding, Plausibility
from atalante_hal.safety.plausibility.signals import Signals, signals_of
from atalante_hal.safety.plausibility.trunk import TORSO_HEIGHT
from atalante_hal.safety.plausibility.unchecked import UNCHECKED_CYCLES
from atalante_hal.wire.e2e import COUNTER_BYTE
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK, ROBOT = atalante_dbc.load(), load_robot()
_RECEIVED = [m for m in NETWORK.received_by("HAL") if m.cycle_ms == 1]
MESSAGES = [m for bus in NETWORK.buses for m in _RECEIVED if m.bus == bus]
NAMES = [m.name for m in MESSAGES]
PERIOD = 1e-3
GEAR = ROBOT.gear * ROBOT.polarity
MIDDLE = (ROBOT.position_min + ROBOT.position_max) / 2.0
#: The joints swing by 0.15 rad at up to 0.9 rad/s.
AMPLITUDE, RATE = 0.15, 6.0
SWING_PERIOD = round(2.0 * math.pi / RATE / PERIOD)
JOINT, LEG_IMU = JOINTS.index("right_FH"), IMUS.index("right_tibia")
TORSO, PELVIS = IMUS.index("torso"), IMUS.index("pelvis")
#: Angular velocity [rad/s] and angular frequency [rad/s] of a trunk that swings.
TRUNK_RATE, TRUNK_FREQUENCY = 0.05, 12.0

Change = Callable[[Signals, int], object]
#: Function that returns the received frames for the frames sent in this cycle and in the last cycle.
Disturbance = Callable[[Frames, Frames], Frames]


def undisturbed(frames: Frames, before: Frames) -> Frames:
    return frames


def doubled(row: int) -> Disturbance:
    return lambda frames, before: np.concatenate([frames, frames[row : row + 1]])


def late(row: int) -> Disturbance:
    return lambda frames, before: np.concatenate([before[row : row + 1], np.delete(frames, row)])


def lost_when_sampled(row: int, cycles: tuple[int, ...] = (0, 2, 8)) -> Disturbance:
    """Lose at most three of 16 frames, in the cycles of slow checks. This is less than the 20 % that is tolerated."""

    def disturb(frames: Frames, before: Frames) -> Frames:
        lost = int(frames["data"][0, COUNTER_BYTE]) % 16 in cycles
        return np.delete(frames, row) if lost else frames

    return disturb


def surplus(frames: Frames, before: Frames) -> Frames:
    unknown = new_frames(1)
    unknown["can_id"], unknown["len"] = 0x7FF, 8
    return np.concatenate([unknown, frames])


DISTURBANCES: dict[str, Disturbance] = {
    "none": undisturbed,
    "surplus unknown frame": surplus,
    **{f"{name} doubled": doubled(row) for row, name in enumerate(NAMES)},
    **{f"{name} one cycle late": late(row) for row, name in enumerate(NAMES)},
    **{f"{name} lost when sampled": lost_when_sampled(row) for row, name in enumerate(NAMES)},
    **{
        f"{name} lost in the inertial checks": lost_when_sampled(row, (11, 12))
        for row, name in enumerate(NAMES)
        if name.startswith("IMU_")
    },
}


@functools.cache
def motion() -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Return position, velocity, quaternions (4, 4) and gyros (4, 3) in each cycle of one period of the motion."""
    model = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
    data = model.model.createData()
    frames = [model.model.getFrameId(f"imu_{imu}") for imu in IMUS]
    phase = 2.0 * math.pi / SWING_PERIOD * np.arange(SWING_PERIOD)
    found = []
    for angle in phase.tolist():
        q, v = pinocchio.neutral(model.model), np.zeros(model.model.nv)
        q[model.q] = MIDDLE + AMPLITUDE * math.sin(angle)
        v[model.v] = AMPLITUDE * (2.0 * math.pi / SWING_PERIOD / PERIOD) * math.cos(angle)
        pinocchio.forwardKinematics(model.model, data, q, v)
        pinocchio.updateFramePlacements(model.model, data)
        coefficients = [pinocchio.Quaternion(data.oMf[frame].rotation).coeffs() for frame in frames]
        gyros = [
            pinocchio.getFrameVelocity(model.model, data, frame, pinocchio.ReferenceFrame.LOCAL).angular.copy()
            for frame in frames
        ]
        found.append((q[model.q].copy(), v[model.v].copy(), np.array(coefficients)[:, [3, 0, 1, 2]], np.array(gyros)))
    return found


@functools.cache
def noise() -> np.ndarray:
    return np.random.default_rng(1).standard_normal((1021, 64))


class Line:
    """A healthy robot whose frames are disturbed."""

    def __init__(self, disturb: Disturbance) -> None:
        self.disturb = undisturbed
        self.transmit, self.receive = TransmitImage(MESSAGES), ReceiveImage(MESSAGES)
        self.sent = signals_of(self.transmit.codec, self.transmit.values)
        self.checks = Plausibility(UNEVEN, self.receive, PERIOD)
        self.cycles = 0
        self.before = self.transmit.frames.copy()
        self.standing = False
        self.run(1)
        self.disturb = disturb
        self.run(40)

    def cycle(self, change: Change) -> tuple[Finding, ...]:
        sent, index, noisy = self.sent, self.cycles % SWING_PERIOD, noise()[self.cycles % len(noise())]
        position, velocity, sent.quaternion[:], gyro = motion()[index]
        sent.position[:], sent.velocity[:] = position * GEAR, velocity * GEAR
        sent.torque[:] = 20.0 * math.sin(0.05 * self.cycles) + 0.05 * noisy[:12]
        sent.gyro[:] = gyro + 4e-3 * noisy[12:24].reshape(4, 3)
        sent.accel[:] = [specific_force(q) for q in sent.quaternion] + 0.05 * noisy[24:36].reshape(4, 3)
        sent.force[:] = 3.0 * noisy[36:60].reshape(2, 4, 3) + [0.0, 0.0, 150.0 * self.standing]
        change(sent, self.cycles)
        self.transmit.seal(self.cycles & 0xFF)
        frames = self.transmit.frames.copy()
        arrived = self.disturb(frames, self.before)
        self.receive.accept(arrived, len(arrived), self.cycles & 0xFF)
        self.before = frames
        self.cycles += 1
        return self.checks.check()

    def run(self, cycles: int, change: Change = lambda sent, cycle: None) -> tuple[Finding, ...]:
        found: tuple[Finding, ...] = ()
        for _ in range(cycles):
            found = self.cycle(change)
        return found


@dataclass(frozen=True)
class Fault:
    """Fault, with the largest number of cycles until it is found.

    This number comes from FAULTS.md. For CONTACT_IMPLAUSIBLE, one period of the foot checks is added, because late values
    of a foot delay the finding by a cycle.
    """

    dtc: Dtc
    node: str
    bound: int  # cycles
    change: Callable[[int], Change]  # function of the first faulty cycle that returns the change of the signals
    standing: bool = False  # True if the robot stands before the fault


def _velocity_off(first: int) -> Change:
    return lambda sent, cycle: sent.velocity.__setitem__(JOINT, sent.velocity[JOINT] + 1.0 * GEAR[JOINT])


def _velocity_zero(first: int) -> Change:
    # At rest a velocity of zero is correct. So this joint moves at up to 1.9 rad/s.
    def change(sent: Signals, cycle: int) -> None:
        sent.position[5] += 1.0 * PERIOD * (cycle - first) * GEAR[5]
        sent.velocity[5] = 0.0

    return change


def _drift(first: int) -> Change:
    def change(sent: Signals, cycle: int) -> None:
        sent.position[JOINT] += 0.1 * PERIOD * (cycle - first) * GEAR[JOINT]
        sent.velocity[JOINT] += 0.1 * GEAR[JOINT]

    return change


def _stuck(first: int) -> Change:
    def change(sent: Signals, cycle: int) -> None:
        sent.position[JOINT] = motion()[first % SWING_PERIOD][0][JOINT] * GEAR[JOINT]
        sent.velocity[JOINT] = 0.0

    return change


def _frozen(first: int) -> Change:
    return lambda sent, cycle: sent.gyro.__setitem__(LEG_IMU, [0.1, 0.2, 0.3])


def _dead_cell(first: int) -> Change:
    return lambda sent, cycle: sent.force.__setitem__((1, 2), 0.0)


def _lone_cell(first: int) -> Change:
    return lambda sent, cycle: sent.force.__setitem__((1, 2, 2), 200.0 + sent.force[1, 2, 0])


def _wrong_sign(first: int) -> Change:
    return lambda sent, cycle: sent.accel.__setitem__(TORSO, -sent.accel[TORSO])


def _wrong_gyroscope(first: int) -> Change:
    return lambda sent, cycle: sent.gyro.__setitem__(LEG_IMU, -sent.gyro[LEG_IMU])


def _tilted_torso(first: int) -> Change:
    def change(sent: Signals, cycle: int) -> None:
        sent.quaternion[TORSO] = math.cos(0.05), math.sin(0.05), 0.0, 0.0
        sent.accel[TORSO] = specific_force(sent.quaternion[TORSO])

    return change


def _exchanged_trunk(first: int) -> Change:
    # The trunk must turn, because attitudes and angular velocities of the exchanged IMUs are equal.
    def change(sent: Signals, cycle: int) -> None:
        phase = TRUNK_FREQUENCY * PERIOD * (cycle - first)
        half = -0.5 * TRUNK_RATE / TRUNK_FREQUENCY * math.cos(phase)
        sent.quaternion[[TORSO, PELVIS]] = math.cos(half), 0.0, math.sin(half), 0.0
        sent.gyro[[TORSO, PELVIS], 1] += TRUNK_RATE * math.sin(phase)
        sent.accel[PELVIS, 0] += TORSO_HEIGHT * TRUNK_RATE * TRUNK_FREQUENCY * math.cos(phase)

    return change


FAULTS = {
    "velocity 1 rad/s off": Fault(Dtc.ENC_VELOCITY, "RIGHT_FH", 64, _velocity_off),
    "velocity stays at 0": Fault(Dtc.ENC_VELOCITY, "LEFT_HA", 64, _velocity_zero),
    "encoder drifts by 0.1 rad/s": Fault(Dtc.ENC_DRIFT, "RIGHT_FH", 1000, _drift),
    "encoder is stuck": Fault(Dtc.ENC_STUCK, "RIGHT_FH", 50, _stuck),
    "gyro repeats itself": Fault(Dtc.IMU_STUCK, "IMU_RIGHT_TIBIA", 100, _frozen),
    "cell repeats itself": Fault(Dtc.FOOT_CELL, "FOOT_RIGHT", 260, _dead_cell),
    "cell contradicts the others": Fault(Dtc.FOOT_CELL, "FOOT_RIGHT", 260, _lone_cell),
    "accelerometer has the wrong sign": Fault(Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO", 300, _wrong_sign),
    "gyroscope has the wrong sign": Fault(Dtc.IMU_IMPLAUSIBLE, "IMU_RIGHT_TIBIA", 300, _wrong_gyroscope),
    "torso IMU is tilted": Fault(Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO", 300, _tilted_torso),
    "IMUs of the trunk are exchanged": Fault(Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO", 627, _exchanged_trunk),
    "both feet swing": Fault(Dtc.CONTACT_IMPLAUSIBLE, "FOOT_LEFT", 64, lambda first: lambda sent, cycle: None, True),
}


def cycles_until_found(line: Line, fault: Fault) -> int:
    """Return the number of cycles from the first faulty cycle, which counts as 1, until the finding is confirmed."""
    line.standing = fault.standing
    line.run(512 if fault.standing else 20)
    line.standing = False
    change = fault.change(line.cycles)
    for cycle in range(1, fault.bound + 1):
        if any((f.dtc, f.node, f.confirmed) == (fault.dtc, fault.node, True) for f in line.cycle(change)):
            return cycle
    raise AssertionError(f"no {fault.dtc} in {fault.bound} cycles, but {line.checks.findings}")


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbance_alone_raises_no_finding(name: str):
    line = Line(DISTURBANCES[name])
    for _ in range(SWING_PERIOD):
        assert line.cycle(lambda sent, cycle: None) == ()


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", DISTURBANCES)
def test_each_fault_is_found_under_each_disturbance(name: str):
    for what, fault in FAULTS.items():
        line = Line(DISTURBANCES[name])
        assert cycles_until_found(line, fault) <= fault.bound, what


class TestUnchecked:
    """A check whose messages arrive without values is reported immediately, and confirmed after `UNCHECKED_CYCLES`."""

    @pytest.mark.parametrize(
        ("quantity", "index", "unchecked"),
        [
            ("position", JOINTS.index("left_SA"), {(Dtc.ENC_VELOCITY, "LEFT_SA")}),
            ("position", JOINTS.index("left_SK"), {(Dtc.ENC_VELOCITY, "LEFT_SK"), (Dtc.ENC_DRIFT, "LEFT_FH")}),
            ("position", JOINTS.index("right_FH"), {(Dtc.ENC_VELOCITY, "RIGHT_FH"), (Dtc.ENC_DRIFT, "RIGHT_FH")}),
            (
                "quaternion",
                IMUS.index("pelvis"),
                {(Dtc.ENC_DRIFT, "LEFT_FH"), (Dtc.ENC_DRIFT, "RIGHT_FH"), (Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO")},
            ),
            ("quaternion", IMUS.index("left_tibia"), {(Dtc.ENC_DRIFT, "LEFT_FH")}),
            ("quaternion", IMUS.index("torso"), {(Dtc.IMU_IMPLAUSIBLE, "IMU_TORSO")}),
            ("force", 1, {(Dtc.FOOT_CELL, "FOOT_RIGHT")}),
        ],
    )
    def test_each_check_needs_its_own_messages(self, quantity: str, index: int, unchecked: set[tuple[Dtc, str]]):
        line = Line(undisturbed)

        def empty(sent: Signals, cycle: int) -> None:
            getattr(sent, quantity)[index] = np.nan

        found = line.run(32, empty)
        assert {(f.dtc, f.node) for f in found} == unchecked
        assert not any(f.confirmed for f in found)
        for _ in range(UNCHECKED_CYCLES):
            found = line.cycle(empty)
            assert all(f.confirmed == (f.value >= UNCHECKED_CYCLES) for f in found)
        assert {(f.dtc, f.node) for f in found if f.confirmed} == unchecked
        assert all(f"could not be checked for {f.value:.0f} cycles" in f.text for f in found)
        line.disturb = lambda frames, before: frames[:0]
        assert line.run(48) == found
        line.disturb = undisturbed
        assert line.run(17) == ()

    @pytest.mark.parametrize("name", NAMES)
    def test_silent_node_is_not_reported_as_unchecked(self, name: str):
        line = Line(lambda frames, before: np.delete(frames, NAMES.index(name)))
        assert line.run(2 * UNCHECKED_CYCLES) == ()

    def test_message_that_never_had_values_is_not_counted(self):
        line = Line(undisturbed)
        line.receive = ReceiveImage(MESSAGES)
        line.checks = Plausibility(ROBOT, line.receive, PERIOD)

        def empty(sent: Signals, cycle: int) -> None:
            sent.position[3] = sent.quaternion[1] = sent.force[0] = np.nan

        for _ in range(2 * UNCHECKED_CYCLES):
            assert line.cycle(empty) == ()
