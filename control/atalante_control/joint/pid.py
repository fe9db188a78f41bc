"""Joint PID of the baseline controller: `q_des, q_des' and measured q, q' -> tracking torque u_t` of twelve joints.

Each leg has the gains of its role, stance or swing. The integral is a torque with a separate, small limit. Anti-windup: if the
limiter reduced the torque of a joint, its integral does not grow further in that direction. The integral of a joint assisted by
the virtual guide is scaled by the share of the baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from atalante_control.gait.gait import PERIOD
from atalante_hal.compiled import compiled
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.types import Vector

PerJoint = tuple[float, float, float, float, float, float]  # FH, TH, SH, SK, SA, HA

LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class LegGains:
    """PID gains of the joints of a leg, FH to HA.

    Raises:
        ValueError: If a list does not have six values, or if a value is negative or not finite.
    """

    kp: PerJoint  # Nm/rad
    ki: PerJoint  # Nm/(rad s)
    kd: PerJoint  # Nm s/rad

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd"):
            values = getattr(self, name)
            if len(values) != len(LEG_JOINTS) or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ValueError(f"{name} must be {len(LEG_JOINTS)} finite numbers of at least 0, got {values!r}")


@dataclass(frozen=True)
class PidGains:
    """Gains of both roles and the limit of the integral.

    The defaults are those for walking on the ground, where the stance leg carries the robot.
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
    integral_limit: float = 10.0  # Nm


#: Gains in the air. The stance leg carries no load there, so its TH, SK, SA and HA get the gains of a free leg. With the gains
#: for the ground, knee and ankle would oscillate, because they move only a small inertia (0.16 and 0.04 kg m2).
AIR_GAINS = PidGains(
    stance=LegGains(
        kp=(3000.0, 720.0, 3000.0, 900.0, 300.0, 180.0),
        ki=(300.0, 72.0, 300.0, 90.0, 30.0, 18.0),
        kd=(75.0, 12.0, 75.0, 15.0, 3.0, 2.0),
    )
)


class Pid:
    """PIDs of the twelve joints. Call `start_step` at each step change, then `update` once a cycle.

    Attributes:
        torque: last result, shape (12,) [Nm], overwritten by the next `update`. The caller adds further torques in place.
        gains: Kp, Kd and Ki times the cycle, shape (3, 12).
        integral: integral torque, shape (12,) [Nm].
        limit: largest absolute value of the integral torque [Nm].
    """

    def __init__(self, gains: PidGains) -> None:
        stance, swing = gains.stance, gains.swing
        roles = {LEFT: (stance, swing), RIGHT: (swing, stance)}  # left leg, right leg
        self._gains_of = {
            s: np.array([(*left.kp, *right.kp), (*left.kd, *right.kd), (*left.ki, *right.ki)])
            * [[1.0], [1.0], [PERIOD]]
            for s, (left, right) in roles.items()
        }
        n = len(JOINTS)
        self.limit, self.gains = gains.integral_limit, np.zeros((3, n))
        self.integral, self.torque = np.zeros(n), np.zeros(n)
        self.start_step(RIGHT, np.ones(n))
        self._kernel = compiled(control)
        self.update(np.zeros(2 * n), np.zeros(n), np.zeros(n))

    def reset(self) -> None:
        """Set all integrals to zero."""
        self.integral[:] = 0.0

    def start_step(self, stance: int, share: Vector) -> None:
        """Set the gains of each leg according to its role.

        Args:
            stance: stance leg, LEFT or RIGHT.
            share: share of the baseline in the torque of each joint, shape (12,), in [0, 1]; scales the integral gains.
        """
        self.gains[:] = self._gains_of[stance]
        self.gains[2] *= share

    def update(self, desired: Vector, q: Vector, qd: Vector, sent: Vector | None = None) -> Vector:
        """Compute the tracking torque u_t of one cycle.

        Args:
            desired: q_des [rad], then q_des' [rad/s], shape (24,).
            q: measured angles, shape (12,) [rad].
            qd: measured speeds, shape (12,) [rad/s].
            sent: last `torque` after the limiter, shape (12,) [Nm]; None: not limited.

        Returns:
            `torque`.
        """
        sent = self.torque if sent is None else sent
        self._kernel(desired, q, qd, self.gains, self.limit, sent, self.integral, self.torque)
        return self.torque


def control(
    desired: Vector, q: Vector, qd: Vector, gains: Vector, limit: float, sent: Vector, integral: Vector, torque: Vector
) -> None:
    """Write u_t into `torque`, as in `Pid.update`.

    Args:
        desired: q_des [rad], then q_des' [rad/s], shape (24,).
        q: measured angles, shape (12,) [rad].
        qd: measured speeds, shape (12,) [rad/s].
        gains: Kp, Kd and Ki times the cycle, shape (3, 12).
        limit: largest absolute value of the integral torque [Nm].
        sent: last `torque` after the limiter, shape (12,) [Nm].
        integral: integral torque, shape (12,) [Nm], updated.
        torque: last torque command, shape (12,) [Nm]; overwritten with u_t.
    """
    n = len(q)
    for joint in range(n):
        error, rate = desired[joint] - q[joint], desired[n + joint] - qd[joint]
        growth = error * gains[2, joint]
        if (torque[joint] - sent[joint]) * growth <= 0.0:
            integral[joint] = min(max(integral[joint] + growth, -limit), limit)
        torque[joint] = error * gains[0, joint] + rate * gains[1, joint] + integral[joint]
