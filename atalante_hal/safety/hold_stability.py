"""Check that each drive that holds its position really holds its joint: `position, velocity, torque, drive state -> findings`.

A drive that holds its position controls the joint by itself, and the HAL does not limit its torque. The HAL can only switch off a
drive that moves the joint, or presses the joint onto an end stop. Three motions show that the drive does not hold the joint:

*Oscillation.* The position control of the drive does not suit the joint. Causes are a wrong parameter, a loose gear, or a late
motor. A joint counts as oscillating if its velocity reverses `REVERSALS` times in a row. A joint that is stopped in motion,
pushed or carried reverses less often.

*Overload.* For `OVERLOADED` cycles, a joint is at least `AWAY` from the position in which the hold began, and the drive reports
a torque near its torque limit (`SATURATED`), but the joint neither moves back nor slows down. Causes are a motor that turns in
the wrong direction, a motor without torque, exchanged encoders, and a load that exceeds the torque limit. When a drive stops a
moving joint, its torque may reach the limit for a longer time, but the joint slows down.

*Motor without torque.* For `OVERLOADED` cycles, a joint is at least `SUNK` from the position in which the hold began and neither
moves back nor slows down, but the drive reports hardly any torque (`POWERLESS`). The IMUs of the leg must confirm the encoder
(`ENCODER_ERROR`), because a joint with a wrong encoder may not have moved. No IMU is below SA and HA, so this check omits SA and
HA.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.types import Vector
from atalante_hal.wire.cia402 import DriveState

#: Speed that a joint must exceed before and after a reversal, so that the reversal counts [rad/s].
SPEED: Final = 0.5
#: Longest time between two reversals of an oscillation [cycles].
INTERVAL: Final = 100
#: Number of consecutive reversals after which a joint is regarded as oscillating.
REVERSALS: Final = 6
#: Lowest and highest reported torque that count as overload, as shares of the drive's torque limit.
#: A drive cannot produce more than 105 % of its torque limit. A higher reported torque is a wrong value, not an overload.
SATURATED: Final = (0.9, 1.05)
#: Number of consecutive faulty cycles (overload or motor without torque) after which a drive is reported.
OVERLOADED: Final = 20
#: Overload is counted only at a distance of at least `AWAY` from the position in which the hold began [rad].
#: A drive that holds its joint keeps the distance smaller than `AWAY`. So a wrong reported torque alone is not counted.
AWAY: Final = math.radians(1.0)
#: A motor without torque is counted only at a distance of at least `SUNK` from the position in which the hold began [rad].
#: At the distance `SUNK`, a working drive with the stiffness `Robot.hold_kp` requests more than half of `Robot.torque_max`.
SUNK: Final = math.radians(3.0)
#: Torque below which a motor is regarded as being without torque, as a share of the drive's torque limit.
POWERLESS: Final = 0.1
#: Largest difference between the encoder angle and the IMU angle of a joint that confirms the encoder [rad].
#: If the IMUs do not confirm the encoder, a motion of the joint is not proven. So no missing torque of its motor is reported.
ENCODER_ERROR: Final = math.radians(1.0)
#: The count of faulty cycles restarts if the joint moves back or slows down, because its drive then works.
#: - Moves back: the joint moves towards the position in which the hold began, faster than `SLOWER` [rad/s].
#: - Slows down: the joint still moves away, but its speed is more than `SLOWER` below the speed in the first faulty cycle.
#: `SLOWER` is larger than the noise of the velocities.
SLOWER: Final = 0.05
#: Largest age of the values of a joint at which `_watch_load` evaluates the joint [cycles].
AGE: Final = 4


class Measured(NamedTuple):
    """Measurements of one cycle. Each field has the shape (12,)."""

    position: Vector  # rad
    velocity: Vector  # rad/s
    torque: Vector  # torques that the drives report [Nm]
    drive_state: Vector  # states of the drives
    age: Vector  # age of these values [cycles]
    encoder_error: Vector  # encoder angle minus angle from the IMUs [rad]; infinite if no angle from the IMUs is known


class Swings(NamedTuple):
    """Record of the velocity reversals of all joints. Each field has the shape (12,)."""

    direction: npt.NDArray[np.int64]  # direction of the last motion faster than `SPEED`: 1, -1, or 0 if there is none
    age: npt.NDArray[np.int64]  # number of cycles since the joint first exceeded `SPEED` in its current direction
    reversals: npt.NDArray[np.int64]  # number of consecutive reversals


class Loads(NamedTuple):
    """Memory of `_watch_load`, which detects overload and motors without torque. Each field has the shape (12,)."""

    start: Vector  # position of the joint when the hold began [rad]; NaN if the drive does not hold its position
    speed: Vector  # speed in the first faulty cycle [rad/s]: positive away from `start`, negative towards `start`
    cycles: Vector  # number of consecutive faulty cycles: the drive is overloaded, or its motor has no torque


def _follow(velocity: Vector, drive_state: Vector, swings: Swings, driven: tuple[float, float]) -> bool:
    """Count the velocity reversals of each joint in one more cycle, and return whether a joint oscillates.

    Args:
        velocity: joint velocities, shape (12,) [rad/s].
        drive_state: states of the drives, shape (12,).
        swings: record to update.
        driven: states in which a drive controls its joint.
    """
    oscillates = False
    for i in range(len(velocity)):
        swings.age[i] += 1
        if swings.age[i] > INTERVAL or (drive_state[i] != driven[0] and drive_state[i] != driven[1]):
            swings.direction[i] = swings.reversals[i] = 0
        direction = int(velocity[i] > SPEED) - int(velocity[i] < -SPEED)
        if direction != 0 and direction != swings.direction[i]:
            swings.reversals[i] += int(swings.direction[i] != 0)
            swings.direction[i], swings.age[i] = direction, 0
        oscillates |= swings.reversals[i] >= REVERSALS
    return bool(oscillates)


def _watch_load(joints: Measured, limit: Vector, driven: tuple[float, float], loads: Loads) -> bool:
    """Count the faulty cycles of each drive, and return whether a drive was faulty for `OVERLOADED` cycles.

    A cycle is faulty if the drive is overloaded or its motor has no torque, see the module docstring.

    Args:
        joints: measurements of the cycle.
        limit: torque limits of the drives, shape (12,) [Nm].
        driven: states in which a drive controls its joint; in the first, the drive holds its position.
        loads: record to update.
    """
    overloaded = False
    for i in range(len(limit)):
        if joints.age[i] > AGE:
            continue
        if joints.drive_state[i] != driven[0]:
            loads.start[i] = math.nan
        elif math.isnan(loads.start[i]):
            loads.start[i] = joints.position[i]
        away = joints.position[i] - loads.start[i]
        speed = math.copysign(1.0, away) * joints.velocity[i]
        torque, most = abs(joints.torque[i]), limit[i]
        saturated = SATURATED[0] * most <= torque <= SATURATED[1] * most
        confirmed = abs(joints.encoder_error[i]) <= ENCODER_ERROR
        powerless = abs(away) >= SUNK and torque < POWERLESS * most and confirmed
        if not ((abs(away) >= AWAY and saturated) or powerless) or speed < -SLOWER:
            loads.cycles[i] = 0.0
        elif loads.cycles[i] == 0.0 or speed < loads.speed[i] - SLOWER:
            loads.cycles[i], loads.speed[i] = 1.0, speed
        else:
            loads.cycles[i] += 1.0
        overloaded |= loads.cycles[i] >= OVERLOADED
    return bool(overloaded)


class HoldStability:
    """Check for oscillation, overload and motors without torque, see the module docstring.

    The check is used while the HAL sends no torques of the controller.
    """

    def __init__(self) -> None:
        """Create the check, and compile its kernels."""
        joints = len(JOINTS)
        self._swings = Swings(*np.zeros((3, joints), np.int64))
        self._loads = Loads(*np.zeros((3, joints)))
        self._driven = (float(DriveState.QUICK_STOP_ACTIVE), float(DriveState.OPERATION_ENABLED))
        at_rest = Measured(*np.zeros((6, joints)))
        self._follow = specialised(_follow, at_rest.velocity, at_rest.drive_state, self._swings, self._driven)
        self._watch_load = specialised(_watch_load, at_rest, at_rest.torque, self._driven, self._loads)
        self.restart()

    def restart(self) -> None:
        """Discard all records, because the controller moved the joints until now."""
        for record in self._swings:
            record[:] = 0
        self._loads.start[:] = math.nan

    def check(self, joints: Measured, limit: Vector) -> tuple[Finding, ...]:
        """Check one cycle, and return one finding for each joint whose drive does not hold it.

        Args:
            joints: measurements of the cycle.
            limit: torque limits of the drives, shape (12,) [Nm].
        """
        oscillates = self._follow(joints.velocity, joints.drive_state, self._swings, self._driven)
        overloaded = self._watch_load(joints, limit, self._driven, self._loads)
        if not (oscillates or overloaded):
            return ()
        reversals, cycles = self._swings.reversals.tolist(), self._loads.cycles.tolist()
        fast = f"faster than {np.degrees(SPEED):.0f} deg/s"
        found = [
            (joint, count, f"oscillates although its drive holds it: {count} reversals in a row {fast}")
            for joint, count in enumerate(reversals)
            if count >= REVERSALS
        ]
        found += [
            (
                joint,
                int(count),
                f"does not move back although its drive holds it and reports {abs(joints.torque[joint]):.0f} Nm",
            )
            for joint, count in enumerate(cycles)
            if count >= OVERLOADED and reversals[joint] < REVERSALS
        ]
        return tuple(
            Finding(
                Dtc.HOLD_UNSTABLE,
                JOINT_NODES[joint],
                float(count),
                True,
                f"{JOINTS[joint]} {motion}; its drive is switched off",
            )
            for joint, count, motion in found
        )
