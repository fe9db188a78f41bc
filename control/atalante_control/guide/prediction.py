"""Tables that predict the swing leg while only the backup policy (spring and damper) drives sagittal hip and knee.

`leg, backup policy, mismatch -> matrices from state to predicted errors, largest effect of the disturbances`. The mismatch is
the largest model errors. The guide filter and the certificate use the tables. The tables are valid for one gait and one set of
backup gains. They depend on the guide shape only through the width of a very wide guide.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from atalante_control.guide.backup_policy import STATES, BackupPolicy, SampledLoop, responses
from atalante_control.guide.disturbance import Effect, Grid, HandOver, Leg, Mismatch, spread
from atalante_control.guide.kernel import COMPRESSED, SLACK_CYCLES, START_CYCLES
from atalante_hal.compiled import compiled
from atalante_hal.types import Vector

Pair = tuple[float, float]

#: Smallest and largest number of cycles between a measurement and the torque that is computed from it.
DELAYS = (1, 2)
#: Horizons of the predicted torques and speeds [cycles]. Tracking errors are predicted for every cycle.
FEW = np.array([1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48, 64, 85, 113, 150, 200, 250, 300])
#: Typical magnitude of each of the 10 elements of the leg state (errors, rates and accelerations, see `backup_policy.STATES`).
#: The compression of the state divides by these magnitudes, because the elements have different units.
SIZES = np.repeat([0.07, 1.0, 1.0, 140.0, 140.0], 2)


@dataclass(frozen=True)
class Assumptions:
    """Largest disturbances and model errors under which both joints must stay inside the guide.

    `horizon` and `overlap` are lengths of the prediction tables.
    """

    #: Nm, requested disturbance torques: these torques at sagittal hip and knee must not move a joint out of the guide
    promise: Pair = (30.0, 18.0)
    loop: SampledLoop = field(default_factory=SampledLoop)  # lag of the motor torque, and lag of the measured velocity
    mismatch: Mismatch = field(default_factory=Mismatch)  # largest errors of friction and inertia
    hand_over: HandOver = field(default_factory=HandOver)  # largest deviations when a step starts
    delays: tuple[int, int] = DELAYS  # cycles
    rate: float = 20.0  # Nm, limit of the change of a command in one cycle, set by the limiter of the robot
    horizon: int = 300  # number of predicted cycles
    overlap: int = 100  # number of cycles of the next step in the tables; predictions can end in the next step

    def __post_init__(self) -> None:
        """Check the ranges of the values.

        Raises:
            ValueError: If a value is out of range.
        """
        if not all(0.0 < torque < np.inf for torque in self.promise):
            raise ValueError(
                f"promise (certified disturbance torques) must be finite and above 0 Nm, got {self.promise!r}"
            )
        if not 1 <= self.delays[0] <= self.delays[1]:
            raise ValueError(f"delays must be two numbers of at least 1 cycle, in ascending order, got {self.delays!r}")


class StartReach(NamedTuple):
    """Largest deviations of hip and knee in each cycle of a step. Disturbances act from the start of the step.

    Row i: cycle i of the step. Columns 0 and 1: deviations of SH and SK due to the model errors (`Leg.budget`). Columns 2 and 3:
    deviations of SH and SK due to the requested disturbance torques.
    """

    error: Vector  # (n, 4) rad, tracking error; worst case over all inertia errors and delays
    torque: Vector  # (n, 4) Nm, deviation of the backup torque, for the inertia and delay of the model
    speed: Vector  # (n, 4) rad/s, deviation of the joint speed, for the inertia and delay of the model
    worst_speed: Vector  # (n, 4) rad/s, deviation of the joint speed; worst case over all inertia errors and delays
    change: Vector  # (n, 4) Nm, change of the backup torque from one cycle to the next


class Prediction:
    """Tables that predict hip and knee while only the backup policy drives them.

    Attributes:
        policy: gains of the backup policy.
        leg: swing leg along the nominal trajectory.
        assumptions: assumptions of the promise for which the tables are computed.
        cycles: number of cycles of a step.
        nominal: responses of the loop without model errors.
        compress: matrix from the state to the compressed state, shape (COMPRESSED, STATES).
        ahead: matrices from the compressed state to the predicted errors e of SH and SK, shape (lags, 2, COMPRESSED).
        beyond: matrix from the state to the errors one cycle beyond the horizon, shape (2, STATES).
        slack: largest change that model errors can cause in the predicted errors, per unit of each element of
            `Guard.magnitude`, for each block of `SLACK_CYCLES` cycles ahead, shape (blocks, 2, STATES).
        reach: largest errors due to model errors and requested disturbances, see `GuideTables.reach`.
        few_ahead: matrices from the state to the predicted feedback [rad/s2] of SH and SK and the predicted e' [rad/s] of SH and
            SK, `FEW` cycles ahead, shape (rows, 4, STATES).
        few_reach: largest effects of disturbances on torques and speeds, see `GuideTables.few_reach`.
        few_slack: largest change that model errors can cause in the predicted e', per unit of each element of
            `Guard.magnitude`, shape (rows, 2, STATES).
        start: largest effect of the disturbances since the start of a step.
        torque: torque that the leg needs along the nominal trajectory, shape (n, 2) [Nm].
        mass: mass matrix along the nominal trajectory, shape (n, 2, 2) [kg m2].
    """

    def __init__(self, policy: BackupPolicy, leg: Leg, assumptions: Assumptions, blend: Vector, width: float) -> None:
        """Compute the tables.

        Args:
            policy: gains of the backup policy.
            leg: swing leg along the nominal trajectory, to the end of the overlap.
            assumptions: assumptions of the promise for which the tables are computed.
            blend: element i is the fraction of the torque added at the stance change that remains i cycles later, shape (m,).
            width: largest width of the guides for which the tables are used [rad].
        """
        self.policy, self.leg, self.assumptions = policy, leg, assumptions
        last = len(leg.time) - 1
        self.cycles = last - assumptions.overlap
        horizon, hand_over = assumptions.horizon, assumptions.hand_over
        longest = max(last, horizon + 1)  # `self.beyond` is for the cycle after the horizon
        self.nominal = nominal = responses(policy, assumptions.loop, 1.0, longest)
        rows = nominal.error[: horizon + 1]
        _, _, basis = np.linalg.svd((rows * SIZES).reshape(-1, STATES), full_matrices=False)
        self.compress: Vector = np.ascontiguousarray(basis[:COMPRESSED] / SIZES)
        self.ahead: Vector = np.ascontiguousarray((rows * SIZES) @ basis[:COMPRESSED].T)

        self.beyond: Vector = nominal.error[horizon + 1]
        deviation = assumptions.mismatch.inertia
        family = [
            responses(policy, assumptions.loop, 1.0 / (1.0 + sign * deviation), longest, delay)
            for delay in sorted({*assumptions.delays})
            for sign in (-1.0, 1.0)
        ]
        lightest = family[0]
        changes = [_for_rate_difference(one.error[: horizon + 1] - self.ahead @ self.compress) for one in family]
        self.slack = _blocks(np.abs(changes).max(axis=0), SLACK_CYCLES)

        mobilities = leg.mobilities(hand_over, width)
        budget = leg.budget(assumptions.mismatch, hand_over, np.zeros((0, 2)))
        bounds = np.stack([budget, np.broadcast_to(assumptions.promise, budget.shape)], axis=2)
        self.mass = np.ascontiguousarray(leg.masses(leg.q[:, 1]))
        self.torque = leg.torque() + leg.friction_torque()
        same = np.broadcast_to(np.eye(2), self.mass.shape).copy()
        nothing = np.zeros((0, 2, 2))
        run = compiled(spread)
        starts, blocks = self.cycles + 1, -(-(self.cycles + 1) // START_CYCLES)
        whole = Grid(starts, START_CYCLES, np.arange(horizon + 1))
        few, none = whole._replace(lags=FEW), whole._replace(lags=FEW[:0])

        # `first_change`: largest change of the backup torque within one cycle, without the torque jump at the stance change.
        # The command may change by at most `assumptions.rate` per cycle. The backup torque may change by `first_change`.
        # So the torque jump can decrease by at least `assumptions.rate` - `first_change` per cycle.
        change = Effect(np.diff(lightest.pushed_feedback, axis=0, prepend=0.0), nothing, self.mass)
        first_change = run(change, mobilities, bounds, none, np.zeros((blocks, 0, 4)))
        remaining = hand_over.remaining(blend, assumptions.rate - first_change[:, :2] - first_change[:, 2:])
        # The old torque acts until the first new command arrives, at the latest `delays[1]` cycles after the stance change.
        before = np.tile(hand_over.torque, (assumptions.delays[1], 1))
        bounds[:, :, 0] = leg.budget(assumptions.mismatch, hand_over, np.concatenate([before, remaining]))

        # The loops in `family` differ in inertia error and delay. `reach` and `few_ahead[2]` are maxima over all these loops.
        # Example: a joint moves faster if the leg is lighter than in the model, or if the command arrives later.
        self.reach = np.zeros((blocks, len(whole.lags), 4))
        # `few_ahead`: largest changes of predicted torques [Nm] and speeds [rad/s] that disturbances can cause.
        # Axis 0: torque of the loop without model errors, speed of the same loop, largest speed of all loops in `family`.
        # Axis 1: start of the prediction. Element k is for the start cycles k * START_CYCLES to (k + 1) * START_CYCLES - 1.
        # Axis 2: element i is for the prediction FEW[i] cycles ahead.
        # Axis 3: hip and knee under model errors, then hip and knee under the torques `Assumptions.promise`.
        few_ahead = np.zeros((3, blocks, len(FEW), 4))
        lag = assumptions.loop.velocity_lag
        first, first_rates = [], []
        for one in family:
            late, late_rate = (np.ascontiguousarray(rows[:, :, 2:4]) for rows in (one.error, one.rate))
            first.append(run(Effect(one.pushed_error, lag * late, same), mobilities, bounds, whole, self.reach))
            first[-1][:, :2] += np.abs(late[: last + 1]).sum(axis=2) * lag * hand_over.acceleration
            rate = Effect(one.pushed_rate, lag * late_rate, same)
            first_rates.append(run(rate, mobilities, bounds, few, few_ahead[2]))
        torque, speed = Effect(nominal.pushed_feedback, nothing, self.mass), Effect(nominal.pushed_rate, nothing, same)
        first_torque = run(torque, mobilities, bounds, few, few_ahead[0])
        first_speed = run(speed, mobilities, bounds, few, few_ahead[1])
        # Axes 0 and 1 of `by_bound` are axes 1 and 2 of `few_ahead`.
        # Axis 2: model errors, disturbance torques. Axis 3: torque, speed. Axis 4: sagittal hip, sagittal knee.
        by_bound = few_ahead[:2].reshape(2, blocks, len(FEW), 2, 2).transpose(1, 2, 3, 0, 4)
        self.few_reach: Vector = np.concatenate([by_bound.reshape(blocks, len(FEW), 8), few_ahead[2]], axis=2)
        self.few_ahead: Vector = np.concatenate([nominal.feedback[FEW], nominal.rate[FEW]], axis=1)
        rates = [_for_rate_difference(one.rate[FEW] - nominal.rate[FEW]) for one in family]
        self.few_slack: Vector = np.abs(rates).max(axis=0)
        self.start = StartReach(
            np.max(first, axis=0), first_torque, first_speed, np.max(first_rates, axis=0), first_change
        )


#: Cached tables of the last gaits and gains, in the order of their last use. The first table is deleted first.
_kept: dict[bytes, Prediction] = {}
_MOST_KEPT = 8


def prediction_of(policy: BackupPolicy, leg: Leg, assumptions: Assumptions, blend: Vector, width: float) -> Prediction:
    """Return the prediction for a leg, from a cache if possible.

    The last `_MOST_KEPT` predictions are cached, because guide shapes with the same largest width share the prediction of a gait.

    Args:
        policy: gains of the backup policy.
        leg: swing leg along the nominal trajectory, to the end of the overlap.
        assumptions: assumptions of the promise for which the tables are computed.
        blend: element i is the fraction of the torque added at the stance change that remains i cycles later, shape (m,).
        width: largest width of the guides for which the tables are used [rad].
    """
    parts = [leg.time, leg.q, leg.qd, leg.qdd, leg.gravity, leg.inertia.fit, blend]
    content = hashlib.sha256(repr((policy, assumptions, leg.deadbeat, leg.friction, width)).encode())
    for part in parts:
        content.update(np.ascontiguousarray(part).tobytes())
    key = content.digest()
    tables = _kept.pop(key) if key in _kept else Prediction(policy, leg, assumptions, blend, width)
    _kept[key] = tables
    if len(_kept) > _MOST_KEPT:
        del _kept[next(iter(_kept))]
    return tables


def _for_rate_difference(rows: Vector) -> Vector:
    """Convert prediction matrices: elements 2 and 3 of their state become the error rates, true minus measured.

    The given matrices multiply a state in which elements 2 and 3 are the true error rates of SH and SK. Elements 4 and 5 are the
    measured error rates. The returned matrices multiply a state in which elements 2 and 3 are the differences true - measured.
    The predicted values are the same, because a * true + b * measured = a * (true - measured) + (a + b) * measured.

    Args:
        rows: prediction matrices. The index of the last axis is the element of the state.
    """
    result = rows.copy()
    result[..., 4:6] += rows[..., 2:4]
    return result


def _blocks(rows: Vector, size: int) -> Vector:
    """Return the maximum of each block of `size` consecutive elements along the first axis."""
    starts = np.arange(0, len(rows), size)
    return np.maximum.reduceat(rows, starts, axis=0)
