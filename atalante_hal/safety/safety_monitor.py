"""Safety monitor: what is wrong in a cycle, which state the robot is in, and what follows for its drives and the assistance.

    process image, heartbeats, transceiver, plausibility, loop, controller -> fault memory -> supervisor -> state

The HAL moves the data of every cycle; this judges it. A perfect cycle of a robot that goes on as it did is not judged: nothing
can have changed.
"""

from __future__ import annotations

import numpy as np

from atalante_dbc import Network
from atalante_hal.commands import Commands
from atalante_hal.pendant import Pendant
from atalante_hal.record import Record
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Reaction, worst
from atalante_hal.safety.events import Event
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.heartbeats import Heartbeats
from atalante_hal.safety.limiter import Limiter
from atalante_hal.safety.message_monitor import MessageMonitor
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.start import refusal
from atalante_hal.safety.state_machine import MOVING, Conditions, next_state
from atalante_hal.transceiver import Transceiver
from atalante_hal.types import State, SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import ReceiveImage

#: Cycles within which every drive must have followed to OPERATION ENABLED.
ENABLE_CYCLES = 200
#: Longest time FINISH_STEP goes on [cycles]: more than a step.
FINISH_STEP_CYCLES = 2000

#: How `SafetyMonitor.reason` begins after a START that was refused, until the state changes.
REFUSED = "START refused: "

#: DBC names of the drives, in joint order.
DRIVE_NODES = tuple(joint.upper() for joint in JOINTS)
_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()
_FAULTY = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
_S = SupervisorState
#: States that START leads out of; in the others a press acknowledges and is over.
_STARTABLE = (_S.READY, _S.FULL_ASSIST, _S.HOLD, _S.LOWER, _S.FAULT)


