"""The limiter: the last thing between any command and the bus. It cannot be switched off.

    torque asked for -> derated torque limit, envelope of position and velocity -> torque rate -> torque sent

*Envelope.* Torque that drives a joint towards a position limit fades with where the joint will be `look_ahead` from now at its
velocity: whole up to the limit, none from `position_margin` past it. Torque along the velocity fades likewise from `velocity_max`
to `velocity_margin` past it. The torque the other way, which brakes, keeps the whole limit: the envelope never turns a torque
around and never weakens a brake. It is no controller: a joint that nobody brakes reaches its end stop, which stands at the limit
or less than the margin past it and has to bear the torque pressed onto it at rest. A gait may use the whole range.

*Rate.* The limit of torque, derated or faded, is approached at the rate limit: where it falls under the torque of the last cycle,
the torque follows at `torque_rate_max`. So the rate holds without exception.

What holds of every pair (k-1, k) of command frames with ENABLE_OPERATION for a joint in both, with u the TargetTorque, M the
MaxTorque of the frame, q and v the position and velocity of the joint's last state frame that was good before frame k (or of
an earlier one, no older than the node's timeout), r = torque_rate_max * 1 ms, e one step of TargetTorque on the wire:

- |u_k| <= torque_max, M_k <= torque_max
- |u_k - u_(k-1)| <= r + e
- |u_k| <= max(M_k, |u_(k-1)| - r + e)
- u_k <= max(F_up M_k, u_(k-1) - r) + e and -u_k <= max(F_down M_k, -u_(k-1) - r) + e, where
  F_up = min(S((q + look_ahead v - position_max) / position_margin), S((v - velocity_max) / velocity_margin)),
  F_down = min(S((position_min - q - look_ahead v) / position_margin), S((-v - velocity_max) / velocity_margin)),
  S(x) = 1 - x clipped to [0, 1]

and of every frame with another controlword for a joint: u_k = 0, or the torque the drive reported, |u_k| <= M_k.
All numbers are those of robot.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS, Robot, Vector

_COUNT = len(JOINTS)
#: Too small to change a sum; but it takes an infinite torque along, where 0 * inf would be an error of its own.
_NO_WEIGHT = 2.0**-80


@dataclass(frozen=True)
class Limited:
    """What the limiter did to one command."""

    finite: bool  # False: a number was NaN or infinite and nothing of the command was used
    clamped: bool  # the torque of a joint was cut


class Limiter:
    """The limits of the robot, applied once a cycle.

    A torque that needs no cutting leaves with the bits it came with.

    Attributes:
        last: what was sent last, shape (12,) [Nm]; the rate limit counts from here.
        limit: torque limit in force, shape (12,) [Nm].
        cut: joints whose torque was cut in the last `apply`, shape (12,), for an anti-windup.
        saturated: cycles in a row, up to the last `apply`, in which a torque was cut.
    """

    def __init__(self, robot: Robot, period: float) -> None:
        envelope = robot.envelope
        self._torque_max = robot.torque_max
        self._step = robot.torque_rate_max * period
        self.limit: Vector = robot.torque_max.copy()
        self.cut: npt.NDArray[np.bool_] = np.zeros(_COUNT, np.bool_)
        self.saturated = 0
        #: Torque asked for, torque of the last cycle, position, velocity.
        self._inputs = np.zeros((4, _COUNT))
        self._asked, self.last, self._motion = self._inputs[0], self._inputs[1], self._inputs[2:]
        # Everything that has a limit, upwards and downwards, is a small matrix times the inputs: one product, one comparison.
        ahead, none = envelope.look_ahead, _NO_WEIGHT
        rows = [[1.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [none, 0.0, 1.0, ahead], [none, 0.0, 0.0, 1.0]]
        self._matrix = np.array([*rows, *np.negative(rows)])
        self._terms = np.empty((len(self._matrix), _COUNT))
        up = [self.limit, self._step, robot.position_max, robot.velocity_max]
        down = [self.limit, self._step, -robot.position_min, robot.velocity_max]
        self._bounds = np.array([*up, *down])
        self._margins = np.array([[envelope.position_margin], [envelope.velocity_margin]])
        self._inside = np.empty(self._terms.shape, np.bool_)

    def apply(self, torque: Vector, motion: Vector) -> Limited:
        """Limit a command; the result is in `last`.

        Args:
            torque: shape (12,) [Nm], not changed.
            motion: position [rad] and velocity [rad/s], shape (2, 12), NaN where nothing is known.
        """
        self._asked[:] = torque
        self._motion[:] = motion
        self._matrix.dot(self._inputs, self._terms)
        # NaN is not inside.
        if np.less_equal(self._terms, self._bounds, self._inside).tobytes() != _ALL_INSIDE:
            return self._cut()
        self.last[:] = torque
        if self.saturated:
            self._forget_saturation()
        return _AS_ASKED

    def _cut(self) -> Limited:
        if not np.isfinite(self._inputs).all():
            return _NOT_FINITE
        motions = self._matrix[:, 2:] @ self._motion
        beyond = (motions - self._bounds).reshape(2, 4, _COUNT)[:, 2:] / self._margins
        up, down = self.limit * np.clip(1.0 - beyond, 0.0, 1.0).min(axis=1)
        low, high = np.clip([-down, up], self.last - self._step, self.last + self._step)
        np.clip(self._asked, low, high, out=self.last)
        np.not_equal(self.last, self._asked, self.cut)
        if not self.cut.any():
            self.saturated = 0
            return _AS_ASKED
        self.saturated += 1
        return _CLAMPED

    def derate(self, limit: Vector) -> None:
        """Lower the torque limit, or raise it again up to the robot's own. Shape (12,) [Nm], none negative."""
        np.minimum(limit, self._torque_max, out=self.limit)
        self._bounds[[0, 4]] = self.limit

    def restart(self, torque: Vector) -> None:
        """Count the rate limit from a torque the drives exert by themselves, within the limits. Shape (12,) [Nm]."""
        finite = np.nan_to_num(torque, nan=0.0, posinf=0.0, neginf=0.0)
        np.clip(finite, -self.limit, self.limit, out=self.last)
        self._forget_saturation()

    def _forget_saturation(self) -> None:
        self.saturated = 0
        self.cut.fill(False)


_ALL_INSIDE = b"\1" * (8 * _COUNT)
_NOT_FINITE = Limited(finite=False, clamped=False)
_AS_ASKED = Limited(finite=True, clamped=False)
_CLAMPED = Limited(finite=True, clamped=True)
