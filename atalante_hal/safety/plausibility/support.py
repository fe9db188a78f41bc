"""Support checks, which compare the load on each foot with the posture of the legs.

*Height.* If one foot is clearly higher than the other foot, the higher foot cannot carry load while the lower foot carries no
load. The attitude of a tibia and the angle of its knee give the height of the ankle below the hip. A foot counts as loaded if two
of its cells are loaded, as in the module `feet`. The check detects a positive offset of all cells of a foot when a suspended
robot lifts this foot, and exchanged feet in the first swing.

*Weight.* While both feet carry load, the robot moves slowly, so the leg towards which the robot leans carries more load than the
other leg. If the other leg carries clearly more load for `WEIGHT_CYCLES`, the two feet are exchanged. The exchange is detected
when the weight is first shifted, before the first step. Both feet are then on the ground, so the robot can stop in HOLD.

The height of a foot above the other foot is computed with the mean length of thigh and shank. Legs of other lengths, the ankles
and the attitude errors change the computed height by a small part of `_HEIGHT`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from atalante_hal.dbc_names import FOOT_NODES
from atalante_hal.robot import FEET, IMUS, JOINTS, SIDES, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Ages, Signals

#: Duration of a contradiction after which a foot is reported [cycles].
#: Contradiction: the foot alone carries load, but it is more than `_HEIGHT` above the other foot.
HEIGHT_CYCLES = 64
#: Duration of a contradiction after which the feet are reported as exchanged [cycles].
#: Contradiction: the robot leans away from the leg with clearly more load.
WEIGHT_CYCLES = 128
#: Mean length of a thigh or a shank [m]. The real lengths are adjusted to the patient.
SEGMENT = 0.4
#: Lateral distance of the ankles while both legs are parallel [m].
ANKLE_DISTANCE = 0.188
#: Largest height above the other foot at which a foot can carry the load alone [m].
#: In walks of eight patients, a loaded foot is at most 0.01 m above the other foot, a swinging foot up to 0.09 m.
_HEIGHT = 0.04
#: Largest lean to one side at which the load may be on either leg [rad].
#: At a larger lean, the load must not be clearly on the leg of the opposite side.
_LEAN = 0.05
#: Difference of the two loads, as a share of their sum, above which the load is clearly on one leg.
_SHARE = 0.3
_PELVIS = IMUS.index("pelvis")
_TIBIAE = [IMUS.index(f"{side}_tibia") for side in SIDES]
_KNEES = [JOINTS.index(f"{side}_SK") for side in SIDES]


class Posture(NamedTuple):
    """Posture of the legs in the world."""

    height: float  # height of the left ankle above the right ankle [m]
    lean: float  # mean lean of both shanks to the left [rad]


class Support:
    """Checks of the load on both feet.

    Args:
        robot: sensor thresholds of the robot.
        now: signals decoded in this cycle.
        every: interval between two calls of `evaluate` [cycles].
    """

    def __init__(self, robot: Robot, now: Signals, every: int) -> None:
        self._now, self._every, self._free = now, every, robot.sensors.cell_free
        self._to_joint = (robot.polarity / robot.gear)[_KNEES].tolist()
        #: For each foot: time [cycles] for which it alone has reported load while more than `_HEIGHT` above the other foot.
        self._too_high = [0 for _ in FEET]
        self._wrong_leg = 0  # time for which the robot has leaned away from the leg with clearly more load [cycles]
        self._found: tuple[Finding, ...] = ()

    def evaluate(self, ages: Ages | None) -> bool:
        """Compare the load on both feet with the posture.

        Args:
            ages: ages of the sensor values. The load is compared only if all sensors of the check have new values. None if
                all values are of this cycle.

        Returns:
            Whether a load is implausible.
        """
        if (
            ages is not None
            and max(*ages.imu.tolist(), *ages.foot.tolist(), *ages.joint[_KNEES].tolist()) >= self._every
        ):
            return bool(self._found)
        force = self._now.force[:, :, 2].tolist()
        loaded = [sum(abs(cell) > self._free for cell in cells) >= 2 for cells in force]
        if not any(loaded):
            self._too_high, self._wrong_leg, self._found = [0 for _ in FEET], 0, ()
            return False
        posture = self._posture()
        left, right = (sum(cells) for cells in force)
        for foot, height in enumerate((posture.height, -posture.height)):
            raised = loaded[foot] and not loaded[1 - foot] and height > _HEIGHT
            self._too_high[foot] = self._too_high[foot] + self._every if raised else 0
        wrong = all(loaded) and on_wrong_leg(posture.lean, left, right)
        self._wrong_leg = self._wrong_leg + self._every if wrong else 0
        found = [_high(foot, posture.height) for foot in range(len(FEET)) if self._too_high[foot] >= HEIGHT_CYCLES]
        if self._wrong_leg >= WEIGHT_CYCLES:
            found.append(_exchanged(posture.lean, left, right))
        self._found = tuple(found)
        return bool(found)

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the support checks."""
        return self._found

    def _posture(self) -> Posture:
        attitudes, positions = self._now.quaternion.tolist(), self._now.position.tolist()
        knees = [positions[joint] * factor for joint, factor in zip(_KNEES, self._to_joint, strict=True)]
        return posture_of(attitudes[_PELVIS], [attitudes[imu] for imu in _TIBIAE], knees)


