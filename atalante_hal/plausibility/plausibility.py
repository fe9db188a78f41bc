"""The plausibility checks of one cycle, in the right order and as cheap as they can be.

    process image -> [what stands still | velocity, norms | feet | drift, in turn] -> jump and range -> state

A cycle in which everything is plausible costs one look at the encoders and one at the IMUs; the slow checks take turns. What
fails is put back to the last good value, and its message counts as not received: its age grows.
"""

from __future__ import annotations

from collections.abc import Callable

from atalante_hal.codec import Codec
from atalante_hal.plausibility.encoders import Encoders
from atalante_hal.plausibility.feet import Feet
from atalante_hal.plausibility.finding import (
    FOOT_MESSAGES,
    IMU_MESSAGES,
    JOINT_MESSAGES,
    Ages,
    Finding,
    measured,
    rows_of,
    signals_of,
)
from atalante_hal.plausibility.imus import Imus
from atalante_hal.plausibility.stillness import Stillness
from atalante_hal.robot import Robot, Vector

#: Cycles between two turns of a slow check; the feet get two, the drift of a leg every fourth.
EVERY = 8
#: Older than anything: no value was ever accepted.
_LONG_AGO = 1 << 30


class Plausibility:
    """Judges the decoded values of the HAL's receive image once a cycle.

    Args:
        robot: limits and sensors.
        codec: of the image.
        values: its values, shape (codec.size,): the same array every cycle, corrected in place.
        age: of its rows, shape (rows,): the same array every cycle.
        period: of the cycle [s].

    Attributes:
        findings: what stands; the same object while nothing changes.
        rejected: row -> cycles since its last good value, of the messages that came in this cycle and are not to be used.
    """

    def __init__(self, robot: Robot, codec: Codec, values: Vector, age: Ages, period: float) -> None:
        self._measured = values[measured(codec)]
        self._before = self._measured.copy()
        self._age = age
        now = signals_of(codec, values)
        before = signals_of(codec, self._before)
        self._force = now.force
        self._encoders = Encoders(robot, now, before, period, EVERY)
        self._imus = Imus(robot, codec, now, before)
        self._stillness = Stillness(robot, codec, values, now, age, EVERY)
        self._feet = Feet(robot, now, EVERY // 2)
        self._joint_rows, self._imu_rows, self._foot_rows = (
            rows_of(codec, messages) for messages in (JOINT_MESSAGES, IMU_MESSAGES, FOOT_MESSAGES)
        )
        #: Row -> cycles since its last good value.
        self._since = dict.fromkeys((*self._joint_rows, *self._imu_rows), _LONG_AGO)
        self._settled = False  # the last values of all rows were good
        self._turns = self._build_turns()
        self._cycle = 0
        self.findings: tuple[Finding, ...] = ()
        self.rejected: dict[int, int] = {}

    def _build_turns(self) -> list[Callable[[bool], bool] | None]:
        """Which slow check is made in which cycle: called with `fresh`, returns whether it has something to tell."""
        turns: list[Callable[[bool], bool] | None] = [None] * (4 * EVERY)
        turns[0::EVERY] = [self._stillness.sample] * 4
        turns[2::EVERY] = [self._encoders.judge_velocity] * 4
        turns[4::EVERY] = [self._imus.judge_norms] * 4
        turns[1 :: EVERY // 2] = [self._judge_feet] * 8
        turns[7], turns[7 + 2 * EVERY] = self._imus.judge_left_drift, self._imus.judge_right_drift
        return turns

    def check(self, fresh: bool) -> tuple[Finding, ...]:
        """Judge this cycle; call once, after the image took its frames.

        Args:
            fresh: every row came in this cycle.

        Returns:
            `findings`.
        """
        turn = self._turns[self._cycle]
        self._cycle = (self._cycle + 1) % len(self._turns)
        if turn is not None and (turn(fresh) or self.findings):
            self._collect()
        if not (fresh and self._settled and self._encoders.within_reach() and self._imus.usable()):
            self._judge_rows()
            self._collect()
        if self.findings:
            self._silence_cells()
        self._before[:] = self._measured
        return self.findings

    def _judge_feet(self, _fresh: bool) -> bool:
        left, right = (not self._age[row] for row in self._foot_rows)
        return self._feet.judge((left, right))

    def _judge_rows(self) -> None:
        """Row by row: was it heard, and may it be used."""
        self.rejected = {}
        self._imus.judge_norms(True)
        for joint, row in enumerate(self._joint_rows):
            if not self._age[row]:
                self._conclude(row, self._encoders.accept(joint, self._since[row] + 1))
        for imu, row in enumerate(self._imu_rows):
            if not self._age[row]:
                frozen = imu in self._stillness.imus
                self._conclude(row, self._imus.accept(imu, self._since[row] + 1, frozen=frozen))
        self._since.update((row, since + 1) for row, since in self._since.items() if self._age[row])
        self._settled = not any(self._since.values())

    def _conclude(self, row: int, usable: bool) -> None:
        if usable:
            self._since[row] = 0
        else:
            self._since[row] += 1
            self.rejected[row] = self._since[row]

    def _collect(self) -> None:
        findings = (
            *self._encoders.findings(),
            *self._imus.findings(),
            *self._stillness.findings(),
            *self._feet.findings(),
        )
        if findings != self.findings:
            self.findings = findings
            self._settled = False  # an IMU may be of no use from now on, or of use again

    def _silence_cells(self) -> None:
        """A cell that is stuck carries nothing: what is left of its foot are the others."""
        for cell in (*self._stillness.cells, *self._feet.cells):
            self._force[cell] = 0.0
