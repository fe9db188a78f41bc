"""Standstill checks, which detect stuck encoders, frozen gyros and frozen force cells by exactly constant readings.

All signals are sampled every few cycles, and consecutive samples with exactly the same value are counted. A sample
skips each signal that has no new value since the last sample. In addition, each cycle updates a record of each joint
(`Drive`): the range of its torque since its encoder reading last changed, and a simulated motion under this torque.

*Torque.* The reading of an encoder may be constant because the joint is at rest. So an encoder is reported as stuck only under
two conditions. First, the torque of the drive has varied by at least `breakaway` since the reading last changed. `breakaway` is
more than twice the dry friction of the joint. Second, the joint is not at its end stop, because an end stop holds a joint against
any torque. A stuck encoder of a joint without torque is not detected by this module until the joint is driven. The module `legs`
detects some stuck encoders of joints without torque with the IMUs.

*Ankles.* The ankles of a foot on the ground move the whole robot, whose inertia is some thousand times the inertia of
the foot. A torque that varies fast then does not move the ankles. But the sole is at rest, so an ankle moves when its
shank turns. For an ankle with a loaded foot, the first condition is therefore that the shank has turned by `_TURN` since
the reading last changed. While a foot sends no forces, it may be in the air or on the ground, so the encoders of its
ankles are not checked here.

*Large torque.* A controller that drives a joint with a stuck encoder accelerates the joint by a large torque within a few
cycles. So the larger the torque, the sooner a constant reading is reported. A joint whose reading has been
constant for `_AT_REST` cycles is at rest, so its torque is in balance. In each later cycle, the check computes by which angle
the torque change beyond `breakaway` would have turned a joint with the inertia `_INERTIA`, which is larger than the inertia
of any joint. The encoder is stuck if this angle is at least `_DRIVEN`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.dbc_names import FOOT_NODES, IMU_NODES, JOINT_NODES
from atalante_hal.robot import AT_STOP, CELLS, FEET, IMUS, JOINTS, SIDES, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Cycles, Signals, measured
from atalante_hal.types import Vector
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Longest time from the first repeated reading of a stuck encoder to its detection [cycles].
STUCK_CYCLES = 50
#: Longest time from the first repeated reading of a frozen gyro or force cell to its detection [cycles].
FROZEN_CYCLES = 100
#: Turn of a shank above a loaded foot after which the readings of the ankle encoders must have changed [rad].
_TURN = 0.01
#: Upper bound of the inertia about any joint [kg m2], including the knee of a leg that carries robot and patient.
_INERTIA = 100.0
#: Number of cycles with a constant encoder reading after which a joint counts as at rest.
#: Torques that are not in balance would move the joint within `_AT_REST` cycles.
_AT_REST = 3
#: Turn of a joint after which its encoder reading must have changed [rad]. The turn is 20 encoder counts.
_DRIVEN = 1e-5
#: Largest age of the last forces of a foot at which they still show whether the foot is on the ground [cycles].
#: If the forces are older, the foot may have left the ground or landed. Then the `Drive` records of its ankles are cleared.
_FORCES_VALID = 5
#: Limit of the number of repeated readings for signals that may stay constant [samples]. No signal reaches this limit.
_NO_LIMIT = 1 << 30
#: Index of each ankle joint in JOINTS.
_ANKLES = [JOINTS.index(f"{side}_{joint}") for side in SIDES for joint in ("SA", "HA")]
#: For each ankle joint: index of its foot in FEET.
_FOOT_OF = [0, 0, 1, 1]
#: For each joint: index of its foot in FEET if the joint is an ankle, otherwise -1.
_FOOT_OF_JOINT = tuple(_FOOT_OF[_ANKLES.index(joint)] if joint in _ANKLES else -1 for joint in range(len(JOINTS)))
#: For each ankle joint: index in IMUS of the IMU at its shank.
_SHANK_OF = [IMUS.index(f"{side}_tibia") for side in SIDES for _ in ("SA", "HA")]


class Readings(NamedTuple):
    """Signals of one cycle that `follow_one` uses. Positions are on the motor side."""

    position: Vector  # (12,) rad, measured positions
    before: Vector  # (12,) rad, measured positions of the previous cycle
    torque: Vector  # (12,) Nm at the joint, torques that the drives report
    force: Vector  # (2, 4, 3) N, forces on the cells of both feet


class Drive(NamedTuple):
    """Torques and simulated motion of each joint since its encoder reading last changed. Each field has the shape (12,).

    The simulation computes the smallest angle by which the torques turn a joint. The simulated joint starts at rest. If the
    torque changes by more than `breakaway`, the part of the change above `breakaway` accelerates the joint. If the torque
    changes by less, the missing part brakes the joint, at most to rest. The inertia of the simulated joint is `_INERTIA`, an
    upper bound, so a real joint turns further.
    """

    cycles: Vector  # number of cycles since the encoder reading last changed
    rest: Vector  # torque that holds the joint [Nm]: the torque in the third cycle (`_AT_REST`) with an unchanged encoder reading
    low: Vector  # lowest torque since the encoder reading last changed [Nm]
    high: Vector  # highest torque since the encoder reading last changed [Nm]
    momentum: Vector  # angular momentum of the simulated joint [Nm s], at least 0
    turn: Vector  # angle by which the simulated joint has turned since the encoder reading last changed [rad]


class Stillness:
    """Standstill checks of encoders, gyros and force cells.

    Args:
        robot: limits and friction of the robot.
        image: process image whose decoded values are sampled.
        now: views of the measured signals in these values.
        before: views of the last good signals before this cycle.
        every: interval between two calls of `sample` [cycles].
        period: cycle time [s].
    """

    def __init__(
        self, robot: Robot, image: ReceiveImage, now: Signals, before: Signals, every: int, period: float
    ) -> None:
        codec = image.codec
        where = measured(codec)
        self._values, self._now, self._age = image.values[where], now, image.age
        self._every = every
        #: Age of the values that were sampled last [cycles], by row in the process image. Each call of `sample` updates it.
        #: If the message has a lower age (`_age`), newer values have arrived since the last sample.
        self._sampled_age: Cycles = np.full(len(image.age), 2 * NEVER)
        self._row_of = codec.row_of[where]
        size = len(self._values)
        self._sampled = np.full(size, np.nan)
        self._same = np.empty(size, np.bool_)
        self._repeats = np.full(size, 0)
        # Convert the limits from cycles to samples. Example: with `every` = 16, 50 cycles become (50 - 15) // 16 = 2 samples.
        # The 15 cycles are subtracted, because a reading may be constant for up to 15 cycles before its first sample.
        limit = np.full(size, _NO_LIMIT)
        limit[codec.slice("Position")] = self._to_stuck = (STUCK_CYCLES - every + 1) // every
        limit[codec.slice("Gyro")] = limit[codec.slice("Force")] = to_freeze = (FROZEN_CYCLES - every + 1) // every
        self._to_freeze = to_freeze
        self._limit = limit
        self._none_over = bytes(size)
        #: Number of consecutive samples in which the reading of each encoder was constant, shape (12,).
        self.constant_samples: npt.NDArray[np.int64]
        self.constant_samples, self._gyros, self._cells = (
            self._repeats[codec.slice(quantity)] for quantity in ("Position", "Gyro", "Force")
        )
        self._foot_rows = [codec.rows[f"{node}_STATE"] for node in FOOT_NODES]
        self._gyro, self._force = codec.slice("Gyro"), codec.slice("Force")
        self._encoders_same, self._no_encoder = self._same[codec.slice("Position")], bytes(len(JOINTS))
        self._breakaway = robot.breakaway
        self._loaded = 2.0 * robot.sensors.cell_free  # vertical force above which a foot is on the ground [N]
        self._interval = every * period
        self._drive = Drive(*np.zeros((6, len(JOINTS))))
        #: Indices of the joints whose encoder reading is constant despite a large torque, see *Large torque* above.
        self._driven: list[int] = []
        #: Arguments of the function `follow`. The array objects are the same in every call.
        self._readings = (
            Readings(now.position, before.position, now.torque, now.force),
            self._drive, self._breakaway, self._loaded, period,
        )  # fmt: skip
        self._follow = specialised(follow, *self._readings)
        for joint in range(len(JOINTS)):
            release(self._drive, joint)
        #: For each ankle joint: rotation vector by which its shank has turned while the encoder reading was constant [rad].
        #: Shape (4, 3). The rotation vector of an ankle joint is 0 while its foot is not on the ground.
        self._turn = np.zeros((len(_ANKLES), 3))
        self._to_joint: Vector = robot.polarity / robot.gear
        self._low_stop, self._high_stop = robot.position_min + AT_STOP, robot.position_max - AT_STOP
        #: Finding of each stuck encoder at its last check, by joint index.
        self.encoders: dict[int, Finding] = {}
        #: Indices of the IMUs with a frozen gyro.
        self.imus: list[int] = []
        #: (foot, cell) of each frozen force cell.
        self.cells: list[tuple[int, int]] = []

    def sample(self, whole: bool) -> bool:
        """Take a sample of all signals and compare it with the previous sample.

        Args:
            whole: True if the values of all rows are of this cycle. If False, the ages in the process image are used.

        Returns:
            Whether any signal has been constant for too long. A constant encoder alone is not a finding, see the module
            docstring.
        """
        same, repeats = self._same, self._repeats
        np.equal(self._values, self._sampled, same)
        newer = None if whole else self._newer()
        if newer is None:
            repeats += 1
            repeats *= same
            self._sampled_age.fill(0)
        else:
            np.copyto(repeats, (repeats + 1) * same, where=newer)
        if self._encoders_same.tobytes() != self._no_encoder:
            self._follow_shanks(newer)
        if newer is None:
            self._sampled[:] = self._values
        else:
            np.copyto(self._sampled, self._values, where=newer)
        over: bool = (repeats >= self._limit).tobytes() != self._none_over
        if over or self.encoders or self.imus or self.cells:
            self._check()
        return over

    def _newer(self) -> npt.NDArray[np.bool_]:
        """Return which signals have a newer value than their last sample, and update the ages of the samples."""
        self._sampled_age += self._every
        newer = self._age < self._sampled_age
        np.copyto(self._sampled_age, self._age, where=newer)
        return newer[self._row_of]

    def _follow_shanks(self, newer: npt.NDArray[np.bool_] | None) -> None:
        """Integrate how far each shank rotates while the encoder reading of its ankle joint is constant.

        A row of `_turn` is reset to 0 if the encoder reading has changed, if the foot is not on the ground, or if the foot has
        sent no new forces. Without new values of its gyro, a shank is assumed to be at rest.

        Args:
            newer: for each signal, whether it has a newer value than its last sample; None if all signals have one.
        """
        on_ground = self._now.force[:, :, 2].sum(axis=1) > self._loaded
        rate = self._now.gyro
        if newer is not None:
            on_ground &= newer[self._force].reshape(len(FEET), -1).all(axis=1)
            rate = rate * newer[self._gyro].reshape(len(IMUS), -1)
        self._turn += rate[_SHANK_OF] * self._interval
        self._turn[~on_ground[_FOOT_OF] | (self.constant_samples[_ANKLES] <= 1)] = 0.0

    def follow(self) -> bool:
        """Update the `Drive` record of all joints. All joints must have good values of this and the last cycle.

        Returns:
            Whether the list of encoders that are stuck under a large torque has changed.
        """
        return (self._follow(*self._readings) or bool(self._driven)) and self.check_driven()

    def follow_joint(self, joint: int, cycles: int) -> None:
        """Update the `Drive` record of one joint, see `follow_one`.

        Args:
            joint: index of the joint in JOINTS.
            cycles: time from the joint's last good values to the new values [cycles].
        """
        foot = _FOOT_OF_JOINT[joint]
        if foot >= 0 and self._age[self._foot_rows[foot]] > _FORCES_VALID:
            release(self._drive, joint)
        elif cycles > 0:
            readings, drive, breakaway, loaded, period = self._readings
            follow_one(joint, readings, drive, float(breakaway[joint]), (loaded, cycles * period))

    def check_driven(self) -> bool:
        """Update the list of encoders that are stuck under a large torque, and return whether it has changed."""
        driven = np.flatnonzero((self._drive.turn >= _DRIVEN) & self._free()).tolist()
        if driven == self._driven:
            return False
        self._driven = driven
        self.encoders.update((joint, self._stuck(joint)) for joint in driven)
        return True

    def _free(self) -> npt.NDArray[np.bool_]:
        """Return whether each joint is away from its end stops, shape (12,)."""
        angle = self._now.position * self._to_joint
        return (angle > self._low_stop) & (angle < self._high_stop)

    def _check(self) -> None:
        pushed = self._drive.high - self._drive.low >= self._breakaway
        pushed[_ANKLES] |= np.linalg.norm(self._turn, axis=1) >= _TURN
        stuck = (self.constant_samples >= self._to_stuck) & pushed & self._free()
        stuck[self._driven] = True
        self.encoders = {joint: self._stuck(joint) for joint in np.flatnonzero(stuck).tolist()}
        frozen = (self._gyros.reshape(len(IMUS), 3) >= self._to_freeze).all(axis=1)
        self.imus = np.flatnonzero(frozen).tolist()
        dead = (self._cells.reshape(len(FEET), len(CELLS), 3) >= self._to_freeze).any(axis=2)
        self.cells = [(foot, cell) for foot, cell in np.argwhere(dead).tolist()]

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the standstill checks."""
        return (
            *self.encoders.values(),
            *map(_frozen_imu, self.imus),
            *(_frozen_cell(foot, cell, float(self._now.force[foot, cell, 2])) for foot, cell in self.cells),
        )

    def _stuck(self, joint: int) -> Finding:
        swing = float(self._drive.high[joint] - self._drive.low[joint])
        if swing < self._breakaway[joint]:
            turn = float(np.linalg.norm(self._turn[_ANKLES.index(joint)]))
            text = (
                f"the encoder of {JOINTS[joint]} has a constant reading while the shank turns by {np.degrees(turn):.1f} "
                "degrees over the foot on the ground"
            )
            return Finding(Dtc.ENC_STUCK, JOINT_NODES[joint], turn, True, text)
        text = f"the encoder of {JOINTS[joint]} has a constant reading while the torque varies by {swing:.0f} Nm"
        return Finding(Dtc.ENC_STUCK, JOINT_NODES[joint], swing, True, text)


