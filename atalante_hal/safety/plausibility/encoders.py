"""Encoder checks, which compare each position with its limits, with the previous position and with the reported velocity.

*Jump.* Between two good values that are n cycles apart, a position changes by at most n * top_speed * period plus 3
sigma of the encoder noise. At `Robot.top_speed` and above, the limiter permits no accelerating torque, so every motion
that the limiter permits is accepted. A value with a larger change is rejected. After `JUMPS_TO_CONFIRM`
rejected values in a row, the loss of the encoder's reference is confirmed. The encoder is used again when its value jumps
back to the expected position, or when its drive has restarted (see `reference`). The expected position includes the
motion since the jump.

*Exchange.* If the encoders of a joint are exchanged between the legs, both jump, each to the position of the other one. A
drive that holds its joint with the encoder of the other leg moves its joint away, so both drives must be switched off.

*Overspeed.* A change above the limit of the jump check is real motion if two conditions hold (`continues`). First, the encoder
already moved in the same direction at more than half of top_speed in the cycle before. Second, the velocity grew by at
most top_speed. A value that meets both conditions is used, so that the encoder keeps its reference. After
`OVERSPEED_TO_CONFIRM` such values in a row, the overspeed is confirmed.

*Range.* A joint must be within its position limits, extended by `position_tolerance`.

*Velocity.* The drive reports the encoder velocity after a low-pass with the cut-off frequency `velocity_bandwidth`. The check
applies the same low-pass to the velocities computed from the encoder positions. So the delay of the filter causes no difference,
also in fast motions. The mean difference of two consecutive samples may exceed `velocity_error` for a few cycles, but not for
`VELOCITY_SAMPLES` samples in a row. A late or lost frame changes the time between two positions. The low-pass takes this time
into account.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import JOINTS, LEG_JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Cycles, Signals
from atalante_hal.types import Vector
from atalante_hal.wire.process_image import NEVER

#: Number of consecutive rejected positions of an encoder after which ENC_JUMP is confirmed.
JUMPS_TO_CONFIRM = 5
#: Number of consecutive velocities above the top speed after which overspeed is confirmed.
#: A single velocity above the top speed may come from a small jump of the encoder.
OVERSPEED_TO_CONFIRM = 2
#: Number of consecutive wrong velocities of a drive after which ENC_VELOCITY is raised.
VELOCITY_SAMPLES = 3
_ALL = b"\1" * len(JOINTS)


class Lost(NamedTuple):
    """Data of an encoder whose reading jumped. All positions are on the motor side."""

    last: float  # newest received position [rad]
    cycles: int  # time between the newest good position (before the jump) and `last` [cycles]
    expected: float  # position that the encoder would have without the jump [rad]


class Motion(NamedTuple):
    """Motor positions and velocities of one cycle, the inputs of the function `low_pass`. Shape (12,) each."""

    position: Vector  # new positions [rad]
    before: Vector  # positions of the previous cycle [rad]
    velocity: Vector  # reported velocities [rad/s]


class EncoderChecks:
    """Checks of the twelve encoders.

    Args:
        robot: limits and sensor properties of the robot.
        now: signals decoded in this cycle.
        before: last good signals before this cycle.
        period: cycle time [s].
        every: interval between two calls of `check_velocity` [cycles].
    """

    def __init__(self, robot: Robot, now: Signals, before: Signals, period: float, every: int) -> None:
        self._now, self._before = now, before
        self._travel = robot.top_speed * robot.gear * period
        self._noise = 3.0 * robot.encoder_noise * robot.gear
        self.jumps = [0] * len(JOINTS)
        self._jump_of: dict[int, float] = {}  # size of the last jump of the encoder, by joint index [rad]
        self._lost: dict[int, Lost] = {}
        #: Joints that are too fast: joint index -> velocity [rad/s], number of consecutive values above the top speed.
        self.too_fast: dict[int, tuple[float, int]] = {}
        self._top_speed = robot.top_speed
        #: Position of each joint that is outside its range, by joint index [rad].
        self.outside: dict[int, float] = {}
        self._range = np.array([robot.position_min, robot.position_max])
        tolerance = robot.thresholds.position_tolerance
        self._low, self._high = np.sort(
            np.array([robot.position_min - tolerance, robot.position_max + tolerance]) * robot.gear * robot.polarity,
            axis=0,
        )
        self._polarity = robot.polarity.tolist()
        self._period, self._every = period, every
        self._keep = math.exp(-2.0 * math.pi * robot.sensors.velocity_bandwidth * period)
        #: `_filtered`: velocity of each encoder, computed from its positions, after the low-pass [rad/s].
        #: `_deviation`: velocity reported by each drive minus `_filtered` [rad/s].
        self._filtered, self._deviation = np.zeros((2, len(JOINTS)))
        self._speed = np.zeros(len(JOINTS))  # mean velocity of each encoder between its last two good positions [rad/s]
        self._earlier = np.zeros(len(JOINTS))  # `_deviation` at the last velocity check [rad/s]
        self._no_age = np.zeros(len(JOINTS), np.int64)
        # For each joint, the age that its values had in the last velocity check [cycles].
        self._earlier_age: Cycles = np.full(len(JOINTS), NEVER)
        self._twice_allowed = 2.0 * robot.sensors.velocity_error * robot.gear
        self._wrong = [0] * len(JOINTS)
        self._wrong_findings: tuple[Finding, ...] = ()
        self._gear = robot.gear.tolist()
        #: Arguments of the function `within_reach`. The array objects are the same in every call.
        self._positions = now.position, before.position, self._travel + self._noise, self._low, self._high
        self._within_reach = specialised(within_reach, *self._positions)
        #: Arguments of the function `low_pass`. The array objects are the same in every call.
        self._motion = (
            Motion(now.position, before.position, now.velocity),
            self._filtered, self._deviation, self._speed, self._keep, period,
        )  # fmt: skip
        self._low_pass = specialised(low_pass, *self._motion)

    def within_reach(self) -> bool:
        """Return whether every joint is in its range and has not moved farther than a joint can move in one cycle."""
        return not (self.outside or self.too_fast) and self._within_reach(*self._positions)

    def follow(self) -> None:
        """Advance the low-pass of all joints by one cycle.

        All joints must have good positions in this cycle and in the previous cycle.
        """
        self._low_pass(*self._motion)

    def accept(self, joint: int, cycles: int) -> bool:
        """Check the new position of one joint for a jump, and return whether the position may be used.

        Args:
            joint: index of the joint in JOINTS.
            cycles: time from the joint's last good position to the new position [cycles].
        """
        now, before = float(self._now.position[joint]), float(self._before.position[joint])
        travel, noise = float(self._travel[joint]), float(self._noise[joint])
        confirmed = self.jumps[joint] >= JUMPS_TO_CONFIRM
        moved = abs(now - before)
        # without a previous value `moved` is NaN, and the new value is accepted
        good = not confirmed and not moved > cycles * travel + noise
        if good:
            self.too_fast.pop(joint, None)
        elif not self.jumps[joint] and cycles >= 1:
            good = self._check_overspeed(joint, (now - before) / (cycles * self._period))
        if not good:
            lost = self._lost[joint] = followed(
                self._lost.get(joint, Lost(before, 0, before)), now, cycles, travel, noise
            )
            if confirmed:
                moved = abs(now - lost.expected)
                good = moved <= JUMPS_TO_CONFIRM * travel + noise
        if good:
            self._follow(joint, cycles)
            self.reference(joint)
            self._check_range(joint, now)
            return True
        self.jumps[joint] += 1
        self._jump_of[joint] = moved / self._gear[joint]
        return False

    def _check_overspeed(self, joint: int, mean: float) -> bool:
        """Return whether a motion above the top speed is real, and update `too_fast`.

        Args:
            joint: index of the joint in JOINTS.
            mean: mean velocity since the last good position [rad/s, motor side].
        """
        _, values = self.too_fast.pop(joint, (0.0, 0))
        real = continues(mean, float(self._speed[joint]), float(self._travel[joint]) / self._period)
        if real:
            self.too_fast[joint] = mean * self._polarity[joint] / self._gear[joint], values + 1
        return real

    def tolerated(self, joint: int) -> Dtc | None:
        """Return ENC_JUMP, the pending diagnostic of a rejected position; None if ENC_JUMP is already confirmed.

        Args:
            joint: index of the joint in JOINTS.
        """
        return Dtc.ENC_JUMP if self.jumps[joint] < JUMPS_TO_CONFIRM else None

    def _follow(self, joint: int, cycles: int) -> None:
        """Advance the low-pass of one joint.

        Args:
            joint: index of the joint in JOINTS.
            cycles: time from the joint's last good position to the new position [cycles].
        """
        if cycles < 1:  # a frame was late, so the new position is not newer than the last one
            return
        velocity = float(self._now.velocity[joint])
        moved = float(self._now.position[joint] - self._before.position[joint])
        if cycles >= NEVER or math.isnan(moved):  # the previous position is unknown
            self._filtered[joint] = velocity
            self._speed[joint] = 0.0
        else:
            keep = self._keep**cycles
            mean = self._speed[joint] = moved / (cycles * self._period)
            self._filtered[joint] = keep * self._filtered[joint] + (1.0 - keep) * mean
        self._deviation[joint] = velocity - self._filtered[joint]

    def reference(self, joint: int) -> None:
        """Reset the jump count of a joint, so that its encoder is used again, starting with the next value.

        Args:
            joint: index of the joint in JOINTS.
        """
        self.jumps[joint] = 0
        self._lost.pop(joint, None)

    def _check_range(self, joint: int, position: float) -> None:
        if self._low[joint] <= position <= self._high[joint]:
            self.outside.pop(joint, None)
        else:
            self.outside[joint] = position * self._polarity[joint] / self._gear[joint]

    def check_velocity(self, age: Cycles | None) -> bool:
        """Compare the reported velocities with the encoder velocities. All velocities have passed the same low-pass.

        Args:
            age: age of the values of each joint [cycles], shape (12,). A joint with an age of `NEVER` or more is not
                compared. Pass None if all values are of this cycle.

        Returns:
            Whether a wrong velocity is confirmed for any joint.
        """
        error = self._deviation + self._earlier
        compared = None
        if age is not None or self._earlier_age is not self._no_age:
            compared = self._compared(self._no_age if age is None else age)
            error = np.where(compared, error, 0.0)
        right = np.abs(error) <= self._twice_allowed
        if right.tobytes() != _ALL or any(self._wrong):
            self._count_wrong(error.tolist(), right.tolist(), None if compared is None else compared.tolist())
        self._earlier[:] = self._deviation
        self._earlier_age = self._no_age if age is None else age
        return bool(self._wrong_findings)

    def _compared(self, age: Cycles) -> npt.NDArray[np.bool_]:
        """Return for each joint whether its values are newer than at the last velocity check, shape (12,).

        Args:
            age: age of the values of each joint [cycles], shape (12,).
        """
        cycles = self._every + self._earlier_age - age
        return (age < NEVER) & (self._earlier_age < NEVER) & (cycles > 0)

    def _count_wrong(self, error: list[float], right: list[bool], compared: list[bool] | None) -> None:
        """Count the consecutive wrong velocities of each joint, and update the findings.

        Args:
            error: sum of the last two velocity deviations of each joint, which is twice their mean [rad/s, motor side].
            right: whether the deviation of each joint is within its limit.
            compared: whether each joint was compared; None if all joints were compared. A joint that was not compared
                keeps its count.
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
        """Return the current findings of the encoder checks."""
        if not (self.outside or self.too_fast or any(self.jumps)):
            return self._wrong_findings
        jumps = [self._jump(joint) for joint, jumps in enumerate(self.jumps) if jumps]
        if len(jumps) > 1:
            jumps += [self._exchange(joint) for joint in range(len(JOINTS)) if self._exchanged(joint)]
        too_fast = (self._overspeed(joint, *found) for joint, found in self.too_fast.items())
        return (*jumps, *too_fast, *map(self._outside, self.outside), *self._wrong_findings)

    def _jump(self, joint: int) -> Finding:
        size, confirmed = self._jump_of[joint], self.jumps[joint] >= JUMPS_TO_CONFIRM
        text = f"the encoder of {JOINTS[joint]} jumped by {np.degrees(size):.2f} degrees, more than the joint can move"
        if confirmed:
            text += "; it is not used until it jumps back or its drive restarts"
        return Finding(Dtc.ENC_JUMP, JOINT_NODES[joint], size, confirmed, text)

    def _exchanged(self, joint: int) -> bool:
        """Return whether the encoders of a joint and of its counterpart in the other leg are exchanged.

        Args:
            joint: index of the joint in JOINTS.
        """
        pair = joint, opposite(joint)
        if min(self.jumps[one] for one in pair) < JUMPS_TO_CONFIRM:
            return False
        # `Lost.expected` is the position without the jump. So `Lost.last` minus `Lost.expected` is the jump of each encoder.
        ours, theirs = (self._lost[one].last - self._lost[one].expected for one in pair)
        apart = float(self._before.position[pair[1]] - self._before.position[pair[0]])
        reach = JUMPS_TO_CONFIRM * float(self._travel[joint]) + float(self._noise[joint])
        return abs(ours - apart) <= reach and abs(theirs + apart) <= reach

    def _exchange(self, joint: int) -> Finding:
        other = JOINTS[opposite(joint)]
        text = f"the encoder of {JOINTS[joint]} reads the position of {other}, and vice versa; both drives are switched off"
        return Finding(Dtc.TORQUE_DIRECTION, JOINT_NODES[joint], self._jump_of[joint], True, text)

    def _overspeed(self, joint: int, speed: float, values: int) -> Finding:
        limit = np.degrees(self._top_speed[joint])
        text = f"the speed of {JOINTS[joint]} must be at most {limit:.0f} deg/s, got {np.degrees(speed):+.0f} deg/s"
        return Finding(Dtc.OVERSPEED, JOINT_NODES[joint], speed, values >= OVERSPEED_TO_CONFIRM, text)

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


