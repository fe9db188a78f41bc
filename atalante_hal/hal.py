"""Hardware abstraction layer: `read()` returns the state and `write()` sends a command, each once per cycle.

    bus -> process image -> E2E + plausibility -> state -> safety monitor -> [controller] -> limiter -> process image -> bus

The emulator and the robot differ only in the bus passed to the constructor.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Sequence
from copy import copy

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.commands import Commands, StatusReport
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.leg_model import LegModel
from atalante_hal.record import (
    ASSISTANCE_FACTOR,
    CRC_ERRORS,
    CYCLE,
    DIAGNOSTICS,
    DIAGNOSTICS_HIGH,
    DROPPED,
    FRAMES,
    OVERRUNS,
    SUPERVISOR,
    TIME,
    Record,
)
from atalante_hal.record_layout import split_bits
from atalante_hal.robot import JOINTS, MOTORS, Robot
from atalante_hal.safety.diagnostics import Dtc, number_of
from atalante_hal.safety.limiter import Limiter
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.safety_monitor import SafetyMonitor, Verdict
from atalante_hal.safety.start import powered, words_towards_operation
from atalante_hal.safety.state_machine import Conditions
from atalante_hal.transceiver import RECEIVE_BUDGET, FrameTap, Transceiver
from atalante_hal.types import PERIOD, Command, State, SupervisorState, Vector, read_only
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: TORQUE_SATURATED is confirmed after more than `SATURATED_CYCLES` consecutive cycles in which the limiter changes a torque.
SATURATED_CYCLES = 200
#: Largest number of consecutive controller exceptions that the HAL tolerates while the robot walks on the ground.
#: After a tolerated exception, the HAL sends the last torques again.
#: If more than `BRIDGED_ERRORS` consecutive cycles have an exception, CONTROLLER_LOST is confirmed, which leads to HOLD.
#: A drive, too, tolerates up to `BRIDGED_ERRORS` consecutive lost commands.
BRIDGED_ERRORS = 4
#: Longest total wait for the nodes' answers while `Hal.stop` puts the robot into HOLD [s].
STOP_PATIENCE = 1.0

#: Quantities of a drive that are used even if another value in the same frame, for example the position, is out of range.
_INDEPENDENT = ("DriveState", "Temperature", "Torque")

_S = SupervisorState


class Hal:
    """Interface between a controller and one robot, over one bus or several joined buses.

    Args:
        network: CAN network, as `atalante_dbc.load` returns it.
        robot: Joint limits and transmission.
        bus: Open bus. The caller owns it and closes it.
        patience: Longest wait for the nodes' answers to a SYNC [s]. On the wall clock it must be well below the period of 1 ms.
            In lock-step with another process it should be long, so that a run has the same result on a slow machine.
        assistance_factor: Assistance factor Xi in [0, 1], used until the pendant sets another factor.
        controller_fields: Name and length of each field that the controller records, see `types.Controller`.
        gait_hash: CRC-32 of the gait that the controller uses, sent in HAL_STATUS.
        tap: Receiver of a copy of every frame that is sent or received, for a CAN log; None if there is no log.
        legs: Model of the legs with the patient, for the comparison of the motion with the torques that were sent. None means no
            comparison.

    Raises:
        ValueError: If the assistance factor is not between 0 and 1.
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
        legs: LegModel | None = None,
    ) -> None:
        if not 0.0 <= assistance_factor <= 1.0:
            raise ValueError(f"assistance_factor must be between 0 and 1, got {assistance_factor}")
        self.network, self.robot, self.patience = network, robot, patience
        self._build_images(controller_fields, assistance_factor)
        self._transceiver = Transceiver(
            network, "HAL", bus, tap, cyclic=len(self.messages), surplus=robot.thresholds.surplus_frames
        )
        self._limiter = Limiter(robot, PERIOD)
        self._torque_sent = self._limiter.last.copy()
        self._state.torque_sent = read_only(self._torque_sent)
        self._commands = Commands(network, self._transceiver, self._parts, self._limiter.limit)
        self._errors = 0  # number of consecutive cycles in which the controller raised an exception
        self._status = StatusReport(network, self._transceiver, robot.hash32, gait_hash)
        self._safety_monitor = SafetyMonitor(
            network,
            robot,
            self._image,
            self._state,
            self._parts,
            self._plausibility,
            self._limiter,
        )
        if legs is not None:
            self._safety_monitor.follow_motion(legs)
        #: State of the last cycle, for the controller. It is a copy of `_state`, which the checks of the HAL use.
        #: So the checks do not change if a controller assigns to a field by mistake.
        self.state = copy(self._state)
        #: Log of events, such as new diagnostics and changes of the supervisor state.
        #: Repeats of a diagnostic within a second are logged as one event with a count.
        self.events = self._safety_monitor.memory.events

    # -- construction ------------------------------------------------------------------------------------------------

    def _build_images(self, controller_fields: Sequence[tuple[str, int]], assistance_factor: float) -> None:
        received = self.network.received_by("HAL")
        # The rows of the process image have the order in which the buses deliver the messages, because `accept` is then fast.
        fast = [m for bus in self.network.buses for m in received if m.bus == bus and m.cycle_ms == 1]
        #: Names of the messages, in the order of the elements of `State.valid` and `State.age`.
        self.messages = tuple(m.name for m in fast)
        parts = self._parts = Record(ReceiveImage(fast).codec, controller_fields)
        #: `record` has all values of this cycle in one contiguous vector. `layout` gives the name and the slice of each field.
        #: `controller_record` is the part of `record` with the fields of the controller.
        self.record, self.layout, self.controller_record = parts.values, parts.layout, parts.controller
        self._header = parts.header
        self._header[ASSISTANCE_FACTOR] = assistance_factor
        self._image = ReceiveImage(fast, parts.signals, independent=_INDEPENDENT)
        self._slow_ids = [m.frame_id for m in received if m.cycle_ms != 1]
        self._plausibility = Plausibility(self.robot, self._image, PERIOD)
        self._state = parts.state(assistance_factor, len(fast))
        per_turn = self.robot.polarity / self.robot.gear
        # On the bus, positions and velocities are motor-side values. Torques are joint-side values, so their factor is 1.
        self._to_joint = np.concatenate([per_turn, per_turn, np.ones(len(JOINTS))])

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Check that no other HAL is active on this bus.

        Call it before the first `read` on a bus that another HAL may use.

        Raises:
            HalDuplicate: If a message of another HAL was received.
        """
        self._transceiver.listen()

    def read(self) -> State:
        """Send SYNC, receive the nodes' answers, check them and return the state.

        A failing bus does not raise an exception here. It leads to HOLD, as any other fault does.

        Returns:
            State of this cycle: the same object every cycle, valid until the next `read`.
        """
        state, image, transceiver = self._state, self._image, self._transceiver
        state.cycle = cycle = state.cycle + 1
        state.time = cycle * PERIOD
        # Set before SYNC is sent, because a CAN log reads the cycle of each frame.
        self.state.cycle, self.state.time = cycle, state.time
        late = 0 if image.all_fresh else transceiver.receive()  # number of late answers to the previous SYNC
        self._commands.synchronise(cycle)
        count = transceiver.receive(late, image, self.patience)
        foreign = image.accept(transceiver.scratch, count, cycle & 0xFF)
        if foreign:
            in_row = isinstance(foreign, range)
            rows = slice(foreign[0], foreign[-1] + 1) if in_row else list(foreign)
            others = transceiver.scratch[rows]
            if unknown := self._safety_monitor.accept(others):
                transceiver.foreign(others[unknown])
        self._plausibility.check()
        parts = self._parts
        np.multiply(parts.motor_side, self._to_joint, parts.joint_side)
        verdict = self._safety_monitor.evaluate(() if transceiver.quiet else transceiver.faults())
        if verdict is not None:
            self._apply(verdict)
        self._torque_sent[:] = self._limiter.last
        header = self._header
        header[CYCLE], header[TIME] = cycle, state.time
        header[FRAMES] += count
        header[DROPPED] = transceiver.bus.dropped
        return self._published()

    def _published(self) -> State:
        """Copy the results of the safety monitor to the state for the controller, and return this state."""
        state, published = self._state, self.state
        published.supervisor, published.assistance_factor = state.supervisor, state.assistance_factor
        published.joints_valid, published.implausible_imus = state.joints_valid, state.implausible_imus
        published.delay = state.delay
        return published

    def _skip_old_answers(self) -> None:
        """After a gap between cycles, drop the queued answers to earlier SYNCs, and process the other queued frames.

        For example, an emergency is sent only once, so it must not be lost. Many frames may have arrived in the gap. Of the
        frames that are no messages to the HAL, only one of each identifier is processed, so that this takes at most a few cycles.
        """
        frames = self._transceiver.receive_queued([*self._image.frame_ids])
        slow = np.isin(frames["can_id"], self._slow_ids)
        self._safety_monitor.accept_queued(frames[slow])
        _, first = np.unique(frames["can_id"][~slow], return_index=True)
        self._transceiver.foreign(frames[~slow][first[:RECEIVE_BUDGET]])

    def _apply(self, verdict: Verdict) -> None:
        """Apply the result of the safety monitor in this cycle: set HalState, MaxTorque and the header of the record.

        Args:
            verdict: Result of the safety monitor in this cycle.
        """
        self._commands.announce(verdict.supervisor)
        self._commands.limit[:] = verdict.torque_limit
        if verdict.acknowledged:
            self._transceiver.acknowledge()
        header = self._header
        header[SUPERVISOR], header[ASSISTANCE_FACTOR] = verdict.supervisor, verdict.assistance_factor
        header[CRC_ERRORS] = self.crc_errors
        header[DIAGNOSTICS], header[DIAGNOSTICS_HIGH] = split_bits(verdict.diagnostics)

    def write(self, command: Command) -> Vector:
        """Limit a command and send it; send HOLD instead while `moving` is False.

        Args:
            command: Torques, shape (12,) [Nm at the joint], and vibration levels, shape (8,), of this cycle.

        Returns:
            Torques that were sent, after the limits. Shape (12,) [Nm], valid until the next call.

        Raises:
            ValueError: If the torques or the vibration levels have another shape.
            TypeError: If the step is neither an integer nor None.
        """
        safety_monitor = self._safety_monitor
        if not safety_monitor.moving:
            return self.hold()
        if (shape := np.shape(command.torque)) != (len(JOINTS),):
            raise ValueError(f"the torque must have shape ({len(JOINTS)},), got {shape}")
        if (shape := np.shape(command.vibration)) != (len(MOTORS),):
            raise ValueError(f"the vibration must have shape ({len(MOTORS)},), got {shape}")
        step = None if command.step is None else operator.index(command.step)
        limited = self._limiter.apply(command.torque, self._parts.motion)
        if not limited.finite:
            safety_monitor.report(Dtc.CMD_NONFINITE, "the commanded torque must be finite, got NaN or infinity")
            return self._commands.send_prepared_hold(self._state.cycle)
        if limited.clamped:
            cycles = self._limiter.saturated
            safety_monitor.report(
                Dtc.TORQUE_SATURATED, "the limiter cuts the torque", cycles > SATURATED_CYCLES, cycles
            )
        safety_monitor.step, safety_monitor.walking = step, command.walking
        if command.outside:
            safety_monitor.report(Dtc.GUIDE_OUTSIDE, Dtc.GUIDE_OUTSIDE.meaning, command.guide_left)
        if command.hand_over_exceeded:
            text = "a step started outside the hand-over box: the certificate of its guide does not apply to this step"
            safety_monitor.report(Dtc.GUIDE_OUTSIDE, text, False)
        if command.loop_late:
            text = "full assistance for the rest of this step: data or torques are later than its guide covers"
            safety_monitor.report(Dtc.GUIDE_OUTSIDE, text, False)
        self._commands.drive(self._limiter.last, command.vibration)
        sent = self._send_command()
        self._errors = 0  # counts consecutive exceptions; each statement above can raise one, so reset the count last
        return sent

    def hold(self) -> Vector:
        """Send HOLD. During a start, send the next CiA 402 controlword on the path to OPERATION ENABLED instead.

        A drive in `SafetyMonitor.lowered` is switched off instead, and its brake lets the joint sink slowly. If START is pressed
        to acknowledge faults, each drive in FAULT is reset.

        Returns:
            Torques that were sent, shape (12,) [Nm], valid until the next call.
        """
        self._commands.hold()
        self._errors = 0
        state, control, safety_monitor = self._state, self._commands.control, self._safety_monitor
        if safety_monitor.lowered:
            control[[node in safety_monitor.lowered for node in JOINT_NODES]] = Controlword.DISABLE_VOLTAGE
        if safety_monitor.start_cycles_left and (
            state.supervisor in (_S.LOWER, _S.FAULT) or (state.supervisor is _S.HOLD and safety_monitor.start_prevented)
        ):
            # The operator acknowledged the faults with START. So each drive in FAULT is reset; the other drives continue to hold.
            # In HOLD, too, each drive in FAULT must be reset: its active emergency prevents the start until the drive is reset.
            control[state.drive_state == DriveState.FAULT] = Controlword.FAULT_RESET
            safety_monitor.enabling = False
        elif (
            safety_monitor.start_cycles_left
            and state.supervisor in (_S.READY, _S.HOLD)
            and not safety_monitor.start_prevented
        ):
            control[:] = words_towards_operation(state.drive_state)
            if safety_monitor.proof.running:
                self._test_directions()
            else:
                self._follow_drives()
        else:
            safety_monitor.enabling = False
        if ((control == Controlword.QUICK_STOP) & (state.drive_state == DriveState.OPERATION_ENABLED)).any():
            safety_monitor.recalled = state.cycle
        return self._send_command()

    def _follow_drives(self) -> None:
        """Set the torque commands to the torques that the drives report, or to 0 while any drive is off.

        While any drive is off, the commands are 0: a drive that is off produces no torque, and a drive that holds its
        position ignores its command. As soon as all drives produce torque, the command of each drive is the torque that
        the drive reports. So no joint sags before the controller's first torque. In the first call of a start, and in every call
        while a drive is off, the reported torques are the start value of the rate limit, and only the torque limit applies to
        them. In all other calls, all limits of the limiter apply.
        """
        on = powered(self._state.drive_state)
        torque = np.where(on, self._state.torque, 0.0)
        if on.all() and self._safety_monitor.enabling:
            self._limiter.apply(torque, self._parts.motion)
        else:
            self._limiter.restart(torque)
            self._safety_monitor.enabling = True
        if on.all():
            self._commands.torque[:] = self._limiter.last

    def _test_directions(self) -> None:
        """Limit and send the torques with which the HAL tests the direction of each joint."""
        proof = self._safety_monitor.proof
        self._limiter.apply(proof.torque(self._state.position, self._state.velocity), self._parts.motion)
        proof.sent(self._limiter.last)
        self._commands.torque[:] = self._limiter.last

    def fail(self, error: Exception) -> Vector:
        """Report an exception of the controller or of `write`, and send HOLD in the same cycle.

        While the robot walks on the ground, up to `BRIDGED_ERRORS` consecutive exceptions are bridged with the last torques, as a
        drive bridges lost commands. The safety monitor then ends the walk, because HOLD within a step would make the robot fall.

        Args:
            error: Exception that `Controller.reset`, `Controller.update` or `write` raised.

        Returns:
            Torques that were sent, shape (12,) [Nm], valid until the next call.
        """
        safety_monitor = self._safety_monitor
        safety_monitor.report(Dtc.CONTROLLER_ERROR, f"the controller raised {type(error).__name__}: {error}")
        self._errors += 1
        if self._errors > BRIDGED_ERRORS:
            safety_monitor.report(Dtc.CONTROLLER_LOST, Dtc.CONTROLLER_LOST.meaning)
        elif safety_monitor.walking:
            self._limiter.apply(self._torque_sent, self._parts.motion)
            self._commands.torque[:] = self._limiter.last
            return self._send_command()
        return self._commands.send_prepared_hold(self._state.cycle)

    def report(self, dtc: Dtc, text: str, *, confirmed: bool = True, value: float = 0.0) -> None:
        """Report a timing fault that the loop found at the start of a cycle. The following `read` evaluates the fault.

        Args:
            dtc: Diagnostic to raise.
            text: One sentence for the event.
            confirmed: True if the fault is confirmed, False if it is only pending.
            value: Measured value, for the event.
        """
        self._safety_monitor.report(dtc, text, confirmed, value, cycle=self._state.cycle + 1)
        if dtc is Dtc.CYCLE_GAP and confirmed:
            self._skip_old_answers()

    def end(self) -> None:
        """Request HOLD, starting with the next cycle, and ignore every later START.

        A signal handler may call this method at any time.
        """
        self._safety_monitor.end()

    def stop(self, cycles: int = 10) -> None:
        """Send HOLD for some cycles, so that every drive has time to react.

        Call this method at the end of a run, before the bus is closed. It waits at most `STOP_PATIENCE` for the nodes'
        answers.

        Args:
            cycles: Number of cycles in which HOLD is sent.
        """
        self.end()
        patience, deadline = self.patience, time.monotonic() + STOP_PATIENCE
        for _ in range(cycles):
            self.patience = max(0.0, min(patience, deadline - time.monotonic()))
            self.read()
            self.hold()
        self.patience = patience
        self._safety_monitor.memory.log_repeats(self._state.cycle, final=True)

    @property
    def ending(self) -> bool:
        """Return whether `end` was called, so that the robot stays in HOLD."""
        return self._safety_monitor.ending

    @property
    def moving(self) -> bool:
        """Return whether the torques of the controller are sent to the drives."""
        return self._safety_monitor.moving

    @property
    def reason(self) -> str:
        """Return the reason for the current supervisor state, as one sentence."""
        return self._safety_monitor.reason

    @property
    def conditions(self) -> Conditions:
        """Return the conditions that the state machine evaluated last."""
        return self._safety_monitor.conditions

    @property
    def bus(self) -> Bus:
        """Return the bus on which the frames are sent and received."""
        return self._transceiver.bus

    @bus.setter
    def bus(self, bus: Bus) -> None:
        self._transceiver.bus = bus

    @property
    def tap(self) -> FrameTap | None:
        """Return the tap, which receives a copy of every frame; None if there is no tap."""
        return self._transceiver.tap

    @tap.setter
    def tap(self, tap: FrameTap | None) -> None:
        self._transceiver.tap = tap

    @property
    def crc_errors(self) -> int:
        """Return the number of frames rejected so far because of a wrong CRC."""
        return self._safety_monitor.crc_errors

    @property
    def silent(self) -> bool:
        """Return whether no node has answered a SYNC so far."""
        return bool((self._image.age >= NEVER).all())

    def missing(self) -> list[str]:
        """Return the names of the nodes for which the HAL still waits before the robot becomes READY.

        Such a node timed out, is not qualified yet, has sent no status, or uses another DBC.
        """
        names = self._safety_monitor.missing()
        return [node.name for node in self.network.nodes if node.name in names]

    def _send_command(self) -> Vector:
        state, safety_monitor = self._state, self._safety_monitor
        sent = self._commands.send(state.cycle)
        if state.cycle % self._status.cycles == 0:
            worst, overruns = number_of(safety_monitor.memory.bits), self._header[OVERRUNS]
            self._status.send(state.supervisor, state.assistance_factor, overruns, worst, safety_monitor.step)
            safety_monitor.check_timeouts()
        return sent
