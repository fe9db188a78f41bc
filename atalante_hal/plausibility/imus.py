"""IMUs against themselves and the encoders: a quaternion is a unit, no axis is at its end, and the legs agree with the joints.

*Drift.* Pelvis and tibia IMU enclose the joints FH, TH, SH and SK of a leg, whose axes are x, z, y, y of parallel frames. So the
tibia's attitude in the pelvis is Rx(FH) Rz(TH) Ry(SH + SK), three angles that two attitudes tell and four encoders contradict or
not. An encoder that drifts at rate d is found attitude_error / d later, plus `DRIFT_SAMPLES` samples: within 1000 cycles above
0.035 rad/s, later below. What it cannot see: SA and HA, which have no IMU behind them (all their drifts are missed here), SH
and SK drifting opposite ways, and which of the two drifts. An IMU that drifts looks the same; of a healthy one only the turn
about the vertical does, and that is TH.
"""

from __future__ import annotations

import math

from atalante_hal.codec import Codec
from atalante_hal.diagnostics import Dtc
from atalante_hal.plausibility.finding import IMU_MESSAGES, IMU_NODES, JOINT_NODES, Finding, Signals
from atalante_hal.robot import IMUS, JOINTS, SIDES, Robot, Vector

#: Cycles without a good value after which an IMU is given up.
IMU_CYCLES = 10
#: Samples of a leg on end whose attitude contradicts its encoders.
DRIFT_SAMPLES = 4
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)
_AXES = (("FH",), ("TH",), ("SH", "SK"))
_HIPS = tuple(JOINTS.index(f"{side}_FH") for side in SIDES)


class Imus:
    """The four IMUs.

    Args:
        now: what was decoded in this cycle.
    """

    def __init__(self, robot: Robot, codec: Codec, now: Signals) -> None:
        self._now = now
        self._gyro_end, self._accel_end = (_end_of_range(codec, signal) for signal in ("GyroX", "AccelX"))
        self._surely = min(self._gyro_end, self._accel_end) ** 2
        self._norm_error = robot.sensors.quaternion_error
        # Half of what one may err: the others do so by the precision of the wire.
        self._least, self._most = len(IMUS) - 0.5 * self._norm_error, len(IMUS) + 0.5 * self._norm_error
        self._to_joint: Vector = robot.polarity / robot.gear
        self._attitude_error = robot.sensors.attitude_error
        #: IMUs whose quaternion is none, and of those at the end of their range; both by number with the value.
        self.no_attitude: dict[int, float] = {}
        self.saturated: dict[int, float] = {}
        self._useless = [0] * len(IMUS)  # cycles since the last good value
        self._contradicts = [[0] * len(_AXES) for _ in SIDES]
        self._drifts: list[tuple[Finding, ...]] = [() for _ in SIDES]

    def usable(self) -> bool:
        """Whether every quaternion is a unit, unless two err the opposite way, and no axis is at the end of its range.

        No axis is if the sum of all squares is under the square of that end: one product for most cycles.
        """
        quaternions, inertial = self._now.quaternions, self._now.inertial
        if not self._least <= quaternions.dot(quaternions) <= self._most:
            return False
        return bool(inertial.dot(inertial) < self._surely) or not any(map(self.saturation, range(len(IMUS))))

    def saturation(self, imu: int) -> float | None:
        """The largest reading of an IMU that is at the end of its range [rad/s or m/s2], None if none is."""
        gyro = max(map(abs, self._now.gyro[imu].tolist()))
        accel = max(map(abs, self._now.accel[imu].tolist()))
        return gyro if gyro >= self._gyro_end else accel if accel >= self._accel_end else None

    def accept(self, imu: int, cycles: int, *, frozen: bool) -> bool:
        """Whether the new values of one IMU may be used.

        Args:
            cycles: from the last good ones to these.
            frozen: it repeats itself.
        """
        saturation, norm = self.saturation(imu), self._wrong_norm(imu)
        for value, standing in ((saturation, self.saturated), (norm, self.no_attitude)):
            if value is None:
                standing.pop(imu, None)
            else:
                standing[imu] = value
        usable = not frozen and saturation is None and norm is None
        self._useless[imu] = 0 if usable else cycles
        return usable

    def _wrong_norm(self, imu: int) -> float | None:
        """The norm of the quaternion of an IMU, None if it is a unit."""
        w, x, y, z = self._now.quaternion[imu].tolist()
        squared = w * w + x * x + y * y + z * z
        return None if abs(squared - 1.0) <= self._norm_error else math.sqrt(squared)

    def judge_norms(self, whole: bool) -> bool:
        """Look at each quaternion by itself; returns whether one is none.

        Args:
            whole: every node was heard in this cycle; otherwise `accept` looks at those that were.
        """
        if whole:
            norms = ((imu, self._wrong_norm(imu)) for imu in range(len(IMUS)))
            self.no_attitude.update((imu, norm) for imu, norm in norms if norm is not None)
        return bool(self.no_attitude)

    def judge_left_drift(self, whole: bool) -> bool:
        """Compare the attitude of the left tibia in the pelvis with the encoders between.

        Args:
            whole: every node was heard in this cycle; otherwise nothing is compared.

        Returns:
            Whether an encoder has drifted away.
        """
        return self._judge_drift(0, whole)

    def judge_right_drift(self, whole: bool) -> bool:
        """As `judge_left_drift`, of the right."""
        return self._judge_drift(1, whole)

    def _judge_drift(self, leg: int, whole: bool) -> bool:
        if not whole:
            return bool(self._drifts[leg])
        hip = _HIPS[leg]
        fh, th, sh, sk = (self._now.position[hip : hip + 4] * self._to_joint[hip : hip + 4]).tolist()
        angles = hip_angles(self._now.quaternion[_PELVIS].tolist(), self._now.quaternion[_TIBIAE[leg]].tolist())
        drifts = []
        for axis, (angle, encoder) in enumerate(zip(angles, (fh, th, sh + sk), strict=True)):
            error = math.remainder(encoder - angle, 2.0 * math.pi)
            counts = self._contradicts[leg]
            counts[axis] = counts[axis] + 1 if abs(error) > self._attitude_error else 0
            if counts[axis] >= DRIFT_SAMPLES:
                drifts.append(_drift(SIDES[leg], _AXES[axis], error))
        self._drifts[leg] = tuple(drifts)
        return bool(drifts)

    def findings(self) -> tuple[Finding, ...]:
        """What stands."""
        return (
            *(_no_attitude(imu, norm, self._given_up(imu)) for imu, norm in self.no_attitude.items()),
            *(_saturated(imu, value, self._given_up(imu)) for imu, value in self.saturated.items()),
            *self._drifts[0],
            *self._drifts[1],
        )

    def _given_up(self, imu: int) -> bool:
        return self._useless[imu] >= IMU_CYCLES


