"""Step-by-step integration of the rollouts of the virtual guide, as reference and baseline of the exact flow.

This module is not part of the control loop. It integrates all four rollouts (two joints, two extreme disturbances) over the
horizon grid of the guide filter. The exact discretisation of each grid interval is computed in advance. All rollouts are
integrated together, which needs the fewest numpy operations per interval.
"""

from __future__ import annotations

import numpy as np

from atalante_control.gait.gait import PERIOD
from atalante_control.guide.filter import GuideFilter
from atalante_hal.types import Vector


class SteppedRollouts:
    """Step-by-step integration of the rollouts of a guide filter. The backup policies must be monotone and not saturated."""

    def __init__(self, guide: GuideFilter) -> None:
        """Copy grid, gains and disturbance bounds of the guide filter.

        Args:
            guide: guide filter whose rollouts are integrated.
        """
        self._guide = guide
        config = guide.config
        lengths = np.arange(guide.stride + 1, dtype=np.float64) * PERIOD
        joints = [0, 0, 1, 1]
        self._phi = np.stack([config.policies[j].transition(lengths) for j in joints], axis=3)
        # The columns are the rollouts of the hip with its largest and its smallest disturbance, then the same for the knee.
        extremes = [config.disturbance[j][side] for j, side in zip(joints, (1, 0, 1, 0), strict=True)]
        self._push = np.stack(
            [config.policies[j].step_response(lengths) * u for j, u in zip(joints, extremes, strict=True)], axis=2
        )
        self._sign = np.array([1.0, -1.0, 1.0, -1.0])
        self.start_step()

    def start_step(self) -> None:
        """Update the particular solution P for a new walking step. Call it after `GuideFilter.start_step`."""
        guide = self._guide
        self._p = guide.solution()[:, [[0, 0, 2, 2], [1, 1, 3, 3]]]
        interval = self._p[guide.grid]
        carried = np.einsum("abr,nbr->nar", self._phi[guide.stride], interval[:-1])
        self._added = interval[1:] - carried + self._push[guide.stride]

    def rollouts(self, cycle: int, e_hip: float, ed_hip: float, e_knee: float, ed_knee: float) -> Vector:
        """Return the rollouts of both joints, as `GuideFilter.rollouts` does.

        Args:
            cycle: cycle of the walking step, from 0.
            e_hip: tracking error of the hip [rad].
            ed_hip: rate of the tracking error of the hip [rad/s].
            e_knee: tracking error of the knee [rad].
            ed_knee: rate of the tracking error of the knee [rad/s].

        Returns:
            Rollouts of hip and knee for both disturbance extremes, shape (4, n) [rad].
        """
        guide = self._guide
        first = int(np.searchsorted(guide.grid, cycle))
        lag = int(guide.grid[first]) - cycle
        state = np.array([[e_hip, e_hip, e_knee, e_knee], [ed_hip, ed_hip, ed_knee, ed_knee]])
        phi = self._phi[lag]
        state = (phi * (state - self._p[cycle])).sum(axis=1) + self._p[guide.grid[first]] + self._push[lag]
        e, ed = state
        (phi00, phi01), (phi10, phi11) = self._phi[guide.stride]
        errors = np.empty((len(guide.grid) - first, 4))
        errors[0] = e
        for i, (added, added_rate) in enumerate(self._added[first:], start=1):
            e, ed = phi00 * e + phi01 * ed + added, phi10 * e + phi11 * ed + added_rate
            errors[i] = e
        return np.asarray((errors * self._sign).T)
