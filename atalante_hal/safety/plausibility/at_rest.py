"""Checks at rest, which compare each force cell and each IMU with weight and gravity before the drives may be enabled.

A sensor is checked while the HAL sends no torques of a controller. Its readings are sampled in blocks of `SAMPLES` samples. A
sensor without a plausible block is in `unchecked`, and the robot is not READY.

*Feet before the first START.* While all drives are off, the robot cannot stand, so it is suspended. Each cell must then be
within `cell_free` of zero. This reveals an offset of one cell or of all cells of a foot. A wrong sign, a wrong gain and
exchanged feet have no effect on a cell without load. The module `feet` detects a wrong sign on the ground.

*Feet in HOLD.* The robot may stand or be suspended, and a crane may carry any part of the weight. So the total load must be at
most the weight of the robot with the heaviest patient, plus `_WEIGHT_MARGIN`.

*IMUs.* The specific force must have the magnitude of gravity. It must point up in the attitude that the same IMU reports. The
mean angular velocity must be the turn of this attitude during the block. Torso and pelvis are one rigid body and their IMUs
have equal axes, so both attitudes must be equal. Their difference in heading may be large, because the headings drift. The
module `legs` compares the pelvis IMU with the tibia IMUs and the encoders. Exchanged IMUs of torso and pelvis have equal
readings and cannot be distinguished; the exchange has no effect on any other check or controller. A block is discarded if the
IMU turns fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from atalante_hal.robot import CELLS, FEET, IMUS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.finding import FOOT_NODES, IMU_NODES, Ages, Signals
from atalante_hal.safety.start import powered
from atalante_hal.safety.state_machine import MOVING
from atalante_hal.types import SupervisorState, Vector
from atalante_hal.wire.process_image import NEVER

#: Number of samples in a block.
SAMPLES = 16
#: Number of consecutive implausible blocks after which a sensor is reported. When the drives are off, bent legs fall at first.
FAULTY_BLOCKS = 2
GRAVITY = 9.81  # m/s2
#: Largest deviation of the magnitude of the mean specific force from gravity [m/s2]. Legs whose drives are off sink, and a
#: robot that was stopped sways; the mean of a block then deviates by up to 1 m/s2.
_GRAVITY_ERROR = 2.0
#: Largest angle between the mean specific force and the vertical of the attitude [rad]. The same motions cause up to 0.1 rad.
_VERTICAL_ERROR = 0.2
#: Largest difference between the mean angular velocity and the turn of the attitude [rad/s].
_RATE_ERROR = 0.1
#: Angular velocity above which an IMU is not at rest [rad/s].
_MOVING_RATE = 0.5
#: Time after a motion in which no sensor is checked, because a robot that was stopped sways [cycles].
SETTLING_CYCLES = 1000
#: Largest difference of the headings of torso IMU and pelvis IMU [rad]. The difference drifts by less than 0.1 rad in an hour.
_HEADING_ERROR = 1.0
#: Mass of the exoskeleton and of the heaviest patient [kg].
MASS_MAX = 82.5 + 110.0
#: Largest load on both feet in HOLD, as a multiple of the weight of `MASS_MAX`.
_WEIGHT_MARGIN = 1.1
#: IMUs of the same rigid body.
_RIGID = [IMUS.index("torso"), IMUS.index("pelvis")]
_S = SupervisorState
_NODES = (*IMU_NODES, *FOOT_NODES)


class AtRest:
    """Checks of IMUs and feet at rest.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        drive_state: decoded values of `DriveState`, shape (12,).
        every: mean interval between two calls of `sample` [cycles].
        period: cycle time [s].

    Attributes:
        supervisor: state of the state machine.
        unchecked: DBC names of the sensors that have not been checked since the start or since their last restart.
    """

    def __init__(self, robot: Robot, now: Signals, drive_state: Vector, every: int, period: float) -> None:
        self.supervisor = _S.OFF
        self.unchecked = set(_NODES)
        self._now, self._drive_state, self._every = now, drive_state, every
        self._cell_free, self._attitude_error = robot.sensors.cell_free, 2.0 * robot.sensors.attitude_error
        self._duration = (SAMPLES - 1) * every * period  # time from the first to the last sample of a block [s]
        self._settling = 0  # remaining time until the robot is at rest [cycles]
        self._samples = [0] * len(_NODES)  # number of samples in the present block of each sensor
        self._faulty = [0] * len(_NODES)  # number of consecutive implausible blocks of each sensor
        self._first = np.zeros((len(IMUS), 4))  # attitude of each IMU in the first sample
        self._gyro, self._accel = np.zeros((2, len(IMUS), 3))  # sums over the samples of the block
        self._force = np.zeros((len(FEET), len(CELLS)))  # sums of the vertical forces over the samples of the block
        self._load = [0.0 for _ in FEET]  # mean load of each foot in its last block [N]
        self._findings: dict[str, Finding] = {}

    def enter(self, supervisor: SupervisorState) -> None:
        """Accept a new state of the state machine.

        Args:
            supervisor: new state.
        """
        if self.supervisor in MOVING:
            self._settling = SETTLING_CYCLES
        self.supervisor = supervisor

    def disturb(self) -> None:
        """Wait until the robot is at rest again, because a start enables the drives and tests their directions.

        A present finding remains, because a START must not remove it.
        """
        if not self._findings:
            self._settling = SETTLING_CYCLES

    def sample(self, ages: Ages | None) -> bool:
        """Add a sample of each sensor to its block, and check each sensor whose block is complete.

        Args:
            ages: ages of the sensor values. A sensor whose values are too old begins a new block. None if all values are of this
                cycle.

        Returns:
            Whether a sensor is implausible.
        """
        if self.supervisor in MOVING or self._settling:
            self._settling = max(0, self._settling - self._every)
            self._samples, self._faulty = [0] * len(_NODES), [0] * len(_NODES)
            self._findings.clear()
            return False
        usable = [True] * len(_NODES) if ages is None else [*(ages.imu < NEVER), *(ages.foot < NEVER)]
        for sensor, node in enumerate(_NODES):
            if not usable[sensor]:
                self._samples[sensor] = 0
                continue
            self._add(sensor)
            if self._samples[sensor] == SAMPLES:
                self._samples[sensor] = 0
                self._check(sensor, node)
        return bool(self._findings)

    def forget(self, node: str) -> None:
        """Require a new check of a sensor whose node has restarted.

        Args:
            node: DBC name of the node; the name of a node without such a sensor has no effect.
        """
        if node in _NODES:
            self.unchecked.add(node)
            self._samples[_NODES.index(node)] = 0

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings."""
        return tuple(self._findings.values())

    def _add(self, sensor: int) -> None:
        now, begins = self._now, not self._samples[sensor]
        self._samples[sensor] += 1
        foot = sensor - len(IMUS)
        if foot >= 0:
            self._force[foot] = now.force[foot, :, 2] + (0.0 if begins else self._force[foot])
            return
        if begins:
            self._first[sensor] = now.quaternion[sensor]
            self._gyro[sensor] = self._accel[sensor] = 0.0
        self._gyro[sensor] += now.gyro[sensor]
        self._accel[sensor] += now.accel[sensor]

    def _check(self, sensor: int, node: str) -> None:
        foot = sensor - len(IMUS)
        found = self._foot_fault(foot) if foot >= 0 else self._imu_fault(sensor)
        if found is None:
            return
        value, text = found
        self._faulty[sensor] = self._faulty[sensor] + 1 if text else 0
        if 0 < self._faulty[sensor] < FAULTY_BLOCKS:
            return
        self.unchecked.discard(node)
        if text:
            dtc = Dtc.FOOT_CELL if foot >= 0 else Dtc.IMU_IMPLAUSIBLE
            self._findings[node] = Finding(dtc, node, value, True, text)
        else:
            self._findings.pop(node, None)

    def _imu_fault(self, imu: int) -> tuple[float, str] | None:
        attitude = self._now.quaternion[imu].tolist()
        gyro, accel = ((total[imu] / SAMPLES).tolist() for total in (self._gyro, self._accel))
        turn = turn_rate(self._first[imu].tolist(), attitude, self._duration)
        if math.hypot(*turn) > _MOVING_RATE:
            return None
        found = imu_fault(IMUS[imu], attitude, turn, gyro, accel)
        if found[1] or imu not in _RIGID or not self.unchecked.isdisjoint(IMU_NODES[i] for i in _RIGID if i != imu):
            return found
        torso, pelvis = self._now.quaternion[_RIGID].tolist()
        return rigid_fault(torso, pelvis, self._attitude_error)

    def _foot_fault(self, foot: int) -> tuple[float, str]:
        cells = (self._force[foot] / SAMPLES).tolist()
        self._load[foot] = sum(cells)
        suspended = self.supervisor in (_S.OFF, _S.READY) and not powered(self._drive_state).any()
        return foot_fault(FEET[foot], cells, sum(self._load), self._cell_free if suspended else math.inf)


