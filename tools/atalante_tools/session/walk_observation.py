"""Observer of a walk on the ground: detects a fall, and measures the deviation from the initial walking line."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from atalante_hal.bus import BusDown
from atalante_hal.robot import IMUS
from atalante_hal.safety.plausibility.fall import FALLEN

if TYPE_CHECKING:
    from atalante_control.walking.controller import WalkController
    from atalante_hal.types import Vector
    from atalante_tools.session.embedded.access import Access, Stance
    from atalante_tools.session.rig import Rig
    from atalante_tools.session.walk_options import Push

#: Period of the observation [cycles]. During one period, the pelvis of a falling robot turns by less than 2 degrees.
PERIOD_CYCLES: Final = 10
#: Time for which the robot is observed after the HAL has left the state ACTIVE [cycles].
#: If the robot stops in the middle of a step, more than 1.5 s can pass before it falls.
AFTERMATH: Final = 5000
_PELVIS: Final = IMUS.index("pelvis")


class Observation:
    """Observer of a walk: detects a fall, measures the true deviation from the walking line, and applies the push.

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
        self._push_begun: int | None = None  # cycle in which the push began
        self._push_angle = 0.0  # direction of the push in world axes [rad]
        self._squares, self._count = 0.0, 0  # sum of the squared attitude errors [rad2], and number of these errors
        self._origin: Stance | None = None
        self._moved = False  # whether the controller has moved the robot
        if push is not None and rig.access is not None:
            rig.access.push(self._wrench)

    def check(self) -> bool:
        """Return whether the robot has fallen. The attitude is observed every `PERIOD_CYCLES` cycles."""
        if self._rig.hal.state.cycle % PERIOD_CYCLES:
            return self.fell
        access = self._rig.access
        try:
            upright = self._measured() if access is None else self._compare(access)
        except BusDown:  # the process of the robot has ended; the HAL reports this
            return self.fell
        self.fell = self.fell or upright < math.cos(FALLEN)
        return self.fell

    def _measured(self) -> float:
        """Return the measured or estimated cosine of the angle between the z axis of the pelvis and the vertical.

        The controller estimates the vertical only while it moves the robot. After that, the attitude of the pelvis IMU is used.
        Before the start, a robot on a crane may lean, so the cosine is 1.
        """
        hal = self._rig.hal
        if hal.moving:
            self._moved = True
            return float(self._controller.vertical[2])
        if not self._moved:
            return 1.0
        _, x, y, _ = hal.state.imu_quaternion[_PELVIS].tolist()
        return _upright(x, y)

    def _compare(self, access: Access) -> float:
        """Return the true cosine of the angle between the z axis of the pelvis and the vertical.

        While the controller walks, also add up the squared error of the vertical that the controller estimates.
        """
        x, y, z, w = access.attitude()
        upright = _upright(x, y)
        if self._controller.walking:
            if self._origin is None:
                self._origin = access.stance()
            a, b, c = self._controller.vertical.tolist()
            self._squares += (2.0 * (x * z - w * y) - a) ** 2 + (2.0 * (y * z + w * x) - b) ** 2 + (upright - c) ** 2
            self._count += 1
        return upright

    @property
    def attitude_rms_deg(self) -> float | None:
        """Return the root mean square error [deg] of the estimated vertical during the walk; None if unknown."""
        return round(math.degrees(math.sqrt(self._squares / self._count)), 3) if self._count else None

    def true_deviation(self) -> dict[str, Any]:
        """Return the fields of `WalkResult` for the true deviation from the initial walking line. Unknown values are None."""
        access, lateral, yaw = self._rig.access, None, None
        if access is not None and self._origin is not None and not self.fell:
            with suppress(BusDown):
                start, end = self._origin, access.stance()
                across = math.cos(start.yaw) * (end.y - start.y) - math.sin(start.yaw) * (end.x - start.x)
                lateral, yaw = round(across, 3), round(math.degrees(math.remainder(end.yaw - start.yaw, math.tau)), 2)
        return {"true_lateral_m": lateral, "true_yaw_deg": yaw}

    def _wrench(self) -> Vector:
        """Return force [N] and moment [Nm] of the push in this cycle, shape (6,)."""
        import numpy as np

        from atalante_hal.types import PERIOD

        wrench = np.zeros(6)
        assert self._push is not None
        controller, push, cycle = self._controller, self._push, self._rig.hal.state.cycle
        if self._push_begun is None:
            step = controller.steps_wanted // 2 if push.step is None else push.step
            if not controller.reached(step, push.phase):
                return wrench
            self._push_begun = cycle
            # `push.direction` is relative to the desired line. This line turns by the angle `turn` before each step.
            self._push_angle = math.radians(push.direction) + controller.config.turn * controller.steps_begun
        if (cycle - self._push_begun + 1) * PERIOD <= push.duration:
            wrench[:2] = push.force * math.cos(self._push_angle), push.force * math.sin(self._push_angle)
        return wrench


def _upright(x: float, y: float) -> float:
    """Return the cosine of the angle between the z axis of a link and the vertical.

    Args:
        x: Element x of the quaternion of the link in world axes.
        y: Element y of this quaternion.
    """
    return 1.0 - 2.0 * (x * x + y * y)
