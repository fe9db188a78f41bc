r"""Guide certificate: a check before walking that the filter can keep the joints in a guide. `guide filter -> Certificate`.

The filter keeps a joint in its guide as long as the joint is in the safe backward image. These are the states from which the
backup policy stays in the guide under every disturbance within its bounds (Proposition 1 of the paper). Three conditions must
hold for a whole walk. Each condition is checked here exactly, with the linear flow.

1. *The re-centred state is in the image at the start of a step.* Re-centring sets s(0) = q - q_nom, s'(0) = q' - q_nom'.
   Every step therefore starts at e = 0, e' = 0, whatever the state at the end of the last step was. From there the error is
   :math:`R(t) + s(0) R_0(t) + s'(0) R_1(t)` plus the effect of the disturbance, at most D(t) up or down. R is the response to
   the nominal acceleration; R_0 and R_1 are the responses to the acceleration of the re-centring. The condition holds if, at
   every t of the horizon, the largest error over all admissible s(0), s'(0) is below the upper bound and the smallest is above
   the lower bound. The remaining distance, as a fraction of the bound, is the margin.
2. *The image is not empty at any time of the step.* This follows from condition 1. The backup policy without disturbance leads
   from a state in the image at 0 to a state at t. From there the worst disturbance adds D(tau) <= D(t + tau), so that state is
   in the image at t. (For a monotone loop, the image at 0 also covers a constant extreme disturbance that starts at t. For an
   underdamped loop D is the L1 norm, which covers every signal.)
3. *The end of a step does not violate the next one.* Near T the horizon is short. With this horizon alone the filter would
   admit states near T from which the joint leaves the guide in the next step, and h would fall at the step change. Two measures
   prevent this.
   Re-centring resets the error, so the end state enters the next step only through s(0) and s'(0), and condition 1 holds for
   every pair of them in the hand-over box. In addition the horizon extends `overlap` past T, so the image at T already
   excludes states that leave the guide fast. A joint that swings every other step is handed over by the baseline controller. A
   joint that is assisted in consecutive steps is handed over by its own guide, with |s(0)| up to the width at the end of the
   step. The box is an assumption, which the controller checks at every step change. The largest admissible box is part of the
   certificate.

By induction over the steps the joint never leaves its guide on the model of separate inertias J, each with its own ideal
torque limit. Conditions 1 and 2 hold for the linear loop. In states off the re-centred path the ideal torque can saturate. The
filter then simulates both extreme disturbances cycle by cycle and keeps a torque reserve. This case is tested under adversarial
pushes, but not proved.

The bounds of the filter are torques on the separate inertias. A torque d on the coupled hip and knee is equivalent to A d on
the separate inertias, with A = J M(q_SK)^-1. On the light empty leg this is several times d: at a straight knee, 1 Nm at the hip
is equivalent to (7.6, -3.4) Nm, and 1 Nm at the knee to (-14.7, 7.7) Nm. `joint_torque` converts the bounds to the printed pair
(hip, knee) of real torques. All disturbances with |d_SH| <= hip and |d_SK| <= knee, together, in any direction and order, are
within the bounds at every knee angle that the leg can have inside the guide.

The pair includes the mass matrix of SH and SK in the worst pose, deviations at the step change up to the hand-over box, and
sampling. It does not include the real torque limit of the drives, the torque rate of the limiter, the delay of the loop and the
torque carried over a step change; joints have left a certified guide because of these. It does not include errors of friction
and inertia, velocity noise and the other joints either; these use part of the same bounds. The pair is therefore a margin on the
model, not a guarantee for the robot. Where the baseline fades in (Xi between `AirwalkConfig.fade` and 1) the control law is
different, and nothing is certified.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from atalante_control.gait.gait import bezier
from atalante_control.guide.backup_policy import BackupPolicy, ForcedResponse
from atalante_control.guide.filter import GuideFilter
from atalante_control.joint.idealization import AssistedInertia
from atalante_hal.types import Vector

Pair = tuple[float, float]

_JOINTS = ("SH", "SK")
_STATES = 41  # number of errors e across the guide at which the safe backward image is evaluated
#: Ratio of hip torque to knee torque in the result of `joint_torque`.
_DIRECTION = np.array([5.0, 3.0])
_KNEE_SPACING = math.radians(0.05)  # rad, largest spacing of the knee angles at which the mass matrix is evaluated


@dataclass(frozen=True)
class HandOver:
    """Hand-over box: limits of the angle and speed deviations at a step change, for which the certificate holds.

    Raises:
        ValueError: If a value is negative or not finite.
    """

    deviation: float = math.radians(2.0)  # rad, largest |s(0)|
    rate: float = 0.5  # rad/s, largest |s'(0)|

    def __post_init__(self) -> None:
        for name in ("deviation", "rate"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of the hand-over must be finite and at least 0, got {getattr(self, name)!r}")


@dataclass(frozen=True)
class JointTorque:
    """Largest disturbance torques that may act on hip and knee together, in any direction, within the disturbance bounds."""

    hip: float  # Nm, at SH
    knee: float  # Nm, at SK
    worst_knee: float  # rad, angle of SK at which these two torques reach a disturbance bound


@dataclass(frozen=True)
class JointCertificate:
    """Certificate of one joint. Its torques are those on the separate inertia J of the joint (see module docstring)."""

    joint: str  # SH or SK
    margin: float  # 1 - largest |e| / q_bound after a start in the re-centred state; negative: the joint may leave the guide
    tightest_phase: float  # phase t / T at which the margin is smallest
    side: str  # bound of the guide with the smallest margin, upper or lower
    u_ext: tuple[float, float]  # Nm, disturbance bounds of the filter
    #: Largest admissible disturbance bounds [Nm]; (0, 0): no disturbance is admissible.
    #: These bounds are admissible only for a filter that is configured with them.
    u_ext_max: tuple[float, float]
    #: Largest backup torque |u_b| over the step under the worst disturbance [Nm].
    torque: float
    torque_limit: float  # Nm, torque limit minus the reserve of the filter
    image_empty_at: float  # first phase at which no state is safe; infinity if there is no such phase
    hand_over_max: float  # factor by which the hand-over box can grow until the margin is zero


@dataclass(frozen=True)
class Certificate:
    """Result of the certification of a guide on the model.

    `joint_torque` is the real torque at the joints that corresponds to the bounds of the filter. It is None if the guide is not
    certified or if `certify` was called without the mass matrix.
    """

    shape: str
    xi: float
    certified: bool
    reason: str  # sentence that states why the guide is certified or why it is not
    joints: tuple[JointCertificate, JointCertificate]
    joint_torque: JointTorque | None = None

    @property
    def margin(self) -> float:
        """Return the smaller margin of the two joints."""
        return min(joint.margin for joint in self.joints)


def certify(
    guide: GuideFilter, xi: float, hand_over: HandOver | None = None, inertia: AssistedInertia | None = None
) -> Certificate:
    """Compute the certificate of a guide at an assistance factor.

    Args:
        guide: filter with shape, gains, inertia, disturbance bounds, gait and re-centring; it is not changed.
        xi: assistance factor in [0, 1].
        hand_over: largest deviations at the hand-over from the baseline controller; None: the default of `HandOver`.
        inertia: mass matrix of SH and SK, for `Certificate.joint_torque`; None: `joint_torque` is None.
    """
    hand_over = hand_over or HandOver()
    bounds = guide.shape.bounds(guide.time / guide.deadbeat.duration, xi)
    joints = (_joint(guide, bounds, 0, hand_over), _joint(guide, bounds, 1, hand_over))
    reason = next((reason for reason in map(_reason, joints) if reason), "")
    if reason:
        return Certificate(guide.shape.name, xi, False, reason, joints)
    worst = min(joints, key=lambda joint: joint.margin)
    return Certificate(
        guide.shape.name,
        xi,
        True,
        f"smallest margin {100 * worst.margin:.0f} % of the guide, {worst.joint} at "
        f"{worst.tightest_phase:.2f} T ({worst.side} side)",
        joints,
        None if inertia is None else joint_torque(guide, xi, hand_over, inertia),
    )


def joint_torque(guide: GuideFilter, xi: float, hand_over: HandOver, inertia: AssistedInertia) -> JointTorque:
    """Return the largest disturbance torques of hip and knee, in the ratio 5 to 3, within the bounds of the filter.

    With A = J M(q_SK)^-1 it is the largest pair for which no element of |A| (hip, knee) exceeds its bound. This holds at every
    knee angle that the guide and the re-centring allow along the step. The pair is rounded down to 0.01 Nm.

    Args:
        guide: filter with gait, re-centring, shape and disturbance bounds.
        xi: assistance factor in [0, 1].
        hand_over: largest deviations at the step change.
        inertia: mass matrix M and separate inertias J.
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
    """Return the lowest and the highest angle of SK along a step inside the guide, q_nom + s + e [rad]."""
    time = guide.time[: guide.cycles + 1]
    phase = time / guide.deadbeat.duration
    upper, lower = guide.shape.bounds(phase, xi).T
    nominal = bezier(guide.nominal[1:], phase)[:, 0]
    # s is linear in the deviations, so a corner of the hand-over box is the worst case.
    moved = np.abs(guide.deadbeat.basis(time)[0]).T @ [hand_over.deviation, hand_over.rate]
    return float((nominal - moved - lower).min()), float((nominal + moved + upper).max())


