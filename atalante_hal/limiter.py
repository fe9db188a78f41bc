"""The limiter: the last thing between any command and the bus. It cannot be switched off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from atalante_hal.robot import Robot, Vector


@dataclass(frozen=True)
class Limited:
    """What the limiter did to one command."""

    finite: bool  # False: the command had a NaN or an infinity and nothing of it was used
    clamped: bool  # a torque or its rate was cut


class Limiter:
    """Torque and torque-rate limits of the robot, applied in place once a cycle.

    The arithmetic changes nothing inside the limits: a torque that needs no cutting leaves with the bits it came with.
    """

    def __init__(self, robot: Robot, period: float) -> None:
        self._torque_max = robot.torque_max.copy()
        self._torque_min = -self._torque_max
        self._step = robot.torque_rate_max * period
        self._low = np.empty_like(self._step)
        self._high = np.empty_like(self._step)
        self._finite = np.empty(self._step.shape, np.bool_)
        self._allowed = list(zip(self._step.tolist(), self._torque_max.tolist(), strict=True))
        #: What was sent last; the rate limit counts from here. Shape (12,) [Nm].
        self.last = np.zeros_like(self._step)

    def apply(self, torque: Vector) -> Limited:
        """Limit a command; the result is in `last`.

        Args:
            torque: shape (12,) [Nm], not changed.
        """
        for asked, last, (step, largest) in zip(torque.tolist(), self.last.tolist(), self._allowed, strict=True):
            if not (-step <= asked - last <= step and -largest <= asked <= largest):
                break
        else:
            self.last[:] = torque
            return _AS_ASKED
        if np.isfinite(torque, out=self._finite).tobytes() != _ALL_TRUE:
            return _NOT_FINITE
        np.subtract(self.last, self._step, out=self._low)
        np.add(self.last, self._step, out=self._high)
        np.maximum(self._low, self._torque_min, out=self._low)
        np.minimum(self._high, self._torque_max, out=self._high)
        np.maximum(torque, self._low, out=self.last)
        np.minimum(self.last, self._high, out=self.last)
        return _AS_ASKED if self.last.tobytes() == torque.tobytes() else _CLAMPED

    def restart(self, torque: Vector) -> None:
        """Count the rate limit from a torque the drives exert by themselves, within the limits. Shape (12,) [Nm]."""
        finite = np.nan_to_num(torque, nan=0.0, posinf=0.0, neginf=0.0)
        np.maximum(finite, self._torque_min, out=self.last)
        np.minimum(self.last, self._torque_max, out=self.last)


_ALL_TRUE = b"\1" * 12
_NOT_FINITE = Limited(finite=False, clamped=False)
_AS_ASKED = Limited(finite=True, clamped=False)
_CLAMPED = Limited(finite=True, clamped=True)
