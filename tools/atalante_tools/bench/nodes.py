"""Recorded nodes, which replace the emulator in benchmarks of the HAL, and answer each SYNC with prepared frames.

The frames have valid alive counters and CRCs. To answer a SYNC, the prepared frames are only copied, which takes little
time. The joints oscillate about the first pose of a swing with a small tracking error. Therefore the guide filter gets
realistic values, and no plausibility check fails.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from struct import Struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import atalante_dbc
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, Gait, StepTables, load_gait
from atalante_control.guide.filter import GuideFilter
from atalante_control.guide.kernel import LegState
from atalante_control.guide.shapes import CONSTANT
from atalante_dbc import Message, Network
from atalante_hal.bus import Stamps
from atalante_hal.hal import Hal
from atalante_hal.robot import JOINTS, Robot, load_robot
from atalante_hal.safety.direction import DirectionProof
from atalante_hal.types import GRAVITY, PERIOD, Command, State, SupervisorState, Vector
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.e2e import COUNTER_BYTE
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES, Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.bench.measure import require

#: Number of cycles after which an alive counter wraps to 0.
TURN = 256
#: Number of recorded poses. The poses are played in turn, one per cycle. `POSES` has no common factor with 16.
#: Some checks of the HAL run in every 16th cycle. With 16 poses, such a check would always read the same pose
#: and report a fault.
POSES = 15
#: Largest constant tracking error (recorded minus desired joint angle) [rad].
#: With tracking errors of at most `ERROR`, the guide filter does not saturate: its output is not at a limit.
ERROR = 0.01
#: Largest rate of change of the tracking error [rad/s].
ERROR_RATE = 0.05
ASSISTANCE = 0.5
_E2E = Struct("<HB")


@dataclass(frozen=True)
class Walk:
    """Data from which `Recording` computes the frames of a walking robot."""

    network: Network
    robot: Robot
    gait: Gait
    tables: StepTables
    guide: GuideFilter


@cache
def walk() -> Walk:
    """Load the network, the robot and the gait of the demo, and create the guide filter of this gait."""
    network, robot = atalante_dbc.load(), load_robot()
    gait = load_gait(AIRWALK_GAIT, robot)
    return Walk(network, robot, gait, gait.tables(), AirwalkController(robot, gait, CONSTANT).guide_at(ASSISTANCE))


def cyclic_messages(network: Network) -> list[Message]:
    """Return the messages that the HAL receives in every cycle, ordered by bus."""
    return [m for bus in network.buses for m in network.received_by("HAL") if m.bus == bus and m.cycle_ms == 1]


def syncs(network: Network) -> list[Message]:
    """Return the SYNC messages of all buses, in the order in which the HAL sends these messages."""
    return [m for m in network.sent_by("HAL") if m.name.startswith("SYNC_")]


class Recording:
    """Recorded frames of all nodes. Each call of `play` writes the frames of the next cycle into `frames`.

    The recording consists of `POSES` payloads per message, and a CRC for each payload and each alive counter. The
    recording is small, so it stays in the processor caches.

    Attributes:
        cyclic: messages that are sent in every cycle, in the order of the frames.
        slow: messages with longer periods, each with its period and phase [cycles].
        frames: frames of the current cycle, written by `play`.
        values: physical values of the cyclic messages, shape (POSES, signals), in the order of `Codec(cyclic).signals`.
        cycles: number of cycles played.
        pose: index of the last pose played.
    """

    def __init__(self, walk: Walk) -> None:
        network = walk.network
        self.cyclic = cyclic_messages(network)
        image = TransmitImage(self.cyclic)
        codec, rng = image.codec, np.random.default_rng(0)
        self.values = np.tile(_walking(image), (POSES, 1))
        motor = walk.robot.gear * walk.robot.polarity
        phase = 2.0 * np.pi * np.arange(POSES)[:, None] / POSES
        swing = ERROR_RATE * POSES * PERIOD / (2.0 * np.pi) * np.sin(phase)
        error = rng.uniform(-ERROR, ERROR, len(JOINTS))
        self.values[:, codec.slice("Position")] = (walk.tables.q[0] + error + swing) * motor
        self.values[:, codec.slice("Velocity")] = ERROR_RATE * np.cos(phase) * motor
        # The noise alternates in sign, because the HAL reports constant sensor values as a fault.
        sign = np.where(np.arange(POSES) % 2, 1.0, -1.0)[:, None]
        for name, noise in (("Torque", 0.05), ("Gyro", 0.01), ("Accel", 0.05), ("Force", 1.0)):
            columns = codec.slice(name)
            self.values[:, columns] += sign * rng.uniform(0.5 * noise, noise, (POSES, columns.stop - columns.start))
        for side, leg in (("LEFT", 0), ("RIGHT", len(JOINTS) // 2)):
            # The pitch angle of the tibia is the sum of hip and knee angle [rad]. Quaternions contain half angles.
            half_pitch = 0.5 * (walk.tables.q[0] + error)[leg + 2 : leg + 4].sum()
            for axis, value in (("W", np.cos(half_pitch)), ("Y", np.sin(half_pitch))):
                self.values[:, codec.index(f"IMU_{side}_TIBIA_STATE", f"Quaternion{axis}")] = value
            for axis, change in (("X", -np.sin(2.0 * half_pitch)), ("Z", np.cos(2.0 * half_pitch) - 1.0)):
                self.values[:, codec.index(f"IMU_{side}_TIBIA_STATE", f"Accel{axis}")] += GRAVITY * change
        request = [codec.index("PENDANT_STATE", name) for name in ("Request", "RequestCounter")]
        self._before = _seal(image, self.values)
        self.values[:, request] = 1.0  # START pressed once
        self._steady = _seal(image, self.values)

        slow = [m for m in network.received_by("HAL") if m.cycle_ms > 1]
        image = TransmitImage(slow)
        image.values[image.codec.slice("DbcHash")] = network.hash32
        image.values[image.codec.slice("NodeState")] = 5  # operational
        image.values[image.codec.slice("SupplyVoltage")] = 48.0
        gap = max(m.cycle_ms for m in slow) // len(slow)
        #: Messages with long periods: (message, period in cycles, phase in cycles).
        #: The phases differ, so that only few messages with long periods are sent in the same cycle.
        self.slow = tuple((m, m.cycle_ms, gap * row % m.cycle_ms) for row, m in enumerate(slow))
        self._slow = _seal(image, image.values[None, :])
        self._slow_turn = [0] * len(slow)
        self._due = [
            [row for row, (_, period, phase) in enumerate(self.slow) if cycle % period == phase]
            for cycle in range(max(m.cycle_ms for m in slow))
        ]
        rows = len(self.cyclic)
        self.frames = new_frames(rows + len(slow))
        self._cyclic_memory = self.frames[:rows].view(np.uint8).data
        self._cyclic_counters, self._cyclic_checksums = _e2e_fields(self.frames[:rows])
        self._slow_memory = [self.frames[rows + i : rows + i + 1].view(np.uint8).data for i in range(len(slow))]
        self.cycles = 0
        self.pose = 0

    def play(self) -> int:
        """Write the frames of the next cycle into `frames`; return the number of frames."""
        cycle = self.cycles
        self.cycles = cycle + 1
        tag = self.cycles % TURN  # low byte of the cycle number in SYNC; the first cycle number is 1
        self.pose = tag % POSES
        sealed = self._before if cycle < TURN else self._steady
        self._cyclic_memory[:] = sealed.payloads[self.pose]
        self._cyclic_counters.fill(tag)
        self._cyclic_checksums[:] = sealed.checksums[tag]
        due = self._due[cycle % len(self._due)]
        for memory, row in zip(self._slow_memory, due, strict=False):
            turn = self._slow_turn[row]
            self._slow_turn[row] = (turn + 1) % TURN
            start = row * FRAME_BYTES
            memory[:] = self._slow.payloads[0][start : start + FRAME_BYTES]
            _E2E.pack_into(memory, HEADER_BYTES, self._slow.checksums[turn, row], turn)
        return len(self.cyclic) + len(due)


class _Sealed(NamedTuple):
    payloads: list[bytes]  # element k contains the frames of all messages in pose k
    #: Element [c, m] is the CRC of message m with the alive counter c, shape (TURN, messages).
    checksums: npt.NDArray[np.uint16]


def _seal(image: TransmitImage, values: Vector) -> _Sealed:
    payloads, checksums = [], []
    _, of_rows = _e2e_fields(image.frames)
    for cycle in range(TURN):
        image.values[:] = values[cycle % len(values)]
        sealed = image.seal()
        payloads.append(sealed.tobytes())
        checksums.append(of_rows.copy())
    return _Sealed(payloads[: len(values)], np.array(checksums))


def _e2e_fields(frames: Frames) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint16]]:
    """Return a view of the alive counters and a view of the CRCs of the frames, shape (frames,) each."""
    octets, halves = (
        frames.view(np.uint8).reshape(-1, FRAME_BYTES),
        frames.view(np.uint16).reshape(-1, FRAME_BYTES // 2),
    )
    return octets[:, HEADER_BYTES + COUNTER_BYTE], halves[:, HEADER_BYTES // 2]


def _walking(image: TransmitImage) -> Vector:
    """Return a plausible value of each signal, shape (signals,). `Recording` adds motion and noise to these values.

    The HAL reports no fault if it receives the resulting values.
    """
    codec, rng = image.codec, np.random.default_rng(1)
    values = np.zeros(codec.size)
    for name, low, high in (
        ("Torque", -20.0, 20.0), ("Force", -5.0, 5.0), ("Gyro", -0.1, 0.1), ("Accel", -0.1, 0.1),
    ):  # fmt: skip
        columns = codec.slice(name)
        values[columns] = rng.uniform(low, high, columns.stop - columns.start)
    for column, (_, signal) in enumerate(codec.signals):
        if signal.name == "Temperature":
            values[column] = 30.0
        elif signal.name == "DriveState":
            values[column] = DriveState.OPERATION_ENABLED
    values[codec.slice("Accel")][2::3] += GRAVITY
    values[codec.slice("Quaternion")][::4] = 1.0
    for name, value in (("DeadMan", 1.0), ("AssistanceSet", 1.0), ("AssistanceFactor", ASSISTANCE)):
        values[codec.index("PENDANT_STATE", name)] = value
    return values


class RecordedBus:
    """Bus of the HAL (see `atalante_hal.bus.Bus`) that answers each SYNC with the frames of the next recorded cycle."""

    def __init__(self, recording: Recording) -> None:
        self.name, self.dropped = "recording", 0
        self.stamps: Stamps = np.zeros(len(recording.frames), np.int64)
        self.sent = 0  # frames sent by the HAL
        self._recording, self._memory = recording, recording.frames.view(np.uint8).data
        self._into, self._into_memory = recording.frames, self._memory
        self._syncs = len(syncs(walk().network))
        self._synced = False
        self._prepared: list[bytes] = []  # frames of the prepared cycles, last cycle first

    def prepare(self, cycles: int) -> None:
        """Prepare the frames of the next cycles, so that `receive` only has to copy the frames."""
        memory = self._memory
        self._prepared = [memory[: self._recording.play() * FRAME_BYTES].tobytes() for _ in range(cycles)][::-1]

    def send(self, frames: Frames) -> None:
        """Count the frames that the HAL sends. A batch with exactly one frame per bus is a batch of SYNC frames."""
        count = len(frames)
        self.sent += count
        if count == self._syncs:
            self._synced = True

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Copy the frames of the next cycle into `frames` if SYNC was sent; return the number of copied frames."""
        if not self._synced:
            return 0
        self._synced = False
        if frames is not self._into:
            self._into, self._into_memory = frames, frames.view(np.uint8).data
        if not self._prepared:
            self.prepare(1)
        cycle = self._prepared.pop()
        size = len(cycle)
        self._into_memory[:size] = cycle
        return size // FRAME_BYTES

    def close(self) -> None:
        """Do nothing; there is no resource to release."""


