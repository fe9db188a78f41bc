r"""Ideal plant: simulated hip and knee of one swing leg in the air, with drives, encoders and limiter.

`torque command, push -> motion, measurements`. The search for the worst push uses the plant. The plant shares no table with the
controller. The equation of motion of the plant is

.. math:: m\,[M(q) \ddot q + c(q, \dot q) + g(q)] + f\,r(\dot q) = u + d

with the sagittal hip and knee (SH, SK) as coordinates q, the real joint torques u of the drives, the push d, the friction torque
r of the model, the mass factor m and the friction factor f. The mass matrix M depends only on the knee angle. M is
:math:`A + B \cos q_{SK} + C \sin q_{SK}`, because both axes are parallel. The velocity-dependent torque c follows from the
derivatives of M. The gravity torque g is linear in the sine and cosine of the hip angle and of the sum of both angles. All
coefficients are fitted to Pinocchio's rigid-body dynamics of the whole exoskeleton. The other ten joints rest at their mean
angles of the step.

Each cycle of 1 ms samples the encoders and computes a command. The command acts 1 + `Condition.delay` cycles later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio

from atalante_control.gait.gait import Gait
from atalante_control.model import ArticulatedModel
from atalante_emulator.drive import DriveParameters
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import PERIOD, Vector

#: Indices in JOINTS of the sagittal hip and the sagittal knee of the left leg.
HIP, KNEE = JOINTS.index("left_SH"), JOINTS.index("left_SK")
#: Angles of hip and knee at which the coefficients of the plant are fitted to the rigid-body dynamics [rad].
_HIP_ANGLES = np.linspace(-1.6, 0.2, 7)
_KNEE_ANGLES = np.linspace(0.0, 1.9, 7)
#: Number of integration steps per cycle.
_SUBSTEPS = 2


@dataclass(frozen=True)
class Condition:
    """Deviation of the plant from the model of the controller."""

    friction: float = 1.0  # real friction divided by the friction that the controller compensates
    mass: float = 1.0  # real mass divided by the mass in the model; scales inertia and weight
    noise: float = 0.0  # noise of the joint encoders [rad rms]
    #: Probability that the measurements of a cycle are lost. The commands of a cycle are lost with the same probability.
    loss: float = 0.0
    delay: int = 0  # additional delay of a command [cycles]; if 0, a command acts one cycle after it is computed

    def __str__(self) -> str:
        """Return the deviations as text, for example "friction +20 %, 1 ms delay". The text for no deviation is "as modelled"."""
        parts = [f"{name} {100.0 * (getattr(self, name) - 1.0):+.0f} %" for name in ("friction", "mass")
                 if getattr(self, name) != 1.0]  # fmt: skip
        parts += [f"encoder noise {self.noise:g} rad"] * (self.noise > 0.0)
        parts += [f"{100.0 * self.loss:g} % frame loss"] * (self.loss > 0.0) + [f"{self.delay} ms delay"] * (
            self.delay > 0
        )
        return ", ".join(parts) or "as modelled"


class Plant(NamedTuple):
    """Constants of the plant for compiled functions. Index 0 is the hip, index 1 the knee."""

    #: Mass matrix of hip and knee [kg m2]. Rows: the elements M11, M12 and M22. Columns: the coefficients a, b, c. Shape (3, 3).
    #: An element of the mass matrix is a + b cos(knee angle) + c sin(knee angle).
    mass: Vector
    #: Gravity torques [Nm]. Rows: hip and knee. Columns: the coefficients a, b, c, d. Shape (2, 4).
    #: A gravity torque is a cos(q_SH) + b sin(q_SH) + c cos(q_SH + q_SK) + d sin(q_SH + q_SK).
    weight: Vector
    coulomb: Vector  # dry friction [Nm], shape (2,)
    viscous: Vector  # viscous friction [Nm s/rad], shape (2,)
    friction_speed: float  # speed at which dry friction reaches 76 % of its full value [rad/s]
    tracking: float  # change of the motor torque in a cycle, divided by its distance to the command, 0 to 1
    keep: float  # weight of the old value in the velocity filter, 0 to 1
    torque_max: Vector  # torque limit of the limiter [Nm], shape (2,)
    torque_step: Vector  # largest change of the command in a cycle [Nm], shape (2,)
    velocity_max: Vector  # speed above which the limiter reduces the torque [rad/s], shape (2,)
    #: width of the speed range above `velocity_max` in which the limiter reduces the torque to zero [rad/s]
    velocity_margin: float
    delay: int  # additional delay of a command [cycles]; if 0, a command acts one cycle after it is computed
    #: Probability that the measurements of a cycle are lost. The commands of a cycle are lost with the same probability.
    loss: float


def plant(
    articulated: ArticulatedModel,
    gait: Gait,
    robot: Robot,
    friction: tuple[Vector, Vector, float],
    condition: Condition,
) -> Plant:
    """Return the plant of the left leg in a right-stance step. In this step, the left leg swings.

    Args:
        articulated: empty exoskeleton with the pelvis fixed.
        gait: right-stance step, which gives the angles of the ten joints at rest.
        robot: limits of the drives.
        friction: dry friction [Nm] and viscous friction [Nm s/rad] that the controller compensates, each of shape (2,), and
            the speed at which dry friction reaches 76 % of its full value [rad/s].
        condition: deviation of the plant from the model.
    """
    pose = gait.tables().q.mean(axis=0)
    mass, weight = _fitted(articulated, pose)
    dry, viscous, speed = friction
    drive, both = DriveParameters(), [HIP, KNEE]
    return Plant(
        mass=condition.mass * mass,
        weight=condition.mass * weight,
        coulomb=condition.friction * dry,
        viscous=condition.friction * viscous,
        friction_speed=speed,
        tracking=1.0 - math.exp(-PERIOD / drive.motor.current_loop),
        keep=math.exp(-2.0 * math.pi * drive.velocity_bandwidth * PERIOD),
        torque_max=robot.torque_max[both],
        torque_step=robot.torque_rate_max[both] * PERIOD,
        velocity_max=robot.velocity_max[both],
        velocity_margin=robot.envelope.velocity_margin,
        delay=condition.delay,
        loss=condition.loss,
    )


def _fitted(articulated: ArticulatedModel, pose: Vector) -> tuple[Vector, Vector]:
    """Fit `Plant.mass` and `Plant.weight` to the rigid-body dynamics.

    Raises:
        RuntimeError: If the equation of the plant does not fit the rigid-body dynamics.
    """
    model, into, out_of = articulated
    data, rows = model.createData(), out_of[[HIP, KNEE]]
    masses, weights, knees, sums = [], [], [], []
    for hip in _HIP_ANGLES:
        for knee in _KNEE_ANGLES:
            angles = pose.copy()
            angles[[HIP, KNEE]] = hip, knee
            q = pinocchio.neutral(model)
            q[into] = angles
            upper = np.triu(pinocchio.crba(model, data, q))
            block = (upper + np.triu(upper, 1).T)[np.ix_(rows, rows)]
            masses.append([block[0, 0], block[0, 1], block[1, 1]])
            weights.append(pinocchio.computeGeneralizedGravity(model, data, q)[rows])
            knees.append([1.0, math.cos(knee), math.sin(knee)])
            sums.append([math.cos(hip), math.sin(hip), math.cos(hip + knee), math.sin(hip + knee)])
    mass, mass_error = _least_squares(knees, masses)
    weight, weight_error = _least_squares(sums, weights)
    error = max(mass_error, weight_error)
    if not error < 1e-6:
        raise RuntimeError(
            f"the plant must match the dynamics of the swing leg to 1e-6 (Nm, kg m2), got an error of {error:.3g}"
        )
    return mass, weight


def _least_squares(basis: list[list[float]], values: list[Any]) -> tuple[Vector, float]:
    """Fit each column of `values` with a weighted sum of the columns of `basis`.

    Returns:
        Weights, one row per column of `values`, and the largest error of all fits.
    """
    x, y = np.array(basis), np.array(values)
    coefficients: Vector = np.linalg.lstsq(x, y, rcond=None)[0].T.copy()
    return coefficients, float(np.abs(x @ coefficients.T - y).max())


def inverse_dynamics(constants: Plant, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Return the joint torques [Nm] for the accelerations `qdd`, including gravity and friction, shape (2,).

    Args:
        constants: constants of the plant.
        q: angles of hip and knee, shape (2,) [rad].
        qd: speeds, shape (2,) [rad/s].
        qdd: accelerations, shape (2,) [rad/s2].
    """
    m11, m12, m22, bias_hip, bias_knee = dynamics(constants, q[0], q[1], qd[0], qd[1])
    return np.array([m11 * qdd[0] + m12 * qdd[1] + bias_hip, m12 * qdd[0] + m22 * qdd[1] + bias_knee])


