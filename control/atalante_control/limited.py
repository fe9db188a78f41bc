"""Rollouts of the virtual guide where the drive is at its torque limit: `state -> largest |e| / q_bound ahead`.

The guide filter's flow is linear as long as the backup policy gets the torque it asks for. Where it does not, the torque
is constant and the error a known drift plus a parabola: the cycle at which the drive comes off its limit is found, with
the largest error until then, and from there on the flow is linear again. A rollout that saturates a second time goes on
cycle by cycle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from atalante_control.backup import BackupPolicy, ForcedResponse
from atalante_control.gait import PERIOD

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

_HOPELESS = 2.0  # |e| / q_bound from which a rollout is left: lambda is 1 from 1 on


def combine(parts: tuple[Vector, ...], deviation: Pair, rate: Pair, out: Vector) -> None:
    """Tables of a step from those of its nominal, of s(0) and of s'(0); columns (e, e') of SH, then of SK."""
    np.multiply(parts[1], (deviation[0], deviation[0], deviation[1], deviation[1]), out=out)
    np.add(out, parts[2] * (rate[0], rate[0], rate[1], rate[1]), out=out)
    np.add(out, parts[0], out=out)


class LimitedRollouts:
    """Both joints' rollouts with their torque limits.

    Attributes:
        stepped: rollouts so far.
    """

    def __init__(
        self,
        policies: Sequence[BackupPolicy],
        limits: Sequence[float],
        disturbance: Sequence[Pair],
        drifts: Sequence[ForcedResponse],
        solution: Vector,
        bounds: Vector,
        stride: int,
        linear: Callable[[int, int, int, float, float], Pair],
    ) -> None:
        """Share the guide's tables.

        Args:
            limits: torque the rollouts count on, SH and SK [Nm].
            drifts: of `backup.free_drift`, SH and SK, on every cycle of the horizon.
            solution: P on every cycle, shape (horizon + 1, 4), kept up to date by the guide, like `bounds`.
            bounds: guide on every cycle, upper and lower, shape (horizon + 1, 2) [rad].
            stride: cycles of a grid interval.
            linear: (joint, side, cycle, e, e') to the largest ratio and torque over limit of the linear rollout.
        """
        self._policies, self._limits, self._disturbance = policies, limits, disturbance
        self._p, self._bounds, self._stride, self._linear = solution, bounds, stride, linear
        self._horizon = len(bounds) - 1
        self._drift_parts = tuple(np.hstack(columns) for columns in zip(*drifts, strict=True))
        self._drift = np.empty_like(self._drift_parts[0])
        # Drift, and Kp e + Kd e' of it for each joint, cycle by cycle; a list is read ten times faster than an array.
        self._rows: list[list[float]] = []
        self._pull: list[list[float]] = []
        self._moved: tuple[Pair, Pair] | None = None
        one, time = np.array([PERIOD]), np.arange(self._horizon + 1, dtype=np.float64) * PERIOD
        self._cycle_flow = [
            (*p.transition(one)[0].ravel().tolist(), *p.step_response(one)[0].tolist()) for p in policies
        ]
        self._allowance = [_allowance(p, d, time) for p, d in zip(policies, disturbance, strict=True)]
        self.stepped = 0

    def start_step(self, deviation: Pair, rate: Pair) -> None:
        """Take the step change; the drift is made when the first rollout of the step needs it."""
        self._moved = (deviation, rate)

    def ratio(self, joint: int, side: int, cycle: int, e: float, ed: float) -> float:
        """Largest |e| / q_bound ahead on one side: e under the upper extreme (0), or -e under the lower one (1).

        Args:
            joint: 0 SH, 1 SK.
            cycle: since the step change.
            e, ed: error [rad] and its rate [rad/s] then.
        """
        if self._moved is not None:
            combine(self._drift_parts, *self._moved, self._drift)
            self._rows, self._moved = self._drift.tolist(), None
            errors, rates = self._drift[:, ::2], self._drift[:, 1::2]
            kps, kds = ([getattr(p, name) for p in self._policies] for name in ("kp", "kd"))
            self._pull = (errors * kps + rates * kds).T.tolist()
        self.stepped += 1
        policy, columns = self._policies[joint], slice(2 * joint, 2 * joint + 2)
        kp, kd, limit = policy.kp, policy.kd, self._limits[joint]
        phi00, phi01, phi10, phi11, s0, s1 = self._cycle_flow[joint]
        external, allowance = self._disturbance[joint][1 - side], self._allowance[joint][side]
        sign, start, worst, linear = (-1.0 if side else 1.0), cycle, 0.0, False
        while cycle < self._horizon and worst < _HOPELESS:
            u = -kp * e - kd * ed
            if -limit <= u <= limit:
                if not linear:
                    ratio, torque = self._linear(joint, side, cycle, e, ed)
                    if torque <= 1.0:
                        return max(worst, ratio)
                linear = True
                (p0, p1), (n0, n1) = self._p[cycle : cycle + 2, columns].tolist()
                e, ed = e - p0, ed - p1
                e, ed = n0 + phi00 * e + phi01 * ed + s0 * external, n1 + phi10 * e + phi11 * ed + s1 * external
                cycle += 1
            else:
                linear = False
                e, ed, cycle, peak = self._off_limit(joint, cycle, e, ed, math.copysign(limit, u) + external, sign)
                worst = max(worst, peak)
            worst = max(worst, (sign * e + allowance[cycle - start]) / float(self._bounds[cycle, side]))
        return worst

    def _off_limit(
        self, joint: int, cycle: int, e: float, ed: float, force: float, sign: float
    ) -> tuple[float, float, int, float]:
        """The cycle at which a saturated rollout comes off the limit, by false position on the excess torque.

        Args:
            force: torque until then, limit and disturbance together [Nm].
            sign: +1 towards the upper bound, -1 towards the lower one.

        Returns:
            e, e', cycle there, and the largest ratio where the error turns in between (0: it does not).
        """
        policy, column, rows, pull = self._policies[joint], 2 * joint, self._rows, self._pull[joint]
        kp, kd, limit, a = policy.kp, policy.kd, self._limits[joint], force / policy.inertia
        e0, ed0 = e - rows[cycle][column], ed - rows[cycle][column + 1]

        def state(n: int) -> tuple[float, float]:
            t, row = n * PERIOD, rows[cycle + n]
            return e0 + ed0 * t + 0.5 * a * t * t + row[column], ed0 + a * t + row[column + 1]

        # Torque asked for after n cycles: c0 + c1 n + c2 n^2, and the pull of the drift.
        c0, c1, c2 = kp * e0 + kd * ed0, (kp * ed0 + kd * a) * PERIOD, 0.5 * kp * a * PERIOD * PERIOD
        now = kp * e + kd * ed
        way = 1.0 if now > 0.0 else -1.0
        # g, what is asked for beyond the limit: g > 0 at `inner`, still saturated; g <= 0 at `outer`, off the limit.
        inner, g, last = 0, way * now - limit, self._horizon - cycle
        outer, g_outer = 0, 0.0
        slope = g - way * (c0 + c1 + c2 + pull[cycle + 1]) + limit
        reach = 4 * self._stride
        for trial in range(12):
            if outer:
                # False position, and halving now and then: g bends where the error turns.
                part = g / (g - g_outer) if trial % 3 else 0.5
                n = inner + min(max(1, round((outer - inner) * part)), outer - inner - 1)
            else:
                n = min(last, inner + (math.ceil(g / slope) if slope * reach > g else reach))
            more = way * (c0 + (c1 + c2 * n) * n + pull[cycle + n]) - limit
            if more <= 0.0:
                outer, g_outer = n, more
            else:
                slope, inner, g = (g - more) / (n - inner), n, more
            if inner == last or outer - inner == 1:
                break
        end = outer or inner
        found = state(end)

        peak = 0.0
        if sign * ed > 0.0 > sign * found[1]:
            # Where e' is zero, by false position: the maximum is flat, twice is enough.
            left, right, rate_left, rate_right = 0, end, ed, found[1]
            for _ in range(2):
                turn = left + round((right - left) * rate_left / (rate_left - rate_right))
                then, rate = state(turn)
                peak = max(peak, sign * then / float(self._bounds[cycle + turn, 0 if sign > 0.0 else 1]))
                if sign * rate > 0.0:
                    left, rate_left = turn, rate
                else:
                    right, rate_right = turn, rate
        return found[0], found[1], cycle + end, peak


def _allowance(policy: BackupPolicy, disturbance: Pair, time: Vector) -> tuple[list[float], list[float]]:
    """What the worst disturbance adds to a constant extreme, upper and lower [rad]: zero for a monotone loop."""
    largest, smallest = policy.disturbance(time, *disturbance)
    step = policy.step_response(time)[:, 0]
    low, high = disturbance
    return (largest - high * step).tolist(), (low * step - smallest).tolist()
