"""Check that no joint oscillates while its drive holds its position: `velocity, drive state -> findings`.

A drive that holds its position controls the joint by itself, and the HAL does not limit its torque. The joint oscillates if
the position control of the drive does not suit the joint. Causes are a wrong parameter, a loose gear, or a late motor.
A joint counts as oscillating if its velocity reverses `REVERSALS` times in a row. A joint that is stopped in motion, pushed or
carried reverses less often.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.types import Vector
from atalante_hal.wire.cia402 import DriveState

#: A reversal counts only if the joint exceeds this speed [rad/s] before and after the reversal.
SPEED: Final = 0.5
#: Longest time between two reversals of an oscillation [cycles].
INTERVAL: Final = 100
#: A joint is regarded as oscillating after this number of consecutive reversals.
REVERSALS: Final = 6


class Swings(NamedTuple):
    """Record of the reversals of all joints, shape (12,) each."""

    direction: npt.NDArray[np.int64]  # sign of the last velocity above `SPEED`; 0 if there is none
    age: npt.NDArray[np.int64]  # number of cycles since the joint first exceeded `SPEED` in its current direction
    reversals: npt.NDArray[np.int64]  # number of consecutive reversals


def _follow(velocity: Vector, drive_state: Vector, swings: Swings, driven: tuple[float, float]) -> bool:
    """Update the reversals of all joints by one cycle, and return whether a joint oscillates.

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


class HoldStability:
    """Check of all joints while the HAL sends no torques of the controller."""

    def __init__(self) -> None:
        """Create the check, and compile its kernel."""
        self._swings = Swings(*np.zeros((3, len(JOINTS)), np.int64))
        self._driven = (float(DriveState.QUICK_STOP_ACTIVE), float(DriveState.OPERATION_ENABLED))
        zero = np.zeros(len(JOINTS))
        self._follow = specialised(_follow, zero, zero, self._swings, self._driven)
        self.restart()

    def restart(self) -> None:
        """Discard all counted reversals, because the controller moved the joints until now."""
        for record in self._swings:
            record[:] = 0

    def check(self, velocity: Vector, drive_state: Vector) -> tuple[Finding, ...]:
        """Check the velocities of one cycle, and return one finding for each joint that oscillates.

        Args:
            velocity: joint velocities, shape (12,) [rad/s].
            drive_state: states of the drives, shape (12,).
        """
        if not self._follow(velocity, drive_state, self._swings, self._driven):
            return ()
        return tuple(
            Finding(
                Dtc.HOLD_UNSTABLE, JOINTS[joint].upper(), float(count), True,
                f"{JOINTS[joint]} oscillates although its drive holds it: {count} reversals in a row faster than "
                f"{np.degrees(SPEED):.0f} deg/s; its drive is switched off",
            )
            for joint, count in enumerate(self._swings.reversals.tolist())
            if count >= REVERSALS
        )  # fmt: skip
