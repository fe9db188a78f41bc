"""Schedule of the plausibility checks in each cycle.

    process image -> one slow check in turn (standstill, velocity, feet, legs, support, soles, inertial, fall, `Unchecked`)
    -> jump, range, IMUs, trunk, knees -> state

Each cycle checks the encoders and the IMUs, and runs at most one slow check. If the new values of a joint or an IMU fail a
check, they are rejected: the process image keeps the previous values, and the age of these values grows. Only the signals in
`signals.JUDGED` are rejected, so state, temperature and torque of a drive are still updated. If the drive is off, all signals
of its frame are rejected, so a start waits until its values are accepted. The module `rejections` confirms the diagnostic if
more than a fifth of the values of a sensor are rejected. Each check uses only the messages that it needs, and the ages of their
values. So a fault of one message does not disable the checks of other messages.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from atalante_hal.dbc_names import IMU_NODES, JOINT_NODES
from atalante_hal.robot import IMUS, JOINTS, LEG_JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.encoders import EncoderChecks
from atalante_hal.safety.plausibility.fall import Fall
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.imus import IMU_CYCLES, Imus
from atalante_hal.safety.plausibility.inertial import Inertial
from atalante_hal.safety.plausibility.knees import KNEE_IMUS, KNEE_JOINTS, Knees
from atalante_hal.safety.plausibility.legs import Legs
from atalante_hal.safety.plausibility.rejections import Rejections
from atalante_hal.safety.plausibility.signals import Ages, Rows, judged, signals_of
from atalante_hal.safety.plausibility.soles import Soles
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.safety.plausibility.support import Support
from atalante_hal.safety.plausibility.trunk import Trunk
from atalante_hal.safety.plausibility.unchecked import Unchecked
from atalante_hal.types import Vector
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER, ReceiveImage

#: Interval of the foot checks [cycles].
FEET = 4
#: Interval of the standstill check, of the velocity check, of the fall check and of the monitor `Unchecked` [cycles].
#: `Unchecked` reports checks that could not run, because their messages contain no usable values.
SLOW = 16
#: Period of the schedule of all slow checks [cycles]. Each leg, each sole and the support are checked once per period.
_PERIOD = 32
#: Intervals between the inertial checks [cycles], used alternately.
#: Both intervals are odd, so an inertial check in an even cycle is followed by one in an odd cycle, and so on.
#: Reason: a vibration at half the sampling rate of the IMUs changes its sign in each cycle, so it cancels in the means.
_INERTIAL_INTERVALS = (15, 17)
#: Largest age of values that the trunk check uses [cycles].
#: A node that always answers one cycle late has values of age 1. The trunk check accepts this age.
_LATE = 1
#: Largest age of a value that the knee checks use [cycles]. If a value is older, the filters of the knee checks restart.
_HELD = 4
_FRESH = int(Check.SOME_LOST)
#: States of a drive that is off.
_OFF = (
    DriveState.NOT_READY_TO_SWITCH_ON,
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY_TO_SWITCH_ON,
    DriveState.SWITCHED_ON,
)
#: Indices in JOINTS of SH and SK.
_HIPS_AND_KNEES = frozenset(joint for joint, name in enumerate(JOINTS) if name.endswith(("SH", "SK")))


class Plausibility:
    """Plausibility checks of the decoded values in the process image.

    Args:
        robot: limits and sensor thresholds of the robot.
        image: process image of the cyclic sensor messages; implausible values are rejected there.
        period: cycle time [s].

    Attributes:
        findings: current findings; the tuple is replaced only when the findings change.
        encoder_error: encoder angle of each joint minus its angle from the IMUs, shape (12,) [rad], see `Legs`.
    """

    def __init__(self, robot: Robot, image: ReceiveImage, period: float) -> None:
        self._image = image
        codec = image.codec
        now, before = signals_of(codec, image.values), signals_of(codec, image.values_before)
        self._force = now.force
        self._encoders = EncoderChecks(robot, now, before, period, SLOW)
        self._imus = Imus(robot, codec, now)
        self._stillness = Stillness(robot, image, now, before, SLOW, period)
        self._legs = Legs(robot, now, self._stillness.constant_samples, period)
        self.encoder_error = self._legs.encoder_error
        self._feet = FootChecks(robot, now, FEET)
        self._support = Support(robot, now, _PERIOD)
        self._soles = Soles(robot, now)
        self._inertial = Inertial(robot, now, self._imus.limits, _INERTIAL_INTERVALS, period)
        self._trunk = Trunk(now, period)
        self._fall = Fall(now)
        self._knees = Knees(robot, now, self._legs.heading, self._legs.tilt, period)
        self._rows = Rows(codec)
        self._trunk_rows = self._rows.imu[[IMUS.index("torso"), IMUS.index("pelvis")]]
        self._knee_rows = np.concatenate((self._rows.joint[KNEE_JOINTS], self._rows.imu[KNEE_IMUS]))
        self._rejections = Rejections()
        self._unchecked = Unchecked(self._rows, image.check, SLOW)
        self._joint_rows, self._imu_rows = self._rows.joint.tolist(), self._rows.imu.tolist()
        #: For each row of a joint or an IMU in the process image: indices of the signals that are rejected together.
        self._judged = {row: judged(codec, row) for row in (*self._joint_rows, *self._imu_rows)}
        #: For each row of a joint in the process image: indices of all its signals, and index of its drive state.
        self._whole = {row: np.flatnonzero(codec.row_of == row) for row in self._joint_rows}
        self._drive_state = {row: codec.index(codec.messages[row].name, "DriveState") for row in self._joint_rows}
        self._foot_ages = [NEVER] * len(self._rows.foot)  # age of the values of each foot at its last check [cycles]
        #: For each row of a joint or an IMU in the process image: cycle in which its last good values were measured.
        #: Not updated while `_settled` is True. Then the last good values of all rows are from the previous cycle.
        self._measured = dict.fromkeys((*self._joint_rows, *self._imu_rows), -NEVER)
        #: Measured force of each faulty cell, by (foot, cell), shape (3,) [N]. In the process image, this force is set to 0.
        self._measured_forces: dict[tuple[int, int], Vector] = {}
        self._settled = False  # True if all joints and IMUs had good and new values in the previous cycle
        self._turns = self._build_turns()
        self._cycle = 0
        self.findings: tuple[Finding, ...]
        #: `findings` before the last call of `_check_rows`. If `findings` has changed, the next cycle calls `_check_rows` again.
        self._evaluated: tuple[Finding, ...]
        self.findings = self._evaluated = ()

    def _build_turns(self) -> list[Callable[[Ages | None], bool] | None]:
        """Return the slow check for each cycle of the schedule period; None for a cycle without a slow check.

        Each check is called with the ages of the sensor values, or with None if all values are of this cycle. The
        return value states whether the check has findings.
        """
        turns: list[Callable[[Ages | None], bool] | None] = [None] * _PERIOD
        turns[0::SLOW] = [self._sample] * (_PERIOD // SLOW)
        turns[2::SLOW] = [self._check_velocity] * (_PERIOD // SLOW)
        turns[4::SLOW] = [self._check_unchecked] * (_PERIOD // SLOW)
        turns[6] = self._support.evaluate
        turns[14::SLOW] = [self._check_fall] * (_PERIOD // SLOW)
        turns[12] = turns[12 + _INERTIAL_INTERVALS[0]] = self._check_inertial
        turns[1::FEET] = [self._check_feet] * (_PERIOD // FEET)
        turns[8], turns[24] = self._legs.check_left, self._legs.check_right
        turns[10], turns[26] = self._soles.check_left, self._soles.check_right
        return turns

    def check(self) -> tuple[Finding, ...]:
        """Run the checks of one cycle. Call this after the process image has accepted the frames of the cycle.

        Returns:
            The current findings.
        """
        fresh = self._image.all_fresh
        if self._measured_forces:
            self._restore_cells()
        turn = self._turns[self._cycle % _PERIOD]
        if turn is not None and (turn(None if fresh else self._rows.ages(self._image.age)) or self.findings):
            self._collect()
        settled = fresh and self._settled and self.findings is self._evaluated and not self._rejections.pending
        if settled and self._encoders.within_reach() and self._imus.usable():
            self._encoders.follow()
            changed = self._stillness.follow(), self._trunk.follow(), self._knees.follow()
            if any(changed):
                self._collect()
        else:
            self._evaluated = self.findings
            self._check_rows()
            if (self._image.age[self._trunk_rows] <= _LATE).all():
                self._trunk.follow()
            # The values of a saturated IMU are rejected, so a part of an impact is missing in the sums of the knee checks.
            clipped = not self._imus.saturated.keys().isdisjoint(KNEE_IMUS)
            if not clipped and (self._image.age[self._knee_rows] <= _HELD).all():
                self._knees.follow()
            else:
                self._knees.restart()
            self._collect()
        if self.findings:
            self._set_faulty_cells_to_zero()
        self._cycle += 1
        return self.findings

    def reference(self, node: str) -> None:
        """Adapt the checks to the restart of a drive or an IMU.

        Skip the jump check for the next position of a joint whose drive has referenced its encoder.
        Also discard the finding that the encoders of this joint are exchanged between the legs. If the joint is SH or SK,
        also discard the finding of the knee checks about its leg. The heading of a restarted IMU is measured again. If it
        is an IMU of the knee checks, their filters restart.

        Args:
            node: DBC name of the drive or the IMU; the name of any other node has no effect.
        """
        if node in IMU_NODES:
            imu = IMU_NODES.index(node)
            self._legs.restart_heading(imu)
            if imu in KNEE_IMUS:
                self._knees.restart()
        if node not in JOINT_NODES:
            return
        if self._settled:
            self._measured.update(dict.fromkeys(self._measured, self._cycle - 1))
            self._settled = False
        joint = JOINT_NODES.index(node)
        self._encoders.reference(joint)
        self._rejections.forget(joint)
        self._legs.reference(joint)
        if joint in _HIPS_AND_KNEES:
            self._knees.reference(joint // len(LEG_JOINTS))
        self._measured[self._joint_rows[joint]] = -NEVER

    @property
    def swing(self) -> int | None:
        """Return the index of the swing leg in FEET if exactly one foot is on the ground, otherwise None."""
        return self._feet.swing

    @property
    def implausible_imus(self) -> frozenset[int]:
        """Return the indices in IMUS of the IMUs that contradict gravity or their own attitude, see `Inertial.implausible`."""
        return self._inertial.implausible

    def _sample(self, ages: Ages | None) -> bool:
        return self._stillness.sample(ages is None)

    def _check_velocity(self, ages: Ages | None) -> bool:
        return self._encoders.check_velocity(None if ages is None else ages.joint)

    def _check_unchecked(self, ages: Ages | None) -> bool:
        return self._unchecked.evaluate(None if ages is None else self._image.age)

    def _check_inertial(self, ages: Ages | None) -> bool:
        # The values of an IMU with a frozen gyro are rejected later in this cycle. Here they are marked as too old.
        if frozen := self._stillness.imus:
            ages = ages or self._rows.ages(self._image.age)
            ages.imu[frozen] = NEVER
        return self._inertial.evaluate(ages)

    def _check_fall(self, ages: Ages | None) -> bool:
        # An IMU whose values are lost or rejected must not hide a fall. Here its values are marked as too old.
        if not self._settled:
            ages = ages or self._rows.ages(self._image.age)
            good = np.array([self._measured[row] for row in self._imu_rows])
            ages.imu[self._cycle - good > IMU_CYCLES] = NEVER
        return self._fall.evaluate(ages)

    def _check_feet(self, ages: Ages | None) -> bool:
        now = [0] * len(self._foot_ages) if ages is None else ages.foot.tolist()
        # A foot is checked only if it has new values since its last check. The age of values that are too old is `NEVER`.
        left, right = (age < min(before + FEET, NEVER) for age, before in zip(now, self._foot_ages, strict=True))
        self._foot_ages = now
        return self._feet.evaluate((left, right))

    def _check_rows(self) -> None:
        """Check the new values of each joint and each IMU, and reject implausible values."""
        measured, cycle, image = self._measured, self._cycle, self._image
        if self._settled:
            measured.update(dict.fromkeys(measured, cycle - 1))
        checks, ages = image.check.tolist(), image.age.tolist()
        rejected: dict[int, Dtc] = {}
        for sensor, row in enumerate((*self._joint_rows, *self._imu_rows)):
            if checks[row] > _FRESH:
                continue
            at = cycle - ages[row]
            if self._accept(sensor, at - measured[row]):
                measured[row] = at
            else:
                # If the drive is off, its state is rejected, too. So a start waits until the values of the drive are accepted.
                off = row in self._whole and image.values_before[self._drive_state[row]] in _OFF
                image.refuse(row, self._whole[row] if off else self._judged[row])
                imu = sensor - len(self._joint_rows)
                dtc = self._encoders.tolerated(sensor) if imu < 0 else self._imus.tolerated(imu)
                if dtc is not None:
                    rejected[sensor] = dtc
        self._rejections.update(rejected)
        self._stillness.check_driven()
        self._settled = all(at == cycle for at in measured.values())

    def _accept(self, sensor: int, cycles: int) -> bool:
        """Return whether the new values of a sensor may be used.

        Args:
            sensor: index of a joint, or number of joints plus index of an IMU.
            cycles: time from the sensor's last good values to the new values [cycles].
        """
        imu = sensor - len(self._joint_rows)
        if imu < 0:
            accepted = self._encoders.accept(sensor, cycles)
            if accepted:
                self._stillness.follow_joint(sensor, cycles)
            return accepted
        return self._imus.accept(imu, cycles, frozen=imu in self._stillness.imus)

    def _collect(self) -> None:
        findings: tuple[Finding, ...] = (
            *self._encoders.findings(),
            *self._imus.findings(),
            *self._legs.findings(),
            *self._stillness.findings(),
            *self._feet.findings(),
            *self._support.findings(),
            *self._soles.findings(),
            *self._inertial.findings(),
            *self._trunk.findings(),
            *self._fall.findings(),
            *self._knees.findings(),
            *self._unchecked.findings(),
        )
        if often := self._rejections.findings():
            # A confirmed finding of another check describes the fault more precisely: omit the finding about rejected values.
            confirmed = {(finding.dtc, finding.node) for finding in findings if finding.confirmed}
            findings += tuple(finding for finding in often if (finding.dtc, finding.node) not in confirmed)
        if findings != self.findings:
            self.findings = findings

    def _set_faulty_cells_to_zero(self) -> None:
        """Set the force of each faulty cell in the process image to zero."""
        for cell in {*self._stillness.cells, *self._feet.cells}:
            self._measured_forces[cell] = self._force[cell].copy()
            self._force[cell] = 0.0

    def _restore_cells(self) -> None:
        """Restore the measured forces of the faulty cells, because the previous cycle has set these forces to zero.

        The foot checks need the measured forces. A foot with new values already has its measured forces.
        """
        for (foot, cell), force in self._measured_forces.items():
            if self._image.check[self._rows.foot[foot]] > _FRESH:
                self._force[foot, cell] = force
        self._measured_forces.clear()
