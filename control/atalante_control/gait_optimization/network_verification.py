"""Verification of the gait network: its gaits for random subjects get the same checks as solved gaits.

`GaitNetwork, random subjects -> checks of each gait -> worst value per check`. No gait is solved.
A gait of the network gets the same checks as a solved gait, at all samples of `Verifier`. These samples also lie between the
nodes of the optimiser. Only the tolerances differ: the gaits of the network satisfy the equality constraints of the optimiser
approximately.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from atalante_control.dynamics.gait_network import GaitNetwork
from atalante_control.gait.gait import GaitError, check_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.verify import INTERPOLATED, GaitCheck, Verifier
from atalante_hal.robot import Robot


class WorstCheck(NamedTuple):
    """Line of the report about one check: largest value in all gaits, limit, and number of gaits that fail the check."""

    name: str
    value: float
    limit: float
    unit: str
    failures: int


def network_checks(network: GaitNetwork, subject: Subject, robot: Robot) -> tuple[GaitCheck, ...]:
    """Verify the gait of the network for one subject.

    Args:
        network: gait network.
        subject: patient and step parameters, within the range of the network.
        robot: limits of the joints.
    """
    gait = network.gait(subject, robot)
    try:
        check_gait(gait, robot)
        rejected = 0.0
    except GaitError:
        rejected = 1.0
    checks = Verifier(robot, subject.patient).verify(gait, tolerances=INTERPOLATED)
    return (*checks, GaitCheck("gait is rejected as a gait file", rejected, 0.0, ""))


def worst_checks(gaits: Sequence[tuple[GaitCheck, ...]]) -> list[WorstCheck]:
    """Return the worst value of each check over all gaits.

    Args:
        gaits: checks of each gait, in the same order for every gait.
    """
    return [
        WorstCheck(
            same[0].name,
            max(check.value for check in same),
            same[0].limit,
            same[0].unit,
            sum(not check.holds for check in same),
        )
        for same in zip(*gaits, strict=True)
    ]
