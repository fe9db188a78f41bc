"""Compiled cycle of the virtual guide filter: compute h, then lambda, then u_v of a joint from e, e' and the step tables.

`GuideFilter` prepares the tables and runs `tick` compiled. The flow of the backup policy is linear as long as its torque is
within the limit of the drive (`_linear`). Beyond the limit the rollout is computed cycle by cycle (`limited`): the torque is
constant, and the error is a known drift plus a parabola. When the torque is within the limit again, the flow is linear.

`GuideTables` names the tables, `Joint` the constants and results of a joint.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from atalante_control.gait.gait import PERIOD
from atalante_control.structured import Records
from atalante_hal.types import Vector

Pair = tuple[float, float]


class Joint:
    """Data of one assisted joint: constants, values of the step, and results of the last tick."""

    kp: float  # Nm/rad, Kp of the backup policy
    kd: float  # Nm s/rad, Kd of the backup policy
    inertia: float  # kg m2
    limit: float  # Nm, torque limit of the backup policy
    counted: float  # Nm, torque limit in the rollouts: `limit` minus the reserve
    up: float  # Nm, u_ext_max
    down: float  # Nm, u_ext_min
    phi11: float  # error after one cycle per unit of e
    phi12: float  # s, error after one cycle per unit of e'
    phi21: float  # 1/s, rate of the error after one cycle per unit of e
    phi22: float  # rate of the error after one cycle per unit of e'
    s1: float  # rad/Nm, error after one cycle per unit of disturbance
    s2: float  # rad/(Nm s), rate of the error after one cycle per unit of disturbance
    monotone: bool  # see `BackupPolicy.monotone`
    first: int  # cycle of the first point of the grid
    stride: int  # cycles between two points of the grid
    zeta: float  # s, gain of the derivative term lambda_d
    smoothing: float  # weight of the new value in the low-pass filter of dh/dt
    xi: float  # assistance factor of the step
    fresh: bool  # true before the first tick of a step, when dh/dt is not defined
    h: float  # safe backward image function
    rate: float  # 1/s, dh/dt
    gate: float  # weight of the backup torque, lambda + (1 - lambda) lambda_d
    upper: float  # rad, distance from q_des to the upper bound of the guide
    lower: float  # rad, distance from q_des to the lower bound of the guide
    stepped: int  # number of rollouts computed cycle by cycle


class GuideTables(NamedTuple):
    """Tables of the guide filter for SH and SK of the swing leg, index 0 and 1 of the first axis."""

    joints: Records[Joint]  # (2,) data of SH and SK; `tick` writes its results to them
    flow: Vector  # (2, horizon + 1, 9) flow of the backup policy, a row for each cycle ahead; columns: ERROR to STEADY below
    step: Vector  # (2, horizon + 1, 6) a row for each cycle since the step change; columns: P, DRIFT and BOUND below


ERROR = 0  # columns 0 and 1 of `flow`: predicted error per unit of e and per unit of e'
ERROR_ADDED = 2  # columns 2 and 3 of `flow`: largest error that the disturbance adds, up and down [rad]
TORQUE = 4  # columns 4 and 5 of `flow`: predicted Kp e + Kd e' per unit of e and per unit of e'
TORQUE_ADDED = 6  # columns 6 and 7 of `flow`: largest torque that the disturbance adds, up and down [Nm]
STEADY = 8  # column 8 of `flow`: error caused by a constant disturbance of 1 Nm [rad/Nm]
P = 0  # columns 0 and 1 of `step`: solution P of the undisturbed loop and its rate [rad, rad/s]
DRIFT = 2  # columns 2 and 3 of `step`: error without backup torque and its rate [rad, rad/s]
BOUND = 4  # columns 4 and 5 of `step`: distance from q_des to the guide, upper and lower [rad]

#: Any limit above 1 gives the same lambda. With 2.0, h = 1 - (|e| / q_bound)^2 is still exact down to -3.
_HOPELESS = 2.0  # a prediction ends early at this |e| / q_bound, because lambda is 1 for every value above 1


def tick(guide: GuideTables, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> Pair:
    """Compute the guide torques u_v of SH and SK for one cycle.

    Args:
        guide: tables of the guide filter; the results of the tick are written to `joints`.
        cycle: cycles since the step change, at most the length of the step.
        e_hip: q - q_des of SH [rad].
        ed_hip: q' - q_des' of SH [rad/s].
        e_knee: q - q_des of SK [rad].
        ed_knee: q' - q_des' of SK [rad/s].

    Returns:
        u_v of SH and SK [Nm].
    """
    return (
        _act(guide.joints[0], guide.flow[0], guide.step[0], cycle, e_hip, ed_hip),
        _act(guide.joints[1], guide.flow[1], guide.step[1], cycle, e_knee, ed_knee),
    )


def _act(joint: Joint, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> float:
    ratio = _largest_ratio(joint, flow, step, cycle, e, ed)
    h, rate = 1.0 - ratio * ratio, 0.0
    if not joint.fresh:
        rate = joint.rate + joint.smoothing * ((h - joint.h) / PERIOD - joint.rate)
    weight = damped_gate(gate(h, joint.xi), rate, joint.zeta)
    joint.h, joint.rate, joint.gate, joint.fresh = h, rate, weight, False
    joint.upper, joint.lower = step[cycle, BOUND], step[cycle, BOUND + 1]
    u, limit = -joint.kp * e - joint.kd * ed, joint.limit
    return weight * float(limit if u > limit else -limit if u < -limit else u)


def gate(h: float, xi: float) -> float:
    """Return lambda of the paper, (1 + (Xi^10 - 1) h)^3, clamped to [0, 1]; 1 outside the safe backward image.

    Args:
        h: safe backward image function, at most 1.
        xi: assistance factor in [0, 1].
    """
    if h <= 0.0:
        return 1.0
    base = 1.0 + (xi**10 - 1.0) * h
    return base * base * base if base > 0.0 else 0.0


def damped_gate(gate: float, rate: float, zeta: float) -> float:
    """Return lambda + (1 - lambda) lambda_d, with lambda_d = zeta max(0, -dh/dt) clamped to 1.

    Args:
        gate: lambda, in [0, 1]; the result is then in [0, 1] too.
        rate: dh/dt [1/s].
        zeta: derivative gain [s].
    """
    damping = -zeta * rate
    if damping <= 0.0:
        return gate
    return gate + (1.0 - gate) * damping if damping < 1.0 else 1.0


def _largest_ratio(joint: Joint, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> float:
    """Return the largest |e| / q_bound of this cycle and of the predictions under both extreme disturbances.

    There is a rollout for each bound of the guide. It is computed cycle by cycle only if the drive saturates while it pushes the
    joint away from this bound. If a monotone loop saturates in the other direction, its error stays below that of the linear
    rollout, which is then used.
    """
    worst = float(e / step[cycle, BOUND] if e > 0.0 else -e / step[cycle, BOUND + 1])
    asked = (joint.kp * e + joint.kd * ed) / joint.counted
    ratios, torques = _linear(joint, flow, step, cycle, e, ed)
    for side in range(2):
        against = abs(asked) if not joint.monotone else -asked if side else asked
        if against > 1.0 or torques[side] > 1.0:
            joint.stepped += 1
            worst = max(worst, limited(joint, flow, step, side, cycle, e, ed))
        else:
            worst = max(worst, ratios[side])
    return worst


def _linear(joint: Joint, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> tuple[Pair, Pair]:
    """Return the largest |e| / q_bound and the largest torque / `Joint.counted` of the linear rollouts.

    Each result is a pair: the value under the upper extreme disturbance, then the value under the lower one.
    """
    kp, kd, monotone = joint.kp, joint.kd, joint.monotone
    y, yd = e - step[cycle, P], ed - step[cycle, P + 1]
    above = below = torque_above = torque_below = -math.inf
    first = cycle + int((joint.first - cycle) % joint.stride)
    for point in range(first, len(step), joint.stride):
        now, ahead = step[point], flow[point - cycle]
        e_up, e_down = errors_ahead(ahead, now, y, yd)
        torque = ahead[TORQUE] * y + ahead[TORQUE + 1] * yd + kp * now[P] + kd * now[P + 1]
        up, down = torque + ahead[TORQUE_ADDED], ahead[TORQUE_ADDED + 1] - torque
        if not monotone:
            up, down = abs(up), abs(down)
        above, below = max(above, e_up / now[BOUND]), max(below, e_down / now[BOUND + 1])
        torque_above, torque_below = max(torque_above, up), max(torque_below, down)
    return (above, below), (torque_above / joint.counted, torque_below / joint.counted)


def errors_ahead(flow: Vector, step: Vector, y: float, yd: float) -> Pair:
    """Return the largest e and the largest -e of a linear rollout at a point ahead [rad].

    Args:
        flow: row of `flow` for the number of cycles to the point.
        step: row of `step` of the point.
        y: e - P at the start of the rollout [rad].
        yd: e' - P' at the start of the rollout [rad/s].
    """
    error = flow[ERROR] * y + flow[ERROR + 1] * yd + step[P]
    return error + flow[ERROR_ADDED], flow[ERROR_ADDED + 1] - error


def limited(joint: Joint, flow: Vector, step: Vector, side: int, cycle: int, e: float, ed: float) -> float:
    """Return the largest |e| / q_bound of a rollout in which the drive saturates.

    Args:
        joint: record of the joint.
        flow: table `flow` of the joint.
        step: table `step` of the joint.
        side: 0: e under the upper extreme disturbance; 1: -e under the lower extreme disturbance.
        cycle: cycles since the step change at the start of the rollout.
        e: error at the start [rad].
        ed: rate of the error at the start [rad/s].
    """
    sign, external = (-1.0, joint.down) if side else (1.0, joint.up)
    limit, horizon, start, worst, linear = joint.counted, len(step) - 1, cycle, 0.0, False
    while cycle < horizon and worst < _HOPELESS:
        u, now, then = -joint.kp * e - joint.kd * ed, step[cycle], step[cycle + 1]
        if -limit <= u <= limit:
            if not linear:
                ratios, torques = _linear(joint, flow, step, cycle, e, ed)
                if torques[side] <= 1.0:
                    return max(worst, ratios[side])
            linear = True
            y, yd = e - now[P], ed - now[P + 1]
            e = then[P] + joint.phi11 * y + joint.phi12 * yd + joint.s1 * external
            ed = then[P + 1] + joint.phi21 * y + joint.phi22 * yd + joint.s2 * external
        else:
            linear = False
            gained = (math.copysign(limit, u) + external) / joint.inertia * PERIOD
            y, yd = e - now[DRIFT], ed - now[DRIFT + 1]
            e = then[DRIFT] + y + (yd + 0.5 * gained) * PERIOD
            ed = then[DRIFT + 1] + yd + gained
        cycle += 1
        # `allowance` is the error under the worst disturbance minus the error under the constant extreme; zero if monotone.
        ahead = flow[cycle - start]
        allowance = ahead[ERROR_ADDED + side] - sign * external * ahead[STEADY]
        worst = max(worst, (sign * e + allowance) / then[BOUND + side])
    return worst
