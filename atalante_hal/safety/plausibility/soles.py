"""Sole checks, which compare the ankle encoders of a foot on the floor with the IMU of its tibia.

The foot has no IMU. But a foot that carries load stands on its whole sole, unless its centre of pressure is near an edge. The
sole is then level. The attitude of the tibia and the angles of the sagittal and henke ankle (SA, HA) give the direction of the
vertical in the axes of the sole. The components of this direction in the plane of the sole are the tilt of the sole. A tilt above
`sole_tilt` in `SOLE_SAMPLES` consecutive samples of a flat foot is an error of an ankle encoder or of the tibia IMU. The module
`legs` compares the tibia IMU with other encoders.

The larger component of the tilt determines the reported joint: an error of SA tilts the sole about its lateral axis, and an error
of HA about its longitudinal axis. The check assumes a level floor. A suspended robot cannot be checked, because its soles are
free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import IMUS, JOINTS, SIDES, Robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Ages, Signals
from atalante_hal.wire.process_image import NEVER

#: Number of consecutive samples with a tilted sole after which an ankle encoder is reported. A foot is sampled every 32 cycles.
#: The sole counts as tilted if the force cells show a flat foot, but ankle encoders and tibia IMU show a tilt.
SOLE_SAMPLES = 4
#: Load that a foot flat on the floor must exceed, as a multiple of `cell_free` (largest force of an unloaded cell).
_LOAD = 4.0
#: Largest distance of the centre of pressure from the middle of a flat foot: along the foot, across the foot.
#: Each value is a multiple of the distance between the middle and a force cell in this direction.
#: The edge of the sole is at the multiple 1.1 along the foot, and at the multiple 2.0 across the foot.
_CENTRE = (0.8, 1.4)
#: Outward rotation of the foot about the vertical axis of the tibia [rad].
TOE_OUT = math.radians(8.0)
#: Direction of the henke axis in the axes of the sole: components x and z, not scaled to the length 1. Component y is 0.
HENKE_AXIS = (0.788, 0.616)
_TIBIAE = [IMUS.index(f"{side}_tibia") for side in SIDES]
_ANKLES = [[JOINTS.index(f"{side}_{name}") for name in ("SA", "HA")] for side in SIDES]


class Soles:
    """Checks of both soles.

    Args:
        robot: transmission and sensor thresholds of the robot.
        now: signals decoded in this cycle.
    """

    def __init__(self, robot: Robot, now: Signals) -> None:
        self._now, self._loaded, self._tilt = now, _LOAD * robot.sensors.cell_free, robot.sensors.sole_tilt
        self._to_joint = (robot.polarity / robot.gear).tolist()
        #: For each sole: number of consecutive samples in which the sole is tilted although its forces show flat contact.
        self._samples = [0 for _ in SIDES]
        self._found: dict[int, Finding] = {}

    def check_left(self, ages: Ages | None) -> bool:
        """Check the left sole.

        Args:
            ages: ages of the sensor values; a foot with values that are too old is not checked. None if all values are of this
                cycle.

        Returns:
            Whether there is a finding for any sole.
        """
        return self._check(0, ages)

    def check_right(self, ages: Ages | None) -> bool:
        """Check the right sole, see `check_left`."""
        return self._check(1, ages)

    def findings(self) -> tuple[Finding, ...]:
        """Return the current findings of the sole checks."""
        return tuple(self._found.values())

    def _check(self, foot: int, ages: Ages | None) -> bool:
        joints, imu, now = _ANKLES[foot], _TIBIAE[foot], self._now
        if ages is not None and max(*ages.joint[joints].tolist(), ages.imu[imu], ages.foot[foot]) >= NEVER:
            return bool(self._found)
        tilt = (0.0, 0.0)
        if stands_flat(now.force[foot, :, 2].tolist(), self._loaded):
            sa, ha = (float(now.position[joint]) * self._to_joint[joint] for joint in joints)
            tilt = sole_tilt(now.quaternion[imu].tolist(), sa, ha, TOE_OUT if foot == 0 else -TOE_OUT)
        self._samples[foot] = self._samples[foot] + 1 if math.hypot(*tilt) > self._tilt else 0
        if self._samples[foot] >= SOLE_SAMPLES:
            self._found[foot] = _tilted(foot, *tilt)
        else:
            self._found.pop(foot, None)
        return bool(self._found)


def stands_flat(cells: Sequence[float], loaded: float) -> bool:
    """Return whether a foot stands on its whole sole.

    Args:
        cells: vertical forces on the four cells, in the order of CELLS [N].
        loaded: load that a flat foot exceeds [N].
    """
    front_left, front_right, rear_left, rear_right = cells
    load = sum(cells)
    along = abs(front_left + front_right - rear_left - rear_right)
    across = abs(front_left + rear_left - front_right - rear_right)
    return load > loaded and along <= _CENTRE[0] * load and across <= _CENTRE[1] * load


def sole_tilt(tibia: Sequence[float], sa: float, ha: float, toe_out: float) -> tuple[float, float]:
    """Return the tilt of a sole along and across the foot. Both components are 0 if the sole is level.

    The tilt is the projection of the upward unit vector of the world onto the longitudinal and the lateral axis of the sole.

    Args:
        tibia: attitude of the tibia, quaternion wxyz, sensor to world.
        sa: angle of the sagittal ankle [rad].
        ha: angle of the henke ankle [rad].
        toe_out: rotation of the foot about the vertical axis of the tibia, positive to the left [rad].

    Returns:
        Component along the foot and component across the foot, each from -1 to 1. The first component is approximately
        the angle error of SA in rad.
    """
    w, i, j, k = tibia
    # Upward direction in the axes of the tibia.
    x, y, z = 2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)
    cosine, sine = math.cos(toe_out), math.sin(toe_out)
    x, y = cosine * x + sine * y, cosine * y - sine * x
    cosine, sine = math.cos(sa), math.sin(sa)
    x, z = cosine * x - sine * z, cosine * z + sine * x
    # Rotation by -HA about the henke axis, with Rodrigues' formula.
    length = math.hypot(*HENKE_AXIS)
    ax, az = (component / length for component in HENKE_AXIS)
    cosine, sine = math.cos(ha), -math.sin(ha)
    along = (1.0 - cosine) * (ax * x + az * z)
    return cosine * x - sine * az * y + along * ax, cosine * y + sine * (az * x - ax * z)


def _tilted(foot: int, along: float, across: float) -> Finding:
    joint = _ANKLES[foot][abs(across) > abs(along)]
    tilt = math.hypot(along, across)
    got = f"got a tilt of {math.degrees(tilt):.1f} degrees"
    text = f"encoder of {JOINTS[joint]}: the {SIDES[foot]} sole must be level, because it is flat on the floor, {got}"
    return Finding(Dtc.ENC_DRIFT, JOINT_NODES[joint], tilt, True, text)
