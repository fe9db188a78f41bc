"""Oscillation of a joint that its drive holds: number, speed and interval of the reversals, and the state of the drive."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.hold_stability import INTERVAL, REVERSALS, SPEED, HoldStability, _follow
from atalante_hal.wire.cia402 import DriveState

KNEE = JOINTS.index("left_SK")
ABOVE = np.nextafter(SPEED, 1.0)


def oscillate(
    check: HoldStability,
    reversals: int,
    *,
    joint: int = KNEE,
    speed: float = ABOVE,
    interval: int = 5,
    state: DriveState = DriveState.QUICK_STOP_ACTIVE,
) -> tuple[Finding, ...]:
    """Return the findings after a motion with a number of reversals, which begins forwards."""
    velocity, states = np.zeros(len(JOINTS)), np.full(len(JOINTS), float(state))
    found: tuple[Finding, ...] = ()
    for swing in range(reversals + 1):
        velocity[joint] = speed * (-1) ** swing
        for _ in range(interval if swing < reversals else 1):
            found = check.check(velocity, states)
    return found


@pytest.mark.parametrize("joint", range(len(JOINTS)))
def test_oscillating_joint_is_found_at_the_last_reversal(joint: int) -> None:
    assert oscillate(HoldStability(), REVERSALS - 1, joint=joint) == ()
    (finding,) = oscillate(HoldStability(), REVERSALS, joint=joint)
    assert finding == Finding(
        Dtc.HOLD_UNSTABLE,
        JOINTS[joint].upper(),
        REVERSALS,
        True,
        f"{JOINTS[joint]} oscillates although its drive holds it: {REVERSALS} reversals in a row faster than 29 deg/s; "
        "its drive is switched off",
    )


@pytest.mark.parametrize(
    ("speed", "interval", "state", "found"),
    [
        (ABOVE, 1, DriveState.QUICK_STOP_ACTIVE, True),
        (SPEED, 1, DriveState.QUICK_STOP_ACTIVE, False),
        (-ABOVE, 1, DriveState.QUICK_STOP_ACTIVE, True),
        (ABOVE, INTERVAL, DriveState.QUICK_STOP_ACTIVE, True),
        (ABOVE, INTERVAL + 1, DriveState.QUICK_STOP_ACTIVE, False),
        (ABOVE, 5, DriveState.OPERATION_ENABLED, True),
        (ABOVE, 5, DriveState.SWITCH_ON_DISABLED, False),
        (ABOVE, 5, DriveState.FAULT, False),
    ],
)
def test_only_fast_reversals_of_a_driven_joint_count(
    speed: float, interval: int, state: DriveState, found: bool
) -> None:
    assert bool(oscillate(HoldStability(), 2 * REVERSALS, speed=speed, interval=interval, state=state)) is found


def test_slow_samples_between_two_swings_do_not_count() -> None:
    check, states = HoldStability(), np.full(len(JOINTS), float(DriveState.QUICK_STOP_ACTIVE))
    velocity = np.zeros(len(JOINTS))
    counted = []
    for value in [1.0, 0.0, -0.4, 0.4, 1.0, -1.0] * REVERSALS:
        velocity[KNEE] = value
        counted.append(bool(check.check(velocity, states)))
    # one reversal in the first six samples, then two in each six
    assert counted.index(True) == 6 * (REVERSALS // 2)


@pytest.mark.parametrize("speeds", [(SPEED, -ABOVE), (ABOVE, -SPEED)])
def test_both_directions_must_exceed_the_speed(speeds: tuple[float, float]) -> None:
    check, states = HoldStability(), np.full(len(JOINTS), float(DriveState.QUICK_STOP_ACTIVE))
    velocity = np.zeros(len(JOINTS))
    for value in speeds * REVERSALS:
        velocity[KNEE] = value
        assert check.check(velocity, states) == ()


def test_pause_ends_the_series() -> None:
    check = HoldStability()
    oscillate(check, REVERSALS - 1)
    rest, states = np.zeros(len(JOINTS)), np.full(len(JOINTS), float(DriveState.QUICK_STOP_ACTIVE))
    for _ in range(INTERVAL + 1):
        assert check.check(rest, states) == ()
    assert oscillate(check, REVERSALS - 1) == ()
    assert oscillate(check, 1)


def test_finding_lasts_until_the_drive_is_off() -> None:
    check = HoldStability()
    assert oscillate(check, REVERSALS)
    assert oscillate(check, 1)
    assert oscillate(check, 0, state=DriveState.SWITCH_ON_DISABLED) == ()
    assert oscillate(check, REVERSALS - 1) == ()


def test_restart_forgets_the_motion() -> None:
    check = HoldStability()
    oscillate(check, REVERSALS - 1)
    check.restart()
    assert oscillate(check, REVERSALS - 1) == ()


def test_kernel_reports_no_oscillation_of_joints_at_rest() -> None:
    zero, check = np.zeros(len(JOINTS)), HoldStability()
    assert _follow(zero, zero, check._swings, check._driven) is False
