"""What the controller tells of a cycle. `q_des, errors, guide -> telemetry for the recording, statistics of the guide`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

#: The telemetry; angles in rad, pairs are the swing leg's SH and SK.
TELEMETRY = np.dtype(
    [
        ("q_des", np.float64, len(JOINTS)),
        ("error", np.float64, 2),  # q - q_des
        ("q_bound", np.float64, 2),  # distance to the guide on the error's side
        ("guide", np.float64, 2),  # distances to the guide, upper and lower
        ("h", np.float64, 2),
        ("lambda", np.float64, 2),  # lambda + (1 - lambda) lambda_d
        ("filter_active", np.float64, 2),
        ("step", np.float64),  # completed right-stance steps
        ("phase", np.float64),  # t / T
        ("stance", np.float64),  # 0 left, 1 right
        ("assistance_factor", np.float64),  # Xi of this step
    ]
)


@dataclass
class AirwalkStatistics:
    """What the guide did from the first completed right-stance step on."""

    steps: int = 0  # completed right-stance steps
    cycles: int = 0  # counted
    inside: int = 0  # of them, both assisted joints in the guide
    active: int = 0  # of them, the filter acting on one
    max_ratio: float = 0.0  # largest |e| / q_bound
    min_h_at_start: float = 1.0  # smallest h at a step's first cycle
    hand_overs_exceeded: int = 0  # step changes with a deviation beyond the certified hand-over
    factors: set[float] = field(default_factory=set)  # assistance factors of the steps

    @property
    def inside_fraction(self) -> float:
        """Part of the counted time with both joints in the guide; 0 before anything is counted."""
        return self.inside / max(1, self.cycles)

    @property
    def active_fraction(self) -> float:
        """Part of the counted time the filter acts."""
        return self.active / max(1, self.cycles)

    def count(self, cycle: int, ratio: float, h: float, acting: bool) -> None:
        """A cycle of a step: largest |e| / q_bound and smallest h of the two joints, and whether the filter acts on one."""
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
        telemetry: shape (1,), of `TELEMETRY`.
        row: q_des, then q_des'.
        joints: of `GuideFilter`.
        active: gate above which the filter counts as acting.

    Returns:
        Distances to the guide on the errors' sides [rad], the larger |e| / q_bound, the smaller h, whether the filter acts.
    """
    told, hip, knee = telemetry[0], joints[0], joints[1]
    for i in range(len(told["q_des"])):
        told["q_des"][i] = row[i]
    bounds = (
        hip["upper"] if errors[0] > 0.0 else hip["lower"],
        knee["upper"] if errors[1] > 0.0 else knee["lower"],
    )
    for i in range(2):
        told["error"][i], told["q_bound"][i] = errors[i], bounds[i]
        told["h"][i], told["lambda"][i] = joints[i]["h"], joints[i]["gate"]
        told["filter_active"][i] = joints[i]["gate"] > active
    told["guide"][0], told["guide"][1] = hip["upper"], hip["lower"]
    told["step"], told["phase"], told["stance"], told["assistance_factor"] = step, phase, stance, xi
    ratio = max(abs(errors[0]) / bounds[0], abs(errors[1]) / bounds[1])
    return bounds, ratio, min(hip["h"], knee["h"]), max(hip["gate"], knee["gate"]) > active
