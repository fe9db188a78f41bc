"""How far a gait of the network is from the solved one of the same subject, and whether that is near enough to walk.

`GaitNetwork, freshly solved gaits -> Deviation each -> findings against the limits`. Off the grid: at the points of the
library a fit is always good, and a distorted gait may still walk.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import Gait, GaitError, check_gait
from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_hal.robot import Robot

Vector = npt.NDArray[np.float64]


class Deviation(NamedTuple):
    """One subject's."""

    angles: Vector  # (n, 12) rad, absolute, along the step
    landing_position: float  # m, of the swing foot when it lands, in the frame of the stance foot
    landing_attitude: float  # rad
    position_defect: float  # rad, largest jump of a joint into the mirrored step
    speed_defect: float  # rad/s
    feedforward: float  # rms of the difference over rms of the solved one
    within_limits: bool  # positions, speeds and feedforward of both steps


class Finding(NamedTuple):
    """A line of the report."""

    name: str
    value: float
    limit: float
    unit: str

    @property
    def ok(self) -> bool:
        """Whether the limit is kept."""
        return self.value <= self.limit


def random_subjects(low: Vector, high: Vector, count: int, seed: int) -> Iterator[Subject]:
    """Subjects anywhere in the box of a network, as a rule off the grid. `low`, `high`: shape (4,), its INPUTS."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        mass, height, length, duration = rng.uniform(low, high).tolist()
        yield Subject(Patient(mass, height), length, round(duration, 3))


def deviation(subject: Subject, gait: Gait, solved: Gait, robot: Robot) -> Deviation:
    """Compare the network's gait with the solved one."""
    ours, theirs = gait.tables(), solved.tables()
    mirrored = gait.mirrored().tables()
    dynamics = stance_dynamics(robot, subject.patient)
    landed = dynamics.swing_foot(theirs.q[-1]).actInv(dynamics.swing_foot(ours.q[-1]))
    try:
        check_gait(gait, robot)
        within_limits = True
    except GaitError:
        within_limits = False
    return Deviation(
        angles=np.abs(ours.q - theirs.q),
        landing_position=float(np.linalg.norm(landed.translation)),
        landing_attitude=float(np.linalg.norm(pinocchio.log3(landed.rotation))),
        position_defect=float(np.abs(ours.q[-1] - mirrored.q[0]).max()),
        speed_defect=float(np.abs(ours.qd[-1] - mirrored.qd[0]).max()),
        feedforward=float(np.sqrt(((ours.uf - theirs.uf) ** 2).mean() / (theirs.uf**2).mean())),
        within_limits=within_limits,
    )


def findings(deviations: Sequence[Deviation]) -> list[Finding]:
    """The report: the worst of all subjects unless the line says otherwise."""
    angles = np.degrees(np.concatenate([d.angles.ravel() for d in deviations]))
    worst = {name: max(getattr(d, name) for d in deviations) for name in Deviation._fields[1:-1]}
    return [
        Finding("joint error, 95th percentile", float(np.percentile(angles, 95)), 0.5, "deg"),
        Finding("joint error, worst", float(angles.max()), 1.5, "deg"),
        Finding("landing foot, position", 1e3 * worst["landing_position"], 3.0, "mm"),
        Finding("landing foot, attitude", math.degrees(worst["landing_attitude"]), 0.3, "deg"),
        Finding("periodicity, position", math.degrees(worst["position_defect"]), 0.1, "deg"),
        Finding("periodicity, speed", worst["speed_defect"], 0.02, "rad/s"),
        Finding("feedforward, rms of the difference", 100.0 * worst["feedforward"], 5.0, "%"),
        Finding("gaits beyond a limit of the robot", float(sum(not d.within_limits for d in deviations)), 0.0, ""),
    ]
