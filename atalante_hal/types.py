"""What passes between the HAL and a controller: the state read, the command written, and the controller protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]


class SupervisorState(IntEnum):
    """State of the supervisor; larger is worse. Values are those of `HalState` on the wire."""

    OFF = 0  # no node is expected to answer
    READY = 1  # every node is heard and well; drives may be enabled on the operator's word
    ACTIVE = 2  # the controller drives the joints
    FULL_ASSIST = 3  # as ACTIVE with the assistance factor led to 1
    FINISH_STEP = 4  # the step under way is finished, then HOLD
    HOLD = 5  # every drive holds its position by itself
    LOWER = 6  # a joint that cannot hold is let down slowly
    FAULT = 7  # latched; leaves by the operator alone


@dataclass(slots=True)
class State:
    """One cycle as the HAL sees it; joint side, SI units, order of `robot.JOINTS`.

    The arrays are views of the HAL's memory, valid until the next `Hal.read()`: copy what must live longer.
    Do not write into them.
    """

    cycle: int  # SYNC counter
    time: float  # s, cycle * period
    supervisor: SupervisorState
    assistance_factor: float  # Xi in [0, 1], set by the operator; led to 1 in FULL_ASSIST
    position: Vector  # (12,) rad
    velocity: Vector  # (12,) rad/s
    torque: Vector  # (12,) Nm, measured by the drive
    temperature: Vector  # (12,) degC
    drive_state: Vector  # (12,) values of cia402.DriveState
    imu_quaternion: Vector  # (4, 4) wxyz, sensor frame to world (REP-103)
    imu_gyro: Vector  # (4, 3) rad/s
    imu_accel: Vector  # (4, 3) m/s2, specific force
    foot_force: Vector  # (2, 4, 3) N, on the foot, in the foot frame
    vibration: Vector  # (8,) measured level, 0 to 1
    valid: npt.NDArray[np.bool_]  # (messages,) fresh, intact, plausible, and its sender is trusted
    age: npt.NDArray[np.int64]  # (messages,) cycles between the SYNC the data answers and the last one
    joints_valid: bool  # all twelve joint states are fresh
    imu_rows: tuple[int, ...] = ()  # places of the IMUs' messages in `valid` and `age`; empty: their age is not known
    torque_sent: Vector | None = None  # (12,) Nm, what the limits left of the last command; None: it is not known


@dataclass(slots=True)
class Command:
    """What a controller asks for; the limiter decides what is sent.

    Raises nothing: a non-finite value is caught by the limiter and ends in HOLD.
    """

    torque: Vector  # (12,) Nm at the joint
    vibration: Vector  # (8,) level, 0 to 1
    step: int | None = None  # number of the step under way; None: this controller does not walk
    outside: bool = False  # a joint is outside its safe backward image: told, not acted upon


class Controller(Protocol):
    """What the loop runs: any object with these members."""

    @property
    def telemetry(self) -> Vector:
        """What the controller wants recorded: always the same array, rewritten every update."""

    @property
    def telemetry_fields(self) -> Sequence[tuple[str, int]]:
        """(name, length) of each piece of `telemetry`."""

    def reset(self, state: State) -> None:
        """Called when the supervisor enters ACTIVE, before the first `update`."""

    def update(self, state: State) -> Command:
        """One cycle: read the state, return the command. Any exception puts the robot into HOLD."""
