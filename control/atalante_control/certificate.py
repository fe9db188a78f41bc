r"""Guide certificate: what a guide promises, computed before it is walked. `guide filter -> Certificate`.

The filter keeps a joint in its guide as long as the joint is in the safe backward image, the states from which the
backup policy stays inside under any disturbance within its bounds (Proposition 1 of the paper). Three things then have
to hold for a whole walk, and each is computed here, exactly, from the linear flow.

1. *The re-centred state is in the image at the start of a step.* The deadbeat sets s(0) = q - q_nom, s'(0) = q' -
   q_nom', so every step starts at e = 0, e' = 0, wherever the last one ended. From there the error is
   :math:`R(t) + s(0) R_0(t) + s'(0) R_1(t)` plus what the disturbance adds, at most D(t) up or down; R is the response
   to the nominal acceleration, R_0 and R_1 to the deadbeat's. Contained means that at every t to the horizon's end the
   largest of it over all admissible s(0), s'(0) stays under the upper bound, and the smallest over the lower one.
   What is left, as a part of the bound, is the margin.
2. *The image is then not empty all along the step.* From a state in the image at 0, the backup policy without
   disturbance leads at t to a state from which the worst disturbance adds D(tau) <= D(t + tau): that state is in the
   image at t. (For a monotone loop, a constant extreme from t on is a disturbance the image at 0 was made for; for an
   underdamped one D is the L1 norm, which covers every signal.)
3. *The end of a step does not spoil the next one.* Near T the horizon is short; without more, the filter would admit
   states there from which the next step cannot be kept, and h would fall at the change. Two things prevent that. The
   deadbeat re-centres the state, so the end state enters the next step through s(0) and s'(0) alone, and 1 holds for
   every pair of them in the hand-over box. And the horizon reaches `overlap` past T, so that the image at T already
   excludes leaving the guide fast. A joint that swings every other step is handed over by the baseline controller; one
   assisted in consecutive steps by its own guide, with |s(0)| up to the last width. The box is an assumption that
   the controller checks at every step change; the largest one admitted is part of the certificate.

By induction over the steps the joint never leaves its guide. The law is sampled every millisecond and the joint is not
the model: delay, quantisation, friction left over, coupling and the hand-over torque all count as disturbance, so its
bound has to be set wider than the push one wants to admit. Disturbances are those of the separate inertias: torques tau
on the coupled hip and knee count as J M^-1 tau (`AssistedInertia.ideal`), which on the light empty leg is several times
tau. And 1 and 2 hold for the linear loop: where the drive saturates away from the re-centred path, the filter steps the
two extremes and keeps a torque reserve, which is tested under adversarial pushes, not proved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_control.backup import BackupPolicy, ForcedResponse
from atalante_control.guide import GuideFilter

Vector = npt.NDArray[np.float64]

_JOINTS = ("SH", "SK")
_STATES = 41  # errors across the guide at which the image is cut


@dataclass(frozen=True)
class HandOver:
    """Deviations from the nominal start of a step with which a joint is handed over to the guide."""

    deviation: float = math.radians(2.0)  # rad, largest |s(0)|
    rate: float = 0.5  # rad/s, largest |s'(0)|


@dataclass(frozen=True)
class JointCertificate:
    """What holds for one joint."""

    joint: str  # SH or SK
    margin: float  # 1 - largest e / q_bound from the re-centred state; negative: it is left
    tightest_phase: float  # where along the step, t / T
    side: str  # upper or lower
    u_ext: tuple[float, float]  # Nm, the disturbance bounds asked for
    u_ext_max: tuple[float, float]  # Nm, the same bounds scaled to where the margin is zero; (0, 0): none is admitted
    torque: float  # Nm, largest |u_b| along the way
    torque_limit: float  # Nm, what the filter counts on
    image_empty_at: float  # first phase at which no state at all is safe; infinity where there is always one
    hand_over_max: float  # the hand-over box may be this much larger before the margin is zero


@dataclass(frozen=True)
class Certificate:
    """Whether a guide keeps its promise, and if not, why."""

    shape: str
    xi: float
    certified: bool
    reason: str  # one sentence
    joints: tuple[JointCertificate, JointCertificate]

    @property
    def margin(self) -> float:
        """The smaller margin of the two joints."""
        return min(joint.margin for joint in self.joints)


def certify(guide: GuideFilter, xi: float, hand_over: HandOver | None = None) -> Certificate:
    """Certificate of a guide at an assistance factor.

    Args:
        guide: gives shape, gains, inertia, disturbance bounds, gait and deadbeat; it is not changed.
        hand_over: deviations from the baseline controller; None: the default of `HandOver`.
    """
    hand_over = hand_over or HandOver()
    bounds = guide.shape.bounds(guide.time / guide.deadbeat.duration, xi)
    joints = (_joint(guide, bounds, 0, hand_over), _joint(guide, bounds, 1, hand_over))
    reason = next((said for said in map(_complaint, joints) if said), "")
    if reason:
        return Certificate(guide.shape.name, xi, False, reason, joints)
    worst = min(joints, key=lambda joint: joint.margin)
    return Certificate(
        guide.shape.name,
        xi,
        True,
        f"{100 * worst.margin:.0f} % of the guide is left where it is tightest, {worst.joint} at "
        f"{worst.tightest_phase:.2f} T ({worst.side} side)",
        joints,
    )


def largest_assistance(guide: GuideFilter, margin: float, hand_over: HandOver | None = None) -> float:
    """Up to which assistance factor a guide is certified with a margin; negative: not even at 0.

    Guides close as Xi grows, so it is found by bisection, to 0.01 and never too large.
    """

    def held(xi: float) -> bool:
        certificate = certify(guide, xi, hand_over)
        return certificate.certified and certificate.margin >= margin

    if not held(0.0):
        return -1.0
    low, high = 0.0, 1.0
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if held(middle) else (low, middle)
    return low


def _joint(guide: GuideFilter, bounds: Vector, joint: int, hand_over: HandOver) -> JointCertificate:
    policy, (low, high), time = guide.config.policies[joint], guide.config.disturbance[joint], guide.time
    response = _from_rest(policy, guide.forced[joint], time)
    up, down = policy.disturbance(time, low, high)
    # Linear in the deviations, so a corner of the box is the worst: (n, 2) of (e, e'), up to a sign.
    d, r = hand_over.deviation, hand_over.rate
    same, opposite = d * response.deviation + r * response.rate, d * response.deviation - r * response.rate
    moved = np.maximum(np.abs(same[:, 0]), np.abs(opposite[:, 0]))
    nominal = response.nominal[:, 0]
    rooms = np.stack([bounds[:, 0] - nominal, bounds[:, 1] + nominal], axis=1)
    ratios = 1.0 - (rooms - moved[:, None] - np.stack([up, -down], axis=1)) / bounds
    at, side = np.unravel_index(int(ratios.argmax()), ratios.shape)

    margin = 1.0 - float(ratios[at, side])

    limit = (1.0 - guide.config.reserve) * policy.torque_limit
    step = policy.step_response(time)
    unit = np.abs(policy.kp * step[:, 0] + policy.kd * step[:, 1]).max()
    asked = [
        np.abs((response.nominal + sign * m) @ [policy.kp, policy.kd]).max()
        for m in (same, opposite)
        for sign in (1, -1)
    ]
    undisturbed = float(max(asked))
    per_disturbance = float(unit) * max(high, -low)

    left = rooms - moved[:, None]
    scale = _smallest_ratio(left, np.stack([up, -down], axis=1))
    if per_disturbance > 0.0:
        scale = min(scale, (limit - undisturbed) / per_disturbance)
    scale = max(0.0, scale)
    return JointCertificate(
        _JOINTS[joint],
        margin,
        float(time[at]) / guide.deadbeat.duration,
        ("upper", "lower")[int(side)],
        (low, high),
        (low * scale + 0.0, high * scale + 0.0),
        undisturbed + per_disturbance,
        limit,
        math.inf if margin >= 0.0 else _empty_from(guide, bounds, joint),
        _smallest_ratio(rooms - np.stack([up, -down], axis=1), np.repeat(moved[:, None], 2, axis=1)),
    )


def _complaint(joint: JointCertificate) -> str:
    if math.isfinite(joint.image_empty_at):
        return (
            f"no state of {joint.joint} is safe: at {joint.tightest_phase:.2f} T the guide is narrower, or closes faster, "
            f"than the backup policy holds against {joint.u_ext[0]:.3g} to {joint.u_ext[1]:.3g} Nm"
        )
    if joint.margin < 0.0:
        return (
            f"{joint.joint} may leave the guide by {-100 * joint.margin:.0f} % at {joint.tightest_phase:.2f} T "
            f"({joint.side} side) under {joint.u_ext[0]:.3g} to {joint.u_ext[1]:.3g} Nm; it holds against "
            f"{joint.u_ext_max[0]:.3g} to {joint.u_ext_max[1]:.3g} Nm"
        )
    if joint.torque > joint.torque_limit:
        return (
            f"the backup policy of {joint.joint} asks for {joint.torque:.0f} Nm from the re-centred state and the drive "
            f"gives {joint.torque_limit:.0f} Nm"
        )
    return ""


def _from_rest(policy: BackupPolicy, forced: ForcedResponse, time: Vector) -> ForcedResponse:
    """The forced responses that start at e = 0, e' = 0."""
    phi = policy.transition(time)
    return ForcedResponse(*(part - phi @ part[0] for part in forced))


