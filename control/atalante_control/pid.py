"""Joint PID of the baseline controller: `q_des, q_des' and measured q, q' -> tracking torque u_t` of twelve joints.

Each leg has the gains of its role, stance or swing. The integral is a torque with a small limit of its own, so that it
cannot wind up; a joint led by the virtual guide integrates only as far as the baseline acts on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_control.gait import PERIOD
from atalante_hal.robot import JOINTS, LEG_JOINTS

Vector = npt.NDArray[np.float64]
PerJoint = tuple[float, float, float, float, float, float]  # FH, TH, SH, SK, SA, HA

LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class LegGains:
    """PID gains of a leg's joints, FH to HA.

    Raises:
        ValueError: not six values, or one that is negative or not finite.
    """

    kp: PerJoint  # Nm/rad
    ki: PerJoint  # Nm/(rad s)
    kd: PerJoint  # Nm s/rad

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd"):
            values = getattr(self, name)
            if len(values) != len(LEG_JOINTS) or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ValueError(f"{name} is {len(LEG_JOINTS)} finite numbers, none negative, not {values!r}")


@dataclass(frozen=True)
class PidGains:
    """Gains of both roles and the limit of the integral.

    The defaults hold for walking on the ground, where the stance leg carries the robot.
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


#: In the air the stance leg carries nothing: its knee and ankle get the gains of a free leg, which would otherwise
#: ring on the little inertia they move (0.16 and 0.04 kg m2 seen alone).
AIR_GAINS = PidGains(
    stance=LegGains(
        kp=(3000.0, 720.0, 3000.0, 900.0, 300.0, 180.0),
        ki=(300.0, 72.0, 300.0, 90.0, 30.0, 18.0),
        kd=(75.0, 12.0, 75.0, 15.0, 3.0, 2.0),
    )
)


class Pid:
    """The twelve PIDs.

    Attributes:
        torque: last result, shape (12,) [Nm], overwritten by the next `update`.
    """

    def __init__(self, gains: PidGains) -> None:
        self._limit = np.full(len(JOINTS), gains.integral_limit)
        stance, swing = gains.stance, gains.swing
        roles = {LEFT: (stance, swing), RIGHT: (swing, stance)}  # left leg, right leg
        self._proportional = {s: _row(left.kp, right.kp) for s, (left, right) in roles.items()}
        self._derivative = {s: _row(left.kd, right.kd) for s, (left, right) in roles.items()}
        self._integral_gain = {s: _row(left.ki, right.ki) * PERIOD for s, (left, right) in roles.items()}
        self._integral = np.zeros(len(JOINTS))
        self._error, self._term = np.empty(len(JOINTS)), np.empty(len(JOINTS))
        self._lower = -self._limit
        self.torque = np.zeros(len(JOINTS))

    def reset(self) -> None:
        """Empty the integrals."""
        self._integral[:] = 0.0

    def update(
        self, stance: int, q_des: Vector, qd_des: Vector, q: Vector, qd: Vector, share: Vector | None = None
    ) -> Vector:
        """u_t of one cycle.

        Args:
            stance: LEFT or RIGHT.
            q_des, q: shape (12,) [rad].
            qd_des, qd: shape (12,) [rad/s].
            share: how far the baseline acts on each joint, shape (12,) in [0, 1]; scales what is integrated.
        """
        error, term, integral, torque = self._error, self._term, self._integral, self.torque
        np.subtract(q_des, q, out=error)
        np.multiply(error, self._integral_gain[stance], out=term)
        if share is not None:
            np.multiply(term, share, out=term)
        np.add(integral, term, out=integral)
        np.maximum(integral, self._lower, out=integral)
        np.minimum(integral, self._limit, out=integral)
        np.multiply(error, self._proportional[stance], out=torque)
        np.subtract(qd_des, qd, out=error)
        np.multiply(error, self._derivative[stance], out=error)
        np.add(torque, error, out=torque)
        np.add(torque, integral, out=torque)
        return torque


def _row(left: Sequence[float], right: Sequence[float]) -> Vector:
    return np.array([*left, *right], dtype=np.float64)
