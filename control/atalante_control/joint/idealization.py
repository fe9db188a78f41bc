"""Joint idealization: what makes an assisted joint feel like a free inertia. `q, q' -> u_i`, with u_g from `gravity`.

The paper's u_i = k_d sign(q') + k_v q' + u_g, with three things it leaves open settled here:

- It prints sign(q) and k_v q; friction opposes the velocity, and that is what is meant.
- sign is smoothed to tanh(q' / v_s): at rest the measured velocity changes sign with its noise, and a torque of
  +-k_d each cycle would shake the joint.
- The guide takes the two joints for separate inertias J, J q'' = u_v. They are not: hip and knee share the shank (3.6
  kg m2 off the diagonal against 1.9 on it), so a torque on one throws the other, and a moving knee pulls at the hip.
  `AssistedInertia` turns the torques meant for the separate inertias into those that give the coupled pair the same
  accelerations, and gives the pair's velocity torques (centrifugal, Coriolis), which belong to u_i as gravity does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio

from atalante_control.model import ArticulatedModel
from atalante_hal.robot import JOINTS, LEG_JOINTS

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

_ASSISTED = (LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK"))

#: What the merge knows of the assisted joints, SH and SK.
LAW = np.dtype(
    [
        ("fit", np.float64, (3, 3)),
        ("inertias", np.float64, 2),
        ("decoupled", np.bool_),
        ("coulomb", np.float64, 2),
        ("viscous", np.float64, 2),
        ("smoothing", np.float64),
    ],
    align=True,
)


@dataclass(frozen=True)
class Friction:
    """Joint friction as identified on the robot, each leg joint FH to HA.

    Raises:
        ValueError: not six values, a negative one, or a smoothing speed that is not positive.
    """

    coulomb: tuple[float, ...] = (4.0, 3.0, 5.0, 5.0, 2.0, 1.0)  # Nm, k_d
    viscous: tuple[float, ...] = (6.0, 4.0, 6.0, 4.0, 1.0, 0.5)  # Nm s/rad, k_v
    smoothing: float = 0.05  # rad/s, v_s

    def __post_init__(self) -> None:
        for name in ("coulomb", "viscous"):
            values = getattr(self, name)
            if len(values) != len(LEG_JOINTS) or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ValueError(f"{name} is {len(LEG_JOINTS)} finite numbers, none negative, not {values!r}")
        if not (math.isfinite(self.smoothing) and self.smoothing > 0.0):
            raise ValueError(f"smoothing is a positive speed in rad/s, not {self.smoothing!r}")

    def torque(self, joint: int, velocity: float) -> float:
        """Compensation k_d tanh(q' / v_s) + k_v q' [Nm] of one of `LEG_JOINTS` by index."""
        return friction(velocity, self.coulomb[joint], self.viscous[joint], self.smoothing)


class AssistedInertia:
    """Mass matrix of SH and SK of one leg, which depends on the knee alone, in closed form.

    The block is M(q_SK) = A + B cos q_SK + C sin q_SK; A, B, C come from three evaluations of Pinocchio's CRBA with the
    other joints at rest in the middle of their swing.

    Attributes:
        inertias: J of SH and SK [kg m2], the largest diagonal of M along the swing.
        fit: A, B, C of M11, of M12 and of M22, shape (3, 3) [kg m2].
    """

    def __init__(self, articulated: ArticulatedModel, swing: Vector) -> None:
        """Identify the block of the left leg; the right one is the same by symmetry.

        Args:
            swing: poses of a step the left leg swings in, shape (n, 12) [rad].
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
        """M11, M12, M22 [kg m2] at a knee angle [rad]; 1 is SH, 2 is SK."""
        m11, m12, m22 = (self.fit[:, 0] + self.fit[:, 1] * math.cos(knee) + self.fit[:, 2] * math.sin(knee)).tolist()
        return m11, m12, m22

    def torques(self, knee: float, hip_rate: float, knee_rate: float, u: Pair) -> Pair:
        """Torques of SH and SK [Nm] under which each moves as J q'' = u, while the leg's other joints rest.

        tau = M J^-1 u + c, with c the velocity torques of M(q_SK): c1 = M11' q1' q2' + M12' q2'^2, c2 = -M11' q1'^2 / 2.

        Args:
            knee: angle of SK [rad].
            hip_rate, knee_rate: [rad/s].
            u: torques meant for the separate inertias `inertias` [Nm].
        """
        return coupled(self.fit, self.inertias, knee, hip_rate, knee_rate, u)

    def ideal(self, knee: float, hip_rate: float, knee_rate: float, tau: Pair) -> Pair:
        """Inverse of `torques`: what real torques `tau` without gravity are to the separate inertias [Nm]."""
        c1, c2 = self.torques(knee, hip_rate, knee_rate, (0.0, 0.0))
        on_hip, on_knee = (self.ideal_of(knee) @ (tau[0] - c1, tau[1] - c2)).tolist()
        return on_hip, on_knee

    def ideal_of(self, knee: float) -> Vector:
        """Return A = J M^-1, by which real torques without velocity torques count on the separate inertias. Shape (2, 2).

        Args:
            knee: angle of SK [rad].
        """
        m11, m12, m22 = self.block(knee)
        inverse: Vector = np.array([[m22, -m12], [-m12, m11]]) / (m11 * m22 - m12 * m12)
        return np.reshape(self.inertias, (2, 1)) * inverse


def law_of(friction: Friction, inertia: AssistedInertia, decoupled: bool) -> npt.NDArray[np.void]:
    """What `merge` knows, shape (1,).

    Args:
        decoupled: u_f + u_v are meant for the separate inertias and go through `AssistedInertia.torques`.
    """
    laws = np.zeros(1, LAW)
    law = laws[0]
    law["fit"], law["inertias"], law["decoupled"] = inertia.fit, inertia.inertias, decoupled
    law["coulomb"], law["viscous"] = ([row[i] for i in _ASSISTED] for row in (friction.coulomb, friction.viscous))
    law["smoothing"] = friction.smoothing
    return laws


def merge(
    laws: npt.NDArray[np.void], torque: Vector, gravity: Vector, q: Vector, qd: Vector, leg: int, w: float, u: Pair
) -> None:
    """w u_t + (1 - w) (u_i + u_f + u_v) on SH and SK of the swing leg.

    Args:
        laws: of `law_of`.
        torque: u_t, shape (12,) [Nm]; those of SH and SK are overwritten.
        gravity: u_g, shape (12,) [Nm].
        q, qd: shape (12,) [rad], [rad/s].
        leg: first joint of the swing leg.
        w: share of the baseline in [0, 1).
        u: u_f + u_v of SH and SK [Nm].
    """
    law, hip, knee = laws[0], leg + _ASSISTED[0], leg + _ASSISTED[1]
    if law["decoupled"]:
        u = coupled(law["fit"], law["inertias"], q[knee], qd[hip], qd[knee], u)
    for i in range(2):
        joint = leg + _ASSISTED[i]
        assisted = gravity[joint] + friction(qd[joint], law["coulomb"][i], law["viscous"][i], law["smoothing"]) + u[i]
        torque[joint] = w * torque[joint] + (1.0 - w) * assisted


def friction(velocity: float, coulomb: float, viscous: float, smoothing: float) -> float:
    """Compensation k_d tanh(q' / v_s) + k_v q' [Nm]."""
    return coulomb * math.tanh(velocity / smoothing) + viscous * velocity


def coupled(fit: Vector, inertias: Vector | Pair, knee: float, hip_rate: float, knee_rate: float, u: Pair) -> Pair:
    """As `AssistedInertia.torques`."""
    c, s = math.cos(knee), math.sin(knee)
    m11, m12 = fit[0, 0] + fit[0, 1] * c + fit[0, 2] * s, fit[1, 0] + fit[1, 1] * c + fit[1, 2] * s
    m22 = fit[2, 0] + fit[2, 1] * c + fit[2, 2] * s
    m11_slope, m12_slope = fit[0, 2] * c - fit[0, 1] * s, fit[1, 2] * c - fit[1, 1] * s
    hip_acceleration, knee_acceleration = u[0] / inertias[0], u[1] / inertias[1]
    return (
        m11 * hip_acceleration + m12 * knee_acceleration + (m11_slope * hip_rate + m12_slope * knee_rate) * knee_rate,
        m12 * hip_acceleration + m22 * knee_acceleration - 0.5 * m11_slope * hip_rate * hip_rate,
    )
