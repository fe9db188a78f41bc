"""Inertial checks of the IMUs: accelerometers against gravity, gyroscopes against attitudes, torso IMU against pelvis IMU.

All IMUs are sampled about every 16 cycles, alternately in an even and an odd cycle, so a vibration of half the sampling rate of
the IMUs has no effect. Each check compares a mean over about `SAMPLES` samples with a limit, so a single impact or a short fall
has no effect. The checks run in every state of the robot, and need no standstill.

*Accelerometer.* The mean acceleration of a body over a second is small, because its speed is limited. So the mean specific force
in world axes is gravity, upwards. The difference of each sample is limited to `_FORCE_CLIP`, because impacts are short and large.
Samples of an IMU that turns fast are omitted, because a leg without torque falls. The check detects a wrong sign, exchanged axes,
a gain that is wrong by a third, and an attitude that is tilted by more than 18 degrees.

*Gyroscope.* The change of the attitude between two samples is an angular velocity, about each axis of the sensor. The gyroscope
must report the same. The mean square of the difference may be at most `_RATE_ERROR` squared plus a share of the mean square of
the angular velocity. The check detects a wrong sign and exchanged axes as soon as the IMU turns by more than 0.06 rad/s rms.

*Constant reading.* A healthy sensor has noise, and its reading changes when the IMU turns. If one axis of a gyroscope or an
accelerometer has exactly the same reading in `_CONSTANT` + 1 samples, the attitude must not turn by more than `_TURN` beyond this
reading: for a gyroscope the turn about the axis minus the integral of the reading, for an accelerometer the change of the
direction of gravity along the axis. An IMU whose attitude does not change is never reported. The missed turn does not decay. So
the check needs noise of at least one code (rms): then a healthy reading is constant for at most 0.3 s.

*Torso and pelvis.* Both IMUs are on one rigid body with equal axes. So their angular velocities and their vertical directions are
equal. Their headings are not compared, because they drift. If one of the two IMUs fails a check of its own, the comparison is
omitted.

A sample is skipped if its values are too old, if it is saturated, or if its quaternion has a wrong norm. A reading before a
skipped sample is not compared with a reading after it. If the values of an IMU are too old, its means are set to 0, because
another check reports this fault.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import IMU_NODES
from atalante_hal.robot import IMUS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.imus import ImuLimits, usable_one
from atalante_hal.safety.plausibility.signals import Ages, Cycles, Signals
from atalante_hal.types import GRAVITY, Vector
from atalante_hal.wire.process_image import NEVER

#: Number of samples in each running mean. With fewer samples since the start, the mean is over all of them.
SAMPLES = 64
#: For each IMU: number of samples after which its means are first compared with their limits.
#: Torso and pelvis need only 4 samples, so their faults are found before READY.
#: The tibiae need more samples, because they accelerate before READY: the drives are off, and bent legs sink.
FIRST_SAMPLES = (4, 4, 16, 16)
#: Limit of the mean difference between specific force and gravity [m/s2]. A healthy robot reaches 2.2 m/s2 in walks and falls.
_FORCE_ERROR = 3.0
#: Each sample of the difference between specific force and gravity is clipped to this magnitude [m/s2].
_FORCE_CLIP = 5.0
#: Angular velocity of an IMU above which its specific force is not compared with gravity [rad/s].
#: Fast motions cause large accelerations, for example when the drives are switched off and the legs fall to their end stops.
_MOVING_RATE = 0.5
#: Largest rms difference between gyroscope and rate of change of the attitude while the IMU is at rest [rad/s].
#: `_RATE_ERROR` also limits the rms difference between the gyroscopes of torso and pelvis.
_RATE_ERROR = 0.1
#: Limit of the rms difference while an IMU turns: sqrt(_RATE_ERROR^2 + _RATE_SHARE * mean square of the angular velocity).
_RATE_SHARE = 0.25
#: Number of consecutive samples that must repeat a reading exactly before the reading is regarded as constant.
_CONSTANT = 4
#: Largest permitted missed turn, see `Record.missed` [rad].
_TURN = 0.01
_TORSO, _PELVIS = IMUS.index("torso"), IMUS.index("pelvis")


class Readings(NamedTuple):
    """Readings of all IMUs in one sample."""

    quaternion: Vector  # (4, 4) wxyz, sensor to world
    gyro: Vector  # (4, 3) rad/s
    accel: Vector  # (4, 3) m/s2


class Record(NamedTuple):
    """Last sample of each IMU, and running means of the errors that the checks compare with limits."""

    quaternion: Vector  # (4, 4) attitude in the last sample
    gyro: Vector  # (4, 3) angular velocity in the last sample [rad/s]
    age: Cycles  # (4,) age of the last sample [cycles]; `NEVER` if it must not be used
    #: Number of samples in each mean, at most `SAMPLES`, shape (9,).
    #: Elements 0 to 3: gyroscope checks of the IMUs; 4: check of torso against pelvis; 5 to 8: accelerometer checks of the IMUs.
    samples: Vector
    force: Vector  # (4, 3) mean difference between specific force and gravity, in world axes [m/s2]
    #: Mean square difference between two angular velocities that must be equal, shape (5, 3) [rad2/s2]. Columns: the three axes.
    #: Rows 0 to 3, one for each IMU: its gyroscope minus the rate of change of its attitude.
    #: Row 4: gyroscope of the torso minus gyroscope of the pelvis.
    rate_error: Vector
    rate: Vector  # (5, 3) mean square of the angular velocity [rad2/s2]; rows and columns as in `rate_error`
    #: Mean difference, shape (3,): upward unit vector in torso axes minus upward unit vector in pelvis axes.
    tilt: Vector
    accel: Vector  # (4, 3) specific force in the last sample [m/s2]
    #: Number of samples that repeated the reading of each axis, shape (4, 6): gyroscope, then accelerometer.
    repeats: Vector
    #: Missed turn of each axis, shape (4, 6) [rad]: rotation of the IMU during which the reading of the axis should have changed.
    #: A missed turn beyond its limit is kept until the reading changes or the values are too old.
    missed: Vector


class Excess(NamedTuple):
    """Values that exceed their limits. A value within its limit is replaced by 0."""

    force: Vector  # (4,) magnitude of the mean difference between specific force and gravity [m/s2]
    rate: Vector  # (5,) largest rms difference in each row of `Record.rate_error` [rad/s]
    tilt: Vector  # (1,) angle between the upward directions of torso and pelvis [rad]
    missed: Vector  # (4,) rad, largest missed turn among the axes of each IMU, see `Record.missed`


class Inertial:
    """Inertial checks of all IMUs, see the module docstring.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        limits: limits of the readings of an IMU.
        intervals: times between successive calls of `evaluate` [cycles]. The sequence of times repeats.
        period: cycle time [s].
    """

    def __init__(
        self, robot: Robot, now: Signals, limits: ImuLimits, intervals: tuple[int, ...], period: float
    ) -> None:
        imus = len(IMUS)
        self._new = np.zeros(imus, np.int64)
        self._excess = Excess(np.zeros(imus), np.zeros(imus + 1), np.zeros(1), np.zeros(imus))
        record = Record(
            np.zeros((imus, 4)), np.zeros((imus, 3)), np.full(imus, NEVER), np.zeros(2 * imus + 1), np.zeros((imus, 3)),
            np.zeros((imus + 1, 3)), np.zeros((imus + 1, 3)), np.zeros(3),
            np.zeros((imus, 3)), np.zeros((imus, 6)), np.zeros((imus, 6)),
        )  # fmt: skip
        self._intervals = itertools.cycle(intervals)
        self._interval = 0  # time since the last call of `evaluate` [cycles]
        #: Third and later arguments of the function `follow`. The array objects are the same in every call.
        self._readings = (
            Readings(now.quaternion, now.gyro, now.accel), record, self._excess, limits,
            period, 2.0 * robot.sensors.attitude_error,
        )  # fmt: skip
        never = np.full(imus, NEVER)
        self._follow = specialised(follow, never, self._interval, *self._readings)
        self._found: tuple[Finding, ...] = ()
        #: Indices in IMUS of the IMUs that contradict gravity or their own attitude.
        #: If torso IMU and pelvis IMU contradict only each other, the faulty one is unknown, so neither is in the set.
        self.implausible: frozenset[int] = frozenset()

    def evaluate(self, ages: Ages | None) -> bool:
        """Sample the IMUs and check them.

        Args:
            ages: ages of the sensor values; an IMU with values that are too old is not sampled. None if all values are of this
                cycle.

        Returns:
            Whether an IMU is implausible.
        """
        implausible = self._follow(self._new if ages is None else ages.imu, self._interval, *self._readings)
        self._interval = next(self._intervals)
        self.implausible = _wrong(self._excess) if implausible else frozenset()
        self._found = _findings(self._excess, self.implausible) if implausible else ()
        return bool(self._found)

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the inertial checks."""
        return self._found


