"""Telemetry and statistics of the controller: `q_des, errors, guide -> recorded telemetry, statistics of the guide`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

Pair = tuple[float, float]

#: Telemetry of a cycle; angles in rad, pairs are SH and SK of the swing leg.
TELEMETRY = np.dtype(
    [
        ("q_des", np.float64, len(JOINTS)),
        ("error", np.float64, 2),  # q - q_des
        ("q_bound", np.float64, 2),  # distance to the guide on the side of the error
        ("guide", np.float64, 2),  # distances to the guide, upper and lower
        ("h", np.float64, 2),  # safe backward image function
        ("lambda", np.float64, 2),  # lambda + (1 - lambda) lambda_d
        ("filter_active", np.float64, 2),  # 1 where the filter is active
        ("step", np.float64),  # number of completed right-stance steps
        ("phase", np.float64),  # t / T
        ("stance", np.float64),  # 0 left, 1 right
        ("assistance_factor", np.float64),  # Xi of this step
    ]
)


@dataclass
class AirwalkStatistics:
    """Statistics of the guide from the first completed right-stance step on."""

    steps: int = 0  # completed right-stance steps
    cycles: int = 0  # counted cycles
    inside: int = 0  # counted cycles with both assisted joints in the guide
    active: int = 0  # counted cycles with the filter active on at least one joint
    max_ratio: float = 0.0  # largest |e| / q_bound
    min_h_at_start: float = 1.0  # smallest h in the first cycle of a step
    hand_overs_exceeded: int = 0  # step changes with a deviation beyond the certified hand-over
    factors: set[float] = field(default_factory=set)  # assistance factors of the steps

    @property
    def inside_fraction(self) -> float:
        """Return the fraction of the counted time with both joints in the guide; 0 before the first counted cycle."""
        return self.inside / max(1, self.cycles)

    @property
    def active_fraction(self) -> float:
        """Return the fraction of the counted time with the filter active; 0 before the first counted cycle."""
        return self.active / max(1, self.cycles)

    def count(self, cycle: int, ratio: float, h: float, acting: bool) -> None:
        """Count a cycle of a step.

        Args:
            cycle: cycles since the step change.
            ratio: the larger |e| / q_bound of the two joints.
            h: the smaller h of the two joints.
            acting: whether the filter is active on either joint.
        """
        if self.steps:
            self.cycles += 1
            self.inside += ratio <= 1.0
            self.active += acting
            self.max_ratio = max(self.max_ratio, ratio)
            if cycle == 0:
                self.min_h_at_start = min(self.min_h_at_start, h)


def write_telemetry(
    telemetry: npt.NDArray[np.void],
    row: Vector,
    joints: npt.NDArray[np.void],
    errors: Pair,
    active: float,
    step: int,
    phase: float,
    stance: int,
    xi: float,
) -> tuple[Pair, float, float, bool]:
    """Write the telemetry of a cycle.

    Args:
        telemetry: record to write, shape (1,), dtype TELEMETRY.
        row: q_des [rad], then q_des' [rad/s], shape (24,).
        joints: `GuideFilter.joints` after the tick of the cycle.
        errors: q - q_des of SH and SK of the swing leg [rad].
        active: gate above which the filter counts as active.
        step: completed right-stance steps.
        phase: time in the step over its duration, t / T.
        stance: stance leg, 0 left, 1 right.
        xi: assistance factor of the step.

    Returns:
        Distances to the guide on the sides of the errors [rad], the larger |e| / q_bound, the smaller h, and whether the filter
        is active on either joint.
    """
    record, hip, knee = telemetry[0], joints[0], joints[1]
    for i in range(len(record["q_des"])):
        record["q_des"][i] = row[i]
    bounds = (
        hip["upper"] if errors[0] > 0.0 else hip["lower"],
        knee["upper"] if errors[1] > 0.0 else knee["lower"],
    )
    for i in range(2):
        record["error"][i], record["q_bound"][i] = errors[i], bounds[i]
        record["h"][i], record["lambda"][i] = joints[i]["h"], joints[i]["gate"]
        record["filter_active"][i] = joints[i]["gate"] > active
    record["guide"][0], record["guide"][1] = hip["upper"], hip["lower"]
    record["step"], record["phase"], record["stance"], record["assistance_factor"] = step, phase, stance, xi
    ratio = max(abs(errors[0]) / bounds[0], abs(errors[1]) / bounds[1])
    return bounds, ratio, min(hip["h"], knee["h"]), max(hip["gate"], knee["gate"]) > active
