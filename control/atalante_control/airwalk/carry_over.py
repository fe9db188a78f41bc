"""Carry-over: a torque added to the command after a stance change, so that the command does not jump.

`torque before the stance change, torque of the new control law -> continuous torque`

Example: the torque is 10 Nm before the stance change, and the new control law computes 14 Nm. The controller adds -4 Nm in the
first cycle. The added torque then fades out to 0 Nm. If the added torque of a joint is limited to 3 Nm, the controller adds
-3 Nm, and the command jumps by 1 Nm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from atalante_control.structured import Records, zeros
from atalante_hal.robot import JOINTS
from atalante_hal.types import PERIOD, Vector


class Carry:
    """State of the carry-over: torque before the stance change, and torque to add after the stance change."""

    pending: bool  # true until the first torque after the stance change is computed
    before: Annotated[Vector, len(JOINTS)]  # Nm, torque before the stance change
    #: Nm, largest absolute value of `carried`; infinity for a joint without a guide
    limit: Annotated[Vector, len(JOINTS)]
    #: Nm, torque jump at the stance change: `before` minus the computed torque of the first cycle
    jump: Annotated[Vector, len(JOINTS)]
    #: Nm, torque to add in the first cycle after the stance change: `jump`, clipped to -`limit` and `limit`
    carried: Annotated[Vector, len(JOINTS)]


class CarryOver:
    """Carry-over: after a stance change, adds a torque that fades out, so that the torque command does not jump.

    The added torque of a joint with a guide is limited, so a large jump remains in part.

    Attributes:
        records: record that `add_carried` reads and updates, shape (1,).
        guided_blend: fade-out of the added torque of a joint with a guide, shape (n,). Element i is the fraction of
            `Carry.carried` that is added in cycle i after the stance change. The fraction falls from 1 towards 0.
        blends: fade-out of the added torques, shape (2, m). Row 0: joints without a guide. Row 1: joints with a guide.
    """

    def __init__(self, duration: float, guided_duration: float) -> None:
        """Compute the fade-outs, and create the record of the state.

        Args:
            duration: time in which the added torque of a joint without a guide fades out [s]. With 0, no torque is added, and
                the command can jump.
            guided_duration: the same for a joint with a guide [s].
        """
        free, self.guided_blend = _fade_out(duration), _fade_out(guided_duration)
        self.blends: Vector = np.zeros((2, max(len(free), len(self.guided_blend))))
        self.blends[0, : len(free)], self.blends[1, : len(self.guided_blend)] = free, self.guided_blend
        self.records: Records[Carry] = zeros(Carry, 1)
        self.limit((), ())

    @property
    def pending(self) -> bool:
        """Return whether the next call of `add_carried` computes a new added torque."""
        return bool(self.records[0].pending)

    def start(self, before: Vector) -> None:
        """Start a carry-over, at a stance change or at the start of the motion.

        Args:
            before: torque before the stance change, shape (12,) [Nm]; copied.
        """
        carry = self.records[0]
        carry.before[:], carry.pending = before, True

    def limit(self, joints: Sequence[int], largest: Sequence[float]) -> None:
        """Limit the added torques of the joints with a guide. The added torques of all other joints are not limited.

        Args:
            joints: indices of the joints with a guide in JOINTS.
            largest: largest absolute value of the added torque of each of these joints [Nm].
        """
        limit = self.records[0].limit
        limit[:] = math.inf
        for joint, torque in zip(joints, largest, strict=True):
            limit[joint] = torque

    def cancel(self) -> None:
        """Cancel the carry-over of the last call of `start`, if `add_carried` has not been called after this call.

        If the added torque already fades out, it continues to fade out.
        """
        self.records[0].pending = False


def _fade_out(duration: float) -> Vector:
    """Return the fade-out of an added torque, shape (n,), for a duration [s]."""
    cycles = round(duration / PERIOD)
    fading: Vector = 0.5 + 0.5 * np.cos(math.pi * np.arange(cycles) / max(1, cycles))
    return fading


def add_carried(carries: Records[Carry], blends: Vector, cycle: int, torque: Vector) -> None:
    """Add a torque to the torque command, so that the command does not jump at a stance change.

    The first call after a stance change computes the added torque: torque before the stance change minus `torque`, limited to
    `Carry.limit`. In later calls, the added torque fades out.

    Args:
        carries: `CarryOver.records`; `pending` is set to False.
        blends: `CarryOver.blends`.
        cycle: number of cycles since the stance change.
        torque: torque command, shape (12,) [Nm], updated.
    """
    carry = carries[0]
    if carry.pending:
        for joint in range(len(torque)):
            jump, limit = carry.before[joint] - torque[joint], carry.limit[joint]
            carry.jump[joint] = jump
            carry.carried[joint] = min(max(jump, -limit), limit)
        carry.pending = False
    if cycle < blends.shape[1]:
        for joint in range(len(torque)):
            guided = 1 if carry.limit[joint] < math.inf else 0
            torque[joint] += carry.carried[joint] * blends[guided, cycle]
