"""Comparison of reported and sent torques: tolerance, torque limit, time to follow a command, and number of wrong cycles."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.torque_tracking import CONFIRM, SPAN, TOLERANCE, TorqueTracking, _compare

KNEE = JOINTS.index("left_SK")
BREAKAWAY = np.linspace(2.0, 24.0, len(JOINTS))
LIMIT = 100.0


def wrong_cycles(sent: list[float], reported: list[float], *, joint: int = KNEE, limit: float = LIMIT) -> list[int]:
    """Return the indices of the cycles with a finding, for the torques of one joint in consecutive cycles; all others are 0."""
    check, torques = TorqueTracking(BREAKAWAY), np.zeros((2, len(JOINTS)))
    found = []
    for cycle, torques[:, joint] in enumerate(zip(sent, reported, strict=True)):
        findings = check.check(torques[0], np.full(len(JOINTS), limit), torques[1])
        assert all(finding.node == JOINTS[joint].upper() for finding in findings)
        if findings:
            found.append(cycle)
    return found


@pytest.mark.parametrize("joint", range(len(JOINTS)))
@pytest.mark.parametrize("sent", [30.0, 0.0, -30.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_torque_beyond_the_tolerance_is_found_after_the_confirmation(joint: int, sent: float, direction: float) -> None:
    edge = TOLERANCE * BREAKAWAY[joint]
    cycles = SPAN + CONFIRM
    good = [sent] * SPAN
    for error, found in ((0.99 * edge, []), (1.01 * edge, [SPAN + CONFIRM - 1])):
        reported = good + [sent + direction * error] * CONFIRM
        assert wrong_cycles([sent] * cycles, reported, joint=joint) == found


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_torque_at_exactly_the_tolerance_is_not_found(direction: float) -> None:
    cycles = SPAN + CONFIRM
    assert wrong_cycles([0.0] * cycles, [direction * TOLERANCE * BREAKAWAY[KNEE]] * cycles) == []


@pytest.mark.parametrize(("share", "found"), [(-1.0, True), (0.0, True), (0.4, True), (1.0, False), (1.6, True)])
def test_share_of_the_torque_is_found(share: float, found: bool) -> None:
    sent = [20.0] * (SPAN + CONFIRM)
    assert bool(wrong_cycles(sent, [20.0] * SPAN + [share * 20.0] * CONFIRM)) is found


@pytest.mark.parametrize(
    ("late", "found"),
    [(0, False), (1, False), (SPAN - 1, False), (SPAN + CONFIRM - 2, False), (SPAN + CONFIRM - 1, True)],
)
def test_torque_may_follow_a_step_of_the_command_late(late: int, found: bool) -> None:
    before, after = [-40.0] * 2 * SPAN, [40.0] * 3 * SPAN
    reported = before + [-40.0] * late + [40.0] * (3 * SPAN - late)
    assert bool(wrong_cycles(before + after, reported)) is found


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("reported", "found"), [(60.0, False), (40.0, False), (30.0, True), (70.0, True)])
def test_drive_may_limit_a_torque_above_the_limit(sign: float, reported: float, found: bool) -> None:
    sent = [sign * 60.0] * (SPAN + CONFIRM)
    assert bool(wrong_cycles(sent, [sign * reported] * len(sent), limit=40.0)) is found


@pytest.mark.parametrize("reported", [np.nan, np.inf, -np.inf])
def test_torque_that_is_not_finite_is_wrong(reported: float) -> None:
    sent = [1.0] * (SPAN + CONFIRM)
    assert wrong_cycles(sent, [1.0] * SPAN + [reported] * CONFIRM) == [SPAN + CONFIRM - 1]


def test_a_right_torque_restarts_the_count() -> None:
    wrong = [0.0] * (CONFIRM - 1)
    reported = [30.0] * SPAN + [*wrong, 30.0] * 5
    assert wrong_cycles([30.0] * len(reported), reported) == []


def test_torques_before_the_span_is_complete_are_not_compared() -> None:
    sent = [30.0] * 2 * SPAN
    assert wrong_cycles(sent, [0.0] * len(sent))[0] == SPAN + CONFIRM - 2


def test_restart_forgets_all_torques() -> None:
    check, limit, zero, sent = TorqueTracking(BREAKAWAY), np.full(12, LIMIT), np.zeros(12), np.full(12, 30.0)
    for _ in range(SPAN + CONFIRM - 2):
        assert check.check(sent, limit, zero) == ()
    check.restart()
    for _ in range(SPAN + CONFIRM - 2):
        assert check.check(sent, limit, zero) == ()
    assert len(check.check(sent, limit, zero)) == len(JOINTS)


def test_finding_names_joint_and_torques() -> None:
    check, limit, sent, reported = TorqueTracking(BREAKAWAY), np.full(12, LIMIT), np.zeros(12), np.zeros(12)
    sent[KNEE], reported[KNEE] = 30.0, -30.0
    for _ in range(SPAN + CONFIRM - 1):
        found = check.check(sent, limit, reported)
    text = "the drive of left_SK must follow the torque command of 30.0 Nm, got a reported torque of -30.0 Nm"
    assert found == (Finding(Dtc.TORQUE_TRACKING, "LEFT_SK", -30.0, True, text),)


def test_kernel_reports_no_deviation_if_the_torques_follow() -> None:
    zero, tracking = np.zeros(len(JOINTS)), TorqueTracking(BREAKAWAY)._tracking
    limit = np.full(len(JOINTS), LIMIT)
    assert [_compare(zero, limit, zero, TOLERANCE * BREAKAWAY, tracking) for _ in range(SPAN)] == [False] * SPAN
