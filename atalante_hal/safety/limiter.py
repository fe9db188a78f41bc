"""Limiter: the last stage between the requested torque and the bus. The limiter cannot be switched off.

    requested torque -> derated torque limit, envelope of position and velocity -> torque rate -> torque sent

*Envelope.* The limit of a torque that acts towards a position limit depends on the predicted position of the joint: the
position after the time `look_ahead` at the current velocity. The torque limit is full while the predicted position is
inside the position limit, and falls to zero over a distance of `position_margin` outside this limit. In the same way
the limit of a torque in the direction of the velocity falls to zero between `velocity_max` and
`velocity_max + velocity_margin`. A torque in the opposite direction brakes the joint and keeps the full limit. So the
envelope never reverses a torque and never weakens braking. The envelope is not a controller: without braking a joint
reaches its end stop. The end stop is at most `position_margin` outside the position limit. The end stop must withstand
the torque of a joint that rests against it. A gait may use the full range.

*Acceleration.* A light joint exceeds its velocity limit before a measured velocity shows it, because the torque changes
at a finite rate and because a measurement is old. So the envelope also limits the predicted velocity. The joint reaches
this velocity if the torque falls from u to zero at `torque_rate_max`. The prediction assumes the measured acceleration,
and in addition the acceleration that the torque change of the last `DELAY` cycles causes on the smallest inertia of the
joint. Let x be the velocity v without the low-pass of the drive, and a the change of x in one cycle, divided by the
period T. Let o be the torque sent `DELAY` cycles ago, and J the smallest inertia. A positive torque is at most U, the
largest u >= 0 with

    (a + max(0, u - o) / J) (DELAY T + u / (2 torque_rate_max)) <= max(0, velocity_max - x)

A negative torque has the mirrored limit. On the ground the measured accelerations are small, so the same torques are permitted as
without this limit. A torque that brakes is limited only if it would accelerate the joint beyond the limit of the opposite
direction. The prediction treats each joint alone: torques of other joints count only through the measured acceleration. In the
first cycle after `restart`, a and x - v are unknown and assumed to be 0. In the second cycle, a is still assumed to be 0.

*Rate.* The torque changes by at most `torque_rate_max`, without exception. If the derating or the envelope reduces the limit
below the torque of the last cycle, the torque approaches the new limit at this rate.

*Guarantee.* The inequalities below hold for every pair (k-1, k) of command frames that both have ENABLE_OPERATION for a joint.
u is the TargetTorque and M the MaxTorque of a frame. q and v are the position and velocity in the last good state frame of the
joint before frame k, or in an earlier good frame not older than the timeout of the node. In a walk on the ground, this timeout is
longer than in the DBC (`message_monitor.GROUND_TOLERANCE`). r = torque_rate_max * 1 ms, and e is the resolution of TargetTorque.

- |u_k| <= torque_max, M_k <= torque_max
- |u_k - u_(k-1)| <= r + e
- |u_k| <= max(M_k, |u_(k-1)| - r + e)
- u_k <= max(min(F_up M_k, U_up), u_(k-1) - r) + e and -u_k <= max(min(F_down M_k, U_down), -u_(k-1) - r) + e, where U_up and
  U_down are the torques U of both directions, from the motion that the limiter received, and
  F_up = min(S((q + look_ahead v - position_max) / position_margin), S((v - velocity_max) / velocity_margin)),
  F_down = min(S((position_min - q - look_ahead v) / position_margin), S((-v - velocity_max) / velocity_margin)),
  S(x) = 1 - x clipped to [0, 1]

For every frame with another controlword for a joint: u_k is 0 or the torque that the drive reported, and |u_k| <= M_k.
All limits are defined in robot.toml.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.compiled import specialised
from atalante_hal.robot import JOINTS, SIDES, Robot
from atalante_hal.types import Vector

_COUNT = len(JOINTS)
#: Number of cycles after which a change of the commanded torque is visible in the measured acceleration.
DELAY: Final = 3
#: Smallest effective inertia [kg m2] of each joint in LEG_JOINTS while all other joints are free to move.
#: Each value is a lower bound for the empty exoskeleton in all poses, with a fixed pelvis and with a free pelvis.
SMALLEST_INERTIA: Final = (0.12, 0.14, 0.17, 0.11, 0.038, 0.038)
#: Results of `limit`: all torques are unchanged, at least one torque was changed, an input is not finite.
_UNCHANGED, _CUT, _NOT_FINITE = range(3)


@dataclass(frozen=True)
class Limited:
    """Result of limiting one command."""

    finite: bool  # whether all inputs were finite; if not, the whole command was ignored
    clamped: bool  # whether the limiter changed the torque of at least one joint


class JointLimits(NamedTuple):
    """Constant limits of all joints, for the compiled function `limit`.

    The `Limiter` owns `step` and `inertia`; the `Robot` owns the other arrays.
    """

    step: Vector  # (12,) maximum change of the torque in one cycle [Nm]
    position_min: Vector  # (12,) lowest position [rad]
    position_max: Vector  # (12,) highest position [rad]
    velocity_max: Vector  # (12,) highest velocity [rad/s]
    look_ahead: float  # time over which the envelope predicts the joint position, at constant velocity [s]
    position_margin: float  # distance of the predicted position outside a limit at which the outward torque is 0 [rad]
    velocity_margin: float  # excess over `velocity_max` at which the accelerating torque is 0 [rad/s]
    inertia: Vector  # (12,) smallest effective inertia of each joint [kg m2]
    period: float  # duration of a cycle [s]
    filter_lag: float  # delay of the low-pass of the reported velocity [s]


class Limiter:
    """Torque limiter of all joints, applied once per cycle.

    A torque within the limits is passed on bit for bit.

    Attributes:
        last: torque sent last, shape (12,) [Nm]; the rate limit is relative to it.
        limit: current torque limit, shape (12,) [Nm].
        cut: True for each joint whose torque was changed in the last `apply`, shape (12,). Controllers use it for
            anti-windup.
        saturated: number of consecutive cycles, up to the last `apply`, in which the torque of any joint was changed.
    """

    def __init__(self, robot: Robot, period: float) -> None:
        self._torque_max = robot.torque_max
        envelope = robot.envelope
        keep = math.exp(-2.0 * math.pi * robot.sensors.velocity_bandwidth * period)
        self._limits = JointLimits(
            step=robot.torque_rate_max * period,
            position_min=robot.position_min,
            position_max=robot.position_max,
            velocity_max=robot.velocity_max,
            look_ahead=envelope.look_ahead,
            position_margin=envelope.position_margin,
            velocity_margin=envelope.velocity_margin,
            inertia=np.array(SMALLEST_INERTIA * len(SIDES)),
            period=period,
            filter_lag=keep / (1.0 - keep) * period,
        )
        self.limit: Vector = robot.torque_max.copy()
        self.last: Vector = np.zeros(_COUNT)
        self.cut: npt.NDArray[np.bool_] = np.zeros(_COUNT, np.bool_)
        self.saturated = 0
        # Copies of the inputs, because the compiled code accepts only the array type and layout that it was compiled for.
        self._asked, self._motion = np.zeros(_COUNT), np.zeros((2, _COUNT))
        # First rows of `_past`: torques sent in the last `DELAY` cycles, newest first.
        # Last two rows of `_past`, both for the last cycle: reported velocity, and velocity without the low-pass of the drives.
        self._past = np.zeros((DELAY + 2, _COUNT))
        self._apply = specialised(
            limit, self._asked, self._motion, self._limits, self.limit, self.last, self._past, self.cut
        )
        self.restart(self.last)

    def apply(self, torque: Vector, motion: Vector) -> Limited:
        """Limit a command and store the result in `last`.

        Args:
            torque: requested torque, shape (12,) [Nm]; not changed.
            motion: position [rad] and velocity [rad/s], shape (2, 12); NaN where they are unknown.

        Returns:
            Whether the inputs were finite and whether a torque was cut. If an input is not finite, `last` keeps its value.
        """
        self._asked[:] = torque
        self._motion[:] = motion
        done = self._apply(self._asked, self._motion, self._limits, self.limit, self.last, self._past, self.cut)
        if done == _NOT_FINITE:
            return Limited(finite=False, clamped=False)
        self.saturated = self.saturated + 1 if done == _CUT else 0
        return _LIMITED[done]

    def derate(self, limit: Vector) -> None:
        """Set the torque limit. A value above the maximum torque of the robot is clipped to the maximum torque.

        Args:
            limit: new torque limit, shape (12,) [Nm], at least 0.
        """
        np.minimum(limit, self._torque_max, out=self.limit)

    def restart(self, torque: Vector) -> None:
        """Start the rate limit again at the torque that the drives report.

        The reported torque is clipped to the torque limit.

        Args:
            torque: torque reported by the drives, shape (12,) [Nm]; NaN and infinity are replaced by 0.
        """
        finite = np.nan_to_num(torque, nan=0.0, posinf=0.0, neginf=0.0)
        np.clip(finite, -self.limit, self.limit, out=self.last)
        self._past[:DELAY] = self.last
        self._past[DELAY:] = math.nan
        self.saturated = 0
        self.cut.fill(False)


_LIMITED = {_UNCHANGED: Limited(finite=True, clamped=False), _CUT: Limited(finite=True, clamped=True)}


def limit(
    requested: Vector,
    motion: Vector,
    limits: JointLimits,
    torque_limit: Vector,
    last: Vector,
    past: Vector,
    cut: npt.NDArray[np.bool_],
) -> int:
    """Limit the torque of all joints: torque limit, envelope and torque rate, as described in the module docstring.

    Args:
        requested: requested torque, shape (12,) [Nm].
        motion: position [rad] and velocity [rad/s], shape (2, 12).
        limits: constant limits of the joints.
        torque_limit: current torque limit, shape (12,) [Nm].
        last: torque sent in the last cycle, shape (12,) [Nm]; overwritten with the torque to be sent in this cycle.
        past: torques sent in the last `DELAY` cycles, newest first [Nm], then two velocities of the last cycle [rad/s]:
            as reported, and without the low-pass; NaN if unknown. Shape (DELAY + 2, 12); updated.
        cut: True for each joint whose torque differs from the requested torque, shape (12,); overwritten.

    Returns:
        `_UNCHANGED`, `_CUT`, or `_NOT_FINITE`; with `_NOT_FINITE` no output is changed.
    """
    for joint in range(len(requested)):
        if not (
            math.isfinite(requested[joint]) and math.isfinite(motion[0, joint]) and math.isfinite(motion[1, joint])
        ):
            return _NOT_FINITE
    done = _UNCHANGED
    for joint in range(len(requested)):
        velocity, ahead = motion[1, joint], motion[0, joint] + limits.look_ahead * motion[1, joint]
        too_high = (ahead - limits.position_max[joint]) / limits.position_margin
        too_low = (limits.position_min[joint] - ahead) / limits.position_margin
        too_fast_up = (velocity - limits.velocity_max[joint]) / limits.velocity_margin
        too_fast_down = (-velocity - limits.velocity_max[joint]) / limits.velocity_margin
        up = torque_limit[joint] * share(max(too_high, too_fast_up))
        down = torque_limit[joint] * share(max(too_low, too_fast_down))
        before, fast_before = past[DELAY, joint], past[DELAY + 1, joint]
        fast = velocity if math.isnan(before) else velocity + limits.filter_lag * (velocity - before) / limits.period
        acceleration = 0.0 if math.isnan(fast_before) else (fast - fast_before) / limits.period
        past[DELAY, joint], past[DELAY + 1, joint] = velocity, fast
        oldest, inertia, fall = past[DELAY - 1, joint], limits.inertia[joint], 0.5 * limits.period / limits.step[joint]
        delay, fastest = DELAY * limits.period, limits.velocity_max[joint]
        up = min(up, highest_torque(fastest - fast, acceleration, oldest, inertia, delay, fall))
        down = min(down, highest_torque(fastest + fast, -acceleration, -oldest, inertia, delay, fall))
        # If the torque limit falls below the torque of the last cycle, the torque decreases at the rate limit.
        lowest, highest = last[joint] - limits.step[joint], last[joint] + limits.step[joint]
        sent = min(max(requested[joint], within(-down, lowest, highest)), within(up, lowest, highest))
        cut[joint] = sent != requested[joint]
        if cut[joint]:
            done = _CUT
        last[joint] = sent
        for age in range(DELAY - 1, 0, -1):
            past[age, joint] = past[age - 1, joint]
        past[0, joint] = sent
    return done


def highest_torque(room: float, acceleration: float, oldest: float, inertia: float, delay: float, fall: float) -> float:
    """Return U [Nm], the largest torque in one direction that keeps the predicted velocity within its limit.

    With the torque U, the predicted growth of the velocity is acceleration times time:

    - Acceleration: `acceleration` + max(0, U - `oldest`) / `inertia`. The measured acceleration belongs to the torque `oldest`.
    - Time: `delay` + `fall` * U. After the delay, the torque falls from U to 0. The mean torque in the fall is U / 2, so half of
      the duration of the fall counts.

    U is the largest torque for which the growth is at most `room`; 0 if there is no such torque above 0. If U is above `oldest`,
    U is the larger solution of the quadratic equation growth = `room`. Otherwise the equation is linear.

    Args:
        room: difference between the velocity limit and the velocity [rad/s].
        acceleration: measured acceleration [rad/s2].
        oldest: torque sent `DELAY` cycles ago [Nm].
        inertia: smallest inertia of the joint [kg m2].
        delay: duration of `DELAY` cycles [s].
        fall: half of the time in which the torque falls by 1 Nm [s/Nm].
    """
    room = max(room, 0.0)
    known = max(oldest, 0.0)
    if acceleration * (delay + known * fall) > room:  # the velocity gets too high even if the torque does not increase
        return max((room / acceleration - delay) / fall, 0.0)
    # Solve the quadratic equation in the docstring for U.
    free = inertia * acceleration - oldest  # torque that does not come from the motor [Nm]
    root = math.sqrt((delay - free * fall) ** 2 + 4.0 * fall * inertia * room)
    return max((root - delay - free * fall) / (2.0 * fall), known)


def share(beyond: float) -> float:
    """Return S(x), the allowed fraction of the torque limit when a joint is outside a position or velocity limit.

    Args:
        beyond: distance outside the limit as a fraction of the margin; negative inside the limit.
    """
    return within(1.0 - beyond, 0.0, 1.0)


def within(value: float, low: float, high: float) -> float:
    """Return `value` clipped to [low, high]."""
    return min(max(value, low), high)
