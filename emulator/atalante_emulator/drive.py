"""Firmware of the twelve emulated drives: CiA 402 state machine, command watchdog, torque limits and local error reactions.

One cycle calls three methods in this order. `sample` fills the signals of the state frames. `command` latches the command of
the HAL. `drive` computes the torques of the next millisecond.

The drives are the last safety layer. They react to errors without the HAL, in one of two ways:

- Local hold. Causes: the last valid command is `WATCHDOG` cycles old, no SYNC for `WATCHDOG` cycles, two senders of one
  command, supply voltage below `hold_below`. The drive stays in QUICK STOP ACTIVE until the HAL acknowledges the hold. The
  motor holds the joint at the position that the drive's own encoder measured at the start of the hold. If the encoder jumps
  during the hold, the setpoint jumps by the same angle, so the joint does not move.
- Lowering. Causes: over-temperature, over-current, encoder error, supply voltage below `off_below`. The drive cannot hold the
  joint. The drive enters FAULT REACTION ACTIVE and then FAULT. The power stage is off, and the brake lets the joint sink
  slowly. The same brake acts in every drive whose power stage is off, so the HAL can lower a joint with DISABLE_VOLTAGE.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from atalante_emulator import emergency
from atalante_emulator.emergency import Emergency, Errors, FaultReaction, reaction_to
from atalante_emulator.encoder import Encoders
from atalante_emulator.motor import MotorParameters, Motors
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.types import PERIOD, Vector
from atalante_hal.wire.cia402 import AUTOMATIC, Controlword, DriveState, next_state

#: Timeout of the commands and of SYNC [cycles]. At a timeout, an enabled drive starts its local hold.
WATCHDOG: Final = 5
#: Interval of the slow tasks of the drives [cycles]: update of temperatures and warnings, and after a fault the check whether
#: the joint is at rest.
SLOW_CYCLES: Final = 100
#: Names of the drive nodes, in the order of JOINTS.
NODES: Final = tuple(joint.upper() for joint in JOINTS)
_LEG: Final = len(LEG_JOINTS)
_POWERED: Final = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_FAULTY: Final = (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)


@dataclass(frozen=True)
class DriveParameters:
    """True parameters of the emulated drives. The HAL cannot read these parameters."""

    motor: MotorParameters = field(default_factory=MotorParameters)
    velocity_bandwidth: float = 80.0  # cut-off frequency of the velocity low-pass [Hz]
    torque_noise: float = 0.05  # noise of the torque measurement [Nm rms]
    trip_temperature: float = 120.0  # winding temperature that switches the power stage off [degC]
    cool_enough: float = 100.0  # highest winding temperature at which an over-temperature error can end [degC]
    supply: float = 48.0  # nominal supply voltage [V]
    hold_below: float = 40.0  # supply voltage below which a drive starts its local hold [V]
    #: Joint speed, computed from two encoder samples, above which the local hold assumes that the encoder jumped [rad/s].
    jump_speed: float = 20.0
    off_below: float = 20.0  # lowest supply voltage at which the power stage works [V]
    rest_speed: float = 0.05  # joint speed below which the lowering of a joint ends [rad/s]


class DriveSignals(NamedTuple):
    """Signals in the state frames of the twelve drives, shape (12,) each. `Drives` updates the signals."""

    position: Vector  # position of the motor [rad]
    velocity: Vector  # velocity of the motor [rad/s]
    torque: Vector  # measured torque at the joint [Nm]
    temperature: Vector  # temperature of the winding [degC]
    state: Vector  # value of `DriveState`


def _within(target: Vector, limit: Vector, own_limit: Vector, wanted: Vector) -> None:
    """Clip the target torque to the limits of HAL and drive, and write it to `wanted`. All arrays have shape (12,) [Nm]."""
    for i in range(len(wanted)):
        most = min(limit[i], own_limit[i])
        wanted[i] = max(-most, min(target[i], most))


_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()


class Drives:
    """Twelve drives of two legs. Leg 0 (left) has drives 0 to 5, leg 1 (right) has drives 6 to 11."""

    def __init__(
        self, robot: Robot, parameters: DriveParameters, signals: DriveSignals, outbox: list[Emergency] | None = None
    ) -> None:
        """Create the drives in the state SWITCH_ON_DISABLED.

        Args:
            robot: joint properties that the firmware uses: torque limits, gear ratios and hold gains.
            parameters: true parameters of the drives.
            signals: arrays to which the signals of the state frames are written.
            outbox: list to which emergencies to send are appended. With None, the drives create a list.
        """
        self._robot = robot
        self.parameters = parameters
        self.signals = signals
        self.state = [DriveState.SWITCH_ON_DISABLED] * len(JOINTS)
        #: For each drive: True after the drive has left OPERATION ENABLED without a command, for example for a local hold.
        #: A latched drive ignores ENABLE_OPERATION until the HAL sends QUICK_STOP or a controlword that changes the state.
        self.latched = [False] * len(JOINTS)
        #: Delay of each drive from the command ENABLE_OPERATION to the state OPERATION ENABLED [cycles].
        self.enable_delay = [0] * len(JOINTS)
        #: For each drive: number of consecutive ENABLE_OPERATION commands that the drive has delayed, see `enable_delay`.
        self._enabling = [0] * len(JOINTS)
        self.emergencies = [] if outbox is None else outbox
        self.errors = Errors(NODES, self.emergencies)
        #: Supply voltage of each drive [V].
        self.voltage = [parameters.supply] * len(JOINTS)
        #: Age of the last valid command, per leg [cycles].
        self.missed = [0] * len(SIDES)
        self._unsynced = [0] * len(SIDES)  # number of consecutive cycles without SYNC, per leg
        self._unsynced_at = [-1] * len(SIDES)  # number of the last cycle without SYNC, per leg
        self.encoders = Encoders(robot, parameters.velocity_bandwidth, signals.position, signals.velocity)
        self.motors = Motors(robot, parameters.motor, signals.torque, signals.temperature)
        self._slow_phase = 0
        #: Controlwords that have no effect in the present drive states, as bytes; empty if no such controlwords are known.
        #: If the HAL sends these controlwords again, the drives skip them.
        self._steady = b""
        self._hold_at = np.zeros(len(JOINTS))  # setpoint of the local hold of each drive [rad]
        self._target, self._limit = np.zeros((2, len(JOINTS)))
        self._own_limit = robot.torque_max.copy()  # torque limit of each drive at the current winding temperature [Nm]
        self._within = compiled(_within)
        # Compile the kernel now, because compilation takes longer than a cycle.
        self._within(self._target, self._limit, self._own_limit, self.motors.wanted)
        self._states_changed()

    # -- called in every cycle ---------------------------------------------------------------------------------------

    def sample(self, position: Vector) -> None:
        """Read the encoders and update the position and velocity signals.

        Args:
            position: joint positions, shape (12,) [rad].
        """
        self.encoders.sample(position)

    def command(
        self,
        fresh: tuple[bool, bool],
        controlword: Vector,
        target: Vector,
        limit: Vector,
        delay: tuple[int, int] = (0, 0),
    ) -> None:
        """Latch the last valid command and run the watchdog and the state machines.

        Until the next command, every call of `drive` reads the arrays `target` and `limit`.

        Args:
            fresh: per leg, whether a valid new command arrived since the last cycle.
            controlword: `Controlword` values, shape (12,).
            target: target torques, shape (12,) [Nm at the joint].
            limit: torque limits from the signal MaxTorque of the HAL, shape (12,) [Nm]. The drive's own limit applies too.
            delay: per leg, age of the new command on arrival [cycles], less than `WATCHDOG`. The watchdog adds the cycles since
                the arrival to this age.
        """
        missed = self.missed
        for leg in (0, 1):
            if fresh[leg]:
                missed[leg] = delay[leg]
            else:
                missed[leg] += 1
                if missed[leg] >= WATCHDOG:
                    self.hold(leg, emergency.COMMAND_TIMEOUT)
        words = controlword.tobytes()
        if words != self._steady:
            self._run_state_machines(fresh, controlword, words)
        self._target, self._limit = target, limit

    def drive(self, velocity: Vector) -> list[float]:
        """Return the joint torques of the next `PERIOD`.

        Args:
            velocity: true joint velocities, shape (12,) [rad/s]. The friction depends on these velocities.

        Returns:
            Joint torques, shape (12,) [Nm].
        """
        self._slow_phase += 1
        if self._slow_phase == SLOW_CYCLES:
            self._update_slow()
        wanted = self.motors.wanted
        self._within(self._target, self._limit, self._own_limit, wanted)
        if not self._all_enabled:
            self._without_command(wanted)
        return self.motors.advance(velocity)

    def draw_noise(self, generator: np.random.Generator, out: Vector) -> None:
        """Draw the measurement noise of the torque signals for many cycles.

        Args:
            generator: source of the random numbers.
            out: output for the noise, shape (cycles, 12) [Nm].
        """
        np.multiply(generator.standard_normal(out.shape), self.parameters.torque_noise, out=out)

    def _without_command(self, wanted: Vector) -> None:
        """Set the torque of drives in a state other than OPERATION ENABLED: hold torque in QUICK STOP ACTIVE, otherwise zero."""
        robot, limit = self._robot, self._own_limit
        # The local hold uses the unfiltered encoder velocity, because the filtered velocity has too much delay.
        speed = self.encoders.speed
        jumped = np.abs(speed) > self.parameters.jump_speed
        if jumped.any():  # the encoder jumped: shift the setpoint by the jump, so that the joint does not move
            self._hold_at[jumped] += speed[jumped] * PERIOD
            speed[jumped] = 0.0
        hold = robot.hold_kp * (self._hold_at - self.encoders.angle) - robot.hold_kd * speed
        np.clip(hold, -limit, limit, out=hold)
        unknown = np.isnan(hold)
        if unknown.any():  # the hold began before the first sample of the encoder
            self._hold_at[unknown], hold[unknown] = self.encoders.angle[unknown], 0.0
        wanted[:] = np.where(self._is_enabled, wanted, np.where(self._is_holding, hold, 0.0))

    # -- errors and local reactions ----------------------------------------------------------------------------------

    def hold(self, leg: int, code: int) -> None:
        """Start a latched local hold in every enabled drive of a leg.

        Args:
            leg: index of the leg, 0 is left.
            code: error code of the emergency that reports the cause.
        """
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            if self.state[drive] is DriveState.OPERATION_ENABLED:
                self.fail(drive, code)

    def miss_sync(self, leg: int, cycle: int) -> None:
        """Count a cycle without SYNC on the bus of a leg. After `WATCHDOG` such cycles in a row, start the local hold.

        Args:
            leg: index of the leg, 0 is left.
            cycle: number of the cycle.
        """
        in_a_row = self._unsynced_at[leg] == cycle - 1
        self._unsynced[leg] = self._unsynced[leg] + 1 if in_a_row else 1
        self._unsynced_at[leg] = cycle
        if self._unsynced[leg] >= WATCHDOG:
            self.hold(leg, emergency.LIFE_GUARD)

    def restart_sync_watchdog(self, leg: int) -> None:
        """Restart the SYNC watchdog of a leg after a SYNC that arrived late in its cycle.

        Args:
            leg: index of the leg, 0 is left.
        """
        self._unsynced[leg] = 0

    def warn(self, leg: int, code: int) -> None:
        """Report a warning from each drive of a leg, because the command of the leg has an error.

        The drives do not react to a warning.

        Args:
            leg: index of the leg, 0 is left.
            code: emergency error code.
        """
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            self.errors.warn(drive, code)

    def fail(self, drive: int, code: int, *, persists: bool = False) -> None:
        """Report an error of a drive and start its local reaction.

        Args:
            drive: index of the drive.
            code: emergency error code.
            persists: True if the cause lasts until a call of `recover`. Until then the HAL cannot acknowledge the error.
        """
        self.errors.begin(drive, code, persists=persists)
        state = self.state[drive]
        match reaction_to(code):
            case FaultReaction.LOWER if state not in _FAULTY:
                self._enter(drive, DriveState.FAULT_REACTION_ACTIVE)
                self.latched[drive] = False
            case FaultReaction.HOLD if state in _POWERED:
                if state is not DriveState.QUICK_STOP_ACTIVE:
                    self._enter(drive, DriveState.QUICK_STOP_ACTIVE)
                self.latched[drive] = True
        self._states_changed()

    def recover(self, drive: int, code: int) -> None:
        """Mark the cause of an error as gone. The reaction to the error continues until the HAL acknowledges the error.

        Args:
            drive: index of the drive.
            code: emergency error code.
        """
        self.errors.end(drive, code)
        if not self.latched[drive] and self.state[drive] not in _FAULTY:
            self.errors.acknowledge(drive)
        # Evaluate the next controlwords even if they are unchanged, because they may now acknowledge the error.
        self._steady = b""

    def leave(self, drive: int, state: DriveState) -> None:
        """Change the state of a drive without a command, for example because its power stage is locked for a moment.

        Args:
            drive: index of the drive.
            state: state to enter.
        """
        if self.state[drive] is DriveState.OPERATION_ENABLED:
            self.latched[drive] = state not in (DriveState.OPERATION_ENABLED, *_FAULTY)
        self._enter(drive, state)
        self._states_changed()

    def reset(self, drive: int) -> None:
        """Restart a drive, as after a loss of power. The drive is then in SWITCH_ON_DISABLED and has no errors.

        Args:
            drive: index of the drive.
        """
        self._enter(drive, DriveState.SWITCH_ON_DISABLED)
        self.latched[drive] = False
        self.errors.clear(drive)
        self._states_changed()

    def heat(self, drive: int, temperature: float) -> None:
        """Set the winding temperature of a drive.

        Args:
            drive: index of the drive.
            temperature: winding temperature [degC].
        """
        self.motors.temperature[drive] = temperature
        self._check_temperature()

    def supply(self, drive: int, voltage: float) -> None:
        """Set the supply voltage of a drive, and begin or end its voltage errors.

        Args:
            drive: index of the drive.
            voltage: supply voltage [V].
        """
        self.voltage[drive] = voltage
        for code, least in (
            (emergency.UNDER_VOLTAGE, self.parameters.hold_below),
            (emergency.NO_VOLTAGE, self.parameters.off_below),
        ):
            if voltage < least:
                self.fail(drive, code, persists=True)
            elif self.errors.has(drive, code):
                self.recover(drive, code)

    # -- state machine -----------------------------------------------------------------------------------------------

    def _run_state_machines(self, fresh: tuple[bool, bool], controlword: Vector, words: bytes) -> None:
        changed = False
        for drive, word in enumerate(controlword.tolist()):
            if fresh[drive // _LEG]:
                changed |= self._apply_controlword(drive, int(word))
        if changed:
            self._states_changed()
        elif fresh[0] and fresh[1]:
            self._steady = words

    def _apply_controlword(self, drive: int, word: int) -> bool:
        """Apply a controlword to a drive. Return whether the word changed the drive state or acknowledged an error."""
        state, latched = self.state[drive], self.latched[drive]
        after = next_state(state, word, latched=latched)
        if self.errors.any_persists(drive) and (state is DriveState.FAULT or after is DriveState.OPERATION_ENABLED):
            return False  # the cause of an error persists, so the HAL cannot acknowledge the error
        if after is DriveState.OPERATION_ENABLED is not state and self._enabling[drive] < self.enable_delay[drive]:
            self._enabling[drive] += 1
            return True  # evaluate the next controlwords even if they are unchanged
        self._enabling[drive] = 0
        acknowledged = after is not state and state is DriveState.FAULT
        if latched and (after is not state or word == Controlword.QUICK_STOP):
            acknowledged = not self.errors.any_persists(drive) or after is not DriveState.QUICK_STOP_ACTIVE
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

    # -- temperature and standstill ----------------------------------------------------------------------------------

    def _update_slow(self) -> None:
        self._slow_phase = 0
        if DriveState.FAULT_REACTION_ACTIVE in self.state:
            self._check_rest()
        self.motors.warm(SLOW_CYCLES * PERIOD)
        self._check_temperature()
        self.errors.advance()

    def _check_temperature(self) -> None:
        """Reduce the torque limit of hot drives and switch off drives above the trip temperature."""
        temperature, parameters = self.motors.temperature, self.parameters
        # The temperature is rounded as in the state frame, so that drive and HAL compute the same limit.
        self._own_limit[:] = self._robot.torque_limit(np.rint(temperature))
        for drive, degrees in enumerate(temperature.tolist()):
            if degrees >= parameters.trip_temperature:
                self.fail(drive, emergency.OVER_TEMPERATURE, persists=True)
            elif degrees <= parameters.cool_enough and self.errors.has(drive, emergency.OVER_TEMPERATURE):
                self.recover(drive, emergency.OVER_TEMPERATURE)

    def _check_rest(self) -> None:
        """Change each drive from FAULT REACTION ACTIVE to FAULT when its joint is at rest."""
        speed = np.abs(self.encoders.speed)
        for drive in np.flatnonzero(speed < self.parameters.rest_speed).tolist():
            if self.state[drive] is DriveState.FAULT_REACTION_ACTIVE:
                self._enter(drive, AUTOMATIC[self.state[drive]])
        self._states_changed()