def follow(
    age: Cycles,
    interval: int,
    now: Readings,
    record: Record,
    excess: Excess,
    limits: ImuLimits,
    period: float,
    tilt_error: float,
) -> bool:
    """Add a sample of each IMU to the means, and compare the means with their limits.

    Args:
        age: age of the values of each IMU, shape (4,) [cycles]. An IMU with an age of at least `NEVER` is skipped.
        interval: time since the last call [cycles].
        now: readings of the sample.
        record: last sample and means. Updated here.
        excess: output for the values that exceed their limits.
        limits: limits of the readings of an IMU.
        period: cycle time [s].
        tilt_error: largest angle between the upward directions of torso and pelvis [rad].

    Returns:
        Whether a value exceeds its limit.
    """
    comparable = True
    for imu in range(len(age)):
        used = age[imu] < NEVER and usable_one(now.quaternion[imu], now.gyro[imu], now.accel[imu], limits)
        if used and record.age[imu] < NEVER:
            add(imu, now, record, period * (interval + record.age[imu] - age[imu]))
        elif imu in (_TORSO, _PELVIS):
            comparable = False
        if not used:
            # A skipped sample resets repeats and missed turns.
            # Exception: a `missed_turn` beyond its limit is kept until the values are too old.
            for axis in range(6):
                if age[imu] >= NEVER or missed_turn(record, imu, axis) == 0.0:
                    record.repeats[imu, axis] = record.missed[imu, axis] = 0.0
        if age[imu] >= NEVER:  # the values are too old: another check reports this IMU
            record.force[imu] = 0.0
            record.rate_error[imu] = 0.0
            if imu in (_TORSO, _PELVIS):
                record.tilt[:] = 0.0
                record.rate_error[len(age)] = 0.0
        record.age[imu] = age[imu] if used else NEVER
        # Copy each element: for a copy of the whole row, numba would create an array, because source and target could overlap.
        for axis in range(4):
            record.quaternion[imu, axis] = now.quaternion[imu, axis]
        for axis in range(3):
            record.gyro[imu, axis] = now.gyro[imu, axis]
            record.accel[imu, axis] = now.accel[imu, axis]
    if comparable:
        compare(now, record)
    return exceeds(record, excess, tilt_error)


