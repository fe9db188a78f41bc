"""Joint idealization: torques u_i with which an assisted joint moves like a free inertia. `q, q', u_g -> u_i`.

The law of the paper is u_i = k_d sign(q') + k_v q' + u_g, with the gravity torque u_g. This module differs from the paper in
three points:

- The paper prints sign(q) and k_v q. Friction opposes the velocity, so this module uses q'.
- The sign is smoothed to tanh(q' / v_s). At rest, noise changes the sign of the measured velocity from cycle to cycle. Without
  smoothing, the torque would switch between +k_d and -k_d and shake the joint.
- The paper treats hip and knee as separate inertias. In fact both joints move the shank: the off-diagonal element of the mass
  matrix is up to 3.6 kg m2, and the diagonal element of the knee is 1.9 kg m2. A torque at one joint therefore accelerates both
  joints, and a moving knee loads the hip. `AssistedInertia` is the mass matrix of both joints. u_i contains the velocity torques
  (centrifugal, Coriolis) of this mass matrix.
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
    """Parameters of `idealization` for the assisted joints, sagittal hip and knee."""

    #: Coefficients A, B, C of the mass matrix [kg m2]: M = A + B cos(knee) + C sin(knee). Row: M11, M12, M22. Column: A, B, C.
    fit: Annotated[Vector, (3, 3)]
    coulomb: Annotated[Vector, 2]  # Nm, Coulomb friction k_d
    viscous: Annotated[Vector, 2]  # Nm s/rad, viscous friction k_v
    smoothing: float  # rad/s, smoothing speed v_s


@dataclass(frozen=True)
class Friction:
    """Joint friction as identified on the robot, one value per joint of a leg in the order of `LEG_JOINTS`.

    Raises:
        ValueError: If a list does not have six values, a value is negative, or the smoothing speed is not positive.
    """

    coulomb: tuple[float, ...] = (4.0, 3.0, 5.0, 5.0, 2.0, 1.0)  # Nm, Coulomb friction k_d of each joint
    viscous: tuple[float, ...] = (6.0, 4.0, 6.0, 4.0, 1.0, 0.5)  # Nm s/rad, viscous friction k_v of each joint
    smoothing: float = 0.05  # rad/s, smoothing speed v_s

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
    """Closed-form mass matrix of sagittal hip and knee (SH, SK) of one leg, as a function of the knee angle.

    The mass matrix is M(q_SK) = A + B cos q_SK + C sin q_SK. A, B and C follow from three evaluations of Pinocchio's composite
    rigid body algorithm, with all other joints at their mean angles during the swing.

    Attributes:
        inertias: J of SH and SK [kg m2], the largest diagonal elements of M during the swing.
        fit: A, B, C (columns) of M11, M12 and M22 (rows), shape (3, 3) [kg m2].
    """

    def __init__(self, articulated: ArticulatedModel, swing: Vector) -> None:
        """Compute the mass matrix of sagittal hip and knee of the left leg. By symmetry the matrix also applies to the right leg.

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
        """Return the mass matrix at a knee angle [kg m2]: M11 (sagittal hip), M12 (coupling), M22 (knee).

        Args:
            knee: angle of SK [rad].
        """
        m11, m12, m22 = (self.fit[:, 0] + self.fit[:, 1] * math.cos(knee) + self.fit[:, 2] * math.sin(knee)).tolist()
        return m11, m12, m22

    def velocity_torques(self, knee: float, hip_rate: float, knee_rate: float) -> Pair:
        """Return the velocity torques (centrifugal, Coriolis) of sagittal hip and knee [Nm].

        Args:
            knee: angle of SK [rad].
            hip_rate: speed of SH [rad/s].
            knee_rate: speed of SK [rad/s].
        """
        return velocity_torques(self.fit, knee, hip_rate, knee_rate)


def law_of(friction: Friction, inertia: AssistedInertia) -> Records[Law]:
    """Return the parameters of `idealization`, shape (1,).

    Args:
        friction: friction to compensate.
        inertia: mass matrix of SH and SK.
    """
    laws: Records[Law] = zeros(Law, 1)
    law = laws[0]
    law.fit[:] = inertia.fit
    law.coulomb[:], law.viscous[:] = ([row[i] for i in _ASSISTED] for row in (friction.coulomb, friction.viscous))
    law.smoothing = friction.smoothing
    return laws


def idealization(law: Law, knee: float, hip_rate: float, knee_rate: float, gravity: Pair) -> Pair:
    """Return u_i of sagittal hip and knee, the sum of friction compensation, velocity torques and gravity torques u_g [Nm].

    Args:
        law: result of `law_of`.
        knee: angle of SK [rad].
        hip_rate: speed of SH [rad/s].
        knee_rate: speed of SK [rad/s].
        gravity: u_g of SH and SK [Nm].
    """
    hip_c, knee_c = velocity_torques(law.fit, knee, hip_rate, knee_rate)
    return (
        gravity[0] + hip_c + friction(hip_rate, law.coulomb[0], law.viscous[0], law.smoothing),
        gravity[1] + knee_c + friction(knee_rate, law.coulomb[1], law.viscous[1], law.smoothing),
    )


def friction(velocity: float, coulomb: float, viscous: float, smoothing: float) -> float:
    """Return the friction compensation k_d tanh(q' / v_s) + k_v q' [Nm].

    Args:
        velocity: q' [rad/s].
        coulomb: k_d [Nm].
        viscous: k_v [Nm s/rad].
        smoothing: v_s [rad/s].
    """
    return coulomb * math.tanh(velocity / smoothing) + viscous * velocity


def mass(fit: Vector, knee: float) -> tuple[float, float, float]:
    """Return M11, M12 and M22 of sagittal hip and knee at a knee angle [kg m2]. Compiled kernels can call this function.

    Args:
        fit: `AssistedInertia.fit`.
        knee: angle of SK [rad].
    """
    c, s = math.cos(knee), math.sin(knee)
    return (
        fit[0, 0] + fit[0, 1] * c + fit[0, 2] * s,
        fit[1, 0] + fit[1, 1] * c + fit[1, 2] * s,
        fit[2, 0] + fit[2, 1] * c + fit[2, 2] * s,
    )


def velocity_torques(fit: Vector, knee: float, hip_rate: float, knee_rate: float) -> Pair:
    """Return the velocity torques (centrifugal, Coriolis) of sagittal hip and knee [Nm]. Compiled kernels can call this function.

    The torque of SH is M11' q1' q2' + M12' q2'^2, and the torque of SK is -M11' q1'^2 / 2. M11' and M12' are derivatives with
    respect to the knee angle; q1' and q2' are the speeds of SH and SK.

    Args:
        fit: `AssistedInertia.fit`.
        knee: angle of SK [rad].
        hip_rate: speed of SH [rad/s].
        knee_rate: speed of SK [rad/s].
    """
    c, s = math.cos(knee), math.sin(knee)
    m11_slope, m12_slope = fit[0, 2] * c - fit[0, 1] * s, fit[1, 2] * c - fit[1, 1] * s
    return (m11_slope * hip_rate + m12_slope * knee_rate) * knee_rate, -0.5 * m11_slope * hip_rate * hip_rate
