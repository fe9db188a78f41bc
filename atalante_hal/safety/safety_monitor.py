"""Safety monitor: collects the faults of each cycle, runs the state machine, and sets torque limits and assistance factor.

    process image, heartbeats, bus faults, plausibility, loop, controller -> fault memory -> state machine -> verdict

The HAL transfers the data of each cycle and acts on the verdict. The safety monitor itself sends no frames. The
evaluation is skipped in a cycle without a fault if the pendant and the drives report the same values as before, because
then the result cannot change.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from atalante_dbc import Network
from atalante_hal.dbc_names import IMU_NODES, JOINT_MESSAGES, JOINT_NODES, TRUNK_NODES
from atalante_hal.leg_model import LegModel
from atalante_hal.pendant import Pendant
from atalante_hal.record import Record
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding, Reaction
from atalante_hal.safety.direction import DirectionProof
from atalante_hal.safety.events import Event
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.heartbeats import Heartbeats
from atalante_hal.safety.hold_stability import HoldStability, Measured
from atalante_hal.safety.limiter import Limiter
from atalante_hal.safety.message_monitor import GROUND_TOLERANCE, NO_TOLERANCE, MessageMonitor, Tolerance
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.plausibility.signals import rows_of
from atalante_hal.safety.start import (
    ENABLE_CYCLES,
    PROGRAM_ENDS,
    Refusal,
    StartRequest,
    entry_text,
    powered,
    refusal,
    stop_text,
)
from atalante_hal.safety.state_machine import MOVING, Conditions, next_state
from atalante_hal.safety.torque_motion import TorqueMotion
from atalante_hal.safety.torque_tracking import TorqueTracking
from atalante_hal.types import PERIOD, State, SupervisorState, Vector, read_only
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.e2e import SETTLED, Check, Qualification, qualify
from atalante_hal.wire.frame import Frames
from atalante_hal.wire.process_image import ReceiveImage

#: Maximum duration of FINISH_STEP [cycles].
#: A walking robot ends its current step, makes a stop step and shifts its weight back in less than `FINISH_STEP_CYCLES`.
FINISH_STEP_CYCLES = 6000

#: Longest time from the command QUICK_STOP to the report QUICK STOP ACTIVE of the drive [cycles].
#: After this time, the command counts as lost. The answer to a command takes two cycles, and may be late by four more cycles.
RECALL_CYCLES = 6

_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()
_FAULTY = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
#: Codes of an IMU whose values are rejected.
_REJECTED = frozenset({Dtc.IMU_INVALID, Dtc.IMU_SATURATED, Dtc.IMU_STUCK})
_S = SupervisorState
#: States in which START can change the state.
#: In OFF and FINISH_STEP, START only acknowledges faults. In ACTIVE, START has no effect.
_STARTABLE = (_S.READY, _S.FULL_ASSIST, _S.HOLD, _S.LOWER, _S.FAULT)


class Verdict(NamedTuple):
    """Result of evaluating one cycle. The HAL sets the drive commands and the record from it."""

    supervisor: SupervisorState  # state of the state machine
    assistance_factor: float  # Xi in [0, 1]
    torque_limit: Vector  # (12,) Nm, torque limit of each drive in this cycle; the array of the limiter, not a copy
    diagnostics: int  # bit set of the active diagnostics, see `diagnostics.dtcs_of`
    acknowledged: bool  # True if the operator pressed START in this cycle, which also acknowledges a bus-off


class SafetyMonitor:
    """Safety monitor of one HAL.

    Attributes:
        reason: reason for the current supervisor state, as one sentence for the operator.
        moving: True if the controller's torques are sent to the drives.
        step: number of the walking step, reported by the controller; None if the controller does not walk.
        walking: True while the robot walks on the ground, reported by the controller.
        start_cycles_left: number of cycles in which a pressed START can still change the state; 0 if no START is being
            processed.
        enabling: True while drives are being enabled. In this time, the limiter follows the torques that the drives report.
        recalled: cycle in which QUICK_STOP was last sent to a drive in OPERATION ENABLED.
        proof: direction test at a start, which checks that each motor turns its joint in the right direction. The state changes
            from READY or HOLD to ACTIVE only after this test.
        torque_tracking: comparison of the reported torques with the sent torques while the robot moves.
        torque_motion: comparison of the motion with the sent torques while the robot moves; None without a model of the legs.
        lowered: DBC names of the drives that cannot hold and are being lowered.
    """

    def __init__(
        self,
        network: Network,
        robot: Robot,
        image: ReceiveImage,
        state: State,
        record: Record,
        plausibility: Plausibility,
        limiter: Limiter,
    ) -> None:
        """Create the safety monitor in state OFF.

        Args:
            network: messages and nodes of the DBC.
            robot: limits and thresholds of the robot.
            image: process image of the fast messages.
            state: state of the HAL; supervisor state, assistance factor and message validity are written to it.
            record: record of the cycle, of which the arrays of `state` are read-only views.
            plausibility: plausibility checks, run by the HAL before `evaluate`.
            limiter: torque limiter; its torque limit is reduced when drives are hot.
        """
        self._robot, self._image, self._state, self._record = robot, image, state, record
        self._plausibility, self._limiter = plausibility, limiter
        self._message_monitor = MessageMonitor(network, image)
        self._heartbeats = Heartbeats(network, robot.thresholds)
        self._pendant = Pendant(image)
        state.valid, state.age = read_only(self._message_monitor.valid), read_only(image.age)
        self.memory = FaultMemory()
        self.conditions = Conditions()
        self.reason = "nothing has happened yet"
        self.moving = False
        self.step: int | None = None
        self.walking = False
        self.start_cycles_left = 0
        self.enabling = False
        self.recalled = -RECALL_CYCLES
        self.proof = DirectionProof(robot)
        self._proof_begun = False  # True if the direction test has begun in the current start
        self._stalled = 0  # during a start: number of cycles since any drive last changed its state
        self._states_at_start = b""  # during a start: drive states in the previous cycle
        self.lowered: set[str] = set()
        self._hold_stability = HoldStability()
        self._held = Measured(
            state.position,
            state.velocity,
            state.torque,
            state.drive_state,
            np.zeros(len(JOINTS)),
            plausibility.encoder_error,
        )
        self._joint_rows = np.array(rows_of(image.codec, JOINT_MESSAGES))
        self.torque_tracking = TorqueTracking(robot.breakaway)
        self.torque_motion: TorqueMotion | None = None
        #: DBC names of the drives that stay off until a start passes its direction test (attribute `proof`).
        #: 1. Drives with a wrong torque, drives that did not hold their joints, drives whose joints failed the direction test.
        #: 2. Drives that were off when START was pressed, if START was pressed in READY, or if no start had passed the test yet.
        #: A start enables the drives in `_kept_off` for the direction test. If the start fails, they are switched off again.
        self._kept_off: set[str] = set()
        self._tested = False  # True after a start has passed the direction test
        #: True if `evaluate` may skip the next cycle.
        #: A cycle is skipped only if all data are fresh, there is no fault, and the values of pendant and drives are unchanged.
        self._steady = False
        self._reports: list[Finding] = []  # faults that loop and controller reported since the last `evaluate`
        self._acknowledged = False  # True if START was pressed in this cycle
        #: Leaky bucket (error counter) of each drive, by DBC name. No entry means an empty bucket.
        #: The bucket fills while the drive is far weaker than the same drive of the other leg.
        self._weak: dict[str, Qualification] = {}
        self._ending = False
        self._duplicate_found = False  # True if another HAL was detected while this HAL was in OFF or READY
        self._assistance_factor = state.assistance_factor  # assistance factor set by the operator
        self._ramping = False  # True while the assistance factor ramps to 1 or back to the operator's value
        #: Number of the walking step in which FINISH_STEP began, and number of the cycle in which FINISH_STEP ends at the latest.
        self._finish: tuple[int | None, int] = None, 0
        self._drives_evaluated = b""  # drive states and temperatures of the last evaluation

    def follow_motion(self, legs: LegModel) -> None:
        """Begin to compare the motion of the joints with the sent torques.

        Args:
            legs: model of the legs with the patient.
        """
        self.torque_motion = TorqueMotion(self._robot, legs, self._state, self._limiter.last, self._joint_rows)

    def evaluate(self, bus_faults: Sequence[Finding] = ()) -> Verdict | None:
        """Evaluate this cycle, unless all inputs are unchanged. Call this method after the plausibility checks.

        Args:
            bus_faults: faults of the bus in this cycle.

        Returns:
            The verdict; None if all inputs are unchanged, so that the last verdict is still valid.
        """
        pendant, state = self._pendant, self._state
        found = self._check_joints()
        if (
            self._steady
            and self._image.all_fresh
            and not self._plausibility.findings
            and not bus_faults
            and not found
            and pendant.signals.tobytes() == pendant.evaluated
            and self._record.drive_side.tobytes() == self._drives_evaluated
        ):
            return None
        self._evaluate((*bus_faults, *found))
        limit, diagnostics = self._limiter.limit, self.memory.bits
        return Verdict(state.supervisor, state.assistance_factor, limit, diagnostics, self._acknowledged)

    def _check_joints(self) -> tuple[Finding, ...]:
        """Check the drive torques in the states `MOVING`, and the held joints in all other states. Return the faults.

        A drive with a wrong torque, or one that does not hold its joint, stays off until a START in which the test of the joint
        directions is passed.
        """
        state = self._state
        if self.moving:
            found = self.torque_tracking.check(self._limiter.last, self._limiter.limit, state.torque)
            if self.torque_motion is not None:
                found += self.torque_motion.check(self.proof.late)
        else:
            self._held.age[:] = state.age[self._joint_rows]
            found = self._hold_stability.check(self._held, self._limiter.limit)
        self._kept_off.update(finding.node for finding in found)
        return found

    def accept(self, frames: Frames) -> list[int]:
        """Process the status messages, emergencies and unknown frames of a cycle.

        Call this method before the plausibility checks of the cycle. They must know which nodes have restarted: an IMU may then
        report another heading.

        Args:
            frames: received frames of a cycle without the cyclic 1 ms messages, shape (n,).

        Returns:
            Indices in `frames` of the frames that the DBC does not define as messages to the HAL.
        """
        unknown = self._heartbeats.accept(frames, self._state.cycle, self._record.vibration)
        for node in self._heartbeats.booted:
            self._plausibility.reference(node)
        self._heartbeats.booted.clear()
        if not self._heartbeats.quiet:
            self._steady = False
        return unknown

    def accept_queued(self, frames: Frames) -> None:
        """Process the slow messages that arrived in a gap between cycles, and ignore a START that was pressed in the gap.

        Args:
            frames: slow messages of the nodes, shape (n,), in order of arrival.
        """
        self._pendant.forget_start()
        self.accept(frames[self._heartbeats.essential(frames)])

    def report(self, dtc: Dtc, text: str, confirmed: bool = True, value: float = 0.0, cycle: int | None = None) -> None:
        """Report a fault of the loop or the controller. The fault is logged immediately and evaluated in the next `evaluate`.

        Args:
            dtc: diagnostic trouble code.
            text: one sentence for the operator.
            confirmed: True if the reaction is due, False if the diagnostic is pending.
            value: measured value. Its quantity and unit depend on the code.
            cycle: cycle in which the fault occurred; default: the current cycle.
        """
        cycle = self._state.cycle if cycle is None else cycle
        finding = Finding(dtc, "HAL", value, confirmed, text)
        self.memory.raise_finding(cycle, finding)
        self._reports.append(finding)
        self._steady = False

    @property
    def ending(self) -> bool:
        """Return whether `end` was called."""
        return self._ending

    def end(self) -> None:
        """Request HOLD, starting with the next cycle, because the program is ending."""
        self._ending, self._steady = True, False

    def check_timeouts(self) -> None:
        """Request an evaluation of the next cycle if a status message has timed out or if event repeats must be logged.

        The fault memory counts equal events for some time (counting window). When this time is over, it logs their number. Call
        this method periodically, because cycles without a fault are not evaluated.
        """
        cycle = self._state.cycle
        if self._heartbeats.overdue(cycle) or self.memory.window_over(cycle):
            self._steady = False

    @property
    def crc_errors(self) -> int:
        """Return the number of frames rejected so far because of a wrong CRC."""
        return self._image.crc_errors + self._heartbeats.image.crc_errors

    def missing(self) -> set[str]:
        """Return the nodes that prevent READY.

        A node prevents READY if its messages are not trusted (for example after a timeout), if it has sent no status message, or
        if it uses a different DBC.
        """
        return self._message_monitor.missing() | self._heartbeats.missing()

    def _evaluate(self, findings: Sequence[Finding]) -> None:
        """Raise all diagnostics of this cycle, run the state machine, and apply the reactions."""
        state, memory, cycle = self._state, self.memory, self._state.cycle
        message_monitor, pendant = self._message_monitor, self._pendant
        message_monitor.evaluate(cycle, memory, self._tolerance())
        state.joints_valid = message_monitor.joints_valid
        self._heartbeats.evaluate(cycle, memory)
        for finding in (*findings, *self._plausibility.findings, *self._reports):
            memory.raise_finding(cycle, finding)
        self._reports.clear()
        nodes_ready = message_monitor.nodes_ready and self._heartbeats.all_reported
        self._check_drives(nodes_ready)
        if self._duplicate_found:
            memory.raise_dtc(
                cycle,
                Dtc.HAL_DUPLICATE,
                "HAL",
                text="another HAL sent on this bus: end the other one, then start this one again",
            )
        row = pendant.row
        pendant.evaluate(
            message_monitor.is_trusted(row),
            qualifying=message_monitor.in_time(row),
            new=bool(self._image.check[row] <= Check.SOME_LOST),
            further_frames=self._image.decode_further_frames(row),
            two_senders=message_monitor.may_have_two_senders(row),
        )
        operator_stops = pendant.stop_requested or not pendant.dead_man
        walk_end_requested = self.walking and operator_stops and not pendant.hold_requested
        memory.close_cycle(cycle)
        state.implausible_imus = self._plausibility.implausible_imus
        self._duplicate_found |= Dtc.HAL_DUPLICATE in memory.confirmed and state.supervisor in (_S.OFF, _S.READY)
        self._process_start(nodes_ready)
        self.conditions = Conditions(
            diagnostics=memory.confirmed,
            nodes_ready=nodes_ready,
            drives_enabled=self._all_enabled()
            and (state.supervisor is _S.FULL_ASSIST or (self._proof_begun and not self.proof.running)),
            dead_man=pendant.dead_man,
            stop_requested=(pendant.stop_requested and not walk_end_requested) or self._ending,
            start_wanted=self.start_cycles_left > 0,
            step_finished=self.step is None or self.step != self._finish[0] or cycle >= self._finish[1],
            walk_end_requested=walk_end_requested,
            walk_ends=self._walk_ends() if self.walking else frozenset(),
        )
        before = state.supervisor
        after, reasons = next_state(before, self.conditions)
        if after is not before:
            self._enter(before, after, reasons)
        elif reasons and (after is _S.OFF or Dtc.BUS_DOWN in reasons):
            # The supervisor state remains, but its reason changes, for example from "interface down" to "interface removed".
            self.reason = memory.text_of(reasons)
        self._update_assistance()
        self._update_lowered()
        self._steady = (
            after is before
            and message_monitor.settled
            and self._heartbeats.quiet
            and not (
                memory.active
                or self._weak
                or self.start_cycles_left
                or self._ramping
                or after is _S.FINISH_STEP
                or self._ending
            )
        )

    def _walk_ends(self) -> frozenset[Dtc]:
        """Return the confirmed codes with which a walking robot ends its walk on both feet (FINISH_STEP).

        If the values of each trunk IMU are rejected or implausible, the walking controller has only an estimate of the attitude,
        so the codes of these IMUs end the walk, too.
        """
        memory = self.memory
        ends = memory.walk_ends(JOINT_NODES)
        unusable = {*memory.nodes_of(_REJECTED), *(IMU_NODES[imu] for imu in self._state.implausible_imus)}
        return ends | _REJECTED | {Dtc.IMU_IMPLAUSIBLE} if unusable.issuperset(TRUNK_NODES) else ends

    def _tolerance(self) -> Tolerance:
        """Return in which legs a brief timeout is tolerated in this cycle.

        In a walk on the ground, timeouts of both legs are tolerated. Otherwise, timeouts are tolerated only in a swing leg while
        the other foot is on the ground.
        """
        if self.walking:
            return GROUND_TOLERANCE
        swing = self._plausibility.swing
        return NO_TOLERANCE if swing is None else Tolerance((swing,))

    def _check_drives(self, nodes_ready: bool) -> None:
        state, memory = self._state, self.memory
        drives = self._record.drive_side.tobytes()
        if drives != self._drives_evaluated:
            self._drives_evaluated = drives
            self._limiter.derate(self._robot.torque_limit(state.temperature))
        self._check_derating()
        if state.drive_state.tobytes() == _ENABLED:
            return
        for node, drive in zip(JOINT_NODES, state.drive_state.tolist(), strict=True):
            if drive in _FAULTY:
                # If a drive has sent an emergency, only the emergency determines the reaction.
                if not self._heartbeats.has_emergency(node) and (nodes_ready or state.supervisor is not _S.OFF):
                    memory.raise_dtc(state.cycle, Dtc.DRIVE_FAULT, node, value=drive)
            elif drive != DriveState.OPERATION_ENABLED and self.moving:
                memory.raise_dtc(state.cycle, Dtc.DRIVE_STATE, node, value=drive)

    def _check_derating(self) -> None:
        """Report each drive whose torque limit is reduced because of its temperature.

        A single high temperature is no reason to stop. The diagnostic is confirmed if a drive is far weaker than the same drive
        of the other leg in 16 cycles in a row, or in more than a fifth of the cycles.
        """
        limit, full = self._limiter.limit, self._robot.torque_max
        if limit.tobytes() == full.tobytes() and not self._weak:
            return
        share = (limit / full).tolist()
        for index, (node, mine, twins) in enumerate(
            zip(JOINT_NODES, share, share[len(share) // 2 :] + share, strict=False)
        ):
            weak = mine < self._robot.thresholds.derated_imbalance * twins
            bucket = qualify(self._weak.pop(node, SETTLED), good=not weak)
            if bucket is not SETTLED:
                self._weak[node] = bucket
            if mine < 1.0 or not bucket.trusted:
                text = f"{node}: its torque limit is {limit[index]:.0f} of {full[index]:.0f} Nm because it is hot"
                if not weak and not bucket.trusted:
                    text = f"{node}: its temperature changes between normal and hot"
                confirmed = not bucket.trusted
                self.memory.raise_dtc(
                    self._state.cycle, Dtc.DERATED, node, value=limit[index], confirmed=confirmed, text=text
                )

    def _process_start(self, nodes_ready: bool) -> None:
        """Process a START until the state changes, the start is refused, or `ENABLE_CYCLES` cycles have passed.

        A start that fails switches drives off again. If it began in READY, or if no start has passed the direction test yet,
        these are the drives that were off before the start, because their directions are not tested yet. If a later start in
        HOLD fails, these are only the drives in `_kept_off`, because the other drives have already moved the robot.

        Args:
            nodes_ready: True if every required node is trusted and has sent a status message.
        """
        state, pendant = self._state, self._pendant
        self._acknowledged = False
        if pendant.started and state.supervisor is not _S.ACTIVE and not self._ending:
            faulty = {
                node for node, drive in zip(JOINT_NODES, state.drive_state.tolist(), strict=True) if drive in _FAULTY
            }
            self._heartbeats.acknowledge(faulty)
            self._acknowledged = True
            if not self.start_cycles_left:  # do not restart the direction test if START is pressed again during a start
                self._proof_begun = False
                if state.supervisor is _S.READY or not self._tested:
                    # A drive that is off now has not been tested since the robot entered READY, or has never been tested.
                    # So if the start fails, each drive that was off before the start is switched off again.
                    on = powered(state.drive_state).tolist()
                    self._kept_off.update(node for node, is_on in zip(JOINT_NODES, on, strict=True) if not is_on)
            self.start_cycles_left = ENABLE_CYCLES if state.supervisor in _STARTABLE else 0
        elif self.start_cycles_left:
            self.start_cycles_left -= 1
        else:
            return
        states = state.drive_state.tobytes()
        self._stalled = 0 if self._acknowledged or states != self._states_at_start else self._stalled + 1
        self._states_at_start = states
        ended = self._prove_directions() or refusal(self._robot, self._start_request(nodes_ready))
        if ended:
            self._end_start(ended)

    def _all_enabled(self) -> bool:
        """Return whether all drives are in OPERATION ENABLED, and no recent QUICK_STOP can still change their state."""
        state = self._state
        return state.drive_state.tobytes() == _ENABLED and state.cycle - self.recalled >= RECALL_CYCLES

    def _prove_directions(self) -> Refusal | None:
        """Begin the direction tests as soon as all drives are enabled. Evaluate the tests in each cycle until all are complete.

        Returns:
            Refusal that ends the start if a joint failed; None if the start may continue.
        """
        state, proof = self._state, self.proof
        if not self._all_enabled() or not self.start_cycles_left or state.supervisor not in (_S.READY, _S.HOLD):
            self._proof_begun = proof.running = False
            return None
        self._stalled = 0
        if not self._proof_begun:
            # The direction test starts from the torques that the HAL sent last (`limiter.last`).
            # While `enabling` is True, the sent torques follow the reported torques. So wait until `enabling` is True.
            if not self.enabling:
                return None
            self._proof_begun = True
            proof.begin(state.position, self._limiter.last)
            if not proof.running:
                self._pass_test()
        elif proof.running:
            if failure := proof.evaluate(state.position, state.foot_force[..., 2]):
                self._kept_off.update(JOINT_NODES[joint] for joint in proof.failed)
                for joint in proof.failed:
                    finding = Finding(Dtc.TORQUE_DIRECTION, JOINT_NODES[joint], proof.mobility[joint], True, failure)
                    self.memory.raise_finding(state.cycle, finding)
                    self._reports.append(finding)
                return Refusal("START_FAILED", "error", failure)
            if not proof.running:
                self._pass_test()
                state.delay = proof.late
                self.memory.events.append(Event(state.cycle, "DIRECTIONS_PROVEN", proof.report()))
        return None

    def _pass_test(self) -> None:
        self._kept_off.clear()
        self._tested = True

    @property
    def start_prevented(self) -> bool:
        """Return whether a confirmed diagnostic prevents the drives from being enabled."""
        return bool(self.memory.worst())

    def _start_request(self, nodes_ready: bool) -> StartRequest:
        state, pendant = self._state, self._pendant
        return StartRequest(
            supervisor=state.supervisor,
            pressed=self._acknowledged,
            cycles_left=self.start_cycles_left,
            stalled=self._stalled,
            ending=self._ending,
            stop_requested=pendant.stop_requested,
            dead_man=pendant.dead_man,
            diagnostic=self.memory.text_of(self.memory.worst()),
            nodes_ready=nodes_ready,
            missing=self.missing(),
            drive_state=state.drive_state,
            torque=state.torque,
            velocity=state.velocity,
        )

    def _end_start(self, ended: Refusal) -> None:
        self.start_cycles_left = 0
        self.proof.running = False
        # Each START of the operator gets its own event; events of several STARTs within one second are not merged.
        self.memory.events.append(Event(self._state.cycle, ended.code, ended.text, ended.severity))
        self.reason = ended.text

    def _enter(self, before: SupervisorState, after: SupervisorState, reasons: frozenset[Dtc]) -> None:
        state, memory = self._state, self.memory
        state.supervisor = after
        # Remove the START request, because one START may change the state only once.
        self.start_cycles_left = 0
        self._pendant.clear_press()
        self.moving = after in MOVING
        if before in MOVING and not self.moving:
            self._hold_stability.restart()
            self.torque_tracking.restart()
            if self.torque_motion is not None:
                self.torque_motion.restart()
        self.walking = self.walking and self.moving
        if Dtc.OPERATOR_STOP in reasons:
            text = PROGRAM_ENDS if self._ending else stop_text(self._pendant.stop_requested)
            memory.raise_dtc(state.cycle, Dtc.OPERATOR_STOP, "PENDANT", text=text)
        if reasons:
            self.reason = memory.text_of(reasons) or self.reason
        elif before is not _S.FINISH_STEP:  # the HOLD after FINISH_STEP keeps the reason of FINISH_STEP
            self.reason = entry_text(after, self.missing(), self._pendant.stop_requested)
        if after is _S.ACTIVE and before not in MOVING:
            # The fault memory merges equal events within a second into one event. `log_repeats` ends all merging here.
            # So the reason for the next HOLD gets its own event, even if it equals the reason for the last HOLD.
            memory.log_repeats(state.cycle, final=True)
        if after is _S.ACTIVE and before not in MOVING and not self.enabling:
            self._limiter.restart(state.torque)
        if after is _S.FINISH_STEP:
            self._finish = self.step, state.cycle + FINISH_STEP_CYCLES
        self._ramping = self.moving and before in MOVING
        severity = "error" if after is _S.FAULT else "info"
        text = f"{before.name} -> {after.name}" + (f": {self.reason}" if reasons or after is _S.FINISH_STEP else "")
        self.memory.events.append(Event(state.cycle, after.name, text, severity, value=after))

    def _update_assistance(self) -> None:
        """Set the assistance factor to the operator's value, or ramp it to 1 in FULL_ASSIST and FINISH_STEP.

        When the robot returns to ACTIVE, ramp the factor back to the operator's value.
        """
        state, wanted = self._state, self._pendant.assistance_factor
        if wanted is not None:
            self._assistance_factor = wanted
        full = state.supervisor in (_S.FULL_ASSIST, _S.FINISH_STEP)
        target = 1.0 if full else self._assistance_factor
        if self._ramping:
            step, way = PERIOD / self._robot.thresholds.full_assist_ramp, target - state.assistance_factor
            state.assistance_factor += max(-step, min(step, way))
            self._ramping = state.assistance_factor != target
        elif not full:
            state.assistance_factor = target

    def _update_lowered(self) -> None:
        """Update `lowered`, the set of drives that are switched off so that their joints sink slowly.

        A drive belongs to `lowered` if it has a confirmed diagnostic that demands LOWER. In LOWER and FAULT, drives are only
        added. In all other states, `lowered` also contains the drives in `_kept_off`. A START enables the drives in `_kept_off`,
        too. If the START ends before the test of the joint directions is passed, these drives are switched off again.
        """
        lower = frozenset(dtc for dtc in self.memory.confirmed if dtc.reaction is Reaction.LOWER)
        off = {node for node in self.memory.nodes_of(lower) if node in JOINT_NODES}
        kept = self.lowered if self._state.supervisor in (_S.LOWER, _S.FAULT) else self._kept_off
        self.lowered = kept | off