def add(imu: int, now: Readings, record: Record, time: float) -> None:
    """Add a sample of one IMU to its means.

    Args:
        imu: index of the IMU in IMUS.
        now: readings of the sample.
        record: last sample and means. Updated here.
        time: time since the last sample [s].
    """
    share = count(record, imu)
    turn = turn_rate(record.quaternion[imu], now.quaternion[imu], time)
    for axis in range(3):
        mean = 0.5 * (record.gyro[imu, axis] + now.gyro[imu, axis])
        add_rates(record, imu, axis, share, (turn[axis], mean))
    add_missed(imu, now, record, turn, time)
    if turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2 > _MOVING_RATE**2:
        return
    share = count(record, len(record.rate) + imu)
    x, y, z = to_world(now.quaternion[imu], now.accel[imu])
    z -= GRAVITY
    scale = share * _FORCE_CLIP / max(_FORCE_CLIP, math.sqrt(x * x + y * y + z * z))
    record.force[imu, 0] += scale * x - share * record.force[imu, 0]
    record.force[imu, 1] += scale * y - share * record.force[imu, 1]
    record.force[imu, 2] += scale * z - share * record.force[imu, 2]


def add_missed(imu: int, now: Readings, record: Record, turn: tuple[float, float, float], time: float) -> None:
    """Add to the missed turns of one IMU the rotation that its constant readings did not measure since the last sample.

    Args:
        imu: index of the IMU in IMUS.
        now: readings of the sample.
        record: last sample, repeats and missed turns. Updated here.
        turn: angular velocity since the last sample, from the attitudes [rad/s].
        time: time since the last sample [s].
    """
    # If the attitude has not changed, the IMU is at rest, or all its values are constant.
    # Another check reports an IMU whose values are all constant (F32).
    turned = time if turn[0] != 0.0 or turn[1] != 0.0 or turn[2] != 0.0 else 0.0
    before, up = upward(record.quaternion[imu]), upward(now.quaternion[imu])
    for axis in range(3):
        gyro, accel = now.gyro[imu, axis], now.accel[imu, axis]
        add_repeat(record, imu, axis, gyro == record.gyro[imu, axis], (turn[axis] - gyro) * turned)
        add_repeat(record, imu, 3 + axis, accel == record.accel[imu, axis], up[axis] - before[axis])


