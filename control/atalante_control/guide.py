r"""Virtual guide filter of the swing leg's SH and SK, with the exact flow of the backup policy.

`e, e' of both joints -> safe backward image h -> lambda -> u_v`. Each cycle asks where the backup policy would lead the
two joints over the rest of the step under the worst disturbances, and lets it act the more, the closer that comes to
the guide. The flow is linear (see `backup`), so the answer is one matrix product over the horizon for both joints and
both extremes, not an integration; where the backup policy would saturate the drive, the rollout is stepped instead.

The horizon is a grid of `points` intervals ending at T, the same points all step long, plus `overlap` beyond T: there
the joint goes on along the next step's nominal and the guide keeps its last width. Without it the last cycles of a
step look no further than the step's end, and admit any speed there (see `certificate`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from struct import Struct

import numpy as np
import numpy.typing as npt

from atalante_control.backup import BackupPolicy, forced_response, free_drift
from atalante_control.deadbeat import Deadbeat
from atalante_control.gait import PERIOD
from atalante_control.guide_shapes import GuideShape
from atalante_control.limited import LimitedRollouts, combine

Vector = npt.NDArray[np.float64]

#: Rows of the product. Rollouts: e of SH under the upper extreme, -e under the lower one, SK likewise, over the bound;
#: then the torque Kp e + Kd e' (against the side) along the same rollouts, over the limit.
_ROWS = 8
#: Columns of its left factor: Phi11 and Phi12 of SH, of SK, and what the disturbance adds to each rollout.
_TERMS = 8
#: Phi11 and Phi12 of a joint in the left factor, term by term: e and -e, torque and -torque in its own rows, zero in
#: the other joint's; and where the joint's begin [bytes].
_STATE_TERMS = Struct("2d16x2d16x2d16x2d").pack_into
_JOINT_TERMS = (2 * _ROWS + 2) * 8


@dataclass(frozen=True)
class GuideConfig:
    """What the guide filter needs to know of the two assisted joints, SH then SK.

    Raises:
        ValueError: a disturbance interval that does not contain zero, or a number out of range.
    """

    policies: tuple[BackupPolicy, BackupPolicy]
    disturbance: tuple[tuple[float, float], tuple[float, float]]  # Nm, (u_ext_min, u_ext_max) of each joint
    points: int = 100  # grid intervals over a step
    overlap: float = 0.1  # s, horizon beyond the step's end
    zeta: float = 0.01  # s, gain of the derivative term lambda_d
    derivative_time: float = 0.005  # s, time constant of the low pass on dh/dt
    reserve: float = 0.1  # part of the torque limit the rollouts do not count on: it corrects what a cycle is late

    def __post_init__(self) -> None:
        for low, high in self.disturbance:
            if not (math.isfinite(low) and math.isfinite(high) and low <= 0.0 <= high):
                raise ValueError(f"a disturbance bound is (min <= 0, max >= 0) in Nm, not {(low, high)!r}")
        if self.points < 2:
            raise ValueError(f"points is at least 2, not {self.points!r}")
        if not 0.0 <= self.reserve < 1.0:
            raise ValueError(f"reserve is a part of the torque limit in [0, 1), not {self.reserve!r}")
        for name in ("overlap", "zeta", "derivative_time"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} is not negative and finite, in s, not {getattr(self, name)!r}")


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


class GuideFilter:
    """The filter on both joints, for one gait and one shape; the same for either swing leg, by symmetry.

    Call `start_step` at each step change, then `tick` once a cycle.

    Attributes:
        h: safe backward image function at the last tick, SH and SK; at least 0 inside it.
        gates: lambda + (1 - lambda) lambda_d at the last tick.
        bounds: guide at the last tick, upper and lower [rad].
        cycles, stride, grid, horizon: cycles of a step, of a grid interval, of the grid points, of the horizon's end.
        time: of every cycle to the horizon's end [s]; `forced`: responses of SH and SK on it that P is made of.
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
        """Prepare every table of a step.

        Args:
            nominal: Bezier control points of the swing leg's SH and SK, shape (2, 8) [rad].
            following: of the same joints in the step after, when the leg stands, shape (2, 8) [rad].
            feedforward: of u_f where it is applied, shape (2, 8) [Nm].
        """
        self.config, self.shape, self.deadbeat = config, shape, deadbeat
        self.cycles = round(deadbeat.duration / PERIOD)
        self.stride = max(1, -(-self.cycles // config.points))
        beyond = math.ceil(round(config.overlap / PERIOD) / self.stride) * self.stride
        self.horizon = self.cycles + beyond
        self.grid = np.arange(self.cycles % self.stride, self.horizon + 1, self.stride)
        self.time: Vector = np.arange(self.horizon + 1, dtype=np.float64) * PERIOD

        ufs = (None, None) if feedforward is None else (feedforward[0], feedforward[1])
        parts = list(zip(config.policies, nominal, following, ufs, strict=True))
        self.forced = [forced_response(p, deadbeat, q, after, self.time, uf) for p, q, after, uf in parts]
        # Tables of (e, e') of SH, then of SK: nominal, per deviation, per rate; P is their sum for the step.
        self._p_parts = tuple(np.hstack(columns) for columns in zip(*self.forced, strict=True))
        self._p = np.empty((self.horizon + 1, 4))

        lags = len(self.grid)
        self._flow = _rollout_table(config, self.stride, lags)
        # For every first grid point, the rest of the grid as one contiguous block: numpy is twice as fast on it.
        self._blocks = np.concatenate(
            [np.arange(_ROWS * lags).reshape(_ROWS, lags)[:, i:].ravel() for i in range(lags)]
        )
        self._packed_p, self._packed_scale = np.empty(len(self._blocks)), np.empty(len(self._blocks))
        self._bounds = np.empty((self.horizon + 1, 2))
        self._rows_p, self._rows_scale = np.empty((_ROWS, lags)), np.empty((_ROWS, lags))
        self._limits = [(1.0 - config.reserve) * policy.torque_limit for policy in config.policies]
        self._rows_scale[4:] = np.repeat(1.0 / np.array(self._limits), 2)[:, None]
        self._out = np.empty(_ROWS * lags)
        self._out_cells = memoryview(self._out.data).cast("B").cast("d")  # an element of it, for half the price
        self._views = [self._view(cycle) for cycle in range(self.horizon + 1)]
        # Kp e + Kd e' along a rollout, in terms of Phi11 and Phi12: e' of the state y is e of the state A y.
        self._torque_of = [
            (p.kp, p.kd, p.kp - p.kd * p.kd / p.inertia, -p.kd * p.kp / p.inertia) for p in config.policies
        ]
        self._backup = [(p.kp, p.kd, p.torque_limit) for p in config.policies]
        # Left factor of the product, by terms: the first four are written every cycle.
        terms = np.zeros((_TERMS, _ROWS))
        self._z, self._state_terms = terms.T, memoryview(terms.data).cast("B")
        self._z[range(4), range(4, 8)] = 1.0
        for joint, policy in enumerate(config.policies):
            self._z[4 + 2 * joint, 4 + 2 * joint] = self._z[5 + 2 * joint, 5 + 2 * joint] = policy.kp
        self._push = [
            (policy.kd * high / policy.inertia, -policy.kd * low / policy.inertia)
            for policy, (low, high) in zip(config.policies, config.disturbance, strict=True)
        ]
        self._monotone = all(p.monotone for p in config.policies)
        drifts = [free_drift(p, deadbeat, q, after, self.time, uf) for p, q, after, uf in parts]
        self._limited = LimitedRollouts(
            config.policies, self._limits, config.disturbance, drifts, self._p, self._bounds, self.stride, self._linear
        )

        self._smoothing = PERIOD / (config.derivative_time + PERIOD)
        self._xi, self._fresh, self._dh, self._ratio = math.nan, True, [0.0, 0.0], [0.0, 0.0]
        self.h, self.gates, self.bounds = [1.0, 1.0], [0.0, 0.0], [0.0, 0.0]
        self.start_step(0.0, (0.0, 0.0), (0.0, 0.0))

    def start_step(self, xi: float, deviation: tuple[float, float], rate: tuple[float, float]) -> None:
        """Take the step change: width from Xi, P from what the deadbeat has to undo.

        Args:
            xi: assistance factor of the whole step.
            deviation: s(0) of SH and SK [rad].
            rate: s'(0) of SH and SK [rad/s].
        """
        if xi != self._xi:
            self._bounds[:] = self.shape.bounds(self.time / self.deadbeat.duration, xi)
            self._rows_scale[:4] = np.tile(1.0 / self._bounds[self.grid].T, (2, 1))
            self._rows_scale.take(self._blocks, out=self._packed_scale, mode="clip")
            self._xi = xi
        combine(self._p_parts, deviation, rate, self._p)
        self._limited.start_step(deviation, rate)
        p, rows = self._p[self.grid].T, self._rows_p
        for joint, policy in enumerate(self.config.policies):
            e, ed = p[2 * joint], p[2 * joint + 1]
            rows[2 * joint], rows[4 + 2 * joint] = e, policy.kp * e + policy.kd * ed
        np.negative(rows[::2], out=rows[1::2])
        rows.take(self._blocks, out=self._packed_p, mode="clip")
        self._fresh = True

    def tick(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> tuple[float, float]:
        """u_v of SH and SK [Nm].

        Args:
            cycle: since the step change; past the step's end it stays there.
            e_hip, e_knee: q - q_des [rad].
            ed_hip, ed_knee: q' - q_des' [rad/s].
        """
        if cycle > self.cycles:
            cycle = self.cycles
        self._predict(cycle, e_hip, ed_hip, e_knee, ed_knee)
        fresh, self._fresh = self._fresh, False
        return self._act(0, e_hip, ed_hip, fresh), self._act(1, e_knee, ed_knee, fresh)

    def rollouts(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> Vector:
        """Errors the unsaturated backup policy leads to at the rest of the grid, from the exact flow.

        Returns:
            Shape (4, n) [rad]: of SH the largest e and the largest -e under the disturbance bounds, then of SK.
        """
        flow, p, _, _, _ = self._views[cycle]
        self._load(0, cycle, e_hip, ed_hip)
        self._load(1, cycle, e_knee, ed_knee)
        return np.asarray((self._z @ flow + p)[:4])

    @property
    def stepped(self) -> int:
        """Rollouts so far that were not linear, because the backup policy saturates along them."""
        return self._limited.stepped

    def solution(self) -> Vector:
        """P of this step on the cycle grid, (e, e') of SH then of SK. Shape (horizon + 1, 4) [rad, rad/s]."""
        return self._p.copy()

    def _act(self, joint: int, e: float, ed: float, fresh: bool) -> float:
        upper, lower = self.bounds
        ratio, now = self._ratio[joint], e / upper if e > 0.0 else -e / lower
        if now > ratio:
            ratio = now
        h, rate = 1.0 - ratio * ratio, 0.0
        if not fresh:
            rate = self._dh[joint]
            rate += self._smoothing * ((h - self.h[joint]) / PERIOD - rate)
        self._dh[joint], self.h[joint] = rate, h
        self.gates[joint] = weight = damped_gate(gate(h, self._xi), rate, self.config.zeta)
        kp, kd, limit = self._backup[joint]
        u = -kp * e - kd * ed
        return weight * (limit if u > limit else -limit if u < -limit else u)

    def _load(self, joint: int, cycle: int, e: float, ed: float) -> None:
        """x - P(t) of one joint into the product's left factor: both signs, error rows and torque rows."""
        p, pd = self._p[cycle, 2 * joint : 2 * joint + 2].tolist()
        a, b, c, d = self._torque_of[joint]
        up, down = self._push[joint]
        y, yd = e - p, ed - pd
        t, td = a * y + b * yd, c * yd + d * y
        _STATE_TERMS(self._state_terms, joint * _JOINT_TERMS, y, -y, t, -t, yd, -yd, td + up, down - td)

    def _predict(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> None:
        """Largest ratio to the bound ahead, of each joint, into `_ratio`."""
        flow, p, scale, out, bounds = self._views[cycle]
        self._load(0, cycle, e_hip, ed_hip)
        self._load(1, cycle, e_knee, ed_knee)
        np.dot(self._z, flow, out)
        np.add(out, p, out)
        np.multiply(out, scale, out)
        # argmax and eight reads cost half of a maximum along the rows.
        i0, i1, i2, i3, i4, i5, i6, i7 = out.argmax(1).tolist()
        if not self._monotone:
            np.abs(out[4:], out=out[4:])
            i4, i5, i6, i7 = out[4:].argmax(1).tolist()
        at, n = self._out_cells, out.shape[1]
        a, b, c, d = at[i0], at[n + i1], at[2 * n + i2], at[3 * n + i3]
        self.bounds = bounds.tolist()
        ratio, torques = self._ratio, (at[4 * n + i4], at[5 * n + i5], at[6 * n + i6], at[7 * n + i7])
        ratio[0], ratio[1] = a if a > b else b, c if c > d else d
        (hip_kp, hip_kd, _), (knee_kp, knee_kd, _) = self._backup
        limit, other_limit = self._limits
        hip = (hip_kp * e_hip + hip_kd * ed_hip) / limit
        knee = (knee_kp * e_knee + knee_kd * ed_knee) / other_limit
        if hip > 1.0 or hip < -1.0 or torques[0] > 1.0 or torques[1] > 1.0:
            ratio[0] = self._saturated(0, cycle, e_hip, ed_hip, hip, (a, b), torques[:2])
        if knee > 1.0 or knee < -1.0 or torques[2] > 1.0 or torques[3] > 1.0:
            ratio[1] = self._saturated(1, cycle, e_knee, ed_knee, knee, (c, d), torques[2:])

    def _saturated(
        self,
        joint: int,
        cycle: int,
        e: float,
        ed: float,
        now: float,
        ratios: tuple[float, float],
        torques: tuple[float, ...],
    ) -> float:
        """Largest ratio where a rollout saturates.

        Only the rollouts along which the drive saturates against the side they are to be held from are stepped: one of
        a monotone loop that saturates the other way stays below the linear rollout, which is kept as its bound.
        """
        worst = 0.0
        for side in (0, 1):
            against = abs(now) if not self._monotone else -now if side else now
            if against > 1.0 or torques[side] > 1.0:
                worst = max(worst, self._limited.ratio(joint, side, cycle, e, ed))
            else:
                worst = max(worst, ratios[side])
        return worst

    def _linear(self, joint: int, side: int, cycle: int, e: float, ed: float) -> tuple[float, float]:
        """Largest ratio and largest torque over the limit of one linear rollout from `cycle` on."""
        flow, p, scale, out, _ = self._views[cycle]
        self._load(joint, cycle, e, ed)  # the other joint's rows are not looked at
        np.dot(self._z, flow, out)
        np.add(out, p, out)
        np.multiply(out, scale, out)
        row, n, best = 2 * joint + side, out.shape[1], out.argmax(1).tolist()
        return self._out_cells[row * n + best[row]], self._out_cells[(row + 4) * n + best[row + 4]]

    def _block(self, first: int) -> int:
        """Where the packed block of the grid points from `first` on begins."""
        return _ROWS * (first * len(self.grid) - first * (first - 1) // 2)

    def _view(self, cycle: int) -> tuple[Vector, ...]:
        first = int(np.searchsorted(self.grid, cycle))
        lag, n = int(self.grid[first]) - cycle, len(self.grid) - first
        block = slice(self._block(first), self._block(first + 1))
        return (
            self._flow[lag, :n].T,
            self._packed_p[block].reshape(_ROWS, n),
            self._packed_scale[block].reshape(_ROWS, n),
            self._out[: _ROWS * n].reshape(_ROWS, n),
            self._bounds[cycle],
        )


def _rollout_table(config: GuideConfig, stride: int, lags: int) -> Vector:
    """Right factor of the product, for each offset of the cycle before a grid point. Shape (stride, lags, 8).

    Terms: Phi11 and Phi12 of SH, of SK, then what the disturbance adds in each of the four rollouts [rad].
    """
    flow = np.empty((stride, lags, _TERMS))
    for joint, (policy, (low, high)) in enumerate(zip(config.policies, config.disturbance, strict=True)):
        for offset in range(stride):
            tau = (offset + stride * np.arange(lags, dtype=np.float64)) * PERIOD
            largest, smallest = policy.disturbance(tau, low, high)
            flow[offset, :, 2 * joint : 2 * joint + 2] = policy.transition(tau)[:, 0]
            flow[offset, :, 4 + 2 * joint : 6 + 2 * joint] = np.stack([largest, -smallest], axis=1)
    return flow
