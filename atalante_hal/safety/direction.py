"""Test of the joint directions: before ACTIVE, each joint moves a little, and its encoder must follow the torque.

    all drives enabled -> torque pulse on each joint -> mobility of the joint -> ACTIVE, or START_FAILED

A motor with exchanged phases and a drive with a wrong sign push a joint in the wrong direction. A dead motor does not move it.
At a start, drive state, position and reported torque do not show these faults. So the HAL adds a torque pulse to the torque that
holds the pose, and evaluates the motion.

*Pulse.* The pulse has the shape of the second derivative of sin(pi x)^4. So a free inertia moves away and back, and is
then at rest in its initial position. The peak of the pulse is `PEAK` times `breakaway`, which exceeds the dry friction.
The joints of a leg that are tested at the same time hardly move each other. Both legs are tested at the same time, with
opposite pulses. If the encoders of both legs are exchanged, each encoder moves against the torque of its joint, and the
exchange is detected. The pulse moves the left joint towards the middle of its range. A joint near its end stop is the
exception: this joint and the same joint of the other leg both move towards the middle. An exchange of the encoders of
these two joints may not be detected.

*Pose.* A position control with a share of the drive's gains holds the pose, because the drives do not hold the pose
during the test. With a wrong sign, this control pushes its joint away. A joint that moves by more than `TRAVEL` ends
the start.

*Result.* The mobility of a joint is the inverse of its effective inertia. It follows from a least-squares fit of the position:
mobility times the double integral of the sent torque, plus a polynomial of time. All joints of a test have the same delay from
torque to motion. The test uses the delay with which the torques explain the motions of these joints best. Both tests with short
pulses together give a more exact delay, which a controller can use (`State.delay`). A motion against the torque has no effect
on the delay: a foot that bounces off the floor may move as if its torque were late and reversed. A joint with a mobility of at
least `MOBILITY` follows its torque. A mobility of at most -`MOBILITY` shows a wrong sign. A joint between these limits does not
follow its torque. A disturbance may spoil a test, so a joint fails only after `TRIALS` tests. The legs of a suspended robot
whose drives are off sink onto their end stops within some seconds, and the leg weight presses joints onto the end stops. So the
pulse of a repeated test is `BOOST` times larger for a joint within the position tolerance of its limit. If the foot of a leg
carries load, the joints of the leg may be blocked. A foot that only touches the floor hits the floor during the pulse, and the
impact stops the ankle. An impact lasts one or two cycles, so the impact hardly changes the mean force. A joint whose foot
carried load or hit the floor stays untested. An offset of a single cell is no load and no impact, because load acts on at least
two cells, and an impact is short. Each start tests all joints again, because motors and encoders may have been exchanged since
the last one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.types import PERIOD, Vector

#: One element for each test: the joints of a leg that are tested at the same time, and the duration of their pulse [cycles].
GROUPS = ((("FH", "SH"), 32), (("TH", "SA"), 16), (("SK", "HA"), 16))
_SHORT = min(duration for _, duration in GROUPS)
#: Delay [cycles] from a torque command to the first position that shows its effect, if no frame and no motor is late.
LATENCY = 2
#: Delays from torque to motion that the test tries [cycles]: `LATENCY` plus 0 to 3, because frames and motors may be late.
#: Longer delays are not tried, because a reversed motor moves its joint almost like a correct motor that is 4 to 5 cycles late.
#: Reason: in a pulse of 16 cycles, the largest and the smallest torque are 4.6 cycles apart.
LATENCIES = tuple(range(LATENCY, LATENCY + 4))
#: Largest torque of the pulse, as a multiple of the breakaway torque `Robot.breakaway`. One value for each joint in LEG_JOINTS.
#: The peaks of FH and SH are larger, because these joints move a whole leg.
PEAK = (6.0, 3.0, 6.0, 3.0, 3.0, 3.0)
#: Gains of the HAL's position control in the test, as multiples of the drives' gains `Robot.hold_kp` and `Robot.hold_kd`.
#: One value for each joint in LEG_JOINTS. Light joints have low gains, because the HAL controls with more delay than a drive.
STIFFNESS = (1.0, 1.0, 1.25, 0.5, 0.25, 0.25)
DAMPING = (0.5, 0.5, 0.6, 0.25, 0.25, 0.25)
#: Integral time of the HAL's position control, which holds the legs during the test [s].
INTEGRAL = 0.03
#: Largest distance of a joint from its initial position during the test [rad]. A larger distance ends the start.
TRAVEL = math.radians(1.5)
#: First condition for a loaded foot: the mean force on the foot during a test exceeds `LOAD * cell_free`.
#: Second condition for a loaded foot: on at least two cells, the mean force exceeds half of `LOAD * cell_free`.
#: `LOAD * cell_free` is about four times the rms noise of the mean force on a foot.
#: The rms noise of the mean force on one cell is half the rms noise of the mean force on the foot, which has four cells.
LOAD = 1.0 / 3.0
#: F is the sum of the forces on a foot in two consecutive cycles. A foot has hit the floor if a value of F meets two conditions.
#: First condition for a hit: the magnitude of F exceeds `HIT * cell_free`.
#: Second condition for a hit: the magnitude of F - 2 m exceeds `HIT * cell_free`.
#: Here, m is the median force on the foot in the test.
#: `HIT * cell_free` is about four times the rms noise of F (sum of the forces on a foot in two consecutive cycles).
#: If the floor stops a moving ankle, F (sum of the foot forces in two consecutive cycles) is at least 1.5 * `HIT * cell_free`.
HIT = 2.0
#: Factor by which the pulse is larger in the second test of a joint near its end stop.
#: The leg weight may press the joint onto the end stop, so the pulse of the first test may be too small to move it.
BOOST = 6.0
#: Number of unsuccessful tests after which a joint fails.
#: Exception: a joint does not fail if its foot carried load or hit the floor, unless the joint moved against its torque.
TRIALS = 2
#: Smallest mobility (acceleration per torque) of a joint that follows its torque [1/(kg m2)].
#: One value for each joint in LEG_JOINTS.
#: In a suspended robot, the mobility of each joint is at least about twice the value in `MOBILITY`.
#: This factor of about 2 holds for straight and bent legs, without a patient and with a patient of 110 kg.
MOBILITY = (0.045, 0.23, 0.075, 0.56, 4.6, 6.8)


def pulse(cycle: int, duration: int) -> float:
    """Return the shape of the torque pulse at one time: -1 in the middle of the pulse, 0 outside the pulse.

    Before and after the middle, the shape has a positive lobe with a height of 0.5625.

    Args:
        cycle: time since the pulse began [cycles].
        duration: duration of the pulse [cycles].
    """
    if not 0 <= cycle <= duration:
        return 0.0
    square = math.sin(math.pi * cycle / duration) ** 2
    return square * (3.0 - 4.0 * square)


def pose_gains(robot: Robot) -> tuple[Vector, Vector]:
    """Return the gains with which the HAL can hold a pose: stiffness [Nm/rad] and damping [Nm s/rad], shape (12,) each.

    Args:
        robot: hold gains of the drives.
    """
    both = len(SIDES)
    return robot.hold_kp * np.array(STIFFNESS * both), robot.hold_kd * np.array(DAMPING * both)


def mobilities_of(torque: Vector, position: Vector) -> tuple[Vector, Vector]:
    """Estimate the mobility of each joint from its torques and positions, once for each delay in `LATENCIES`.

    The estimate is a least-squares fit. It assumes that a torque moves the joint after exactly the tried delay. A wrong delay
    makes the mobility of a light joint several times too small.

    Args:
        torque: torque sent in each cycle, shape (n, joints) [Nm].
        position: position in each cycle, measured before the torque was sent, shape (n, joints) [rad].

    Returns:
        Two arrays of shape (delays, joints). The first array is the mobility, the inverse of the effective inertia
        [1/(kg m2)]. The mobility is 0 for a joint whose torque did not change. The second array is the share of the measured
        motion that the torque explains. The magnitude of the share is from 0 to 1, and its sign is the sign of the mobility.
    """
    count = len(position)
    response = np.zeros((len(LATENCIES), *torque.shape))
    for row, latency in enumerate(LATENCIES):
        response[row, latency:] = torque[:-latency] - torque[0]
    response = response.cumsum(axis=1).cumsum(axis=1) * PERIOD**2
    # `response` is the motion that the torques would cause with a mobility of 1.
    # A joint may also move without a pulse, roughly like a cubic polynomial of time.
    # So the cubic polynomial that fits best is subtracted from `response` and from `motion`.
    free = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), 4))[0]
    response -= free @ (free.T @ response)
    motion = position - position[0]
    motion -= free @ (free.T @ motion)
    power, total = (response**2).sum(axis=1), (motion**2).sum(axis=0)
    moved = (response * motion).sum(axis=1)
    mobility: Vector = moved / np.where(power > 0.0, power, np.inf)
    explained: Vector = moved * np.abs(mobility) / np.where(total > 0.0, total, np.inf)
    return mobility, explained


class DirectionProof:
    """Test of the motor and encoder direction of each joint, done at each start when all drives are in OPERATION ENABLED.

    Args:
        robot: position limits, hold gains and breakaway torques.
        groups: one element for each test, as in `GROUPS`; empty means no test.

    Attributes:
        proven: True for each joint that passed in the last start, shape (12,).
        mobility: last measured mobility of each joint, shape (12,) [1/(kg m2)]; 0 if it was not measured.
        failed: indices in JOINTS of the joints that failed in this start.
        running: True from `begin` until all joints are tested, or one has failed.
        late: delay of the torques in addition to `LATENCY` [cycles]. With this delay, the torques explain the motions best. The
            motions are those of all joints that passed a test with a short pulse and more than two joints in the last start. A
            new start keeps the delay until its first such test. 0 before any joint passed such a test.
    """

    def __init__(self, robot: Robot, groups: Sequence[tuple[Sequence[str], int]] = GROUPS) -> None:
        both = len(SIDES)
        self._groups = groups
        self._peak = np.array(PEAK * both) * robot.breakaway
        self._middle = 0.5 * (robot.position_min + robot.position_max)
        self._kp, self._kd = pose_gains(robot)
        self._least = np.array(MOBILITY * both)
        self._free = robot.sensors.cell_free
        stop = robot.thresholds.position_tolerance
        self._low, self._high = robot.position_min + stop, robot.position_max - stop
        self.proven: npt.NDArray[np.bool_] = np.zeros(len(JOINTS), np.bool_)
        self.mobility = np.zeros(len(JOINTS))
        self.failed: list[int] = []
        self.running = False
        self._anchor, self._base, self._sign = np.zeros((3, len(JOINTS)))
        #: Remaining tests. For each test: joints to test, as indices in JOINTS, and duration of the pulse [cycles].
        self._tests: list[tuple[list[int], int]] = []
        self._trials = [0] * len(JOINTS)
        # Extra delay [cycles], measured with a short pulse on more than two joints. Tests of one or two joints use this delay.
        # Reason: a delay fitted to only one or two joints might make a motor with a wrong sign look like a late motor.
        self.late = 0
        #: Score of each delay in `LATENCIES`. The delay with the largest score explains the measured motions best.
        #: Each joint adds a share (0 to 1) to the score of a delay: the part of its motion that the delayed torque explains.
        #: A joint adds its share only if it passed a test that had a short pulse and tested more than two joints at once.
        self._explained = np.zeros(len(LATENCIES))
        self._position: list[Vector] = []  # joint positions in each cycle of the current test
        #: Vertical forces on the cells of each foot in each cycle of the current test, shape (2, 4) [N].
        self._force: list[Vector] = []
        self._torque: list[Vector] = []  # sent torques in each cycle of the current test

    def begin(self, position: Vector, torque: Vector) -> None:
        """Begin the tests of all joints.

        Args:
            position: present joint positions, shape (12,) [rad], which the position control holds.
            torque: torque sent last, shape (12,) [Nm], to which the control adds its torque.
        """
        self._anchor[:], self._base[:] = position, torque
        self._sign[:] = np.where(position < self._middle, 1.0, -1.0)
        left, right = np.split((position < self._low) | (position > self._high), len(SIDES))
        ours, theirs = np.split(self._sign, len(SIDES))
        theirs[:] = np.where(left | right, theirs, -ours)
        self._trials = [0] * len(JOINTS)
        self.failed = []
        self.proven[:] = False
        self.mobility[:] = 0.0
        self._explained[:] = 0.0
        self._tests = [
            ([j for j in range(len(JOINTS)) if LEG_JOINTS[j % len(LEG_JOINTS)] in names], duration)
            for names, duration in self._groups
        ]
        self._next_test()

    def torque(self, position: Vector, velocity: Vector) -> Vector:
        """Return the torque of this cycle, shape (12,) [Nm]: position control and pulse.

        Args:
            position: joint positions, shape (12,) [rad].
            velocity: joint velocities, shape (12,) [rad/s].
        """
        spring = self._kp * (self._anchor - position)
        self._base += spring * (PERIOD / INTEGRAL)
        torque = self._base + spring - self._kd * velocity
        joints, duration = self._tests[0]
        shape = pulse(len(self._position), duration)
        torque[joints] += shape * self._sign[joints] * self._strength(joints)
        self._position.append(position.copy())
        return torque

    def sent(self, torque: Vector) -> None:
        """Store the torque that was sent in this cycle, after the limits.

        Args:
            torque: sent torque, shape (12,) [Nm].
        """
        self._torque.append(torque.copy())

    def evaluate(self, position: Vector, force: Vector) -> str:
        """Record this cycle, and evaluate the motion of the tested joints when their pulse is over.

        Args:
            position: joint positions, shape (12,) [rad].
            force: vertical force on each cell of each foot, shape (2, 4) [N].

        Returns:
            Reason why the start must end, as one sentence; empty if the start may continue.
        """
        self._force.append(force.copy())
        travel = np.abs(position - self._anchor)
        if not travel.max() <= TRAVEL:
            far = np.flatnonzero(travel > 0.5 * TRAVEL)
            # Gravity makes both legs sag equally far, so a faulty joint moves farther than the same joint of the other leg.
            # A faulty joint also moves its neighbours, and a light neighbour moves far. So each difference between the legs is
            # weighted with the stiffness `_kp`, which is small for light joints.
            excess = self._kp * np.abs(travel - np.roll(travel, len(LEG_JOINTS)))
            joint = int(far[np.argmax(excess[far])])
            self._fail(far.tolist())
            farthest = int(np.argmax(travel))
            moved, largest, most = (f"{math.degrees(angle):.1f} deg" for angle in (travel[joint], travel.max(), TRAVEL))
            other = "" if farthest == joint else f", and {JOINTS[farthest]} moved by {largest}"
            return (
                f"{JOINTS[joint]} moved by {moved} in the test of its direction{other}; "
                f"each joint may move by at most {most}"
            )
        joints, duration = self._tests[0]
        if len(self._position) <= duration + LATENCY:
            return ""
        mobility, explained = mobilities_of(np.array(self._torque)[:, joints], np.array(self._position)[:, joints])
        late = self.late
        if len(joints) > len(SIDES):
            explained = np.maximum(explained, 0.0)
            late = int(np.argmax(explained.sum(axis=1)))
            if duration == _SHORT:
                passed = mobility[late] >= self._least[joints]
                self._explained += explained[:, passed].sum(axis=1)
                if self._explained.any():
                    self.late = int(np.argmax(self._explained))
        self.mobility[joints] = mobility[late]
        return self._evaluate_test(joints, duration)

    def _evaluate_test(self, joints: Sequence[int], duration: int) -> str:
        again: list[int] = []
        supported = self._on_the_floor()
        for joint in joints:
            mobility, least = self.mobility[joint], self._least[joint]
            self._trials[joint] += 1
            if mobility >= least:
                self.proven[joint] = True
            elif self._trials[joint] < TRIALS:
                again.append(joint)
            elif mobility <= -least or not supported[joint // len(LEG_JOINTS)]:
                self.failed.append(joint)
        if self.failed:
            self._fail(self.failed)
            return ", ".join(map(self._failure, self.failed))
        del self._tests[0]
        if again:
            self._tests.insert(0, (again, duration))
        self._next_test()
        return ""

    def _on_the_floor(self) -> npt.NDArray[np.bool_]:
        """Return whether each foot carried load or hit the floor during the test, shape (2,)."""
        cells = np.array(self._force)
        force, mean, least = cells.sum(axis=2), cells.mean(axis=0), LOAD * self._free
        carries = np.abs(mean) > 0.5 * least
        loaded = (np.abs(mean.sum(axis=1)) > least) & (carries.sum(axis=1) >= 2)
        pairs = force[1:] + force[:-1]
        change = pairs - 2.0 * np.median(force, axis=0)
        hit = np.minimum(np.abs(pairs), np.abs(change)).max(axis=0) > HIT * self._free
        supported: npt.NDArray[np.bool_] = loaded | hit
        return supported

    def report(self) -> str:
        """Return the result of the tests as one sentence: effective inertias, delay of the torques, untested joints."""
        passed = ", ".join(f"{JOINTS[j]} {1.0 / self.mobility[j]:.2g}" for j in np.flatnonzero(self.proven).tolist())
        text = f"effective inertia [kg m2]: {passed}"
        if self.late:
            text += f"; torques {self.late} ms late"
        blocked = [JOINTS[j] for j in np.flatnonzero(~self.proven).tolist()]
        return f"{text}; not tested under load: {', '.join(blocked)}" if blocked else text

    def _strength(self, joints: Sequence[int]) -> Vector:
        """Return the largest torque in the pulse of each tested joint, shape (joints,) [Nm]."""
        pressed = (self._anchor < self._low) | (self._anchor > self._high)
        repeated = np.array(self._trials) > 0
        return np.where(pressed & repeated, BOOST, 1.0)[joints] * self._peak[joints]

    def _failure(self, joint: int) -> str:
        least = self._least[joint]
        found = "moves against its torque" if self.mobility[joint] <= -least else "does not follow its torque"
        return f"{JOINTS[joint]} {found} (mobility {self.mobility[joint]:.2g}; must be at least {least:g})"

    def _fail(self, joints: list[int]) -> None:
        self.failed, self.running = joints, False

    def _next_test(self) -> None:
        self._position.clear()
        self._force.clear()
        self._torque.clear()
        self.running = bool(self._tests)
