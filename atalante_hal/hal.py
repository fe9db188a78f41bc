"""The hardware abstraction layer: `read()` a state, `write()` a command, once a cycle each.

    bus -> process image -> E2E + plausibility -> state -> safety monitor -> [controller] -> limiter -> process image -> bus

The emulator and the robot differ in the bus handed to the constructor, in nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.commands import Commands, StatusReport
from atalante_hal.record import Record
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, number_of
from atalante_hal.safety.limiter import Limiter
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.safety_monitor import DRIVE_NODES, SafetyMonitor
from atalante_hal.safety.start import powered
from atalante_hal.safety.state_machine import Conditions
from atalante_hal.transceiver import FrameTap, Transceiver
from atalante_hal.types import Command, State, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState, controlword_towards_operation
from atalante_hal.wire.codec import Vector
from atalante_hal.wire.process_image import NEVER, ReceiveImage

PERIOD = 1e-3  # s, the SYNC period
#: Cycles in a row with a torque the limiter cuts, after which the controller is helped.
SATURATED_CYCLES = 200
#: Longest wait for answers while the robot is put into HOLD at the end [s].
STOP_PATIENCE = 1.0

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
        tap: sees every frame sent and received, for a CAN log.

    Raises:
        ValueError: the assistance factor is not between 0 and 1.
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
        self._build_images(controller_fields, assistance_factor)
        self._transceiver = Transceiver(
            network, "HAL", bus, tap, cyclic=len(self.messages), surplus=robot.thresholds.surplus_frames
        )
        self._limiter = Limiter(robot, PERIOD)
        self.state.torque_sent = self._limiter.last
        self._commands = Commands(network, self._transceiver, self._parts, self._limiter.limit)
        self._status = StatusReport(network, self._transceiver, robot.hash32, gait_hash)
        self._safety_monitor = SafetyMonitor(
            network,
            robot,
            PERIOD,
            self._parts,
            self.state,
            self._image,
            self._plausibility,
            self._transceiver,
            self._limiter,
            self._commands,
        )
        #: What went wrong or changed, once, when it began.
        self.events = self._safety_monitor.memory.events

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
        self.state = parts.state(assistance_factor, len(fast))
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
            in_row = isinstance(foreign, range)
            places = slice(foreign[0], foreign[-1] + 1) if in_row else list(foreign)
            self._safety_monitor.accept(transceiver.scratch[places])
        self._plausibility.check()
        parts = self._parts
        np.multiply(parts.motor_side, self._to_joint, parts.joint_side)
        self._safety_monitor.judge()
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
        safety_monitor = self._safety_monitor
        if not safety_monitor.moving:
            return self.hold()
        limited = self._limiter.apply(command.torque, self._parts.motion)
        if not limited.finite:
            safety_monitor.report(Dtc.CMD_NONFINITE, "the controller asked for a torque that is not finite")
            return self._commands.send_prepared_hold(self.state.cycle)
        if limited.clamped:
            cycles = self._limiter.saturated
            safety_monitor.report(
                Dtc.TORQUE_SATURATED, "the limiter cuts the torque", cycles > SATURATED_CYCLES, cycles
            )
        safety_monitor.step = command.step
        if command.outside:
            safety_monitor.report(Dtc.GUIDE_OUTSIDE, "a joint is outside the virtual guide")
        self._commands.drive(self._limiter.last, command.vibration)
        return self._send_command()

    def hold(self) -> Vector:
        """Send HOLD; drives being enabled for a start get the next step of their state machine instead."""
        self._commands.hold()
        state, control, safety_monitor = self.state, self._commands.control, self._safety_monitor
        if safety_monitor.lowered:
            control[[node in safety_monitor.lowered for node in DRIVE_NODES]] = Controlword.DISABLE_VOLTAGE
        if safety_monitor.start_wanted and state.supervisor in (_S.LOWER, _S.FAULT):
            # The operator acknowledged: clear the drives that have a fault, the others go on holding.
            control[state.drive_state == DriveState.FAULT] = Controlword.FAULT_RESET
        elif safety_monitor.start_wanted and state.supervisor in (_S.READY, _S.HOLD) and not safety_monitor.hindered:
            control[:] = [controlword_towards_operation(int(s)) for s in state.drive_state.tolist()]
            # What the drive holds with now, so that nothing sags between its hold and the controller's first torque.
            self._follow_drives()
            self._commands.torque[:] = self._limiter.last
        else:
            safety_monitor.enabling = False
        return self._send_command()

    def _follow_drives(self) -> None:
        """Command what the drives hold with, within all limits from the second cycle on; a drive that is off makes no torque."""
        torque = np.where(powered(self.state.drive_state), self.state.torque, 0.0)
        if self._safety_monitor.enabling:
            self._limiter.apply(torque, self._parts.motion)
        else:
            self._limiter.restart(torque)
            self._safety_monitor.enabling = True

    def fail(self, error: Exception) -> Vector:
        """The controller, or what was done with its command, raised: HOLD in this same cycle."""
        self._safety_monitor.report(Dtc.CONTROLLER_ERROR, f"the controller raised {type(error).__name__}: {error}")
        return self._commands.send_prepared_hold(self.state.cycle)

    def report(self, dtc: Dtc, text: str, *, confirmed: bool = True, value: float = 0.0) -> None:
        """The loop noticed a fault of timing at the start of a cycle; judged in its `read`."""
        self._safety_monitor.report(dtc, text, confirmed, value, cycle=self.state.cycle + 1)
        if dtc is Dtc.CYCLE_GAP and confirmed:
            self._transceiver.discard()

    def end(self) -> None:
        """HOLD from the next cycle on, and no START any more. A signal handler may call it at any time."""
        self._safety_monitor.end()

    def stop(self, cycles: int = 10) -> None:
        """HOLD, and stay long enough for every drive to have followed. Call at the end, before closing the bus."""
        self.end()
        patience, deadline = self.patience, time.monotonic() + STOP_PATIENCE
        for _ in range(cycles):
            self.patience = max(0.0, min(patience, deadline - time.monotonic()))
            self.read()
            self.hold()
        self.patience = patience

    @property
    def moving(self) -> bool:
        """The controller's torques are used."""
        return self._safety_monitor.moving

    @property
    def reason(self) -> str:
        """Why the robot is in the state it is in, one sentence."""
        return self._safety_monitor.reason

    @property
    def conditions(self) -> Conditions:
        """What the supervisor judged last."""
        return self._safety_monitor.conditions

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
        return self._safety_monitor.crc_errors

    @property
    def silent(self) -> bool:
        """No node has ever answered a SYNC."""
        return bool((self._image.age >= NEVER).all())

    def missing(self) -> list[str]:
        """Nodes that keep the robot out of READY: not heard in time or not trusted yet, no status, another DBC. For people."""
        names = self._safety_monitor.missing()
        return [node.name for node in self.network.nodes if node.name in names]

    def _send_command(self) -> Vector:
        state, safety_monitor = self.state, self._safety_monitor
        sent = self._commands.send(state.cycle)
        if state.cycle % self._status.cycles == 0:
            worst_one, overruns = number_of(safety_monitor.memory.bits), self._header[6]
            self._status.send(state.supervisor, state.assistance_factor, overruns, worst_one, safety_monitor.step)
            safety_monitor.look_for_heartbeats()
        return sent
