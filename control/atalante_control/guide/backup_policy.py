r"""Backup policy of the virtual guide and the exact flow of a joint under it.

`gait, re-centring -> forced response P`, `gains, inertia -> transition Phi, disturbance responses`. The guide filter and the
certificate use both. A joint is idealised as :math:`J\ddot q = u_b + u_f + u_{ext}` with
:math:`u_b = K_p (q_{des} - q) + K_d (\dot q_{des} - \dot q)`. Its error :math:`e = q - q_{des}` obeys

.. math:: J\ddot e + K_d \dot e + K_p e = u_f - J \ddot q_{des} + u_{ext},

which is linear. From the state :math:`x = (e, \dot e)` at :math:`t`, under a constant disturbance, the state is exactly

.. math:: x(t + \tau) = P(t + \tau) + \Phi(\tau) (x - P(t)) + u_{ext} S(\tau)

with any solution P of the undisturbed loop. Between step changes the forcing is a polynomial. P is therefore a polynomial too,
and its coefficients are found by comparison, without integration and without a grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import derivative, power_basis
from atalante_control.gait.recentering import Deadbeat
from atalante_hal.types import Vector


@dataclass(frozen=True)
class BackupPolicy:
    """PD law of one joint, with the inertia of the joint and the torque limit.

    Raises:
        ValueError: If a value is not positive, or if `kp`, `kd` or `inertia` is not finite.
    """

    kp: float  # Nm/rad
    kd: float  # Nm s/rad
    inertia: float  # kg m2, J
    torque_limit: float = math.inf  # Nm, largest |u_b|

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "inertia"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} of the backup policy must be positive and finite, got {value!r}")
        if not self.torque_limit > 0.0:
            raise ValueError(f"torque_limit of the backup policy must be positive [Nm], got {self.torque_limit!r}")

    @property
    def monotone(self) -> bool:
        """Return whether the loop is critically damped or overdamped, Kd^2 >= 4 Kp J.

        The impulse response of a monotone loop never changes sign. A constant disturbance at its bound is then the worst one.
        """
        return self.kd**2 >= 4.0 * self.kp * self.inertia * (1.0 - 1e-12)

    def transition(self, tau: Vector) -> Vector:
        """Return the state transition matrix Phi(tau) of the undisturbed loop in closed form.

        Args:
            tau: times from the start, shape (n,) [s].

        Returns:
            Matrices that act on (e, e'), shape (n, 2, 2).
        """
        impulse, slope = self._impulse(tau)
        sigma, stiffness = self.kd / (2.0 * self.inertia), self.kp / self.inertia
        phi = np.empty((len(tau), 2, 2))
        phi[:, 0, 0], phi[:, 0, 1] = slope + 2.0 * sigma * impulse, impulse
        phi[:, 1, 0], phi[:, 1, 1] = -stiffness * impulse, slope
        return phi

    def step_response(self, tau: Vector) -> Vector:
        """Return S(tau), the response of (e, e') from rest to a constant disturbance of 1 Nm.

        Args:
            tau: times from the start, shape (n,) [s].

        Returns:
            Response, shape (n, 2) [rad/Nm, rad/(Nm s)].
        """
        impulse, slope = self._impulse(tau)
        sigma = self.kd / (2.0 * self.inertia)
        return np.stack([(1.0 - slope - 2.0 * sigma * impulse) / self.kp, impulse / self.inertia], axis=1)

    def peak_response(self, tau: Vector) -> Vector:
        """Return the largest |e(tau)| that a disturbance within +-1 Nm can cause from rest.

        It is the L1 norm of the impulse response. For a monotone loop it equals the error in S. For an underdamped loop the
        worst disturbance changes sign with the impulse response, at tau_n = n pi / omega_d. S is monotone between these
        times, so the absolute increments of S are summed.

        Args:
            tau: times from the start, shape (n,) [s].

        Returns:
            Largest error, shape (n,) [rad/Nm].
        """
        if self.monotone:
            return np.abs(self.step_response(tau)[:, 0])
        omega = abs(self._poles()[1])
        turns = np.arange(int(tau.max() * omega / math.pi) + 2, dtype=np.float64) * math.pi / omega
        at_turns = self.step_response(turns)[:, 0]
        summed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at_turns)))])
        last = (tau * omega / math.pi).astype(np.intp)
        return np.asarray(summed[last] + np.abs(self.step_response(tau)[:, 0] - at_turns[last]))

    def disturbance(self, tau: Vector, low: float, high: float) -> tuple[Vector, Vector]:
        """Return the largest and the smallest e(tau) that disturbances within [low, high] can cause from rest.

        The mean of the interval acts through S, the deviation from the mean through the peak response. For a monotone loop the
        result is the pair of constant extremes of the paper. For an underdamped loop it is the true worst case, which that
        pair underestimates.

        Args:
            tau: times from the start, shape (n,) [s].
            low: smallest disturbance [Nm].
            high: largest disturbance [Nm].

        Returns:
            Largest and smallest error, each of shape (n,) [rad].
        """
        mean, half = 0.5 * (high + low), 0.5 * (high - low)
        drift, spread = mean * self.step_response(tau)[:, 0], half * self.peak_response(tau)
        return drift + spread, drift - spread

    def particular(self, forcing: Vector, scale: float) -> Vector:
        """Return the polynomial solution of e'' + (Kd/J) e' + (Kp/J) e = f.

        Args:
            forcing: coefficients of f [rad/s2] in powers of t / scale, lowest first, shape (d + 1,).
            scale: unit of time of the powers [s].

        Returns:
            Coefficients of e [rad] in the same powers, shape (d + 1,).
        """
        degree = len(forcing) - 1
        damping, stiffness = self.kd / self.inertia / scale, self.kp / self.inertia
        solution = np.zeros(degree + 3)
        for i in range(degree, -1, -1):
            known = damping * (i + 1) * solution[i + 1] + (i + 2) * (i + 1) * solution[i + 2] / scale**2
            solution[i] = (forcing[i] - known) / stiffness
        return solution[: degree + 1]

    def _poles(self) -> tuple[float, complex]:
        sigma = self.kd / (2.0 * self.inertia)
        square = sigma**2 - self.kp / self.inertia
        spread = complex(math.sqrt(square)) if square >= 0.0 else complex(0.0, math.sqrt(-square))
        return sigma, spread

    def _impulse(self, tau: Vector) -> tuple[Vector, Vector]:
        """Return e and e' of the free motion from e(0) = 0, e'(0) = 1. They are accurate even near critical damping."""
        sigma, spread = self._poles()
        if spread.imag:
            omega = spread.imag
            decay = np.exp(-sigma * tau)
            impulse = decay * np.sin(omega * tau) / omega
            return impulse, decay * np.cos(omega * tau) - sigma * impulse
        slow, fast = sigma - spread.real, sigma + spread.real
        decay, gap = np.exp(-slow * tau), fast - slow
        impulse = decay * (-np.expm1(-gap * tau) / gap if gap > 1e-12 * sigma else tau)
        return impulse, decay - fast * impulse


class ForcedResponse(NamedTuple):
    """Solution P of the undisturbed loop and its sensitivity to the re-centring. Each array has rows (e, e'), shape (n, 2)."""

    nominal: Vector  # P without re-centring [rad, rad/s]
    deviation: Vector  # response added to P per rad of s(0)
    rate: Vector  # response added to P per rad/s of s'(0)


class Curve(NamedTuple):
    """Nominal motion of one joint in a step and in the next step, with the feedforward of the first step."""

    deadbeat: Deadbeat  # re-centring of the gait
    nominal: Vector  # (8,) rad, Bezier control points of q_nom in this step
    following: Vector  # (8,) rad, Bezier control points of q_nom of the same joint in the next step
    time: Vector  # (n,) s, time since the step change, at least 0; may exceed T
    feedforward: Vector | None = None  # (8,) Nm, Bezier control points of u_f in this step; None: no feedforward


def forced_response(policy: BackupPolicy, curve: Curve) -> ForcedResponse:
    """Return the undisturbed solution P of one joint over a step and, after T, along the nominal trajectory of the next step.

    P is linear in the deviations at the step change, so a step change only adds two tables: P = nominal + s(0) deviation +
    s'(0) rate.

    Args:
        policy: backup policy of the joint.
        curve: nominal motion and feedforward of the joint.
    """
    deadbeat, time = curve.deadbeat, curve.time
    duration = deadbeat.duration
    now = policy.particular(_forcing(policy, curve.nominal, curve.feedforward, duration), duration)
    then = policy.particular(_forcing(policy, curve.following, None, duration), duration)
    result, late, jump = _successive(now, then, time, duration)
    result[late] += policy.transition(time[late] - duration) @ jump

    bases = []
    for cubic in deadbeat.polynomials():
        acceleration = cubic[2:] * np.array([2.0, 6.0]) / deadbeat.end**2
        particular = policy.particular(-acceleration, deadbeat.end)
        response = _polynomial(particular, time, deadbeat.end)
        after = time > deadbeat.end
        last = _polynomial(particular, np.array([deadbeat.end]), deadbeat.end)[0]
        response[after] = policy.transition(time[after] - deadbeat.end) @ last
        bases.append(response)
    return ForcedResponse(result, bases[0], bases[1])


def free_drift(policy: BackupPolicy, curve: Curve) -> ForcedResponse:
    """Return the error of the joint without backup torque, the double integral of u_f / J - q_des''.

    Where the drive saturates, the kernel adds the motion under a constant torque to this drift. Only the difference between two
    times has a meaning.

    Args:
        policy: backup policy of the joint.
        curve: nominal motion and feedforward of the joint.
    """
    deadbeat, _, _, time, feedforward = curve
    duration = deadbeat.duration
    now, then = -power_basis(curve.nominal[None, :])[0], -power_basis(curve.following[None, :])[0]
    pushed = np.zeros(len(now) + 2)
    pushed[: len(now)] = now
    if feedforward is not None:
        uf, powers = power_basis(feedforward[None, :])[0], np.arange(len(feedforward))
        pushed[2:] += uf * duration**2 / policy.inertia / ((powers + 1) * (powers + 2))
    result, late, jump = _successive(pushed, then, time, duration)
    result[late, 0] += jump[0] + jump[1] * (time[late] - duration)
    result[late, 1] += jump[1]
    value, slope, _ = deadbeat.basis(time)
    return ForcedResponse(result, *(-np.stack([value[i], slope[i]], axis=1) for i in (0, 1)))


def _successive(
    now: Vector, then: Vector, time: Vector, duration: float
) -> tuple[Vector, npt.NDArray[np.bool_], Vector]:
    """Evaluate a polynomial in t / T up to T, and a second polynomial in (t - T) / T after T.

    Returns:
        Values and rates, shape (n, 2); True for each time after T, shape (n,); the jump of value and rate at T, shape (2,).
    """
    late = time > duration
    result = np.where(late[:, None], _polynomial(then, time - duration, duration), _polynomial(now, time, duration))
    end = _polynomial(now, np.array([duration]), duration)[0]
    return result, late, end - _polynomial(then, np.zeros(1), duration)[0]


def _forcing(policy: BackupPolicy, nominal: Vector, feedforward: Vector | None, duration: float) -> Vector:
    """Return the coefficients of u_f / J - q_nom'' in powers of t / T, shape (8,) [rad/s2]."""
    forcing = np.zeros(len(nominal))
    acceleration = power_basis(derivative(derivative(nominal[None, :])))[0] / duration**2
    forcing[: len(acceleration)] -= acceleration
    if feedforward is not None:
        forcing += power_basis(feedforward[None, :])[0] / policy.inertia
    return forcing


def _polynomial(coefficients: Vector, time: Vector, scale: float) -> Vector:
    """Return the value and the time derivative of a polynomial in time / scale, shape (n, 2)."""
    x = time / scale
    slope = coefficients[1:] * np.arange(1, len(coefficients)) / scale
    return np.stack([np.polynomial.polynomial.polyval(x, c) for c in (coefficients, slope)], axis=1)