def opposite(joint: int) -> int:
    """Return the index of the same joint of the other leg.

    Args:
        joint: index of the joint in JOINTS.
    """
    return (joint + len(LEG_JOINTS)) % len(JOINTS)


def continues(mean: float, speed: float, top_speed: float) -> bool:
    """Return whether a motion above the top speed is real: the joint must already have moved fast in this direction.

    Args:
        mean: mean velocity since the last good position [rad/s].
        speed: mean velocity between the last two good positions [rad/s].
        top_speed: largest velocity that the limiter permits [rad/s].
    """
    return speed * mean > 0.0 and 0.5 * top_speed < abs(speed) and abs(mean) <= abs(speed) + top_speed


def followed(lost: Lost, now: float, cycles: int, travel: float, noise: float) -> Lost:
    """Return the updated `Lost` record of an encoder whose reading jumped.

    A change that is small enough to be motion of the joint is added to the expected position.

    Args:
        lost: record before the position `now` was received.
        now: received position [rad].
        cycles: time from the last good position to the position `now` [cycles].
        travel: largest motion of the joint in one cycle [rad].
        noise: largest change of the position due to encoder noise [rad].
    """
    step = now - lost.last
    jumped = abs(step) > (cycles - lost.cycles) * travel + noise
    return Lost(now, cycles, lost.expected if jumped else lost.expected + step)


def within_reach(position: Vector, before: Vector, reach: Vector, low: Vector, high: Vector) -> bool:
    """Return whether every joint is within its position limits and moved by no more than `reach`.

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


def low_pass(motion: Motion, filtered: Vector, deviation: Vector, speed: Vector, keep: float, period: float) -> None:
    """Advance the low-pass of the encoder velocities by one cycle. The drives use the same low-pass.

    Args:
        motion: new and previous positions, and reported velocities.
        filtered: velocities after the low-pass, shape (12,) [rad/s]; updated.
        deviation: receives the reported velocities minus `filtered`, shape (12,) [rad/s].
        speed: receives the encoder velocities without the low-pass, shape (12,) [rad/s].
        keep: share of the last velocity that the low-pass keeps.
        period: cycle time [s].
    """
    for joint in range(len(filtered)):
        mean = (motion.position[joint] - motion.before[joint]) / period
        speed[joint] = mean
        filtered[joint] = keep * filtered[joint] + (1.0 - keep) * mean
        deviation[joint] = motion.velocity[joint] - filtered[joint]
