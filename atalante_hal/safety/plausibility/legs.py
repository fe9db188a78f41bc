"""Leg checks, which compare the encoders of a leg with its IMUs to detect drifting, stuck and exchanged encoders.

Four joints of a leg lie between the pelvis IMU and the tibia IMU: frontal, transverse and sagittal hip and sagittal
knee (FH, TH, SH, SK). At zero angles their axes are x, z, y and y. So the attitude of the tibia relative to the pelvis
is Rx(FH) Rz(TH) Ry(SH + SK). The two IMUs give these three angles, and the four encoders must agree with them.

*Drift.* An encoder that drifts at the rate `d` [rad/s] is detected `DRIFT_SAMPLES` samples after the time
`attitude_error / d`. A drift of more than 0.035 rad/s is detected within 1000 cycles, and a slower drift takes longer.
Some drifts cannot be detected, and some drifting encoders cannot be distinguished. The foot has no IMU, so a drift of
SA or HA is detected only on the ground, by the module `soles`. Opposite drifts of SH and SK cancel, and are detected
only while the leg moves, by the module `knees`. A drift of SH cannot be distinguished from a drift of SK. A drift of an
IMU has the same effect as a drift of an encoder. The heading of an IMU without a fault also drifts without a limit. This
turns the attitude of the tibia relative to the pelvis about the vertical, so it affects all angles if the pelvis is tilted or
FH is not 0. All checks therefore turn the attitude of the tibia back by an estimate of the heading drift. The estimate follows
the error of TH by at most `_HEADING_DRIFT` per sample. If the encoder of TH drifts more slowly than this limit, the estimate
follows this drift. So such a drift of the encoder of TH is not detected. An IMU that restarts reports another heading. The
estimate is then measured again, so that the error of TH is the same as before the restart. So a drift of TH in the time without
the IMU is not detected. If the drive of TH restarts in the same time, its encoder counts as referenced, and its old error is
kept only if the heading is unchanged with it. A restart is known from the boot-up message, or from the decreased uptime in the
next status message. So after an IMU was silent, its legs are not compared for `SILENT_SAMPLES` samples, unless a restart is
known before. A leg waits again only after `DRIFT_SAMPLES` comparisons. So an IMU that is silent again and again does not switch
the checks off.

*Standstill.* While the reading of an encoder is constant and its joint is at rest, the difference between encoders and
IMUs about the axis of the joint is also constant. If the joint moves while its encoder is stuck, this difference changes by
the motion of the joint. The check uses this change, so that a stuck encoder is detected long before the difference reaches
`attitude_error`. The threshold also covers the effect of a misaligned IMU (`misalignment`) while the leg turns about
another axis. If the readings of SH and SK are both constant, both are reported. Unlike the module `stillness`, the
standstill check needs no torque, so it also covers a joint that other joints move.
The attitude of an intact IMU has an error that changes slowly. This changes both the difference and the angles from the IMUs,
as if the leg turned. So the check follows a slow change of the difference. It follows faster while the gyros agree with the
velocities of the encoders, because a joint that turns while its encoder is stuck is seen by the gyros. If such a joint turns at
less than 0.014 rad/s, it is reported as a drift when the difference exceeds `attitude_error`.

*Exchange.* If the encoders of a joint are exchanged between the legs, each encoder reports the angle of the other leg. So the
errors of both legs are opposite, and their size is the difference between the two readings. The joint is reported when
the errors agree with the difference within `_AGREEMENT`, and both errors exceed `attitude_error`, in `EXCHANGE_SAMPLES`
consecutive samples. The errors of intact sensors are at most `attitude_error`, so they never switch off a drive. Exchanged
tibia IMUs have the same effect, about all axes.

*Age.* Values from earlier cycles are extrapolated to this cycle with the velocity that the same message contains. The
thresholds are extended by `velocity_error` times the age of the values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, SIDES, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.inertial import to_world, turned_about_vertical
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.types import Vector
from atalante_hal.wire.process_image import NEVER

#: Number of consecutive samples after which an encoder drift is reported.
DRIFT_SAMPLES = 4
#: Number of samples in which a leg is not compared after one of its IMUs was silent.
#: During these samples, a status message of the IMU arrives (sent every 100 cycles). It shows whether the IMU has restarted.
SILENT_SAMPLES = 4
#: Number of consecutive samples after which a stuck encoder is reported.
STANDSTILL_SAMPLES = 2
#: Number of consecutive samples after which exchanged encoders are reported. Both legs are compared in every sample.
EXCHANGE_SAMPLES = 2
#: If the encoders of a joint are exchanged between the legs, the left error (encoder minus IMU) is d, and the right error is -d.
#: d is the left encoder reading minus the right encoder reading. Each error may deviate from d or -d by `_AGREEMENT` * |d|.
#: Example: with encoder readings of 5 degrees (left) and 2 degrees (right), an error may deviate by 0.35 * (5 - 2) degrees.
_AGREEMENT = 0.35
#: Largest change of the error (encoder minus IMU) per sample that the standstill check ignores [rad].
#: `_IMU_DRIFT` applies while the gyros contradict the encoders.
#: `_IMU_DRIFT` is over ten times the heading drift of intact IMUs between two samples.
_IMU_DRIFT = 2e-5
#: Largest ignored change per sample while the gyros agree with the encoders [rad]. Then it replaces `_IMU_DRIFT`.
#: Emulated IMUs have random attitude errors of 4 mrad rms (time constant 10 s), interpolated over 128 cycles.
#: These attitude errors change the error (encoder minus IMU) by 0.11 mrad rms in 16 cycles.
_IMU_WANDER = 2e-4
#: Largest difference of the velocities from encoders and gyros about an axis at which the two agree [rad/s].
#: `_GYRO_ERROR` is 3.6 times the rms noise of the difference of two gyros.
_GYRO_ERROR = 0.02
#: Largest change of the estimated heading drift per sample [rad]. The headings of intact IMUs drift slowly.
#: The heading drift of a leg is estimated every 32 cycles, so the estimate follows a drift of at most 3e-4 rad/s.
_HEADING_DRIFT = 1e-5
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)
#: Angles of a leg that are compared with the IMUs: angle of FH, angle of TH, sum of the angles of SH and SK.
_AXES = (("FH",), ("TH",), ("SH", "SK"))
#: Index of TH in `_AXES`. The encoder angle of TH minus its angle from the IMUs shows the heading drift of the IMUs.
_HEADING = _AXES.index(("TH",))
#: Index of the sum SH + SK in `_AXES`. An error of this sum in the first comparison shows that the IMUs are mounted askew.
_SAGITTAL = _AXES.index(("SH", "SK"))
#: For each of the first four joints of a leg: index of its axis in `_AXES`.
_AXIS_OF = (0, 1, 2, 2)
#: Index of TH in LEG_JOINTS.
_TH = LEG_JOINTS.index("TH")
_HIPS = tuple(JOINTS.index(f"{side}_FH") for side in SIDES)


class _Comparison(NamedTuple):
    """Comparison of the encoders and IMUs of a leg in one sample, corrected for the heading drift of the IMUs."""

    angles: tuple[float, float, float]  # leg angles from the IMUs: FH, TH and the sum SH + SK [rad]
    errors: tuple[float, float, float]  # encoder angles minus IMU angles [rad]
    encoders: tuple[float, float, float, float]  # encoder angles of FH, TH, SH and SK [rad]
    uncertainty: float  # largest error [rad] that arises if encoder and IMU values are from different cycles
    upright: float  # cosine of the angle between the axis of TH and the vertical


class Legs:
    """Checks of both legs.

    Attributes:
        encoder_error: encoder angle of each joint minus its angle from the IMUs in the last sample of its leg, shape (12,) [rad].
            It is corrected for the heading drift. SH and SK both have the error of their sum. The error is infinite
            if a value is too old, while the leg waits after one of its IMUs was silent, and always for SA and HA.
        heading: cosine and sine of half the angle by which the attitude of each tibia IMU must be turned about the vertical to
            correct its heading drift relative to the pelvis IMU, shape (2, 2).
        tilt: cosine and sine of half the angle by which the attitude of each tibia IMU must be turned about its axis y, because
            IMUs are mounted askew, shape (2, 2). The angle is the error of SH + SK in the first comparison. It is 0 if this
            error exceeds `attitude_error`.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        constant_samples: number of consecutive samples with a constant reading, for each encoder, shape (12,), from `Stillness`.
        period: cycle time [s].
    """

    def __init__(self, robot: Robot, now: Signals, constant_samples: npt.NDArray[np.int64], period: float) -> None:
        self._now, self._period = now, period
        self._velocity_error = robot.sensors.velocity_error
        self._to_joint: Vector = robot.polarity / robot.gear
        self._attitude_error = robot.sensors.attitude_error
        self._attitude_change, self._misalignment = robot.sensors.attitude_change, robot.sensors.misalignment
        #: For each leg: estimated heading drift [rad]. It is the heading of the pelvis IMU minus the heading of the tibia IMU.
        self._heading_drift = [0.0 for _ in SIDES]
        #: For each leg: errors of the last comparison [rad]; None before the first comparison.
        self._errors: list[tuple[float, float, float] | None] = [None for _ in SIDES]
        self._heading_lost = [False for _ in SIDES]  # for each leg: whether its heading must be measured again
        self._waits = [0 for _ in SIDES]  # for each leg: number of samples until it is compared again
        self._comparisons = [0 for _ in SIDES]  # for each leg: number of comparisons since its last wait began
        #: For each leg: whether the drive of TH has restarted since the last comparison.
        self._referenced = [False for _ in SIDES]
        self.heading: Vector = np.tile([1.0, 0.0], (len(SIDES), 1))
        self.tilt: Vector = np.tile([1.0, 0.0], (len(SIDES), 1))
        self.encoder_error: Vector = np.full(len(JOINTS), math.inf)
        self._contradicts = [[0] * len(_AXES) for _ in SIDES]
        self._constant_samples = [constant_samples[hip : hip + len(_AXIS_OF)] for hip in _HIPS]
        #: For each joint: result of the comparison in the last sample in which the encoder reading of the joint changed.
        #: While the reading is constant, a slow drift of the IMUs is added to the error in this result.
        self._moved: list[_Comparison | None] = [None] * len(JOINTS)
        #: Number of consecutive samples in which the leg turned but the encoder reading was constant, by joint index.
        self._turned: dict[int, int] = {}
        self._drifts: list[tuple[Finding, ...]] = [() for _ in SIDES]
        self._stuck: list[tuple[Finding, ...]] = [() for _ in SIDES]
        #: For each of FH, TH, SH and SK: number of consecutive samples in which left and right encoder seemed exchanged.
        self._exchanges = [0] * len(_AXIS_OF)
        #: Findings that the left and the right encoder of a joint are exchanged, by index of the joint in a leg.
        #: The findings of a joint remain until its left or its right drive restarts.
        self._exchanged: dict[int, tuple[Finding, ...]] = {}

    def reference(self, joint: int) -> None:
        """Discard the findings that the left and the right encoder of a joint are exchanged.

        If the joint is TH, and the IMU of its tibia or of the pelvis also restarts before the next comparison, the error of TH
        from before no longer counts, see `_measure_heading`. Call this when the drive of the joint has restarted and referenced
        its encoder.

        Args:
            joint: index of the joint in JOINTS.
        """
        leg, index = divmod(joint, len(LEG_JOINTS))
        self._referenced[leg] |= index == _TH
        self._exchanged.pop(index, None)
        if index < len(self._exchanges):
            self._exchanges[index] = 0

    def restart_heading(self, imu: int) -> None:
        """Request a new measurement of the heading of an IMU in the next comparison. Call this when the IMU has restarted.

        Before the first comparison of a leg, the call has no effect on this leg.

        Args:
            imu: index of the IMU in IMUS.
        """
        for leg, tibia in enumerate(_TIBIAE):
            self._heading_lost[leg] = self._heading_lost[leg] or imu in (_PELVIS, tibia)

    def check_left(self, ages: Ages | None) -> bool:
        """Check the left leg.

        If an encoder of the right leg has a constant reading, the standstill check of the right leg also runs. So a stuck encoder
        is detected earlier.

        Args:
            ages: ages of the sensor values; a leg with values that are too old is not compared. None if all values are of this
                cycle.

        Returns:
            Whether there is a finding for any leg.
        """
        return self._check(0, ages)

    def check_right(self, ages: Ages | None) -> bool:
        """Check the right leg in the same way as `check_left` checks the left leg."""
        return self._check(1, ages)

    def _check(self, leg: int, ages: Ages | None) -> bool:
        self._waits[leg] = max(0, self._waits[leg] - 1)
        comparison = self._compare(leg, ages)
        if comparison is None:
            self._record_errors(leg, (math.inf,) * len(_AXES))
        else:
            self._comparisons[leg] += 1
            self._record_errors(leg, comparison.errors)
            self._check_drift(leg, comparison)
            self._check_standstill(leg, comparison)
            self._check_exchange(leg, comparison, ages)
        other = 1 - leg
        if self._stuck[other] or self._constant_samples[other].any():
            comparison = self._compare(other, ages)
            if comparison is not None:
                self._check_standstill(other, comparison)
        return any(self._drifts) or any(self._stuck) or bool(self._exchanged)

    def _compare(self, leg: int, ages: Ages | None) -> _Comparison | None:
        """Compare the encoders and IMUs of a leg in this cycle.

        If an IMU has restarted, its heading is measured first. If the values of an IMU are too old, the wait of the leg begins.

        Args:
            leg: index in SIDES.
            ages: ages of the sensor values; None if all values are of this cycle.

        Returns:
            The comparison. None if a value is too old, or while the leg waits after one of its IMUs was silent.
        """
        now, four, uncertainty = self._now, slice(_HIPS[leg], _HIPS[leg] + len(_AXIS_OF)), 0.0
        angles = now.position[four] * self._to_joint[four]
        pelvis, tibia = now.quaternion[_PELVIS].tolist(), now.quaternion[_TIBIAE[leg]].tolist()
        if ages is not None:
            cycles = [*ages.joint[four].tolist(), *ages.imu[[_PELVIS, _TIBIAE[leg]]].tolist()]
            if max(cycles[-2:]) >= NEVER and (
                self._waits[leg] >= SILENT_SAMPLES or self._comparisons[leg] >= DRIFT_SAMPLES
            ):
                self._waits[leg], self._comparisons[leg] = SILENT_SAMPLES + 1, 0
            if max(cycles) >= NEVER:
                return None
            uncertainty = self._velocity_error * self._period * sum(cycles)
            angles += now.velocity[four] * self._to_joint[four] * (self._period * ages.joint[four])
            pelvis = extrapolated(pelvis, now.gyro[_PELVIS].tolist(), self._period * cycles[-2])
            tibia = extrapolated(tibia, now.gyro[_TIBIAE[leg]].tolist(), self._period * cycles[-1])
        fh, th, sh, sk = angles.tolist()
        if self._heading_lost[leg]:
            self._measure_heading(leg, fh, th, pelvis, tibia)
        elif self._waits[leg]:
            return None
        self._referenced[leg] = False
        x, z, y = hip_angles(pelvis, turned_about_vertical(tibia, self.heading[leg].tolist()))
        turn = 2.0 * math.pi
        errors = math.remainder(fh - x, turn), math.remainder(th - z, turn), math.remainder(sh + sk - y, turn)
        if self._errors[leg] is None and abs(errors[_SAGITTAL]) <= self._attitude_error:
            half = 0.5 * errors[_SAGITTAL]
            self.tilt[leg] = math.cos(half), math.sin(half)
        self._errors[leg] = errors
        w, i, j, k = pelvis
        upright = math.cos(x) * (1.0 - 2.0 * (i * i + j * j)) - 2.0 * math.sin(x) * (j * k + w * i)
        return _Comparison((x, z, y), errors, (fh, th, sh, sk), uncertainty, upright)

    def _record_errors(self, leg: int, errors: Sequence[float]) -> None:
        first = _HIPS[leg]
        self.encoder_error[first : first + len(_AXIS_OF)] = [errors[axis] for axis in _AXIS_OF]

    def _check_drift(self, leg: int, comparison: _Comparison) -> None:
        drifts = []
        counts, allowed = self._contradicts[leg], self._attitude_error + comparison.uncertainty
        for axis, error in enumerate(comparison.errors):
            counts[axis] = counts[axis] + 1 if abs(error) > allowed else 0
            if counts[axis] >= DRIFT_SAMPLES:
                drifts.append(_drift(SIDES[leg], _AXES[axis], error))
        if not counts[_HEADING]:
            self._follow_heading(leg, comparison)
        self._drifts[leg] = tuple(drifts)

    def _follow_heading(self, leg: int, comparison: _Comparison) -> None:
        """Change the estimated heading drift of a leg so that the error of TH (encoder minus IMU) decreases.

        A heading drift changes the angle of TH by `upright` times the drift, so this factor also gives the direction.
        """
        change = comparison.errors[_HEADING] * comparison.upright
        self._set_heading(leg, self._heading_drift[leg] + max(-_HEADING_DRIFT, min(_HEADING_DRIFT, change)))

    def _measure_heading(self, leg: int, fh: float, th: float, pelvis: Sequence[float], tibia: Sequence[float]) -> None:
        """Measure the heading drift of a leg. Assume that FH and TH have the same errors as in the last comparison.

        If the drive of TH has restarted since the last comparison, assume that its encoder has the error 0.
        Exception: with the old error, the heading is unchanged, and with the error 0, it is not. Then keep the old error.

        Args:
            leg: index in SIDES.
            fh: encoder angle of FH [rad].
            th: encoder angle of TH [rad].
            pelvis: attitude of the pelvis IMU, quaternion wxyz.
            tibia: attitude of the tibia IMU, quaternion wxyz.
        """
        self._heading_lost[leg], self._waits[leg] = False, 0
        errors = self._errors[leg]
        if errors is None:
            return
        fh -= errors[0]
        drift = heading_drift(fh, th - errors[_HEADING], pelvis, tibia)
        if self._referenced[leg]:
            referenced = heading_drift(fh, th, pelvis, tibia)
            if self._is_heading(leg, referenced) or not self._is_heading(leg, drift):
                drift = referenced
        self._set_heading(leg, drift)

    def _is_heading(self, leg: int, drift: float) -> bool:
        """Return whether a measured heading drift agrees with the estimated heading drift of a leg."""
        return abs(math.remainder(drift - self._heading_drift[leg], 2.0 * math.pi)) <= self._attitude_error

    def _set_heading(self, leg: int, drift: float) -> None:
        self._heading_drift[leg] = drift
        self.heading[leg] = math.cos(0.5 * drift), math.sin(0.5 * drift)

    def _check_standstill(self, leg: int, comparison: _Comparison) -> None:
        stuck = []
        samples = self._constant_samples[leg].tolist()
        rates: Sequence[float] = self._error_rates(leg, comparison) if any(samples) else ()
        for index, constant in enumerate(samples):
            joint, axis = _HIPS[leg] + index, _AXIS_OF[index]
            moved = self._moved[joint]
            if not constant or moved is None:
                self._moved[joint], self._turned[joint] = comparison, 0
                continue
            change = comparison.errors[axis] - moved.errors[axis]
            turned = max(abs(angle - moved.angles[i]) for i, angle in enumerate(comparison.angles))
            # If an encoder is stuck while the leg turns, the error (encoder minus IMU) changes.
            # So an encoder counts as stuck only if the change of its error and the turn of its leg both exceed `allowed`.
            # If the error changes but the leg does not turn, the encoder has jumped or drifts.
            allowed = self._attitude_change + self._misalignment * turned + comparison.uncertainty + moved.uncertainty
            if min(abs(change), turned) <= allowed:
                self._turned[joint] = 0
                self._moved[joint] = _follow_imu_drift(moved, axis, change, rates[axis])
                continue
            self._turned[joint] += 1
            if self._turned[joint] >= STANDSTILL_SAMPLES:
                stuck.append(_stuck(joint, change))
        self._stuck[leg] = tuple(stuck)

    def _error_rates(self, leg: int, comparison: _Comparison) -> tuple[float, float, float]:
        """Return the velocities from the encoders minus those from the gyros, for FH, TH and SH + SK [rad/s].

        The angular velocity of the tibia relative to the pelvis is the sum of the velocities of the joints about their axes. In
        the pelvis frame, these are the axis x for FH, (0, -sin FH, cos FH) for TH, and the axis y of the tibia for SH + SK.

        Args:
            leg: index in SIDES.
            comparison: comparison of this cycle.
        """
        now, tibia = self._now, _TIBIAE[leg]
        attitude = turned_about_vertical(now.quaternion[tibia].tolist(), self.heading[leg].tolist())
        w, i, j, k = now.quaternion[_PELVIS].tolist()
        turning = to_world((w, -i, -j, -k), to_world(attitude, now.gyro[tibia].tolist()))
        x, y, z = (now.gyro[_PELVIS] - turning).tolist()
        fh, th, _ = comparison.angles
        sagittal = (y * math.cos(fh) + z * math.sin(fh)) / math.cos(th)
        four = slice(_HIPS[leg], _HIPS[leg] + len(_AXIS_OF))
        velocity = (now.velocity[four] * self._to_joint[four]).tolist()
        return (
            velocity[0] + x + math.sin(th) * sagittal,
            velocity[1] + z * math.cos(fh) - y * math.sin(fh),
            velocity[2] + velocity[3] + sagittal,
        )

    def _check_exchange(self, leg: int, comparison: _Comparison, ages: Ages | None) -> None:
        ours = comparison.errors
        allowed = self._attitude_error + comparison.uncertainty
        if max(map(abs, ours)) <= allowed:
            self._exchanges = [0] * len(_AXIS_OF)
            return
        opposite = self._compare(1 - leg, ages)
        if opposite is None:
            return
        theirs = opposite.errors
        their_allowed = self._attitude_error + opposite.uncertainty
        for index, axis in enumerate(_AXIS_OF):
            apart = comparison.encoders[index] - opposite.encoders[index]
            deviation = max(abs(ours[axis] - apart), abs(theirs[axis] + apart))
            beyond = abs(ours[axis]) > allowed and abs(theirs[axis]) > their_allowed
            agrees = beyond and deviation <= _AGREEMENT * abs(apart)
            self._exchanges[index] = self._exchanges[index] + 1 if agrees else 0
            if self._exchanges[index] >= EXCHANGE_SAMPLES and index not in self._exchanged:
                errors = (ours[axis], theirs[axis]) if leg == 0 else (theirs[axis], ours[axis])
                self._exchanged[index] = tuple(
                    _exchange(hip + index, error) for hip, error in zip(_HIPS, errors, strict=True)
                )

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the leg checks."""
        exchanged = (finding for pair in self._exchanged.values() for finding in pair)
        return (*self._drifts[0], *self._drifts[1], *self._stuck[0], *self._stuck[1], *exchanged)


