"""Simulation of single walking steps on the ideal plant (model of one swing leg), with the controller of the robot.

`state at the start, push -> |e| / q_bound in each cycle`. The ratio is the tracking error e, divided by the distance q_bound from
the desired angle to the edge of the guide. A joint with a ratio above 1 is outside the guide.

Each step calls the compiled cycle of the real controller, so the check covers the control law that runs on the robot. At the
start of a step, the torques from before the stance change still act. The plant, the limiter and the drives are the same as in the
module `plant`.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.airwalk.kernel import Measured, Parts, run
from atalante_control.gait.gait import Gait, motion
from atalante_control.guide.kernel import GuideTables
from atalante_control.guide.shapes import GuideShape
from atalante_control.joint.pid import RIGHT
from atalante_control.model import ArticulatedModel, ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.compiled import compiled
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, LEG_JOINTS, MOTORS, Robot
from atalante_hal.types import PERIOD, State, SupervisorState, Vector
from atalante_tools.guide.plant import HIP, KNEE, Condition, Plant, advance, inverse_dynamics, limited, plant

Pair = tuple[float, float]

#: Largest ratio |e| / q_bound. Above this ratio, the joint is far outside the guide, and the step ends early.
FAR_OUTSIDE = 8.0
#: Columns of `Walked.log`.
LOG = (
    "e_hip",
    "e_knee",
    "ratio_hip",
    "ratio_knee",
    "push_hip",
    "push_knee",
    "sent_hip",
    "sent_knee",
    "rate_hip",
    "rate_knee",
)
#: Number of features that can set the direction of a push (`Push.feedback`): tracking error and error rate of hip and knee.
FEATURES = 4
#: Divisor that scales the error rate in `Push.feedback` [rad/s]. An error rate of 0.5 rad/s gives the feature value 1.
RATE = 0.5


class Push(NamedTuple):
    """Push at hip and knee during one step. The push always has the largest torque, and only its direction changes.

    The direction at hip and knee is the sign of `signs[cycle] + feedback @ features`. The array `features` describes the motion
    of the leg in the current cycle, shape (4,): e / q_bound of hip and knee, then e' / `RATE` of hip and knee. e is the tracking
    error.
    """

    signs: Vector  # sign of the planned direction, one row per cycle, columns: hip and knee; shape (cycles + 1, 2)
    #: weights of the `features`: one row for each joint (hip, knee), one column for each feature; shape (2, FEATURES)
    feedback: Vector


class Start(NamedTuple):
    """State of the leg at the stance change."""

    deviation: Pair  # angle minus nominal angle, of hip and knee [rad]
    rate: Pair  # speed minus nominal speed, of hip and knee [rad/s]
    #: Torque jump at the stance change, of hip and knee [Nm].
    #: The jump is the motor torque before the stance change minus the torque that gives the nominal acceleration after it.
    carried: Pair
    ahead: Pair  # real speed minus measured speed of hip and knee [rad/s], caused by the delay of the measurement


class Goal(NamedTuple):
    """Desired motion of the plant, and the guide around this motion."""

    q: Vector  # desired angles of hip and knee (columns) in each cycle (row) [rad], shape (cycles + 1, 2)
    qd: Vector  # desired speeds of hip and knee (columns) in each cycle (row) [rad/s], shape (cycles + 1, 2)
    #: distances from the desired angle to the guide edge [rad], shape (2, cycles + 1, 2). Axes: joint, cycle, edge (upper, lower)
    bounds: Vector


class Walked(NamedTuple):
    """Result of a simulated step."""

    ratio: float  # largest ratio |e| / q_bound of the step; above 1: a joint was outside the guide
    cycle: int  # cycle with the largest ratio |e| / q_bound
    joint: int  # joint with the largest ratio |e| / q_bound: 0 for the hip, 1 for the knee
    log: Vector  # values of each cycle, shape (cycles + 1, len(LOG)). If the step ends early, the remaining rows are zero.


@dataclass(frozen=True)
class Setup:
    """Gait, robot and model with which a guide is checked."""

    robot: Robot
    gait: Gait
    config: AirwalkConfig
    exoskeleton: ExoskeletonParameters

    @functools.cached_property
    def articulated(self) -> ArticulatedModel:
        """Return the model of the empty exoskeleton with the pelvis fixed."""
        return pinocchio_model(urdf(self.exoskeleton, self.robot))

    def controller(self, shape: GuideShape) -> AirwalkController:
        """Return a controller for a guide shape.

        Args:
            shape: shape of the guide.
        """
        return AirwalkController(self.robot, self.gait, shape, self.config, self.exoskeleton)

    def plant(self, condition: Condition) -> Plant:
        """Return the ideal plant of the swing leg.

        Args:
            condition: deviation of the plant from the model.
        """
        friction = self.config.friction
        pair = [LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")]
        dry, viscous = np.array(friction.coulomb)[pair], np.array(friction.viscous)[pair]
        return plant(self.articulated, self.gait, self.robot, (dry, viscous, friction.smoothing), condition)


class IdealLeg:
    """Simulated left leg that swings, for one guide and one assistance factor."""

    def __init__(self, setup: Setup, controller: AirwalkController, xi: float) -> None:
        """Compute the nominal motion and the bounds of the guide at every cycle of a step.

        Args:
            setup: gait, robot and model.
            controller: controller of the guide; each step restarts it.
            xi: assistance factor in [0, 1].
        """
        self._setup, self._controller, self._xi = setup, controller, xi
        gait = setup.gait
        coefficients, duration, end = gait.coefficients[[HIP, KNEE]], gait.duration, setup.config.alpha * gait.duration
        self.cycles = gait.cycles
        time: Vector = np.arange(self.cycles + 1, dtype=np.float64) * PERIOD
        phase: Vector = time / duration
        x: Vector = np.minimum(time / end, 1.0)[:, None]
        #: Nominal angles [rad], speeds [rad/s] and accelerations [rad/s2] of hip and knee, each of shape (cycles + 1, 2).
        self.nominal: tuple[Vector, Vector, Vector] = motion(coefficients, duration, phase)
        # The desired motion begins at the start state and reaches the nominal motion at the time `end`.
        # Remaining angle deviation = angle deviation at the start * `_s[0]` + speed deviation at the start * `_s[1]`.
        self._s = 1.0 - 3.0 * x**2 + 2.0 * x**3, end * (x - 2.0 * x**2 + x**3)
        # `_sd` is the time derivative of `_s`.
        self._sd = (-6.0 * x + 6.0 * x**2) / end, 1.0 - 4.0 * x + 3.0 * x**2
        self.bounds: Vector = controller.guide_at(xi).shape.bounds(phase, xi)
        self._mean = gait.tables().q.mean(axis=0)
        self._row = np.concatenate([self._mean, np.zeros(len(JOINTS))])

    def goal(self, start: Start) -> Goal:
        """Return the desired motion of a step, and the guide around this motion.

        The desired motion is the nominal motion plus a polynomial that removes the deviation at the stance change.

        Args:
            start: state at the stance change.
        """
        (q, qd, _), d, r = self.nominal, np.array(start.deviation), np.array(start.rate)
        return Goal(q + d * self._s[0] + r * self._s[1], qd + d * self._sd[0] + r * self._sd[1], self.bounds)

    def walk(self, plant: Plant, start: Start, push: Push, box: Pair, noise: Vector) -> Walked:
        """Simulate one walking step, from the stance change to the end of the step.

        Args:
            plant: constants of the plant.
            start: state at the stance change.
            push: push of the step.
            box: largest push at hip and knee [Nm].
            noise: noise of the encoders and numbers in [0, 1] for lost frames, shape (cycles + 1, 4); see `noise_of`.
        """
        goal = self.goal(start)
        before = inverse_dynamics(plant, goal.q[0], goal.qd[0], self.nominal[2][0]) + np.array(start.carried)
        self._change_step(goal.q[0], goal.qd[0], before)
        log = np.zeros((self.cycles + 1, len(LOG)))
        leg = np.concatenate([goal.q[0], goal.qd[0] + np.array(start.ahead)])
        episode = Episode(plant, goal, push, np.array(box), noise, before, self._row, log)
        controller = self._controller
        ratio, cycle, joint = _walk()(episode, leg, controller._measured, controller.guide.tables, controller._parts)
        return Walked(float(ratio), int(cycle), int(joint), log)

    def image(self, start: Start) -> Vector:
        """Return the largest tracking errors at which the controller can still keep both joints inside the guide.

        For such an error, the safety value h is at least 0, so the backup policy can keep both joints inside the guide. Only the
        angle of one joint deviates from the desired motion. The angle of the second joint and both speeds do not deviate. The set
        of all states with h >= 0 is called the safe backward image.

        Args:
            start: state at the stance change.

        Returns:
            Sizes of the largest errors [rad], shape (2, cycles + 1, 2). The axes are joint, cycle, and sign of the error (+, -).
            Only every tenth cycle has values. The other cycles are NaN.
        """
        goal, controller = self.goal(start), self._controller
        self._change_step(goal.q[0], goal.qd[0], np.zeros(2))
        image = np.full((2, self.cycles + 1, 2), math.nan)
        _image()(goal, self._row, image, controller._measured, controller.guide.tables, controller._parts)
        return image

    def _change_step(self, q: Vector, qd: Vector, before: Vector) -> None:
        """Start a right-stance step of the controller."""
        position, velocity, torque = self._mean.copy(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
        position[[HIP, KNEE]], velocity[[HIP, KNEE]], torque[[HIP, KNEE]] = q, qd, before
        state = _state(position, velocity, torque, self._xi)
        controller = self._controller
        controller.reset(state)
        controller._change_step(state, RIGHT)


class Episode(NamedTuple):
    """Inputs of `walk_step`."""

    plant: Plant
    goal: Goal
    push: Push
    box: Vector  # largest push at hip and knee [Nm], shape (2,)
    #: result of `noise_of`: encoder noise [rad] and random numbers that select lost frames, shape (cycles + 1, 4)
    noise: Vector
    before: Vector  # torque before the stance change [Nm], shape (2,)
    #: Angles of the twelve joints [rad], then their speeds [rad/s], shape (24,).
    #: All joints except SH and SK of the swing leg keep these values during the step. The values of SH and SK are not used.
    other: Vector
    log: Vector  # values of each cycle, overwritten by `walk_step`, shape (cycles + 1, len(LOG))


def noise_of(cycles: int, condition: Condition, generator: np.random.Generator) -> Vector:
    """Draw encoder noise [rad] (columns 0 and 1) and numbers in [0, 1) for the choice of lost frames (columns 2 and 3).

    Args:
        cycles: number of cycles in a step.
        condition: deviation of the plant. Only its encoder noise is used.
        generator: source of the random numbers.

    Returns:
        Random numbers, shape (cycles + 1, 4): noise at the hip, noise at the knee, loss of measurement, loss of command.
    """
    noise = np.empty((cycles + 1, 4))
    noise[:, :2] = condition.noise * generator.standard_normal((cycles + 1, 2))
    noise[:, 2:] = generator.random((cycles + 1, 2))
    return noise


def walk_step(
    episode: Episode, leg: Vector, measured: Measured, guide: GuideTables, parts: Parts
) -> tuple[float, int, int]:
    """Simulate one walking step on the ideal plant.

    Args:
        episode: inputs, and the log that is written.
        leg: angles [rad] and speeds [rad/s] of hip and knee, shape (4,), updated.
        measured: inputs of the controller, overwritten.
        guide: tables of the guide.
        parts: parts of the controller.

    Returns:
        Largest |e| / q_bound, and the cycle and the joint with this ratio.
    """
    constants, goal, push, box, noise, before, row, log = episode
    count, cycles = len(measured.q), len(goal.q) - 1
    motor, latched, last = before.copy(), before.copy(), before.copy()
    waiting = np.zeros((constants.delay + 1, 2))
    for i in range(len(waiting)):
        waiting[i] = last
    read, filtered, features = leg[:2].copy(), goal.qd[0].copy(), np.zeros(FEATURES)
    measured.q[:], measured.qd[:] = row[:count], row[count:]
    measured.attitudes[:], measured.gyros[:], measured.sent[:] = 0.0, 0.0, 0.0
    for i in range(len(measured.attitudes)):
        measured.attitudes[i, 0] = 1.0
    desired = row.copy()
    torque, joints = parts.outputs[0].torque, (HIP, KNEE)
    largest, largest_cycle, largest_joint, ratio = 0.0, 0, 0, 0.0
    for cycle in range(cycles + 1):
        for i in range(2):
            e = leg[i] - goal.q[cycle, i]
            ratio = e / goal.bounds[i, cycle, 0] if e > 0.0 else e / goal.bounds[i, cycle, 1]
            features[i], features[2 + i] = ratio, (leg[2 + i] - goal.qd[cycle, i]) / RATE
            log[cycle, i], log[cycle, 2 + i], log[cycle, 8 + i] = e, ratio, leg[2 + i] - goal.qd[cycle, i]
            if abs(ratio) > largest:
                largest, largest_cycle, largest_joint = abs(ratio), cycle, i
        if largest > FAR_OUTSIDE or not math.isfinite(leg[0]) or not math.isfinite(leg[1]):
            break
        for i in range(2):
            position = leg[i] + noise[cycle, i]
            if cycle > 0:
                filtered[i] = constants.keep * filtered[i] + (1.0 - constants.keep) * (position - read[i]) / PERIOD
            read[i] = position
            if noise[cycle, 2] >= constants.loss or cycle == 0:
                measured.q[joints[i]], measured.qd[joints[i]] = position, filtered[i]
        for i in range(2):
            desired[joints[i]], desired[count + joints[i]] = goal.q[cycle, i], goal.qd[cycle, i]
            measured.sent[joints[i]] = last[i]
        run(cycle, False, desired, measured, guide, parts)
        for i in range(2):
            last[i] = limited(constants, i, torque[joints[i]], last[i], measured.qd[joints[i]])
            level = push.signs[cycle, i]
            for k in range(FEATURES):
                level += push.feedback[i, k] * features[k]
            d = box[i] if level >= 0.0 else -box[i]
            log[cycle, 4 + i], log[cycle, 6 + i] = d, last[i]
            motor[i] += constants.tracking * (latched[i] - motor[i])
        if cycle < cycles:
            advance(constants, leg, motor[0] + log[cycle, 4], motor[1] + log[cycle, 5])
        # `waiting` is a ring buffer. The drives apply the command of this cycle `1 + constants.delay` cycles later.
        waiting[cycle % len(waiting)] = last
        if noise[cycle, 3] >= constants.loss:
            latched[:] = waiting[(cycle + 1) % len(waiting)]
    return largest, largest_cycle, largest_joint


def safe_errors(goal: Goal, row: Vector, image: Vector, measured: Measured, guide: GuideTables, parts: Parts) -> None:
    """Find the largest tracking errors at which the controller can still keep both joints inside the guide.

    A bisection finds the errors of each joint at every tenth cycle. An error is safe if the controller returns h >= 0. Then the
    backup policy can keep both joints inside the guide.

    Args:
        goal: desired motion and guide.
        row: angles [rad], then speeds [rad/s] of all joints, shape (24,); the values of hip and knee are ignored.
        image: sizes of the largest safe errors [rad], written at every tenth cycle, shape (2, cycles + 1, 2). The axes are
            joint, cycle, and sign of the error (+, -).
        measured: inputs of the controller, overwritten.
        guide: tables of the guide.
        parts: parts of the controller.
    """
    count, desired, joints = len(measured.q), row.copy(), (HIP, KNEE)
    measured.q[:], measured.qd[:] = row[:count], row[count:]
    measured.attitudes[:], measured.gyros[:], measured.sent[:] = 0.0, 0.0, 0.0
    for i in range(len(measured.attitudes)):
        measured.attitudes[i, 0] = 1.0
    for cycle in range(0, len(goal.q), 10):
        for joint in range(2):
            for side in range(2):
                sign, inside, outside = 1.0 - 2.0 * side, 0.0, goal.bounds[joint, cycle, side]
                for _ in range(10):
                    middle = 0.5 * (inside + outside)
                    for i in range(2):
                        angle, rate = goal.q[cycle, i], goal.qd[cycle, i]
                        desired[joints[i]], desired[count + joints[i]] = angle, rate
                        measured.q[joints[i]], measured.qd[joints[i]] = angle, rate
                    measured.q[joints[joint]] += sign * middle
                    if run(cycle, False, desired, measured, guide, parts)[1] >= 0.0:
                        inside = middle
                    else:
                        outside = middle
                image[joint, cycle, side] = inside


@functools.cache
def _image() -> Any:
    return compiled(safe_errors)


@functools.cache
def _walk() -> Any:
    return compiled(walk_step)


def _state(position: Vector, velocity: Vector, torque: Vector, xi: float) -> State:
    """Return the state that the HAL passes to the controller at the stance change. No fault is active."""
    attitude = np.zeros((len(IMUS), 4))
    attitude[:, 0] = 1.0
    zero = np.zeros(len(JOINTS))
    return State(
        cycle=0,
        time=0.0,
        supervisor=SupervisorState.ACTIVE,
        assistance_factor=xi,
        position=position,
        velocity=velocity,
        torque=torque,
        temperature=zero,
        drive_state=zero,
        imu_quaternion=attitude,
        imu_gyro=np.zeros((len(IMUS), 3)),
        imu_accel=np.zeros((len(IMUS), 3)),
        foot_force=np.zeros((len(FEET), len(CELLS), 3)),
        vibration=np.zeros(len(MOTORS)),
        valid=np.ones(1, np.bool_),
        age=np.zeros(1, np.int64),
        joints_valid=True,
        torque_sent=torque,
    )