def dynamics(
    constants: Plant, hip: float, knee: float, hip_rate: float, knee_rate: float
) -> tuple[float, float, float, float, float]:
    """Return the mass matrix of hip and knee, and the joint torques that give zero acceleration.

    Args:
        constants: constants of the plant.
        hip: angle of SH [rad].
        knee: angle of SK [rad].
        hip_rate: speed of SH [rad/s].
        knee_rate: speed of SK [rad/s].

    Returns:
        Entries M11, M12 and M22 of the mass matrix [kg m2], then one torque of the hip and one of the knee [Nm]. Each torque is
        the sum of Coriolis, centrifugal, gravity and friction torques.
    """
    a, w = constants.mass, constants.weight
    c, s = math.cos(knee), math.sin(knee)
    m11, m12 = a[0, 0] + a[0, 1] * c + a[0, 2] * s, a[1, 0] + a[1, 1] * c + a[1, 2] * s
    m22 = a[2, 0] + a[2, 1] * c + a[2, 2] * s
    m11_slope, m12_slope = a[0, 2] * c - a[0, 1] * s, a[1, 2] * c - a[1, 1] * s
    ch, sh, ck, sk = math.cos(hip), math.sin(hip), math.cos(hip + knee), math.sin(hip + knee)
    speed = constants.friction_speed
    bias_hip = (
        (m11_slope * hip_rate + m12_slope * knee_rate) * knee_rate
        + w[0, 0] * ch + w[0, 1] * sh + w[0, 2] * ck + w[0, 3] * sk
        + constants.coulomb[0] * math.tanh(hip_rate / speed) + constants.viscous[0] * hip_rate
    )  # fmt: skip
    bias_knee = (
        -0.5 * m11_slope * hip_rate * hip_rate
        + w[1, 0] * ch + w[1, 1] * sh + w[1, 2] * ck + w[1, 3] * sk
        + constants.coulomb[1] * math.tanh(knee_rate / speed) + constants.viscous[1] * knee_rate
    )  # fmt: skip
    return m11, m12, m22, bias_hip, bias_knee


