"""Joint PID of the baseline controller: `q_des, q_des' and measured q, q' -> tracking torque u_t` of twelve joints.

The gains of a leg depend on whether the leg is in stance or in swing. The integral is a torque with a separate, small limit.
Anti-windup: if the limiter changed the torque of a joint, the integral of this joint does not grow further towards the requested
torque. If the virtual guide assists a joint, the baseline controller provides only a share (0 to 1) of the torque of this
joint. The integral gain of the joint is multiplied by this share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from atalante_control.structured import Records, zeros
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.types import PERIOD, Vector

PerJoint = tuple[float, float, float, float, float, float]  # one value for each joint of a leg: FH, TH, SH, SK, SA, HA

LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class LegGains:
    """PID gains of the six joints of a leg, in the order of `LEG_JOINTS`.

    Raises:
        ValueError: If a list does not have six values, or if a value is negative or not finite.
    """

    kp: PerJoint  # Nm/rad, proportional gains
    ki: PerJoint  # Nm/(rad s), integral gains
    kd: PerJoint  # Nm s/rad, derivative gains

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd"):
            values = getattr(self, name)
            if len(values) != len(LEG_JOINTS) or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ValueError(f"{name} must be {len(LEG_JOINTS)} finite numbers of at least 0, got {values!r}")


@dataclass(frozen=True)
class PidGains:
    """PID gains of stance leg and swing leg, and the limit of the integral torque.

    The defaults are for walking on the ground, where the stance leg carries the robot.
    """

    stance: LegGains = LegGains(
        kp=(3000.0, 1500.0, 3000.0, 2500.0, 2000.0, 1500.0),
        ki=(300.0, 150.0, 300.0, 250.0, 200.0, 150.0),
        kd=(75.0, 30.0, 75.0, 50.0, 30.0, 20.0),
    )
    swing: LegGains = LegGains(
        kp=(1800.0, 720.0, 1800.0, 900.0, 300.0, 180.0),
        ki=(180.0, 72.0, 180.0, 90.0, 30.0, 18.0),
        kd=(40.0, 12.0, 40.0, 15.0, 3.0, 2.0),
    )
    integral_limit: float = 10.0  # Nm, largest absolute value of the integral torque


#: Gains for the suspended robot. The stance leg then carries no load, so its knee and ankle move only small inertias.
#: With the stance gains of a robot on the ground, knee and ankle of a suspended robot would oscillate.
#: Therefore TH, SK, SA and HA of the stance leg have the gains of the swing leg.
AIR_GAINS = PidGains(
    stance=LegGains(
        kp=(3000.0, 720.0, 3000.0, 900.0, 300.0, 180.0),
        ki=(300.0, 72.0, 300.0, 90.0, 30.0, 18.0),
        kd=(75.0, 12.0, 75.0, 15.0, 3.0, 2.0),
    )
)


class PidRecord:
    """PID data of the twelve joints: gains, integral torque and last requested torque."""

    gains: Annotated[Vector, (3, len(JOINTS))]  # Kp [Nm/rad], Kd [Nm s/rad], and Ki times the cycle time [Nm/rad]
    limit: float  # Nm, largest absolute value of the integral torque
    integral: Annotated[Vector, len(JOINTS)]  # Nm, integral torque
    requested: Annotated[Vector, len(JOINTS)]  # Nm, last torque command, with all contributions, before the limiter


class Pid:
    """PIDs of the twelve joints.

    Call `start_step` at each stance change. Then call `update` and `store_request` once per cycle.

    Attributes:
        records: record of `control`, shape (1,): gains, integral and the last requested torque.
    """

    def __init__(self, gains: PidGains) -> None:
        stance, swing = gains.stance, gains.swing
        # stance leg -> (gains of the left leg, gains of the right leg)
        roles = {LEFT: (stance, swing), RIGHT: (swing, stance)}
        #: Stance leg -> gains, shape (3, 12). The rows are Kp, Kd and Ki * PERIOD, with one column for each joint.
        self._gains_of = {
            s: np.array([(*left.kp, *right.kp), (*left.kd, *right.kd), (*left.ki, *right.ki)])
            * [[1.0], [1.0], [PERIOD]]
            for s, (left, right) in roles.items()
        }
        n = len(JOINTS)
        self.records: Records[PidRecord] = zeros(PidRecord, 1)
        self.limit_integral(gains.integral_limit)
        self._torque = np.zeros(n)
        # Writable copies of q, qd and sent. For a read-only array, numba would compile the kernel again in the
        # control loop, because a read-only array has another type.
        self._inputs = np.zeros(n), np.zeros(n), np.zeros(n)
        self.start_step(RIGHT, np.ones(n))
        self._kernel = compiled(control)
        self.update(np.zeros(2 * n), np.zeros(n), np.zeros(n))

    def reset(self) -> None:
        """Set all integrals to zero."""
        self.records[0].integral[:] = 0.0

    def limit_integral(self, limit: float) -> None:
        """Set the limit of the integral torques, and limit the present integral torques.

        Args:
            limit: largest absolute value of the integral torque of a joint [Nm]; infinity for no limit.
        """
        record = self.records[0]
        record.limit = limit
        np.clip(record.integral, -limit, limit, out=record.integral)

    def start_step(self, stance: int, share: Vector) -> None:
        """Set the gains of each leg for its role as stance leg or swing leg.

        Args:
            stance: stance leg, LEFT or RIGHT.
            share: share of the baseline in the torque of each joint, in [0, 1], shape (12,). The share multiplies the
                integral gains.
        """
        gains = self.records[0].gains
        gains[:] = self._gains_of[stance]
        gains[2] *= share

    def update(self, desired: Vector, q: Vector, qd: Vector, sent: Vector | None = None) -> Vector:
        """Compute the tracking torque u_t of one cycle.

        Args:
            desired: q_des [rad], then q_des' [rad/s], shape (24,).
            q: measured angles, shape (12,) [rad].
            qd: measured speeds, shape (12,) [rad/s].
            sent: torque command of the previous cycle after the limiter, shape (12,) [Nm]; None if the limiter changed nothing.

        Returns:
            u_t, shape (12,) [Nm]. The next call overwrites this array.
        """
        for copy, values in zip(self._inputs, (q, qd, self.requested if sent is None else sent), strict=True):
            copy[:] = values
        self._kernel(self.records, desired, *self._inputs, self._torque)
        return self._torque

    @property
    def requested(self) -> Vector:
        """Return the torque command of the last `store_request`, shape (12,) [Nm]."""
        return self.records[0].requested

    def store_request(self, torque: Vector) -> None:
        """Store the torque command of this cycle for the anti-windup of the next cycle.

        Args:
            torque: torque command before the limiter, with all contributions, shape (12,) [Nm]; copied.
        """
        self.requested[:] = torque


def control(pids: Records[PidRecord], desired: Vector, q: Vector, qd: Vector, sent: Vector, torque: Vector) -> None:
    """Compute the tracking torque u_t, as `Pid.update` does, and write it into `torque`.

    Args:
        pids: `Pid.records`; the integral is updated.
        desired: q_des [rad], then q_des' [rad/s], shape (24,).
        q: measured angles, shape (12,) [rad].
        qd: measured speeds, shape (12,) [rad/s].
        sent: torque command of the previous cycle after the limiter, shape (12,) [Nm].
        torque: u_t, shape (12,) [Nm], overwritten.
    """
    pid, n = pids[0], len(q)
    gains, limit, integral, requested = pid.gains, pid.limit, pid.integral, pid.requested
    for joint in range(n):
        error, rate = desired[joint] - q[joint], desired[n + joint] - qd[joint]
        growth = error * gains[2, joint]
        if (requested[joint] - sent[joint]) * growth <= 0.0:
            integral[joint] = min(max(integral[joint] + growth, -limit), limit)
        torque[joint] = error * gains[0, joint] + rate * gains[1, joint] + integral[joint]