def add_repeat(record: Record, imu: int, axis: int, same: bool, missed: float) -> None:
    """Count a repeated reading, and increase the missed turn by the rotation that the reading does not contain.

    If the reading has changed, set the number of repeats and the missed turn to 0.

    Args:
        record: repeats and missed turns. Updated here.
        imu: index of the IMU in IMUS.
        axis: column of `Record.repeats`.
        same: whether the reading equals the one of the last sample.
        missed: turn of the attitude since the last sample that the reading does not contain [rad].
    """
    if not same:
        record.repeats[imu, axis] = record.missed[imu, axis] = 0.0
    elif missed_turn(record, imu, axis) == 0.0:
        record.repeats[imu, axis] += 1.0
        record.missed[imu, axis] += missed


def missed_turn(record: Record, imu: int, axis: int) -> float:
    """Return the missed turn of one axis [rad]; 0 if the missed turn is within its limit or the reading is not constant.

    Args:
        record: repeats and missed turns.
        imu: index of the IMU in IMUS.
        axis: column of `Record.repeats`.
    """
    return beyond(abs(record.missed[imu, axis]), _TURN) if record.repeats[imu, axis] >= _CONSTANT else 0.0


def compare(now: Readings, record: Record) -> None:
    """Add a sample to the means that compare torso and pelvis: vertical direction and angular velocity.

    Args:
        now: readings of the sample.
        record: means. Updated here.
    """
    pair = len(IMUS)
    share = count(record, pair)
    torso, pelvis = upward(now.quaternion[_TORSO]), upward(now.quaternion[_PELVIS])
    for axis in range(3):
        record.tilt[axis] += share * (torso[axis] - pelvis[axis] - record.tilt[axis])
        add_rates(record, pair, axis, share, (now.gyro[_PELVIS, axis], now.gyro[_TORSO, axis]))


def count(record: Record, row: int) -> float:
    """Count one more sample, and return the weight of this sample in a running mean.

    The weight is 1 / number of samples. The number of samples is limited to `SAMPLES`.

    Args:
        record: means and numbers of samples. Updated here.
        row: index of the number of samples in `Record.samples`.
    """
    record.samples[row] = min(record.samples[row] + 1.0, SAMPLES)
    return float(1.0 / record.samples[row])


def add_rates(record: Record, row: int, axis: int, share: float, rates: tuple[float, float]) -> None:
    """Update the running means `Record.rate_error` and `Record.rate` with two measurements of one angular velocity.

    Args:
        record: means. Updated here.
        row: row of both means.
        axis: axis of the angular velocity, 0 to 2.
        share: weight of the new sample, see `count`.
        rates: the two measurements [rad/s]. `Record.rate` is the mean square of the first measurement.
    """
    first, second = rates
    record.rate_error[row, axis] += share * ((first - second) ** 2 - record.rate_error[row, axis])
    record.rate[row, axis] += share * (first**2 - record.rate[row, axis])


def exceeds(record: Record, excess: Excess, tilt_error: float) -> bool:
    """Write the values that exceed their limits to `excess`, and return whether there is one.

    Args:
        record: means.
        excess: output for the values that exceed their limits.
        tilt_error: largest angle between the upward directions of torso and pelvis [rad].
    """
    pair, found = len(record.force), False
    for imu in range(pair):
        x, y, z = record.force[imu, 0], record.force[imu, 1], record.force[imu, 2]
        excess.force[imu] = 0.0
        if record.samples[pair + 1 + imu] >= FIRST_SAMPLES[imu]:
            excess.force[imu] = beyond(math.sqrt(x * x + y * y + z * z), _FORCE_ERROR)
        excess.rate[imu] = wrong_rate(record, imu) if record.samples[imu] >= FIRST_SAMPLES[imu] else 0.0
        excess.missed[imu] = 0.0
        for axis in range(6):
            excess.missed[imu] = max(excess.missed[imu], missed_turn(record, imu, axis))
        found = found or excess.force[imu] > 0.0 or excess.rate[imu] > 0.0 or excess.missed[imu] > 0.0
    x, y, z = record.tilt[0], record.tilt[1], record.tilt[2]
    enough = record.samples[pair] >= FIRST_SAMPLES[_TORSO]
    excess.tilt[0] = beyond(math.sqrt(x * x + y * y + z * z), tilt_error) if enough else 0.0
    excess.rate[pair] = wrong_rate(record, pair) if enough else 0.0
    return bool(found or excess.tilt[0] > 0.0 or excess.rate[pair] > 0.0)


def beyond(value: float, limit: float) -> float:
    """Return a value if it is above its limit, otherwise 0."""
    return value if value > limit else 0.0


def wrong_rate(record: Record, row: int) -> float:
    """Return the largest rms difference in one row of `Record.rate_error` [rad/s].

    Only axes above their limit count. The result is 0 if no axis is above its limit.

    Args:
        record: means.
        row: row of `Record.rate_error`.
    """
    largest = 0.0
    for axis in range(3):
        error = record.rate_error[row, axis]
        limit = _RATE_ERROR**2 + _RATE_SHARE * record.rate[row, axis]
        largest = max(largest, beyond(error, limit))
    return math.sqrt(largest)


