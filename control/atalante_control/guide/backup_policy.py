r"""Backup policy of the virtual guide and the exact flow it gives a joint.

`gait, re-centring -> forced response P`, `gains, inertia -> transition Phi, disturbance responses` -> guide filter and
certificate. A joint is idealised as :math:`J\ddot q = u_b + u_f + u_{ext}` with
:math:`u_b = K_p (q_{des} - q) + K_d (\dot q_{des} - \dot q)`; its error :math:`e = q - q_{des}` follows

.. math:: J\ddot e + K_d \dot e + K_p e = u_f - J \ddot q_{des} + u_{ext},

which is linear. From the state :math:`x = (e, \dot e)` at :math:`t`, under a constant disturbance, it is exactly

.. math:: x(t + \tau) = P(t + \tau) + \Phi(\tau) (x - P(t)) + u_{ext} S(\tau)

with any one solution P of the undisturbed loop. Between step changes the forcing is a polynomial, so P is a polynomial
too, found by comparing coefficients: no integration, no grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import derivative, power_basis
from atalante_control.gait.recentering import Deadbeat

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BackupPolicy:
    """PD law of one joint with the inertia and the torque it acts with.

    Raises:
        ValueError: a value that is not positive and finite.
    """

    kp: float  # Nm/rad
    kd: float  # Nm s/rad
    inertia: float  # kg m2, J
    torque_limit: float = math.inf  # Nm, largest |u_b|

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "inertia"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} of the backup policy is positive and finite, not {value!r}")
        if not self.torque_limit > 0.0:
            raise ValueError(f"torque_limit of the backup policy is positive, in Nm, not {self.torque_limit!r}")

    @property
    def monotone(self) -> bool:
        """True when Kd^2 >= 4 Kp J: the impulse response never changes sign, and constant extremes are the worst."""
        return self.kd**2 >= 4.0 * self.kp * self.inertia * (1.0 - 1e-12)

    def transition(self, tau: Vector) -> Vector:
        """Phi(tau), closed form. Args: tau shape (n,) [s]. Returns: shape (n, 2, 2) acting on (e, e')."""
        impulse, slope = self._impulse(tau)
        sigma, stiffness = self.kd / (2.0 * self.inertia), self.kp / self.inertia
        phi = np.empty((len(tau), 2, 2))
        phi[:, 0, 0], phi[:, 0, 1] = slope + 2.0 * sigma * impulse, impulse
        phi[:, 1, 0], phi[:, 1, 1] = -stiffness * impulse, slope
        return phi

    def step_response(self, tau: Vector) -> Vector:
        """S(tau): response of (e, e') to a unit disturbance torque from rest. Shape (n, 2) [rad/Nm, rad/(Nm s)]."""
        impulse, slope = self._impulse(tau)
        sigma = self.kd / (2.0 * self.inertia)
        return np.stack([(1.0 - slope - 2.0 * sigma * impulse) / self.kp, impulse / self.inertia], axis=1)

    def peak_response(self, tau: Vector) -> Vector:
        """Largest |e(tau)| any disturbance within +-1 Nm can cause from rest: the L1 norm of the impulse response.

        Equal to S for a monotone loop. An underdamped one answers best to a disturbance that changes sign with the
        impulse response, at tau_n = n pi / omega_d: between these, S is monotone, and its increments add up.

        Returns: shape (n,) [rad/Nm].
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
        """Largest and smallest e(tau) that disturbances within [low, high] Nm can cause from rest.

        Their mean acts through S, what is left of them through the peak response: for a monotone loop this is the
        pair of constant extremes of the paper, for an underdamped one it is the true worst case, not that pair.

        Returns: two arrays of shape (n,) [rad].
        """
        mean, half = 0.5 * (high + low), 0.5 * (high - low)
        drift, spread = mean * self.step_response(tau)[:, 0], half * self.peak_response(tau)
        return drift + spread, drift - spread

    def particular(self, forcing: Vector, scale: float) -> Vector:
        """Polynomial solution of e'' + (Kd/J) e' + (Kp/J) e = f.

        Args:
            forcing: coefficients of f [rad/s2] in powers of t / scale, lowest first, shape (d + 1,).
            scale: [s].

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
        """Response e and e' to e(0) = 0, e'(0) = 1; accurate through critical damping."""
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
    """One solution P of the undisturbed loop and what a deadbeat adds to it; (e, e'), each of shape (n, 2)."""

    nominal: Vector  # rad, rad/s
    deviation: Vector  # per rad of s(0)
    rate: Vector  # per rad/s of s'(0)


def forced_response(
    policy: BackupPolicy,
    deadbeat: Deadbeat,
    nominal: Vector,
    following: Vector,
    time: Vector,
    feedforward: Vector | None = None,
) -> ForcedResponse:
    """P of one joint over a step and, past T, into the trajectory that follows it.

    P is linear in the deadbeat's deviations, so a step change only adds two tables: P = nominal + s(0) deviation +
    s'(0) rate.

    Args:
        nominal: Bezier control points of q_nom in this step, shape (8,) [rad].
        following: of the same joint in the next step, shape (8,) [rad].
        time: since the step change, shape (n,) [s], not negative; may pass T.
        feedforward: Bezier control points of u_f applied in this step, shape (8,) [Nm]; None: none applied.
    """
    duration = deadbeat.duration
    now = policy.particular(_forcing(policy, nominal, feedforward, duration), duration)
    then = policy.particular(_forcing(policy, following, None, duration), duration)
    late = time > duration
    result = np.where(late[:, None], _polynomial(then, time - duration, duration), _polynomial(now, time, duration))
    end = np.array([duration])
    gap = _polynomial(now, end, duration)[0] - _polynomial(then, np.zeros(1), duration)[0]
    result[late] += policy.transition(time[late] - duration) @ gap

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


def free_drift(
    policy: BackupPolicy,
    deadbeat: Deadbeat,
    nominal: Vector,
    following: Vector,
    time: Vector,
    feedforward: Vector | None = None,
) -> ForcedResponse:
    """Error of the joint with no backup torque: what a constant torque is added to where the drive saturates.

    Twice integrated u_f / J - q_des''. Arguments and result as for `forced_response`; only differences along the
    drift have a meaning.
    """
    duration = deadbeat.duration
    late = time > duration
    start, end = np.zeros(1), np.array([duration])
    now, then = -power_basis(nominal[None, :])[0], -power_basis(following[None, :])[0]
    pushed = np.zeros(len(now) + 2)
    pushed[: len(now)] = now
    if feedforward is not None:
        uf, powers = power_basis(feedforward[None, :])[0], np.arange(len(feedforward))
        pushed[2:] += uf * duration**2 / policy.inertia / ((powers + 1) * (powers + 2))
    result = np.where(late[:, None], _polynomial(then, time - duration, duration), _polynomial(pushed, time, duration))
    gap = _polynomial(pushed, end, duration)[0] - _polynomial(then, start, duration)[0]
    result[late, 0] += gap[0] + gap[1] * (time[late] - duration)
    result[late, 1] += gap[1]
    value, slope, _ = deadbeat.basis(time)
    return ForcedResponse(result, *(-np.stack([value[i], slope[i]], axis=1) for i in (0, 1)))


def _forcing(policy: BackupPolicy, nominal: Vector, feedforward: Vector | None, duration: float) -> Vector:
    """Coefficients of u_f / J - q_nom'' in powers of t / T, shape (8,)."""
    forcing = np.zeros(len(nominal))
    acceleration = power_basis(derivative(derivative(nominal[None, :])))[0] / duration**2
    forcing[: len(acceleration)] -= acceleration
    if feedforward is not None:
        forcing += power_basis(feedforward[None, :])[0] / policy.inertia
    return forcing


def _polynomial(coefficients: Vector, time: Vector, scale: float) -> Vector:
    """Value and time derivative, shape (n, 2)."""
    x = time / scale
    slope = coefficients[1:] * np.arange(1, len(coefficients)) / scale
    return np.stack([np.polynomial.polynomial.polyval(x, c) for c in (coefficients, slope)], axis=1)