def _smallest_ratio(room: Vector, taken: Vector) -> float:
    """How often `taken` goes into `room` where it goes least; infinity where nothing is taken."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return max(0.0, float(np.where(taken > 0.0, room / taken, np.inf).min()))


def _image(guide: GuideFilter, bounds: Vector, joint: int, cycle: int) -> tuple[Vector, Vector, Vector]:
    """The safe backward image at a cycle: for errors e across the guide, the speeds e' between which it is safe.

    Each point of the horizon bounds Phi11 e + Phi12 e' on both sides: an interval of e' for each e.

    Returns:
        e, lowest and highest e', each shape (m,); lowest > highest where no e' is safe.
    """
    policy, (low, high) = guide.config.policies[joint], guide.config.disturbance[joint]
    points = np.concatenate([[cycle], guide.grid[guide.grid > cycle]])
    p, bounds = guide.forced[joint].nominal[points], bounds[points]
    tau = guide.time[points] - guide.time[cycle]
    up, down = policy.disturbance(tau, low, high)
    phi = policy.transition(tau)
    free = p[:, 0] - phi[:, 0] @ p[0]
    e = np.linspace(-bounds[0, 1], bounds[0, 0], _STATES)
    room_up = (bounds[:, 0] - up - free)[:, None] - np.outer(phi[:, 0, 0], e)
    room_down = (-bounds[:, 1] - down - free)[:, None] - np.outer(phi[:, 0, 0], e)
    gain = phi[1:, 0, 1, None]
    if len(tau) == 1:
        return e, np.full_like(e, -np.inf), np.full_like(e, np.inf)
    one, other = room_up[1:] / gain, room_down[1:] / gain
    positive = gain > 0.0
    return e, np.where(positive, other, one).max(axis=0), np.where(positive, one, other).min(axis=0)


def _empty_from(guide: GuideFilter, bounds: Vector, joint: int) -> float:
    for cycle in range(0, guide.cycles, guide.stride):
        _, slowest, fastest = _image(guide, bounds, joint, cycle)
        if not (slowest <= fastest).any():
            return cycle / guide.cycles
    return math.inf
