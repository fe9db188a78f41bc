"""Joint idealization: torques with which an assisted joint moves like a free inertia. `q, q' -> u_i`, with u_g from `gravity`.

The law of the paper is u_i = k_d sign(q') + k_v q' + u_g. Three points are decided here:

- The paper prints sign(q) and k_v q. Friction opposes the velocity, so this module uses q'.
- The sign is smoothed to tanh(q' / v_s). At rest the measured velocity changes sign with its noise, and a torque of +-k_d in
  each cycle would shake the joint.
- The guide treats the two joints as separate inertias, J q'' = u_v. In fact hip and knee share the shank (3.6 kg m2 off the
  diagonal of the mass matrix, 1.9 on it), so a torque on one joint accelerates the other, and a moving knee loads the hip.
  `AssistedInertia` converts torques on the separate inertias to torques that cause the same accelerations of the coupled pair.
  It adds the velocity torques of the pair (centrifugal, Coriolis), which are part of u_i like gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pinocchio

from atalante_control.model import ArticulatedModel
from atalante_control.structured import Records, zeros
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.types import Vector

Pair = tuple[float, float]

_ASSISTED = (LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK"))


class Law:
    """Parameters of `merge` for the assisted joints, SH and SK."""

    fit: Annotated[Vector, (3, 3)]  # kg m2, `AssistedInertia.fit`
    inertias: Annotated[Vector, 2]  # kg m2, inertias J of SH and SK without their coupling, see `AssistedInertia`
    decoupled: bool  # true: u_f + u_v are converted with the mass matrix of SH and SK
    coulomb: Annotated[Vector, 2]  # Nm
    viscous: Annotated[Vector, 2]  # Nm s/rad
    smoothing: float  # rad/s


@dataclass(frozen=True)
class Friction:
    """Joint friction as identified on the robot, for each leg joint FH to HA.

    Raises:
        ValueError: If a list does not have six values, a value is negative, or the smoothing speed is not positive.
    """

    coulomb: tuple[float, ...] = (4.0, 3.0, 5.0, 5.0, 2.0, 1.0)  # Nm, k_d
    viscous: tuple[float, ...] = (6.0, 4.0, 6.0, 4.0, 1.0, 0.5)  # Nm s/rad, k_v
    smoothing: float = 0.05  # rad/s, v_s

    def __post_init__(self) -> None:
        for name in ("coulomb", "viscous"):
            values = getattr(self, name)
            if len(values) != len(LEG_JOINTS) or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ValueError(f"{name} must be {len(LEG_JOINTS)} finite numbers of at least 0, got {values!r}")
        if not (math.isfinite(self.smoothing) and self.smoothing > 0.0):
            raise ValueError(f"smoothing must be a positive speed in rad/s, got {self.smoothing!r}")

    def torque(self, joint: int, velocity: float) -> float:
        """Return the friction compensation k_d tanh(q' / v_s) + k_v q' of a joint [Nm].

        Args:
            joint: index in `LEG_JOINTS`.
            velocity: q' [rad/s].
        """
        return friction(velocity, self.coulomb[joint], self.viscous[joint], self.smoothing)


class AssistedInertia:
    """Mass matrix of SH and SK of one leg in closed form; it depends only on the knee angle.

    The block is M(q_SK) = A + B cos q_SK + C sin q_SK. A, B and C follow from three evaluations of the CRBA of Pinocchio, with
    the other joints at their mean angles during the swing.

    Attributes:
        inertias: J of SH and SK [kg m2], the largest diagonal elements of M during the swing.
        fit: A, B, C (columns) of M11, M12 and M22 (rows), shape (3, 3) [kg m2].
    """

    def __init__(self, articulated: ArticulatedModel, swing: Vector) -> None:
        """Compute the mass matrix of SH and SK of the left leg. By symmetry it also applies to the right leg.

        Args:
            articulated: empty exoskeleton with the pelvis fixed.
            swing: poses of a step in which the left leg swings, shape (n, 12) [rad].
        """
        posture = swing.mean(axis=0)
        model = articulated.model
        data = model.createData()
        hip, knee = JOINTS.index("left_SH"), JOINTS.index("left_SK")
        rows = articulated.v[[hip, knee]]
        angles = np.array([0.0, 0.8, 1.6])
        entries = []
        for angle in angles:
            q = pinocchio.neutral(model)
            pose = posture.copy()
            pose[knee] = angle
            q[articulated.q] = pose
            upper = np.triu(pinocchio.crba(model, data, q))
            mass = upper + np.triu(upper, 1).T
            entries.append(mass[np.ix_(rows, rows)][[0, 0, 1], [0, 1, 1]])
        basis = np.stack([np.ones(3), np.cos(angles), np.sin(angles)], axis=1)
        self.fit: Vector = np.linalg.solve(basis, np.array(entries)).T.copy()
        blocks = np.array([self.block(float(angle)) for angle in swing[:, knee]])
        self.inertias: Pair = (float(blocks[:, 0].max()), float(blocks[:, 2].max()))

    def block(self, knee: float) -> tuple[float, float, float]:
        """Return the mass matrix at a knee angle [kg m2]: M11 (SH), M12 (coupling of SH and SK), M22 (SK).

        Args:
            knee: angle of SK [rad].
        """
        m11, m12, m22 = (self.fit[:, 0] + self.fit[:, 1] * math.cos(knee) + self.fit[:, 2] * math.sin(knee)).tolist()
        return m11, m12, m22

    def torques(self, knee: float, hip_rate: float, knee_rate: float, u: Pair) -> Pair:
        """Return the torques [Nm] that accelerate SH and SK as J q'' = u. The other joints are assumed at rest.

        tau = M J^-1 u + c, with c the velocity torques of M(q_SK): c1 = M11' q1' q2' + M12' q2'^2, c2 = -M11' q1'^2 / 2.

        Args:
            knee: angle of SK [rad].
            hip_rate: speed of SH [rad/s].
            knee_rate: speed of SK [rad/s].
            u: torques on the separate inertias `inertias`, SH and SK [Nm].
        """
        return coupled(self.fit, self.inertias, knee, hip_rate, knee_rate, u)

    def ideal(self, knee: float, hip_rate: float, knee_rate: float, tau: Pair) -> Pair:
        """Return the torques u [Nm] in J q'' = u that are equivalent to real torques of SH and SK. Inverse of `torques`.

        Args:
            knee: angle of SK [rad].
            hip_rate: speed of SH [rad/s].
            knee_rate: speed of SK [rad/s].
            tau: real torques of SH and SK without gravity [Nm].
        """
        c1, c2 = self.torques(knee, hip_rate, knee_rate, (0.0, 0.0))
        on_hip, on_knee = (self.ideal_of(knee) @ (tau[0] - c1, tau[1] - c2)).tolist()
        return on_hip, on_knee

    def ideal_of(self, knee: float) -> Vector:
        """Return A = J M^-1, shape (2, 2). It converts real torques minus velocity torques to torques u in J q'' = u.

        Args:
            knee: angle of SK [rad].
        """
        m11, m12, m22 = self.block(knee)
        inverse: Vector = np.array([[m22, -m12], [-m12, m11]]) / (m11 * m22 - m12 * m12)
        return np.reshape(self.inertias, (2, 1)) * inverse


def law_of(friction: Friction, inertia: AssistedInertia, decoupled: bool) -> Records[Law]:
    """Return the parameters of `merge`, shape (1,).

    Args:
        friction: friction to compensate.
        inertia: mass matrix of SH and SK.
        decoupled: whether u_f + u_v are torques on the separate inertias, which `AssistedInertia.torques` converts.
    """
    laws: Records[Law] = zeros(Law, 1)
    law = laws[0]
    law.fit[:], law.inertias[:], law.decoupled = inertia.fit, inertia.inertias, decoupled
    law.coulomb[:], law.viscous[:] = ([row[i] for i in _ASSISTED] for row in (friction.coulomb, friction.viscous))
    law.smoothing = friction.smoothing
    return laws


def merge(
    laws: Records[Law], leg: int, w: float, u: Pair, q: Vector, qd: Vector, gravity: Vector, torque: Vector
) -> None:
    """Set the torque of SH and SK of the swing leg to w u_t + (1 - w) (u_i + u_f + u_v).

    Args:
        laws: result of `law_of`.
        leg: index in JOINTS of the first joint of the swing leg.
        w: weight of the baseline in [0, 1).
        u: u_f + u_v of SH and SK [Nm].
        q: measured angles, shape (12,) [rad].
        qd: measured speeds, shape (12,) [rad/s].
        gravity: u_g, shape (12,) [Nm].
        torque: u_t, shape (12,) [Nm]; the entries of SH and SK are overwritten.
    """
    law = laws[0]
    hip, knee = leg + _ASSISTED[0], leg + _ASSISTED[1]
    if law.decoupled:
        u = coupled(law.fit, law.inertias, q[knee], qd[hip], qd[knee], u)
    for i in range(2):
        joint = leg + _ASSISTED[i]
        assisted = gravity[joint] + friction(qd[joint], law.coulomb[i], law.viscous[i], law.smoothing) + u[i]
        torque[joint] = w * torque[joint] + (1.0 - w) * assisted


def friction(velocity: float, coulomb: float, viscous: float, smoothing: float) -> float:
    """Return the friction compensation k_d tanh(q' / v_s) + k_v q' [Nm].

    Args:
        velocity: q' [rad/s].
        coulomb: k_d [Nm].
        viscous: k_v [Nm s/rad].
        smoothing: v_s [rad/s].
    """
    return coulomb * math.tanh(velocity / smoothing) + viscous * velocity


def coupled(fit: Vector, inertias: Vector | Pair, knee: float, hip_rate: float, knee_rate: float, u: Pair) -> Pair:
    """Convert torques u in J q'' = u to real torques, as `AssistedInertia.torques` does. Compiled kernels can call it.

    Args:
        fit: `AssistedInertia.fit`.
        inertias: `AssistedInertia.inertias`.
        knee: angle of SK [rad].
        hip_rate: speed of SH [rad/s].
        knee_rate: speed of SK [rad/s].
        u: torques on the separate inertias, SH and SK [Nm].
    """
    c, s = math.cos(knee), math.sin(knee)
    m11, m12 = fit[0, 0] + fit[0, 1] * c + fit[0, 2] * s, fit[1, 0] + fit[1, 1] * c + fit[1, 2] * s
    m22 = fit[2, 0] + fit[2, 1] * c + fit[2, 2] * s
    m11_slope, m12_slope = fit[0, 2] * c - fit[0, 1] * s, fit[1, 2] * c - fit[1, 1] * s
    hip_acceleration, knee_acceleration = u[0] / inertias[0], u[1] / inertias[1]
    return (
        m11 * hip_acceleration + m12 * knee_acceleration + (m11_slope * hip_rate + m12_slope * knee_rate) * knee_rate,
        m12 * hip_acceleration + m22 * knee_acceleration - 0.5 * m11_slope * hip_rate * hip_rate,
    )
