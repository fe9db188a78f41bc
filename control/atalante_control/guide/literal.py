"""Literal law, the control law exactly as printed in Gurriet et al. (2019): `measured motion of hip and knee -> torque u_a`.

The literal law is for comparisons with this paper. Its certificate contains no certified torques: it is not proven that the
joints stay inside the guide under any disturbance torque.

The torque u_a is u_i + u_f + u_v. u_i cancels friction and gravity (joint idealization), u_f is the feedforward torque of the
gait, and u_v is the torque of the guide. Each joint is treated as a separate inertia, J q'' = u_v + u_f + u_ext, with the
disturbance torque u_ext. The backup torque u_b is the PD part of the baseline PID. In each cycle the motion under u_b is
integrated to the end of the step twice: with the largest and with the smallest constant u_ext. The safety value h is 1 - r^2
with the largest r = |e| / q_bound of both motions, and

    lambda = (1 + (Xi^10 - 1) h)^3,   lambda_d = -zeta dh/dt,   u_v = (lambda + (1 - lambda) lambda_d) u_b.

lambda is 1 for h < 0, where the paper defines no torque. Apart from this, neither lambda nor lambda_d is limited or
filtered. `docs/reference/paper.md` lists what the coupled filter does instead, and why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from atalante_control.guide.certificate import Certificate
from atalante_control.guide.disturbance import Leg
from atalante_control.guide.kernel import Guard, LegState
from atalante_control.guide.shapes import GuideShape
from atalante_control.joint.pid import LegGains
from atalante_control.structured import Records, zeros
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

_ASSISTED = [LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK")]


class LiteralRecord:
    """Constants and state of the literal law. Each array has two elements: sagittal hip, sagittal knee."""

    kp: Annotated[Vector, 2]  # Nm/rad, proportional gain of the backup torque u_b
    kd: Annotated[Vector, 2]  # Nm s/rad, derivative gain of the backup torque u_b
    inertia: Annotated[Vector, 2]  # kg m2, inertia J of the joint
    coulomb: Annotated[Vector, 2]  # Nm, Coulomb friction k_d
    viscous: Annotated[Vector, 2]  # Nm s/rad, viscous friction k_v
    push: Annotated[Vector, 2]  # Nm, largest absolute value of the external torque u_ext
    #: Gain zeta [s] of the rate of change of the safety value h. While h falls, zeta increases the weight of the backup
    #: torque u_b. While h rises, zeta decreases this weight. With zeta = 0, the rate of change of h has no effect.
    zeta: float
    idealization: float  # factor in [0, 1] on the torque u_i, which cancels friction and gravity (joint idealization)
    xi: float  # assistance factor of the step, from 0 (widest guide) to 1 (narrowest guide)
    fresh: bool  # True until the first cycle of a step is computed
    h: Annotated[Vector, 2]  # safety value of the last cycle; below 0, u_ext can push the joint out of the guide


class LiteralTables(NamedTuple):
    """Data from which `assistive_torque` computes the torque of the literal law in each cycle of a step."""

    records: Records[LiteralRecord]  # (1,) constants and state of the literal law; `assistive_torque` updates the state
    step: Vector  # (cycles + 1, 8) one row per cycle of the step; columns: see `BOUND`, `REFERENCE` and `FEEDFORWARD`


#: Columns 0 to 3 of `step`: distances from q_des to the guide bounds [rad].
#: Order of the bounds: hip upper, hip lower, knee upper, knee lower.
BOUND = 0
REFERENCE = 4  # columns 4 and 5 of `step` [rad/s2]: desired acceleration q_des'' of sagittal hip and knee
FEEDFORWARD = 6  # columns 6 and 7 of `step` [Nm]: feedforward torque of hip and knee, u_f * `LiteralConfig.feedforward`


@dataclass(frozen=True)
class LiteralConfig:
    """Parameters of the literal law."""

    gains: LegGains  # PID gains of the swing leg; kp and kd of SH and SK are also the gains of the backup torque u_b
    push: Pair  # Nm, largest absolute value of the external torque u_ext of sagittal hip and knee
    #: Gain zeta [s] of the rate of change of the safety value h. While h falls, zeta increases the weight of the backup
    #: torque u_b. While h rises, zeta decreases this weight. With zeta = 0, the rate of change of h has no effect.
    zeta: float
    idealization: float  # factor in [0, 1] on the torque u_i, which cancels friction and gravity (joint idealization)
    feedforward: float  # factor in [0, 1] on the feedforward torque u_f


class LiteralGuide:
    """Literal law for one gait and one guide shape. Call `start_step` at each stance change.

    Attributes:
        tables: constants, state and values of each cycle, with which `assistive_torque` computes the torque.
    """

    def __init__(self, config: LiteralConfig, shape: GuideShape, leg: Leg, feedforward: Vector) -> None:
        """Compute the tables that are the same in every step.

        Args:
            config: parameters.
            shape: shape of the guide.
            leg: swing leg along the nominal trajectory; the cycles after the step are ignored.
            feedforward: u_f of SH and SK in each cycle of the step, shape (cycles + 1, 2) [Nm].
        """
        count = len(feedforward)
        self._shape, self._phase = shape, np.arange(count) / (count - 1)
        self._nominal: Vector = leg.qdd[:count]
        self._basis = leg.deadbeat.basis(leg.time[:count])[2][:, :, None]
        self.tables = LiteralTables(zeros(LiteralRecord, 1), np.zeros((count, 8)))
        self.tables.step[:, FEEDFORWARD:] = config.feedforward * feedforward
        record, gains, friction = self.tables.records[0], config.gains, leg.friction
        record.kp[:], record.kd[:] = ([row[i] for i in _ASSISTED] for row in (gains.kp, gains.kd))
        record.coulomb[:], record.viscous[:] = (
            [row[i] for i in _ASSISTED] for row in (friction.coulomb, friction.viscous)
        )
        record.inertia[:], record.push[:], record.zeta = leg.inertia.inertias, config.push, config.zeta
        record.idealization = config.idealization
        self.start_step(0.0, (0.0, 0.0), (0.0, 0.0))

    def start_step(self, xi: float, deviation: Pair, rate: Pair) -> None:
        """Start a step: compute the guide bounds and the desired accelerations q_des'' of all cycles.

        Args:
            xi: assistance factor of the whole step.
            deviation: measured minus nominal angles of SH and SK at the stance change [rad].
            rate: measured minus nominal speeds of SH and SK at the stance change [rad/s].
        """
        record, step = self.tables.records[0], self.tables.step
        step[:, BOUND : BOUND + 4] = self._shape.bounds(self._phase, xi).transpose(1, 0, 2).reshape(-1, 4)
        moved = self._basis[0] * np.array(deviation) + self._basis[1] * np.array(rate)
        step[:, REFERENCE : REFERENCE + 2] = self._nominal + moved
        record.xi, record.fresh = xi, True


def no_promise(shape: str, xi: float) -> Certificate:
    """Return the certificate of the literal law. It states that no disturbance torque is certified.

    Args:
        shape: name of the shape.
        xi: assistance factor in [0, 1).
    """
    reason = "no promise: the paper's literal law controls each joint by itself, but hip and knee are coupled"
    return Certificate(shape, xi, False, reason, None, None, -math.inf)


def assistive_torque(tables: LiteralTables, guard: Guard, cycle: int, leg: LegState, rates: Pair) -> Pair:
    """Compute the assistive torques u_a of sagittal hip and knee for one cycle [Nm].

    Args:
        tables: tables of the literal law.
        guard: record of the guide filter. For the telemetry, the function writes to it the smaller h and the larger gate of
            the two joints, and the guide bounds.
        cycle: number of cycles since the stance change. A number above the length of the step is replaced by this length.
        leg: measurements of the swing leg.
        rates: q_des' of SH and SK [rad/s].
    """
    record, step = tables.records[0], tables.step
    now = step[min(cycle, len(step) - 1)]
    hip_h, hip_gate, hip = _guide_torque(tables, cycle, 0, leg.hip - leg.hip_desired, leg.hip_rate - rates[0])
    knee_h, knee_gate, knee = _guide_torque(tables, cycle, 1, leg.knee - leg.knee_desired, leg.knee_rate - rates[1])
    record.fresh = False
    guard.h, guard.gate = min(hip_h, knee_h), max(hip_gate, knee_gate)
    for side in range(4):
        guard.bounds[side] = now[BOUND + side]
    return (
        hip + now[FEEDFORWARD] + record.idealization * (_friction(record, 0, leg.hip_rate) + leg.hip_gravity),
        knee + now[FEEDFORWARD + 1] + record.idealization * (_friction(record, 1, leg.knee_rate) + leg.knee_gravity),
    )


def _guide_torque(tables: LiteralTables, cycle: int, joint: int, e: float, rate: float) -> tuple[float, float, float]:
    """Return three values of a joint: safety value h, gate (weight of u_b), and guide torque u_v = gate * u_b [Nm]."""
    record = tables.records[0]
    ratio = max(_largest_ratio(tables, cycle, joint, e, rate, 1.0), _largest_ratio(tables, cycle, joint, e, rate, -1.0))
    h = 1.0 - ratio * ratio
    slope = 0.0 if record.fresh else (h - record.h[joint]) / PERIOD
    record.h[joint] = h
    weight = (1.0 + (record.xi**10 - 1.0) * max(h, 0.0)) ** 3
    gate = weight + (1.0 - weight) * -record.zeta * slope
    return h, gate, gate * (-record.kp[joint] * e - record.kd[joint] * rate)


def _largest_ratio(tables: LiteralTables, cycle: int, joint: int, e: float, rate: float, side: float) -> float:
    """Simulate the rest of the step under a constant push. Return the largest |e| / q_bound.

    The torque on the joint is the sum of the feedforward torque, the backup torque (PD feedback) and the push. The push is
    the largest external torque `LiteralRecord.push` in the direction `side` (1 or -1).
    """
    record, step = tables.records[0], tables.step
    kp, kd, inertia = record.kp[joint], record.kd[joint], record.inertia[joint]
    push, worst = side * record.push[joint], 0.0
    for at in range(min(cycle, len(step) - 1), len(step)):
        now = step[at]
        worst = max(worst, e / now[BOUND + 2 * joint], -e / now[BOUND + 2 * joint + 1])
        torque = now[FEEDFORWARD + joint] + push - kp * e - kd * rate
        rate += PERIOD * (torque / inertia - now[REFERENCE + joint])
        e += PERIOD * rate
    return worst


def _friction(record: LiteralRecord, joint: int, rate: float) -> float:
    """Return the friction torque k_d sign(q') + k_v q' [Nm]."""
    sign = math.copysign(1.0, rate) if rate != 0.0 else 0.0
    return float(record.coulomb[joint] * sign + record.viscous[joint] * rate)
