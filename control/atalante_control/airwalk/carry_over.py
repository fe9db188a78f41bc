"""Carry-over of the torque at a stance change: the torque jump is compensated, and the compensation fades out.

`torque before the stance change, torque of the new control law -> continuous torque`
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from atalante_control.gait.gait import PERIOD
from atalante_control.structured import Records, zeros
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector


class Carry:
    """State of the carry-over of the torque: torque before the stance change, and torque jump to compensate."""

    pending: bool  # true until the first torque after the stance change is computed
    before: Annotated[Vector, len(JOINTS)]  # Nm, torque before the stance change
    #: Nm, torque before the stance change minus first torque after the stance change
    carried: Annotated[Vector, len(JOINTS)]


class CarryOver:
    """Carry-over of the torque, which keeps the command continuous at a stance change.

    Attributes:
        records: record that `add_carried` reads and updates, shape (1,).
        blend: fade-out of the compensation, shape (n,). Element i is the share of the torque jump that is compensated in
            cycle i after the stance change. The share falls from 1 towards 0.
    """

    def __init__(self, duration: float) -> None:
        """Compute the fade-out `blend`, and create the record of the state.

        Args:
            duration: time in which the compensation of the torque jump fades out [s]. With 0, the jump is not compensated.
        """
        cycles = round(duration / PERIOD)
        self.blend: Vector = 0.5 + 0.5 * np.cos(math.pi * np.arange(cycles) / max(1, cycles))
        self.records: Records[Carry] = zeros(Carry, 1)

    @property
    def pending(self) -> bool:
        """Return whether a carry-over has started but the first torque after the stance change is not computed yet."""
        return bool(self.records[0].pending)

    def start(self, before: Vector) -> None:
        """Start the carry-over of the torque, at a stance change or at the start of the motion.

        Args:
            before: torque before the stance change, shape (12,) [Nm]; copied.
        """
        carry = self.records[0]
        carry.before[:], carry.pending = before, True

    def cancel(self) -> None:
        """Cancel a carry-over that was started but not applied yet. A fade-out that has begun does not change."""
        self.records[0].pending = False


def add_carried(carries: Records[Carry], blend: Vector, cycle: int, torque: Vector) -> None:
    """Add the opposite of the torque jump at the stance change to the torque command, so that the command does not jump.

    The first call after a stance change computes the added torque. In later calls, the added torque fades out.

    Args:
        carries: `CarryOver.records`; `pending` is set to False.
        blend: `CarryOver.blend`.
        cycle: number of cycles since the stance change.
        torque: torque command, shape (12,) [Nm], updated.
    """
    carry = carries[0]
    if carry.pending:
        for joint in range(len(torque)):
            carry.carried[joint] = carry.before[joint] - torque[joint]
        carry.pending = False
    if cycle < len(blend):
        for joint in range(len(torque)):
            torque[joint] += carry.carried[joint] * blend[cycle]