def hip_angles(pelvis: Sequence[float], tibia: Sequence[float]) -> tuple[float, float, float]:
    """Return the angles FH, TH and SH + SK of a leg, computed from the attitudes of its two IMUs [rad].

    The rotation from the tibia frame to the pelvis frame is Rx(FH) Rz(TH) Ry(SH + SK).

    Args:
        pelvis: attitude of the pelvis IMU, quaternion wxyz, sensor to world, of unit norm within the resolution of its signals.
        tibia: attitude of the tibia IMU, in the same form.
    """
    # Relative attitude: conj(pelvis) * tibia.
    a, b, c, d = pelvis
    e, f, g, h = tibia
    w = a * e + b * f + c * g + d * h
    x = a * f - b * e - c * h + d * g
    y = a * g + b * h - c * e - d * f
    z = a * h - b * g + c * f - d * e
    sine = 2.0 * (w * z - x * y)  # sine of the transverse hip angle: element (0, 1) of the rotation matrix times -1
    th = math.asin(max(-1.0, min(1.0, sine)))
    sagittal = math.atan2(2.0 * (x * z + w * y), 1.0 - 2.0 * (y * y + z * z))
    fh = math.atan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + z * z))
    return fh, th, sagittal


def heading_drift(fh: float, th: float, pelvis: Sequence[float], tibia: Sequence[float]) -> float:
    """Return the heading of the pelvis IMU minus the heading of a tibia IMU at known hip angles [rad].

    The axis of SH and SK is the axis y of the tibia. Its direction follows from FH and TH.

    Args:
        fh: angle of FH [rad].
        th: angle of TH [rad].
        pelvis: attitude of the pelvis IMU, quaternion wxyz.
        tibia: attitude of the tibia IMU, quaternion wxyz.
    """
    axis = -math.sin(th), math.cos(th) * math.cos(fh), math.cos(th) * math.sin(fh)
    expected, found = to_world(pelvis, axis), to_world(tibia, (0.0, 1.0, 0.0))
    return math.atan2(expected[1], expected[0]) - math.atan2(found[1], found[0])


