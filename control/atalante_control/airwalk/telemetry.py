"""Telemetry and statistics of the controller: `q_des, tracking errors, guide -> recorded telemetry, statistics`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from atalante_control.guide.kernel import Joint
from atalante_control.structured import Records, dtype_of
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

Pair = tuple[float, float]


class Telemetry:
    """Telemetry of one cycle. Each pair except `guide` has a value for SH and a value for SK of the swing leg."""

    q_des: Annotated[Vector, len(JOINTS)]  # rad
    error: Annotated[Vector, 2]  # rad, q - q_des
    q_bound: Annotated[Vector, 2]  # rad, distance from q_des to the upper bound for error > 0, else to the lower bound
    guide: Annotated[Vector, 2]  # rad, distances from q_des to the upper and to the lower bound of the guide
    h: Annotated[Vector, 2]  # safe backward image function
    gate: Annotated[Vector, 2]  # weight of the backup torque, lambda + (1 - lambda) lambda_d; published as `lambda`
    filter_active: Annotated[Vector, 2]  # 1 where the filter is active
    step: float  # number of completed right-stance steps
    phase: float  # t / T
    stance: float  # 0 left, 1 right
    assistance_factor: float  # Xi of this step


_DTYPE = dtype_of(Telemetry)
#: Name and number of values of each published field, in the order of the record.
TELEMETRY_FIELDS = tuple(
    ({"gate": "lambda"}.get(name, name), _DTYPE[name].itemsize // 8) for name in _DTYPE.names or ()
)


class Step:
    """Values that are constant during one step."""

    stance: int  # 0 left, 1 right
    completed: int  # number of right-stance steps completed before this step
    cycles: int  # cycles of a step
    xi: float  # assistance factor
    share: float  # weight w of the baseline torque
    intensity: float  # factor of the haptic levels
    active: float  # weight of the backup torque above which the filter counts as active


@dataclass
class AirwalkStatistics:
    """Statistics of the guide. Counting starts after the first completed right-stance step."""

    steps: int = 0  # completed right-stance steps
    cycles: int = 0  # counted cycles
    inside: int = 0  # number of counted cycles with both assisted joints inside the guide
    active: int = 0  # number of counted cycles with the filter active on at least one joint
    max_ratio: float = 0.0  # largest |e| / q_bound
    min_h_at_start: float = 1.0  # smallest value of the safe backward image function h in the first cycle of a step
    hand_overs_exceeded: int = 0  # number of step changes with a deviation larger than the certificate assumes
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
        """Add one cycle of a step to the statistics.

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
    telemetry: Records[Telemetry], step: Step, joints: Records[Joint], cycle: int, desired: Vector, errors: Pair
) -> tuple[Pair, float, float, bool]:
    """Write the telemetry of a cycle.

    Args:
        telemetry: record to write, shape (1,).
        step: values of the step.
        joints: `GuideTables.joints` after the tick of the cycle.
        cycle: cycles since the step change.
        desired: q_des [rad], then q_des' [rad/s], shape (24,).
        errors: q - q_des of SH and SK of the swing leg [rad].

    Returns:
        Distances to the guide on the sides of the errors [rad], the larger |e| / q_bound, the smaller h, and whether the filter
        is active on either joint.
    """
    record, hip, knee = telemetry[0], joints[0], joints[1]
    for i in range(len(record.q_des)):
        record.q_des[i] = desired[i]
    bounds = hip.upper if errors[0] > 0.0 else hip.lower, knee.upper if errors[1] > 0.0 else knee.lower
    for i in range(2):
        joint = joints[i]
        record.error[i], record.q_bound[i] = errors[i], bounds[i]
        record.h[i], record.gate[i] = joint.h, joint.gate
        record.filter_active[i] = joint.gate > step.active
    record.guide[0], record.guide[1] = hip.upper, hip.lower
    record.step, record.phase = step.completed, cycle / step.cycles
    record.stance, record.assistance_factor = step.stance, step.xi
    ratio = max(abs(errors[0]) / bounds[0], abs(errors[1]) / bounds[1])
    return bounds, ratio, min(hip.h, knee.h), max(hip.gate, knee.gate) > step.active
