"""Compiled cycle of the virtual guide filter, which computes the torques of sagittal hip and knee (SH, SK).

`GuideFilter` prepares the tables and runs the compiled `tick` in each cycle. A tick has four steps:

1. Estimate the state of the leg from the measurements (`_estimate`).
2. Predict errors, torques and speeds under the backup policy. Their largest ratio to their limits gives the safety value h
   (`largest_ratio`).
3. Compute the gate from h. The gate is the weight of the backup torque (`gate`, `damped_gate`).
4. Return the weighted mean of the torque of the free motion and the backup torque.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from atalante_control.guide.backup_policy import STATES
from atalante_control.joint.idealization import Law, idealization, mass
from atalante_control.structured import Records
from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

#: Slope of the conversion of a torque ratio or speed ratio x (x = value / limit) to 1 - STEEPNESS * (1 - x).
#: Example: the ratio 0.9 is converted to 0.6, and the ratio 1 to 1.
#: Normal walking already uses most of the allowed torque and speed.
#: Due to the conversion, torque and speed raise the weight of the backup torque only close to their limits.
STEEPNESS = 4.0
#: Number of elements of the compressed state, a short form of the state of the leg.
#: A prediction of the tracking errors from the compressed state is faster than a prediction from all 10 elements of the state.
COMPRESSED = 5
#: Number of consecutive predicted cycles in a `Block`.
#: `Block.slack` bounds the effect of model errors in all cycles of the block.
SLACK_CYCLES = 10
#: Number of start cycles that share one row of `GuideTables.reach`. Example: predictions that start in cycle 8 to 11 use row 2.
START_CYCLES = 4


class Guard:
    """Constants and state of the filter, and results of the last cycle."""

    #: Gains of the backup policy. Row 0: acceleration of the hip. Row 1: acceleration of the knee.
    #: Columns 0 and 1: Kv, gains on the errors of hip and knee [1/s2]. Columns 2 and 3: Dv, gains on the error rates [1/s].
    gains: Annotated[Vector, (2, 4)]
    torque_limit: float  # Nm, largest allowed torque in the prediction
    speed_limit: float  # rad/s, largest allowed speed of SH and SK, predicted with the inertia and delay of the model
    worst_speed_limit: float  # rad/s, largest allowed speed of SH and SK, predicted with the worst inertia and delay
    tracking: float  # share of a commanded torque change that a motor reaches within one cycle
    keep: float  # weight of the old value in the low-pass of the measured velocity
    #: Gain zeta [s]. While the safety value h falls, the backup torque has the weight w + (1 - w) * zeta * (-dh/dt), at most 1.
    #: Here, w is the weight at a constant h. Example: with zeta = 0.01 s, dh/dt = -50 1/s raises the weight from 0 to 0.5.
    #: The backup torque must rise before h is negative, because a joint may leave the guide at a negative h.
    zeta: float
    #: weight of the new value in the low-pass filter for `rate`, the rate of change of the safety value h
    smoothing: float
    #: Largest decrease of the gate (weight of the backup torque) per cycle.
    #: Without a limit of the decrease, the gate would oscillate.
    release: float
    #: factor in [0, 1] on the torque u_i, which cancels friction, gravity, centrifugal and Coriolis torques (joint idealization)
    idealization: float
    feedforward: float  # factor in [0, 1] on the torque u_f, which accelerates the leg along q_des (feedforward)
    promise: float  # disturbance torques that the filter assumes in this step, as a fraction of `Assumptions.promise`
    xi: float  # assistance factor of the step, from 0 (widest guide) to 1 (narrowest guide)
    fresh: bool  # True until the first cycle of a step is computed
    motor: Annotated[Vector, 2]  # Nm, estimated torques of the motors of hip and knee
    lag: Annotated[Vector, 2]  # rad/s, estimated error of the measured velocities of hip and knee: true minus measured
    state: Annotated[Vector, STATES]  # state of the last cycle, see `backup_policy`
    #: Magnitudes of the state. The largest effect of model errors is a weighted sum of these magnitudes.
    #: Elements 2 and 3: abs(true error rate - measured error rate) of hip and knee [rad/s].
    #: All other elements: absolute value of the same element of `state`.
    magnitude: Annotated[Vector, STATES]
    compression: Annotated[Vector, (COMPRESSED, STATES)]  # matrix from the state to the compressed state
    compressed: Annotated[Vector, COMPRESSED]  # compressed state of the last cycle
    few_slack: Annotated[Vector, (STATES, 2)]  # elementwise maximum of `Few.slack` over all prediction lengths
    #: safety value 1 - `largest_ratio`^2 of the last cycle; at h >= 0, the backup policy can keep both joints inside the guide
    h: float
    rate: float  # 1/s, rate of change of the safety value h, after a low-pass filter
    #: Weight of the backup torque in the last cycle. `tick` writes a value in [0, 1].
    #: The literal law (`literal.assistive_torque`) can write a value outside [0, 1].
    gate: float
    #: rad, distances from q_des to the bounds: hip upper, hip lower, knee upper, knee lower
    bounds: Annotated[Vector, 4]


class Lag:
    """Prediction matrix for one number of cycles ahead: `GuideTables.lags[i]` predicts the tracking errors i cycles ahead.

    A record has arrays of fixed shape, so the compiled loops are fast.
    """

    #: Matrix that predicts the errors of hip and knee [rad] from the compressed state: errors = `Guard.compressed` @ `ahead`.
    ahead: Annotated[Vector, (COMPRESSED, 2)]


class Block:
    """Bounds of the tracking errors in a group of `SLACK_CYCLES` consecutive predicted cycles, for example cycles 20 to 29.

    In each cycle of the block, each element of the matrix `Lag.ahead` is between `middle` - `spread` and `middle` + `spread`.
    """

    #: `Guard.magnitude` @ `slack` is the largest change of the tracking errors of hip and knee due to model errors [rad].
    slack: Annotated[Vector, (STATES, 2)]
    middle: Annotated[Vector, (COMPRESSED, 2)]  # (largest + smallest `Lag.ahead` in the block) / 2, for each element
    spread: Annotated[Vector, (COMPRESSED, 2)]  # (largest - smallest `Lag.ahead` in the block) / 2, for each element
    ratio: float  # upper bound of the ratio of predicted error to guide width in the block, computed in the last control cycle


class Few:
    """Prediction of torque and speed `lag` cycles ahead, see `prediction.FEW`."""

    lag: int  # number of cycles ahead
    #: State @ `ahead` gives four predicted values. Values 0 and 1: feedback acceleration -Kv e - Dv e' of hip and knee [rad/s2].
    #: Values 2 and 3: error rate e' of hip and knee [rad/s].
    ahead: Annotated[Vector, (STATES, 4)]
    #: `Guard.magnitude` @ `slack` is the largest change of the error rate e' of hip and knee due to model errors [rad/s].
    slack: Annotated[Vector, (STATES, 2)]


class GuideTables(NamedTuple):
    """Tables of the guide filter. `GuideFilter` owns the tables; `tick` writes to `guards` and to `Block.ratio` only.

    Columns of `few_reach`:

    - 0 to 3: change of hip torque, knee torque, hip speed and knee speed due to torque errors of the model,
    - 4 to 7: change of hip torque, knee torque, hip speed and knee speed due to the disturbance torques `Assumptions.promise`,
    - 8 and 9: as columns 2 and 3 (hip and knee speed, torque errors of the model), but with the worst inertia and delay,
    - 10 and 11: as columns 6 and 7 (hip and knee speed, `Assumptions.promise`), but with the worst inertia and delay.
    """

    guards: Records[Guard]  # (1,) constants, state and results of the filter
    laws: Records[Law]  # (1,) mass matrix and friction
    lags: Records[Lag]  # (lags,) predictions of the tracking errors; the index is the number of cycles ahead
    blocks: Records[Block]  # (blocks,) bounds of the predicted tracking errors
    few: Records[Few]  # (rows,) predictions of torque and speed, in ascending order of `Few.lag`
    #: (starts, lags, 4) rad, largest tracking errors that disturbances can cause.
    #: Example: reach[2, 50] is the error 50 cycles ahead, if the prediction starts in one of the cycles 8 to 11 of the step.
    #: The 4 columns: hip and knee due to model errors, then hip and knee due to the disturbance torques `Assumptions.promise`.
    reach: Vector
    #: (starts, blocks, 4) rad, maximum of `reach` over all cycles of a `Block`.
    #: Example: highest[2, 5] is the maximum of reach[2, 50] to reach[2, 59].
    highest: Vector
    #: (starts, rows, 12) largest changes of torque [Nm] and speed [rad/s] due to disturbances. Columns: see the class docstring.
    #: Example: few_reach[2, 3] is the change after `few[3].lag` cycles of a prediction that starts in one of the cycles 8 to 11.
    few_reach: Vector
    #: (n, COLUMNS) values of gait and guide in each cycle of a step.
    #: In an airwalk (robot suspended), additional rows contain the first cycles of the next step.
    #: Reason: the predictions of an airwalk reach into the next step.
    step: Vector


#: Columns 0 to 3 of `step`: 1 / (distance from q_des to a bound) [1/rad].
#: Order of the bounds: hip upper, hip lower, knee upper, knee lower.
INVERSE = 0
REFERENCE = 4  # columns 4 and 5 of `step`: acceleration of q_des at the time when a command takes effect [rad/s2]
VELOCITY = 6  # columns 6 and 7 of `step`: velocity of q_des after the low-pass of the drives [rad/s]
BASE = 8  # columns 8 and 9 of `step`: torque that moves the leg along q_des [Nm]
MASS = 10  # columns 10 to 12 of `step`: mass matrix M11, M12 and M22 along q_des [kg m2]
SPEED = 13  # columns 13 and 14 of `step`: velocity of q_des [rad/s]
#: Column 15 of `step`: smallest allowed weight of the backup torque.
#: The smallest allowed weight falls from 1 to 0 in the first cycles of a step, so a step starts with the full backup torque.
FLOOR = 15
#: Columns 16 to 19 of `step` [1/rad], computed from columns 0 to 3 in the same order.
#: Row k: largest value of the column in the rows k to k + `TAIL_CYCLES`, multiplied by 1 + `TAIL_MARGIN`.
TAIL = 16
#: Columns 20 to 23 of `step` [1/rad], computed from columns 0 to 3 in the same order.
#: Row k: largest value of the column in the rows k to k + `SLACK_CYCLES` - 1.
NEAR = 20
COLUMNS = 24
#: Number of cycles after the end of the prediction in which the guide must still be wider than the last predicted error.
TAIL_CYCLES = 60
#: Relative margin: the guide width must be at least (1 + `TAIL_MARGIN`) * (error in the last predicted cycle).
#: The margin keeps the error inside the guide in the cycles after the last predicted cycle.
TAIL_MARGIN = 0.03


def write_bounds(step: Vector, bounds: Vector) -> None:
    """Write the guide of a step to the columns `INVERSE`, `TAIL` and `NEAR`.

    Args:
        step: table of the step, shape (n, COLUMNS).
        bounds: distances from q_des to the upper and lower bound for hip and knee, shape (2, n, 2) [rad].
    """
    for cycle in range(len(step)):
        row = step[cycle]
        for joint in range(2):
            for side in range(2):
                column, inverse = 2 * joint + side, 1.0 / bounds[joint, cycle, side]
                row[INVERSE + column] = row[TAIL + column] = row[NEAR + column] = inverse
    slide_maximum(step, TAIL, TAIL + 4, TAIL_CYCLES + 1)
    slide_maximum(step, NEAR, NEAR + 4, SLACK_CYCLES)
    for cycle in range(len(step)):
        for column in range(TAIL, TAIL + 4):
            step[cycle, column] *= 1.0 + TAIL_MARGIN


def slide_maximum(table: Vector, first: int, end: int, cycles: int) -> None:
    """Replace each value by the largest value of the same column in `cycles` rows, from the row of the value on.

    Args:
        table: values, shape (n, m), changed in place. The last row also stands for all rows after it.
        first: first column that is changed.
        end: column after the last column that is changed.
        cycles: number of rows of each maximum.
    """
    last, covered = len(table) - 1, 1  # each value is the maximum of `covered` rows of the original table
    while covered < cycles:
        shift = min(covered, cycles - covered)
        for row in range(last):  # rows are changed in ascending order, so row `later` still contains its old values
            later = min(row + shift, last)
            for column in range(first, end):
                table[row, column] = max(table[row, column], table[later, column])
        covered += shift


class Motion(NamedTuple):
    """Desired motion as a linear function of the deviations at the stance change. `write_motion` evaluates this function.

    Rows are cycles since the stance change. The columns are four values of hip and knee: acceleration (one command lag
    later), velocity after the low-pass of the drives, velocity, and torque.

    The re-centring adds an offset s(t) to the nominal motion. The offset is linear in the deviations s(0) and s'(0) at the stance
    change. SH and SK have the same factors. The last factor is the acceleration s'', from which the torque follows.
    """

    #: (n, 8) nominal motion, without the re-centring offset s. Each quantity has two columns: hip, then knee.
    #: Quantities: acceleration [rad/s2], velocity after the low-pass of the drives [rad/s], velocity [rad/s], torque [Nm].
    nominal: Vector
    #: (n, 4) re-centring offset s for s(0) = 1 rad and s'(0) = 0.
    #: Columns: s'' one command lag later [rad/s2], s' after the low-pass of the drives [rad/s], s' [rad/s], s'' [rad/s2].
    of_deviation: Vector
    of_rate: Vector  # (n, 4) re-centring offset s for s'(0) = 1 rad/s and s(0) = 0; columns as in `of_deviation`


def write_motion(step: Vector, motion: Motion, deviation: Pair, rate: Pair) -> None:
    """Write the desired motion of a step to the columns `REFERENCE`, `VELOCITY`, `SPEED` and `BASE`.

    Args:
        step: table of the step, shape (n, COLUMNS). The columns `MASS` must be set.
        motion: desired motion of every step.
        deviation: deviations s(0) of SH and SK at the stance change [rad].
        rate: deviations s'(0) of SH and SK at the stance change [rad/s].
    """
    for cycle in range(len(step)):
        row, nominal = step[cycle], motion.nominal[cycle]
        by_deviation, by_rate = motion.of_deviation[cycle], motion.of_rate[cycle]
        hip = by_deviation[3] * deviation[0] + by_rate[3] * rate[0]
        knee = by_deviation[3] * deviation[1] + by_rate[3] * rate[1]
        row[BASE] = row[MASS] * hip + row[MASS + 1] * knee + nominal[6]
        row[BASE + 1] = row[MASS + 1] * hip + row[MASS + 2] * knee + nominal[7]
        for joint in range(2):
            s, s_rate = deviation[joint], rate[joint]
            row[REFERENCE + joint] = by_deviation[0] * s + by_rate[0] * s_rate + nominal[joint]
            row[VELOCITY + joint] = by_deviation[1] * s + by_rate[1] * s_rate + nominal[2 + joint]
            row[SPEED + joint] = by_deviation[2] * s + by_rate[2] * s_rate + nominal[4 + joint]


class LegState(NamedTuple):
    """Measurements, q_des, sent torques and gravity torques of sagittal hip and knee (SH, SK) of the swing leg in one cycle."""

    hip: float  # rad, q of SH
    knee: float  # rad, q of SK
    hip_rate: float  # rad/s, measured velocity of the sagittal hip
    knee_rate: float  # rad/s, measured velocity of the knee
    hip_desired: float  # rad, q_des of SH
    knee_desired: float  # rad, q_des of SK
    hip_sent: float  # Nm, command of the previous cycle to the sagittal hip, after the limiter
    knee_sent: float  # Nm, command of the previous cycle to the knee, after the limiter
    hip_gravity: float  # Nm, u_g of SH
    knee_gravity: float  # Nm, u_g of SK


def leg_state(hip: int, q: Vector, qd: Vector, desired: Vector, sent: Vector, gravity: Pair) -> LegState:
    """Return the `LegState` of the swing leg.

    Args:
        hip: index of SH of the swing leg in JOINTS; SK is the next joint.
        q: joint angles, shape (12,) [rad].
        qd: joint speeds, shape (12,) [rad/s].
        desired: array whose first 12 elements are q_des [rad].
        sent: torques sent in the last cycle, shape (12,) [Nm].
        gravity: gravity torques of SH and SK [Nm].
    """
    knee = hip + 1
    return LegState(
        q[hip],
        q[knee],
        qd[hip],
        qd[knee],
        desired[hip],
        desired[knee],
        sent[hip],
        sent[knee],
        gravity[0],
        gravity[1],
    )


def tick(guide: GuideTables, cycle: int, leg: LegState) -> Pair:
    """Compute the torques of sagittal hip and knee for one cycle: mean of free torque and backup torque, weighted by the gate.

    The torques are (1 - gate) u_free + gate u_B. u_free is the sum of u_i and u_f, each multiplied by its intensity. u_B is the
    backup torque, see `backup_policy`. The gate is the result of `damped_gate`, with two lower bounds: the value in column
    `FLOOR`, and the last gate minus `Guard.release`. The second bound does not apply in the first cycle of a step.

    Args:
        guide: tables of the guide filter; the results of the tick are written to `GuideTables.guards`.
        cycle: number of cycles since the stance change, at most the length of the step.
        leg: measurements of the swing leg.

    Returns:
        Torques of SH and SK [Nm].
    """
    guard, law, now = guide.guards[0], guide.laws[0], guide.step[cycle]
    u_hip, u_knee = idealization(law, leg.knee, leg.hip_rate, leg.knee_rate, (leg.hip_gravity, leg.knee_gravity))
    m11, m12, m22 = mass(law.fit, leg.knee)
    _estimate(guard, guide.step, cycle, leg, (m11, m12, m22), (u_hip, u_knee))
    x = guard.state

    ratio = largest_ratio(guide, cycle)
    h, rate = 1.0 - ratio * ratio, 0.0
    if not guard.fresh:
        rate = guard.rate + guard.smoothing * ((h - guard.h) / PERIOD - guard.rate)
    weight = max(damped_gate(gate(h, guard.xi), rate, guard.zeta), now[FLOOR])
    if not guard.fresh:
        weight = max(weight, guard.gate - guard.release)
    guard.h, guard.rate, guard.gate, guard.fresh = h, rate, weight, False
    for side in range(4):
        guard.bounds[side] = 1.0 / now[INVERSE + side]

    k, free, share = (
        guard.gains,
        guard.feedforward * (1.0 - weight) + weight,
        guard.idealization * (1.0 - weight) + weight,
    )
    hip = free * now[REFERENCE] - weight * (k[0, 0] * x[0] + k[0, 1] * x[1] + k[0, 2] * x[4] + k[0, 3] * x[5])
    knee = free * now[REFERENCE + 1] - weight * (k[1, 0] * x[0] + k[1, 1] * x[1] + k[1, 2] * x[4] + k[1, 3] * x[5])
    return share * u_hip + m11 * hip + m12 * knee, share * u_knee + m12 * hip + m22 * knee


def _estimate(guard: Guard, step: Vector, cycle: int, leg: LegState, m: tuple[float, float, float], u: Pair) -> None:
    """Estimate the state of the sampled loop and write it into `Guard.state`.

    The measured velocity lags behind the true velocity. The lag caused by the sent torques is known. The lag caused by the
    disturbance is part of `GuideTables.reach`.
    """
    x, now, last = guard.state, step[cycle], step[cycle - 1 if cycle else 0]
    if guard.fresh:
        guard.motor[0], guard.motor[1] = leg.hip_sent, leg.knee_sent
        guard.lag[0], guard.lag[1] = 0.0, 0.0
    x[0], x[1] = leg.hip - leg.hip_desired, leg.knee - leg.knee_desired
    x[4], x[5] = leg.hip_rate - now[VELOCITY], leg.knee_rate - now[VELOCITY + 1]
    x[2], x[3] = x[4] + guard.lag[0], x[5] + guard.lag[1]
    x[6], x[7] = _acceleration(guard.motor[0] - u[0], guard.motor[1] - u[1], m, last)
    x[8], x[9] = _acceleration(leg.hip_sent - u[0], leg.knee_sent - u[1], m, last)
    guard.motor[0] += guard.tracking * (leg.hip_sent - guard.motor[0])
    guard.motor[1] += guard.tracking * (leg.knee_sent - guard.motor[1])
    hip, knee = _acceleration(guard.motor[0] - u[0], guard.motor[1] - u[1], m, last)
    half = 0.5 * PERIOD * (1.0 + guard.keep)
    guard.lag[0] = guard.keep * guard.lag[0] + half * hip
    guard.lag[1] = guard.keep * guard.lag[1] + half * knee


def _acceleration(hip: float, knee: float, m: tuple[float, float, float], row: Vector) -> Pair:
    """Return `M^-1 u - q_des''`, the acceleration of the tracking error e under torques u of sagittal hip and knee [rad/s2]."""
    m11, m12, m22 = m
    determinant = m11 * m22 - m12 * m12
    return (m22 * hip - m12 * knee) / determinant - row[REFERENCE], (m11 * knee - m12 * hip) / determinant - row[
        REFERENCE + 1
    ]


def largest_ratio(guide: GuideTables, cycle: int) -> float:
    """Return the largest ratio of a predicted quantity to its limit, under the backup policy and the worst disturbances.

    The quantities are the tracking error (limit: width of the guide), the torque and the speed. The ratios of torque and speed
    are converted with the slope `STEEPNESS`.

    Args:
        guide: tables of the guide filter; `Guard.state` must contain the state of the current cycle.
        cycle: number of cycles since the stance change.
    """
    guard = guide.guards[0]
    x, y, size = guard.state, guard.compressed, guard.magnitude
    for column in range(STATES):
        size[column] = abs(x[column] - x[column + 2] if 2 <= column < 4 else x[column])
    for i in range(COMPRESSED):
        total = 0.0
        for column in range(STATES):
            total += guard.compression[i, column] * x[column]
        y[i] = total
    ratio = _error_ratio(guide, cycle)
    return max(ratio, _few_ratio(guide, cycle, ratio))


def _error_ratio(guide: GuideTables, cycle: int) -> float:
    """Return the largest ratio of predicted error to guide width.

    Most cycles ahead need not be predicted. `bound_blocks` computes an upper bound of the ratio for each block. The
    block with the largest bound is predicted first. A block whose bound is at most the largest ratio found so far
    cannot contain a larger ratio. The last block is always predicted, because a narrower width (columns `TAIL`) applies to the
    last predicted cycle.
    """
    guard, step, reach = guide.guards[0], guide.step, guide.reach[cycle // START_CYCLES]
    promise, size, y0, y1, y2, y3, y4 = guard.promise, guard.magnitude, *_compressed(guard)
    lags = min(len(guide.lags), len(step) - cycle)
    blocks = (lags + SLACK_CYCLES - 1) // SLACK_CYCLES
    first, worst = bound_blocks(guide, cycle, blocks), 0.0
    for number in range(-1, blocks):
        at = first if number < 0 else number
        block, last = guide.blocks[at], at == blocks - 1
        if number >= 0 and (number == first or (block.ratio <= worst and not last)):
            continue
        hip_slack = knee_slack = e_hip = e_knee = d_hip = d_knee = 0.0
        for column in range(STATES):
            hip_slack += block.slack[column, 0] * size[column]
            knee_slack += block.slack[column, 1] * size[column]
        for lag in range(at * SLACK_CYCLES, min((at + 1) * SLACK_CYCLES, lags)):
            row, width, added = guide.lags[lag].ahead, step[cycle + lag], reach[lag]
            e_hip = row[0, 0] * y0 + row[1, 0] * y1 + row[2, 0] * y2 + row[3, 0] * y3 + row[4, 0] * y4
            e_knee = row[0, 1] * y0 + row[1, 1] * y1 + row[2, 1] * y2 + row[3, 1] * y3 + row[4, 1] * y4
            d_hip = hip_slack + added[0] + promise * added[2]
            d_knee = knee_slack + added[1] + promise * added[3]
            worst = max(worst, (d_hip + e_hip) * width[INVERSE], (d_hip - e_hip) * width[INVERSE + 1])
            worst = max(worst, (d_knee + e_knee) * width[INVERSE + 2], (d_knee - e_knee) * width[INVERSE + 3])
        if last:
            width = step[cycle + lags - 1]
            worst = max(worst, (d_hip + e_hip) * width[TAIL], (d_hip - e_hip) * width[TAIL + 1])
            worst = max(worst, (d_knee + e_knee) * width[TAIL + 2], (d_knee - e_knee) * width[TAIL + 3])
    return worst


def _compressed(guard: Guard) -> tuple[float, float, float, float, float]:
    """Return the five elements of the compressed state, from which the errors are predicted."""
    y = guard.compressed
    return y[0], y[1], y[2], y[3], y[4]


def bound_blocks(guide: GuideTables, cycle: int, blocks: int) -> int:
    """Compute `Block.ratio`, the upper bound of error / width, for each block. Return the index of the largest bound.

    In a block, a predicted error differs from `Block.middle` times the compressed state y by at most `Block.spread` times abs(y).
    The disturbances add at most `GuideTables.highest`, and 1 / width is at most the value in the columns `NEAR`.

    Args:
        guide: tables of the guide filter; `Guard.magnitude` and `Guard.compressed` must belong to the current cycle.
        cycle: number of cycles since the stance change.
        blocks: number of blocks.
    """
    guard, highest, promise = guide.guards[0], guide.highest[cycle // START_CYCLES], guide.guards[0].promise
    y, size = guard.compressed, guard.magnitude
    first, most = 0, -1.0
    for number in range(blocks):
        block, added, width = guide.blocks[number], highest[number], guide.step[cycle + number * SLACK_CYCLES]
        d_hip, d_knee = added[0] + promise * added[2], added[1] + promise * added[3]
        e_hip = e_knee = 0.0
        for column in range(STATES):
            d_hip += block.slack[column, 0] * size[column]
            d_knee += block.slack[column, 1] * size[column]
        for i in range(COMPRESSED):
            e_hip += block.middle[i, 0] * y[i]
            e_knee += block.middle[i, 1] * y[i]
            d_hip += block.spread[i, 0] * abs(y[i])
            d_knee += block.spread[i, 1] * abs(y[i])
        bound = max((d_hip + e_hip) * width[NEAR], (d_hip - e_hip) * width[NEAR + 1])
        bound = max(bound, (d_knee + e_knee) * width[NEAR + 2], (d_knee - e_knee) * width[NEAR + 3])
        block.ratio = bound
        if bound > most:
            first, most = number, bound
    return first


def _few_ratio(guide: GuideTables, cycle: int, least: float) -> float:
    """Return 1 - STEEPNESS * (1 - r), where r is the largest ratio of a predicted torque or speed to its limit.

    Args:
        guide: tables of the guide filter.
        cycle: number of cycles since the stance change.
        least: ratio below which the exact result is not needed. If the exact result is below `least`, the returned
            result may be smaller than the exact result.
    """
    guard, step, reach = guide.guards[0], guide.step, guide.few_reach[cycle // START_CYCLES]
    x, size, promise = guard.state, guard.magnitude, guard.promise
    torque = speed = worst = hip_most = knee_most = 0.0
    known = guard.worst_speed_limit * (1.0 - (1.0 - least) / STEEPNESS)
    for column in range(STATES):
        hip_most += guard.few_slack[column, 0] * size[column]
        knee_most += guard.few_slack[column, 1] * size[column]
    for i in range(len(guide.few)):
        few = guide.few[i]
        at = cycle + few.lag
        if at >= len(step):
            break
        now, added = step[at], reach[i]
        a_hip = a_knee = v_hip = v_knee = 0.0
        for column in range(STATES):
            a_hip += few.ahead[column, 0] * x[column]
            a_knee += few.ahead[column, 1] * x[column]
            v_hip += few.ahead[column, 2] * x[column]
            v_knee += few.ahead[column, 3] * x[column]
        hip = now[BASE] + now[MASS] * a_hip + now[MASS + 1] * a_knee
        knee = now[BASE + 1] + now[MASS + 1] * a_hip + now[MASS + 2] * a_knee
        torque = max(torque, abs(hip) + added[0] + promise * added[4], abs(knee) + added[1] + promise * added[5])
        v_hip, v_knee = abs(v_hip + now[SPEED]), abs(v_knee + now[SPEED + 1])
        speed = max(speed, v_hip + added[2] + promise * added[6], v_knee + added[3] + promise * added[7])
        v_hip, v_knee = v_hip + added[8] + promise * added[10], v_knee + added[9] + promise * added[11]
        if max(v_hip + hip_most, v_knee + knee_most) > max(worst, known):
            hip_slack = knee_slack = 0.0
            for column in range(STATES):
                hip_slack += few.slack[column, 0] * size[column]
                knee_slack += few.slack[column, 1] * size[column]
            worst = max(worst, v_hip + hip_slack, v_knee + knee_slack)
    largest = max(torque / guard.torque_limit, speed / guard.speed_limit, worst / guard.worst_speed_limit)
    return 1.0 - STEEPNESS * (1.0 - largest)


def gate(h: float, xi: float) -> float:
    """Return lambda, the weight of the backup torque for a constant h: (1 + (Xi^10 - 1) h)^3, limited to [0, 1].

    Lambda is the symbol in the paper. While h falls, `damped_gate` increases the weight. If h < 0, the backup policy may not be
    able to keep the joints inside the guide. Then the weight is 1.

    Args:
        h: safety value, at most 1 (in the paper: function of the safe backward image).
        xi: assistance factor in [0, 1].
    """
    if h <= 0.0:
        return 1.0
    base = 1.0 + (xi**10 - 1.0) * h
    return base * base * base if base > 0.0 else 0.0


def damped_gate(gate: float, rate: float, zeta: float) -> float:
    """Return the weight of the backup torque: lambda + (1 - lambda) lambda_d, with lambda_d = zeta max(0, -dh/dt) clamped to 1.

    Args:
        gate: lambda, in [0, 1]; the result is then in [0, 1] too.
        rate: dh/dt [1/s].
        zeta: derivative gain [s].
    """
    damping = -zeta * rate
    if damping <= 0.0:
        return gate
    return gate + (1.0 - gate) * damping if damping < 1.0 else 1.0
