"""Check that the motion of each joint agrees with the torque that the HAL sends: `LegModel, motion -> findings`.

A drive with a faulty current sensor or motor may report the commanded torque although its motor produces a reversed torque, no
torque, or a torque that is too low or too high. The reported torque then agrees with the command (`torque_tracking`), but the
motion does not. From the motion, the module `leg_torques` computes the torque that each motor produced.

*External torque.* A push on a joint, or a muscle of the patient, moves the joint like a wrong motor torque. But an external
torque does not depend on the command. While the produced torque e deviates from the sent torque t, the check compares two
explanations:

    external torque:  e = t + p with a constant p
    faulty motor:     e = s t   with a share s in `SHARES`

Each explanation is fitted to the torques of the last checks. E is the mean square error of the first fit, F of the second fit.
A motor is suspected if E > `RATIO` * (F + error^2), where error is the error of the produced torque, `Robot.torque_error`. A
drive is reported after `CONFIRM` such checks in a row.

The comparison needs a torque that changes. After a fault, the controller changes the torque of the joint within a few cycles.
An external torque that opposes each change of the torque, such as an obstacle that stops the joint, looks like a dead motor.

*Changes.* Sent and computed torques are averages over `leg_torques.SPAN` cycles. At the start of a deviation, these averages also
contain cycles before the deviation, so the first torques are left out. The torques are also left out while a deviation decreases,
because an external torque may then be ending.

*Isolation.* A wrong motor torque changes only the computed torque of its own joint, because the motion of all joints is
measured. A wrong encoder, IMU or force cell, or a load on the leg that the force cells do not measure, changes several computed
torques. So a deviation counts only while the other joints of the leg agree with their torques.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.leg_model import LegModel
from atalante_hal.robot import AT_STOP, JOINTS, LEG_JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.leg_torques import History, Sample, Torques, compute, make_history, make_torques, store
from atalante_hal.types import State, Vector

#: Interval between two checks of a leg [cycles]. The legs are checked alternately.
INTERVAL: Final = 4
#: A faulty motor produces s times the sent torque. The share s is in one of these two ranges.
#: The first range of s covers reversed (s < 0), dead (s = 0) and weak motors.
#: The second range of s covers motors that are too strong.
SHARES: Final = ((-1.5, 0.6), (1.4, 2.2))
#: A motor is suspected if E > `RATIO` * (F + error^2). error is `Robot.torque_error`. E and F are mean square errors.
#: E belongs to the explanation "external torque", F to the explanation "faulty motor" (see the module docstring).
RATIO: Final = 2.5
#: Number of consecutive checks that must suspect the motor before the drive is reported.
CONFIRM: Final = 2
#: A joint deviates if |produced torque - sent torque| > `BAND` * torque_error + `_BAND_SHARE` * |sent torque|.
#: `Robot.torque_error` is the rms error with which the produced torque of a joint is known [Nm].
BAND: Final = 2.0
_BAND_SHARE: Final = 0.2
#: The deviation of a joint is discarded while another joint of the same leg deviates, too.
#: The limit for that other joint is wider: it is computed with `OTHER_BAND` and `_OTHER_SHARE`.
#: Reason: if a sensor is wrong or a load on the leg is not measured, several joints deviate although their motors are intact.
OTHER_BAND: Final = 4.5
_OTHER_SHARE: Final = 0.25
#: Decay factors of the two sets of `Deviations.sums`. Each check multiplies a set by its factor, and then adds the new torques.
#: The set with 0.8 covers about the last 5 checks (20 cycles), the set with 0.96 about the last 25 checks (100 cycles).
DECAY: Final = (0.8, 0.96)
#: Number of checks that are left out of `Deviations.sums` at the start of a deviation.
#: In these first checks, the torques are averages that also contain cycles before the deviation.
LEFT_OUT: Final = 2
#: Longest gap in a deviation [checks]. If more consecutive checks find no deviation, the deviation ends.
PAUSE: Final = 5
#: Smallest deviation that is added to `Deviations.sums`, as a fraction of the recent maximum `Deviations.peak`.
#: Reason: while a push on the joint ends, the deviation decreases.
_PEAK_SHARE: Final = 0.8
#: Factor by which each check with a deviation reduces `Deviations.peak`, so that an old maximum is forgotten.
_PEAK_DECAY: Final = 0.97
#: Smallest sum of the weights of all checks with which a motor can be suspected.
#: The sum is `Deviations.sums[window, joint, 0]`: the last check has the weight 1, and older checks have smaller weights.
#: Three checks are enough: the sum of their weights is at least 1 + 0.8 + 0.8^2 = 2.44.
#: Two checks are not enough: the sum of their weights is at most 1 + 0.96 = 1.96.
_LEAST_WEIGHT: Final = 2.4
_LEG: Final = len(LEG_JOINTS)


class Tolerances(NamedTuple):
    """Properties of the joints that the check uses. Each field has the shape (12,)."""

    error: Vector  # Nm, rms error of the torque that is computed from the motion
    low: Vector  # rad, position below which a joint is at its lower end stop
    high: Vector  # rad, position above which a joint is at its upper end stop


class Deviations(NamedTuple):
    """Record of the deviations of produced torques from sent torques, for each joint."""

    #: Sums of 1, t, e, t*t, t*e and e*e over the added checks of the deviation, with the sent torque t and the produced torque e.
    #: Shape (2, 12, 6), for each factor of `DECAY` and each joint. Older checks count less, see `DECAY`.
    sums: Vector
    length: npt.NDArray[np.int64]  # (12,) number of checks with a deviation since the deviation began
    pause: npt.NDArray[np.int64]  # (12,) number of checks since the last check with a deviation
    peak: Vector  # (12,) Nm, decaying maximum of |produced torque - sent torque| in the current deviation
    found: npt.NDArray[np.int64]  # (12,) number of consecutive checks that suspected the motor
    share: Vector  # (12,) share s = produced torque / sent torque, from the last check that suspected the motor


class Memory(NamedTuple):
    """Values that the check keeps from cycle to cycle."""

    history: History
    torques: Torques
    deviations: Deviations


def _check(late: int, sample: Sample, model: LegModel, tolerances: Tolerances, memory: Memory) -> bool:
    """Store the values of one cycle, check the leg whose turn it is, and return whether a drive is faulty.

    Args:
        late: further delay of the torques [cycles], see `leg_torques.compute`.
        sample: values of the cycle.
        model: links and friction of the legs.
        tolerances: properties of the joints.
        memory: memory of the check. Updated here.
    """
    store(sample, memory.history)
    turn = memory.history.cycles[0] % INTERVAL
    leg = 2 * turn // INTERVAL
    if 2 * turn % INTERVAL or not compute(leg, model, late, memory.history, memory.torques):
        return False
    faulty = False
    deviating = 0
    for i in range(_LEG):
        deviating += _deviates(leg, i, sample.position, tolerances, memory.torques, OTHER_BAND, _OTHER_SHARE)
    for i in range(_LEG):
        others = deviating - _deviates(leg, i, sample.position, tolerances, memory.torques, OTHER_BAND, _OTHER_SHARE)
        joint = leg * _LEG + i
        if others:
            _forget(joint, memory.deviations)
        elif not _deviates(leg, i, sample.position, tolerances, memory.torques, BAND, _BAND_SHARE):
            memory.deviations.pause[joint] += 1
            if memory.deviations.pause[joint] > PAUSE:
                _forget(joint, memory.deviations)
        else:
            faulty |= _compare(joint, memory.torques.sent[i], memory.torques.produced[i], tolerances, memory.deviations)
    return faulty


def _deviates(
    leg: int, i: int, position: Vector, tolerances: Tolerances, torques: Torques, band: float, share: float
) -> bool:
    """Return whether the produced torque of a joint deviates from its sent torque.

    An end stop holds a joint against the torque of its motor. So at the lower end stop a produced torque above the sent torque
    is no deviation, and at the upper end stop a produced torque below the sent torque is no deviation.

    Args:
        leg: index in `SIDES`.
        i: index in `LEG_JOINTS`.
        position: joint positions, shape (12,) [rad].
        tolerances: properties of the joints.
        torques: torques of the leg.
        band: least deviation relative to the error of the produced torque.
        share: share of the sent torque that is added to the least deviation.
    """
    joint = leg * _LEG + i
    deviation = torques.produced[i] - torques.sent[i]
    if abs(deviation) <= band * tolerances.error[joint] + share * abs(torques.sent[i]):
        return False
    stopped = (position[joint] < tolerances.low[joint] and deviation > 0.0) or (
        position[joint] > tolerances.high[joint] and deviation < 0.0
    )
    return not stopped


def _forget(joint: int, deviations: Deviations) -> None:
    """Clear the stored deviation of a joint.

    Args:
        joint: index in `JOINTS`.
        deviations: state of the check. Updated here.
    """
    deviations.sums[:, joint] = 0.0
    deviations.length[joint] = deviations.pause[joint] = deviations.found[joint] = 0
    deviations.peak[joint] = 0.0


def _compare(joint: int, sent: float, produced: float, tolerances: Tolerances, deviations: Deviations) -> bool:
    """Explain why the produced torque of a joint deviates from the sent torque. Return whether the motor is faulty.

    The torques of the check are added to the sums of the joint. From these sums, the two explanations of the module docstring
    are fitted: external torque and faulty motor. At the start of a deviation, and while a deviation decreases, the check is left
    out.

    Args:
        joint: index in `JOINTS`.
        sent: sent torque t [Nm].
        produced: produced torque e [Nm].
        tolerances: properties of the joints.
        deviations: state of the check. Updated here.

    Returns:
        True if the last `CONFIRM` added checks suspect the motor. False if this check is left out.
    """
    size = abs(produced - sent)
    deviations.length[joint] += 1
    deviations.pause[joint] = 0
    deviations.peak[joint] = max(size, _PEAK_DECAY * deviations.peak[joint])
    if deviations.length[joint] <= LEFT_OUT or size < _PEAK_SHARE * deviations.peak[joint]:
        return False
    faulty = False
    for window in range(len(DECAY)):
        sums, keep = deviations.sums[window, joint], DECAY[window]
        for k, value in enumerate((1.0, sent, produced, sent * sent, sent * produced, produced * produced)):
            sums[k] = keep * sums[k] + value
        count, t, e, tt, et, ee = sums
        if count < _LEAST_WEIGHT:
            continue
        external = ee - 2.0 * et + tt - (e - t) ** 2 / count
        share, best = et / max(tt, 1e-9), math.inf
        for low, high in SHARES:
            s = min(max(share, low), high)
            best = min(best, ee - 2.0 * s * et + s * s * tt)
        if external > RATIO * (best + count * tolerances.error[joint] ** 2):
            faulty = True
            deviations.share[joint] = share
    deviations.found[joint] = deviations.found[joint] + 1 if faulty else 0
    return bool(deviations.found[joint] >= CONFIRM)


class TorqueMotion:
    """Check that the motion of each joint agrees with the torque that the HAL sends.

    The check runs only while the controller drives the joints.

    Args:
        robot: position limits and errors of the produced torques.
        model: links and friction of the legs.
        state: state of the HAL, whose arrays are the same in every cycle.
        sent: torques sent in the last cycle, shape (12,) [Nm]. The array is the same in every cycle.
        rows: row of each joint in the process image, shape (12,).
    """

    def __init__(self, robot: Robot, model: LegModel, state: State, sent: Vector, rows: npt.NDArray[np.int64]) -> None:
        joints = len(JOINTS)
        self._memory = Memory(
            make_history(),
            make_torques(),
            Deviations(
                np.zeros((len(DECAY), joints, 6)), np.zeros(joints, np.int64), np.zeros(joints, np.int64),
                np.zeros(joints), np.zeros(joints, np.int64), np.zeros(joints),
            ),
        )  # fmt: skip
        sample = Sample(sent, state.position, state.imu_accel, state.imu_gyro, state.foot_force, state.age, rows)
        limits = Tolerances(robot.torque_error, robot.position_min + AT_STOP, robot.position_max - AT_STOP)
        self._arguments = sample, model, limits, self._memory
        # The arrays of the state are read-only. For numba, read-only and writable arrays have different types.
        # `_check` is compiled for writable arrays. The compiled code also accepts read-only arrays, see `specialised`.
        writable = Sample._make(np.zeros_like(values) for values in sample)
        self._check = specialised(_check, 0, writable, *self._arguments[1:])
        self.restart()

    def restart(self) -> None:
        """Clear all stored torques and motions. Call this when the controller stops driving the joints."""
        for record in (self._memory.history, self._memory.deviations):
            for values in record:
                values[:] = 0

    def check(self, late: int = 0) -> tuple[Finding, ...]:
        """Check the motion of this cycle, and return one finding for each drive with a faulty motor.

        Args:
            late: number of cycles by which a torque moves the joints later than usual, because states, commands or motors are
                late, 0 to `leg_torques.MORE`.
        """
        if not self._check(late, *self._arguments):
            return ()
        found, shares = self._memory.deviations.found.tolist(), self._memory.deviations.share.tolist()
        return tuple(
            Finding(
                Dtc.TORQUE_MOTION, node, share, True,
                f"the motion of {joint} must agree with the torque that was sent, "
                f"got a motion as with {share:.2f} times this torque",
            )
            for joint, node, checks, share in zip(JOINTS, JOINT_NODES, found, shares, strict=True)
            if checks >= CONFIRM
        )  # fmt: skip
