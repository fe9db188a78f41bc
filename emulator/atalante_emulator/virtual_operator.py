"""Virtual operator behind a robot on the ground: steadies the pelvis with a bounded horizontal force.

The operator acts only if the pelvis leans by more than `DEADBAND`. Every intervention is recorded and logged, because a walk with
interventions is not a walk of the robot alone.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_emulator.bodies import PELVIS, Body
from atalante_hal.types import PERIOD, Vector

_log = logging.getLogger(__name__)

#: Largest lean of the pelvis at which the operator exerts no force [rad]. A walking robot leans less than `DEADBAND`.
DEADBAND: Final = 0.1
STIFFNESS: Final = 2000.0  # force divided by (lean - `DEADBAND`) [N/rad]
DAMPING: Final = 300.0  # force per lean rate [N s/rad]
#: Longest time from a cycle with a force to the next cycle with a force in the same intervention [cycles].
_PAUSE: Final = 200


@dataclass
class Intervention:
    """Interval in which the virtual operator exerted a force."""

    start: int  # first cycle with a force; the first call of the operator is cycle 0
    end: int  # last cycle with a force
    largest: float  # largest force [N]
    impulse: float  # integral of the magnitude of the force [N s]


class VirtualOperator:
    """Virtual person who steadies the pelvis. The emulator calls the operator once per control cycle (1 ms)."""

    def __init__(self, body: Body, most: float) -> None:
        """Connect the operator to a body.

        Args:
            body: robot with a free pelvis.
            most: largest force [N].

        Raises:
            ValueError: If the largest force is not positive.
        """
        if not most > 0.0:
            raise ValueError(f"the largest force of the virtual operator must be above 0 N, got {most!r}")
        self._body, self._most, self._cycle = body, most, 0
        self._wrench = np.zeros(6)
        #: All interventions so far.
        self.interventions: list[Intervention] = []

    def __call__(self, hal_state: int) -> Vector:
        """Return force [N] and moment [Nm] on the pelvis, in world axes, shape (6,).

        Args:
            hal_state: ignored.
        """
        motion = self._body.motion(PELVIS)
        x, y, z, w = motion.attitude
        up = np.array([2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)])
        lean, rate = up[:2], np.cross(motion.rate, up)[:2]
        size = float(np.hypot(*lean))
        force = np.zeros(2)
        if size > DEADBAND:
            force = -STIFFNESS * (1.0 - DEADBAND / size) * lean - DAMPING * rate
            force *= min(1.0, self._most / max(float(np.hypot(*force)), 1e-9))
            self._record(float(np.hypot(*force)))
        self._wrench[:2] = force
        self._cycle += 1
        return self._wrench

    def _record(self, force: float) -> None:
        cycle, past = self._cycle, self.interventions
        if not past or cycle - past[-1].end > _PAUSE:
            past.append(Intervention(cycle, cycle, 0.0, 0.0))
            _log.info("the virtual operator holds the robot from cycle %d on", cycle)
        last = past[-1]
        last.end, last.largest, last.impulse = cycle, max(last.largest, force), last.impulse + force * PERIOD
