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

#: Timeout of the commands and of SYNC [cycles]. After a timeout, an enabled drive holds its joint without the HAL (local hold).
WATCHDOG: Final = 5
#: Interval of the slow tasks of the drives [cycles]. The slow tasks update temperatures and warnings.
#: For a drive in FAULT REACTION ACTIVE, the slow tasks also check whether the joint has stopped.
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
    trip_temperature: float = 120.0  # winding temperature at which a drive switches its power stage off [degC]
    #: Highest winding temperature at which the HAL can acknowledge an over-temperature error [degC].
    cool_enough: float = 100.0
    supply: float = 48.0  # nominal supply voltage [V]
    hold_below: float = 40.0  # supply voltage below which a drive holds its joint instead of following commands [V]
    #: Joint speed, computed from two successive encoder samples, above which a holding drive assumes an encoder jump [rad/s].
    jump_speed: float = 20.0
    off_below: float = 20.0  # lowest supply voltage at which the power stage works [V]
    rest_speed: float = 0.05  # joint speed below which a joint counts as stopped in FAULT REACTION ACTIVE [rad/s]


class DriveSignals(NamedTuple):
    """Values that the twelve drives report to the HAL in their state frames. Element i of each array belongs to joint i."""

    position: Vector  # angle of the motor shaft, before the gear, shape (12,) [rad]
    velocity: Vector  # velocity of the motor shaft, before the gear, shape (12,) [rad/s]
    torque: Vector  # measured motor torque, given as torque at the joint, shape (12,) [Nm]
    temperature: Vector  # temperature of the motor winding, shape (12,) [degC]
    state: Vector  # state of the drive as a value of `DriveState`, shape (12,)


