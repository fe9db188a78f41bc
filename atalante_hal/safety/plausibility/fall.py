"""Fall check: torso IMU and pelvis IMU show that the trunk leans so far that the robot has fallen.

A robot that leans by more than `FALLEN` cannot regain its balance. The check runs in every state, so a robot that lies on the
ground is not READY and cannot be started.
"""

from __future__ import annotations

import math

from atalante_hal.dbc_names import IMU_NODES
from atalante_hal.robot import IMUS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.inertial import upward
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.wire.process_image import NEVER

#: Lean of the trunk above which the robot has fallen [rad].
FALLEN = math.radians(35.0)
_PELVIS = IMUS.index("pelvis")
_TRUNK = IMUS.index("torso"), _PELVIS


class Fall:
    """Check whether the robot has fallen.

    A single faulty IMU causes no finding: if the values of both trunk IMUs are usable, both must show the lean. If only one has
    usable values, it decides. The finding is confirmed if two evaluations in a row show the lean.

    Args:
        now: signals decoded in this cycle.
    """

    def __init__(self, now: Signals) -> None:
        self._quaternion = now.quaternion
        self._found: tuple[Finding, ...] = ()

    def evaluate(self, ages: Ages | None) -> bool:
        """Check the lean of the trunk.

        Args:
            ages: ages of the sensor values; an IMU with values that are too old is not used. None if all values are of this
                cycle.

        Returns:
            Whether the trunk leans too far.
        """
        usable = [imu for imu in _TRUNK if ages is None or ages.imu[imu] < NEVER]
        upright = max((upward(self._quaternion[imu])[2] for imu in usable), default=1.0)
        if upright < math.cos(FALLEN):
            self._found = (_fallen(upright, confirmed=bool(self._found)),)
        else:
            self._found = ()
        return bool(self._found)

    def findings(self) -> tuple[Finding, ...]:
        """Return the finding about a fall, if there is one."""
        return self._found


def _fallen(upright: float, *, confirmed: bool) -> Finding:
    lean = math.acos(max(-1.0, upright))
    text = f"the robot has fallen: its trunk leans by {math.degrees(lean):.0f} degrees"
    return Finding(Dtc.FALLEN, IMU_NODES[_PELVIS], lean, confirmed, text)
