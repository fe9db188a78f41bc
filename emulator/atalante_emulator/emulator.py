"""Emulator of the robot: runs all nodes of the CAN network except the HAL, and sends their frames after each SYNC.

    bus -> process image -> E2E + validity -> nodes -> body -> nodes -> process image -> bus

A cycle begins with SYNC. Every node latches the command of the previous cycle and sends its samples. Then the body moves for
one millisecond. Then the nodes sample the sensors for the next cycle, and the emulator adds counter and CRC to the next
frames. So the next SYNC is answered without delay, and a HAL in another process can compute while the body moves.

`poll` answers an embedded HAL in lock-step, as the `step` function of a `PairBus`. `run` answers a HAL in another process. With
the same seed and the same frames of the HAL, the emulator sends the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from atalante_dbc import Network
from atalante_emulator.bodies import Body
from atalante_emulator.collision import Senders
from atalante_emulator.crane import Crane
from atalante_emulator.drive import WATCHDOG, DriveParameters, Drives, DriveSignals
from atalante_emulator.emergency import COMMAND_LOST, COMMAND_REJECTED, LIFE_GUARD, TWO_SENDERS, Emergency
from atalante_emulator.faults import LINK_KINDS, NODE_KINDS, SENSOR_KINDS, Fault
from atalante_emulator.foot import Feet, FootParameters
from atalante_emulator.haptics import Haptics, HapticsParameters
from atalante_emulator.heartbeat import Heartbeats
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_emulator.link import FaultyBus
from atalante_emulator.node_faults import NodeFaults
from atalante_emulator.noise import NOISE_CYCLES, SensorNoise
from atalante_emulator.patient import ActivePatient
from atalante_emulator.pendant import Operator, PendantNode
from atalante_emulator.virtual_operator import VirtualOperator
from atalante_emulator.wearer import PassiveWearer
from atalante_hal.bus import Bus, BusFull
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, SIDES, Robot
from atalante_hal.types import PERIOD, SupervisorState, Vector
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import COUNTER_BYTE, Check
from atalante_hal.wire.frame import FRAME_BYTES, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

#: Capacity of the receive buffer [frames]. The HAL sends seven or eight frames per cycle.
_RECEIVE_BUDGET = 128
#: Capacity of the transmit buffer [frames]. The nodes send 19 cyclic frames per cycle, and slow and emergency messages.
_BATCH = 128
#: The nodes reject a command frame if `ReceiveImage` found one of these errors in the frame.
_REJECTED = (Check.CRC, Check.LENGTH, Check.RANGE, Check.INVALID)
#: Half of the number of alive counter values (256). The difference of two alive counters is mapped to -128 to 127.
_HALF_TURN = 128
#: Longest wait for the other SYNCs of a cycle after the first SYNC [s]. The HAL sends one SYNC on each bus.
_SYNC_SKEW = 200e-6
#: Largest number of cycles without SYNC that `run` simulates in a row to catch up with real time.
#: After these cycles, `run` calls `stop` and receives frames.
_CATCH_UP = 20


@dataclass(frozen=True)
class EmulatorParameters:
    """True parameters of the emulated nodes. The HAL cannot read these parameters."""

    drive: DriveParameters = field(default_factory=DriveParameters)
    imu: ImuParameters = field(default_factory=ImuParameters)
    foot: FootParameters = field(default_factory=FootParameters)
    haptics: HapticsParameters = field(default_factory=HapticsParameters)


class Emulator:
    """All nodes of the network except the HAL. The nodes sense and move one emulated robot, the `body`.

    `before_send` is a list of callables `(cycle, values)`. Each callable is called after the SYNC of a cycle and may change
    `values`, the signal values that the nodes then send. The values are in the order of `signals`.

    `pelvis_forces` is a list of callables `(hal_state) -> wrench`. Each callable is called once per time step, also without SYNC.
    The sum of the returned wrenches acts on the pelvis: force [N] and moment [Nm] in world axes, shape (6,). For example, a
    `Crane` is such a callable.
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
        """Connect the nodes to the bus.

        Args:
            network: nodes and messages of the DBC.
            robot: joint properties that the nodes use.
            body: mechanics of the robot. The emulator advances the body, and the caller closes the body.
            bus: bus on which the nodes of all buses send and receive. A `JoinedBus` combines several channels.
            seed: seed of all random numbers: sensor noise, biases and random faults.
            operator: emulated operator of the pendant. None if another process runs the pendant node.
            parameters: true parameters of the nodes. With None, the default parameters are used.
            faults: faults to inject. The first cycle of the emulator has number 0.

        Raises:
            FaultError: If the target or a signal of a fault is not in the network, or this emulator does not run the target node.
        """
        parameters = parameters or EmulatorParameters()
        self.network, self.body, self.bus, self.operator = network, body, bus, operator
        self._robot, self._seed = robot, seed
        self._link: FaultyBus | None = None
        self._node_faults: NodeFaults | None = None
        self.cycle = 0
        self.frames_lost = 0  # number of frames lost because the transmit queue of the bus was full
        self.before_send: list[Callable[[int, Vector], None]] = []
        self.pelvis_forces: list[Callable[[int], Vector]] = []
        self._pushing = False  # whether a wrench acted on the pelvis in the last time step
        #: Crane that lowers the robot to the ground, or None. If set, the crane is also in `pelvis_forces`.
        self.crane: Crane | None = None
        #: Emulated operator who steadies the robot on the ground, or None. If set, the operator is also in `pelvis_forces`.
        self.virtual_operator: VirtualOperator | None = None
        #: Emulated wearer whose legs act on the joints of the robot, or None.
        self.wearer: PassiveWearer | ActivePatient | None = None
        self._build_images()
        self._bind_commands()
        self._build_nodes(robot, parameters)
        self._noise = SensorNoise(seed, self._tx.codec, self.drives, self._imus, self._feet)
        self.inject(faults)
        self._sample_next()

    def inject(self, faults: Sequence[Fault]) -> None:
        """Plan the faults of a run. Call this at most once, and only if the constructor got no faults.

        Args:
            faults: faults to inject; each must begin at least two cycles later, because the next frames are already computed.

        Raises:
            FaultError: If the target or a signal of a fault is not in the network, or this emulator does not run the target node.
        """
        if any(fault.kind in LINK_KINDS for fault in faults):
            self.bus = self._link = FaultyBus(self.bus, self.network, faults, lambda: self.cycle, seed=self._seed)
        if any(fault.kind in NODE_KINDS or fault.kind in SENSOR_KINDS for fault in faults):
            self._node_faults = NodeFaults(
                faults, self.network, self._robot, self._tx.codec,
                self.drives, self._haptics, self._heartbeats, self._emergencies,
            )  # fmt: skip
            if self._node_faults.rewrites:
                self.before_send.append(self._node_faults.rewrite)

    @property
    def signals(self) -> Codec:
        """Codec of the 1 ms messages of the nodes. Its method `index` finds a signal in the `values` of `before_send`."""
        return self._tx.codec

    # -- construction ------------------------------------------------------------------------------------------------

    def _build_images(self) -> None:
        network = self.network
        kinds = ("drive", "imu", "foot", "haptics") + (("pendant",) if self.operator else ())
        ours = {node.name for node in network.nodes if node.kind in kinds}
        sent = [m for m in network.messages if m.sender in ours]
        cyclic = [m for bus in network.buses for m in sent if m.bus == bus and m.cycle_ms == 1]
        self._tx = TransmitImage(cyclic)
        self._sealed = False  # True if `_tx` already contains the finished frames for the next SYNC
        self._tag = 0  # alive counter in the frames for the next SYNC: low byte of the expected cycle number
        self._haptics_tx = TransmitImage([network.message("HAPTICS_STATE")])
        self._emergencies: list[Emergency] = []  # emergency messages to send in this cycle
        self._emergency_tx = TransmitImage([m for m in sent if m.name.endswith("_EMCY")])
        self._heartbeats = Heartbeats(network, [m for m in sent if m.name.endswith("_STATUS")], self._emergency_tx)
        self._statuses: Sequence[Frames] = ()  # status messages that are due in this cycle

        received = [m for m in network.sent_by("HAL") if m.cycle_ms == 1]
        syncs = [m for m in received if m.name.startswith("SYNC_")]
        # `_rx` lists the commands before the SYNCs, because a HAL in the same process delivers its frames in this order.
        self._rx = ReceiveImage([m for m in received if m not in syncs] + syncs)
        self._rx.values.fill(0.0)  # initial values: no torque, no vibration, HAL state OFF
        self._scratch = new_frames(_RECEIVE_BUDGET)
        self._scratch_from = [self._scratch[offset:] for offset in range(_RECEIVE_BUDGET)]
        #: Number of frames at the start of `_scratch` that arrived before a SYNC. The next `poll` processes these frames.
        self._waiting = 0

        self._sync_rows = [self._rx.codec.rows[m.name] for m in syncs]
        self._sync_ids = {m.frame_id for m in syncs}
        self._shares: list[Frames] = []  # _shares[i]: frames with which the nodes of bus i answer the SYNC of bus i
        for sync in syncs:
            rows = [row for row, m in enumerate(cyclic) if m.bus == sync.bus]
            self._shares.append(self._tx.frames[rows[0] : rows[-1] + 1])
        self._whole = [self._tx.frames]
        #: _leg_syncs[leg]: index i of the SYNC that the drives of the leg receive.
        self._leg_syncs = [[m.name for m in syncs].index(f"SYNC_{side.upper()}_LEG") for side in SIDES]
        #: _answered[i]: copy of the frames `_shares[i]`. `_imperfect_cycle` renews this copy each time it starts a cycle.
        #: If SYNC i arrives after another SYNC has started the cycle, the nodes on the bus of SYNC i send `_answered[i]`.
        self._answered = self._shares
        batch = new_frames(_BATCH)
        self._batch = batch.view(np.uint8).data
        self._batch_up_to = [batch[:count] for count in range(_BATCH + 1)]

    def _bind_commands(self) -> None:
        values, codec = self._rx.values, self._rx.codec
        self._controlword = values[codec.slice("Controlword")]
        self._target = values[codec.slice("TargetTorque")]
        self._limit = values[codec.slice("MaxTorque")]
        self._level = values[codec.slice("Level")]
        self._hal_state_index = codec.index("SYNC_RIGHT_SENSE", "HalState")
        self._hal_state_row = codec.rows["SYNC_RIGHT_SENSE"]
        self._sync_cycles = values[codec.slice("Cycle")]
        self._command_rows = [codec.rows[f"COMMAND_{side.upper()}_LEG"] for side in SIDES]
        self._senders = [Senders(self._rx.codec.messages[row]) for row in self._command_rows]
        #: _leg_rows[leg]: row of the SYNC and row of the command of the leg in the receive buffer `_rx`.
        self._leg_rows = [
            (self._sync_rows[sync], row) for sync, row in zip(self._leg_syncs, self._command_rows, strict=True)
        ]
        #: _counters[row]: alive counter of the last frame received for this row of `_rx` (one row for each message of the HAL).
        self._counters = self._rx.frames["data"][:, COUNTER_BYTE]
        self._level_row = codec.rows["HAPTICS_COMMAND"]
        self._commanded = [False] * len(SIDES)
        self._delay = [0] * len(SIDES)  # _delay[leg]: number of cycles by which the last valid command arrived late
        self._last_sync: int | None = None

    def _build_nodes(self, robot: Robot, parameters: EmulatorParameters) -> None:
        codec = self._tx.codec
        #: Signal values without noise. The nodes write into this array.
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
        self._feet = Feet(
            parameters.foot, self.body.soles, truth[codec.slice("Force")].reshape(len(FEET), len(CELLS), 3)
        )
        for kind, temperature in (("IMU", parameters.imu.temperature), ("FOOT", parameters.foot.temperature)):
            for message in codec.messages:
                if message.name.startswith(f"{kind}_"):
                    truth[codec.index(message.name, "Temperature")] = temperature
        #: Vibration of each motor as a share of its largest vibration, 0 to 1, in the order of MOTORS, shape (8,).
        self.vibration: Vector = self._haptics_tx.values[self._haptics_tx.codec.slice("Amplitude")]
        self._haptics = Haptics(parameters.haptics, self.vibration)
        self._haptics_cycles = self._haptics_tx.codec.messages[0].cycle_ms
        self._pendant = None if self.operator is None else PendantNode(self.operator, codec, truth)

    # -- receive and send --------------------------------------------------------------------------------------------

    def poll(self, timeout: float = 0.0) -> bool:
        """Receive frames and, if they contain SYNC, run one cycle.

        Args:
            timeout: longest wait for the first frame [s].

        Returns:
            Whether a cycle was run.
        """
        if self._link is not None:
            self._link.synced = False
        count = self.bus.receive(self._scratch_from[self._waiting], timeout) + self._waiting
        if count < len(self._rx.frames):
            count = self._receive_rest(count)
            if not count:
                return self._cycle_without_sync()
        self._waiting = 0
        self._rx.accept(self._scratch, count)
        if self._rx.all_fresh and self._commands_in_step():
            self._commanded = [False] * len(SIDES)
            self._complete_answer(int(self._sync_cycles[0]))
            self._cycle((True, True), self._whole)
            return True
        return self._imperfect_cycle(count)

    def _receive_rest(self, count: int) -> int:
        """Receive frames until all SYNCs of the cycle have arrived, or until `_SYNC_SKEW` after the first SYNC.

        Args:
            count: number of frames already in the scratch buffer.

        Returns:
            Number of frames in the scratch buffer; 0 if there is no SYNC. In this case the frames are kept for the next call.
        """
        ids = self._scratch["can_id"]
        synced: set[int] = set()
        deadline = None
        while count < _RECEIVE_BUDGET:
            synced = self._sync_ids.intersection(ids[:count].tolist())
            if not synced and not self._lost_sync:
                break
            if len(synced) == len(self._sync_ids):
                break
            now = time.monotonic()
            deadline = deadline or now + _SYNC_SKEW
            got = self.bus.receive(self._scratch_from[count], max(0.0, deadline - now))
            if not got:
                break
            count += got
        if not synced:
            self._waiting = count
            return 0
        return count

    @property
    def _lost_sync(self) -> bool:
        """Whether the HAL sent a SYNC in this call of `poll`, even if an injected fault removed the SYNC.

        Always False for an emulator without communication faults.
        """
        return self._link is not None and self._link.synced

    def _imperfect_cycle(self, count: int) -> bool:
        """Process received frames if a frame of the HAL is missing, invalid or late.

        If a SYNC is among them, run one cycle, unless the emulator already ran this cycle.

        Args:
            count: number of frames in the scratch buffer.

        Returns:
            Whether a cycle was run.
        """
        self._check_delays()
        checks = self._rx.check.tolist()
        self._check_commands(checks, count)
        synced = [sync for sync, row in enumerate(self._sync_rows) if checks[row] <= Check.SOME_LOST]
        if not synced:
            return self._cycle_without_sync()
        number = int(max(self._sync_cycles[synced]))
        if number == self._last_sync:  # another SYNC of this cycle arrived earlier, and the cycle has already run
            for leg, sync in enumerate(self._leg_syncs):
                if sync in synced:
                    self.drives.restart_sync_watchdog(leg)
            self._send([self._answered[sync] for sync in synced])
            return False
        self._last_sync = number
        fresh = self._commanded[0], self._commanded[1]
        delay = self._delay[0], self._delay[1]
        self._commanded = [False] * len(SIDES)
        self._complete_answer(number)
        self._answered = [share.copy() for share in self._shares]
        for leg, sync in enumerate(self._leg_syncs):
            if sync not in synced:
                self.drives.miss_sync(leg, self.cycle)
        self._cycle(fresh, [self._answered[sync] for sync in synced], delay)
        return True

    def _commands_in_step(self) -> bool:
        """Return whether the commands of both legs are on time.

        The HAL sends a command and the SYNC of the next cycle with the same alive counter. So a command is on time if
        its counter equals the counter of the SYNC.
        """
        counters = self._counters.tobytes()
        (left_sync, left), (right_sync, right) = self._leg_rows
        return counters[left_sync] == counters[left] and counters[right_sync] == counters[right]

    def _check_delays(self) -> None:
        """Store by how many cycles each valid command is late, and reject a command that is late by `WATCHDOG` cycles or more.

        The HAL sends a command and the SYNC of the next cycle with the same alive counter. So the delay of a command
        is SYNC counter minus command counter [cycles]. The delay is negative if the SYNC is missing.
        """
        for leg, (sync, command) in enumerate(self._leg_rows):
            if self._rx.check[command] <= Check.SOME_LOST:
                delay = (int(self._counters[sync]) - int(self._counters[command]) + _HALF_TURN & 0xFF) - _HALF_TURN
                if -WATCHDOG <= delay < WATCHDOG:
                    self._delay[leg] = max(delay, 0)
                else:
                    self._rx.refuse(command, np.flatnonzero(self._rx.codec.row_of == command))

    def _check_commands(self, checks: list[int], count: int) -> None:
        """Inform the drives of each leg about lost and rejected commands.

        If two nodes send commands to a leg, the drives of this leg start their local hold.

        Args:
            checks: value of `Check` of each row of the process image.
            count: number of frames in the scratch buffer.
        """
        for leg, row in enumerate(self._command_rows):
            check = checks[row]
            self._commanded[leg] |= check <= Check.SOME_LOST
            # If a command is too late, `_check_delays` sets its check result to IMPLAUSIBLE.
            if check in (Check.SOME_LOST, Check.IMPLAUSIBLE):
                self.drives.warn(leg, COMMAND_LOST)
            elif check in _REJECTED:
                self.drives.warn(leg, COMMAND_REJECTED)
            if self._senders[leg].are_two(self._scratch[:count], self.cycle):
                self.drives.hold(leg, TWO_SENDERS)

    def _cycle_without_sync(self) -> bool:
        """Run a cycle without answers if an injected fault removed the SYNC of the HAL. Otherwise, do nothing.

        Returns:
            Whether a cycle was run.
        """
        lost = self._lost_sync
        if lost:
            for leg in range(len(SIDES)):
                self.drives.miss_sync(leg, self.cycle)
            self.run_without_sync()
        return lost

    def _send(self, parts: Sequence[Frames]) -> None:
        """Send all frames of a cycle in one call of `bus.send`."""
        frames = parts[0] if len(parts) == 1 else self._gather(parts)
        try:
            self.bus.send(frames)
        except BusFull as error:
            self.frames_lost += len(frames) - error.sent

    def _gather(self, parts: Sequence[Frames]) -> Frames:
        octets = b"".join([part.tobytes() for part in parts])
        self._batch[: len(octets)] = octets
        return self._batch_up_to[len(octets) // FRAME_BYTES]

    # -- steps of one cycle ------------------------------------------------------------------------------------------

    def _sample_next(self) -> None:
        """Sample the sensors, and encode the frames that the nodes will send after the next SYNC.

        The HAL waits for these frames, so they are encoded before that SYNC. A callable in `before_send` may change the values
        after the SYNC. With such a callable, the 1 ms messages are encoded after the SYNC.
        """
        body = self.body
        position = body.position
        if self._node_faults is not None:
            position = self._node_faults.begin(self.cycle, position)
        self.drives.sample(position)
        self._imus.sample(body.imu)
        self._feet.sample(body.sole_force, body.touching)
        if not self.cycle % NOISE_CYCLES:
            self._noise.draw()
        if not self.before_send:
            self._seal()
        self._statuses = self._heartbeats.due(self.cycle)

    def _seal(self) -> None:
        self._noise.add(self.cycle, self._truth, self._tx.values)
        for rewrite in self.before_send:
            rewrite(self.cycle, self._tx.values)
        self._tx.seal(self._tag)
        self._sealed = True

    def _complete_answer(self, number: int) -> None:
        """Make sure that `_tx` contains the frames with which the nodes answer a SYNC.

        `_sample_next` has already encoded these frames for the expected cycle number. Encode them again if SYNC contains another
        number, if the pendant signals changed, or if `before_send` contains a callable.

        Args:
            number: cycle number received in SYNC.
        """
        changed = self._pendant is not None and self._pendant.receive(int(self._rx.values[self._hal_state_index]))
        if changed or self.before_send or not self._sealed or number & 0xFF != self._tag:
            self._tag = number & 0xFF
            self._seal()
        self._tag = self._tag + 1 & 0xFF
        self._sealed = False

    def _cycle(self, fresh: tuple[bool, bool], answer: list[Frames], delay: tuple[int, int] = (0, 0)) -> None:
        """Run one cycle: pass the command to the drives, send the answer, move the body and sample the sensors.

        The command of cycle k-1 acts from the start of cycle k to the start of cycle k+1.

        Args:
            fresh: per leg, whether a valid new command arrived.
            answer: frames to send.
            delay: per leg, delay of the new command [cycles].
        """
        drives = self.drives
        drives.command(fresh, self._controlword, self._target, self._limit, delay)
        self._send(self._with_slow(answer))
        self._step_body()

    def _step_body(self) -> None:
        """Move the body by one millisecond, and sample the sensors."""
        if self.pelvis_forces:
            hal_state = self._hal_state()
            first, *others = self.pelvis_forces
            wrench = first(hal_state)
            for force in others:
                wrench = wrench + force(hal_state)
            acting = wrench.tolist()
            pushing = any(acting)
            if pushing or self._pushing:
                self.body.push(acting[:3], acting[3:])
            self._pushing = pushing
        if self.wearer is not None:
            self.wearer.act(self.body.position, self.body.velocity, self.drives.motors.limb)
        self.body.step(self.drives.drive(self.body.velocity))
        self.cycle += 1
        self._sample_next()

    def _hal_state(self) -> int:
        """Return the HAL state of the last SYNC; OFF if the last SYNC is at least `WATCHDOG` cycles old."""
        heard = self._rx.age[self._hal_state_row] < WATCHDOG
        return int(self._rx.values[self._hal_state_index]) if heard else SupervisorState.OFF

    def _with_slow(self, parts: list[Frames]) -> list[Frames]:
        """Return `parts` plus the status messages, the haptics message and the emergency messages that are due."""
        if self.cycle % self._haptics_cycles == 0:
            self._haptics.advance(self._level, int(self._rx.age[self._level_row]), self._haptics_cycles)
            parts = [*parts, self._haptics_tx.seal()]
        if self._statuses:
            parts = [*parts, *self._statuses]
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

    # -- real time ---------------------------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Run the robot for a HAL in another process.

        After `WATCHDOG` milliseconds without SYNC, the drives start their local hold. Body and heartbeats continue in real time.
        If this computer is too slow for that, or this process was stopped, the simulated time falls behind.

        Args:
            stop: function that returns True to end the run. It is called about once per millisecond, and at least after every
                `_CATCH_UP` simulated milliseconds.
        """
        alone_from = time.monotonic() + WATCHDOG * PERIOD
        while not stop():
            ran = self.poll(PERIOD)
            now = time.monotonic()
            if ran:
                alone_from = now + WATCHDOG * PERIOD
                continue
            for _ in range(_CATCH_UP):
                if alone_from > now:
                    break
                self.idle()
                alone_from += PERIOD
            alone_from = max(alone_from, now - _CATCH_UP * PERIOD)

    def idle(self) -> None:
        """Run one millisecond without a HAL. Enabled drives start their local hold.

        The nodes send only status, haptics and emergency messages.
        """
        for leg in range(len(SIDES)):
            self.drives.hold(leg, LIFE_GUARD)
        self.run_without_sync()

    def run_without_sync(self) -> None:
        """Run one millisecond without SYNC. The nodes send only status, haptics and emergency messages."""
        drives = self.drives
        self._rx.new_cycle()
        drives.command((False, False), self._controlword, self._target, self._limit)
        if parts := self._with_slow([]):
            self._send(parts)
        self._step_body()