def posture_of(pelvis: Sequence[float], tibiae: Sequence[Sequence[float]], knees: Sequence[float]) -> Posture:
    """Return the posture of the legs.

    Args:
        pelvis: attitude of the pelvis, quaternion wxyz, sensor to world.
        tibiae: attitudes of the left and the right tibia, in the same form.
        knees: angles of the left and the right knee [rad].
    """
    w, x, y, z = pelvis
    # World components x and y of the pelvis axis y, which points to the left.
    left_x, left_y = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z)
    length = math.hypot(left_x, left_y)
    drops, lean = [], 0.0
    for (w, x, y, z), knee in zip(tibiae, knees, strict=True):
        # Components x, y and z of the long axis of the shank in the world.
        shank_x, shank_y, shank_z = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        # Vertical component of the thigh axis, which is the shank axis rotated about the knee axis by -knee.
        thigh_z = math.cos(knee) * shank_z - math.sin(knee) * 2.0 * (x * z - w * y)
        drops.append(SEGMENT * (thigh_z + shank_z))
        lean += (shank_x * left_x + shank_y * left_y) / (length * len(SIDES))
    w, x, y, z = pelvis
    return Posture(drops[1] - drops[0] + ANKLE_DISTANCE * 2.0 * (y * z + w * x), lean)


def on_wrong_leg(lean: float, left: float, right: float) -> bool:
    """Return whether the robot leans away from the leg with clearly more load.

    Args:
        lean: lean of the robot to the left [rad].
        left: load on the left foot [N].
        right: load on the right foot [N].
    """
    towards = math.copysign(1.0, lean) * (left - right)
    return abs(lean) > _LEAN and towards < -_SHARE * (left + right)


def _high(foot: int, height: float) -> Finding:
    text = f"the {FEET[foot]} foot reports load although it is {abs(height):.2f} m above the other foot, which reports no load"
    return Finding(Dtc.FOOT_CELL, FOOT_NODES[foot], abs(height), True, text)


def _exchanged(lean: float, left: float, right: float) -> Finding:
    side = SIDES[0] if lean > 0.0 else SIDES[1]
    text = (
        f"the feet are exchanged: the robot leans {math.degrees(abs(lean)):.0f} degrees to the {side}, but the load is"
    )
    return Finding(
        Dtc.CONTACT_IMPLAUSIBLE,
        FOOT_NODES[0],
        lean,
        True,
        f"{text} {left:.0f} N on the left and {right:.0f} N on the right foot",
    )