@dataclass
class RecordedHal:
    """HAL in the state ACTIVE, with recorded nodes instead of a robot."""

    hal: Hal
    bus: RecordedBus
    recording: Recording


def active_hal() -> RecordedHal:
    """Create a HAL with recorded nodes and run this HAL until its state is ACTIVE.

    Raises:
        BenchmarkError: If the HAL does not reach ACTIVE.
    """
    recording = Recording(walk())
    bus = RecordedBus(recording)
    hal = Hal(walk().network, walk().robot, bus)
    hal._safety_monitor.proof = DirectionProof(walk().robot, ())  # recorded nodes do not react to test pulses
    hal._safety_monitor.torque_tracking.tolerance.fill(np.inf)  # recorded nodes do not follow torque commands
    for _ in range(2 * TURN):
        hal.read()
        hal.hold()
    state = hal.state.supervisor
    require(
        state is SupervisorState.ACTIVE, f"the HAL on recorded nodes must be in ACTIVE, got {state.name}: {hal.reason}"
    )
    return RecordedHal(hal, bus, recording)


class FilterOnly:
    """Controller that consists only of the guide filter for left hip (SH) and left knee (SK)."""

    def __init__(self, walk: Walk) -> None:
        self._guide, self._cycle = walk.guide, 0
        self._desired = walk.tables.q[0, 2:4].tolist()
        self._command = Command(np.zeros(len(JOINTS)), np.full(8, 0.25))

    def update(self, state: State) -> Command:
        """Return the command of the controller in one cycle."""
        self.filter(self._command.torque, *state.position[2:4].tolist(), *state.velocity[2:4].tolist())
        return self._command

    def filter(self, torque: Vector, hip: float, knee: float, hip_rate: float, knee_rate: float) -> None:
        """Write the virtual guide torques u_v of the left hip (SH) and the left knee (SK) into `torque`.

        Args:
            torque: joint torques [Nm], shape (12,); entries 2 and 3 are written.
            hip: angle of the left SH [rad].
            knee: angle of the left SK [rad].
            hip_rate: velocity of the left SH [rad/s].
            knee_rate: velocity of the left SK [rad/s].
        """
        cycle = self._cycle % TURN
        if not cycle:
            self._guide.start_step(ASSISTANCE, (0.01, -0.01), (0.05, 0.05))
        self._cycle += 1
        q_hip, q_knee = self._desired
        leg = LegState(hip, knee, hip_rate, knee_rate, q_hip, q_knee, float(torque[2]), float(torque[3]), 0.0, 0.0)
        torque[2:4] = self._guide.tick(cycle, leg)