def hip_angles(pelvis: list[float], tibia: list[float]) -> tuple[float, float, float]:
    """Angles FH, TH, SH + SK [rad] of the rotation Rx Rz Ry that takes the tibia's axes into the pelvis'.

    Args:
        pelvis, tibia: quaternions wxyz, sensor to world, unit to the precision of the wire.
    """
    # conj(pelvis) * tibia
    a, b, c, d = pelvis
    e, f, g, h = tibia
    w = a * e + b * f + c * g + d * h
    x = a * f - b * e - c * h + d * g
    y = a * g + b * h - c * e - d * f
    z = a * h - b * g + c * f - d * e
    sine = 2.0 * (w * z - x * y)  # of TH, less the sign of the matrix entry (0, 1)
    th = math.asin(max(-1.0, min(1.0, sine)))
    sagittal = math.atan2(2.0 * (x * z + w * y), 1.0 - 2.0 * (y * y + z * z))
    fh = math.atan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + z * z))
    return fh, th, sagittal


def _end_of_range(codec: Codec, name: str) -> float:
    """Readings from here on are the last step of the range."""
    signal = next(s for m, s in codec.signals if m.name == IMU_MESSAGES[0] and s.name == name)
    return signal.maximum - 0.5 * signal.factor


def _no_attitude(imu: int, norm: float, given_up: bool) -> Finding:
    text = f"the quaternion of the {IMUS[imu]} IMU has the norm {norm:.3f}, not 1"
    return Finding(Dtc.IMU_INVALID, IMU_NODES[imu], norm, given_up, text)


def _saturated(imu: int, value: float, given_up: bool) -> Finding:
    text = f"the {IMUS[imu]} IMU is at the end of its range, {value:.0f}"
    return Finding(Dtc.IMU_SATURATED, IMU_NODES[imu], value, given_up, text)


def _drift(side: str, joints: tuple[str, ...], error: float) -> Finding:
    named = " and ".join(f"{side}_{joint}" for joint in joints)
    text = f"encoder of {named}: {math.degrees(error):+.1f} degrees off what pelvis and tibia IMU say"
    node = JOINT_NODES[JOINTS.index(f"{side}_{joints[0]}")]
    return Finding(Dtc.ENC_DRIFT, node, error, True, text)
