"""The twelve drives: encoder, CiA 402, command watchdog, current loop, friction and heat, in a few array operations.

One cycle is `sample` (what the state frames will say), then `command` (latch what the HAL wants), then `drive` (torques
for the next millisecond). A drive that gets no valid new command for `WATCHDOG` cycles latches a local hold: QUICK STOP
ACTIVE, its motor holding the position of its own encoder, whatever the HAL does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.cia402 import Controlword, DriveState, next_state
from atalante_hal.robot import JOINTS, LEG_JOINTS, SIDES, Robot

Vector = npt.NDArray[np.float64]

#: Cycles (or milliseconds without SYNC) without a valid new command, after which an enabled drive holds by itself.
WATCHDOG = 5
COUNTS = 131072  # encoder counts a motor turn, 17 bits
#: Cycles between two updates of the winding temperature, which is slow.
THERMAL_CYCLES = 100
_LEG = len(LEG_JOINTS)


@dataclass(frozen=True)
class DriveParameters:
    """What the emulated drives are really like. Per leg joint where a tuple: FH, TH, SH, SK, SA, HA."""

    coulomb: tuple[float, ...] = (4.1, 3.1, 5.15, 4.9, 2.06, 0.97)  # Nm, dry friction at the joint
    viscous: tuple[float, ...] = (6.2, 3.9, 5.9, 4.1, 1.03, 0.49)  # Nm s/rad
    friction_speed: float = 0.05  # rad/s over which dry friction changes sign
    velocity_bandwidth: float = 80.0  # Hz, low-pass of the velocity estimate
    current_loop: float = 0.5e-3  # s, time constant of the torque
    torque_noise: float = 0.05  # Nm rms, of the torque measurement
    ambient: float = 25.0  # degC
    heating: float = 70.0  # K above ambient in the end at half the joint's torque limit
    thermal_time: float = 300.0  # s
    trip_temperature: float = 120.0  # degC: the drive switches itself off


class DriveSignals(NamedTuple):
    """What the state frames will say, shape (12,) each."""

    position: Vector  # rad at the motor
    velocity: Vector  # rad/s at the motor
    torque: Vector  # Nm at the joint
    temperature: Vector  # degC
    state: Vector  # DriveState


class Emergency(NamedTuple):
    """An error a drive wants told: CiA 301 error register, CiA 402 error code."""

    drive: int
    register: int
    code: int


#: CiA 301 / 402 codes of what a drive can notice by itself.
TEMPERATURE_ERROR = (0x09, 0x4310)  # generic, temperature; excess drive temperature
COMMUNICATION_ERROR = (0x11, 0x8130)  # generic, communication; life guard

_ENABLED = np.full(len(JOINTS), float(DriveState.OPERATION_ENABLED)).tobytes()


class Drives:
    """Twelve drives; one command frame serves the six of a leg, leg 0 is left: drives 0 to 5, leg 1 drives 6 to 11.

    What is linear (filters, current loop, friction on top of the motor) is one matrix-vector product: one call.
    """

    def __init__(self, robot: Robot, parameters: DriveParameters, signals: DriveSignals) -> None:
        self._robot = robot
        self._parameters = parameters
        self.signals = signals
        self.state = [DriveState.SWITCH_ON_DISABLED] * len(JOINTS)
        #: Drives that stopped by themselves and were not acknowledged with QUICK_STOP since.
        self.latched = [False] * len(JOINTS)
        self.emergencies: list[Emergency] = []
        #: Cycles in a row without a new command, a leg.
        self.missed = [0] * len(SIDES)
        self._steady = b""  # controlwords that left every drive as it was the last time
        self._hold_at = np.zeros(len(JOINTS))  # rad, where a stopped drive holds
        self._build_encoders()
        self._build_motors()
        self._states_changed()

    def _build_encoders(self) -> None:
        counts = COUNTS / (2.0 * math.pi)
        self._counts_per_rad = self._robot.gear * self._robot.polarity * counts
        self._lsb = np.full(len(JOINTS), 1.0 / counts)
        # Velocity estimate v' = keep v + gain (counts - counts before). The two rows of counts take turns.
        keep = math.exp(-2.0 * math.pi * self._parameters.velocity_bandwidth * PERIOD)
        gain = (1.0 - keep) / (counts * PERIOD)
        self._encoder = np.zeros((3, len(JOINTS)))
        self._counts, self._counts_before = self._encoder[1], self._encoder[2]
        self._filter, self._filter_next = np.array([keep, gain, -gain]), np.array([keep, -gain, gain])
        self._first_sample = True

    def _build_motors(self) -> None:
        parameters, both = self._parameters, len(SIDES)
        self._target: Vector = np.zeros(len(JOINTS))
        self._limit = b""
        self._lower, self._upper = np.zeros((2, len(JOINTS)))
        # Motor torque now, wanted torque, direction of dry friction, velocity -> motor torque next, joint torque.
        self._inputs = np.zeros(4 * len(JOINTS))
        self._torque, self._wanted, self._direction, self._velocity = self._inputs.reshape(4, -1)
        self._outputs = np.zeros(2 * len(JOINTS))
        self._next_torque, self._joint_torque = self._outputs.reshape(2, -1)
        tracking = 1.0 - math.exp(-PERIOD / parameters.current_loop)
        motor = [np.eye(len(JOINTS)) * (1.0 - tracking), np.eye(len(JOINTS)) * tracking]
        friction = [np.diag(parameters.coulomb * both), np.diag(parameters.viscous * both)]
        none = [np.zeros_like(motor[0])] * 2
        self._matrix = np.block([[*motor, *none], [*motor, -friction[0], -friction[1]]])
        self._per_friction_speed = np.full(len(JOINTS), 1.0 / parameters.friction_speed)
        self._heat = parameters.heating / (0.5 * self._robot.torque_max) ** 2
        self._heat_gain = THERMAL_CYCLES * PERIOD / parameters.thermal_time
        self._thermal_phase = 0
        self.signals.temperature.fill(parameters.ambient)

    def sample(self, position: Vector) -> None:
        """Read the encoders: joint position [rad], shape (12,), to the signals of the state frames."""
        signals, counts = self.signals, self._counts_before
        np.multiply(position, self._counts_per_rad, out=counts)
        np.rint(counts, out=counts)
        if self._first_sample:
            self._counts[:] = counts
            self._first_sample = False
        self._counts_before, self._counts = self._counts, counts
        self._filter, self._filter_next = self._filter_next, self._filter
        np.multiply(counts, self._lsb, out=signals.position)
        self._filter.dot(self._encoder, signals.velocity)
        self._encoder[0] = signals.velocity

    def command(self, fresh: tuple[bool, bool], controlword: Vector, target: Vector, limit: Vector) -> None:
        """Latch the last valid command and run watchdog and state machine.

        Args:
            fresh: per leg, whether a valid new command came since the last cycle.
            controlword: shape (12,), `Controlword` values.
            target: shape (12,) [Nm at the joint]; read again in every `drive` until the next command.
            limit: shape (12,) [Nm], the HAL's MaxTorque; the joint's own limit holds anyway.
        """
        missed = self.missed
        for leg in (0, 1):
            if fresh[leg]:
                missed[leg] = 0
            else:
                missed[leg] += 1
                if missed[leg] >= WATCHDOG:
                    self.hold(leg)
        words = controlword.tobytes()
        if words != self._steady:
            self._run_state_machines(fresh, controlword, words)
        self._target = target
        limits = limit.tobytes()
        if limits != self._limit:
            self._limit = limits
            np.minimum(limit, self._robot.torque_max, out=self._upper)
            np.negative(self._upper, out=self._lower)

    def hold(self, leg: int) -> None:
        """Local hold, latched, of every enabled drive of a leg: its HAL is not heard."""
        drives = [d for d in range(leg * _LEG, (leg + 1) * _LEG) if self.state[d] is DriveState.OPERATION_ENABLED]
        for drive in drives:
            self._enter(drive, DriveState.QUICK_STOP_ACTIVE)
            self.latched[drive] = True
            self.emergencies.append(Emergency(drive, *COMMUNICATION_ERROR))
        if drives:
            self._states_changed()

    def drive(self, velocity: Vector) -> list[float]:
        """Joint torques for the next `PERIOD`: what the motors make of the command, less friction. Shape (12,) [Nm].

        Args:
            velocity: true joint velocity [rad/s], shape (12,): what friction acts on.
        """
        self._thermal_phase += 1
        if self._thermal_phase == THERMAL_CYCLES:
            self._warm_up()
        wanted, direction = self._wanted, self._direction
        np.minimum(self._target, self._upper, out=wanted)
        np.maximum(wanted, self._lower, out=wanted)
        if not self._all_enabled:
            self._without_command(wanted)
        np.multiply(velocity, self._per_friction_speed, out=direction)
        np.tanh(direction, out=direction)
        self._velocity[:] = velocity
        self._matrix.dot(self._inputs, self._outputs)
        self._torque[:] = self._next_torque
        self.signals.torque[:] = self._next_torque
        torque: list[float] = self._joint_torque.tolist()
        return torque

    def draw_noise(self, generator: np.random.Generator, out: Vector) -> None:
        """Measurement noise of the torque signal for many cycles. Shape (cycles, 12) [Nm]."""
        np.multiply(generator.standard_normal(out.shape), self._parameters.torque_noise, out=out)

    def _without_command(self, wanted: Vector) -> None:
        """Replace the command of drives that are not enabled: position hold, or nothing."""
        robot = self._robot
        angle = self._counts / self._counts_per_rad
        # The drive's own loop uses the bare encoder difference: the filtered estimate is for the frame, and too late.
        speed = (self._counts - self._counts_before) / (self._counts_per_rad * PERIOD)
        hold = robot.hold_kp * (self._hold_at - angle) - robot.hold_kd * speed
        np.clip(hold, -robot.torque_max, robot.torque_max, out=hold)
        wanted[:] = np.where(self._is_enabled, wanted, np.where(self._is_holding, hold, 0.0))

    def _run_state_machines(self, fresh: tuple[bool, bool], controlword: Vector, words: bytes) -> None:
        changed = False
        for drive, word in enumerate(controlword.tolist()):
            if not fresh[drive // _LEG]:
                continue
            state, latched = self.state[drive], self.latched[drive]
            after = next_state(state, int(word), latched=latched)
            if latched and (after is not DriveState.QUICK_STOP_ACTIVE or word == Controlword.QUICK_STOP):
                self.latched[drive] = False
                changed = True
            if after is not state:
                self._enter(drive, after)
                changed = True
        if changed:
            self._states_changed()
        elif fresh[0] and fresh[1]:
            self._steady = words

    def _enter(self, drive: int, state: DriveState) -> None:
        if state is DriveState.QUICK_STOP_ACTIVE:
            self._hold_at[drive] = self._counts[drive] / self._counts_per_rad[drive]
        self.state[drive] = state
        self.signals.state[drive] = state

    def _states_changed(self) -> None:
        self._steady = b""
        self.signals.state[:] = self.state
        self._all_enabled = self.signals.state.tobytes() == _ENABLED
        self._is_enabled = self.signals.state == DriveState.OPERATION_ENABLED
        self._is_holding = self.signals.state == DriveState.QUICK_STOP_ACTIVE

    def _warm_up(self) -> None:
        """First-order winding temperature, heated by torque squared; too hot switches the drive off."""
        self._thermal_phase = 0
        temperature = self.signals.temperature
        final = self._parameters.ambient + self._heat * self.signals.torque**2
        temperature += self._heat_gain * (final - temperature)
        if temperature.max() < self._parameters.trip_temperature:
            return
        for drive in np.flatnonzero(temperature >= self._parameters.trip_temperature).tolist():
            if self.state[drive] is not DriveState.FAULT:
                self._enter(drive, DriveState.FAULT)
                self.emergencies.append(Emergency(drive, *TEMPERATURE_ERROR))
        self._states_changed()
