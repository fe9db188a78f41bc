"""A cycle of the virtual guide filter: `e, e' of a joint, tables of the step -> h -> lambda -> u_v`, as machine code.

`GuideFilter` prepares the tables and runs `tick` compiled. The flow of the backup policy is linear as long as the drive
gives the torque it asks for (`_linear`). Where it does not, the rollout goes cycle by cycle (`limited`): the torque is constant
and the error a known drift plus a parabola, until the drive comes off its limit and the flow is linear for the rest.

Everything is of one joint here: its row of JOINT; `flow`, one row a cycle ahead, shape (horizon + 1, 9); and `step`, one
row a cycle since the step change, shape (horizon + 1, 6).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import PERIOD

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

#: What the filter knows of a joint: what stays, what a step gives it, and what the last tick found.
JOINT = np.dtype(
    [
        *((name, np.float64) for name in ("kp", "kd", "inertia", "limit")),  # the backup policy
        ("counted", np.float64),  # Nm, part of its limit the rollouts count on
        ("up", np.float64),  # Nm, u_ext_max
        ("down", np.float64),  # Nm, u_ext_min
        *((name, np.float64) for name in ("phi11", "phi12", "phi21", "phi22", "s1", "s2")),  # Phi and S of one cycle
        ("monotone", np.bool_),
        ("first", np.int64),  # cycle of the first point of the grid
        ("stride", np.int64),  # cycles from one to the next
        ("zeta", np.float64),  # s
        ("smoothing", np.float64),  # of dh/dt, part of a new value that is taken
        ("xi", np.float64),  # assistance factor of the step
        ("fresh", np.bool_),  # the step has not had a tick: there is no h to compare with
        ("h", np.float64),
        ("rate", np.float64),  # 1/s, dh/dt
        ("gate", np.float64),  # lambda + (1 - lambda) lambda_d
        ("upper", np.float64),  # rad, guide
        ("lower", np.float64),
        ("stepped", np.int64),  # rollouts so far that were not linear
    ]
)
#: Columns of `flow`: what a unit of e and e' becomes as error, then what the disturbance adds to it at most, up and down;
#: the same of the torque Kp e + Kd e'; and the error under a constant 1 Nm.
ERROR, ERROR_ADDED, TORQUE, TORQUE_ADDED, STEADY = 0, 2, 4, 6, 8
#: Columns of `step`: P, P' of the loop; the drift without any torque, and its rate; guide, upper and lower.
P, DRIFT, BOUND = 0, 2, 4

_HOPELESS = 2.0  # |e| / q_bound from which a rollout is left: lambda is 1 from 1 on


def tick(
    joints: npt.NDArray[np.void],
    flow: Vector,
    step: Vector,
    cycle: int,
    e_hip: float,
    ed_hip: float,
    e_knee: float,
    ed_knee: float,
) -> Pair:
    """u_v of SH and SK [Nm], from the tables of SH, then SK. What is found on the way goes into `joints`."""
    return (
        _act(joints[0], flow[0], step[0], cycle, e_hip, ed_hip),
        _act(joints[1], flow[1], step[1], cycle, e_knee, ed_knee),
    )


def _act(joint: Any, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> float:
    ratio = _largest_ratio(joint, flow, step, cycle, e, ed)
    h, rate = 1.0 - ratio * ratio, 0.0
    if not joint["fresh"]:
        rate = joint["rate"] + joint["smoothing"] * ((h - joint["h"]) / PERIOD - joint["rate"])
    weight = damped_gate(gate(h, joint["xi"]), rate, joint["zeta"])
    joint["h"], joint["rate"], joint["gate"], joint["fresh"] = h, rate, weight, False
    joint["upper"], joint["lower"] = step[cycle, BOUND], step[cycle, BOUND + 1]
    u, limit = -joint["kp"] * e - joint["kd"] * ed, joint["limit"]
    return weight * float(limit if u > limit else -limit if u < -limit else u)


def gate(h: float, xi: float) -> float:
    """lambda of the paper, (1 + (Xi^10 - 1) h)^3, clamped to [0, 1]; 1 outside the safe backward image."""
    if h <= 0.0:
        return 1.0
    base = 1.0 + (xi**10 - 1.0) * h
    return base * base * base if base > 0.0 else 0.0


def damped_gate(gate: float, rate: float, zeta: float) -> float:
    """lambda + (1 - lambda) lambda_d with lambda_d = zeta max(0, -dh/dt) clamped to 1; in [0, 1] for lambda in it.

    Args:
        rate: dh/dt [1/s].
        zeta: derivative gain [s].
    """
    damping = -zeta * rate
    if damping <= 0.0:
        return gate
    return gate + (1.0 - gate) * damping if damping < 1.0 else 1.0


def _largest_ratio(joint: Any, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> float:
    """Largest |e| / q_bound now and ahead, under both extremes.

    Only the rollouts along which the drive saturates against the side they are to be held from are stepped: one of a
    monotone loop that saturates the other way stays below the linear rollout, which is kept as its bound.
    """
    worst = float(e / step[cycle, BOUND] if e > 0.0 else -e / step[cycle, BOUND + 1])
    asked = (joint["kp"] * e + joint["kd"] * ed) / joint["counted"]
    ratios, torques = _linear(joint, flow, step, cycle, e, ed)
    for side in range(2):
        against = abs(asked) if not joint["monotone"] else -asked if side else asked
        if against > 1.0 or torques[side] > 1.0:
            joint["stepped"] += 1
            worst = max(worst, limited(joint, flow, step, side, cycle, e, ed))
        else:
            worst = max(worst, ratios[side])
    return worst


def _linear(joint: Any, flow: Vector, step: Vector, cycle: int, e: float, ed: float) -> tuple[Pair, Pair]:
    """Largest |e| / q_bound and largest torque over what is counted on, of the linear rollouts up and down the grid."""
    kp, kd, monotone = joint["kp"], joint["kd"], joint["monotone"]
    y, yd = e - step[cycle, P], ed - step[cycle, P + 1]
    above = below = torque_above = torque_below = -math.inf
    first = cycle + int((joint["first"] - cycle) % joint["stride"])
    for point in range(first, len(step), joint["stride"]):
        now, ahead = step[point], flow[point - cycle]
        e_up, e_down = errors_ahead(ahead, now, y, yd)
        torque = ahead[TORQUE] * y + ahead[TORQUE + 1] * yd + kp * now[P] + kd * now[P + 1]
        up, down = torque + ahead[TORQUE_ADDED], ahead[TORQUE_ADDED + 1] - torque
        if not monotone:
            up, down = abs(up), abs(down)
        above, below = max(above, e_up / now[BOUND]), max(below, e_down / now[BOUND + 1])
        torque_above, torque_below = max(torque_above, up), max(torque_below, down)
    return (above, below), (torque_above / joint["counted"], torque_below / joint["counted"])


def errors_ahead(flow: Vector, step: Vector, y: float, yd: float) -> Pair:
    """Largest e and largest -e [rad] at a point ahead, of a linear rollout. Args: rows of the tables; state less P."""
    error = flow[ERROR] * y + flow[ERROR + 1] * yd + step[P]
    return error + flow[ERROR_ADDED], flow[ERROR_ADDED + 1] - error


def limited(joint: Any, flow: Vector, step: Vector, side: int, cycle: int, e: float, ed: float) -> float:
    """Largest |e| / q_bound ahead where the drive saturates: e under the upper extreme (0), or -e under the lower one (1).

    Args:
        cycle: since the step change.
        e, ed: error [rad] and its rate [rad/s] then.
    """
    sign, external = (-1.0, joint["down"]) if side else (1.0, joint["up"])
    limit, horizon, start, worst, linear = joint["counted"], len(step) - 1, cycle, 0.0, False
    while cycle < horizon and worst < _HOPELESS:
        u, now, then = -joint["kp"] * e - joint["kd"] * ed, step[cycle], step[cycle + 1]
        if -limit <= u <= limit:
            if not linear:
                ratios, torques = _linear(joint, flow, step, cycle, e, ed)
                if torques[side] <= 1.0:
                    return max(worst, ratios[side])
            linear = True
            y, yd = e - now[P], ed - now[P + 1]
            e = then[P] + joint["phi11"] * y + joint["phi12"] * yd + joint["s1"] * external
            ed = then[P + 1] + joint["phi21"] * y + joint["phi22"] * yd + joint["s2"] * external
        else:
            linear = False
            gained = (math.copysign(limit, u) + external) / joint["inertia"] * PERIOD
            y, yd = e - now[DRIFT], ed - now[DRIFT + 1]
            e = then[DRIFT] + y + (yd + 0.5 * gained) * PERIOD
            ed = then[DRIFT + 1] + yd + gained
        cycle += 1
        # What the worst disturbance adds to a constant extreme: nothing in a monotone loop.
        ahead = flow[cycle - start]
        allowance = ahead[ERROR_ADDED + side] - sign * external * ahead[STEADY]
        worst = max(worst, (sign * e + allowance) / then[BOUND + side])
    return worst
