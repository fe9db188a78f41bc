"""The legs' IMUs against their encoders: an encoder that drifts away, and one that stands still while its leg turns.

Pelvis and tibia IMU enclose the joints FH, TH, SH and SK of a leg, whose axes are x, z, y, y of parallel frames. So the tibia's
attitude in the pelvis is Rx(FH) Rz(TH) Ry(SH + SK), three angles that two attitudes tell and four encoders contradict or not.

*Drift.* An encoder that drifts at rate d is found attitude_error / d later, plus `DRIFT_SAMPLES` samples: within 1000 cycles
above 0.035 rad/s, later below. What it cannot see: SA and HA, which have no IMU behind them (all their drifts are missed here),
SH and SK drifting opposite ways, and which of the two drifts. An IMU that drifts looks the same; of a healthy one only the turn
about the vertical does, and that is TH.

*Standstill.* While an encoder repeats itself, the contradiction of its axis stays what it was if the joint stands, and becomes
the joint's motion if it does not. A change counts, so that it is found long before `attitude_error`; what a turn of the leg about
another axis makes of an IMU that is not mounted straight (`misalignment`) is allowed for. If SH and SK both stand still, both are
suspected. It needs no torque, which `stillness` looks at: a joint that is moved by its neighbours is found, too.

*Age.* Values that are some cycles old are carried to this cycle at the velocity reported with them, and `velocity_error` for
that time is allowed for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import IMUS, JOINTS, SIDES, Robot, Vector
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import JOINT_NODES, Ages, Finding, Signals
from atalante_hal.wire.process_image import NEVER

#: Samples of a leg on end whose attitude contradicts its encoders, or one that stands still.
DRIFT_SAMPLES, STANDSTILL_SAMPLES = 4, 2
#: What the contradiction of a joint that stands still changes by without being noticed [rad each sample]: over ten times what
#: the heading of a healthy IMU does.
_FORGOTTEN = 2e-5
_PELVIS = IMUS.index("pelvis")
_TIBIAE = tuple(IMUS.index(f"{side}_tibia") for side in SIDES)
_AXES = (("FH",), ("TH",), ("SH", "SK"))
#: Axis of each of a leg's first four joints.
_AXIS_OF = (0, 1, 2, 2)
_HIPS = tuple(JOINTS.index(f"{side}_FH") for side in SIDES)


class _Contradiction(NamedTuple):
    """What a leg's IMUs and encoders said together: angles of the tibia in the pelvis, and encoders less these. rad."""

    angles: tuple[float, float, float]
    errors: tuple[float, float, float]
    doubt: float = 0.0  # rad, by which the errors may be off because values were not of one cycle


