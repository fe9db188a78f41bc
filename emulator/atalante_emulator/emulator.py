"""The emulated robot at the other end of the bus.

    bus -> process image -> E2E + validity -> nodes -> body (PyBullet) -> nodes -> process image -> bus

A cycle begins with SYNC: every node latches the command of the cycle before and sends what it sampled, then the body moves on
by one millisecond. Then the next answer is sampled and sealed ahead: a HAL that waits for it in another process waits for a
copy, and works while the body moves. The same object answers an embedded HAL in lock-step (`poll` as the `step` of a `PairBus`)
and a HAL in another process (`run`). One seed gives one sequence of bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from atalante_dbc import Network
from atalante_emulator.body import PERIOD, Body
from atalante_emulator.collision import Senders
from atalante_emulator.drive import WATCHDOG, DriveParameters, Drives, DriveSignals
from atalante_emulator.emergency import COMMAND_LOST, COMMAND_REFUSED, LIFE_GUARD, TWO_SENDERS, Emergency
from atalante_emulator.faults import LINK_KINDS, NODE_KINDS, SENSOR_KINDS, Fault
from atalante_emulator.foot import Feet, FootParameters
from atalante_emulator.haptics import Haptics, HapticsParameters
from atalante_emulator.heartbeat import Heartbeats
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_emulator.link import FaultyBus
from atalante_emulator.node_faults import NodeFaults
from atalante_emulator.noise import NOISE_CYCLES, SensorNoise
from atalante_emulator.pendant import Operator, PendantNode
from atalante_hal.bus import Bus, BusFull
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, SIDES, Robot
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import FRAME_BYTES, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

Vector = npt.NDArray[np.float64]

#: Frames one `receive` can take; a cycle is seven and now and then one more.
_RECEIVE_BUDGET = 128
#: Frames of one cycle at most: nineteen, now and then a slow one, and what goes wrong.
_BATCH = 128
#: What a command frame is when it came, and is not to be followed.
_REFUSED = (Check.CRC, Check.LENGTH, Check.RANGE, Check.INVALID)
#: Longest wait [s] for the other SYNCs of a cycle once the first is there.
_SYNC_SKEW = 200e-6


@dataclass(frozen=True)
class EmulatorParameters:
    """What the emulated nodes are like."""

    drive: DriveParameters = field(default_factory=DriveParameters)
    imu: ImuParameters = field(default_factory=ImuParameters)
    foot: FootParameters = field(default_factory=FootParameters)
    haptics: HapticsParameters = field(default_factory=HapticsParameters)


class Emulator:
    """All nodes of the network but the HAL, on one body.

    `before_send` holds callables `(cycle, values)` that may rewrite what the nodes are about to say, called when the SYNC of that
    cycle has come: `values` is in the order of `signals`.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        body: Body,
        bus: Bus,
        *,
        seed: int = 0,
        operator: Operator | None = None,
        parameters: EmulatorParameters | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Put the nodes on the bus.

        Args:
            body: the mechanics; the emulator steps it, the caller closes it.
            bus: that carries all of the network's buses; several channels come as a `JoinedBus`.
            seed: of every random number: sensor noise and biases.
            operator: holds the pendant; None: the pendant is somebody else's node.
            faults: what goes wrong, and when; cycle 0 is the first.

        Raises:
            FaultError: the network has no such target or signal.
        """
        parameters = parameters or EmulatorParameters()
        self.network, self.body, self.bus, self.operator = network, body, bus, operator
        self._link: FaultyBus | None = None
        if any(fault.kind in LINK_KINDS for fault in faults):
            self.bus = self._link = FaultyBus(bus, network, faults, lambda: self.cycle, seed=seed)
        self.cycle = 0
        self.frames_lost = 0  # nodes' frames that the bus had no room for
        self.before_send: list[Callable[[int, Vector], None]] = []
        self._build_images()
        self._bind_commands()
        self._build_nodes(robot, parameters)
        self._noise = SensorNoise(seed, self._tx.codec, self.drives, self._imus, self._feet)
        self._node_faults: NodeFaults | None = None
        if any(fault.kind in NODE_KINDS or fault.kind in SENSOR_KINDS for fault in faults):
            self._node_faults = NodeFaults(
                faults, network, robot, self._tx.codec, self.drives, self._heartbeats, self._emergencies
            )
            if self._node_faults.rewrites:
                self.before_send.append(self._node_faults.rewrite)
        self._look_ahead()

    @property
    def signals(self) -> Codec:
        """Order of the values of the 1 ms messages."""
        return self._tx.codec

    # -- construction ------------------------------------------------------------------------------------------------

    def _build_images(self) -> None:
        network = self.network
        kinds = ("drive", "imu", "foot", "haptics") + (("pendant",) if self.operator else ())
        ours = {node.name for node in network.nodes if node.kind in kinds}
        sent = [m for m in network.messages if m.sender in ours]
        cyclic = [m for bus in network.buses for m in sent if m.bus == bus and m.cycle_ms == 1]
        self._tx = TransmitImage(cyclic)
        self._sealed = False  # the frames wait for their SYNC
        self._tag = 0  # low byte of the number of the cycle they are for: their alive counter
        self._haptics_tx = TransmitImage([network.message("HAPTICS_STATE")])
        self._heartbeats = Heartbeats(network, [m for m in sent if m.name.endswith("_STATUS")])
        self._emergencies: list[Emergency] = []  # to be told in this cycle
        self._emergency_tx = TransmitImage([m for m in sent if m.name.endswith("_EMCY")])

        heard = [m for m in network.sent_by("HAL") if m.cycle_ms == 1]
        syncs = [m for m in heard if m.name.startswith("SYNC_")]
        # As they come on an embedded bus: the commands of the last cycle, then SYNC.
        self._rx = ReceiveImage([m for m in heard if m not in syncs] + syncs)
        self._rx.values.fill(0.0)  # until something is commanded: no torque, motors still, a HAL that is OFF
        self._scratch = new_frames(_RECEIVE_BUDGET)
        self._scratch_from = [self._scratch[place:] for place in range(_RECEIVE_BUDGET)]
        self._waiting = 0  # frames at the head of the scratch that no SYNC has followed yet

        self._sync_rows = [self._rx.codec.rows[m.name] for m in syncs]
        self._sync_ids = {m.frame_id for m in syncs}
        self._shares: list[Frames] = []  # what the nodes of the bus of each SYNC send
        for sync in syncs:
            rows = [row for row, m in enumerate(cyclic) if m.bus == sync.bus]
            self._shares.append(self._tx.frames[rows[0] : rows[-1] + 1])
        self._whole = [self._tx.frames]
        #: Of each leg, the place of its SYNC among the SYNCs.
        self._leg_syncs = [[m.name for m in syncs].index(f"SYNC_{side.upper()}_LEG") for side in SIDES]
        self._answered = self._shares  # shares of the last imperfect cycle
        batch = new_frames(_BATCH)
        self._batch = batch.view(np.uint8).data
        self._batch_up_to = [batch[:count] for count in range(_BATCH + 1)]

    def _bind_commands(self) -> None:
        values, codec = self._rx.values, self._rx.codec
        self._controlword = values[codec.slice("Controlword")]
        self._target = values[codec.slice("TargetTorque")]
        self._limit = values[codec.slice("MaxTorque")]
        self._level = values[codec.slice("Level")]
        self._pendant_hears = codec.index("SYNC_RIGHT_SENSE", "HalState")
        self._sync_cycles = values[codec.slice("Cycle")]
        self._command_rows = [codec.rows[f"COMMAND_{side.upper()}_LEG"] for side in SIDES]
        self._senders = [Senders(self._rx.codec.messages[row]) for row in self._command_rows]
        self._level_row = codec.rows["HAPTICS_COMMAND"]
        self._commanded = [False] * len(SIDES)
        self._last_sync: int | None = None

    def _build_nodes(self, robot: Robot, parameters: EmulatorParameters) -> None:
        codec = self._tx.codec
        #: What the signals are before noise; the nodes write into it.
        self._truth = np.zeros(codec.size)
        truth = self._truth

        def joint(signal: str) -> Vector:
            first = codec.index(f"{JOINTS[0].upper()}_STATE", signal)
            return truth[first : first + len(JOINTS)]

        self.drives = Drives(
            robot,
            parameters.drive,
            DriveSignals(*(joint(s) for s in ("Position", "Velocity", "Torque", "Temperature", "DriveState"))),
            self._emergencies,
        )
        self._imus = Imus(
            parameters.imu,
            ImuSignals(
                truth[codec.slice("Quaternion")].reshape(len(IMUS), 4),
                truth[codec.slice("Gyro")].reshape(len(IMUS), 3),
                truth[codec.slice("Accel")].reshape(len(IMUS), 3),
            ),
        )
        self._feet = Feet(parameters.foot, truth[codec.slice("Force")].reshape(len(FEET), len(CELLS), 3))
        for kind, temperature in (("IMU", parameters.imu.temperature), ("FOOT", parameters.foot.temperature)):
            for message in codec.messages:
                if message.name.startswith(f"{kind}_"):
                    truth[codec.index(message.name, "Temperature")] = temperature
        amplitude = self._haptics_tx.values[self._haptics_tx.codec.slice("Amplitude")]
        self._haptics = Haptics(parameters.haptics, amplitude)
        self._haptics_cycles = self._haptics_tx.codec.messages[0].cycle_ms
        self._pendant = None if self.operator is None else PendantNode(self.operator, codec, truth)

    # -- bus ---------------------------------------------------------------------------------------------------------

    def poll(self, timeout: float = 0.0) -> bool:
        """Take what the buses delivered and, if SYNC was in it, run one cycle.

        Args:
            timeout: longest wait for the first frame [s].

        Returns:
            Whether a cycle was run.
        """
        count = self.bus.receive(self._scratch_from[self._waiting], timeout) + self._waiting
        if count < len(self._rx.frames):
            count = self._receive_rest(count)
            if not count:
                return self._cycle_without_sync()
        self._waiting = 0
        self._rx.accept(self._scratch, count)
        if self._rx.all_fresh:
            self._commanded = [False] * len(SIDES)
            self._complete_answer(int(self._sync_cycles[0]))
            self._cycle((True, True), self._whole)
            return True
        return self._imperfect_cycle(count)

    def _receive_rest(self, count: int) -> int:
        """Wait until every SYNC of the cycle is there; returns 0 while there is none, and keeps what came for later."""
        ids = self._scratch["can_id"]
        deadline = None
        while count < _RECEIVE_BUDGET:
            synced = self._sync_ids.intersection(ids[:count].tolist())
            if not synced:
                self._waiting = count
                return 0
            if len(synced) == len(self._sync_ids):
                break
            now = time.monotonic()
            deadline = deadline or now + _SYNC_SKEW
            got = self.bus.receive(self._scratch_from[count], max(0.0, deadline - now))
            if not got:
                break
            count += got
        return count

    def _imperfect_cycle(self, count: int) -> bool:
        """Something is missing or refused: run the cycle with what is there."""
        checks = self._rx.check.tolist()
        self._judge_commands(checks, count)
        synced = [place for place, row in enumerate(self._sync_rows) if checks[row] <= Check.SOME_LOST]
        if not synced:
            return self._cycle_without_sync()
        number = int(max(self._sync_cycles[synced]))
        if number == self._last_sync:  # the rest of a cycle that has already run
            for leg, place in enumerate(self._leg_syncs):
                if place in synced:
                    self.drives.find_sync(leg)
            self._send([self._answered[place] for place in synced])
            return False
        self._last_sync = number
        fresh = self._commanded[0], self._commanded[1]
        self._commanded = [False] * len(SIDES)
        self._complete_answer(number)
        self._answered = [share.copy() for share in self._shares]
        for leg, place in enumerate(self._leg_syncs):
            if place not in synced:
                self.drives.miss_sync(leg, self.cycle)
        self._cycle(fresh, [self._answered[place] for place in synced])
        return True

    def _judge_commands(self, checks: list[int], count: int) -> None:
        """What the drives of each leg make of their command message."""
        for leg, row in enumerate(self._command_rows):
            check = checks[row]
            self._commanded[leg] |= check <= Check.SOME_LOST
            if check == Check.SOME_LOST:
                self.drives.notice(leg, COMMAND_LOST)
            elif check in _REFUSED:
                self.drives.notice(leg, COMMAND_REFUSED)
            if self._senders[leg].are_two(self._scratch[:count], self.cycle):
                self.drives.hold(leg, TWO_SENDERS)

    def _cycle_without_sync(self) -> bool:
        """Whether the wire lost or spoilt this cycle's SYNC: then the millisecond goes by all the same."""
        lost = self._link is not None and self._link.synced
        if lost:
            for leg in range(len(SIDES)):
                self.drives.miss_sync(leg, self.cycle)
            self._alone()
        return lost

    def _send(self, parts: Sequence[Frames]) -> None:
        """All that a cycle has to say in one batch: who waits for it takes it up at once or not at all."""
        frames = parts[0] if len(parts) == 1 else self._gather(parts)
        try:
            self.bus.send(frames)
        except BusFull as error:
            self.frames_lost += len(frames) - error.sent

    def _gather(self, parts: Sequence[Frames]) -> Frames:
        octets = b"".join([part.tobytes() for part in parts])
        self._batch[: len(octets)] = octets
        return self._batch_up_to[len(octets) // FRAME_BYTES]

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def _look_ahead(self) -> None:
        """What the sensors say in the coming cycle: known as soon as the body has moved."""
        body = self.body
        position = body.position
        if self._node_faults is not None:
            position = self._node_faults.begin(self.cycle, position)
        self.drives.sample(position)
        self._imus.sample(body.imu)
        self._feet.sample(body.contact, body.foot_rotation)
        if not self.cycle % NOISE_CYCLES:
            self._noise.draw()
        if not self.before_send:
            self._seal()

    def _seal(self) -> None:
        self._noise.add(self.cycle, self._truth, self._tx.values)
        for rewrite in self.before_send:
            rewrite(self.cycle, self._tx.values)
        self._tx.seal(self._tag)
        self._sealed = True

    def _complete_answer(self, number: int) -> None:
        """SYNC of this cycle is there: what could not be said ahead of it."""
        changed = self._pendant is not None and self._pendant.hear(int(self._rx.values[self._pendant_hears]))
        if changed or self.before_send or not self._sealed or number & 0xFF != self._tag:
            self._tag = number & 0xFF
            self._seal()
        self._tag = self._tag + 1 & 0xFF
        self._sealed = False

    def _cycle(self, fresh: tuple[bool, bool], answer: list[Frames]) -> None:
        """Latch, send, move, look ahead: [k, k+1] is driven by the command of cycle k-1."""
        drives = self.drives
        drives.command(fresh, self._controlword, self._target, self._limit)
        self._send(self._with_slow(answer))
        self.body.step(drives.drive(self.body.velocity))
        self.cycle += 1
        self._look_ahead()

    def _with_slow(self, parts: list[Frames]) -> list[Frames]:
        """`parts`, and the messages slower than the cycle that are due."""
        if self.cycle % self._haptics_cycles == 0:
            self._haptics.advance(self._level, int(self._rx.age[self._level_row]), self._haptics_cycles)
            parts = [*parts, self._haptics_tx.seal()]
        if due := self._heartbeats.due(self.cycle):
            parts = [*parts, *due]
        if self._emergencies:
            parts = [*parts, *self._seal_emergencies()]
        return parts

    def _seal_emergencies(self) -> list[Frames]:
        tx, parts = self._emergency_tx, []
        for node, register, code in self._emergencies:
            name = f"{node}_EMCY"
            tx.values[tx.codec.index(name, "ErrorRegister")] = register
            tx.values[tx.codec.index(name, "ErrorCode")] = code
            parts.append(tx.seal_row(tx.codec.rows[name]).copy())
            self._heartbeats.set(node, "ErrorFlags", register)
        self._emergencies.clear()
        return parts

    # -- wall clock --------------------------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Be the robot for another process until `stop()`, asked every millisecond or so.

        Without SYNC for `WATCHDOG` milliseconds the drives hold by themselves, and body and heartbeats go on in real time.
        """
        alone_from = time.monotonic() + WATCHDOG * PERIOD
        while not stop():
            ran = self.poll(PERIOD)
            now = time.monotonic()
            if ran:
                alone_from = now + WATCHDOG * PERIOD
                continue
            while alone_from <= now:
                self.idle()
                alone_from += PERIOD

    def idle(self) -> None:
        """One millisecond without a HAL: the nodes say nothing but their heartbeat, and enabled drives hold."""
        for leg in range(len(SIDES)):
            self.drives.hold(leg, LIFE_GUARD)
        self._alone()

    def _alone(self) -> None:
        """One millisecond in which no node can answer."""
        drives = self.drives
        self._rx.new_cycle()
        drives.command((False, False), self._controlword, self._target, self._limit)
        if parts := self._with_slow([]):
            self._send(parts)
        self.body.step(drives.drive(self.body.velocity))
        self.cycle += 1
        self._look_ahead()