def extrapolated(quaternion: list[float], gyro: list[float], time: float) -> list[float]:
    """Extrapolate an attitude in time to first order, at constant angular velocity.

    Args:
        quaternion: attitude before the extrapolation, wxyz, sensor to world.
        gyro: angular velocity in the sensor frame [rad/s], three axes.
        time: extrapolation time [s].

    Returns:
        The attitude after that time, wxyz; its norm is 1 only to first order.
    """
    w, x, y, z = quaternion
    p, q, r = (0.5 * time * rate for rate in gyro)
    return [
        w - x * p - y * q - z * r,
        x + w * p + y * r - z * q,
        y + w * q + z * p - x * r,
        z + w * r + x * q - y * p,
    ]


def _follow_imu_drift(moved: _Comparison, axis: int, change: float, rate: float) -> _Comparison:
    """Return a copy of the comparison `moved`, in which a slow drift of the IMUs is added to the error (encoder minus IMU).

    Args:
        moved: comparison when the encoder reading of the joint last changed.
        axis: index in `_AXES`.
        change: change of the error about this axis since then [rad].
        rate: velocity from the encoders minus that from the gyros about this axis [rad/s].

    Returns:
        A copy of `moved`, whose error about the axis has changed by `change`, but by at most `_IMU_WANDER` if `rate` is at most
        `_GYRO_ERROR`, and by at most `_IMU_DRIFT` otherwise.
    """
    errors = list(moved.errors)
    limit = _IMU_WANDER if abs(rate) <= _GYRO_ERROR else _IMU_DRIFT
    errors[axis] += max(-limit, min(limit, change))
    return moved._replace(errors=(errors[0], errors[1], errors[2]))


def _drift(side: str, joints: tuple[str, ...], error: float) -> Finding:
    named = " and ".join(f"{side}_{joint}" for joint in joints)
    text = f"encoder of {named}: its angle differs by {math.degrees(error):+.1f} degrees from pelvis and tibia IMU"
    node = JOINT_NODES[JOINTS.index(f"{side}_{joints[0]}")]
    return Finding(Dtc.ENC_DRIFT, node, error, True, text)


def _stuck(joint: int, change: float) -> Finding:
    text = f"the encoder of {JOINTS[joint]} has a constant reading while its leg turned by {math.degrees(-change):+.2f} degrees"
    return Finding(Dtc.ENC_STUCK, JOINT_NODES[joint], -change, True, text)


def _exchange(joint: int, error: float) -> Finding:
    text = (
        f"the encoder of {JOINTS[joint]} reads the angle of the other leg, and vice versa, or the tibia IMUs are exchanged; "
        "both drives are switched off"
    )
    return Finding(Dtc.TORQUE_DIRECTION, JOINT_NODES[joint], error, True, text)
