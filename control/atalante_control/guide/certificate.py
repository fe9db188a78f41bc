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

By induction over the steps the joint never leaves its guide, on the model: separate inertias J, each with its own ideal
torque limit. 1 and 2 hold for the linear loop. Where the ideal torque saturates away from the re-centred path, the filter
steps the two extremes and keeps a torque reserve; that is tested under adversarial pushes, not proved.

The bounds the filter is built for are torques on those separate inertias. A torque d on the coupled hip and knee counts as
A d with A = J M(q_SK)^-1, which is several times d on the light empty leg: 1 Nm at the hip counts as (7.6, -3.4) Nm at a
straight knee, 1 Nm at the knee as (-14.7, 7.7). `joint_torque` turns the bounds into the pair (hip, knee) of real torques
that is printed: any |d_SH| <= hip and |d_SK| <= knee, together, in any direction and order, stay inside the bounds at
every knee angle the leg can have inside the guide.

What the pair includes: the mass matrix of SH and SK in the worst pose, deviations at the step change up to the hand-over
box, sampling. What it does not include, and what a certified guide was left through: the real torque limit of the drives,
the limiter's torque rate, the delay of the loop, the torque carried over a step change. Errors of friction and inertia,
velocity noise and the other joints are not included either; they use up the same bounds. The pair is therefore a margin on
the model, no guarantee for the robot. Where the baseline fades in (Xi between `AirwalkConfig.fade` and 1) another law runs:
nothing is certified there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_control.gait.gait import bezier
from atalante_control.guide.backup_policy import BackupPolicy, ForcedResponse
from atalante_control.guide.filter import GuideFilter
from atalante_control.joint.idealization import AssistedInertia

Vector = npt.NDArray[np.float64]
Pair = tuple[float, float]

_JOINTS = ("SH", "SK")
_STATES = 41  # errors across the guide at which the image is cut
#: Direction of the pair of real torques, hip to knee. The largest pair along it is what `joint_torque` returns.
_DIRECTION = np.array([5.0, 3.0])
_KNEE_SPACING = math.radians(0.05)  # rad, largest distance between the knee angles at which the mass matrix is taken


