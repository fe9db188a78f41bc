"""Standstill checks, which detect stuck encoders, frozen gyros and frozen force cells: their readings stay exactly constant.

All signals are sampled every few cycles, and consecutive samples with exactly the same value are counted. A signal is
skipped if its value is not newer than its value in the last sample.

The reading of an encoder may be constant because the joint is at rest. An encoder is stuck only under two conditions. First, the
torque of the drive has varied by at least `breakaway` since the reading last changed; this is more than twice the dry friction of
the joint. Second, the joint is not at its end stop, which holds it against any torque. A stuck encoder of a joint without torque
is not detected here until the joint is driven. The module `legs` detects some of these encoders with the IMUs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.finding import (
    FOOT_NODES,
    IMU_NODES,
    JOINT_NODES,
    Cycles,
    Signals,
    measured,
)
from atalante_hal.types import Vector
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Longest time from the first repeated reading of an encoder to its detection as stuck [cycles].
STUCK_CYCLES = 50
#: Longest time from the first repeated reading of a gyro or force cell to its detection as frozen [cycles].
FROZEN_CYCLES = 100
#: A joint counts as being at its end stop if it is closer than this distance to a position limit [rad].
_AT_STOP = 0.005
_NEVER = 1 << 30


class Stillness:
    """Standstill checks of encoders, gyros and force cells.

    Args:
        robot: limits and friction of the robot.
        image: process image whose decoded values are sampled.
        now: views of the measured signals in these values.
        every: interval between two calls of `sample` [cycles].
    """

    def __init__(self, robot: Robot, image: ReceiveImage, now: Signals, every: int) -> None:
        codec = image.codec
        where = measured(codec)
        self._values, self._now, self._age = image.values[where], now, image.age
        self._every = every
        #: Age of the values that were last sampled, for each row [cycles], shape (rows,).
        self._sampled_age: Cycles = np.full(len(image.age), 2 * NEVER)
        self._row_of = codec.row_of[where]
        size = len(self._values)
        self._sampled = np.full(size, np.nan)
        self._same = np.empty(size, np.bool_)
        self._repeats = np.full(size, 0)
        # Round the limits down, because the first sample of a standstill may be up to `every` - 1 cycles late.
        limit = np.full(size, _NEVER)
        limit[codec.slice("Position")] = self._to_stuck = (STUCK_CYCLES - every + 1) // every
        limit[codec.slice("Gyro")] = limit[codec.slice("Force")] = to_freeze = (FROZEN_CYCLES - every + 1) // every
        self._to_freeze = to_freeze
        self._limit = limit
        self._none_over = bytes(size)
        #: Number of consecutive samples with a constant reading, for each encoder, shape (12,).
        self.constant_samples: npt.NDArray[np.int64]
        self.constant_samples, self._gyros, self._cells = (
            self._repeats[codec.slice(quantity)] for quantity in ("Position", "Gyro", "Force")
        )
        self._encoders_same, self._no_encoder = self._same[codec.slice("Position")], bytes(len(JOINTS))
        self._sampled_torque = self._sampled[codec.slice("Torque")]
        self._torque_low, self._torque_high = np.zeros((2, len(JOINTS)))
        self._breakaway = robot.breakaway
        self._to_joint: Vector = robot.polarity / robot.gear
        self._low_stop, self._high_stop = robot.position_min + _AT_STOP, robot.position_max - _AT_STOP
        #: Indices of the joints with a stuck encoder.
        self.encoders: list[int] = []
        #: Indices of the IMUs with a frozen gyro.
        self.imus: list[int] = []
        #: (foot, cell) of each frozen force cell.
        self.cells: list[tuple[int, int]] = []

    def sample(self, whole: bool) -> bool:
        """Take a sample of all signals and compare it with the previous sample.

        Args:
            whole: True if the values of all rows are of this cycle. If False, the ages in the process image are used.

        Returns:
            Whether any signal has been constant for too long. For an encoder this alone is not a finding yet.
        """
        same, repeats = self._same, self._repeats
        np.equal(self._values, self._sampled, same)
        newer = None if whole else self._newer()
        if newer is None:
            repeats += 1
            repeats *= same
            self._sampled_age.fill(0)
        else:
            np.copyto(repeats, (repeats + 1) * same, where=newer)
        if self._encoders_same.tobytes() != self._no_encoder:
            self._follow_torque()
        if newer is None:
            self._sampled[:] = self._values
        else:
            np.copyto(self._sampled, self._values, where=newer)
        over: bool = (repeats >= self._limit).tobytes() != self._none_over
        if over or self.encoders or self.imus or self.cells:
            self._judge()
        return over

    def _newer(self) -> npt.NDArray[np.bool_]:
        """Return for each signal whether its value is newer than the sampled value, and update the ages of the sampled values."""
        self._sampled_age += self._every
        newer = self._age < self._sampled_age
        np.copyto(self._sampled_age, self._age, where=newer)
        return newer[self._row_of]

    def _follow_torque(self) -> None:
        """Update the torque range of each joint since the last change of its encoder reading."""
        first = self.constant_samples == 1
        torque = self._now.torque
        low = np.where(first, self._sampled_torque, self._torque_low)
        high = np.where(first, self._sampled_torque, self._torque_high)
        np.minimum(low, torque, out=self._torque_low)
        np.maximum(high, torque, out=self._torque_high)

    def _judge(self) -> None:
        angle = self._now.position * self._to_joint
        pushed = self._torque_high - self._torque_low >= self._breakaway
        free = (angle > self._low_stop) & (angle < self._high_stop)
        self.encoders = np.flatnonzero((self.constant_samples >= self._to_stuck) & pushed & free).tolist()
        frozen = (self._gyros.reshape(len(IMUS), 3) >= self._to_freeze).all(axis=1)
        self.imus = np.flatnonzero(frozen).tolist()
        dead = (self._cells.reshape(len(FEET), len(CELLS), 3) >= self._to_freeze).any(axis=2)
        self.cells = [(foot, cell) for foot, cell in np.argwhere(dead).tolist()]

    def findings(self) -> tuple[Finding, ...]:
        """Return the present findings."""
        return (
            *map(self._stuck, self.encoders),
            *map(_frozen_imu, self.imus),
            *(_frozen_cell(foot, cell, float(self._now.force[foot, cell, 2])) for foot, cell in self.cells),
        )

    def _stuck(self, joint: int) -> Finding:
        swing = float(self._torque_high[joint] - self._torque_low[joint])
        text = f"the encoder of {JOINTS[joint]} has a constant reading while the torque varies by {swing:.0f} Nm"
        return Finding(Dtc.ENC_STUCK, JOINT_NODES[joint], swing, True, text)


def _frozen_imu(imu: int) -> Finding:
    text = f"the gyro of the {IMUS[imu]} IMU has had a constant reading for {FROZEN_CYCLES} cycles"
    return Finding(Dtc.IMU_STUCK, IMU_NODES[imu], float(FROZEN_CYCLES), True, text)


def _frozen_cell(foot: int, cell: int, force: float) -> Finding:
    text = f"force cell {CELLS[cell]} of the {FEET[foot]} foot has a constant reading of {force:.0f} N"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], force, True, text)