def turn_rate(first: Sequence[float], last: Sequence[float], time: float) -> list[float]:
    """Return the mean angular velocity between two attitudes, in the sensor frame, to first order [rad/s].

    Args:
        first: first attitude, quaternion wxyz, sensor to world.
        last: last attitude, in the same form.
        time: time between the attitudes [s].
    """
    w, x, y, z = relative(first, last)
    return [math.copysign(2.0, w) * part / time for part in (x, y, z)]


def relative(base: Sequence[float], other: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the attitude of `other` relative to `base`, conj(base) * other, as a quaternion wxyz.

    Args:
        base: quaternion wxyz, sensor to world.
        other: quaternion wxyz, sensor to world.
    """
    a, b, c, d = base
    e, f, g, h = other
    return (
        a * e + b * f + c * g + d * h,
        a * f - b * e - c * h + d * g,
        a * g + b * h - c * e - d * f,
        a * h - b * g + c * f - d * e,
    )


def vertical(attitude: Sequence[float]) -> tuple[float, float, float]:
    """Return the upward direction of the world in the sensor frame, as a unit vector.

    Args:
        attitude: quaternion wxyz of unit norm, sensor to world.
    """
    w, x, y, z = attitude
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


def imu_fault(
    imu: str, attitude: Sequence[float], turn: Sequence[float], gyro: Sequence[float], accel: Sequence[float]
) -> tuple[float, str]:
    """Compare the mean readings of an IMU at rest with gravity and with the attitude of the same IMU.

    Args:
        imu: name of the IMU.
        attitude: quaternion wxyz, sensor to world.
        turn: angular velocity of the attitude in the sensor frame, three axes [rad/s].
        gyro: mean angular velocity of the gyroscope, three axes [rad/s].
        accel: mean specific force, three axes [m/s2].

    Returns:
        The deviation and a sentence about the fault. The sentence is empty if there is no fault.
    """
    force = math.hypot(*accel)
    if not abs(force - GRAVITY) <= _GRAVITY_ERROR:
        wanted = f"{GRAVITY:.1f} +- {_GRAVITY_ERROR:.0f} m/s2"
        return force, f"the accelerometer of the {imu} IMU must report {wanted} at rest, got {force:.1f} m/s2"
    up = vertical(attitude)
    along = sum(a * b for a, b in zip(accel, up, strict=True)) / (force * math.hypot(*up))
    angle = math.acos(max(-1.0, min(1.0, along)))
    if angle > _VERTICAL_ERROR:
        text = (
            f"the accelerometer of the {imu} IMU contradicts its attitude by {math.degrees(angle):.0f} degrees at rest"
        )
        return angle, text
    error = math.dist(gyro, turn)
    if error > _RATE_ERROR:
        text = f"the gyroscope of the {imu} IMU contradicts the change of its attitude by {error:.2f} rad/s at rest"
        return error, text
    return angle, ""


def rigid_fault(torso: Sequence[float], pelvis: Sequence[float], tilt_error: float) -> tuple[float, str]:
    """Compare the attitudes of the torso IMU and the pelvis IMU, which are on one rigid body.

    Args:
        torso: attitude of the torso IMU, quaternion wxyz, sensor to world.
        pelvis: attitude of the pelvis IMU, in the same form.
        tilt_error: largest difference of the directions that the IMUs regard as vertical [rad].

    Returns:
        The difference and a sentence about the fault. The sentence is empty if there is no fault.
    """
    tilt = math.dist(vertical(torso), vertical(pelvis))
    w, _, _, z = relative(pelvis, torso)
    heading = abs(math.remainder(2.0 * math.atan2(z, w), 2.0 * math.pi))
    for name, error, allowed in (("tilt", tilt, tilt_error), ("heading", heading, _HEADING_ERROR)):
        if error > allowed:
            text = f"the torso IMU and the pelvis IMU differ by {math.degrees(error):.0f} degrees in {name}"
            return error, f"{text}; must be within {math.degrees(allowed):.0f} degrees, because their body is rigid"
    return tilt, ""


def foot_fault(foot: str, cells: Sequence[float], total: float, free: float) -> tuple[float, str]:
    """Compare the mean vertical forces of a foot at rest with the load that is possible.

    Args:
        foot: name of the foot.
        cells: mean vertical force of each cell of the foot [N].
        total: sum of the vertical forces on both feet [N].
        free: largest magnitude of a force [N]; infinite if the foot may carry load.

    Returns:
        A force and a sentence about the fault. The sentence is empty if there is no fault.
    """
    worst = max(range(len(cells)), key=lambda cell: abs(cells[cell]))
    if not abs(cells[worst]) <= free:
        text = f"force cell {CELLS[worst]} of the {foot} foot reports {cells[worst]:.0f} N while all drives are off"
        return cells[worst], f"{text}; must be within {free:.0f} N, because the robot is suspended before START"
    allowed = _WEIGHT_MARGIN * MASS_MAX * GRAVITY
    if total > allowed:
        text = f"the force cells of both feet report {total:.0f} N at rest; must be at most {allowed:.0f} N"
        return total, f"{text}, because robot and patient do not weigh more"
    return total, ""