def follow(readings: Readings, drive: Drive, breakaway: Vector, loaded: float, period: float) -> bool:
    """Update the `Drive` record of all joints by one cycle, see `follow_one`.

    Args:
        readings: signals of the cycle.
        drive: record of all joints. Updated here.
        breakaway: change of torque that moves each joint, shape (12,) [Nm].
        loaded: vertical force above which a foot is on the ground [N].
        period: cycle time [s].

    Returns:
        Whether a large torque should have changed a constant reading.
    """
    driven = False
    for joint in range(len(breakaway)):
        follow_one(joint, readings, drive, breakaway[joint], (loaded, period))
        driven = driven or drive.turn[joint] >= _DRIVEN
    return driven


def follow_one(joint: int, readings: Readings, drive: Drive, breakaway: float, limits: tuple[float, float]) -> None:
    """Update the `Drive` record of one joint.

    The record is cleared if the encoder reading has changed, or if the joint is an ankle whose foot is on the ground. Otherwise
    the torque of this cycle extends the torque range, and the simulated motion continues by the time since the last values.

    Args:
        joint: index of the joint in JOINTS.
        readings: signals of the cycle.
        drive: record of all joints. Updated here.
        breakaway: change of torque that moves the joint [Nm].
        limits: vertical force above which a foot is on the ground [N], and time since the last values of the joint [s].
    """
    loaded, time = limits
    foot, on_ground = _FOOT_OF_JOINT[joint], False
    if foot >= 0:
        force = readings.force[foot]
        on_ground = force[0, 2] + force[1, 2] + force[2, 2] + force[3, 2] > loaded
    # The ankles of a foot on the ground may stand still despite a torque, see the module docstring.
    if on_ground or readings.position[joint] != readings.before[joint]:
        release(drive, joint)
        return
    torque = readings.torque[joint]
    drive.low[joint], drive.high[joint] = min(drive.low[joint], torque), max(drive.high[joint], torque)
    drive.cycles[joint] += 1.0
    if drive.cycles[joint] <= _AT_REST:
        drive.rest[joint] = torque
    beyond = abs(torque - drive.rest[joint]) - breakaway
    drive.momentum[joint] = max(0.0, drive.momentum[joint] + beyond * time)
    drive.turn[joint] += drive.momentum[joint] / _INERTIA * time


def release(drive: Drive, joint: int) -> None:
    """Clear the `Drive` record of a joint.

    Call this if the encoder reading of the joint has changed, or if the joint is an ankle whose foot is on the ground.

    Args:
        drive: record of all joints. Updated here.
        joint: index of the joint in JOINTS.
    """
    drive.low[joint], drive.high[joint] = np.inf, -np.inf
    drive.cycles[joint] = drive.momentum[joint] = drive.turn[joint] = 0.0


def _frozen_imu(imu: int) -> Finding:
    text = f"the gyro of the {IMUS[imu]} IMU has had a constant reading for {FROZEN_CYCLES} cycles"
    return Finding(Dtc.IMU_STUCK, IMU_NODES[imu], float(FROZEN_CYCLES), True, text)


def _frozen_cell(foot: int, cell: int, force: float) -> Finding:
    text = f"force cell {CELLS[cell]} of the {FEET[foot]} foot has a constant reading of {force:.0f} N"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], force, True, text)
