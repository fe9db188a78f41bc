"""Interface between the HAL and a controller: `State`, `Command` and the protocol `Controller`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
_Array = TypeVar("_Array", bound=npt.NDArray[Any])

#: Period [s] of the SYNC message and of the control loop.
PERIOD = 1e-3
#: Gravitational acceleration [m/s2].
GRAVITY = 9.81


class SupervisorState(IntEnum):
    """State of the robot as set by the state machine, ordered from the best to the worst state.

    The signal `HalState` on the bus has the same values.
    """

    OFF = 0  # nodes need not answer
    READY = 1  # every node answers without a fault; the operator may press START
    ACTIVE = 2  # the controller drives the joints
    FULL_ASSIST = 3  # as in ACTIVE, but the assistance factor is ramped to 1
    FINISH_STEP = 4  # the controller finishes the walking step, then HOLD follows
    HOLD = 5  # every drive holds its position with its internal control loop
    LOWER = 6  # a joint that cannot hold its position is lowered slowly
    FAULT = 7  # latched until the operator presses START


def read_only(array: _Array) -> _Array:
    """Return a view of an array. Writing into the view raises a ValueError."""
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass(slots=True)
class State:
    """Measured state of the robot in one cycle.

    The values have SI units. Position, velocity and torque are those of the joints, not of the motors before the gears. Arrays of
    twelve elements are in the order of `robot.JOINTS`.

    The arrays are views of the HAL's memory and valid until the next `Hal.read()`. Copy values that are needed longer.
    The arrays of `Hal.state` are read-only, because the HAL uses the same memory for its checks.
    """

    cycle: int  # SYNC counter
    time: float  # s, `cycle` times the period
    supervisor: SupervisorState
    assistance_factor: float  # Xi, 0 to 1 (full); set by the operator, ramped to 1 in FULL_ASSIST and FINISH_STEP
    position: Vector  # (12,) rad
    velocity: Vector  # (12,) rad/s
    torque: Vector  # (12,) Nm, measured by the drive
    temperature: Vector  # (12,) degC
    drive_state: Vector  # (12,) values of cia402.DriveState
    imu_quaternion: Vector  # (4, 4) quaternions wxyz, rotation from the sensor frame to the world frame (REP-103)
    imu_gyro: Vector  # (4, 3) rad/s
    imu_accel: Vector  # (4, 3) m/s2, specific force
    foot_force: Vector  # (2, 4, 3) N, force on the foot at each force cell, in the foot frame
    vibration: Vector  # (8,) measured level, 0 to 1
    #: One element per cyclic message: True if the data is new and plausible, and the sender is trusted (see `e2e.qualify`).
    valid: npt.NDArray[np.bool_]
    #: One element per cyclic message: age of the data [cycles], counted from the SYNC that the message answers.
    #: If the last received motion of a joint or an IMU was rejected, its element is the age of the last accepted motion.
    #: Motion of a joint: position and velocity. Motion of an IMU: quaternion, gyro and acceleration.
    #: The state, temperature and torque of a drive may be newer than the last accepted motion of its joint.
    age: npt.NDArray[np.int64]
    joints_valid: bool  # True if all twelve joint states are valid
    joint_rows: tuple[int, ...] = ()  # indices of the messages of the drives in `valid` and `age`; empty if unknown
    imu_rows: tuple[int, ...] = ()  # indices of the IMU messages in `valid` and `age`; empty if unknown
    foot_rows: tuple[int, ...] = ()  # indices of the foot messages in `valid` and `age`; empty if unknown
    #: Indices in `robot.IMUS` of the IMUs whose readings contradict gravity or their own attitude (`IMU_IMPLAUSIBLE`).
    #: If the only contradiction is between the torso IMU and the pelvis IMU, neither of them is in the set.
    implausible_imus: frozenset[int] = frozenset()
    #: (12,) Nm, last output of the torque limiter; None if unknown. Drives that follow the controller receive these torques.
    #: Drives that hold their positions receive the torque 0, not the output of the limiter.
    torque_sent: Vector | None = None
    #: Delay of the torques beyond the normal delay `safety.direction.LATENCY` [cycles].
    #: The direction test of the motors at START measures the delay, see `safety.direction`.
    delay: int = 0


@dataclass(slots=True)
class Command:
    """Command of a controller for one cycle, before the HAL limits the torques.

    A torque that is not finite raises no exception. The limiter detects it and the robot goes to HOLD.
    """

    torque: Vector  # (12,) Nm at the joint
    vibration: Vector  # (8,) level, 0 to 1
    step: int | None = None  # number of the walking step; None while the controller does not walk
    #: True while the robot walks on the ground. In this case, STOP first ends the walk, and then HOLD follows.
    walking: bool = False
    #: True if h < 0: a joint is outside the virtual guide, or a prediction exceeds the guide, a torque limit or a speed limit.
    #: The HAL reports GUIDE_OUTSIDE. This diagnostic is pending (the robot does not react) unless `guide_left` is True.
    outside: bool = False
    #: True if `outside` was True in too many cycles, although the guide is certified (calculated to keep the joints inside).
    #: While `outside` and `guide_left` are True, GUIDE_OUTSIDE is confirmed, and the state FULL_ASSIST follows.
    guide_left: bool = False
    #: True if a step starts with a deviation that exceeds the range for which the certificate of the guide was calculated.
    #: Four quantities at the start of the step are checked: angle deviation, speed deviation, acceleration and torque jump.
    #: If `hand_over_exceeded` is True, the HAL reports GUIDE_OUTSIDE as a pending diagnostic. The robot does not react to it.
    hand_over_exceeded: bool = False
    #: True in the cycle in which a step starts without a guide, or in which the guide of a step ends early.
    #: The cause is a delay of the loop for which the guides are not designed.
    #: The HAL reports GUIDE_OUTSIDE as a pending diagnostic. The robot does not react to it.
    loop_late: bool = False


class Controller(Protocol):
    """Interface of a controller that the control loop runs."""

    @property
    def telemetry(self) -> Vector:
        """Return the values of the controller that are recorded.

        The array is the same in every cycle, and `update` overwrites the array.
        """

    @property
    def telemetry_fields(self) -> Sequence[tuple[str, int]]:
        """Return the name and the length of each field of `telemetry`, in order."""

    def reset(self, state: State) -> None:
        """Prepare for a motion. The loop calls this before the first `update` of each motion.

        Args:
            state: State of the current cycle.
        """

    def update(self, state: State) -> Command:
        """Compute the command of one cycle. Any exception brings the robot to HOLD.

        Args:
            state: State of the current cycle.

        Returns:
            Command of this cycle, before the limits.
        """