def _within(target: Vector, limit: Vector, own_limit: Vector, wanted: Vector) -> None:
    """Clip the target torques, and write the results to `wanted`.

    All arrays have shape (12,) [Nm]. The smaller of two limits applies: `limit` from the HAL and `own_limit` of the drive.
    """
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
            outbox: list to which emergency messages to send are appended. With None, the drives create a list.
        """
        self._robot = robot
        self.parameters = parameters
        self.signals = signals
        self.state = [DriveState.SWITCH_ON_DISABLED] * len(JOINTS)
        #: latched[i] is True if drive i left OPERATION ENABLED without a command, for example to hold its joint.
        #: A latched drive ignores ENABLE_OPERATION. A controlword that changes the drive state unlatches the drive.
        #: QUICK_STOP also unlatches the drive, with one exception: in the states QUICK STOP ACTIVE and FAULT, QUICK_STOP has no
        #: effect while the cause of an error persists.
        self.latched = [False] * len(JOINTS)
        #: enable_delay[i]: number of ENABLE_OPERATION commands that drive i ignores before it enters OPERATION ENABLED.
        self.enable_delay = [0] * len(JOINTS)
        #: _enabling[i]: number of ENABLE_OPERATION commands in a row that drive i has ignored because of `enable_delay`.
        self._enabling = [0] * len(JOINTS)
        self.emergencies = [] if outbox is None else outbox
        self.errors = Errors(NODES, self.emergencies)
        #: Supply voltage of each drive [V].
        self.voltage = [parameters.supply] * len(JOINTS)
        #: missed[leg]: age of the last valid command that the drives of the leg received [cycles].
        self.missed = [0] * len(SIDES)
        self._unsynced = [0] * len(SIDES)  # _unsynced[leg]: number of cycles in a row in which the leg received no SYNC
        self._unsynced_at = [-1] * len(SIDES)  # _unsynced_at[leg]: last cycle in which the leg received no SYNC
        self.encoders = Encoders(robot, parameters.velocity_bandwidth, signals.position, signals.velocity)
        self.motors = Motors(robot, parameters.motor, signals.torque, signals.temperature)
        self._slow_phase = 0
        #: Last set of twelve controlwords without an effect on any drive, as bytes. `_apply_controlword` describes the effects.
        #: If the HAL sends the same controlwords again, the drives need not evaluate them.
        #: Empty after a change of a drive state or of an error, because then the same controlwords may have an effect.
        self._steady = b""
        #: Joint position at which each drive holds its joint [rad]. NaN before the first encoder sample and after a state change.
        #: `_without_command` replaces NaN by the measured joint position.
        self._hold_at = np.full(len(JOINTS), np.nan)
        self._target, self._limit = np.zeros((2, len(JOINTS)))
        self._own_limit = robot.torque_max.copy()  # torque limit of each drive at the current winding temperature [Nm]
        self._within = compiled(_within)
        # Compile `_within` now. A compilation in the first cycle would delay this cycle by more than 1 ms.
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
        """Pass the commands of the HAL to the drives, and update watchdog and drive states.

        The drives keep the arrays `target` and `limit`. Each call of `drive` reads them until the next call of this method.

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
        """Return the joint torques for the next time step of 1 ms (`PERIOD`).

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
        """Overwrite the torque of each drive that is not in OPERATION ENABLED.

        A drive in QUICK STOP ACTIVE holds its joint with a spring and damper torque. A drive in OPERATION ENABLED keeps its
        commanded torque. A drive in any other state has zero torque.
        """
        robot, limit = self._robot, self._own_limit
        # Use the encoder velocity without low-pass: the delay of a low-pass would reduce the damping of the hold.
        speed = self.encoders.speed
        jumped = np.abs(speed) > self.parameters.jump_speed
        # A joint speed above `jump_speed` means that only the encoder position jumped. The joint did not jump.
        # Shift the hold position by the jump of the encoder position, so that the hold torque does not change.
        if jumped.any():
            self._hold_at[jumped] += speed[jumped] * PERIOD
            speed[jumped] = 0.0
        # Set new hold positions only after the shift, because a new hold position already contains the jump.
        begins = np.isnan(self._hold_at)
        if begins.any():
            self._hold_at[begins] = self.encoders.angle[begins]
        hold = robot.hold_kp * (self._hold_at - self.encoders.angle) - robot.hold_kd * speed
        np.clip(hold, -limit, limit, out=hold)
        unknown = np.isnan(hold)
        if unknown.any():  # NaN: there is no encoder sample yet
            hold[unknown] = 0.0
        wanted[:] = np.where(self._is_enabled, wanted, np.where(self._is_holding, hold, 0.0))

    # -- errors and local reactions ----------------------------------------------------------------------------------

    def hold(self, leg: int, code: int) -> None:
        """Make every enabled drive of a leg hold its joint until the HAL acknowledges the error.

        Args:
            leg: index of the leg, 0 is left.
            code: error code of the emergency that reports the cause.
        """
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            if self.state[drive] is DriveState.OPERATION_ENABLED:
                self.fail(drive, code)

    def miss_sync(self, leg: int, cycle: int) -> None:
        """Count a cycle in which the drives of a leg received no SYNC.

        After `WATCHDOG` cycles in a row without SYNC, the enabled drives of the leg hold their joints.

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
        """Reset the number of cycles without SYNC of a leg to 0. The emulator calls this when a SYNC arrives late.

        Args:
            leg: index of the leg, 0 is left.
        """
        self._unsynced[leg] = 0

    def warn(self, leg: int, code: int) -> None:
        """Make each drive of a leg report that the command for this leg was wrong or lost.

        The report is a warning: the drives do not react to it.

        Args:
            leg: index of the leg, 0 is left.
            code: emergency error code.
        """
        for drive in range(leg * _LEG, (leg + 1) * _LEG):
            self.errors.warn(drive, code)

    def fail(self, drive: int, code: int, *, persists: bool = False) -> None:
        """Report an error of a drive to the HAL, and make the drive react: hold the joint, lower the joint, or continue.

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
        """Record that the cause of an error no longer exists, so that the HAL can acknowledge the error.

        The drive continues its reaction, for example the hold of its joint, until the HAL acknowledges the error.

        Args:
            drive: index of the drive.
            code: emergency error code.
        """
        self.errors.end(drive, code)
        if not self.latched[drive] and self.state[drive] not in _FAULTY:
            self.errors.acknowledge(drive)
        # Delete the stored controlwords, so that the next controlwords are evaluated even if they are the same as before.
        # Controlwords that had no effect while the cause of the error persisted can now acknowledge the error.
        self._steady = b""

    def leave(self, drive: int, state: DriveState) -> None:
        """Change the state of a drive without a controlword of the HAL.

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
        """Apply a controlword to a drive, and return whether the controlword had an effect.

        An effect is a new drive state, the acknowledgement of an error, or an ENABLE_OPERATION counted for `enable_delay`.
        """
        state, latched = self.state[drive], self.latched[drive]
        after = next_state(state, word, latched=latched)
        if self.errors.any_persists(drive) and (state is DriveState.FAULT or after is DriveState.OPERATION_ENABLED):
            return False  # the cause of an error persists, so the HAL cannot acknowledge the error
        if after is DriveState.OPERATION_ENABLED is not state and self._enabling[drive] < self.enable_delay[drive]:
            self._enabling[drive] += 1
            return True  # True: the caller must evaluate the same controlword again in the next cycle
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
        if state is not self.state[drive]:
            self._hold_at[drive] = np.nan
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
        """Reduce the torque limit of hot drives, and switch off each drive that has reached the trip temperature."""
        temperature, parameters = self.motors.temperature, self.parameters
        # Round to whole degrees: the HAL gets the temperature in whole degrees, and must compute the same torque limit.
        self._own_limit[:] = self._robot.torque_limit(np.rint(temperature))
        for drive, degrees in enumerate(temperature.tolist()):
            if degrees >= parameters.trip_temperature:
                self.fail(drive, emergency.OVER_TEMPERATURE, persists=True)
            elif degrees <= parameters.cool_enough and self.errors.has(drive, emergency.OVER_TEMPERATURE):
                self.recover(drive, emergency.OVER_TEMPERATURE)

    def _check_rest(self) -> None:
        """Change the state of each drive in FAULT REACTION ACTIVE to FAULT if its joint has stopped."""
        speed = np.abs(self.encoders.speed)
        for drive in np.flatnonzero(speed < self.parameters.rest_speed).tolist():
            if self.state[drive] is DriveState.FAULT_REACTION_ACTIVE:
                self._enter(drive, AUTOMATIC[self.state[drive]])
        self._states_changed()