class Legs:
    """Both legs.

    Args:
        now: what was decoded in this cycle.
        standing: samples on end in which each encoder stood still, shape (12,), as `Stillness` counts them.
        period: of the cycle [s].
    """

    def __init__(self, robot: Robot, now: Signals, standing: npt.NDArray[np.int64], period: float) -> None:
        self._now, self._period = now, period
        self._velocity_error = robot.sensors.velocity_error
        self._to_joint: Vector = robot.polarity / robot.gear
        self._attitude_error = robot.sensors.attitude_error
        self._attitude_change, self._misalignment = robot.sensors.attitude_change, robot.sensors.misalignment
        self._contradicts = [[0] * len(_AXES) for _ in SIDES]
        self._standing = [standing[hip : hip + len(_AXIS_OF)] for hip in _HIPS]
        #: Of each joint, what was said when it moved last.
        self._moved: list[_Contradiction | None] = [None] * len(JOINTS)
        #: Samples on end in which the leg of a joint that stands still has turned.
        self._turned: dict[int, int] = {}
        self._drifts: list[tuple[Finding, ...]] = [() for _ in SIDES]
        self._stuck: list[tuple[Finding, ...]] = [() for _ in SIDES]

    def judge_left(self, ages: Ages | None) -> bool:
        """Look at the left leg, and at the right one if an encoder of it stands still.

        Args:
            ages: of the values; a leg with values that are too old is not compared. None: all are of this cycle.

        Returns:
            Whether something stands.
        """
        return self._judge(0, ages)

    def judge_right(self, ages: Ages | None) -> bool:
        """As `judge_left`, the other way round."""
        return self._judge(1, ages)

    def _judge(self, leg: int, ages: Ages | None) -> bool:
        said = self._compare(leg, ages)
        if said is not None:
            self._judge_drift(leg, said)
            self._judge_standstill(leg, said)
        other = 1 - leg
        if self._stuck[other] or self._standing[other].any():
            said = self._compare(other, ages)
            if said is not None:
                self._judge_standstill(other, said)
        return any(self._drifts) or any(self._stuck)

    def _compare(self, leg: int, ages: Ages | None) -> _Contradiction | None:
        """Return what IMUs and encoders of a leg say of this cycle, None if a value is too old."""
        now, four, doubt = self._now, slice(_HIPS[leg], _HIPS[leg] + len(_AXIS_OF)), 0.0
        angles = now.position[four] * self._to_joint[four]
        pelvis, tibia = now.quaternion[_PELVIS].tolist(), now.quaternion[_TIBIAE[leg]].tolist()
        if ages is not None:
            cycles = [*ages.joint[four].tolist(), *ages.imu[[_PELVIS, _TIBIAE[leg]]].tolist()]
            if max(cycles) >= NEVER:
                return None
            doubt = self._velocity_error * self._period * sum(cycles)
            angles += now.velocity[four] * self._to_joint[four] * (self._period * ages.joint[four])
            pelvis = turned_on(pelvis, now.gyro[_PELVIS].tolist(), self._period * cycles[-2])
            tibia = turned_on(tibia, now.gyro[_TIBIAE[leg]].tolist(), self._period * cycles[-1])
        fh, th, sh, sk = angles.tolist()
        x, z, y = hip_angles(pelvis, tibia)
        turn = 2.0 * math.pi
        errors = math.remainder(fh - x, turn), math.remainder(th - z, turn), math.remainder(sh + sk - y, turn)
        return _Contradiction((x, z, y), errors, doubt)

    def _judge_drift(self, leg: int, said: _Contradiction) -> None:
        drifts = []
        counts = self._contradicts[leg]
        for axis, error in enumerate(said.errors):
            counts[axis] = counts[axis] + 1 if abs(error) > self._attitude_error + said.doubt else 0
            if counts[axis] >= DRIFT_SAMPLES:
                drifts.append(_drift(SIDES[leg], _AXES[axis], error))
        self._drifts[leg] = tuple(drifts)

    def _judge_standstill(self, leg: int, said: _Contradiction) -> None:
        stuck = []
        for place, stands in enumerate(self._standing[leg].tolist()):
            joint, axis = _HIPS[leg] + place, _AXIS_OF[place]
            moved = self._moved[joint]
            if not stands or moved is None:
                self._moved[joint], self._turned[joint] = said, 0
                continue
            change = said.errors[axis] - moved.errors[axis]
            turned = max(abs(angle - moved.angles[i]) for i, angle in enumerate(said.angles))
            # Who changed while the leg did not turn is no encoder that stands still, but one that jumped or drifted before.
            allowed = self._attitude_change + self._misalignment * turned + said.doubt + moved.doubt
            if min(abs(change), turned) <= allowed:
                self._turned[joint] = 0
                self._moved[joint] = _forgotten(moved, axis, change)
                continue
            self._turned[joint] += 1
            if self._turned[joint] >= STANDSTILL_SAMPLES:
                stuck.append(_stuck(joint, change))
        self._stuck[leg] = tuple(stuck)

    def findings(self) -> tuple[Finding, ...]:
        """What stands."""
        return (*self._drifts[0], *self._drifts[1], *self._stuck[0], *self._stuck[1])


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


def turned_on(quaternion: list[float], gyro: list[float], time: float) -> list[float]:
    """Return an attitude some time later, to the first order in the turn.

    Args:
        quaternion: wxyz, sensor to world.
        gyro: in the sensor's frame [rad/s].
        time: [s].
    """
    w, x, y, z = quaternion
    p, q, r = (0.5 * time * rate for rate in gyro)
    return [
        w - x * p - y * q - z * r,
        x + w * p + y * r - z * q,
        y + w * q + z * p - x * r,
        z + w * r + x * q - y * p,
    ]


def _forgotten(moved: _Contradiction, axis: int, change: float) -> _Contradiction:
    """The same, a little nearer to what is said now."""
    errors = list(moved.errors)
    errors[axis] += max(-_FORGOTTEN, min(_FORGOTTEN, change))
    return moved._replace(errors=(errors[0], errors[1], errors[2]))


def _drift(side: str, joints: tuple[str, ...], error: float) -> Finding:
    named = " and ".join(f"{side}_{joint}" for joint in joints)
    text = f"encoder of {named}: {math.degrees(error):+.1f} degrees off what pelvis and tibia IMU say"
    node = JOINT_NODES[JOINTS.index(f"{side}_{joints[0]}")]
    return Finding(Dtc.ENC_DRIFT, node, error, True, text)


def _stuck(joint: int, change: float) -> Finding:
    text = f"the encoder of {JOINTS[joint]} stands still while its leg turned by {math.degrees(-change):+.2f} degrees"
    return Finding(Dtc.ENC_STUCK, JOINT_NODES[joint], -change, True, text)
