"""Desired joint trajectories of the airwalk controller: first a start motion, then one trajectory for each step.

`gait, measured pose at the stance change -> row (q_des, q_des') of each cycle`

In a step, q_des = q_nom + s. q_nom is the nominal trajectory of the gait. The offset s begins with the measured deviation from
q_nom at the stance change, and then fades out to zero (re-centring).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from atalante_control.gait.gait import Gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.joint.pid import LEFT, RIGHT
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.types import PERIOD, Vector

_N, _LEG, _SA = len(JOINTS), len(LEG_JOINTS), LEG_JOINTS.index("SA")


class Deviation(NamedTuple):
    """Deviation at the start of a step: measured angles and speeds minus nominal angles and speeds."""

    angle: Vector  # (12,) rad, s(0) = q - q_nom
    rate: Vector  # (12,) rad/s, s'(0) = q' - q_nom'


class GaitReference:
    """Desired trajectory of right-stance and left-stance steps, sampled at every cycle.

    Attributes:
        nominal: stance leg (LEFT or RIGHT) -> rows (q_nom, q_nom') of the step, shape (n + 1, 24).
    """

    def __init__(self, gait: Gait, deadbeat: Deadbeat, ankle_offset: float) -> None:
        """Tabulate both steps, and the cubics that lead from the measured motion back to the nominal gait.

        Args:
            gait: right-stance step that repeats.
            deadbeat: re-centring, which computes the cubics.
            ankle_offset: angle added to both sagittal ankles [rad].
        """
        self.nominal: dict[int, Vector] = {}
        for stance, step in ((LEFT, gait.mirrored()), (RIGHT, gait)):
            table = step.tables()
            rows = np.hstack([table.q, table.qd])
            rows[:, [_SA, _LEG + _SA]] += ankle_offset
            self.nominal[stance] = rows
        self._rows = {stance: rows.copy() for stance, rows in self.nominal.items()}
        time: Vector = np.arange(gait.cycles + 1, dtype=np.float64) * PERIOD
        (c0, c1), (c0d, c1d), _ = deadbeat.basis(time)
        end = self._end = int(np.searchsorted(time, deadbeat.end))
        #: (2, cycles, 24) offset s from q_nom (columns 0 to 11) and rate s' (columns 12 to 23) in each cycle of the re-centring.
        #: Element 0 begins with s(0) = 1 rad and s'(0) = 0, element 1 with s(0) = 0 and s'(0) = 1 rad/s.
        self._basis = np.zeros((2, end, 2 * _N))
        self._basis[0, :, :_N], self._basis[0, :, _N:] = c0[:end, None], c0d[:end, None]
        self._basis[1, :, :_N], self._basis[1, :, _N:] = c1[:end, None], c1d[:end, None]
        self._added = np.zeros_like(self._basis)
        # `_angles` holds the angle deviations of the 12 joints at time 0 twice: for their effect on angles, then on speeds.
        # `_rates` holds the speed deviations of the 12 joints at time 0 twice, in the same order.
        self._angles, self._rates = np.zeros(2 * _N), np.zeros(2 * _N)

    def start_step(self, stance: int, position: Vector, velocity: Vector) -> Deviation:
        """Start a step with a desired trajectory that begins at the measured motion and returns to the nominal gait.

        Args:
            stance: stance leg of the new step, LEFT or RIGHT.
            position: measured angles at the stance change, shape (12,) [rad].
            velocity: measured speeds at the stance change, shape (12,) [rad/s].

        Returns:
            Deviation of the measured motion from the nominal start of the step, overwritten by the next call.
        """
        nominal, angles, rates, added = self.nominal[stance], self._angles, self._rates, self._added
        np.subtract(position, nominal[0, :_N], out=angles[:_N])
        np.subtract(velocity, nominal[0, _N:], out=rates[:_N])
        angles[_N:], rates[_N:] = angles[:_N], rates[:_N]
        np.multiply(self._basis[0], angles, out=added[0])
        np.multiply(self._basis[1], rates, out=added[1])
        np.add(added[0], added[1], out=added[0])
        np.add(nominal[: self._end], added[0], out=self._rows[stance][: self._end])
        return Deviation(angles[:_N], rates[:_N])

    def row(self, stance: int, cycle: int) -> Vector:
        """Return q_des [rad], then q_des' [rad/s] of a cycle, shape (24,). The caller must not change the array.

        Args:
            stance: stance leg, LEFT or RIGHT.
            cycle: number of cycles since the stance change.
        """
        row: Vector = self._rows[stance][cycle]
        return row


class StartMotion:
    """Trajectory from rest at the measured pose to the first pose and speed of the gait: the sum of two quintics.

    The first quintic leads to the first pose, and ends at rest. The second quintic leads to the speed of the gait: in the last
    `RUN_UP` seconds, it moves each joint back by up to 0.1 s times this speed, and forwards again.

    Attributes:
        cycles: duration in cycles. If a joint would move too fast in the configured duration, see `SPEED_SHARE`, the duration is
            longer than configured.
    """

    #: Largest speed of a joint in the first quintic, as a fraction of the velocity limit of the joint.
    SPEED_SHARE = 0.5
    #: Duration of the second quintic [s], in which each joint moves back and then forwards to reach the speed of the gait.
    #: The angle of the backward motion is proportional to the duration.
    #: If the second quintic took much longer, joints would move back beyond their position limits.
    RUN_UP = 0.5
    #: Largest slope of the quintic 10 x^3 - 15 x^4 + 6 x^5 for x from 0 to 1.
    _STEEPEST = 1.875

    def __init__(self, first: Vector, duration: float, velocity_max: Vector) -> None:
        """Set end pose, end speed and shortest duration.

        Args:
            first: first row (q_nom, q_nom') of the gait, shape (24,) [rad, rad/s].
            duration: shortest duration of the motion [s].
            velocity_max: velocity limits of the joints, shape (12,) [rad/s].
        """
        self._first, self._shortest, self._speed_max = first, duration, self.SPEED_SHARE * velocity_max
        self._pose, self._row = np.zeros(_N), np.zeros(2 * _N)
        self.cycles = round(duration / PERIOD)

    def start(self, position: Vector) -> None:
        """Start the motion at the measured pose.

        Args:
            position: measured angles, shape (12,) [rad]; copied.
        """
        self._pose[:] = position
        needed = float(np.max(np.abs(self._first[:_N] - position) / self._speed_max)) * self._STEEPEST
        self.cycles = max(round(self._shortest / PERIOD), math.ceil(needed / PERIOD))

    def row(self, cycle: int) -> Vector:
        """Return q_des [rad], then q_des' [rad/s] of a cycle, shape (24,), overwritten by the next call.

        Args:
            cycle: cycles since `start`, below `cycles`.
        """
        row, duration = self._row, self.cycles * PERIOD
        gap, speed = self._first[:_N] - self._pose, self._first[_N:]
        x = cycle / self.cycles
        row[:_N] = self._pose + gap * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
        row[_N:] = gap * (30.0 * x * x * (1.0 - x) ** 2 / duration)
        run_up = min(self.RUN_UP, duration)
        y = 1.0 - (self.cycles - cycle) * PERIOD / run_up
        if y > 0.0:
            row[:_N] += speed * (run_up * y**3 * (-4.0 + 7.0 * y - 3.0 * y * y))
            row[_N:] += speed * (y * y * (-12.0 + 28.0 * y - 15.0 * y * y))
        return row
