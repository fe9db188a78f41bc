"""Check that each drive produces the torque that the HAL sends: `torques sent, torques reported -> findings`.

A drive that stays in OPERATION ENABLED may still produce a wrong torque, for example because its power stage is off, its phases
are exchanged, or its current is wrong. If the drive measures its torque correctly, the reported torque shows the fault. The drive
state does not show the fault.

*Range.* A drive follows a command within two milliseconds. If commands are lost, the drive repeats the last command for up to
four cycles. The frame of the drive may be late by four cycles. So a reported torque must lie in the range of the torques sent in
the last `SPAN` cycles. If the torque limit falls, the drive may limit the torque at once, but the HAL reduces the torque at the
torque rate. The range then includes the torque limit. A torque may be outside the range by `TOLERANCE` times the breakaway
torque of the joint. This tolerance is less than half of the dry friction of the joint.

*Limits of the check.* A drive that reports the torque of its command but produces another torque passes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.types import Vector

#: Longest time from sending a torque to the report of this torque by the drive [cycles].
#: The time is 4 cycles without faults, plus 4 cycles if commands are lost, plus 4 cycles if the frame of the drive is late.
#: Without faults, the drive applies a command one cycle after the HAL sent it. The torque follows within two more cycles, and
#: the drive reports it in the next cycle.
SPAN: Final = 12
#: Tolerance of a reported torque, as a fraction of the breakaway torque of the joint.
#: The reported torque may be below the smallest or above the largest of the last sent torques by the tolerance.
TOLERANCE: Final = 0.2
#: Number of consecutive cycles with a wrong torque after which a drive is reported.
CONFIRM: Final = 5


class Tracking(NamedTuple):
    """State of the check: the sent torques, and a counter of wrong torques for each drive."""

    sent: Vector  # (SPAN, 12) Nm, torques sent in the last cycles; the oldest is overwritten
    cycles: npt.NDArray[np.int64]  # (1,) number of cycles since the restart of the check
    wrong: npt.NDArray[np.int64]  # (12,) number of consecutive cycles with a wrong torque


def _compare(sent: Vector, limit: Vector, reported: Vector, tolerance: Vector, tracking: Tracking) -> bool:
    """Compare the reported torques of one cycle with the sent torques, and return whether a drive does not follow its command.

    Args:
        sent: torques sent in the last cycle, shape (12,) [Nm].
        limit: torque limits of the drives, shape (12,) [Nm].
        reported: reported torques, shape (12,) [Nm].
        tolerance: torque by which a reported torque may lie outside the range of the sent torques, shape (12,) [Nm].
        tracking: state of the check. Updated here.
    """
    row = tracking.cycles[0] % SPAN
    tracking.cycles[0] += 1
    complete, deviates = tracking.cycles[0] >= SPAN, False
    for i in range(len(sent)):
        tracking.sent[row, i] = sent[i]
        low = high = sent[i]
        for past in range(SPAN):
            low, high = min(low, tracking.sent[past, i]), max(high, tracking.sent[past, i])
        low, high = min(low, limit[i]) - tolerance[i], max(high, -limit[i]) + tolerance[i]
        within = low <= reported[i] <= high
        tracking.wrong[i] = tracking.wrong[i] + 1 if complete and not within else 0
        deviates |= tracking.wrong[i] >= CONFIRM
    return bool(deviates)


class TorqueTracking:
    """Check that each drive reports the torque that the HAL sends.

    The check runs only while the controller drives the joints.

    Attributes:
        tolerance: torque by which a reported torque may lie outside the range of the sent torques, shape (12,) [Nm].

    Args:
        breakaway: breakaway torques of the joints, shape (12,) [Nm].
    """

    def __init__(self, breakaway: Vector) -> None:
        self.tolerance = TOLERANCE * breakaway
        self._tracking = Tracking(np.zeros((SPAN, len(JOINTS))), np.zeros(1, np.int64), np.zeros(len(JOINTS), np.int64))
        zero = np.zeros(len(JOINTS))
        self._compare = specialised(_compare, zero, zero, zero, self.tolerance, self._tracking)
        self.restart()

    def restart(self) -> None:
        """Discard all stored torques. Call this when the controller stops driving the joints."""
        for record in self._tracking:
            record[:] = 0

    def check(self, sent: Vector, limit: Vector, reported: Vector) -> tuple[Finding, ...]:
        """Compare the torques of one cycle, and return one finding for each drive that does not follow its command.

        Args:
            sent: torques sent in the last cycle, shape (12,) [Nm].
            limit: torque limits of the drives, shape (12,) [Nm].
            reported: torques reported in this cycle, shape (12,) [Nm].
        """
        if not self._compare(sent, limit, reported, self.tolerance, self._tracking):
            return ()
        return tuple(
            Finding(
                Dtc.TORQUE_TRACKING, JOINT_NODES[joint], float(reported[joint]), True,
                f"the drive of {JOINTS[joint]} must follow the torque command of {sent[joint]:.1f} Nm, "
                f"got a reported torque of {reported[joint]:.1f} Nm",
            )
            for joint, cycles in enumerate(self._tracking.wrong.tolist())
            if cycles >= CONFIRM
        )  # fmt: skip
