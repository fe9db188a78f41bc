r"""Backup policy of the virtual guide: control law that holds sagittal hip and knee (SH, SK) of the swing leg inside the guide.

`stiffness at the joints, mass matrix -> gains Kv, Dv -> responses of the sampled loop`. The guide filter and the certificate use
the responses. The backup torque is

.. math:: u_B = u_i + M(q)(\ddot q_{des} - K_v e - D_v \dot e), \qquad e = q - q_{des},

where the torque :math:`u_i` compensates gravity, friction, centrifugal and Coriolis torques. The backup torque contains
the desired acceleration, so the desired motion causes no error. Under a disturbance torque d, the error satisfies
:math:`\ddot e = -K_v e - D_v \dot e + M^{-1} d`. The gains :math:`K_v = M_0^{-1} \mathrm{diag}(k)` are computed with
the mass matrix :math:`M_0` at a knee angle in the middle of the swing. A constant disturbance d deflects each joint by
about d / k. The `stiffness` k is therefore the stiffness of the real joint, and not of a mode.
The gains :math:`D_v = 2 \zeta \sqrt{K_v}` have the eigenvectors of Kv. The loop therefore consists of two modes, one
with large and one with small inertia ("heavy" and "light").

The controller is sampled. The state (z, z', v, m, p) of a mode contains the error z, the true rate z', the measured rate v behind
the low-pass of the drive, the acceleration m caused by the motor torque, and the acceleration p of the last command.
`responses` computes the exact motion of this loop, cycle by cycle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from atalante_hal.types import PERIOD, Vector

Pair = tuple[float, float]

#: Number of elements of the state x. The state has five quantities, each with two elements: sagittal hip, then knee.
#: 1. Tracking error e = q - q_des [rad].
#: 2. True error rate e' [rad/s].
#: 3. Measured error rate e', after the low-pass of the drives [rad/s].
#: 4. Error acceleration e'' that the current motor torque causes [rad/s2].
#: 5. Error acceleration e'' that the torque of the last command will cause [rad/s2].
STATES = 10


@dataclass(frozen=True)
class SampledLoop:
    """Time behaviour of the drives and of the bus, between a command and the next measurement.

    Raises:
        ValueError: If a value is not positive and finite.
    """

    torque_lag: float = 0.5e-3  # s, time constant of the torque of a motor
    velocity_bandwidth: float = 80.0  # Hz, cut-off frequency of the low-pass of the measured velocity

    def __post_init__(self) -> None:
        for name in ("torque_lag", "velocity_bandwidth"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} of the drives must be positive and finite, got {value!r}")

    @property
    def tracking(self) -> float:
        """Return the share of a commanded torque change that a motor reaches within one cycle."""
        return 1.0 - math.exp(-PERIOD / self.torque_lag)

    @property
    def keep(self) -> float:
        """Return the weight of the old value in the low-pass of the measured velocity."""
        return math.exp(-2.0 * math.pi * self.velocity_bandwidth * PERIOD)

    @property
    def velocity_lag(self) -> float:
        """Return the lag of the measured velocity under a constant acceleration [s]."""
        return 0.5 * PERIOD * (1.0 + self.keep) / (1.0 - self.keep)

    @property
    def command_lag(self) -> float:
        """Return the mean time from a measurement to the motor torque that is computed from this measurement [s]."""
        return PERIOD * (0.5 + 1.0 / self.tracking)


@dataclass(frozen=True)
class BackupPolicy:
    """Gains of the backup policy, the control law that returns the coupled sagittal hip and knee to the desired motion.

    Raises:
        ValueError: If a value is not positive and finite, or the mass matrix is not positive definite.
    """

    stiffness: Pair  # Nm/rad, k of SH and SK
    damping: Pair  # damping ratios of the two coupled modes of motion, the slower mode first
    #: kg m2, elements M11, M12 and M22 of the mass matrix of SH and SK at one knee angle in the middle of the swing.
    #: The gains Kv are computed from `mass` and are constant.
    #: The joints therefore have the stiffness `stiffness` only at the knee angle for which `mass` was computed.
    mass: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            values = getattr(self, name)
            if not all(math.isfinite(value) and value > 0.0 for value in values):
                raise ValueError(f"{name} of the backup policy must be positive and finite, got {values!r}")
        m11, m12, m22 = self.mass
        if not (m11 > 0.0 and m11 * m22 > m12 * m12):
            raise ValueError(f"mass of the backup policy must be positive definite, got {self.mass!r}")

    def modes(self) -> tuple[Vector, Vector, Vector]:
        """Return stiffness [1/s2], damping [1/s] and mode vectors (columns) of the two modes, of shapes (2,), (2,) and (2, 2)."""
        m11, m12, m22 = self.mass
        values, shapes = np.linalg.eig(np.linalg.solve([[m11, m12], [m12, m22]], np.diag(self.stiffness)))
        order = np.argsort(values)
        kappa: Vector = values[order].real
        return kappa, 2.0 * np.array(self.damping) * np.sqrt(kappa), shapes[:, order].real

    def gains(self) -> tuple[Vector, Vector]:
        """Return the gain matrices Kv [1/s2] and Dv [1/s] of the backup policy, each of shape (2, 2)."""
        kappa, delta, shapes = self.modes()
        inverse = np.linalg.inv(shapes)
        return shapes @ np.diag(kappa) @ inverse, shapes @ np.diag(delta) @ inverse


class Responses(NamedTuple):
    """Predicted motion of sagittal hip and knee under the backup policy, 0 to n cycles after the prediction starts.

    The rows of each array are SH and SK. To get the predicted motion, multiply `error`, `rate` and `feedback` by a
    state x with `STATES` elements. Multiply the `pushed` arrays by an acceleration of SH and SK that acts only during
    the first cycle.
    """

    error: Vector  # (n + 1, 2, 10) matrix from the state to the predicted error e [rad]
    rate: Vector  # (n + 1, 2, 10) matrix from the state to the predicted rate e' [rad/s]
    feedback: Vector  # (n + 1, 2, 10) matrix from the state to the predicted feedback -Kv e - Dv e' [rad/s2]
    #: Responses to a disturbance acceleration of 1 rad/s2 during the first cycle, shape (n + 1, 2, 2).
    #: Matrix k: response k cycles after the start. Row: responding joint. Column: disturbed joint (hip, knee).
    #: Responses: error e [rad], rate e' [rad/s] and feedback -Kv e - Dv e' [rad/s2].
    pushed_error: Vector
    pushed_rate: Vector
    pushed_feedback: Vector


def responses(policy: BackupPolicy, loop: SampledLoop, mobility: float, cycles: int, delay: int = 1) -> Responses:
    """Compute the responses of the sampled loop to the initial state and to a unit acceleration in the first cycle.

    Args:
        policy: gains of the backup policy.
        loop: time behaviour of the drives and of the bus.
        mobility: inertia of the model divided by the true inertia of the leg; 1 if the model is exact.
        cycles: number of cycles ahead.
        delay: number of cycles between a measurement and the torque that is computed from it, at least 1. All commands that
            are still pending are assumed to be equal to the last command.
    """
    kappa, delta, shapes = policy.modes()
    inverse = np.linalg.inv(shapes)
    rows, pushed = np.zeros((3, cycles + 1, 2, 2, 5)), np.zeros((3, cycles + 1, 2, 2))
    for mode in (0, 1):
        a, b = _mode(kappa[mode], delta[mode], loop, mobility, delay)
        outputs = np.zeros((3, len(b)))
        outputs[0, 0] = outputs[1, 1] = 1.0
        outputs[2, 0], outputs[2, 2] = -kappa[mode], -delta[mode]
        observed, pulses = _powers(a, b, outputs, cycles)
        merged = np.concatenate([observed[..., :4], observed[..., 4:].sum(axis=2, keepdims=True)], axis=2)
        shape = np.outer(shapes[:, mode], inverse[mode])
        rows += np.einsum("rc,nos->onrcs", shape, merged)
        pushed += np.einsum("rc,no->onrc", shape, pulses)
    by_joint = rows.transpose(0, 1, 2, 4, 3).reshape(3, cycles + 1, 2, STATES)
    return Responses(*by_joint, *pushed)


def _powers(a: Vector, b: Vector, outputs: Vector, cycles: int) -> tuple[Vector, Vector]:
    """Return the free response C A^n and the impulse response C A^(n-1) b for n from 0 to `cycles`.

    At n = 0, the impulse response is 0.

    Args:
        a: matrix A, shape (m, m).
        b: vector b, shape (m,).
        outputs: matrix C, shape (o, m).
        cycles: largest n.
    """
    rows = np.zeros((cycles + 1, *outputs.shape))
    rows[0] = outputs
    for n in range(cycles):
        np.matmul(rows[n], a, out=rows[n + 1])
    return rows, np.concatenate([np.zeros((1, len(outputs))), rows[:-1] @ b])


def _mode(kappa: float, delta: float, loop: SampledLoop, mobility: float, delay: int) -> tuple[Vector, Vector]:
    """Return A and b of one mode: x(k + 1) = A x(k) + b w(k), where w(k) is the disturbance acceleration in cycle k.

    The state x is (z, z', v, m, p), as defined in the module docstring. If the delay is longer than one cycle, the accelerations
    of older commands that are still pending follow.
    """
    n, keep, tracking = 4 + delay, loop.keep, loop.tracking
    motor = np.zeros(n)
    motor[3], motor[n - 1] = 1.0 - tracking, tracking
    a, b = np.zeros((n, n)), np.zeros(n)
    a[0, 0], a[0, 1], a[1, 1] = 1.0, PERIOD, 1.0
    a[0] += 0.5 * mobility * PERIOD**2 * motor
    a[1] += mobility * PERIOD * motor
    moved = a[0].copy()
    moved[0] -= 1.0
    a[2] = (1.0 - keep) / PERIOD * moved
    a[2, 2] += keep
    a[3] = motor
    a[4, 0], a[4, 2] = -kappa, -delta
    for pending in range(5, n):
        a[pending, pending - 1] = 1.0
    b[:3] = 0.5 * mobility * PERIOD**2, mobility * PERIOD, (1.0 - keep) * 0.5 * mobility * PERIOD
    return a, b
