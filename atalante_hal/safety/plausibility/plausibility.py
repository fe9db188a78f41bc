"""The plausibility checks of one cycle, in the right order and as cheap as they can be.

    process image -> [what stands still | velocity, norms | feet | legs, in turn] -> jump and range -> state

A cycle in which everything is plausible costs one look at the encoders and one at the IMUs; the slow checks take turns. What
fails is refused: its message keeps the values it had, and ages. Each check runs on the messages it needs, with the ages of
their values: what is wrong with one message switches off no check of another.
"""

from __future__ import annotations

from collections.abc import Callable

from atalante_hal.robot import Robot, Vector
from atalante_hal.safety.plausibility.encoders import Encoders
from atalante_hal.safety.plausibility.feet import Feet
from atalante_hal.safety.plausibility.finding import JOINT_NODES, Ages, Finding, Rows, signals_of
from atalante_hal.safety.plausibility.imus import Imus
from atalante_hal.safety.plausibility.legs import Legs
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.safety.plausibility.unchecked import Unchecked
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Cycles between two turns of what looks for standstill, wrong velocities and checks that cannot run, and of the look at the
#: feet.
SLOW, FEET = 16, 4
#: Cycles after which the turns repeat; each leg gets one.
_ROUND = 32
_FRESH = int(Check.SOME_LOST)


