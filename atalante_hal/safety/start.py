"""Whether the drives may be enabled: the torque each reports fits the state it is in.

    drive state, reported torque -> refusal -> safety monitor, event START_REFUSED

At a start the HAL takes over the torque the drives hold with. A torque that a drive cannot have would be commanded as it was
reported.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS, Robot
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.codec import Vector

#: States in which a drive makes torque; in the others it brakes at most.
POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_NAMES = {float(state): state.name for state in DriveState}


def powered(drive_state: Vector) -> npt.NDArray[np.bool_]:
    """Return which drives make torque.

    Args:
        drive_state: values of `DriveState`, shape (12,).
    """
    return np.isin(drive_state, POWERED)


def refusal(robot: Robot, drive_state: Vector, torque: Vector) -> str | None:
    """Return why the drives must not be enabled, None if they may.

    Args:
        robot: torque limits, and the torque an idle drive may report.
        drive_state: values of `DriveState`, shape (12,).
        torque: reported by the drives, shape (12,) [Nm at the joint].
    """
    idle = robot.thresholds.idle_torque
    on = powered(drive_state)
    allowed = np.where(on, robot.torque_max, 0.0) + idle
    wrong = np.flatnonzero(~(np.abs(torque) <= allowed))  # NaN is wrong
    if not wrong.size:
        return None
    joint = int(wrong[0])
    state = _NAMES.get(float(drive_state[joint]), f"state {drive_state[joint]:g}")
    limit = f"its limit of {robot.torque_max[joint]:.0f} Nm" if on[joint] else f"{idle:g} Nm, it makes no torque"
    return f"the drive of {JOINTS[joint]} reports {torque[joint]:.0f} Nm in {state}; must be within {limit}"