class SafetyMonitor:
    """The judge of one HAL.

    Attributes:
        reason: why the robot is in the state it is in, one sentence.
        moving: the controller's torques are used.
        step: of the controller, by its own count; None: it takes no steps.
        start_wanted: cycles left for a START to change the state; 0: none was pressed since the last change.
        enabling: drives are being enabled, and torque is sent to those that are.
        lowered: drives that cannot hold.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        period: float,
        parts: Record,
        state: State,
        image: ReceiveImage,
        plausibility: Plausibility,
        transceiver: Transceiver,
        limiter: Limiter,
        commands: Commands,
    ) -> None:
        """Begin in OFF.

        Args:
            period: of the cycle [s].
            state: the HAL's, whose supervisor, assistance factor and validity are written here.
        """
        self._robot, self._period, self._parts, self._state, self._image = robot, period, parts, state, image
        self._plausibility, self._transceiver = plausibility, transceiver
        self._limiter, self._commands = limiter, commands
        self._message_monitor = MessageMonitor(network, image)
        self._heartbeats = Heartbeats(network, robot.thresholds)
        self._pendant = Pendant(image)
        state.valid, state.age = self._message_monitor.valid, image.age
        self.memory = FaultMemory()
        self.conditions = Conditions()
        self.reason = "nothing has happened yet"
        self.moving = False
        self.step: int | None = None
        self.start_wanted = 0
        self.enabling = False
        self.lowered: set[str] = set()
        self._steady = False  # a perfect cycle would change nothing
        #: What loop and controller did wrong since the last `judge`: code, whether confirmed, value, sentence.
        self._reports: list[tuple[Dtc, bool, float, str]] = []
        self._ending = False
        self._barred = False  # another HAL was heard before this one moved anything
        self._assistance_factor = state.assistance_factor  # the operator's
        self._leading = False  # the assistance factor is on its way to 1 or back
        self._finish: tuple[int | None, int] = None, 0  # step in which FINISH_STEP began, last cycle it may go on
        self._drives_judged = b""  # what the drives said when they were judged last

    def judge(self) -> None:
        """Judge the cycle whose frames were accepted and checked for plausibility, unless nothing can have changed."""
        pendant = self._pendant
        if not (
            self._steady
            and self._image.all_fresh
            and not self._plausibility.findings
            and self._transceiver.quiet
            and pendant.signals.tobytes() == pendant.heard
            and self._parts.drive_side.tobytes() == self._drives_judged
        ):
            self._judge()

    def accept(self, frames: Frames) -> None:
        """Frames that are no cyclic message to the HAL: status, emergencies, and what nobody may send. Shape (n,)."""
        unknown = self._heartbeats.accept(frames, self._state.cycle, self._state.vibration)
        if unknown:
            self._transceiver.foreign(frames[unknown])
        if not self._heartbeats.quiet:
            self._steady = False

    def report(self, dtc: Dtc, text: str, confirmed: bool = True, value: float = 0.0, cycle: int | None = None) -> None:
        """What loop or controller did wrong: told at once, judged in the next cycle. `cycle`: it happened in, default: this."""
        cycle = self._state.cycle if cycle is None else cycle
        self.memory.raise_dtc(cycle, dtc, "HAL", value=value, confirmed=confirmed, text=text)
        self._reports.append((dtc, confirmed, value, text))
        self._steady = False

    def end(self) -> None:
        """The program ends: HOLD from the next cycle on."""
        self._ending, self._steady = True, False

    def look_for_heartbeats(self) -> None:
        """See whether a status is late: asked now and then, because nothing comes that would say so."""
        if self._heartbeats.overdue(self._state.cycle):
            self._steady = False

    @property
    def crc_errors(self) -> int:
        """Frames refused for their CRC so far."""
        return self._image.crc_errors + self._heartbeats.image.crc_errors

    def missing(self) -> set[str]:
        """Nodes that keep the robot out of READY: not heard in time or not trusted yet, no status, another DBC."""
        return self._message_monitor.missing() | self._heartbeats.missing()

    def _judge(self) -> None:
        """Everything that is wrong in this cycle, and what the supervisor makes of it."""
        state, memory, cycle = self._state, self.memory, self._state.cycle
        message_monitor, pendant = self._message_monitor, self._pendant
        message_monitor.judge(cycle, memory, self._plausibility.swing)
        state.joints_valid = message_monitor.joints_valid
        self._heartbeats.judge(cycle, memory)
        for node in self._heartbeats.booted:
            self._plausibility.reference(node)
        self._heartbeats.booted.clear()
        self._transceiver.judge(cycle, memory)
        for f in self._plausibility.findings:
            memory.raise_dtc(cycle, f.dtc, f.node, value=f.value, confirmed=f.confirmed, text=f.text)
        for dtc, confirmed, value, text in self._reports:
            memory.raise_dtc(cycle, dtc, "HAL", value=value, confirmed=confirmed, text=text)
        self._reports.clear()
        nodes_well = message_monitor.nodes_well and self._heartbeats.known
        self._judge_drives(nodes_well)
        if self._barred:
            memory.raise_dtc(cycle, Dtc.HAL_DUPLICATE, "HAL", text="another HAL was there first: end one, start again")
        row = pendant.row
        pendant.hear(message_monitor.trusts(row), qualifying=message_monitor.hears(row), beside=self._image.beside(row))
        memory.close_cycle(cycle)
        self._barred |= Dtc.HAL_DUPLICATE in memory.confirmed and state.supervisor in (_S.OFF, _S.READY)
        self._judge_start(nodes_well)
        self.conditions = Conditions(
            diagnostics=memory.confirmed,
            nodes_well=nodes_well,
            drives_enabled=state.drive_state.tobytes() == _ENABLED,
            dead_man=pendant.dead_man,
            stop_requested=pendant.stop_requested or self._ending,
            start_wanted=self.start_wanted > 0,
            step_finished=self.step is None or self.step != self._finish[0] or cycle >= self._finish[1],
        )
        before = state.supervisor
        after, reasons = next_state(before, self.conditions)
        if after is not before:
            self._enter(before, after, reasons)
        elif after is _S.OFF and reasons:
            self.reason = memory.text_of(reasons)
        self._lead_assistance()
        self._let_down()
        header = self._parts.header
        header[3], header[10] = state.assistance_factor, memory.bits
        header[8] = self.crc_errors
        self._steady = (
            after is before
            and message_monitor.settled
            and self._heartbeats.quiet
            and not (memory.active or self.start_wanted or self._leading or after is _S.FINISH_STEP or self._ending)
        )

    def _judge_drives(self, nodes_well: bool) -> None:
        state, memory = self._state, self.memory
        said = self._parts.drive_side.tobytes()
        if said != self._drives_judged:
            self._drives_judged = said
            self._limiter.derate(self._robot.torque_limit(state.temperature))
            self._commands.limit[:] = self._limiter.limit
        self._judge_derating()
        if state.drive_state.tobytes() == _ENABLED:
            return
        for node, drive in zip(DRIVE_NODES, state.drive_state.tolist(), strict=True):
            if drive in _FAULTY:
                # The emergency message of a drive decides about its reaction.
                explained = node in self._heartbeats.emergencies or node in self._heartbeats.cleared
                if not explained and (nodes_well or state.supervisor is not _S.OFF):
                    memory.raise_dtc(state.cycle, Dtc.DRIVE_FAULT, node, value=drive)
            elif drive != DriveState.OPERATION_ENABLED and self.moving:
                memory.raise_dtc(state.cycle, Dtc.DRIVE_STATE, node, value=drive)

    def _judge_derating(self) -> None:
        limit, full = self._limiter.limit, self._robot.torque_max
        if limit.tobytes() == full.tobytes():
            return
        share = (limit / full).tolist()
        for place, (node, mine, twins) in enumerate(
            zip(DRIVE_NODES, share, share[len(share) // 2 :] + share, strict=False)
        ):
            if mine < 1.0:
                text = f"{node}: its torque limit is {limit[place]:.0f} of {full[place]:.0f} Nm because it is hot"
                confirmed = mine < self._robot.thresholds.derated_imbalance * twins
                self.memory.raise_dtc(
                    self._state.cycle, Dtc.DERATED, node, value=limit[place], confirmed=confirmed, text=text
                )

    def _judge_start(self, nodes_well: bool) -> None:
        """From START until the supervisor moves, the drives take too long, or the start is refused."""
        state, pendant = self._state, self._pendant
        if pendant.started and state.supervisor is not _S.ACTIVE and not self._ending:
            faulty = {
                node for node, drive in zip(DRIVE_NODES, state.drive_state.tolist(), strict=True) if drive in _FAULTY
            }
            self._heartbeats.acknowledge(faulty)
            self._transceiver.acknowledge()
            self.start_wanted = ENABLE_CYCLES if state.supervisor in _STARTABLE else 0
            if state.supervisor is _S.OFF and self.hindered:
                self._refuse_start(self.memory.text_of(self.memory.worst()))
        elif self.start_wanted:
            self.start_wanted -= 1
            if hindrance := self._hindrance(nodes_well):
                self._refuse_start(hindrance)
            elif not self.start_wanted:
                self._end_start("START_FAILED", f"the drives were not enabled within {ENABLE_CYCLES} cycles", "error")
        if self.start_wanted and state.supervisor in (_S.READY, _S.HOLD):
            implausible = refusal(self._robot, state.drive_state, state.torque)
            if implausible is not None:
                self._refuse_start(implausible)

    @property
    def hindered(self) -> bool:
        """A confirmed diagnostic keeps the drives from being enabled."""
        return worst(self.memory.confirmed) is not Reaction.INFO

    def _hindrance(self, nodes_well: bool) -> str:
        """Return why a start that was asked for cannot go on, one sentence; empty: it can."""
        pendant = self._pendant
        if self._ending:
            return "the program is ending"
        if pendant.stop_requested or not pendant.dead_man:
            return _WORDS[pendant.stop_requested]
        if self._state.supervisor in (_S.LOWER, _S.FAULT):
            return ""  # START acknowledges the cause, which may take some cycles to go
        if self.hindered:
            return self.memory.text_of(self.memory.worst())
        return "" if nodes_well else f"not heard or not trusted yet: {', '.join(sorted(self.missing()))}"

    def _refuse_start(self, why: str) -> None:
        self.start_wanted = 0
        self._end_start("START_REFUSED", REFUSED + why, "warning")

    def _end_start(self, code: str, text: str, severity: str) -> None:
        self.memory.events.append(Event(self._state.cycle, code, text, severity))
        self.reason = text

    def _enter(self, before: SupervisorState, after: SupervisorState, reasons: frozenset[Dtc]) -> None:
        state, memory = self._state, self.memory
        state.supervisor = after
        # One press, one move.
        self.start_wanted = 0
        self._pendant.forget_press()
        self.moving = after in MOVING
        self._commands.announce(after)
        self._parts.header[2] = after
        if Dtc.OPERATOR_STOP in reasons:
            text = "the program is ending" if self._ending else _WORDS[self._pendant.stop_requested]
            memory.raise_dtc(state.cycle, Dtc.OPERATOR_STOP, "PENDANT", text=text)
        if reasons:
            self.reason = memory.text_of(reasons) or self.reason
        if after is _S.ACTIVE and before not in MOVING and not self.enabling:
            self._limiter.restart(state.torque)
        if after is _S.FINISH_STEP:
            self._finish = self.step, state.cycle + FINISH_STEP_CYCLES
        self._leading = self.moving and before in MOVING
        severity = "error" if after is _S.FAULT else "info"
        text = f"{before.name} -> {after.name}" + (f": {self.reason}" if reasons else "")
        self.memory.events.append(Event(state.cycle, after.name, text, severity, value=after))

    def _lead_assistance(self) -> None:
        """The operator's assistance factor, and what FULL_ASSIST makes of it."""
        state, wanted = self._state, self._pendant.assistance_factor
        if wanted is not None:
            self._assistance_factor = wanted
        led = state.supervisor in (_S.FULL_ASSIST, _S.FINISH_STEP)
        target = 1.0 if led else self._assistance_factor
        if self._leading:
            step, way = self._period / self._robot.thresholds.full_assist_ramp, target - state.assistance_factor
            state.assistance_factor += max(-step, min(step, way))
            self._leading = state.assistance_factor != target
        elif not led:
            state.assistance_factor = target

    def _let_down(self) -> None:
        """Joints whose drives cannot hold, while LOWER or FAULT lasts."""
        if self._state.supervisor in (_S.LOWER, _S.FAULT):
            lower = frozenset(dtc for dtc in self.memory.confirmed if dtc.reaction is Reaction.LOWER)
            self.lowered.update(node for node in self.memory.nodes_of(lower) if node in DRIVE_NODES)
        else:
            self.lowered.clear()


#: What the operator did, by whether it was a request.
_WORDS = ("the dead-man was released or the pendant is lost", "the operator asked to stop")
