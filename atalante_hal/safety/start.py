"""Start check: the drives may be enabled only if each reported torque is plausible in the state of its drive.

    drive state, reported torque -> refusal -> safety monitor, event START_REFUSED

At a start the HAL first commands the torque that the drives report, so that no joint sags. Without this check it would also
command a torque that a drive cannot produce.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS, Robot
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.codec import Vector

#: States in which a drive produces torque. In all other states it can at most brake.
POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_NAMES = {float(state): state.name for state in DriveState}


def powered(drive_state: Vector) -> npt.NDArray[np.bool_]:
    """Return which drives produce torque.

    Args:
        drive_state: values of `DriveState`, shape (12,).

    Returns:
        True for each drive in a state of `POWERED`, shape (12,).
    """
    return np.isin(drive_state, POWERED)


def refusal(robot: Robot, drive_state: Vector, torque: Vector) -> str | None:
    """Return the reason why the drives must not be enabled; None if they may be enabled.

    Args:
        robot: source of the torque limits and of the torque that an idle drive may report.
        drive_state: values of `DriveState`, shape (12,).
        torque: torque reported by each drive, shape (12,) [Nm at the joint].
    """
    idle = robot.thresholds.idle_torque
    on = powered(drive_state)
    allowed = np.where(on, robot.torque_max, 0.0) + idle
    wrong = np.flatnonzero(~(np.abs(torque) <= allowed))  # the negation also rejects NaN
    if not wrong.size:
        return None
    joint = int(wrong[0])
    state = _NAMES.get(float(drive_state[joint]), f"state {drive_state[joint]:g}")
    limit = f"its limit of {robot.torque_max[joint]:.0f} Nm" if on[joint] else f"{idle:g} Nm, it makes no torque"
    return f"the drive of {JOINTS[joint]} reports {torque[joint]:.0f} Nm in {state}; must be within {limit}"
