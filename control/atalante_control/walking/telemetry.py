"""Recorded values (telemetry) and statistics of the walking controller.

`q_des, loads, DCM, attitude -> recorded telemetry`

DCM is the divergent component of motion, see `walking.dcm`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from atalante_control.guide.kernel import Guard
from atalante_control.guide.statistics import GuideStatistics
from atalante_control.structured import Records, dtype_of
from atalante_control.walking.dcm import Balance
from atalante_hal.robot import JOINTS
from atalante_hal.types import Vector


class Telemetry:
    """Telemetry of one cycle of a walk.

    The DCM is relative to the stance foot, or to the middle between the feet while no foot swings.
    """

    q_des: Annotated[Vector, len(JOINTS)]  # rad
    dcm: Annotated[Vector, 2]  # m, measured divergent component of motion (DCM) in the walking frame
    dcm_error: Annotated[Vector, 2]  # m, measured minus nominal DCM
    pressure_shift: Annotated[Vector, 2]  # m, shift of the centre of pressure that the ankle stabiliser requests
    load: Annotated[Vector, 2]  # N, filtered vertical force on the left and the right foot
    vertical: Annotated[Vector, 3]  # upward unit vector in the axes of the pelvis
    #: m, position (x, y) of the left sole, then of the right sole, each at its last landing. x is along the desired line.
    feet: Annotated[Vector, 4]
    yaw: float  # rad, mean heading of the soles relative to the desired line at the last landing
    phase: float  # value of `phases.Phase`
    step: float  # number of completed steps
    stance: float  # 0 left, 1 right
    elapsed: float  # s, time since the start of the phase
    max_dcm_error: float  # m, largest error of the DCM in the steps so far
    assistance_factor: float  # assistance factor: 0 (widest guide) to 1 (no guide); 1 in every phase without a guide
    # The controller reads the fields from `error` to `gate` as one vector. Without a guide, and after a guide that ended early,
    # `h` is 1, and the other three fields are 0. After the nominal end of a guided step, the last values are kept.
    error: Annotated[Vector, 2]  # rad, q - q_des of sagittal hip and knee of the swing leg
    q_bound: Annotated[Vector, 2]  # rad, distance from q_des to the bound of the guide on the side of `error`
    h: float  # safety value h of the paper: at least 0 if the backup policy can keep both joints inside the guide
    gate: float  # weight of the backup torque, 0 (free motion) to 1 (full backup torque); published as `lambda`


#: s, time from the start of a step until `max_dcm_error` includes the DCM error. Until then, the landed foot is not at rest.
_SETTLED = 0.1
_DTYPE = dtype_of(Telemetry)
#: Name and number of values of each published field, in the order of the record.
TELEMETRY_FIELDS = tuple(
    ({"gate": "lambda"}.get(name, name), _DTYPE[name].itemsize // 8) for name in _DTYPE.names or ()
)


@dataclass
class WalkStatistics:
    """Statistics of a walk since `reset`."""

    steps: int = 0  # completed steps of the periodic gait
    unnoticed: int = 0  # steps that ended without a detected landing
    guide: GuideStatistics = field(default_factory=GuideStatistics)  # statistics of all guided cycles


def write_telemetry(
    telemetry: Records[Telemetry],
    time: float,
    stepping: bool,
    desired: Vector,
    load: Vector,
    balance: Balance,
    up: Vector,
) -> None:
    """Write the telemetry values that change in each cycle.

    The controller writes the values that stay constant during a phase, at the start of the phase.

    Args:
        telemetry: record to write, shape (1,).
        time: time since the start of the phase [s].
        stepping: whether one foot swings.
        desired: q_des [rad], then q_des' [rad/s], shape (24,).
        load: filtered vertical forces on both feet, shape (2,) [N].
        balance: DCM of the cycle.
        up: upward unit vector in the axes of the pelvis, shape (3,).
    """
    record = telemetry[0]
    for i in range(len(record.q_des)):
        record.q_des[i] = desired[i]
    for k in range(2):
        record.dcm[k], record.dcm_error[k] = balance.dcm[k], balance.error[k]
        record.pressure_shift[k], record.load[k] = balance.shift[k], load[k]
    for k in range(3):
        record.vertical[k] = up[k]
    record.elapsed = time
    if stepping and time >= _SETTLED:
        record.max_dcm_error = max(record.max_dcm_error, math.hypot(balance.error[0], balance.error[1]))


def write_guide(telemetry: Records[Telemetry], guard: Guard, errors: tuple[float, float]) -> tuple[float, float]:
    """Write the telemetry of a cycle with a guide, and return `q_bound` of sagittal hip and knee [rad].

    `q_bound` is the distance from q_des to the bound of the guide, on the side of the present error.

    Args:
        telemetry: record to write, shape (1,).
        guard: record of the guide filter after the tick of the cycle.
        errors: q - q_des of SH and SK of the swing leg [rad].
    """
    record = telemetry[0]
    for i in range(2):
        record.error[i] = errors[i]
        record.q_bound[i] = guard.bounds[2 * i if errors[i] > 0.0 else 2 * i + 1]
    record.h, record.gate = guard.h, guard.gate
    return record.q_bound[0], record.q_bound[1]
