"""Virtual guide filter of the coupled sagittal hip and knee (SH, SK) of the swing leg.

`measured motion -> function h of the safe backward image -> gate -> torques`. In each cycle the filter predicts the motion under
the backup policy for the next `Assumptions.horizon` cycles, and adds the largest effect of all disturbances. The share
of the backup torque grows as the prediction comes closer to the guide, to the torque limit or to the speed limit. The
two joints share one h and one gate, because a torque at one joint accelerates both joints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from atalante_control.guide.kernel import (
    COLUMNS,
    FLOOR,
    MASS,
    SLACK_CYCLES,
    TAIL_CYCLES,
    TAIL_MARGIN,
    Block,
    Few,
    Guard,
    GuideTables,
    Lag,
    LegState,
    Motion,
    slide_maximum,
    tick,
    write_bounds,
    write_motion,
)
from atalante_control.guide.prediction import FEW, Prediction
from atalante_control.guide.shapes import GuideShape
from atalante_control.joint.idealization import law_of
from atalante_control.structured import Records, zeros
from atalante_hal.compiled import compiled, specialised
from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

_SMOOTHED = 11  # number of cycles of the moving mean in `_smoothed`


@dataclass(frozen=True)
class GuideConfig:
    """Parameters of the guide filter that do not depend on gait and gains.

    Raises:
        ValueError: If a number is out of range.
    """

    torque_limit: float  # Nm, largest allowed torque of SH and SK in the prediction
    rate_limit: float  # Nm, largest allowed change of the backup torque within one cycle
    speed_limit: float  # rad/s, largest allowed speed of SH and SK, predicted with the inertia and delay of the model
    worst_speed_limit: float  # rad/s, largest allowed speed of SH and SK, predicted with the worst inertia and delay
    #: Gain zeta [s]. While the safety value h falls, the backup torque has the weight w + (1 - w) * zeta * (-dh/dt), at most 1.
    #: Here, w is the weight at a constant h. Example: with zeta = 0.01 s, dh/dt = -50 1/s raises the weight from 0 to 0.5.
    #: The backup torque must rise before h is negative, because a joint may leave the guide at a negative h.
    zeta: float = 0.01
    #: s, time constant of the low-pass filter for dh/dt, the rate of change of the safety value h
    derivative_time: float = 0.005
    release: float = 0.03  # s, shortest time in which the weight of the backup torque falls from 1 to 0
    #: Factor in [0, 1] on the torque u_i, which cancels friction, gravity, centrifugal and Coriolis torques.
    #: While the backup torque has the weight w, u_i is multiplied by `idealization` * (1 - w) + w.
    idealization: float = 1.0
    #: Factor in [0, 1] on the torque u_f, which accelerates the leg along q_des (feedforward).
    #: While the backup torque has the weight w, u_f is multiplied by `feedforward` * (1 - w) + w.
    feedforward: float = 0.0

    def __post_init__(self) -> None:
        for name in ("torque_limit", "rate_limit", "speed_limit", "worst_speed_limit", "release"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")
        for name in ("zeta", "derivative_time"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must be finite and at least 0 s, got {getattr(self, name)!r}")
        for name in ("idealization", "feedforward"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"intensity of {name} must be between 0 and 1, got {getattr(self, name)!r}")


class GuideFilter:
    """Guide filter of hip and knee for one gait, one shape and one set of gains. By symmetry, the filter serves both swing legs.

    Call `start_step` at each stance change, then `tick` once per cycle.

    Attributes:
        config: parameters.
        shape: shape of the guide.
        prediction: gains, gait and tables of the prediction.
        tables: tables of `kernel`; the results of the last tick are in `tables.guards`.
        blend: smallest gate for each cycle since the stance change, shape (m,).
        cycles: number of cycles of a step.
        time: time since the stance change in each cycle, to the end of the prediction, shape (n,) [s].
    """

    def __init__(self, config: GuideConfig, shape: GuideShape, prediction: Prediction, blend: Vector) -> None:
        """Compute the tables that are the same in every step.

        Args:
            config: parameters.
            shape: shape of the guide.
            prediction: gains, gait and tables of the prediction.
            blend: smallest gate for each cycle since the stance change, shape (m,).

        Raises:
            ValueError: If a bound of the shape is invalid in a cycle of the step, see `GuideShape.bounds`.
        """
        self.config, self.shape, self.prediction, self.blend = config, shape, prediction, blend
        leg = prediction.leg
        self.cycles, self.time = prediction.cycles, leg.time
        self._phase = np.minimum(np.arange(len(leg.time)) / self.cycles, 1.0)
        shape.check(self._phase)
        self._motion = _motion(prediction)
        step = np.zeros((len(leg.time), COLUMNS))
        step[:, MASS : MASS + 3] = prediction.mass.reshape(-1, 4)[:, [0, 1, 3]]
        step[: len(blend), FLOOR] = blend
        self.tables = GuideTables(
            guards=_guards(config, prediction),
            laws=law_of(leg.friction, leg.inertia),
            lags=_lags(prediction),
            blocks=_blocks(prediction),
            few=_few(prediction),
            reach=prediction.reach,
            highest=np.maximum.reduceat(prediction.reach, np.arange(0, len(prediction.ahead), SLACK_CYCLES), axis=1),
            few_reach=prediction.few_reach,
            step=step,
        )
        self._write_bounds = specialised(write_bounds, step, self._bounds(0.0))
        self._write_motion = specialised(write_motion, step, self._motion, (0.0, 0.0), (0.0, 0.0))
        self.start_step(0.0, (0.0, 0.0), (0.0, 0.0))
        discarded = self.tables._replace(guards=self.tables.guards.copy())  # type: ignore[attr-defined]
        self._tick = specialised(tick, discarded, 0, LegState(*[0.0] * 10))

    def start_step(self, xi: float, deviation: Pair, rate: Pair, promise: float = 1.0) -> None:
        """Start a step: compute the guide from the assistance factor, and the reference from the deviations at the stance change.

        Args:
            xi: assistance factor of the whole step.
            deviation: deviations s(0) of SH and SK at the stance change [rad].
            rate: deviations s'(0) of SH and SK at the stance change [rad/s].
            promise: disturbance that the filter assumes in this step, as a fraction of `Assumptions.promise`.
        """
        guard, step = self.tables.guards[0], self.tables.step
        if xi != guard.xi:
            self._write_bounds(step, self._bounds(xi))
        self._write_motion(step, self._motion, deviation, rate)
        guard.xi, guard.promise, guard.fresh = xi, promise, True

    def _bounds(self, xi: float) -> Vector:
        """Return the bounds of the guide in each cycle, shape (2, n, 2) [rad]. `specialised` requires an array in C order."""
        return np.ascontiguousarray(self.shape.bounds(self._phase, xi))

    def widths(self, xi: float) -> Vector:
        """Return the distance from q_des to the nearer bound of the guide, for hip and knee in each cycle, shape (n, 2) [rad].

        Args:
            xi: assistance factor in [0, 1].
        """
        return np.asarray(self.shape.bounds(self._phase, xi).min(axis=2).T)

    def tick(self, cycle: int, leg: LegState) -> Pair:
        """Return the torques of sagittal hip and knee [Nm].

        Args:
            cycle: number of cycles since the stance change. A number above the length of the step is replaced by this length.
            leg: measurements of the swing leg.
        """
        return self._tick(self.tables, min(cycle, self.cycles), leg)

    @property
    def state(self) -> Vector:
        """Return a copy of the state of the sampled loop at the last cycle, shape (10,), as defined in `backup_policy`."""
        return self.tables.guards[0].state.copy()

    def errors_ahead(self) -> Vector:
        """Return the last prediction: tracking errors of hip and knee without disturbances, shape (n, 2) [rad]."""
        return np.asarray(self.prediction.ahead @ (self.prediction.compress @ self.state))

    def uncertainty(self) -> Vector:
        """Return the largest change of `errors_ahead` due to errors of inertia and delay, shape (n, 2) [rad]."""
        x = self.state
        size = np.abs(np.concatenate([x[:2], x[2:4] - x[4:6], x[4:]]))
        return np.repeat(self.prediction.slack @ size, SLACK_CYCLES, axis=0)[: len(self.prediction.ahead)]

    @property
    def h(self) -> float:
        """Return the safety value h of the last cycle. If h >= 0, the backup policy can keep both joints inside the guide."""
        return float(self.tables.guards[0].h)

    @property
    def gate(self) -> float:
        """Return the weight of the backup torque at the last cycle."""
        return float(self.tables.guards[0].gate)


def tail(inverse: Vector) -> Vector:
    """Return (1 + `TAIL_MARGIN`) / (smallest guide width in a cycle and the next `TAIL_CYCLES` cycles), shape (n, m) [1/rad].

    Row k of the result is for the cycles k to k + `TAIL_CYCLES`.

    Args:
        inverse: 1 / width, shape (n, m) [1/rad]. Row k is cycle k. A width is the distance from q_des to a bound of the guide.
            The last row applies to all later cycles.
    """
    largest = np.array(inverse, order="C")
    compiled(slide_maximum)(largest, 0, largest.shape[1], TAIL_CYCLES + 1)
    return (1.0 + TAIL_MARGIN) * largest


def _lags(prediction: Prediction) -> Records[Lag]:
    """Return the tables of the predicted errors, one table for each predicted cycle."""
    lags = zeros(Lag, len(prediction.ahead))
    lags["ahead"] = prediction.ahead.swapaxes(1, 2)
    return lags


def _blocks(prediction: Prediction) -> Records[Block]:
    """Return the bounds of the predicted errors, one for each block of consecutive predicted cycles."""
    blocks, starts = zeros(Block, len(prediction.slack)), np.arange(0, len(prediction.ahead), SLACK_CYCLES)
    high, low = (extreme.reduceat(prediction.ahead, starts).swapaxes(1, 2) for extreme in (np.maximum, np.minimum))
    blocks["slack"] = prediction.slack.swapaxes(1, 2)
    blocks["middle"], blocks["spread"] = 0.5 * (high + low), 0.5 * (high - low)
    return blocks


def _few(prediction: Prediction) -> Records[Few]:
    """Return the tables of the predicted torques and speeds, one for each prediction length in `FEW`."""
    rows = zeros(Few, len(FEW))
    rows["lag"], rows["slack"] = FEW, prediction.few_slack.swapaxes(1, 2)
    rows["ahead"] = prediction.few_ahead.swapaxes(1, 2)
    return rows


def _guards(config: GuideConfig, prediction: Prediction) -> Records[Guard]:
    """Return the initial record of the filter, shape (1,): gains and limits, without the values of a step."""
    guards: Records[Guard] = zeros(Guard, 1)
    guard, loop = guards[0], prediction.assumptions.loop
    guard.gains[:] = np.hstack(prediction.policy.gains())
    guard.compression[:], guard.few_slack[:] = prediction.compress, prediction.few_slack.max(axis=0).T
    guard.torque_limit, guard.speed_limit = config.torque_limit, config.speed_limit
    guard.worst_speed_limit = config.worst_speed_limit
    guard.tracking, guard.keep = loop.tracking, loop.keep
    guard.zeta, guard.smoothing = config.zeta, PERIOD / (config.derivative_time + PERIOD)
    guard.release = PERIOD / config.release
    guard.idealization, guard.feedforward = config.idealization, config.feedforward
    guard.xi, guard.h, guard.bounds[:] = math.nan, 1.0, math.inf
    return guards


def _motion(prediction: Prediction) -> Motion:
    """Compute the two parts of the desired motion of a step: nominal motion, and offset of the re-centring."""
    leg, loop = prediction.leg, prediction.assumptions.loop
    time, lag = leg.time, loop.command_lag
    values, slopes, curvatures = leg.deadbeat.basis(time)
    # The acceleration of the re-centring ends with a jump. The moving mean prevents a jump of the torque.
    ahead = [_smoothed(row) for row in leg.deadbeat.basis(time + lag)[2]]
    of_deviation, of_rate = (
        np.column_stack([accelerations, _measured(value, slope, loop.keep), slope, curvature])
        for accelerations, value, slope, curvature in zip(ahead, values, slopes, curvatures, strict=True)
    )
    acceleration = np.stack([np.interp(time + lag, time, leg.qdd[:, i]) for i in (0, 1)], axis=1)
    velocity = np.stack([_measured(leg.q[:, i], leg.qd[:, i], loop.keep) for i in (0, 1)], axis=1)
    return Motion(np.hstack([acceleration, velocity, leg.qd, prediction.torque]), of_deviation, of_rate)


def _smoothed(row: Vector) -> Vector:
    """Return the moving mean over `_SMOOTHED` values, centred on each value, shape (n,)."""
    padded = np.pad(row, _SMOOTHED // 2, mode="edge")
    return np.convolve(padded, np.full(_SMOOTHED, 1.0 / _SMOOTHED), mode="valid")


def _measured(value: Vector, slope: Vector, keep: float) -> Vector:
    """Return the velocity that a drive would measure along a trajectory, shape (n,). The first value is the true velocity."""
    result = slope.copy()
    for i in range(1, len(value)):
        result[i] = keep * result[i - 1] + (1.0 - keep) * (value[i] - value[i - 1]) / PERIOD
    return result
