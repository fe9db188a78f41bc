"""Encoders against physics: a joint moves no further than it can, and turns as fast as it says.

*Jump.* Between two good values, n cycles apart, a joint moves at most n * velocity_max * period, give or take 3 sigma of the
encoder. What moved further is not used. After `JUMPS_TO_CONFIRM` of these on end the encoder has lost its reference: it is used
again when it jumps back by as much, the joint's motion meanwhile counted, or when its drive has restarted, see `reference`.

*Range.* A joint is within its position limits, give or take `position_tolerance`.

*Velocity.* The mean of the reported velocity between two samples, by the trapezoidal rule, is the way the encoder made; the
drive's low-pass puts them apart for a few cycles, not for fifty. A sample of a joint counts from the cycle it was measured in,
so that a late or lost frame changes the interval and not the verdict.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, Robot, Vector
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import JOINT_NODES, Cycles, Finding, Signals
from atalante_hal.wire.process_image import NEVER

#: Jumps on end, without a good value between them, that are no stray any more.
JUMPS_TO_CONFIRM = 5
#: Comparisons on end in which the velocity has to be wrong.
VELOCITY_SAMPLES = 3
_ALL = b"\1" * len(JOINTS)


class Lost(NamedTuple):
    """An encoder that jumped, motor side."""

    last: float  # rad, position received last
    cycles: int  # from the last good position to that
    expected: float  # rad, where the joint would be without the jump


class Encoders:
    """The twelve encoders.

    Args:
        now: what was decoded in this cycle.
        before: the last good values.
        period: of the cycle [s].
        every: cycles between two calls of `judge_velocity`.
    """

    def __init__(self, robot: Robot, now: Signals, before: Signals, period: float, every: int) -> None:
        self._now, self._before = now, before
        self._way = robot.velocity_max * robot.gear * period
        self._noise = 3.0 * robot.encoder_noise * robot.gear
        self._reach = self._way + self._noise
        self.jumps = [0] * len(JOINTS)
        self._jump_of: dict[int, float] = {}  # size of the last one
        self._lost: dict[int, Lost] = {}
        #: Joints out of their range: number -> position [rad].
        self.outside: dict[int, float] = {}
        self._range = np.array([robot.position_min, robot.position_max])
        tolerance = robot.thresholds.position_tolerance
        self._low, self._high = np.sort(
            np.array([robot.position_min - tolerance, robot.position_max + tolerance]) * robot.gear * robot.polarity,
            axis=0,
        )
        self._polarity = robot.polarity.tolist()
        self._period, self._every = period, every
        # Twice the mean velocity of two samples less twice the way between them: the share of the later and of the earlier one.
        time = every * period
        self._of_later, self._of_earlier = np.array([[-2.0 / time, 1.0], [2.0 / time, 1.0]])
        self._earlier = np.zeros((2, len(JOINTS)))  # position and velocity of the last sample
        self._no_age = np.zeros(len(JOINTS), np.int64)
        self._earlier_age: Cycles = np.full(len(JOINTS), NEVER)  # of the last sample when it was taken
        self._twice_allowed = 2.0 * robot.sensors.velocity_error * robot.gear
        self._wrong = [0] * len(JOINTS)
        self._wrong_findings: tuple[Finding, ...] = ()
        self._gear = robot.gear.tolist()
        self._within_reach = compiled(within_reach)
        self.within_reach()  # is compiled now, not in a cycle

    def within_reach(self) -> bool:
        """Whether every joint is where it can have moved to in one cycle, and in its range."""
        ranges = self._low, self._high
        return not self.outside and self._within_reach(self._now.position, self._before.position, self._reach, *ranges)

    def accept(self, joint: int, cycles: int) -> bool:
        """Whether the new value of one joint may be used.

        Args:
            cycles: from the last good one to this.
        """
        now, before = float(self._now.position[joint]), float(self._before.position[joint])
        way, noise = float(self._way[joint]), float(self._noise[joint])
        confirmed = self.jumps[joint] >= JUMPS_TO_CONFIRM
        moved = abs(now - before)
        good = not confirmed and not moved > cycles * way + noise  # NaN: there was no value before
        if not good:
            lost = self._lost[joint] = followed(self._lost.get(joint, Lost(before, 0, before)), now, cycles, way, noise)
            if confirmed:
                moved = abs(now - lost.expected)
                good = moved <= JUMPS_TO_CONFIRM * way + noise
        if good:
            self.reference(joint)
            self._judge_range(joint, now)
            return True
        self.jumps[joint] += 1
        self._jump_of[joint] = moved / self._gear[joint]
        return False

    def reference(self, joint: int) -> None:
        """Trust the encoder of a joint again: its values count from the next one on."""
        self.jumps[joint] = 0
        self._lost.pop(joint, None)

    def _judge_range(self, joint: int, position: float) -> None:
        if self._low[joint] <= position <= self._high[joint]:
            self.outside.pop(joint, None)
        else:
            self.outside[joint] = position * self._polarity[joint] / self._gear[joint]

    def judge_velocity(self, age: Cycles | None) -> bool:
        """Compare velocity and encoder over the last `every` cycles.

        Args:
            age: of each joint's values [cycles], shape (12,); from `NEVER` on: too old, and this joint is not compared. None:
                all are of this cycle.

        Returns:
            Whether a velocity is wrong.
        """
        motion, earlier, earlier_age = self._now.motion, self._earlier, self._earlier_age
        if age is None and earlier_age is self._no_age:
            error = self._of_later.dot(motion) + self._of_earlier.dot(earlier)
            compared = None
        else:
            error, compared = self._error_between(self._no_age if age is None else age)
        right = np.abs(error) <= self._twice_allowed
        if right.tobytes() != _ALL or any(self._wrong):
            self._count_wrong(error.tolist(), right.tolist(), compared)
        earlier[:] = motion
        self._earlier_age = self._no_age if age is None else age
        return bool(self._wrong_findings)

    def _error_between(self, age: Cycles) -> tuple[Vector, list[bool]]:
        """Return twice the error of each velocity, 0 of joints not compared, and which joints are compared. Shape (12,)."""
        motion, earlier = self._now.motion, self._earlier
        cycles = self._every + self._earlier_age - age
        compared = (age < NEVER) & (self._earlier_age < NEVER) & (cycles > 0)
        time = np.where(compared, cycles, 1) * self._period
        error = motion[1] + earlier[1] - 2.0 * (motion[0] - earlier[0]) / time
        return np.where(compared, error, 0.0), compared.tolist()

    def _count_wrong(self, error: list[float], right: list[bool], compared: list[bool] | None) -> None:
        """Count the comparisons on end in which a velocity was wrong; a joint that was not `compared` keeps its count."""
        self._wrong = [
            wrong if compared is not None and not compared[joint] else 0 if right[joint] else wrong + 1
            for joint, wrong in enumerate(self._wrong)
        ]
        found = {finding.node: finding for finding in self._wrong_findings}
        self._wrong_findings = tuple(
            self._wrong_velocity(joint, 0.5 * error[joint])
            if compared is None or compared[joint]
            else found[JOINT_NODES[joint]]
            for joint, wrong in enumerate(self._wrong)
            if wrong >= VELOCITY_SAMPLES
        )

    def findings(self) -> tuple[Finding, ...]:
        """What stands."""
        if not (self.outside or any(self.jumps)):
            return self._wrong_findings
        jumps = (self._jump(joint) for joint, jumps in enumerate(self.jumps) if jumps)
        return (*jumps, *map(self._outside, self.outside), *self._wrong_findings)

    def _jump(self, joint: int) -> Finding:
        size, confirmed = self._jump_of[joint], self.jumps[joint] >= JUMPS_TO_CONFIRM
        text = f"the encoder of {JOINTS[joint]} jumped by {np.degrees(size):.2f} degrees, which the joint cannot"
        if confirmed:
            text += "; it is not used until it jumps back or its drive restarts"
        return Finding(Dtc.ENC_JUMP, JOINT_NODES[joint], size, confirmed, text)

    def _outside(self, joint: int) -> Finding:
        angle = self.outside[joint]
        low, high = np.degrees(self._range[:, joint])
        text = (
            f"{JOINTS[joint]} is at {np.degrees(angle):.1f} degrees, outside its range of {low:.1f} to {high:.1f} degrees; "
            "move it back by hand with the drives off, or reference its encoder"
        )
        return Finding(Dtc.POSITION_RANGE, JOINT_NODES[joint], angle, True, text)

    def _wrong_velocity(self, joint: int, error: float) -> Finding:
        at_joint = error / self._gear[joint]
        text = f"the velocity of {JOINTS[joint]} is {np.degrees(at_joint):+.0f} deg/s off what its encoder does"
        return Finding(Dtc.ENC_VELOCITY, JOINT_NODES[joint], at_joint, True, text)


def followed(lost: Lost, now: float, cycles: int, way: float, noise: float) -> Lost:
    """Return where a joint is expected whose encoder jumped: what its encoder moves by without a jump is motion.

    Args:
        lost: what was known before.
        now: position received.
        cycles: from the last good position to this one.
        way: most a joint moves in a cycle.
        noise: of the encoder; in the unit of the positions, as all but `cycles`.
    """
    step = now - lost.last
    jumped = abs(step) > (cycles - lost.cycles) * way + noise
    return Lost(now, cycles, lost.expected if jumped else lost.expected + step)


def within_reach(position: Vector, before: Vector, reach: Vector, low: Vector, high: Vector) -> bool:
    """Whether no joint has moved by more than its reach, and none is below `low` or above `high`. Shapes (12,), motor side."""
    for joint in range(len(reach)):
        moved = abs(position[joint] - before[joint])
        if moved > reach[joint] or position[joint] < low[joint] or position[joint] > high[joint]:
            return False
    return True
