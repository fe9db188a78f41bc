"""Sections of a walk: each section is a group of successive steps with the same gait.

`gaits, number of steps -> phase tables, swing leg and guides of the section`

A walk has one section for each periodic gait, in walking order. A speed change is the end of a section: the next step has the
gait of the next section. This step starts at the last pose of the old gait, and the re-centring leads to the new gait.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.recentering import Deadbeat
from atalante_control.gait.walk import WalkGaits
from atalante_control.guide.certificate import Certificate
from atalante_control.guide.literal import LiteralConfig, LiteralGuide, no_promise
from atalante_control.guide.shapes import GuideShape
from atalante_control.guide.step_guides import Choice, StepGuides
from atalante_control.joint.flat_foot import recentring_rows
from atalante_control.joint.pid import LEFT, RIGHT
from atalante_control.model import ArticulatedModel, ExoskeletonParameters
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.kernel import Assistance
from atalante_control.walking.kinematics import Kinematics
from atalante_control.walking.phases import Phase
from atalante_control.walking.reference import PhaseTable, Reach, shift_tables, step_table
from atalante_control.walking.standing import Standing
from atalante_control.walking.swing_leg import swing_leg
from atalante_hal.robot import JOINTS, LEG_JOINTS, Robot
from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

_N = len(JOINTS)
#: Number of steps without a virtual guide after a change of the gait: one step with each leg.
#: A guide is certified only for steps that start near the gait. After the change, the first step of each leg starts too far
#: from the new gait.
_JOINING = 2
_SH, _SK = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")


class Section(NamedTuple):
    """Section of a walk: a number of periodic steps with one gait."""

    #: Periodic step, start step and stop step. The start step is used only in the section in which the walk begins.
    #: The stop step is used only in the section in which the walk ends.
    gaits: WalkGaits
    steps: int  # number of periodic steps


class Models(NamedTuple):
    """Models of the robot and the patient."""

    robot: Robot  # limits of the joints
    worn: ArticulatedModel  # robot with the patient, with a fixed pelvis
    gravity: Gravity  # gravity torques u_g of the robot without the patient
    kinematics: Kinematics  # kinematics of the robot with the patient
    exoskeleton: ExoskeletonParameters  # geometry of the exoskeleton, adjusted to the patient


class SectionMotion:
    """Phase tables of a section, and virtual guides of the swing leg.

    Attributes:
        guided: index (within the walk) of the first periodic step of the section that can be guided.
        end: number of periodic steps of the walk at the end of the section.
        duration: nominal duration of a periodic step [s].
        tables: table of each phase for each stance leg.
        assistance: guide of the current step.
    """

    def __init__(self, section: Section, before: int, models: Models, config: WalkConfig, shape: GuideShape) -> None:
        """Compute the tables and build the guides.

        Args:
            section: gaits and number of steps.
            before: number of periodic steps before the section.
            models: models of the robot and the patient.
            config: parameters of the controller.
            shape: shape of the virtual guide.

        Raises:
            GaitError: If a pose of the weight shift cannot be reached.
            ValueError: If the section has no step.
        """
        gaits, steps = section
        if steps < 1:
            raise ValueError(f"a section must have at least one step, got {steps}")
        self.guided = before + _JOINING if before else 0
        self.end, self.duration = before + steps, gaits.step.duration
        self.tables = _tables(gaits, models, config)
        _, worn, gravity, kinematics, _ = models
        guide = config.guide
        swinging = swing_leg(gaits.step, config.guided_alpha, worn, kinematics, gravity, guide.friction)
        # On the ground, the guide ends at the landing. So its prediction needs no cycles after the end of the step (overlap 0).
        self._guides = StepGuides(guide, models.robot, shape, swinging.leg, _fading(config.engage), 0)
        self._literal = LiteralGuide(
            LiteralConfig(config.gains.swing, guide.promise, guide.zeta, guide.idealization, guide.feedforward),
            shape,
            swinging.leg,
            gaits.step.tables().uf[:, [_SH, _SK]],
        )
        self._literal_law = config.literal_law
        self.assistance = Assistance(
            self._guides.filters[-1].tables, self._literal.tables, swinging.unmodelled.copy(), _fading(config.release)
        )

    def prepare(self) -> None:
        """Choose and store the guide for every assistance factor, before the walk (`StepGuides.prepare`)."""
        if not self._literal_law:
            self._guides.prepare()

    def certificate(self, xi: float) -> Certificate:
        """Return the certificate of a guide: the disturbance torques that the guide provably withstands.

        Args:
            xi: assistance factor in [0, 1].
        """
        if self._literal_law and xi < 1.0:
            return no_promise(self._guides.filters[0].shape.name, xi)
        return self._guides.certificate(xi)

    def start_guide(self, xi: float, angles: Pair, rates: Pair) -> float:
        """Start the guide of a step, and return which fraction of the requested disturbance torques is certified.

        Args:
            xi: assistance factor in [0, 1].
            angles: deviations of sagittal hip and knee of the swing leg at the start of the step [rad].
            rates: speed deviations of these joints [rad/s].
        """
        guide, promise = Choice(self._guides.filters[0], 0.0) if self._literal_law else self._guides.at(xi)
        if self._literal_law:
            self._literal.start_step(xi, angles, rates)
        guide.start_step(xi, angles, rates, promise)
        self.assistance = self.assistance._replace(guide=guide.tables)
        return promise


def _fading(duration: float) -> Vector:
    """Return a factor for each cycle. The factors fall from 1 to 0 along a half cosine within a duration [s]."""
    factors: Vector = 0.5 + 0.5 * np.cos(math.pi * np.arange(round(duration / PERIOD)) * (PERIOD / duration))
    return factors


def _tables(gaits: WalkGaits, models: Models, config: WalkConfig) -> dict[tuple[Phase, int], PhaseTable]:
    """Return the table of each phase of a walk, for each possible stance leg.

    A walk starts on the right foot and can stop on either foot.
    """
    robot, worn, gravity, kinematics, exoskeleton = models
    standing = Standing(worn, gravity, exoskeleton, robot)
    tables: dict[tuple[Phase, int], PhaseTable] = {}
    steps = {Phase.START: gaits.start, Phase.STEP: gaits.step, Phase.STOP: gaits.stop}
    for phase, gait in steps.items():
        for stance in (LEFT, RIGHT):
            speed, alphas = config.reach_speed[phase is Phase.STOP], (config.alpha, config.guided_alpha)
            reach = Reach(speed, config.reach_rate, config.reach_time, config.reach_knee)
            tables[phase, stance] = step_table(gait, stance, alphas, reach, kinematics, exoskeleton.toe_out)
    ahead, _ = shift_tables(standing.shift(gaits.start.coefficients[:, 0], RIGHT), config.shift, config.alpha)
    tables[Phase.SHIFT, RIGHT] = ahead
    tables[Phase.POSTURE, RIGHT] = _held(ahead, 0, config.posture)
    tables[Phase.STAND, RIGHT] = _held(ahead, 0, config.settle)
    for stance in (LEFT, RIGHT):
        last = tables[Phase.STOP, stance].rows[-1, :_N]
        _, back = shift_tables(standing.shift(last, stance), config.shift, config.alpha)
        tables[Phase.BACK, stance] = back
        tables[Phase.REST, stance] = _held(back, -1, config.settle)
    return tables


def _held(table: PhaseTable, row: int, duration: float) -> PhaseTable:
    """Return the table of a phase that moves the robot from the measured pose to one constant target pose.

    All rows of the result contain the target pose. The motion is the re-centring: a polynomial from the measured pose to the
    target pose.

    Args:
        table: table that contains the target pose.
        row: index of the row with the target pose.
        duration: duration of the motion [s].
    """
    count = round(duration / PERIOD) + 1
    rows, feedforward, dcm = (
        np.repeat(array[[row]], count, axis=0) for array in (table.rows, table.feedforward, table.dcm)
    )
    recentring = recentring_rows(Deadbeat(duration, 1.0), count)
    return table._replace(rows=rows, feedforward=feedforward, dcm=dcm, recentring=recentring, guided=recentring)