def largest_assistance(guide: GuideFilter, margin: float, hand_over: HandOver | None = None) -> float:
    """Return the largest assistance factor at which a guide is certified with a margin; -1 if it is not certified at Xi = 0.

    Guides become narrower as Xi grows, so the factor is found by bisection. It is at most 0.01 too small and never too large.

    Args:
        guide: filter to certify; it is not changed.
        margin: smallest accepted `Certificate.margin`, fraction of the guide.
        hand_over: largest deviations at the step change; None: the default of `HandOver`.
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
    # The response is linear in the deviations, so a corner of the hand-over box is the worst case.
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


def _reason(joint: JointCertificate) -> str:
    """Return why a joint is not certified, or "" if it is.

    Values are percentages of the bounds, because the bounds are torques on separate inertias and not on the real joint.
    """
    if math.isfinite(joint.image_empty_at):
        return (
            f"no state of {joint.joint} is safe: at {joint.tightest_phase:.2f} T the guide is too narrow, or closes too fast, "
            "for the backup policy under the disturbance bounds of the filter"
        )
    if not joint.margin >= 0.0:
        return (
            f"{joint.joint} may leave the guide by {-100 * joint.margin:.0f} % at {joint.tightest_phase:.2f} T "
            f"({joint.side} side) under the disturbance bounds of the filter"
        )
    if joint.torque > joint.torque_limit:
        return (
            f"from the re-centred state the backup policy of {joint.joint} needs "
            f"{100 * joint.torque / joint.torque_limit:.0f} % of its torque limit less the reserve"
        )
    return ""


def _from_rest(policy: BackupPolicy, forced: ForcedResponse, time: Vector) -> ForcedResponse:
    """Return the forced responses from the start state e = 0, e' = 0."""
    phi = policy.transition(time)
    return ForcedResponse(*(part - phi @ part[0] for part in forced))


def _smallest_ratio(room: Vector, taken: Vector) -> float:
    """Return the smallest ratio `room / taken`, but at least 0. The ratio is infinite where `taken` is not positive."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return max(0.0, float(np.where(taken > 0.0, room / taken, np.inf).min()))


def _image(guide: GuideFilter, bounds: Vector, joint: int, cycle: int) -> tuple[Vector, Vector, Vector]:
    """Return the safe backward image at a cycle: the interval of safe speeds e' for each error e across the guide.

    Each point of the horizon bounds Phi11 e + Phi12 e' on both sides, which gives an interval of e' for each e.

    Returns:
        Errors e, lowest e' and highest e', each of shape (m,); lowest > highest where no e' is safe.
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