def advance(constants: Plant, leg: Vector, hip_torque: float, knee_torque: float) -> None:
    """Advance the motion of the leg by one cycle under constant torques, with the midpoint rule.

    Args:
        constants: constants of the plant.
        leg: angles of hip and knee [rad], then their speeds [rad/s], shape (4,), updated.
        hip_torque: motor torque plus push at the hip [Nm].
        knee_torque: motor torque plus push at the knee [Nm].
    """
    h = PERIOD / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        a0, a1 = _acceleration(constants, leg[0], leg[1], leg[2], leg[3], hip_torque, knee_torque)
        v0, v1 = leg[2] + 0.5 * h * a0, leg[3] + 0.5 * h * a1
        b0, b1 = _acceleration(
            constants, leg[0] + 0.5 * h * leg[2], leg[1] + 0.5 * h * leg[3], v0, v1, hip_torque, knee_torque
        )
        leg[0] += h * v0
        leg[1] += h * v1
        leg[2] += h * b0
        leg[3] += h * b1


def _acceleration(
    constants: Plant, hip: float, knee: float, hip_rate: float, knee_rate: float, hip_torque: float, knee_torque: float
) -> tuple[float, float]:
    m11, m12, m22, bias_hip, bias_knee = dynamics(constants, hip, knee, hip_rate, knee_rate)
    x, y = hip_torque - bias_hip, knee_torque - bias_knee
    determinant = m11 * m22 - m12 * m12
    return (m22 * x - m12 * y) / determinant, (m11 * y - m12 * x) / determinant


def limited(constants: Plant, joint: int, requested: float, last: float, velocity: float) -> float:
    """Apply the limits of torque, speed and torque rate to a requested torque, and return the command [Nm].

    Args:
        constants: constants of the plant.
        joint: 0 for the hip, 1 for the knee.
        requested: requested torque [Nm].
        last: command of the last cycle [Nm].
        velocity: measured speed [rad/s].
    """
    largest, step = constants.torque_max[joint], constants.torque_step[joint]
    up = largest * min(1.0, max(0.0, 1.0 - (velocity - constants.velocity_max[joint]) / constants.velocity_margin))
    down = largest * min(1.0, max(0.0, 1.0 - (-velocity - constants.velocity_max[joint]) / constants.velocity_margin))
    lowest = min(max(-down, last - step), last + step)
    highest = min(max(up, last - step), last + step)
    return float(min(max(requested, lowest), highest))
