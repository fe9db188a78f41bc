"""Check whether the guides cover the additional delay of the control loop: `delay at START, ages -> late or not`.

The certificate of a guide covers a loop with one more cycle of delay than normal (`prediction.DELAYS`). With more delay, the
backup policy may oscillate. So a step starts without a guide, or its guide ends early, and the patient gets full assistance.
"""

from __future__ import annotations

from typing import Final

from atalante_control.guide.prediction import DELAYS
from atalante_hal.robot import JOINTS, SIDES
from atalante_hal.types import State

#: Largest additional delay that the certificate of a guide covers [cycles].
COVERED: Final = DELAYS[1] - DELAYS[0]
#: Number of consecutive cycles with a delay above `COVERED` after which the fault is confirmed. A single lost frame is no
#: fault, although the controller then uses old data for one cycle. The HAL tolerates the loss of up to a fifth of the frames.
_CONFIRM: Final = 5
# Indices in JOINTS of the joints with a guide: sagittal hip and knee of both legs.
_LEFT_SH, _LEFT_SK, _RIGHT_SH, _RIGHT_SK = (JOINTS.index(f"{side}_{joint}") for side in SIDES for joint in ("SH", "SK"))


class LoopDelay:
    """Additional delay from the measurement of a guided joint to its torque.

    It is the sum of the delay that the HAL measured at START (`State.delay`) and of the ages of the data. The delay at START
    already contains the ages at START.
    """

    def __init__(self) -> None:
        self._at_start = 0  # additional delay at START minus the largest age of the data at START [cycles]
        self._uncovered = 0  # number of consecutive cycles with an uncovered delay

    def reset(self, state: State) -> None:
        """Store the delay that was measured at START.

        Args:
            state: measured state of the robot after START.
        """
        self._at_start = max(0, state.delay - _oldest(state))
        self._uncovered = 0 if self.is_covered(state) else _CONFIRM

    def is_covered(self, state: State) -> bool:
        """Return whether the certificate of a guide covers the delay of this cycle.

        Args:
            state: measured state of the robot.
        """
        return self._at_start + _oldest(state) <= COVERED

    def update(self, state: State) -> bool:
        """Count one cycle, and return `confirmed`.

        Call this in every cycle, also without a guide. Otherwise the counted cycles would not be consecutive.

        Args:
            state: measured state of the robot.
        """
        self._uncovered = 0 if self.is_covered(state) else self._uncovered + 1
        return self.confirmed

    @property
    def confirmed(self) -> bool:
        """Return whether the delay has exceeded `COVERED` in the last `_CONFIRM` cycles, or at START and in all cycles since."""
        return self._uncovered >= _CONFIRM


def _oldest(state: State) -> int:
    """Return the largest age of the data of the guided joints [cycles]; 0 if the ages are unknown."""
    rows, age = state.joint_rows, state.age.item
    if not rows:
        return 0
    return max(age(rows[_LEFT_SH]), age(rows[_LEFT_SK]), age(rows[_RIGHT_SH]), age(rows[_RIGHT_SK]))
