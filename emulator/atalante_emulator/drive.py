"""The firmware of the twelve drives: CiA 402, command watchdog, limits, and what a drive does by itself when something is wrong.

One cycle is `sample` (what the state frames will say), then `command` (latch what the HAL wants), then `drive` (torques
for the next millisecond). The drive is the last line of safety, HAL or no HAL:

- no valid new command for `WATCHDOG` cycles, no SYNC for as many, two senders of one command, a supply that fails: latched
  local hold, QUICK STOP ACTIVE, its motor holding the position of its own encoder;
- too hot, over-current, encoder lost: it cannot hold. FAULT REACTION ACTIVE and then FAULT, power stage off, and the brake lets
  the joint down slowly. The same brake is on whenever a drive has no power: DISABLE_VOLTAGE is how a HAL lowers a joint.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_emulator import emergency
from atalante_emulator.body import PERIOD
from atalante_emulator.emergency import Emergency, Errors, Reaction, reaction_to
from atalante_emulator.encoder import Encoders
from atalante_emulator.motor import MotorParameters, Motors
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.wire.cia402 import AUTOMATIC, Controlword, DriveState, next_state

Vector = npt.NDArray[np.float64]

#: Cycles without a valid new command, or without SYNC, after which an enabled drive holds by itself.
WATCHDOG: Final = 5
#: Cycles between two looks at what is slow: heat, and whether a joint that was let down has come to rest.
SLOW_CYCLES: Final = 100
#: Node names, in the order of the drives.
NODES: Final = tuple(joint.upper() for joint in JOINTS)
_LEG: Final = len(LEG_JOINTS)
_POWERED: Final = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_FAULTY: Final = (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)


@dataclass(frozen=True)
class DriveParameters:
    """What the emulated drives are really like."""

    motor: MotorParameters = field(default_factory=MotorParameters)
    velocity_bandwidth: float = 80.0  # Hz, low-pass of the velocity estimate
    torque_noise: float = 0.05  # Nm rms, of the torque measurement
    trip_temperature: float = 120.0  # degC: the drive switches itself off
    cool_enough: float = 100.0  # degC: and may be switched on again
    supply: float = 48.0  # V
    hold_below: float = 40.0  # V: the drive holds with what is left
    off_below: float = 20.0  # V: the power stage works no more
    rest_speed: float = 0.05  # rad/s: a joint this slow has been let down


class DriveSignals(NamedTuple):
    """What the state frames will say, shape (12,) each."""

    position: Vector  # rad at the motor
    velocity: Vector  # rad/s at the motor
    torque: Vector  # Nm at the joint
    temperature: Vector  # degC
    state: Vector  # DriveState


def _within(target: Vector, limit: Vector, own_limit: Vector, wanted: Vector) -> None:
    """The target within what HAL and drive allow. Shape (12,) each [Nm]."""
    for i in range(len(wanted)):
        most = min(limit[i], own_limit[i])
        wanted[i] = max(-most, min(target[i], most))


_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()


class Drives:
    """Twelve drives; one command frame serves the six of a leg, leg 0 is left: drives 0 to 5, leg 1 drives 6 to 11."""

    def __init__(
        self, robot: Robot, parameters: DriveParameters, signals: DriveSignals, outbox: list[Emergency] | None = None
    ) -> None:
        """Switch the drives on; `outbox` takes the emergencies they want told."""
        self._robot = robot
        self.parameters = parameters
        self.signals = signals
        self.state = [DriveState.SWITCH_ON_DISABLED] * len(JOINTS)
        #: Drives that stopped by themselves and were not acknowledged with QUICK_STOP since.
        self.latched = [False] * len(JOINTS)
        self.emergencies = [] if outbox is None else outbox
        self.errors = Errors(NODES, self.emergencies)
        #: Supply voltage of each drive [V].
        self.voltage = [parameters.supply] * len(JOINTS)
        #: Cycles in a row without a new command, a leg.
        self.missed = [0] * len(SIDES)
        self._unsynced = [0] * len(SIDES)  # cycles in a row without SYNC, a leg
        self._unsynced_at = [-1] * len(SIDES)  # the last of them
        self.encoders = Encoders(robot, parameters.velocity_bandwidth, signals.position, signals.velocity)
        self.motors = Motors(robot, parameters.motor, signals.torque, signals.temperature)
        self._slow_phase = 0
        self._steady = b""  # controlwords that left every drive as it was the last time
        self._hold_at = np.zeros(len(JOINTS))  # rad, where a stopped drive holds
        self._target, self._limit = np.zeros((2, len(JOINTS)))
        self._own_limit = robot.torque_max.copy()  # Nm, of a drive this hot
        self._within = compiled(_within)
        self._within(self._target, self._limit, self._own_limit, self.motors.wanted)  # compiled now, not in a cycle
        self._states_changed()

    # -- every cycle -------------------------------------------------------------------------------------------------

    def sample(self, position: Vector) -> None:
        """Read the encoders: joint position [rad], shape (12,), to the signals of the state frames."""
        self.encoders.sample(position)

    def command(self, fresh: tuple[bool, bool], controlword: Vector, target: Vector, limit: Vector) -> None:
        """Latch the last valid command and run watchdog and state machine.

        Args:
            fresh: per leg, whether a valid new command came since the last cycle.
            controlword: shape (12,), `Controlword` values.
            target: shape (12,) [Nm at the joint].
            limit: shape (12,) [Nm], the HAL's MaxTorque; the drive's own limit holds anyway. Both are read again in every
                `drive` until the next command.
        """
        missed = self.missed
        for leg in (0, 1):
            if fresh[leg]:
                missed[leg] = 0
            else:
                missed[leg] += 1
                if missed[leg] >= WATCHDOG:
                    self.hold(leg, emergency.COMMAND_TIMEOUT)
        words = controlword.tobytes()
        if words != self._steady:
            self._run_state_machines(fresh, controlword, words)
        self._target, self._limit = target, limit

    def drive(self, velocity: Vector) -> list[float]:
        """Joint torques for the next `PERIOD`: what the motors make of the command. Shape (12,) [Nm].

        Args:
            velocity: true joint velocity [rad/s], shape (12,): what friction acts on.
        """
        self._slow_phase += 1
        if self._slow_phase == SLOW_CYCLES:
            self._slow_turn()
        wanted = self.motors.wanted
        self._within(self._target, self._limit, self._own_limit, wanted)
        if not self._all_enabled:
            self._without_command(wanted)
        return self.motors.turn(velocity)

    def draw_noise(self, generator: np.random.Generator, out: Vector) -> None:
        """Measurement noise of the torque signal for many cycles. Shape (cycles, 12) [Nm]."""
        np.multiply(generator.standard_normal(out.shape), self.parameters.torque_noise, out=out)

    def _without_command(self, wanted: Vector) -> None:
        """Replace the command of drives that are not enabled: position hold, or nothing."""
        robot, limit = self._robot, self._own_limit
        # The drive's own loop uses the bare encoder difference: the filtered estimate is for the frame, and too late.
        hold = robot.hold_kp * (self._hold_at - self.encoders.angle) - robot.hold_kd * self.encoders.speed
        np.clip(hold, -limit, limit, out=hold)
        wanted[:] = np.where(self._is_enabled, wanted, np.where(self._is_holding, hold, 0.0))

    # -- what is wrong -----------------------------------------------------------------------------------------------

    def hold(self, leg: int, code: int) -> None:
        """Local hold, latched, of every enabled drive of a leg, for an error of the wire: its HAL is not heard."""
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            if self.state[drive] is DriveState.OPERATION_ENABLED:
                self.fail(drive, code)

    def miss_sync(self, leg: int, cycle: int) -> None:
        """A leg had no SYNC in this cycle."""
        in_a_row = self._unsynced_at[leg] == cycle - 1
        self._unsynced[leg] = self._unsynced[leg] + 1 if in_a_row else 1
        self._unsynced_at[leg] = cycle
        if self._unsynced[leg] >= WATCHDOG:
            self.hold(leg, emergency.LIFE_GUARD)

    def find_sync(self, leg: int) -> None:
        """The SYNC of a leg came after all."""
        self._unsynced[leg] = 0

    def notice(self, leg: int, code: int) -> None:
        """Something was wrong with a command of a leg that asks for no reaction."""
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            self.errors.notice(drive, code)

    def fail(self, drive: int, code: int, *, stands: bool = False) -> None:
        """A drive has an error: it tells it and does what it can do by itself. `stands`: until `recover`."""
        self.errors.begin(drive, code, stands=stands)
        state = self.state[drive]
        match reaction_to(code):
            case Reaction.LOWER if state not in _FAULTY:
                self._enter(drive, DriveState.FAULT_REACTION_ACTIVE)
                self.latched[drive] = False
            case Reaction.HOLD if state in _POWERED:
                if state is not DriveState.QUICK_STOP_ACTIVE:
                    self._enter(drive, DriveState.QUICK_STOP_ACTIVE)
                self.latched[drive] = True
        self._states_changed()

    def recover(self, drive: int, code: int) -> None:
        """The cause of an error is gone; what it led to stays until the HAL acknowledges it."""
        self.errors.end(drive, code)
        if not self.latched[drive] and self.state[drive] not in _FAULTY:
            self.errors.acknowledge(drive)
        self._steady = b""  # the HAL may be acknowledging already

    def leave(self, drive: int, state: DriveState) -> None:
        """Go to a state unasked, as broken firmware would."""
        self._enter(drive, state)
        self._states_changed()

    def reset(self, drive: int) -> None:
        """Begin anew, as after a loss of power."""
        self._enter(drive, DriveState.SWITCH_ON_DISABLED)
        self.latched[drive] = False
        self.errors.forget(drive)
        self._states_changed()

    def heat(self, drive: int, temperature: float) -> None:
        """The winding of a drive has this temperature [degC]."""
        self.motors.temperature[drive] = temperature
        self._judge_heat()

    def supply(self, drive: int, voltage: float) -> None:
        """A drive has this supply voltage [V]."""
        self.voltage[drive] = voltage
        for code, least in (
            (emergency.UNDER_VOLTAGE, self.parameters.hold_below),
            (emergency.NO_VOLTAGE, self.parameters.off_below),
        ):
            if voltage < least:
                self.fail(drive, code, stands=True)
            elif self.errors.has(drive, code):
                self.recover(drive, code)

    # -- state -------------------------------------------------------------------------------------------------------

    def _run_state_machines(self, fresh: tuple[bool, bool], controlword: Vector, words: bytes) -> None:
        changed = False
        for drive, word in enumerate(controlword.tolist()):
            if fresh[drive // _LEG]:
                changed |= self._obey(drive, int(word))
        if changed:
            self._states_changed()
        elif fresh[0] and fresh[1]:
            self._steady = words

    def _obey(self, drive: int, word: int) -> bool:
        """One controlword to one drive; whether anything changed."""
        state, latched = self.state[drive], self.latched[drive]
        after = next_state(state, word, latched=latched)
        if self.errors.stand(drive) and (state is DriveState.FAULT or after is DriveState.OPERATION_ENABLED):
            return False  # not before the cause is gone
        acknowledged = after is not state and state is DriveState.FAULT
        if latched and (after is not DriveState.QUICK_STOP_ACTIVE or word == Controlword.QUICK_STOP):
            acknowledged = not self.errors.stand(drive) or after is not DriveState.QUICK_STOP_ACTIVE
            self.latched[drive] = not acknowledged
        if acknowledged:
            self.errors.acknowledge(drive)
        if after is not state:
            self._enter(drive, after)
        return acknowledged or after is not state

    def _enter(self, drive: int, state: DriveState) -> None:
        if state is DriveState.QUICK_STOP_ACTIVE:
            self._hold_at[drive] = self.encoders.angle[drive]
        self.state[drive] = state

    def _states_changed(self) -> None:
        self._steady = b""
        state = self.signals.state
        state[:] = self.state
        self._all_enabled = state.tobytes() == _ENABLED
        self._is_enabled = state == DriveState.OPERATION_ENABLED
        self._is_holding = state == DriveState.QUICK_STOP_ACTIVE
        self.motors.power(self._is_enabled | self._is_holding)

    # -- what is slow ------------------------------------------------------------------------------------------------

    def _slow_turn(self) -> None:
        self._slow_phase = 0
        if DriveState.FAULT_REACTION_ACTIVE in self.state:
            self._judge_rest()
        self.motors.warm(SLOW_CYCLES * PERIOD)
        self._judge_heat()
        self.errors.turn()

    def _judge_heat(self) -> None:
        """Less torque for a hot drive, none for one that is too hot."""
        temperature, parameters = self.motors.temperature, self.parameters
        # As it is told: the HAL computes the same limit from the frame.
        self._own_limit[:] = self._robot.torque_limit(np.rint(temperature))
        for drive, degrees in enumerate(temperature.tolist()):
            if degrees >= parameters.trip_temperature:
                self.fail(drive, emergency.OVER_TEMPERATURE, stands=True)
            elif degrees <= parameters.cool_enough and self.errors.has(drive, emergency.OVER_TEMPERATURE):
                self.recover(drive, emergency.OVER_TEMPERATURE)

    def _judge_rest(self) -> None:
        """A joint that was let down and moves no more: FAULT."""
        speed = np.abs(self.encoders.speed)
        for drive in np.flatnonzero(speed < self.parameters.rest_speed).tolist():
            if self.state[drive] is DriveState.FAULT_REACTION_ACTIVE:
                self._enter(drive, AUTOMATIC[self.state[drive]])
        self._states_changed()
