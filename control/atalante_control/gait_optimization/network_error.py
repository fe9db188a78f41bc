"""Error of the gait network: deviations from solved gaits of the same subjects, and the limits of these deviations.

`GaitNetwork, newly solved gaits -> one Deviation per subject -> findings against the limits`. The subjects lie between
the grid points of the library, because the fit is always good at the grid points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio

from atalante_control.dynamics.gait_network import subject_of
from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import Gait, GaitError, check_gait
from atalante_control.gait.subject import Subject
from atalante_hal.robot import Robot
from atalante_hal.types import Vector


class Deviation(NamedTuple):
    """Errors of the network for one subject. Two gaits are compared: one from the network, one solved by the optimiser."""

    angles: Vector  # (n, 12) rad, absolute difference of the joint angles of the two gaits in each cycle
    #: m, distance between the landing positions of the swing foot in the two gaits, relative to the stance foot
    landing_position: float
    #: rad, angle between the attitudes of the swing foot at the landing in the two gaits, relative to the stance foot
    landing_attitude: float
    #: rad, largest jump of a joint angle at the stance change if the robot walks with the gait from the network
    position_defect: float
    #: rad/s, largest jump of a joint speed at the stance change if the robot walks with the gait from the network
    speed_defect: float
    #: rms difference of the feedforward torques of the two gaits, as a fraction of the rms torque of the solved gait
    feedforward: float
    within_limits: bool  # whether the gait from the network is valid and within the robot limits, see `check_gait`


class Finding(NamedTuple):
    """Line of the report: one error with its limit."""

    name: str
    value: float
    limit: float
    unit: str

    @property
    def ok(self) -> bool:
        """Return whether the value is within the limit."""
        return self.value <= self.limit


def random_subjects(low: Vector, high: Vector, count: int, seed: int) -> Iterator[Subject]:
    """Yield random subjects within the range of a network.

    Args:
        low: smallest valid values of INPUTS, shape (6,).
        high: largest valid values of INPUTS, shape (6,).
        count: number of subjects.
        seed: seed of the random generator.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        mass, height, length, duration, *legs = rng.uniform(low, high).tolist()
        yield subject_of([mass, height, length, round(duration, 3), *legs])


def deviation(subject: Subject, gait: Gait, solved: Gait, robot: Robot) -> Deviation:
    """Compare the gait of the network with the solved gait of the same subject.

    Args:
        subject: patient and step parameters of both gaits.
        gait: gait of the network.
        solved: solved gait.
        robot: limits of the joints.
    """
    made, reference = gait.tables(), solved.tables()
    mirrored = gait.mirrored().tables()
    dynamics = stance_dynamics(robot, subject.patient)
    landed = dynamics.swing_foot(reference.q[-1]).actInv(dynamics.swing_foot(made.q[-1]))
    try:
        check_gait(gait, robot)
        within_limits = True
    except GaitError:
        within_limits = False
    return Deviation(
        angles=np.abs(made.q - reference.q),
        landing_position=float(np.linalg.norm(landed.translation)),
        landing_attitude=float(np.linalg.norm(pinocchio.log3(landed.rotation))),
        position_defect=float(np.abs(made.q[-1] - mirrored.q[0]).max()),
        speed_defect=float(np.abs(made.qd[-1] - mirrored.qd[0]).max()),
        feedforward=float(np.sqrt(((made.uf - reference.uf) ** 2).mean() / (reference.uf**2).mean())),
        within_limits=within_limits,
    )


def findings(deviations: Sequence[Deviation]) -> list[Finding]:
    """Return the report: for each kind of error, the largest value over all subjects and the limit of this value.

    For the joint angles, the report also contains the 95th percentile of the error. The last line is the number of gaits that are
    invalid or beyond a limit of the robot.

    Args:
        deviations: deviation of each subject.
    """
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
