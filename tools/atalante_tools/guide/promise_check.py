"""Check of a guide: search for a push up to the certified torques that moves a joint out of the guide.

`gait, shape, Xi -> Verdict`. The promise of a guide is one torque at the hip and one torque at the knee. The search
(class `Adversary`) uses pushes up to these torques, unless `Task.push` gives other limits. At the start of a step, the leg
deviates from the nominal motion. The hand-over box (`HandOver`) is the range of start deviations for which the promise holds. The
steps of the search start in the centre and in corners of this box. The search runs on the ideal plant. Then the worst pushes are
repeated on the emulated robot, together with constant pushes, pushes that follow the error rate or the sum of error and error
rate, and pushes that switch at random.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.dynamics.gait_network import load_network
from atalante_control.dynamics.suspended import suspended_gait
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.gait.subject import Subject
from atalante_control.guide.certificate import Certificate
from atalante_control.model import ExoskeletonParameters, Patient
from atalante_hal.robot import Robot
from atalante_hal.types import Vector
from atalante_tools.guide.episode import FEATURES, IdealLeg, Push, Setup, Start
from atalante_tools.guide.plant import Condition
from atalante_tools.guide.robot import PushedRobot, RobotWalk
from atalante_tools.guide.search import DIRECTIONS, Adversary, Tried

Pair = tuple[float, float]

#: Deviations from the model of the controller, by value of the option --condition. The search tries all these deviations.
#: For example, the value "friction" stands for two deviations: 80 % and 120 % of the modelled friction.
CONDITIONS: Final = {
    "model": (Condition(),),
    "friction": (Condition(friction=0.8), Condition(friction=1.2)),
    "mass": (Condition(mass=0.9), Condition(mass=1.1)),
    "both": tuple(Condition(friction=f, mass=m) for f, m in itertools.product((0.8, 1.2), (0.9, 1.1))),
    "noise": (Condition(noise=1e-5),),
    "loss": (Condition(loss=0.01),),
    "delay": (Condition(delay=1),),
}
#: Patients of the option --patients: (mass [kg], height [m], step length [m], step duration [s]).
#: The neural gait network computes a gait for each patient.
PATIENTS: Final = (
    (58.0, 1.62, 0.10, 0.9), (58.0, 1.65, 0.15, 0.9), (61.0, 1.65, 0.15, 0.8), (64.0, 1.70, 0.12, 1.0),
    (67.0, 1.68, 0.18, 0.9), (70.0, 1.75, 0.15, 0.9), (73.0, 1.70, 0.10, 0.8), (76.0, 1.80, 0.15, 1.0),
    (80.0, 1.75, 0.18, 0.9), (84.0, 1.80, 0.12, 0.9), (88.0, 1.85, 0.15, 0.9), (91.0, 1.85, 0.15, 0.9),
)  # fmt: skip
#: Number of start states that are corners of the hand-over box (range of deviations at the start of a step).
_CORNERS: Final = 64
#: Lag of the measured velocity of a drive [s], caused by the low-pass filter and by the sampling (half a cycle).
_VELOCITY_LAG: Final = 2.0e-3
#: Largest multiple of the push limits that is tried in the search for the smallest push that moves a joint out of the guide.
LARGEST_FACTOR: Final = 6.0
#: Share of `Effort.steps` that the search simulates for each multiple of the push limits: 150 of 1500 steps. The minimum is
#: 10 steps.
_SHARE: Final = 0.1


@dataclass(frozen=True)
class Effort:
    """Settings for the search in one guide: numbers of steps, and whether to search for larger pushes."""

    steps: int  # number of steps on the ideal plant with pushes up to the push limits of the check
    robot_steps: int  # number of steps on the emulated robot; 0: the robot is not used
    tightness: bool  # whether to search for the smallest push that moves a joint out of the guide


QUICK: Final = Effort(steps=60, robot_steps=0, tightness=False)
COMPLETE: Final = Effort(steps=1500, robot_steps=60, tightness=True)


@dataclass(frozen=True)
class Task:
    """Task to check one guide: conditions, effort, seed and largest push."""

    conditions: Sequence[Condition]  # deviations of the simulated leg and of the emulated robot from the model
    effort: Effort
    seed: int  # seed of the search
    push: Pair | None = None  # largest push at hip and knee [Nm]; None means the certified torques


@dataclass(frozen=True)
class Verdict:
    """Result of the check of one guide. The field names are the JSON keys of `atalante guide check --json`.

    A ratio is |e| / q_bound: the tracking error, divided by the distance from the desired angle to the edge of the guide. If a
    ratio is above 1, a joint was outside the guide.
    """

    shape: str
    xi: float
    gait: str
    certified: bool
    #: Push limit at the hip [Nm]: `Task.push` if the task has one, otherwise the certified torque.
    #: None if the guide has no certified torques and `Task.push` is None. In this case, no push was tried.
    promise_hip_nm: float | None
    #: Push limit at the knee [Nm], see `promise_hip_nm`.
    promise_knee_nm: float | None
    worst_ratio: float | None  # maximum of `plant_ratio` and `robot_ratio`; None if no step was simulated
    steps: int  # total number of steps on the ideal plant and on the emulated robot
    plant_ratio: float | None  # largest ratio |e| / q_bound on the ideal plant; None if no step was simulated
    robot_ratio: float | None  # largest ratio |e| / q_bound on the emulated robot; None if the robot was not used
    worst_push: str  # kind of the worst push on the ideal plant, for example "constant" or "bang-bang"
    worst_condition: str  # deviation of the plant from the model in the worst step, for example "friction +20 %"
    stopped: str  # reason why the robot left ACTIVE; empty if the robot stayed in ACTIVE
    #: smallest multiple of the push limits that moved a joint out of the guide, such as 1.3; None if not searched or not found
    left_at: float | None
    reason: str  # what limits the certified torques, or why there are none

    @property
    def broken(self) -> bool:
        """Return whether a push within the limits moved a joint out of the guide or stopped the robot."""
        return self.worst_ratio is not None and (self.worst_ratio > 1.0 or bool(self.stopped))


@dataclass(frozen=True)
class Checked:
    """Verdict about a guide, with the data for `figure.draw`: the simulated leg and its worst step."""

    verdict: Verdict
    leg: IdealLeg  # simulated leg that swings in the guide
    #: step on the ideal plant with the largest |e| / q_bound; None if the check had no push limits and therefore no search
    worst: Tried | None


def setup_of(subject: Subject | None, robot: Robot, config: AirwalkConfig | None = None) -> Setup:
    """Return gait, robot and model for a check.

    The gait is the default gait, or the gait that the gait network computes for the subject.

    Args:
        subject: patient and step; None means the default gait.
        robot: limits of the joints.
        config: parameters of the controller, except `startup`; None means the defaults.
    """
    exoskeleton, config = ExoskeletonParameters(), replace(config or AirwalkConfig(), startup=0.1)
    if subject is None:
        return Setup(robot, load_gait(AIRWALK_GAIT, robot), config, exoskeleton)
    exoskeleton = exoskeleton.fitted(subject.patient)
    gait = suspended_gait(load_network().gait(subject, robot), exoskeleton, robot)
    return Setup(robot, gait, config, exoskeleton)


def patients() -> list[Subject]:
    """Convert `PATIENTS` to subjects, the inputs of the gait network."""
    return [Subject(Patient(mass, height), length, duration) for mass, height, length, duration in PATIENTS]


def promise_of(certificate: Certificate) -> Pair | None:
    """Return the certified torques at hip and knee [Nm], or None if the guide is not certified.

    Args:
        certificate: certificate of the running guide.
    """
    bound = certificate.promise
    return None if bound is None else (bound.hip, bound.knee)


def starts_of(config: AirwalkConfig, seed: int) -> list[Start]:
    """Return states at the stance change: the centre and corners of the hand-over box (range of start deviations).

    Args:
        config: parameters of the controller.
        seed: seed of the choice of corners.
    """
    box, generator, zero = config.hand_over, np.random.default_rng(seed), (0.0, 0.0)
    torque, lag = box.torque, _VELOCITY_LAG * box.acceleration
    signs = generator.choice([-1.0, 1.0], (_CORNERS, 8))
    signs[: 2**4, :4] = list(itertools.product((-1.0, 1.0), repeat=4))
    return [Start(zero, zero, zero, zero)] + [
        Start(
            (a * box.deviation, b * box.deviation),
            (c * box.rate, d * box.rate),
            (e * torque[0], f * torque[1]),
            (g * lag, h * lag),
        )
        for a, b, c, d, e, f, g, h in signs.tolist()
    ]


def check(setup: Setup, controller: AirwalkController, xi: float, task: Task) -> Checked:
    """Check one guide at one assistance factor.

    Args:
        setup: gait, robot and model.
        controller: controller of the guide.
        xi: assistance factor in [0, 1].
        task: conditions, effort, seed and largest push.
    """
    certificate = controller.certificate(xi)
    leg, box = IdealLeg(setup, controller, xi), task.push or promise_of(certificate)
    conditions, effort = task.conditions, task.effort
    hip, knee = box or (None, None)
    verdict = Verdict(
        certificate.shape, xi, setup.gait.name, certificate.certified, hip, knee, None, 0, None, None, "", "", "", None,
        certificate.reason,
    )  # fmt: skip
    if box is None:
        return Checked(verdict, leg, None)
    adversary = Adversary(setup, leg, conditions, starts_of(setup.config, task.seed), task.seed)
    worst = adversary.search(box, effort.steps)
    walk = RobotWalk((), "")
    if effort.robot_steps:
        walk = _on_robot(PushedRobot(setup, controller, xi), box, adversary.tried, task)
    left_at = None
    if effort.tightness and worst.ratio <= 1.0:
        left_at = adversary.leaving_factor(box, LARGEST_FACTOR, max(10, round(_SHARE * effort.steps)))
    on_robot = None if walk.worst is None else walk.worst.ratio
    verdict = replace(
        verdict,
        worst_ratio=max(worst.ratio, on_robot or 0.0),
        steps=adversary.steps + len(walk.steps),
        plant_ratio=worst.ratio,
        robot_ratio=on_robot,
        worst_push=worst.kind,
        worst_condition=str(worst.condition),
        stopped=walk.stopped,
        left_at=left_at,
    )
    return Checked(verdict, leg, worst)


def _on_robot(robot: PushedRobot, box: Pair, found: Sequence[Tried], task: Task) -> RobotWalk:
    """Push the emulated robot with the worst pushes of the search, and with the pushes of `_robot_pushes`.

    The robot walks once in each condition. `found` contains the worst pushes on the ideal plant, the worst first.
    """
    conditions, seed = task.conditions, task.seed
    cycles = len(found[0].push.signs)
    pushes = [one.push for one in found[:6]] + _robot_pushes(cycles, np.random.default_rng(seed))
    each = -(-task.effort.robot_steps // len(conditions))
    walks = []
    for number, condition in enumerate(conditions):
        first = number * each % len(pushes)  # rotate the list of pushes, so that the walks begin with different pushes
        walks.append(robot.walk(box, [*pushes[first:], *pushes[:first]], condition, each, seed + number))
    stopped = next((walk.stopped for walk in walks if walk.stopped), "")
    return RobotWalk(tuple(step for walk in walks for step in walk.steps), stopped)


def _robot_pushes(cycles: int, generator: np.random.Generator) -> list[Push]:
    """Return constant pushes, pushes that react to the motion of the leg, and pushes that switch at random.

    A push that reacts follows the sign of the error rate of one joint, or of the sum of error and error rate. At the second
    joint, the push has the same direction or the opposite direction.
    """
    none = np.zeros((2, FEATURES))
    pushes = [Push(np.tile(direction, (cycles, 1)), none) for direction in DIRECTIONS]
    for joint, other, (error, rate) in itertools.product((0, 1), (-1.0, 1.0), ((0.0, 1.0), (1.0, 1.0))):
        feedback = np.zeros((2, FEATURES))
        feedback[:, joint], feedback[:, 2 + joint] = error, rate
        feedback[1 - joint] *= other
        pushes.append(Push(np.full((cycles, 2), 1e-6), feedback))
    for slowest in (15.0, 40.0, 100.0, 250.0):
        switches = generator.random((cycles, 2)) < 1.0 / slowest
        signs: Vector = np.where(np.cumsum(switches, axis=0) % 2, -1.0, 1.0)
        pushes.append(Push(signs, none))
    return pushes


def conditions_of(names: Sequence[str]) -> list[Condition]:
    """Return the deviations from the model with the given names, or all deviations if `names` is empty.

    Args:
        names: keys of `CONDITIONS`.
    """
    return [condition for name in names or CONDITIONS for condition in CONDITIONS[name]]
