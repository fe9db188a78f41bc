r"""Disturbances of the assisted leg and their largest effect under the backup policy: `leg, model errors, responses -> reach`.

For each cycle of the step, this module bounds the torques at sagittal hip and knee (SH, SK) that the model does not explain. The
bound is the sum of the promise (the disturbance torques of the certificate) and a budget. The budget is the sum of four torques:

- a part of the friction torque, since the friction parameters may be wrong,
- a part of the inertia, gravity, centrifugal and Coriolis torques along the desired trajectory, since the inertia may be wrong,
- the torque that is carried over the stance change, while it fades out,
- a constant for errors that have no model: noise, lost frames, lag of the friction compensation, motion of the other joints.

Each of these torques may have any sign in any cycle. The largest error that they cause is therefore a sum of absolute values,

.. math:: D(k, n) = \sum_{i=k}^{n-1} \max_{M} |G(n - i) M^{-1}| \, p_i,

where G is the response to an acceleration that lasts one cycle, and p is the bound. The maximum is over all mass
matrices M that the leg can have in cycle i inside the guide. `spread` computes this sum for each start cycle k and each
number n - k of cycles ahead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from atalante_control.gait.recentering import Deadbeat
from atalante_control.joint.idealization import AssistedInertia, Friction
from atalante_hal.types import Vector

Pair = tuple[float, float]

_POSTURES = 3  # number of knee angles for which the mass matrix is evaluated in each cycle


@dataclass(frozen=True)
class Mismatch:
    """Largest model errors for which the guide certificate holds.

    Raises:
        ValueError: If a value is out of range.
    """

    friction: float = 0.2  # largest error of the friction torque, as a fraction of the friction torque
    inertia: float = 0.1  # largest relative error of mass and inertia; the error is the same for all links of the leg
    residual: Pair = (1.0, 1.0)  # Nm, allowance for all other torque errors at hip and knee

    def __post_init__(self) -> None:
        for name in ("friction", "inertia"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} of the mismatch must be at least 0 and below 1, got {getattr(self, name)!r}")
        if not all(0.0 <= value < math.inf for value in self.residual):
            raise ValueError(f"residual of the mismatch must be finite and at least 0 Nm, got {self.residual!r}")


@dataclass(frozen=True)
class HandOver:
    """Hand-over box: largest deviations at the start of a step for which the guide certificate holds.

    Raises:
        ValueError: If a value is negative or not finite.
    """

    deviation: float = math.radians(2.7)  # rad, largest angle deviation |s(0)| of sagittal hip and knee
    rate: float = 0.25  # rad/s, largest speed deviation |s'(0)| of sagittal hip and knee
    #: Nm, largest torques of sagittal hip and knee that the carry-over adds at the start of a step
    torque: Pair = (25.0, 13.0)
    #: rad/s2, largest joint acceleration before the stance change. The acceleration distorts the velocity measured
    #: after the change.
    acceleration: float = 20.0

    def __post_init__(self) -> None:
        for name in ("deviation", "rate", "acceleration"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of the hand-over must be finite and at least 0, got {getattr(self, name)!r}")
        if not all(0.0 <= value < math.inf for value in self.torque):
            raise ValueError(f"torque of the hand-over must be finite and at least 0 Nm, got {self.torque!r}")

    def largest(self, values: Vector) -> Vector:
        """Return the worst-case size of a re-centring curve, for all start deviations up to `deviation` and `rate`.

        Re-centring adds an offset s(t) to the nominal trajectory after a stance change. The curve is s, s' or s''.

        Args:
            values: the curve for s(0) = 1 rad (row 0) and for s'(0) = 1 rad/s (row 1) at n times, shape (2, n).

        Returns:
            Largest absolute value of the curve at each time, shape (n,). The curve is linear in the deviations, so the
            largest deviations are the worst case.
        """
        return np.asarray(np.abs(values).T @ [self.deviation, self.rate])


class Leg(NamedTuple):
    """Data of the swing leg along its nominal trajectory, in one step and in the first cycles of the next step (overlap).

    The rows are cycles; the columns are SH and SK.
    """

    deadbeat: Deadbeat  # re-centring of the gait
    time: Vector  # (n,) s, time since the stance change
    q: Vector  # (n, 2) rad, nominal angles
    qd: Vector  # (n, 2) rad/s, nominal velocities
    qdd: Vector  # (n, 2) rad/s2, nominal accelerations
    gravity: Vector  # (n, 2) Nm, u_g
    inertia: AssistedInertia  # mass matrix of SH and SK
    friction: Friction  # friction parameters

    def masses(self, knee: Vector) -> Vector:
        """Return the mass matrix for each knee angle, shape (..., 2, 2) [kg m2].

        Args:
            knee: angles of SK, shape (...) [rad].
        """
        basis = np.stack([np.ones_like(knee), np.cos(knee), np.sin(knee)], axis=-1)
        return np.asarray((basis @ self.inertia.fit.T)[..., [[0, 1], [1, 2]]])

    def velocity_torque(self) -> Vector:
        """Return the centrifugal and Coriolis torques along the nominal trajectory, shape (n, 2) [Nm]."""
        rows = zip(self.q[:, 1].tolist(), *self.qd.T.tolist(), strict=True)
        return np.array([self.inertia.velocity_torques(*row) for row in rows])

    def friction_torque(self, margin: float = 0.0) -> Vector:
        """Return the friction torque along the nominal trajectory, shape (n, 2) [Nm].

        Args:
            margin: speed that is added to the absolute value of the velocity [rad/s]. If the margin is not 0, the
                result is the absolute value of the friction torque.
        """
        speed = np.abs(self.qd) + margin if margin else self.qd
        coulomb, viscous = (np.array(row[2:4]) for row in (self.friction.coulomb, self.friction.viscous))
        return np.asarray(coulomb * np.tanh(speed / self.friction.smoothing) + viscous * speed)

    def torque(self) -> Vector:
        """Return gravity plus centrifugal, Coriolis and inertia torque along the nominal trajectory, shape (n, 2) [Nm]."""
        needed = np.einsum("nij,nj->ni", self.masses(self.q[:, 1]), self.qdd)
        return np.asarray(needed + self.velocity_torque() + self.gravity)

    def mobilities(self, hand_over: HandOver, width: float) -> Vector:
        """Return the inverse mass matrices for several knee angles that the leg can have inside the guide, in each cycle.

        Args:
            hand_over: largest deviations at the start of a step.
            width: largest distance of SK from the desired trajectory [rad].

        Returns:
            Inverse mass matrices of SH and SK, shape (n, postures, 2, 2) [1/(kg m2)]. Axis 0: cycle. Axis 1: knee angle.
        """
        moved = width + hand_over.largest(self.deadbeat.basis(self.time)[0])
        knee = self.q[:, 1, None] + moved[:, None] * np.linspace(-1.0, 1.0, _POSTURES)
        inverse: Vector = np.linalg.inv(self.masses(knee)).astype(np.float64)
        return inverse

    def budget(self, mismatch: Mismatch, hand_over: HandOver, blend: Vector) -> Vector:
        """Return the largest torque error of the model in each cycle, shape (n, 2) [Nm], as the module docstring describes.

        Args:
            mismatch: errors of the model.
            hand_over: largest deviations at the start of a step.
            blend: fraction of the carried-over torque that remains in each cycle since the stance change, shape (m,).
        """
        moved = hand_over.largest(self.deadbeat.basis(self.time)[2])
        needed = np.abs(self.torque()) + np.abs(self.masses(self.q[:, 1])).sum(axis=2) * moved[:, None]
        friction = self.friction_torque(_SPEED_MARGIN)
        total: Vector = mismatch.inertia * needed + mismatch.friction * friction + mismatch.residual
        total[: len(blend)] += np.outer(blend, hand_over.torque)
        return total


#: The bound of the friction error covers joint speeds up to the nominal speed plus this margin [rad/s].
_SPEED_MARGIN = 1.0


class Effect(NamedTuple):
    """Effect of a disturbance on two outputs, one per joint (hip, knee). An output is an error, a torque or a speed."""

    #: (n, 2, 2) pushed[i] @ a is the response to an acceleration a that lasts one cycle, i cycles after the acceleration.
    pushed: Vector
    #: (n, 2, 2) response to a wrong start velocity; (0, 2, 2) to ignore this response. The measured velocity lags behind the true
    #: velocity. While a disturbance accelerates the joints by a, a prediction therefore starts with a wrong velocity.
    #: hidden[i] @ a is the response to this velocity error, i cycles after the prediction starts.
    hidden: Vector
    #: (n, 2, 2) conversion from response to output in each cycle k of the step: output = left[k] @ response. For example, the
    #: mass matrix left[k] converts an acceleration to a torque.
    left: Vector


class Grid(NamedTuple):
    """Predictions for which `spread` computes the worst-case effect of disturbances: start cycles and prediction lengths."""

    starts: int  # number of start cycles; the start cycles are 0 to starts - 1
    #: number of consecutive start cycles in a block; `spread` stores one row per block, the maximum over the block
    block: int
    lags: NDArray[np.int64]  # (lags,) prediction lengths [cycles], ascending


def spread(effect: Effect, mobilities: Vector, bounds: Vector, grid: Grid, ahead: Vector) -> Vector:
    """Compute the worst-case change of two outputs that disturbance torques can cause: one output per joint (hip, knee).

    An output is an error, a torque or a speed, see `Effect`. The function fills `ahead` and returns a second array.
    In `ahead`, the disturbances begin when a prediction starts.
    In the returned array, the disturbances begin at the start of the step.

    In both arrays, columns 0 and 1 are the changes of the hip output and the knee output due to the budget (torque errors of the
    model). Columns 2 and 3 are the changes due to the requested promise (disturbance torques of the certificate).
    Each change is a sum of absolute values over the cycles.

    Args:
        effect: effect of a disturbance on the outputs.
        mobilities: inverse mass matrices of each cycle, shape (n, postures, 2, 2).
        bounds: torque bounds of SH and SK (rows), budget and requested promise (columns), in each cycle, shape (n, 2, 2) [Nm].
        grid: start cycles and lengths of the predictions in `ahead`.
        ahead: worst-case change for each block of start cycles and each prediction length, shape (blocks, lags, 4).
            The array is changed in place: each element keeps the maximum of the old value and the largest new change.
            Predictions past the end of `bounds` are left out.

    Returns:
        The worst-case change in each cycle due to the disturbances since cycle 0, without the response `hidden`, shape (n, 4).
    """
    count, postures = len(bounds), mobilities.shape[1]
    # In the loop, total[k] is the change in cycle k due to the disturbances in the cycles k - lag to k.
    # added[k] is the change in cycle k + lag, if a prediction starts in cycle k with a wrong velocity (`Effect.hidden`).
    total, added = np.zeros((count, 4)), np.zeros((grid.starts, 4))
    both = np.zeros((2, 2, 2))
    column = 0
    for lag in range(count):
        reported = column < len(grid.lags) and grid.lags[column] == lag
        starts = min(grid.starts, count - lag) if reported else 0
        hides = reported and len(effect.hidden) > 0
        both[0] = effect.pushed[lag]
        if hides:
            both[1] = effect.hidden[lag]
        for i in range(2 if hides else 1):
            for start in range(count - lag if i == 0 else starts):
                end = start + lag
                for r in range(2):
                    h, k = effect.left[end, r, 0], effect.left[end, r, 1]
                    on_hip, on_knee = h * both[i, 0, 0] + k * both[i, 1, 0], h * both[i, 0, 1] + k * both[i, 1, 1]
                    # Find the largest effect over all postures. A function call here would take five times longer.
                    budget = promise = 0.0
                    for m in range(postures):
                        hip = abs(on_hip * mobilities[start, m, 0, 0] + on_knee * mobilities[start, m, 1, 0])
                        knee = abs(on_hip * mobilities[start, m, 0, 1] + on_knee * mobilities[start, m, 1, 1])
                        budget = max(budget, hip * bounds[start, 0, 0] + knee * bounds[start, 1, 0])
                        promise = max(promise, hip * bounds[start, 0, 1] + knee * bounds[start, 1, 1])
                    if i == 0:
                        total[end, r] += budget
                        total[end, r + 2] += promise
                    else:
                        added[start, r], added[start, r + 2] = budget, promise
        for start in range(starts):
            for r in range(4):
                output = total[start + lag, r] + added[start, r]
                ahead[start // grid.block, column, r] = max(ahead[start // grid.block, column, r], output)
        if reported:
            column += 1
    return total