def upward(quaternion: Vector) -> tuple[float, float, float]:
    """Return the upward direction of the world in the sensor frame, as a unit vector.

    Args:
        quaternion: attitude wxyz of unit norm, sensor to world, shape (4,).
    """
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


def to_world(quaternion: Vector | Sequence[float], vector: Vector | Sequence[float]) -> tuple[float, float, float]:
    """Return a vector of the sensor frame in world axes.

    Args:
        quaternion: attitude wxyz of unit norm, sensor to world, shape (4,).
        vector: vector in the sensor frame, shape (3,).
    """
    w, i, j, k = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    x, y, z = vector[0], vector[1], vector[2]
    p, q, r = 2.0 * (j * z - k * y), 2.0 * (k * x - i * z), 2.0 * (i * y - j * x)
    return x + w * p + j * r - k * q, y + w * q + k * p - i * r, z + w * r + i * q - j * p


def turned_about_vertical(
    quaternion: Vector | Sequence[float], half: Vector | Sequence[float]
) -> tuple[float, float, float, float]:
    """Return an attitude that is turned about the vertical axis of the world, as quaternion wxyz.

    Args:
        quaternion: attitude wxyz, sensor to world, shape (4,).
        half: cosine and sine of half the angle of the turn, shape (2,).
    """
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    c, s = half[0], half[1]
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w


def turn_rate(first: Vector, last: Vector, time: float) -> tuple[float, float, float]:
    """Return the mean angular velocity between two attitudes, in the sensor frame [rad/s].

    For a turn by the angle t, the magnitude is 2 sin(t / 2) / time, which is exact only for small angles.

    Args:
        first: first attitude, quaternion wxyz, sensor to world, shape (4,).
        last: last attitude, in the same form.
        time: time between the attitudes [s].
    """
    a, b, c, d = first[0], first[1], first[2], first[3]
    e, f, g, h = last[0], last[1], last[2], last[3]
    # (x, y, z) is the vector part of the quaternion conj(first) * last, which is the turn between the attitudes.
    # `factor` has the sign of the scalar part, because a quaternion and its negative are the same attitude.
    factor = math.copysign(2.0 / time, a * e + b * f + c * g + d * h)
    x = a * f - b * e - c * h + d * g
    y = a * g + b * h - c * e - d * f
    z = a * h - b * g + c * f - d * e
    return factor * x, factor * y, factor * z


def _findings(excess: Excess, wrong: frozenset[int]) -> tuple[Finding, ...]:
    """Return the findings about the values that exceed their limits.

    Args:
        excess: values that exceed their limits.
        wrong: result of `_wrong`.
    """
    found = []
    values = zip(excess.force.tolist(), excess.rate.tolist(), excess.missed.tolist(), strict=False)
    for imu, (force, rate, missed) in enumerate(values):
        if force:
            text = f"the accelerometer of the {IMUS[imu]} IMU contradicts gravity in the reported attitude by {force:.1f} m/s2"
            found.append(_finding(imu, force, text))
        elif rate:
            text = f"the gyroscope of the {IMUS[imu]} IMU contradicts the change of its attitude by {rate:.2f} rad/s"
            found.append(_finding(imu, rate, text))
        elif missed:
            turn = f"{math.degrees(missed):.1f} degrees"
            text = f"one axis of the {IMUS[imu]} IMU has a constant reading while its attitude turns by {turn}"
            found.append(_finding(imu, missed, text))
    if not wrong.isdisjoint((_TORSO, _PELVIS)):
        return tuple(found)
    tilt, rate = float(excess.tilt[0]), float(excess.rate[-1])
    contradict = "torso IMU and pelvis IMU contradict each other"
    if tilt:
        found.append(_finding(_TORSO, tilt, f"{contradict} by {math.degrees(tilt):.1f} degrees of tilt"))
    elif rate:
        found.append(_finding(_TORSO, rate, f"{contradict} by {rate:.2f} rad/s"))
    return tuple(found)


def _wrong(excess: Excess) -> frozenset[int]:
    """Return the indices in IMUS of the IMUs that contradict gravity or their own attitude."""
    return frozenset(imu for imu in range(len(IMUS)) if excess.force[imu] or excess.rate[imu] or excess.missed[imu])


def _finding(imu: int, value: float, text: str) -> Finding:
    return Finding(Dtc.IMU_IMPLAUSIBLE, IMU_NODES[imu], value, True, text)