@dataclass(frozen=True)
class HandOver:
    """Deviations from the nominal start of a step with which a joint is handed over to the guide.

    Raises:
        ValueError: a value that is negative or not finite.
    """

    deviation: float = math.radians(2.0)  # rad, largest |s(0)|
    rate: float = 0.5  # rad/s, largest |s'(0)|

    def __post_init__(self) -> None:
        for name in ("deviation", "rate"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of the hand-over must be finite and at least 0, got {getattr(self, name)!r}")


@dataclass(frozen=True)
class JointTorque:
    """Largest disturbances of the real joints, together and in any direction and order, inside the filter's bounds."""

    hip: float  # Nm, at SH
    knee: float  # Nm, at SK
    worst_knee: float  # rad, angle of SK at which the pair reaches a bound


@dataclass(frozen=True)
class JointCertificate:
    """What holds for one joint."""

    joint: str  # SH or SK
    margin: float  # 1 - largest e / q_bound from the re-centred state; negative: it is left
    tightest_phase: float  # where along the step, t / T
    side: str  # upper or lower
    u_ext: tuple[float, float]  # Nm on the separate inertia, the bounds the filter is built for
    #: Nm on the separate inertia, the same bounds scaled to where the margin is zero; (0, 0): there is none. A filter built
    #: for these holds them, the filter at hand does not.
    u_ext_max: tuple[float, float]
    torque: float  # Nm on the separate inertia, largest |u_b| along the way
    torque_limit: float  # Nm on the separate inertia, what the filter counts on
    image_empty_at: float  # first phase at which no state at all is safe; infinity where there is always one
    hand_over_max: float  # the hand-over box may be this much larger before the margin is zero


@dataclass(frozen=True)
class Certificate:
    """Whether a guide holds on the model, and if not, why.

    `joint_torque` is what the running filter is built for: real torque at the joints. It is None where the guide is not
    certified, and where `certify` was not given the mass matrix.
    """

    shape: str
    xi: float
    certified: bool
    reason: str  # one sentence
    joints: tuple[JointCertificate, JointCertificate]
    joint_torque: JointTorque | None = None

    @property
    def margin(self) -> float:
        """The smaller margin of the two joints."""
        return min(joint.margin for joint in self.joints)


def certify(
    guide: GuideFilter, xi: float, hand_over: HandOver | None = None, inertia: AssistedInertia | None = None
) -> Certificate:
    """Certificate of a guide at an assistance factor.

    Args:
        guide: gives shape, gains, inertia, disturbance bounds, gait and deadbeat; it is not changed.
        xi: assistance factor in [0, 1].
        hand_over: deviations from the baseline controller; None: the default of `HandOver`.
        inertia: mass matrix of SH and SK, for `Certificate.joint_torque`.
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
        None if inertia is None else joint_torque(guide, xi, hand_over, inertia),
    )


def joint_torque(guide: GuideFilter, xi: float, hand_over: HandOver, inertia: AssistedInertia) -> JointTorque:
    """Largest pair of real torques, 5 at the hip to 3 at the knee, inside the bounds the filter is built for.

    With A = J M(q_SK)^-1 it is the largest pair for which |A| (hip, knee) is at most the bounds, row by row, at every knee
    angle from the lowest to the highest that the guide and the deadbeat allow along the step. It is rounded down to 0.01 Nm.

    Args:
        guide: gives gait, deadbeat, shape and disturbance bounds.
        xi: assistance factor in [0, 1].
        hand_over: deviations that the deadbeat starts from.
        inertia: gives M and J.
    """
    bounds = np.array([min(-low, high) for low, high in guide.config.disturbance]) + 0.0  # no -0.0
    low, high = _knee_range(guide, xi, hand_over)
    angles = np.linspace(low, high, 2 + int((high - low) / _KNEE_SPACING))
    counts = np.array([np.abs(inertia.ideal_of(float(angle))) @ _DIRECTION for angle in angles])
    scales = (bounds / counts).min(axis=1)
    at = int(scales.argmin())
    hip, knee = (np.floor(100.0 * scales[at] * _DIRECTION) / 100.0).tolist()
    return JointTorque(hip, knee, float(angles[at]))


def _knee_range(guide: GuideFilter, xi: float, hand_over: HandOver) -> Pair:
    """Lowest and highest angle of SK along a step inside the guide: q_nom + s + e [rad]."""
    time = guide.time[: guide.cycles + 1]
    phase = time / guide.deadbeat.duration
    upper, lower = guide.shape.bounds(phase, xi).T
    nominal = bezier(guide.nominal[1:], phase)[:, 0]
    # As for the margin, a corner of the hand-over box is the worst.
    moved = np.abs(guide.deadbeat.basis(time)[0]).T @ [hand_over.deviation, hand_over.rate]
    return float((nominal - moved - lower).min()), float((nominal + moved + upper).max())


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
    """Return why a joint is not certified, empty if it is; in parts of the bounds, which are not the joint's Nm."""
    if math.isfinite(joint.image_empty_at):
        return (
            f"no state of {joint.joint} is safe: at {joint.tightest_phase:.2f} T the guide is narrower, or closes faster, "
            "than the backup policy holds against the disturbance its filter is built for"
        )
    if not joint.margin >= 0.0:
        return (
            f"{joint.joint} may leave the guide by {-100 * joint.margin:.0f} % at {joint.tightest_phase:.2f} T "
            f"({joint.side} side) under the disturbance its filter is built for"
        )
    if joint.torque > joint.torque_limit:
        return (
            f"the backup policy of {joint.joint} needs {100 * joint.torque / joint.torque_limit:.0f} % of the torque it may "
            "count on, from the re-centred state"
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