class Plausibility:
    """Judges the decoded values of the HAL's receive image once a cycle.

    Args:
        robot: limits and sensors.
        image: of the sensors' cyclic messages; what cannot be true is refused there.
        period: of the cycle [s].

    Attributes:
        findings: what stands; the same object while nothing changes.
    """

    def __init__(self, robot: Robot, image: ReceiveImage, period: float) -> None:
        self._image = image
        codec = image.codec
        now = signals_of(codec, image.values)
        self._force = now.force
        self._encoders = Encoders(robot, now, signals_of(codec, image.values_before), period, SLOW)
        self._imus = Imus(robot, codec, now)
        self._stillness = Stillness(robot, image, now, SLOW)
        self._legs = Legs(robot, now, self._stillness.standing, period)
        self._feet = Feet(robot, now, FEET)
        self._rows = Rows(codec)
        self._unchecked = Unchecked(self._rows, image.check, SLOW)
        self._joint_rows, self._imu_rows = self._rows.joint.tolist(), self._rows.imu.tolist()
        self._foot_ages = [NEVER] * len(self._rows.foot)  # of the values the feet were judged by, when they were
        #: Row -> cycle in which its last good values were measured; up to date while not settled.
        self._measured = dict.fromkeys((*self._joint_rows, *self._imu_rows), -NEVER)
        #: Silenced cells, (foot, cell) -> what was measured [N], shape (3,).
        self._silenced: dict[tuple[int, int], Vector] = {}
        self._settled = False  # the last values of all rows were good, and of the cycle they came in
        self._turns = self._build_turns()
        self._cycle = 0
        self.findings: tuple[Finding, ...]
        #: What stood when the rows were judged last: where that changes, an IMU is of no use from now on, or of use again.
        self._judged: tuple[Finding, ...]
        self.findings = self._judged = ()

    def _build_turns(self) -> list[Callable[[Ages | None], bool] | None]:
        """Return which slow check is made in which cycle.

        Each is called with the ages of the values, None if all are of this cycle, and returns whether something stands.
        """
        turns: list[Callable[[Ages | None], bool] | None] = [None] * _ROUND
        turns[0::SLOW] = [self._sample] * (_ROUND // SLOW)
        turns[2::SLOW] = [self._judge_velocity] * (_ROUND // SLOW)
        turns[4::SLOW] = [self._judge_unchecked] * (_ROUND // SLOW)
        turns[1::FEET] = [self._judge_feet] * (_ROUND // FEET)
        turns[8], turns[24] = self._legs.judge_left, self._legs.judge_right
        return turns

    def check(self) -> tuple[Finding, ...]:
        """Judge this cycle; call once, after the image took its frames.

        Returns:
            `findings`.
        """
        fresh = self._image.all_fresh
        if self._silenced:
            self._restore_cells()
        turn = self._turns[self._cycle % _ROUND]
        if turn is not None and (turn(None if fresh else self._rows.ages(self._image.age)) or self.findings):
            self._collect()
        settled = fresh and self._settled and self.findings is self._judged
        if not (settled and self._encoders.within_reach() and self._imus.usable()):
            self._judged = self.findings
            self._judge_rows()
            self._collect()
        if self.findings:
            self._silence_cells()
        self._cycle += 1
        return self.findings

    def reference(self, node: str) -> None:
        """Take the next position of a joint as its first one: its drive has restarted and referenced its encoder.

        Args:
            node: DBC name; of a node that is no drive nothing changes.
        """
        if node not in JOINT_NODES:
            return
        if self._settled:
            self._measured.update(dict.fromkeys(self._measured, self._cycle - 1))
            self._settled = False
        joint = JOINT_NODES.index(node)
        self._encoders.reference(joint)
        self._measured[self._joint_rows[joint]] = -NEVER

    @property
    def swing(self) -> int | None:
        """Leg that swings while the other one stands, by its place in FEET; None: none does."""
        return self._feet.swing

    def _sample(self, ages: Ages | None) -> bool:
        return self._stillness.sample(ages is None)

    def _judge_velocity(self, ages: Ages | None) -> bool:
        return self._encoders.judge_velocity(None if ages is None else ages.joint)

    def _judge_unchecked(self, ages: Ages | None) -> bool:
        return self._unchecked.judge(None if ages is None else self._image.age)

    def _judge_feet(self, ages: Ages | None) -> bool:
        now = [0] * len(self._foot_ages) if ages is None else ages.foot.tolist()
        # A foot whose values are those it was judged by before is not judged by them again.
        left, right = (age < before + FEET for age, before in zip(now, self._foot_ages, strict=True))
        self._foot_ages = now
        return self._feet.judge((left, right))

    def _judge_rows(self) -> None:
        """Row by row: was it heard, and may it be used."""
        measured, cycle, image = self._measured, self._cycle, self._image
        if self._settled:
            measured.update(dict.fromkeys(measured, cycle - 1))
        checks, ages = image.check.tolist(), image.age.tolist()
        for sensor, row in enumerate((*self._joint_rows, *self._imu_rows)):
            if checks[row] > _FRESH:
                continue
            at = cycle - ages[row]
            if self._accept(sensor, at - measured[row]):
                measured[row] = at
            else:
                image.refuse(row)
        self._settled = all(at == cycle for at in measured.values())

    def _accept(self, sensor: int, cycles: int) -> bool:
        """Whether the new values of a joint, or after the joints of an IMU, may be used."""
        imu = sensor - len(self._joint_rows)
        if imu < 0:
            return self._encoders.accept(sensor, cycles)
        return self._imus.accept(imu, cycles, frozen=imu in self._stillness.imus)

    def _collect(self) -> None:
        findings = (
            *self._encoders.findings(),
            *self._imus.findings(),
            *self._legs.findings(),
            *self._stillness.findings(),
            *self._feet.findings(),
            *self._unchecked.findings(),
        )
        if findings != self.findings:
            self.findings = findings

    def _silence_cells(self) -> None:
        """A cell that is stuck carries nothing: what is left of its foot are the others."""
        for cell in {*self._stillness.cells, *self._feet.cells}:
            self._silenced[cell] = self._force[cell].copy()
            self._force[cell] = 0.0

    def _restore_cells(self) -> None:
        """Undo `_silence_cells` where no new values came: the checks judge what was measured."""
        for (foot, cell), force in self._silenced.items():
            if self._image.check[self._rows.foot[foot]] > _FRESH:
                self._force[foot, cell] = force
        self._silenced.clear()
