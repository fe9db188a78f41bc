"""Encoder checks, which compare each position with the previous position, its limits and the reported velocity.

*Jump.* Between two good values, n cycles apart, a joint moves at most n * velocity_max * period, plus 3 sigma of the noise. A
value that changed by more is not used. After `JUMPS_TO_CONFIRM` such values in a row the encoder counts as having lost its
reference. It is used again when it jumps back to the expected position, which includes the motion since the jump, or when its
drive has restarted, see `reference`.

*Range.* A joint must be within its position limits, extended by `position_tolerance`.

*Velocity.* The mean reported velocity between two samples, by the trapezoidal rule, must match the change of the encoder
position. Because of the low-pass filter of the drive they may differ for a few cycles, but not for `VELOCITY_SAMPLES` samples in
a row. The time of a sample is the cycle in which it was measured. So a late or lost frame changes the interval between two
samples, but not the result of the comparison.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from atalante_hal.compiled import specialised
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.finding import JOINT_NODES, Cycles, Signals
from atalante_hal.types import Vector
from atalante_hal.wire.process_image import NEVER

#: Number of consecutive jumps after which the diagnostic is confirmed.
JUMPS_TO_CONFIRM = 5
#: Number of consecutive wrong velocities after which the diagnostic is raised.
VELOCITY_SAMPLES = 3
_ALL = b"\1" * len(JOINTS)


class Lost(NamedTuple):
    """Record of an encoder that jumped. Positions are on the motor side."""

    last: float  # last received position [rad]
    cycles: int  # time from the last good position to `last` [cycles]
    expected: float  # expected position without the jump [rad]


class EncoderChecks:
    """Checks of the twelve encoders.

    Args:
        robot: limits and sensor properties of the robot.
        now: signals decoded in this cycle.
        before: last good signals before this cycle.
        period: cycle time [s].
        every: interval between two calls of `judge_velocity` [cycles].
    """

    def __init__(self, robot: Robot, now: Signals, before: Signals, period: float, every: int) -> None:
        self._now, self._before = now, before
        self._travel = robot.velocity_max * robot.gear * period
        self._noise = 3.0 * robot.encoder_noise * robot.gear
        self.jumps = [0] * len(JOINTS)
        self._jump_of: dict[int, float] = {}  # joint index -> size of the last jump of its encoder [rad]
        self._lost: dict[int, Lost] = {}
        #: Joint index -> position [rad] of each joint outside its range.
        self.outside: dict[int, float] = {}
        self._range = np.array([robot.position_min, robot.position_max])
        tolerance = robot.thresholds.position_tolerance
        self._low, self._high = np.sort(
            np.array([robot.position_min - tolerance, robot.position_max + tolerance]) * robot.gear * robot.polarity,
            axis=0,
        )
        self._polarity = robot.polarity.tolist()
        self._period, self._every = period, every
        # Coefficients of twice the velocity deviation, which is a linear function of two consecutive samples.
        time = every * period
        self._of_later, self._of_earlier = np.array([[-2.0 / time, 1.0], [2.0 / time, 1.0]])
        self._earlier = np.zeros((2, len(JOINTS)))  # position [rad] and velocity [rad/s] of the last sample
        self._no_age = np.zeros(len(JOINTS), np.int64)
        self._earlier_age: Cycles = np.full(len(JOINTS), NEVER)  # age of the values of each joint at the last sample
        self._twice_allowed = 2.0 * robot.sensors.velocity_error * robot.gear
        self._wrong = [0] * len(JOINTS)
        self._wrong_findings: tuple[Finding, ...] = ()
        self._gear = robot.gear.tolist()
        #: Arguments of the function `within_reach`. The array objects are the same in every call.
        self._positions = now.position, before.position, self._travel + self._noise, self._low, self._high
        self._within_reach = specialised(within_reach, *self._positions)

    def within_reach(self) -> bool:
        """Return whether every joint is in its range and moved by no more than is possible in one cycle."""
        return not self.outside and self._within_reach(*self._positions)

    def accept(self, joint: int, cycles: int) -> bool:
        """Check the new position of one joint for a jump, and return whether the position may be used.

        Args:
            joint: index of the joint in JOINTS.
            cycles: time from its last good position to the new one [cycles].
        """
        now, before = float(self._now.position[joint]), float(self._before.position[joint])
        travel, noise = float(self._travel[joint]), float(self._noise[joint])
        confirmed = self.jumps[joint] >= JUMPS_TO_CONFIRM
        moved = abs(now - before)
        good = not confirmed and not moved > cycles * travel + noise  # NaN passes: there is no previous value yet
        if not good:
            lost = self._lost[joint] = followed(
                self._lost.get(joint, Lost(before, 0, before)), now, cycles, travel, noise
            )
            if confirmed:
                moved = abs(now - lost.expected)
                good = moved <= JUMPS_TO_CONFIRM * travel + noise
        if good:
            self.reference(joint)
            self._judge_range(joint, now)
            return True
        self.jumps[joint] += 1
        self._jump_of[joint] = moved / self._gear[joint]
        return False

    def reference(self, joint: int) -> None:
        """Reset the jump count of a joint, so that its encoder is used again from the next value on.

        Args:
            joint: index of the joint in JOINTS.
        """
        self.jumps[joint] = 0
        self._lost.pop(joint, None)

    def _judge_range(self, joint: int, position: float) -> None:
        if self._low[joint] <= position <= self._high[joint]:
            self.outside.pop(joint, None)
        else:
            self.outside[joint] = position * self._polarity[joint] / self._gear[joint]

    def judge_velocity(self, age: Cycles | None) -> bool:
        """Compare the reported velocity with the encoder motion since the last call.

        Args:
            age: age of the values of each joint [cycles], shape (12,). A joint with an age of `NEVER` or more is not compared.
                None if all values are of this cycle.

        Returns:
            Whether a wrong velocity is confirmed for any joint.
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
        """Return twice the deviation of each velocity from the encoder motion, and for each joint whether it is compared.

        Args:
            age: age of the values of each joint [cycles], shape (12,).

        Returns:
            Twice the deviation [rad/s, motor side], 0 for a joint that is not compared, shape (12,); and whether each joint is
            compared, length 12.
        """
        motion, earlier = self._now.motion, self._earlier
        cycles = self._every + self._earlier_age - age
        compared = (age < NEVER) & (self._earlier_age < NEVER) & (cycles > 0)
        time = np.where(compared, cycles, 1) * self._period
        error = motion[1] + earlier[1] - 2.0 * (motion[0] - earlier[0]) / time
        return np.where(compared, error, 0.0), compared.tolist()

    def _count_wrong(self, error: list[float], right: list[bool], compared: list[bool] | None) -> None:
        """Count the consecutive wrong velocities of each joint, and update the findings.

        Args:
            error: twice the deviation of the velocity of each joint [rad/s, motor side].
            right: whether the deviation of each joint is within its limit.
            compared: whether each joint was compared; None if all were. A joint that was not compared keeps its count.
        """
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
        """Return the present findings."""
        if not (self.outside or any(self.jumps)):
            return self._wrong_findings
        jumps = (self._jump(joint) for joint, jumps in enumerate(self.jumps) if jumps)
        return (*jumps, *map(self._outside, self.outside), *self._wrong_findings)

    def _jump(self, joint: int) -> Finding:
        size, confirmed = self._jump_of[joint], self.jumps[joint] >= JUMPS_TO_CONFIRM
        text = f"the encoder of {JOINTS[joint]} jumped by {np.degrees(size):.2f} degrees, more than the joint can move"
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
        text = f"the velocity of {JOINTS[joint]} differs from its encoder by {np.degrees(at_joint):+.0f} deg/s"
        return Finding(Dtc.ENC_VELOCITY, JOINT_NODES[joint], at_joint, True, text)


