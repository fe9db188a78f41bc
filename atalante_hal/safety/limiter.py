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

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, Robot, Vector

_COUNT = len(JOINTS)
#: What `limit` did.
_AS_ASKED, _CUT, _NOT_FINITE = range(3)


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
        self._torque_max = robot.torque_max
        self._step = robot.torque_rate_max * period
        self._envelope = np.array([robot.position_min, robot.position_max, robot.velocity_max])
        envelope = robot.envelope
        self._margins = envelope.look_ahead, envelope.position_margin, envelope.velocity_margin
        self.limit: Vector = robot.torque_max.copy()
        self.last: Vector = np.zeros(_COUNT)
        self.cut: npt.NDArray[np.bool_] = np.zeros(_COUNT, np.bool_)
        self.saturated = 0
        # Whatever the torque comes as, the machine code gets the arrays it was compiled for.
        self._asked, self._motion = np.zeros(_COUNT), np.zeros((2, _COUNT))
        self._apply = compiled(limit)
        self.apply(self.last, np.zeros((2, _COUNT)))  # nothing; from now on it is machine code

    def apply(self, torque: Vector, motion: Vector) -> Limited:
        """Limit a command; the result is in `last`.

        Args:
            torque: shape (12,) [Nm], not changed.
            motion: position [rad] and velocity [rad/s], shape (2, 12), NaN where nothing is known.
        """
        self._asked[:] = torque
        self._motion[:] = motion
        inputs = self._asked, self._motion, self.last, self.limit, self._step, self._envelope
        done = self._apply(*inputs, *self._margins, self.cut)
        if done == _NOT_FINITE:
            return Limited(finite=False, clamped=False)
        self.saturated = self.saturated + 1 if done == _CUT else 0
        return _LIMITED[done]

    def derate(self, limit: Vector) -> None:
        """Lower the torque limit, or raise it again up to the robot's own. Shape (12,) [Nm], none negative."""
        np.minimum(limit, self._torque_max, out=self.limit)

    def restart(self, torque: Vector) -> None:
        """Count the rate limit from a torque the drives exert by themselves, within the limits. Shape (12,) [Nm]."""
        finite = np.nan_to_num(torque, nan=0.0, posinf=0.0, neginf=0.0)
        np.clip(finite, -self.limit, self.limit, out=self.last)
        self.saturated = 0
        self.cut.fill(False)


_LIMITED = {_AS_ASKED: Limited(finite=True, clamped=False), _CUT: Limited(finite=True, clamped=True)}


def limit(
    asked: Vector,
    motion: Vector,
    last: Vector,
    torque_limit: Vector,
    step: Vector,
    envelope: Vector,
    look_ahead: float,
    position_margin: float,
    velocity_margin: float,
    cut: npt.NDArray[np.bool_],
) -> int:
    """The limits of all joints, see above.

    Args:
        asked: torque [Nm]; `motion`: position [rad] and velocity [rad/s], shape (2, 12).
        last: torque of the last cycle [Nm], rewritten by that of this one.
        torque_limit: [Nm]; `step`: largest change of torque in a cycle [Nm].
        envelope: lowest and highest position [rad], highest velocity [rad/s], shape (3, 12).
        look_ahead: [s]; `position_margin`: [rad]; `velocity_margin`: [rad/s].
        cut: whose torque is not what was asked for; rewritten.

    Returns:
        `_AS_ASKED`, `_CUT`, or `_NOT_FINITE`: then nothing is changed.
    """
    for joint in range(len(asked)):
        if not (math.isfinite(asked[joint]) and math.isfinite(motion[0, joint]) and math.isfinite(motion[1, joint])):
            return _NOT_FINITE
    done = _AS_ASKED
    for joint in range(len(asked)):
        velocity, ahead = motion[1, joint], motion[0, joint] + look_ahead * motion[1, joint]
        too_high, too_low = (
            (ahead - envelope[1, joint]) / position_margin,
            (envelope[0, joint] - ahead) / position_margin,
        )
        too_fast_up = (velocity - envelope[2, joint]) / velocity_margin
        too_fast_down = (-velocity - envelope[2, joint]) / velocity_margin
        up = torque_limit[joint] * share(max(too_high, too_fast_up))
        down = torque_limit[joint] * share(max(too_low, too_fast_down))
        # A limit that falls under the torque of the last cycle is approached at the rate limit.
        lowest, highest = last[joint] - step[joint], last[joint] + step[joint]
        sent = min(max(asked[joint], within(-down, lowest, highest)), within(up, lowest, highest))
        cut[joint] = sent != asked[joint]
        if cut[joint]:
            done = _CUT
        last[joint] = sent
    return done


def share(beyond: float) -> float:
    """S: the share of the torque that is left so far beyond a limit."""
    return within(1.0 - beyond, 0.0, 1.0)


def within(value: float, low: float, high: float) -> float:
    """The value nearest to `value` in [low, high]."""
    return min(max(value, low), high)
