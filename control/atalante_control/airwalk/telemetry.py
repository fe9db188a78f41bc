"""Telemetry and statistics of the controller: `q_des, tracking errors, guide -> recorded telemetry, statistics`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from atalante_control.guide.kernel import Guard
from atalante_control.guide.statistics import GuideStatistics
from atalante_control.structured import Records, dtype_of
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector

Pair = tuple[float, float]


class Telemetry:
    """Telemetry of one control cycle.

    The two elements of an array with two values are for sagittal hip and knee of the swing leg. Only `guide` has two values of
    the hip.
    """

    q_des: Annotated[Vector, len(JOINTS)]  # rad, desired joint angles
    error: Annotated[Vector, 2]  # rad, q - q_des
    #: Distance from q_des to a guide bound [rad]: to the upper bound if error > 0, else to the lower bound.
    q_bound: Annotated[Vector, 2]
    guide: Annotated[Vector, 2]  # rad, distances from q_des to upper and lower guide bound of the hip
    #: safety value h of the guide filter, equal for hip and knee.
    #: If h >= 0, the backup policy can keep both joints inside the guide.
    h: Annotated[Vector, 2]
    gate: Annotated[Vector, 2]  # weight of the backup torque, the same value for both joints; published as `lambda`
    filter_active: Annotated[Vector, 2]  # 1 while the guide filter is active, else 0; the same for both joints
    step: float  # number of completed right-stance steps
    phase: float  # t / T, time since the start of the step divided by the step duration
    stance: float  # stance leg: 0 left, 1 right
    assistance_factor: float  # Xi of this step


_DTYPE = dtype_of(Telemetry)
#: Published fields in the order of the record. Each element: name of the field, and number of values in the field.
TELEMETRY_FIELDS = tuple(
    ({"gate": "lambda"}.get(name, name), _DTYPE[name].itemsize // 8) for name in _DTYPE.names or ()
)


class Step:
    """Values that are constant during one step."""

    stance: int  # stance leg: 0 left, 1 right
    completed: int  # number of right-stance steps completed before this step
    cycles: int  # number of cycles in a step
    xi: float  # assistance factor Xi of the step
    assisted: bool  # True if hip and knee of the swing leg get the assistive torque; False at assistance factor 1
    intensity: float  # factor of the haptic levels
    literal: bool  # whether the torques follow the formulas of the paper, see `AirwalkConfig.literal_law`
    active: float  # weight of the backup torque above which the guide filter counts as active


@dataclass
class AirwalkStatistics(GuideStatistics):
    """Statistics of the guide. Counting starts after the first completed right-stance step."""

    steps: int = 0  # number of completed right-stance steps

    def count(self, cycle: int, ratio: float, h: float, acting: bool) -> None:
        """Add one cycle to the statistics if at least one right-stance step is completed, see `GuideStatistics.count`."""
        if self.steps:
            super().count(cycle, ratio, h, acting)


def write_telemetry(
    telemetry: Records[Telemetry], step: Step, guard: Guard, cycle: int, desired: Vector, errors: Pair
) -> tuple[Pair, float, bool]:
    """Write the telemetry of a cycle.

    Args:
        telemetry: record to write, shape (1,).
        step: values of the step.
        guard: record of the guide filter after the tick of the cycle.
        cycle: number of cycles since the stance change.
        desired: q_des [rad], then q_des' [rad/s], shape (24,).
        errors: q - q_des of SH and SK of the swing leg [rad].

    Returns:
        Three values: `q_bound` of SH and SK [rad], then the larger of the ratios |e| / q_bound of SH and SK, then whether the
        guide filter is active.
    """
    record, active = telemetry[0], step.assisted and guard.gate > step.active
    for i in range(len(record.q_des)):
        record.q_des[i] = desired[i]
    bounds = guard.bounds[0 if errors[0] > 0.0 else 1], guard.bounds[2 if errors[1] > 0.0 else 3]
    for i in range(2):
        record.error[i], record.q_bound[i] = errors[i], bounds[i]
        record.h[i], record.gate[i], record.filter_active[i] = guard.h, guard.gate, active
    record.guide[0], record.guide[1] = guard.bounds[0], guard.bounds[1]
    record.step, record.phase = step.completed, cycle / step.cycles
    record.stance, record.assistance_factor = step.stance, step.xi
    ratio = max(abs(errors[0]) / bounds[0], abs(errors[1]) / bounds[1])
    return bounds, ratio, active
