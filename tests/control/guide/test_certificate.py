"""Guide certificate: its margins compared with brute force, and the reasons for guides that are not certified."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from atalante_control.gait.gait import AIRWALK_GAIT, bezier, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.certificate import Certificate, HandOver, certify
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.shapes import SHAPES, half_width
from atalante_control.joint.idealization import AssistedInertia
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot

GAIT = load_gait(AIRWALK_GAIT, load_robot())
DEADBEAT = Deadbeat(GAIT.duration, 0.4)
POLICIES = (BackupPolicy(6300.0, 473.0, 8.0, 165.0), BackupPolicy(3600.0, 173.0, 1.9, 180.0))
CONFIG = GuideConfig(POLICIES, ((-30.0, 30.0), (-20.0, 20.0)))
BOX = HandOver()
UNLIMITED = replace(
    CONFIG, policies=(replace(POLICIES[0], torque_limit=math.inf), replace(POLICIES[1], torque_limit=math.inf))
)


def guide(shape: str, config: GuideConfig = CONFIG) -> GuideFilter:
    return GuideFilter(config, SHAPES[shape], DEADBEAT, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4])


def scaled(factor: float, config: GuideConfig = CONFIG) -> GuideConfig:
    low_high = [(low * factor, high * factor) for low, high in config.disturbance]
    return replace(config, disturbance=(low_high[0], low_high[1]))


@pytest.mark.parametrize("shape", ["constant", "widening", "narrowing", "pinched", "asymmetric"])
def test_guides_of_the_demonstration_are_certified(shape: str):
    certificate = certify(guide(shape), 0.5, BOX)
    assert certificate.certified
    assert certificate.margin > 0.2
    assert certificate.reason.endswith("side)")
    for joint in certificate.joints:
        assert joint.u_ext_max[1] > joint.u_ext[1]
        assert joint.u_ext_max[0] < joint.u_ext[0]
        assert joint.hand_over_max > 1.0
        assert joint.image_empty_at == math.inf
        assert 0.0 <= joint.tightest_phase <= 1.2


def brute_force_margin(certificate: Certificate, f: GuideFilter, xi: float, box: HandOver) -> list[float]:
    """Return the margin from h of the filter in the first cycle, over the corners of the hand-over box."""
    worst = [1.0, 1.0]
    for d in (-box.deviation, box.deviation):
        for r in (-box.rate, box.rate):
            f.start_step(xi, (d, d), (r, r))
            f.tick(0, 0.0, 0.0, 0.0, 0.0)
            worst = [min(w, 1.0 - math.sqrt(1.0 - h)) for w, h in zip(worst, f.h, strict=True)]
    return worst


@pytest.mark.parametrize("shape", ["constant", "widening", "narrowing", "pinched", "asymmetric"])
@pytest.mark.parametrize("xi", [0.0, 0.5, 0.8])
def test_margin_matches_the_filter_at_the_worst_start(shape: str, xi: float):
    f = guide(shape, UNLIMITED)
    certificate = certify(f, xi, BOX)
    margins = brute_force_margin(certificate, f, xi, BOX)
    for joint, margin in zip(certificate.joints, margins, strict=True):
        assert joint.margin <= margin + 1e-9
        assert joint.margin == pytest.approx(
            margin, abs=0.01
        )  # the certificate checks every cycle, the filter every eighth


@pytest.mark.parametrize("shape", ["constant", "pinched", "asymmetric", "snap"])
def test_margin_is_zero_at_the_largest_disturbance(shape: str):
    for index, joint in enumerate(certify(guide(shape, UNLIMITED), 0.5, BOX).joints):
        factor = joint.u_ext_max[1] / joint.u_ext[1]
        if factor == 0.0:
            assert joint.margin < 0.0
            continue
        at = certify(guide(shape, scaled(factor, UNLIMITED)), 0.5, BOX).joints[index]
        assert at.margin == pytest.approx(0.0, abs=1e-9)
        assert at.u_ext_max[1] == pytest.approx(joint.u_ext_max[1])
        inside, outside = (
            certify(guide(shape, scaled(factor * s, UNLIMITED)), 0.5, BOX).joints[index] for s in (0.99, 1.01)
        )
        assert inside.margin > 0.0 > outside.margin


def test_margin_is_zero_at_the_largest_hand_over():
    f = guide("widening", UNLIMITED)
    for index, joint in enumerate(certify(f, 0.5, BOX).joints):
        box = HandOver(BOX.deviation * joint.hand_over_max, BOX.rate * joint.hand_over_max)
        assert certify(f, 0.5, box).joints[index].margin == pytest.approx(0.0, abs=1e-9)


def test_margin_falls_with_disturbance_assistance_and_hand_over():
    by_disturbance = [certify(guide("constant", scaled(s)), 0.5, BOX).margin for s in (0.0, 0.5, 1.0, 1.5)]
    by_xi = [certify(guide("constant"), xi, BOX).margin for xi in (0.0, 0.3, 0.6, 0.9)]
    by_box = [certify(guide("constant"), 0.5, HandOver(d, 10 * d)).margin for d in (0.0, 0.02, 0.05)]
    for margins in (by_disturbance, by_xi, by_box):
        assert margins == sorted(margins, reverse=True)
        assert len(set(margins)) > 1


def test_guide_that_snaps_shut_has_no_safe_state():
    certificate = certify(guide("snap"), 0.5, BOX)
    assert not certificate.certified
    assert "no state of SH is safe: at 0.40 T" in certificate.reason
    assert math.isfinite(certificate.joints[0].image_empty_at)
    assert certificate.joints[0].u_ext_max == (0.0, 0.0)


def test_guide_too_narrow_for_the_stiffness_is_not_certified():
    soft = replace(CONFIG, policies=(BackupPolicy(1500.0, 250.0, 8.0), POLICIES[1]))
    certificate = certify(guide("narrowing", soft), 0.75, BOX)
    assert not certificate.certified
    assert "SH may leave the guide by" in certificate.reason or "no state of SH is safe" in certificate.reason
    assert "Nm" not in certificate.reason  # torques of the separate inertias are not joint torques


def test_too_large_hand_over_is_not_certified():
    certificate = certify(guide("widening", UNLIMITED), 0.5, HandOver(0.15, 4.0))
    assert not certificate.certified
    assert "may leave the guide by" in certificate.reason
    assert certificate.joints[0].image_empty_at == math.inf
    assert certificate.joints[0].hand_over_max < 1.0


def test_too_weak_drive_is_not_certified():
    weak = replace(CONFIG, policies=(replace(POLICIES[0], torque_limit=60.0), POLICIES[1]))
    certificate = certify(guide("constant", weak), 0.5, BOX)
    assert not certificate.certified
    assert "the backup policy of SH needs 215 % of its torque limit" in certificate.reason


def test_underdamped_policy_has_a_smaller_margin():
    ringing = replace(CONFIG, policies=(BackupPolicy(6300.0, 60.0, 8.0), POLICIES[1]))
    assert (
        certify(guide("constant", ringing), 0.5, BOX).joints[0].margin
        < certify(guide("constant"), 0.5, BOX).joints[0].margin
    )


def test_overlap_makes_high_speed_at_the_step_end_unsafe():
    """Without overlap, a joint that is about to leave the guide counts as safe at T; with overlap it is unsafe."""
    short, long = (guide("constant", replace(CONFIG, overlap=o)) for o in (0.0, 0.1))
    about_to_leave = (0.9 * half_width(0.5), 1.5, 0.0, 0.0)
    for f in (short, long):
        f.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
        f.tick(800, *about_to_leave)
    assert short.h[0] > 0.0 > long.h[0]


def test_safe_image_is_not_empty_along_a_certified_step():
    """The state that the backup policy reaches from the re-centred start is safe in every cycle, with the margin."""
    for shape in ("constant", "pinched"):
        f = guide(shape)
        margin = certify(f, 0.5, HandOver(0.0, 0.0)).margin
        f.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
        p = f.solution()
        for cycle in range(0, 801, 20):
            start = np.repeat(p[0], 1)
            phi = [policy.transition(np.array([cycle * 1e-3]))[0] for policy in POLICIES]
            hip, knee = p[cycle, :2] - phi[0] @ start[:2], p[cycle, 2:] - phi[1] @ start[2:]
            f.tick(cycle, *hip.tolist(), *knee.tolist())
            assert min(f.h) >= 1.0 - (1.0 - margin) ** 2 - 1e-9


# -- real torque -----------------------------------------------------------------------------------------------------

INERTIA = AssistedInertia(pinocchio_model(urdf(ExoskeletonParameters(), load_robot())), GAIT.tables().q)


def ideal(knee: float, push: tuple[float, float]) -> np.ndarray:
    """Return J M^-1 d of a real push, from the entries of the mass matrix [Nm]."""
    m11, m12, m22 = INERTIA.block(knee)
    return np.array(INERTIA.inertias) * np.linalg.solve([[m11, m12], [m12, m22]], push)


@pytest.mark.parametrize("shape", ["constant", "widening", "narrowing", "pinched", "asymmetric"])
@pytest.mark.parametrize("xi", [0.0, 0.5])
def test_real_torque_pair_is_tight_within_the_filter_bounds(shape: str, xi: float):
    f = guide(shape)
    bound = certify(f, xi, BOX, INERTIA).joint_torque
    assert bound is not None
    assert bound.hip == pytest.approx(5.0 / 3.0 * bound.knee, abs=0.02)
    phase = np.linspace(0.0, 1.0, 801)
    nominal = bezier(GAIT.coefficients[3:4], phase)[:, 0]
    edges = SHAPES[shape].bounds(phase, xi)
    largest = 0.0
    for d, r in itertools.product((-BOX.deviation, 0.0, BOX.deviation), (-BOX.rate, 0.0, BOX.rate)):
        moved = nominal + DEADBEAT.s(phase * GAIT.duration, np.array([d]), np.array([r]))[:, 0]
        for knee in np.concatenate([(moved + edges[:, 0])[::20], moved[::20], (moved - edges[:, 1])[::20]]).tolist():
            for side in (1.0, -1.0):
                parts = np.abs(ideal(knee, (bound.hip, side * bound.knee))) / (30.0, 20.0)
                largest = max(largest, float(parts.max()))
    assert 0.98 < largest <= 1.0
    worst = np.abs(ideal(bound.worst_knee, (bound.hip, -bound.knee))) / (30.0, 20.0)
    assert worst.max() == pytest.approx(1.0, abs=0.01)


def test_real_torque_is_amplified_at_a_straight_knee():
    np.testing.assert_allclose(ideal(0.0, (1.0, 0.0)), (7.6, -3.4), atol=0.1)
    np.testing.assert_allclose(ideal(0.0, (0.0, 1.0)), (-14.7, 7.7), atol=0.1)


def test_real_torque_pair_scales_with_the_filter_bounds():
    """A filter with twice the bounds has twice the torque pair; its margin has no effect."""
    one, two = (certify(guide("pinched", scaled(s)), 0.5, BOX, INERTIA).joint_torque for s in (0.5, 1.0))
    assert one is not None
    assert two is not None
    assert two.hip == pytest.approx(2.0 * one.hip, abs=0.02)
    lopsided = replace(CONFIG, disturbance=((-30.0, 33.0), (-25.0, 20.0)))
    assert certify(guide("pinched", lopsided), 0.5, BOX, INERTIA).joint_torque == two


def test_one_sided_bounds_give_a_real_torque_pair_of_zero():
    one_sided = replace(CONFIG, disturbance=((0.0, 30.0), (-20.0, 20.0)))
    bound = certify(guide("constant", one_sided), 0.5, BOX, INERTIA).joint_torque
    assert bound is not None
    assert (str(bound.hip), str(bound.knee)) == ("0.0", "0.0")


def test_no_real_torque_pair_without_certificate_or_mass_matrix():
    assert certify(guide("snap"), 0.5, BOX, INERTIA).joint_torque is None
    assert certify(guide("constant"), 0.5, BOX).joint_torque is None


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["deviation", "rate"])
def test_invalid_hand_over_is_rejected(name: str, bad: float):
    with pytest.raises(ValueError, match=rf"{name} of the hand-over must be finite and at least 0, got"):
        HandOver(**{name: bad})
