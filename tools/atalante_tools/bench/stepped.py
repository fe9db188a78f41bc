"""Simulation of the tracking errors of hip and knee, cycle by cycle. The guide filter predicts the same errors from tables.

The simulation is the reference for a check of the tables, and the baseline of the benchmark `filter_tick`.

This module is not part of the control loop. It simulates the control loop with the backup policy (`guide.backup_policy`) as
controller, cycle by cycle. The simulated loop includes the delay of the command by one cycle, the motor, the leg, and the
low-pass filter of the measured velocity.
"""

from __future__ import annotations

import numpy as np

from atalante_control.guide.filter import GuideFilter
from atalante_hal.types import PERIOD, Vector


class SteppedRollout:
    """Simulation of the tracking errors of hip and knee. A guide filter predicts the same errors from tables."""

    def __init__(self, guide: GuideFilter) -> None:
        """Copy the gains of the backup policy, and the coefficients of the motor and of the velocity filter.

        Args:
            guide: guide filter whose prediction is simulated cycle by cycle.
        """
        self._stiffness, self._damping = guide.prediction.policy.gains()
        loop = guide.prediction.assumptions.loop
        self._keep, self._tracking = loop.keep, loop.tracking
        self._cycles = len(guide.prediction.ahead)

    def errors(self, state: Vector) -> Vector:
        """Simulate all cycles of the prediction horizon without disturbances, and return the tracking errors.

        Row k has the errors of hip and knee k cycles from now. Shape (cycles, 2) [rad].

        Args:
            state: state of the sampled loop, see `backup_policy`, shape (10,).
        """
        e, rate, measured, motor, command = state.reshape(5, 2)
        errors = np.empty((self._cycles, 2))
        for cycle in range(self._cycles):
            errors[cycle] = e
            following = -self._stiffness @ e - self._damping @ measured
            motor = motor + self._tracking * (command - motor)
            moved = PERIOD * (rate + 0.5 * PERIOD * motor)
            e, rate = e + moved, rate + PERIOD * motor
            measured = self._keep * measured + (1.0 - self._keep) / PERIOD * moved
            command = following
        return errors
