r"""Virtual guide filter of the swing leg's SH and SK, with the exact flow of the backup policy.

`e, e' of both joints -> safe backward image h -> lambda -> u_v`. Each cycle predicts the motion of the two joints under the
backup policy over the rest of the step, for the worst disturbances. The closer the prediction comes to the guide, the larger is
the share of the backup policy in the torque. The flow is linear (see `backup_policy`), so the prediction takes a few products
over the horizon for each joint and both extremes, and no integration. Where the backup policy would saturate the drive, the
prediction is piecewise (see `kernel`).

The horizon is a fixed grid with at most `points` intervals up to T. It continues with the same spacing for `overlap` after T.
After T the joint follows the nominal trajectory of the next step, and the guide keeps its last width. Without the overlap the
prediction in the last cycles would end at T, and any speed would be admitted there (see `certificate`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from atalante_control.gait.gait import PERIOD
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy, Curve, ForcedResponse, forced_response, free_drift
from atalante_control.guide.kernel import BOUND, GuideTables, Joint, P, errors_ahead, tick
from atalante_control.guide.shapes import GuideShape
from atalante_control.structured import Records, zeros
from atalante_hal.compiled import specialised
from atalante_hal.types import Vector

Pair = tuple[float, float]


@dataclass(frozen=True)
class GuideConfig:
    """Parameters of the guide filter for the two assisted joints, SH then SK.

    Raises:
        ValueError: If a disturbance interval does not contain zero, or if a number is out of range.
    """

    policies: tuple[BackupPolicy, BackupPolicy]
    disturbance: tuple[tuple[float, float], tuple[float, float]]  # Nm, (u_ext_min, u_ext_max) of each joint
    points: int = 100  # grid intervals over a step
    overlap: float = 0.1  # s, length of the prediction beyond the end of the step
    zeta: float = 0.01  # s, gain of the derivative term lambda_d
    derivative_time: float = 0.005  # s, time constant of the low-pass filter on dh/dt
    reserve: float = (
        0.1  # fraction of the torque limit that the rollouts do not use; compensates for a delay of one cycle
    )

    def __post_init__(self) -> None:
        for low, high in self.disturbance:
            if not (math.isfinite(low) and math.isfinite(high) and low <= 0.0 <= high):
                raise ValueError(f"disturbance must be (min <= 0, max >= 0) in Nm for each joint, got {(low, high)!r}")
        if self.points < 2:
            raise ValueError(f"points must be at least 2, got {self.points!r}")
        if not 0.0 <= self.reserve < 1.0:
            raise ValueError(f"reserve must be a fraction of the torque limit in [0, 1), got {self.reserve!r}")
        for name in ("overlap", "zeta", "derivative_time"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must be finite and at least 0 s, got {getattr(self, name)!r}")


class GuideFilter:
    """Guide filter of SH and SK for one gait and one shape. By symmetry, the same filter serves both swing legs.

    Call `start_step` at each step change, then `tick` once a cycle.

    Attributes:
        tables: tables of `kernel` for SH and SK; h, gate and guide of `tables.joints` are those of the last tick.
        nominal: Bezier control points of SH and SK, shape (2, 8) [rad].
        cycles: cycles of a step.
        stride: cycles of a grid interval.
        grid: cycles of the grid points.
        horizon: cycle at the end of the horizon.
        time: time of every cycle to the end of the horizon [s].
        forced: forced responses of SH and SK at `time`, from which P is computed.
    """

    def __init__(
        self,
        config: GuideConfig,
        shape: GuideShape,
        deadbeat: Deadbeat,
        nominal: Vector,
        following: Vector,
        feedforward: Vector | None = None,
    ) -> None:
        """Compute the tables that are the same in every step.

        Args:
            config: gains, disturbance bounds and horizon.
            shape: shape of the guide.
            deadbeat: re-centring of the gait.
            nominal: Bezier control points of SH and SK of the swing leg, shape (2, 8) [rad].
            following: Bezier control points of the same joints in the next step, as stance leg, shape (2, 8) [rad].
            feedforward: Bezier control points of u_f, shape (2, 8) [Nm]; None: no feedforward.

        Raises:
            ValueError: If a bound of the shape is not finite or too small at a cycle of the step, see `GuideShape.bounds`.
        """
        self.config, self.shape, self.deadbeat, self.nominal = config, shape, deadbeat, nominal
        self.cycles = round(deadbeat.duration / PERIOD)
        self.stride = max(1, -(-self.cycles // config.points))
        beyond = math.ceil(round(config.overlap / PERIOD) / self.stride) * self.stride
        self.horizon = self.cycles + beyond
        self.grid = np.arange(self.cycles % self.stride, self.horizon + 1, self.stride)
        self.time: Vector = np.arange(self.horizon + 1, dtype=np.float64) * PERIOD
        shape.check(self.time / deadbeat.duration)

        self.forced: list[ForcedResponse] = []
        tables = []
        for joint, policy in enumerate(config.policies):
            uf = None if feedforward is None else feedforward[joint]
            curve = Curve(deadbeat, nominal[joint], following[joint], self.time, uf)
            self.forced.append(forced_response(policy, curve))
            tables.append(np.concatenate([self.forced[joint], free_drift(policy, curve)], axis=2))
        #: Terms of the columns P and DRIFT of `step`: nominal, per rad of s(0), per rad/s of s'(0). Shape (3, 2, horizon + 1, 4).
        self._parts = np.stack(tables, axis=1)
        first = int(self.grid[0])
        flow = np.array([_flow(config, joint, self.time) for joint in (0, 1)])
        self.tables = GuideTables(_joints(config, first, self.stride), flow, np.empty((2, self.horizon + 1, 6)))
        self.start_step(0.0, (0.0, 0.0), (0.0, 0.0))
        discarded = self.tables._replace(joints=_joints(config, first, self.stride))
        self._tick = specialised(tick, discarded, 0, 0.0, 0.0, 0.0, 0.0)

    def start_step(self, xi: float, deviation: Pair, rate: Pair) -> None:
        """Start a step: compute the bounds of the guide from Xi, and the forced responses from the deviations.

        Args:
            xi: assistance factor of the whole step.
            deviation: deviations s(0) of SH and SK at the step change [rad].
            rate: deviations s'(0) of SH and SK at the step change [rad/s].
        """
        (joints, _, step), (nominal, per_deviation, per_rate) = self.tables, self._parts
        if xi != joints[0].xi:
            step[:, :, BOUND:] = self.shape.bounds(self.time / self.deadbeat.duration, xi)
        moved = per_deviation * np.reshape(deviation, (2, 1, 1)) + per_rate * np.reshape(rate, (2, 1, 1))
        np.add(moved, nominal, out=step[:, :, :BOUND])
        for i in (0, 1):
            joints[i].xi, joints[i].fresh = xi, True

    def tick(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> Pair:
        """Return the guide torques u_v of SH and SK [Nm].

        Args:
            cycle: cycles since the step change; limited to the length of the step.
            e_hip: q - q_des of SH [rad].
            ed_hip: q' - q_des' of SH [rad/s].
            e_knee: q - q_des of SK [rad].
            ed_knee: q' - q_des' of SK [rad/s].
        """
        cycle = min(cycle, self.cycles)
        return self._tick(self.tables, cycle, e_hip, ed_hip, e_knee, ed_knee)

    @property
    def h(self) -> list[float]:
        """Return the safe backward image function h of SH and SK at the last tick; it is at least 0 inside the image."""
        return [float(self.tables.joints[i].h) for i in (0, 1)]

    @property
    def gates(self) -> list[float]:
        """Return the weight of the backup torque, lambda + (1 - lambda) lambda_d, of SH and SK at the last tick."""
        return [float(self.tables.joints[i].gate) for i in (0, 1)]

    @property
    def bounds(self) -> list[float]:
        """Return the distances from q_des to the upper and to the lower bound of the guide at the last tick [rad]."""
        hip = self.tables.joints[0]
        return [float(hip.upper), float(hip.lower)]

    @property
    def stepped(self) -> int:
        """Return the number of rollouts that were computed cycle by cycle because of torque saturation."""
        return sum(int(self.tables.joints[i].stepped) for i in (0, 1))

    def rollouts(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> Vector:
        """Predict the errors under the unsaturated backup policy at the remaining grid points, from the exact flow.

        Args:
            cycle: cycles since the step change.
            e_hip: q - q_des of SH [rad].
            ed_hip: q' - q_des' of SH [rad/s].
            e_knee: q - q_des of SK [rad].
            ed_knee: q' - q_des' of SK [rad/s].

        Returns:
            Largest e and largest -e of SH under the disturbance bounds, then of SK, shape (4, n) [rad].
        """
        points = self.grid[self.grid >= cycle].tolist()
        rolled = []
        for joint, (e, ed) in enumerate(((e_hip, ed_hip), (e_knee, ed_knee))):
            flow, step = self.tables.flow[joint], self.tables.step[joint]
            y, yd = e - step[cycle, P], ed - step[cycle, P + 1]
            rolled.append([errors_ahead(flow[point - cycle], step[point], y, yd) for point in points])
        return np.array(rolled).swapaxes(1, 2).reshape(4, len(points))

    def solution(self) -> Vector:
        """Return the solution P of this step at every cycle: (e, e') of SH, then of SK. Shape (horizon + 1, 4) [rad, rad/s]."""
        hip, knee = self.tables.step[:, :, P : P + 2]
        return np.hstack([hip, knee])


def _joints(config: GuideConfig, first: int, stride: int) -> Records[Joint]:
    """Return the initial records of SH and SK: gains, limits and grid, without the values of a step."""
    one = np.array([PERIOD])
    joints: Records[Joint] = zeros(Joint, 2)
    for i, policy in enumerate(config.policies):
        joint, (low, high) = joints[i], config.disturbance[i]
        joint.kp, joint.kd, joint.inertia = policy.kp, policy.kd, policy.inertia
        joint.limit, joint.counted = policy.torque_limit, (1.0 - config.reserve) * policy.torque_limit
        joint.up, joint.down = high, low
        (joint.phi11, joint.phi12), (joint.phi21, joint.phi22) = policy.transition(one)[0]
        joint.s1, joint.s2 = policy.step_response(one)[0]
        joint.monotone = all(policy.monotone for policy in config.policies)
        joint.first, joint.stride = first, stride
        joint.zeta, joint.smoothing = config.zeta, PERIOD / (config.derivative_time + PERIOD)
        joint.xi, joint.h, joint.upper, joint.lower = math.nan, 1.0, math.inf, math.inf
    return joints


def _flow(config: GuideConfig, joint: int, time: Vector) -> Vector:
    """Return the table `flow` of `kernel` for one joint, shape (n, 9)."""
    policy, (low, high) = config.policies[joint], config.disturbance[joint]
    phi, (s, rate) = policy.transition(time), policy.step_response(time).T
    largest, smallest = policy.disturbance(time, low, high)
    kp, kd = policy.kp, policy.kd
    added = kp * largest + kd * high * rate, -(kp * smallest + kd * low * rate)
    return np.column_stack([phi[:, 0], largest, -smallest, kp * phi[:, 0] + kd * phi[:, 1], *added, s])
