"""Attitude and path of the robot during a walk on the ground: `emulated body or controller -> has fallen, deviation`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from atalante_hal.robot import IMUS

if TYPE_CHECKING:
    from atalante_control.walking.controller import WalkController
    from atalante_emulator.emulator import Emulator
    from atalante_hal.types import Vector
    from atalante_tools.session.rig import Rig
    from atalante_tools.session.walk_options import Push

#: The robot has fallen if its pelvis leans by more than this angle [rad].
FALLEN: Final = math.radians(35.0)
#: Period of the observation [cycles]. In this time, the pelvis of a falling robot turns by less than 2 degrees.
PERIOD_CYCLES: Final = 10
#: Time for which a robot that left ACTIVE is observed [cycles]. A HOLD within a step may end in a fall after more than 1.5 s.
AFTERMATH: Final = 5000
#: Row of the pelvis IMU.
_PELVIS: Final = IMUS.index("pelvis")


class Observation:
    """Attitude and path of the robot during the walk, and the push. The true values of an emulated robot are read from its body.

    Attributes:
        fell: Whether the pelvis has leaned by more than `FALLEN`.
    """

    def __init__(self, rig: Rig, controller: WalkController, push: Push | None) -> None:
        """Add the push to the emulated robot.

        Args:
            rig: Rig of the walk.
            controller: Controller of the walk.
            push: Push during the walk; None means no push.
        """
        self.fell = False
        self._rig, self._controller, self._push = rig, controller, push
        self._pushed = 0
        self._squares, self._count = 0.0, 0  # sum of the squared attitude errors [rad2], and their number
        self._origin: tuple[float, float, float] | None = None
        if push is not None and rig.emulator is not None:
            rig.emulator.pelvis_forces.append(self._wrench)

    def check(self) -> bool:
        """Return whether the robot has fallen. The attitude is observed every `PERIOD_CYCLES` cycles."""
        if self._rig.hal.state.cycle % PERIOD_CYCLES:
            return self.fell
        emulator = self._rig.emulator
        if emulator is None:
            upright = float(self._controller.vertical[2])
        else:
            # The axes of the pelvis IMU are parallel to those of the pelvis.
            x, y, z, w = emulator.body.imu[_PELVIS, :4].tolist()
            upright = 1.0 - 2.0 * (x * x + y * y)
            if self._controller.walking:
                if self._origin is None:
                    self._origin = _stance(emulator)
                a, b, c = self._controller.vertical.tolist()
                self._squares += (
                    (2.0 * (x * z - w * y) - a) ** 2 + (2.0 * (y * z + w * x) - b) ** 2 + (upright - c) ** 2
                )
                self._count += 1
        self.fell = self.fell or upright < math.cos(FALLEN)
        return self.fell

    @property
    def attitude_rms_deg(self) -> float | None:
        """Return the root mean square of the error of the estimated vertical during the walk [deg]; None if not known."""
        return round(math.degrees(math.sqrt(self._squares / self._count)), 3) if self._count else None

    def true_deviation(self) -> dict[str, Any]:
        """Return the fields of `WalkResult` for the true deviation from the start line; the values are None if not known."""
        emulator, lateral, yaw = self._rig.emulator, None, None
        if emulator is not None and self._origin is not None and not self.fell:
            (x0, y0, yaw0), (x, y, yaw1) = self._origin, _stance(emulator)
            lateral = round(math.cos(yaw0) * (y - y0) - math.sin(yaw0) * (x - x0), 3)
            yaw = round(math.degrees(math.remainder(yaw1 - yaw0, math.tau)), 2)
        return {"true_lateral_m": lateral, "true_yaw_deg": yaw}

    def _wrench(self, _hal_state: int) -> Vector:
        """Return force [N] and moment [Nm] of the push in this cycle, shape (6,)."""
        import numpy as np

        from atalante_hal.types import PERIOD

        wrench = np.zeros(6)
        assert self._push is not None
        controller, push = self._controller, self._push
        step = controller.steps_wanted // 2 if push.step is None else push.step
        if self._pushed == 0 and not controller.reached(step, push.phase):
            return wrench
        self._pushed += 1
        if self._pushed * PERIOD <= push.duration:
            angle = math.radians(push.direction)
            wrench[:2] = push.force * math.cos(angle), push.force * math.sin(angle)
        return wrench


def _stance(emulator: Emulator) -> tuple[float, float, float]:
    """Return the true middle between the feet [m] and the mean heading of both feet [rad]."""
    from atalante_emulator.bodies.links import FOOT_LINKS

    x = y = ahead = left = 0.0
    for link in FOOT_LINKS:
        motion = emulator.body.motion(link)
        i, j, k, w = motion.attitude.tolist()
        x, y = x + 0.5 * float(motion.position[0]), y + 0.5 * float(motion.position[1])
        ahead, left = ahead + 1.0 - 2.0 * (j * j + k * k), left + 2.0 * (i * j + w * k)
    return x, y, math.atan2(left, ahead)
