r"""Disturbances of the assisted leg and their largest effect under the backup policy: `leg, model errors, responses -> change`.

For each cycle of the step, this module bounds the torques at sagittal hip and knee (SH, SK) that the model does not explain. The
bound is the sum of the promise (the disturbance torques of the certificate) and a budget. The budget is the sum of four torques:

- a part of the friction torque, since the friction parameters may be wrong,
- a part of the inertia, gravity, centrifugal and Coriolis torques along the desired trajectory, since the inertia may be wrong,
- the torque jump at the stance change, until the new control law drives the leg,
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

#: Largest spacing of the knee angles for which the mass matrix is computed in each cycle, without a start deviation [rad].
#: Near the start of a step, the start deviation widens the range of the knee angles.
#: The number of knee angles stays the same, so the spacing is larger there.
_SPACING = math.radians(7.5)


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

    At a stance change, the torques that the controller computes for hip and knee jump. The old torque acts until the first new
    command arrives. In an airwalk (robot suspended), the controller then adds a torque that cancels the jump and fades out, but
    at most `carried`. In a walk on the ground, the controller adds no such torque. `Leg.budget` contains the part of the jump
    that still acts, see `remaining`.

    Raises:
        ValueError: If a value is negative or not finite.
    """

    deviation: float = math.radians(2.7)  # rad, largest angle deviation |s(0)| of sagittal hip and knee
    rate: float = 0.25  # rad/s, largest speed deviation |s'(0)| of sagittal hip and knee
    torque: Pair = (65.0, 35.0)  # Nm, largest jump of the torques of sagittal hip and knee at a stance change
    #: Nm, largest torque that the controller adds to sagittal hip and knee after a stance change
    carried: Pair = (25.0, 13.0)
    #: rad/s2, largest joint acceleration before the stance change.
    #: A joint acceleration before a stance change causes an error of the velocity that is measured after the stance change.
    acceleration: float = 20.0

    def __post_init__(self) -> None:
        for name in ("deviation", "rate", "acceleration"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of the hand-over must be finite and at least 0, got {getattr(self, name)!r}")
        for name in ("torque", "carried"):
            if not all(0.0 <= value < math.inf for value in getattr(self, name)):
                raise ValueError(
                    f"{name} of the hand-over must be finite and at least 0 Nm, got {getattr(self, name)!r}"
                )

    def contains(self, angles: Pair, rates: Pair, accelerations: Pair, jumps: Pair) -> bool:
        """Return whether a stance change is inside the hand-over box. Each argument has two elements: sagittal hip, then knee.

        Args:
            angles: angle deviations s(0) [rad].
            rates: speed deviations s'(0) [rad/s].
            accelerations: joint accelerations before the stance change [rad/s2].
            jumps: torques before the stance change minus torques of the new control law [Nm].
        """
        return (
            max(map(abs, angles)) <= self.deviation
            and max(map(abs, rates)) <= self.rate
            and max(map(abs, accelerations)) <= self.acceleration
            and all(abs(jump) <= largest for jump, largest in zip(jumps, self.torque, strict=True))
        )

    def added(self, blend: Vector) -> Vector:
        """Return the largest carry-over torque for each cycle after a stance change, shape (m, 2) [Nm].

        Args:
            blend: fraction of the added torque that remains in each cycle since the stance change, shape (m,).
        """
        return np.outer(blend, np.minimum(self.carried, self.torque))

    def remaining(self, blend: Vector, decrease: Vector) -> Vector:
        """Return the largest part of the torque jump that can remain in each cycle after a stance change, shape (n, 2) [Nm].

        The command contains the added torque. The limiter of the robot lets a larger jump decrease only slowly.

        Args:
            blend: fraction of the added torque that remains in each cycle since the stance change, shape (m,).
            decrease: largest decrease that the limiter permits in each cycle, shape (n, 2) [Nm].
        """
        falling: Vector = np.maximum(0.0, np.array(self.torque) - np.cumsum(np.maximum(0.0, decrease), axis=0))
        added = self.added(blend)[: len(falling)]
        falling[: len(added)] = np.maximum(falling[: len(added)], added)
        return falling

    def largest(self, values: Vector) -> Vector:
        """Return the largest absolute value that the re-centring offset s(t) can have at each time, shape (n,).

        Re-centring adds the offset s(t) to the nominal trajectory, so that a step starts without a tracking error. The offset
        is linear in the start deviations s(0) and s'(0). The deviations are at most `deviation` and `rate`, with any sign.

        Args:
            values: s at n times, shape (2, n). Row 0: for s(0) = 1 rad. Row 1: for s'(0) = 1 rad/s. With the values of s' or s''
                instead, the result is the largest absolute value of s' or s''.
        """
        return np.asarray(np.abs(values).T @ [self.deviation, self.rate])


class Leg(NamedTuple):
    """Data of one leg along its nominal trajectory.

    The leg is the swing leg of a step. In an airwalk (robot suspended), the data also contain the first cycles of the next step,
    because predictions reach into the next step. In these cycles, the leg is the stance leg. The rows are cycles; the columns
    are SH and SK.
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
        """Return the sum of gravity, centrifugal, Coriolis and inertia torque along the nominal motion, shape (n, 2) [Nm]."""
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
        postures = 2 * math.ceil(round(width / _SPACING, 6)) + 1
        moved = width + hand_over.largest(self.deadbeat.basis(self.time)[0])
        knee = self.q[:, 1, None] + moved[:, None] * np.linspace(-1.0, 1.0, postures)
        inverse: Vector = np.linalg.inv(self.masses(knee)).astype(np.float64)
        return inverse

    def budget(self, mismatch: Mismatch, hand_over: HandOver, jump: Vector) -> Vector:
        """Return the largest torque error of the model in each cycle, shape (n, 2) [Nm], as the module docstring describes.

        Args:
            mismatch: errors of the model.
            hand_over: largest deviations at the start of a step.
            jump: part of the torque jump that still acts in each cycle since the stance change, shape (m, 2) [Nm].
        """
        moved = hand_over.largest(self.deadbeat.basis(self.time)[2])
        needed = np.abs(self.torque()) + np.abs(self.masses(self.q[:, 1])).sum(axis=2) * moved[:, None]
        friction = self.friction_torque(_SPEED_MARGIN)
        total: Vector = mismatch.inertia * needed + mismatch.friction * friction + mismatch.residual
        total[: len(jump)] += jump[: len(total)]
        return total


#: Speed margin [rad/s]. The bound of the friction error covers joint speeds up to the nominal speed plus the speed margin.
_SPEED_MARGIN = 1.0


class Effect(NamedTuple):
    """Effect of a short disturbance on one quantity of hip and knee, as matrices.

    The quantity is the tracking error, the speed, the torque, or the change of the torque within one cycle.

    A disturbance is an acceleration of hip and knee that lasts one cycle. The disturbance has two effects:

    1. The disturbance moves the joints. The matrices `pushed` describe the motion in the following cycles.
    2. While the joints accelerate, the measured velocity lags behind the true velocity. Therefore a prediction starts with a
       wrong velocity. The matrices `hidden` describe how the wrong velocity changes the prediction.

    If the quantity is a torque, `pushed` contains the acceleration that belongs to the torque. The mass matrices in `left`
    convert the acceleration to the torque, and the change of the acceleration to the change of the torque. For an error or a
    speed, `left` contains unit matrices. In `pushed` and `hidden`, a row is the affected joint, and a column is the disturbed
    joint (hip, knee).
    """

    #: Shape (n, 2, 2). The element pushed[i] is the effect of a disturbance, i cycles after the start of the disturbance.
    #: The disturbance is an acceleration of 1 rad/s2 for one cycle.
    #: If the effect is a change of an error or of a speed, `pushed` contains this change.
    #: If the effect is a torque, `pushed` contains an acceleration. The mass matrices `left` convert it to the torque.
    #: If the effect is a torque change, `pushed` contains a change of the acceleration. `left` converts it to the torque change.
    pushed: Vector
    #: Shape (n, 2, 2). The element hidden[i] is the effect of a wrong start velocity on the value predicted i cycles ahead.
    #: The start velocity is measured with a lag. Its error is the one at a joint acceleration of 1 rad/s2.
    #: An empty array of shape (0, 2, 2) means that the start velocity is assumed to be exact.
    hidden: Vector
    #: Shape (n, 2, 2). The changes of the quantity in cycle k of the step are left[k] @ pushed[i] and left[k] @ hidden[i].
    #: For a torque or a torque change, left[k] is the mass matrix [kg m2]. For an error or a speed, left[k] is the unit matrix.
    left: Vector


class Grid(NamedTuple):
    """Set of predictions that `spread` examines: each start cycle is combined with each prediction length."""

    starts: int  # number of start cycles: the predictions start in the cycles 0 to `starts - 1`
    #: number of start cycles that share one row of the result. Example: if block = 4, row 2 is for the start cycles 8 to 11
    block: int
    lags: NDArray[np.int64]  # (lags,) prediction lengths [cycles], ascending


def spread(effect: Effect, mobilities: Vector, bounds: Vector, grid: Grid, ahead: Vector) -> Vector:
    """Compute how much disturbance torques can change a quantity of hip and knee in the worst case.

    `effect` selects the quantity: error, speed, torque, or change of the torque within one cycle.
    The function fills `ahead` and returns a second array.
    In `ahead`, the disturbances begin when a prediction starts.
    In the returned array, the disturbances begin at the start of the step.

    In both arrays, columns 0 and 1 are the changes for hip and knee due to the budget (torque errors of the model). Columns 2 and
    3 are the changes due to the requested promise (disturbance torques of the certificate). Each change is a sum of absolute
    values over the cycles. In the code, `total[k]` is the change in cycle k due to the disturbances of the last `lag` cycles.

    Args:
        effect: matrices from a disturbance to its effect on the quantity.
        mobilities: inverse mass matrices of each cycle, shape (n, postures, 2, 2).
        bounds: torque bounds of SH and SK (rows), budget and requested promise (columns), in each cycle, shape (n, 2, 2) [Nm].
        grid: start cycles and lengths of the predictions in `ahead`.
        ahead: worst-case change for each block of start cycles and each prediction length, shape (blocks, lags, 4).
            The array is changed in place: each element keeps the maximum of the old value and the largest new change.
            Predictions past the end of `bounds` are left out.

    Returns:
        The worst-case change in each cycle due to the disturbances since cycle 0, without `Effect.hidden`, shape (n, 4).
    """
    count, postures = len(bounds), mobilities.shape[1]
    # wrong_start[k]: largest effect of a wrong start velocity on a prediction from cycle k to cycle k + lag.
    total, wrong_start = np.zeros((count, 4)), np.zeros((grid.starts, 4))
    both = np.zeros((2, 2, 2))
    column = 0
    for lag in range(count):
        reported = column < len(grid.lags) and grid.lags[column] == lag
        starts = min(grid.starts, count - lag) if reported else 0
        hides = reported and len(effect.hidden) > 0
        for r in range(2):  # element by element, because `both[0] = ...` makes the compilation several seconds longer
            for c in range(2):
                both[0, r, c] = effect.pushed[lag, r, c]
                if hides:
                    both[1, r, c] = effect.hidden[lag, r, c]
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
                        wrong_start[start, r], wrong_start[start, r + 2] = budget, promise
        for start in range(starts):
            for r in range(4):
                change = total[start + lag, r] + wrong_start[start, r]
                ahead[start // grid.block, column, r] = max(ahead[start // grid.block, column, r], change)
        if reported:
            column += 1
    return total
