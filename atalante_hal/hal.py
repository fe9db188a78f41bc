"""The hardware abstraction layer: `read()` a state, `write()` a command, once a cycle each.

    bus -> process image -> E2E + plausibility -> state -> supervisor -> [controller] -> limiter -> process image -> bus

The emulator and the robot differ in the bus handed to the constructor, in nothing else. A perfect cycle of a robot that goes on
as it did takes the fast path: nothing is judged that cannot have changed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.cia402 import Controlword, DriveState, controlword_towards_operation
from atalante_hal.codec import Vector
from atalante_hal.commands import Commands, StatusReport
from atalante_hal.diagnostics import Dtc, Reaction, number_of, worst
from atalante_hal.fault_memory import FaultMemory
from atalante_hal.heartbeats import Heartbeats
from atalante_hal.image import NEVER, ReceiveImage
from atalante_hal.judgement import Judgement
from atalante_hal.limiter import Limiter
from atalante_hal.pendant import Pendant
from atalante_hal.plausibility import Plausibility
from atalante_hal.record import Record
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.supervisor import MOVING, Conditions, next_state
from atalante_hal.telemetry.events import Event
from atalante_hal.transceiver import FrameTap, Transceiver
from atalante_hal.types import Command, State, SupervisorState

PERIOD = 1e-3  # s, the SYNC period
#: Cycles within which every drive must have followed to OPERATION ENABLED.
ENABLE_CYCLES = 200
#: Longest time FINISH_STEP goes on [cycles]: more than a step.
FINISH_STEP_CYCLES = 2000
#: Cycles in a row with a torque the limiter cuts, after which the controller is helped.
SATURATED_CYCLES = 200
#: Longest wait for answers while the robot is put into HOLD at the end [s].
STOP_PATIENCE = 1.0

_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()
_FAULTY = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
_NODES = tuple(joint.upper() for joint in JOINTS)
_S = SupervisorState


class Hal:
    """One robot on one bus (or several joined to one).

    Args:
        network: of `atalante_dbc.load`.
        robot: joint limits and transmission.
        bus: owned by the caller, who closes it.
        patience: longest wait [s] for the nodes' answers to a SYNC. On the wall clock well under the period; in lock-step with
            another process long, so that the slowest machine still gives the same run.
        assistance_factor: Xi until the pendant sets another.
        controller_fields: (name, length) of what the controller wants recorded, see `types.Controller`.
        gait_hash: of the gait the controller walks, for HAL_STATUS.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        bus: Bus,
        *,
        patience: float = 0.5e-3,
        assistance_factor: float = 1.0,
        controller_fields: Sequence[tuple[str, int]] = (),
        gait_hash: int = 0,
        tap: FrameTap | None = None,
    ) -> None:
        if not 0.0 <= assistance_factor <= 1.0:
            raise ValueError(f"the assistance factor is between 0 and 1, not {assistance_factor}")
        self.network, self.robot, self.patience = network, robot, patience
        self.conditions = Conditions()
        #: Why the robot is in the state it is in, one sentence.
        self.reason = "nothing has happened yet"
        #: The controller's torques are used.
        self.moving = False
        self._memory = FaultMemory()
        #: What went wrong or changed, once, when it began.
        self.events = self._memory.events
        self._build_images(controller_fields, assistance_factor)
        self._transceiver = Transceiver(
            network, "HAL", bus, tap, cyclic=len(self.messages), surplus=robot.thresholds.surplus_frames
        )
        self._limiter = Limiter(robot, PERIOD)
        self.state.torque_sent = self._limiter.last
        self._commands = Commands(network, self._transceiver, self._parts, self._limiter.limit)
        self._status = StatusReport(network, self._transceiver, robot.hash32, gait_hash)
        self._steady = False  # a perfect cycle would change nothing
        #: What loop and controller did wrong since the last judgement: code, whether confirmed, value, sentence.
        self._reports: list[tuple[Dtc, bool, float, str]] = []
        self._ending = False
        self._barred = False  # another HAL was heard before this one moved anything
        self._start_wanted = 0  # cycles left to reach ACTIVE, 0: nobody asked
        self._assistance_factor = assistance_factor  # the operator's
        self._leading = False  # the assistance factor is on its way to 1 or back
        self._step: int | None = None  # of the controller
        self._finish: tuple[int | None, int] = None, 0  # step in which FINISH_STEP began, last cycle it may go on
        self._lowered: set[str] = set()  # drives that cannot hold
        self._enabling = False  # drives are being enabled, and torque is sent to those that are
        self._drives_judged = b""  # what the drives said when they were judged last

    # -- construction ------------------------------------------------------------------------------------------------

    def _build_images(self, controller_fields: Sequence[tuple[str, int]], assistance_factor: float) -> None:
        received = self.network.received_by("HAL")
        # In the order the buses deliver it, see `ReceiveImage.accept`.
        fast = [m for bus in self.network.buses for m in received if m.bus == bus and m.cycle_ms == 1]
        #: Message of each entry of `State.valid` and `State.age`.
        self.messages = tuple(m.name for m in fast)
        parts = self._parts = Record(ReceiveImage(fast).codec, controller_fields)
        #: Everything known about this cycle, one contiguous vector described by `layout`.
        self.record, self.layout, self.controller_record = parts.values, parts.layout, parts.controller
        self._header = parts.header
        self._header[3] = assistance_factor
        self._image = ReceiveImage(fast, parts.signals)
        self._plausibility = Plausibility(self.robot, self._image, PERIOD)
        self._judgement = Judgement(self.network, self._image)
        self._heartbeats = Heartbeats(self.network, self.robot.thresholds)
        self._pendant = Pendant(self._image)
        self.state = parts.state(assistance_factor, len(fast))
        self.state.valid, self.state.age = self._judgement.valid, self._image.age
        per_turn = self.robot.polarity / self.robot.gear
        # Torque is at the joint on the wire, in both directions.
        self._to_joint = np.concatenate([per_turn, per_turn, np.ones(len(JOINTS))])

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Make sure that no other HAL is at work on this bus. Call before the first `read` where there may be one.

        Raises:
            HalDuplicate: there is one.
        """
        self._transceiver.listen()

    def read(self) -> State:
        """Send SYNC, take the nodes' answers, judge them. The state is the same object every cycle.

        A bus that fails does not raise here: it ends in HOLD like any other fault.
        """
        state, image, transceiver = self.state, self._image, self._transceiver
        state.cycle = cycle = state.cycle + 1
        state.time = cycle * PERIOD
        late = 0 if image.all_fresh else transceiver.receive()  # what the last cycle did not wait for
        self._commands.synchronise(cycle)
        count = transceiver.receive(late, image, self.patience)
        foreign = image.accept(transceiver.scratch, count, cycle & 0xFF)
        if foreign:
            self._accept_foreign(foreign)
        findings = self._plausibility.check()
        parts, pendant = self._parts, self._pendant
        np.multiply(parts.motor_side, self._to_joint, parts.joint_side)
        if not (
            self._steady
            and image.all_fresh
            and not findings
            and transceiver.quiet
            and pendant.signals.tobytes() == pendant.heard
            and parts.drive_side.tobytes() == self._drives_judged
        ):
            self._judge()
        header = self._header
        header[0], header[1] = cycle, state.time
        header[7] += count
        header[9] = transceiver.bus.dropped
        return state

    def write(self, command: Command) -> Vector:
        """Limit and send a command; unless the robot is `moving` its torques are not used.

        Returns:
            The torques really sent, after the limits. Shape (12,) [Nm], valid until the next call.
        """
        if not self.moving:
            return self.hold()
        limited = self._limiter.apply(command.torque, self._parts.motion)
        if not limited.finite:
            self._report(Dtc.CMD_NONFINITE, "the controller asked for a torque that is not finite")
            return self._commands.send_prepared_hold(self.state.cycle)
        if limited.clamped:
            cycles = self._limiter.saturated
            self._report(Dtc.TORQUE_SATURATED, "the limiter cuts the torque", cycles > SATURATED_CYCLES, cycles)
        self._step = command.step
        if command.outside:
            self._report(Dtc.GUIDE_OUTSIDE, "a joint is outside the virtual guide")
        self._commands.drive(self._limiter.last, command.vibration)
        return self._send_command()

    def hold(self) -> Vector:
        """Send HOLD; drives being enabled for a start get the next step of their state machine instead."""
        self._commands.hold()
        state, control = self.state, self._commands.control
        if self._lowered:
            control[[node in self._lowered for node in _NODES]] = Controlword.DISABLE_VOLTAGE
        if self._start_wanted and state.supervisor in (_S.LOWER, _S.FAULT):
            # The operator acknowledged: clear the drives that have a fault, the others go on holding.
            control[state.drive_state == DriveState.FAULT] = Controlword.FAULT_RESET
        elif self._start_wanted and state.supervisor in (_S.READY, _S.HOLD):
            control[:] = [controlword_towards_operation(int(s)) for s in state.drive_state.tolist()]
            # What the drive holds with now, so that nothing sags between its hold and the controller's first torque.
            self._follow_drives()
            self._commands.torque[:] = self._limiter.last
        else:
            self._enabling = False
        return self._send_command()

    def _follow_drives(self) -> None:
        """Command what the drives exert by themselves, within all limits from the second cycle on."""
        if self._enabling:
            self._limiter.apply(self.state.torque, self._parts.motion)
        else:
            self._limiter.restart(self.state.torque)
            self._enabling = True

    def fail(self, error: Exception) -> Vector:
        """The controller, or what was done with its command, raised: HOLD in this same cycle."""
        self._report(Dtc.CONTROLLER_ERROR, f"the controller raised {type(error).__name__}: {error}")
        return self._commands.send_prepared_hold(self.state.cycle)

    def report(self, dtc: Dtc, text: str, *, confirmed: bool = True, value: float = 0.0) -> None:
        """The loop noticed a fault of timing at the start of a cycle; judged in its `read`."""
        self._report(dtc, text, confirmed, value, cycle=self.state.cycle + 1)
        if dtc is Dtc.CYCLE_GAP and confirmed:
            self._transceiver.discard()

    def stop(self, cycles: int = 10) -> None:
        """HOLD, and stay long enough for every drive to have followed. Call at the end, before closing the bus."""
        self._ending, self._steady = True, False
        patience, deadline = self.patience, time.monotonic() + STOP_PATIENCE
        for _ in range(cycles):
            self.patience = max(0.0, min(patience, deadline - time.monotonic()))
            self.read()
            self.hold()
        self.patience = patience

    @property
    def bus(self) -> Bus:
        """What carries the frames."""
        return self._transceiver.bus

    @bus.setter
    def bus(self, bus: Bus) -> None:
        self._transceiver.bus = bus

    @property
    def tap(self) -> FrameTap | None:
        """Sees every frame."""
        return self._transceiver.tap

    @tap.setter
    def tap(self, tap: FrameTap | None) -> None:
        self._transceiver.tap = tap

    @property
    def crc_errors(self) -> int:
        """Frames refused for their CRC so far."""
        return self._image.crc_errors + self._heartbeats.image.crc_errors

    @property
    def silent(self) -> bool:
        """No node has ever answered a SYNC."""
        return bool((self._image.age >= NEVER).all())

    def missing(self) -> list[str]:
        """Nodes that keep the robot out of READY: not heard in time or not trusted yet, no status, another DBC. For people."""
        names = self._judgement.missing() | self._heartbeats.missing()
        return [node.name for node in self.network.nodes if node.name in names]

    def _send_command(self) -> Vector:
        state = self.state
        sent = self._commands.send(state.cycle)
        if state.cycle % self._status.cycles == 0:
            worst_one = number_of(self._memory.bits)
            self._status.send(state.supervisor, state.assistance_factor, self._header[6], worst_one, self._step)
            if self._heartbeats.overdue(state.cycle):
                self._steady = False
        return sent

    # -- judging -----------------------------------------------------------------------------------------------------

    def _accept_foreign(self, places: Sequence[int]) -> None:
        """Frames that are no cyclic message to the HAL."""
        in_row = isinstance(places, range)
        frames = self._transceiver.scratch[slice(places[0], places[-1] + 1) if in_row else list(places)]
        unknown = self._heartbeats.accept(frames, self.state.cycle, self.state.vibration)
        if unknown:
            self._transceiver.foreign(frames[unknown])
        if not self._heartbeats.quiet:
            self._steady = False

    def _report(
        self, dtc: Dtc, text: str, confirmed: bool = True, value: float = 0.0, cycle: int | None = None
    ) -> None:
        """Told at once, judged in the next `read`."""
        cycle = self.state.cycle if cycle is None else cycle
        self._memory.raise_dtc(cycle, dtc, "HAL", value=value, confirmed=confirmed, text=text)
        self._reports.append((dtc, confirmed, value, text))
        self._steady = False

    def _judge(self) -> None:
        """Everything that is wrong in this cycle, and what the supervisor makes of it."""
        state, memory, cycle = self.state, self._memory, self.state.cycle
        judgement, pendant = self._judgement, self._pendant
        judgement.judge(cycle, memory, self._plausibility.swing)
        state.joints_valid = judgement.joints_valid
        self._heartbeats.judge(cycle, memory)
        self._transceiver.judge(cycle, memory)
        for f in self._plausibility.findings:
            memory.raise_dtc(cycle, f.dtc, f.node, value=f.value, confirmed=f.confirmed, text=f.text)
        for dtc, confirmed, value, text in self._reports:
            memory.raise_dtc(cycle, dtc, "HAL", value=value, confirmed=confirmed, text=text)
        self._reports.clear()
        nodes_well = judgement.nodes_well and self._heartbeats.known
        self._judge_drives(nodes_well)
        if self._barred:
            memory.raise_dtc(cycle, Dtc.HAL_DUPLICATE, "HAL", text="another HAL was there first: end one, start again")
        pendant.hear(judgement.trusts(pendant.row))
        memory.close_cycle(cycle)
        self._barred |= Dtc.HAL_DUPLICATE in memory.confirmed and state.supervisor in (_S.OFF, _S.READY)
        self._judge_start()
        self.conditions = Conditions(
            diagnostics=memory.confirmed,
            nodes_well=nodes_well,
            drives_enabled=state.drive_state.tobytes() == _ENABLED,
            dead_man=pendant.dead_man,
            stop_requested=pendant.stop_requested or self._ending,
            start_wanted=self._start_wanted > 0,
            step_finished=self._step is None or self._step != self._finish[0] or cycle >= self._finish[1],
        )
        before = state.supervisor
        after, reasons = next_state(before, self.conditions)
        if after is not before:
            self._enter(before, after, reasons)
        self._lead_assistance()
        header = self._header
        header[3], header[10] = state.assistance_factor, memory.bits
        header[8] = self.crc_errors
        self._steady = (
            after is before
            and judgement.settled
            and self._heartbeats.quiet
            and not (memory.active or self._start_wanted or self._leading or after is _S.FINISH_STEP or self._ending)
        )

    def _judge_drives(self, nodes_well: bool) -> None:
        state, memory = self.state, self._memory
        said = self._parts.drive_side.tobytes()
        if said != self._drives_judged:
            self._drives_judged = said
            self._limiter.derate(self.robot.torque_limit(state.temperature))
            self._commands.limit[:] = self._limiter.limit
        self._judge_derating()
        if state.drive_state.tobytes() == _ENABLED:
            return
        for node, drive in zip(_NODES, state.drive_state.tolist(), strict=True):
            if drive in _FAULTY:
                # A drive that said why is judged by that.
                if node not in self._heartbeats.emergencies and (nodes_well or state.supervisor is not _S.OFF):
                    memory.raise_dtc(state.cycle, Dtc.DRIVE_FAULT, node, value=drive)
            elif drive != DriveState.OPERATION_ENABLED and self.moving:
                memory.raise_dtc(state.cycle, Dtc.DRIVE_STATE, node, value=drive)

    def _judge_derating(self) -> None:
        limit, full = self._limiter.limit, self.robot.torque_max
        if limit.tobytes() == full.tobytes():
            return
        share = (limit / full).tolist()
        for place, (node, mine, twins) in enumerate(zip(_NODES, share, share[len(share) // 2 :] + share, strict=False)):
            if mine < 1.0:
                text = f"{node}: its torque limit is {limit[place]:.0f} of {full[place]:.0f} Nm because it is hot"
                confirmed = mine < self.robot.thresholds.derated_imbalance * twins
                self._memory.raise_dtc(
                    self.state.cycle, Dtc.DERATED, node, value=limit[place], confirmed=confirmed, text=text
                )

    def _judge_start(self) -> None:
        """From START until the drives are enabled, or the operator or a diagnostic ends the attempt."""
        state, pendant = self.state, self._pendant
        if pendant.started and state.supervisor is not _S.ACTIVE:
            faulty = {node for node, drive in zip(_NODES, state.drive_state.tolist(), strict=True) if drive in _FAULTY}
            self._heartbeats.acknowledge(faulty)
            self._transceiver.acknowledge()
            self._start_wanted = ENABLE_CYCLES
        elif self._start_wanted:
            self._start_wanted -= 1
            hindered = state.supervisor in (_S.READY, _S.HOLD) and worst(self._memory.confirmed) is not Reaction.INFO
            if hindered or not pendant.dead_man or pendant.stop_requested:
                self._start_wanted = 0
            elif not self._start_wanted:
                text = f"the drives were not enabled within {ENABLE_CYCLES} cycles"
                self.events.append(Event(state.cycle, "START_FAILED", text, "error"))
                self.reason = text

    def _enter(self, before: SupervisorState, after: SupervisorState, reasons: frozenset[Dtc]) -> None:
        state, memory = self.state, self._memory
        state.supervisor = after
        self.moving = after in MOVING
        self._commands.announce(after)
        self._header[2] = after
        if Dtc.OPERATOR_STOP in reasons:
            text = "the program is ending" if self._ending else _WORDS[self._pendant.stop_requested]
            memory.raise_dtc(state.cycle, Dtc.OPERATOR_STOP, "PENDANT", text=text)
        if reasons:
            self.reason = memory.text_of(reasons) or self.reason
        if after is _S.ACTIVE:
            self._start_wanted = 0
            if before not in MOVING and not self._enabling:
                self._limiter.restart(state.torque)
        if after is _S.FINISH_STEP:
            self._finish = self._step, state.cycle + FINISH_STEP_CYCLES
        self._leading = self.moving and before in MOVING
        severity = "error" if after is _S.FAULT else "info"
        text = f"{before.name} -> {after.name}" + (f": {self.reason}" if reasons else "")
        self.events.append(Event(state.cycle, after.name, text, severity, value=after))

    def _lead_assistance(self) -> None:
        """The operator's assistance factor, and what FULL_ASSIST makes of it; joints to be let down."""
        state, wanted = self.state, self._pendant.assistance_factor
        if wanted is not None:
            self._assistance_factor = wanted
        led = state.supervisor in (_S.FULL_ASSIST, _S.FINISH_STEP)
        target = 1.0 if led else self._assistance_factor
        if self._leading:
            step, way = PERIOD / self.robot.thresholds.full_assist_ramp, target - state.assistance_factor
            state.assistance_factor += max(-step, min(step, way))
            self._leading = state.assistance_factor != target
        elif not led:
            state.assistance_factor = target
        if state.supervisor in (_S.LOWER, _S.FAULT):
            lower = frozenset(dtc for dtc in self._memory.confirmed if dtc.reaction is Reaction.LOWER)
            self._lowered.update(node for node in self._memory.nodes_of(lower) if node in _NODES)
        else:
            self._lowered.clear()


#: What the operator did, by whether it was a request.
_WORDS = ("the dead-man was released or the pendant is lost", "the operator asked to stop")