def followed(lost: Lost, now: float, cycles: int, travel: float, noise: float) -> Lost:
    """Return the updated record of an encoder that jumped.

    A change without a jump counts as motion of the joint and is added to its expected position.

    Args:
        lost: record before this position.
        now: received position [rad].
        cycles: time from the last good position to the received one [cycles].
        travel: largest motion of the joint in one cycle [rad].
        noise: largest change of the position due to encoder noise [rad].
    """
    step = now - lost.last
    jumped = abs(step) > (cycles - lost.cycles) * travel + noise
    return Lost(now, cycles, lost.expected if jumped else lost.expected + step)


def within_reach(position: Vector, before: Vector, reach: Vector, low: Vector, high: Vector) -> bool:
    """Return whether every joint is within its limits and moved by at most its reach.

    Args:
        position: new positions, shape (12,) [rad, motor side].
        before: previous positions, shape (12,) [rad, motor side].
        reach: largest possible motion, shape (12,) [rad, motor side].
        low: lower position limits, shape (12,) [rad, motor side].
        high: upper position limits, shape (12,) [rad, motor side].
    """
    for joint in range(len(reach)):
        moved = abs(position[joint] - before[joint])
        if moved > reach[joint] or position[joint] < low[joint] or position[joint] > high[joint]:
            return False
    return True
