"""Joints that their drives do not hold: oscillations and overload, their limits, and the state of the drive."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.hold_stability import (
    AGE,
    AWAY,
    ENCODER_ERROR,
    INTERVAL,
    OVERLOADED,
    POWERLESS,
    REVERSALS,
    SATURATED,
    SLOWER,
    SPEED,
    SUNK,
    HoldStability,
    Measured,
    _follow,
    _watch_load,
)
from atalante_hal.wire.cia402 import DriveState

KNEE = JOINTS.index("left_SK")
ABOVE = np.nextafter(SPEED, 1.0)
LIMIT = load_robot().torque_max
#: Distance and torque of an overloaded knee.
FAR, FULL = 1.01 * AWAY, -LIMIT[KNEE]


def measured(state: DriveState = DriveState.QUICK_STOP_ACTIVE) -> Measured:
    """Return the measurements of a robot at rest whose drives are all in one state."""
    position, velocity, torque, age = np.zeros((4, len(JOINTS)))
    return Measured(position, velocity, torque, np.full(len(JOINTS), float(state)), age, np.full(len(JOINTS), np.inf))


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
    joints, found = measured(state), tuple[Finding, ...]()
    for swing in range(reversals + 1):
        joints.velocity[joint] = speed * (-1) ** swing
        for _ in range(interval if swing < reversals else 1):
            found = check.check(joints, LIMIT)
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
    check, joints, counted = HoldStability(), measured(), []
    for value in [1.0, 0.0, -0.4, 0.4, 1.0, -1.0] * REVERSALS:
        joints.velocity[KNEE] = value
        counted.append(bool(check.check(joints, LIMIT)))
    # one reversal in the first six samples, then two in each six
    assert counted.index(True) == 6 * (REVERSALS // 2)


@pytest.mark.parametrize("speeds", [(SPEED, -ABOVE), (ABOVE, -SPEED)])
def test_both_directions_must_exceed_the_speed(speeds: tuple[float, float]) -> None:
    check, joints = HoldStability(), measured()
    for value in speeds * REVERSALS:
        joints.velocity[KNEE] = value
        assert check.check(joints, LIMIT) == ()


def test_pause_ends_the_series() -> None:
    check = HoldStability()
    oscillate(check, REVERSALS - 1)
    for _ in range(INTERVAL + 1):
        assert check.check(measured(), LIMIT) == ()
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


def test_kernels_report_nothing_of_joints_at_rest() -> None:
    joints, check = measured(), HoldStability()
    assert _follow(joints.velocity, joints.drive_state, check._swings, check._driven) is False
    assert _watch_load(joints, LIMIT, check._driven, check._loads) is False


def overload(
    check: HoldStability,
    cycles: int,
    *,
    joint: int = KNEE,
    away: float = FAR,
    speed: float = 0.0,
    torque: float | None = None,
    state: DriveState = DriveState.QUICK_STOP_ACTIVE,
    age: int = 0,
    encoder_error: float = np.inf,
) -> tuple[Finding, ...]:
    """Begin a hold, then return the findings after a number of equal cycles with a joint away from its position."""
    joints, found = measured(state), tuple[Finding, ...]()
    joints.position[:] = 0.5
    check.check(joints, LIMIT)
    joints.position[joint], joints.velocity[joint], joints.age[joint] = 0.5 + away, speed, age
    joints.torque[joint] = -LIMIT[joint] if torque is None else torque
    joints.encoder_error[joint] = encoder_error
    for _ in range(cycles):
        found = check.check(joints, LIMIT)
    return found


def overloaded() -> tuple[HoldStability, Measured]:
    """Return a check that has seen the first cycle of a hold, and the measurements of an overloaded knee for the next cycles."""
    check, joints = HoldStability(), measured()
    check.check(joints, LIMIT)
    joints.position[KNEE], joints.torque[KNEE] = FAR, FULL
    return check, joints


@pytest.mark.parametrize("joint", range(len(JOINTS)))
def test_overloaded_joint_is_found_in_the_last_cycle(joint: int) -> None:
    assert overload(HoldStability(), OVERLOADED - 1, joint=joint) == ()
    (finding,) = overload(HoldStability(), OVERLOADED, joint=joint)
    assert finding == Finding(
        Dtc.HOLD_UNSTABLE,
        JOINTS[joint].upper(),
        OVERLOADED,
        True,
        f"{JOINTS[joint]} does not move back although its drive holds it and reports {LIMIT[joint]:.0f} Nm; "
        "its drive is switched off",
    )


@pytest.mark.parametrize(
    ("motion", "found"),
    [
        ({"away": 1.0001 * AWAY}, True),
        ({"away": -1.0001 * AWAY, "torque": -FULL}, True),
        ({"away": 0.9999 * AWAY}, False),
        ({"away": -0.9999 * AWAY}, False),
        ({"torque": SATURATED[0] * FULL}, True),
        ({"torque": np.nextafter(SATURATED[0] * FULL, 0.0)}, False),
        ({"torque": SATURATED[1] * FULL}, True),
        ({"torque": np.nextafter(SATURATED[1] * FULL, -np.inf)}, False),
        ({"torque": 0.0}, False),
        ({"torque": -FULL}, True),  # the drive pushes its joint away
        ({"speed": 2.0}, True),
        ({"speed": -SLOWER}, True),
        ({"speed": np.nextafter(-SLOWER, -1.0)}, False),
        ({"away": -FAR, "speed": SLOWER}, True),
        ({"away": -FAR, "speed": np.nextafter(SLOWER, 1.0)}, False),
        ({"age": AGE}, True),
        ({"age": AGE + 1}, False),
        ({"state": DriveState.OPERATION_ENABLED}, False),
        ({"state": DriveState.SWITCH_ON_DISABLED}, False),
    ],
)
def test_limits_of_an_overload(motion: dict[str, float], found: bool) -> None:
    assert bool(overload(HoldStability(), OVERLOADED, **motion)) is found  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("motion", "found"),
    [
        ({}, True),
        ({"away": -1.0001 * SUNK, "speed": -0.5}, True),
        ({"away": 0.9999 * SUNK}, False),
        ({"away": -0.9999 * SUNK}, False),
        ({"torque": np.nextafter(POWERLESS * FULL, 0.0)}, True),
        ({"torque": POWERLESS * FULL}, False),
        ({"torque": -POWERLESS * FULL}, False),
        ({"encoder_error": ENCODER_ERROR}, True),
        ({"encoder_error": -ENCODER_ERROR}, True),
        ({"encoder_error": np.nextafter(ENCODER_ERROR, 1.0)}, False),
        ({"encoder_error": np.nextafter(-ENCODER_ERROR, -1.0)}, False),
        ({"encoder_error": np.inf}, False),
        ({"speed": 2.0}, True),
        ({"speed": np.nextafter(-SLOWER, -1.0)}, False),
        ({"state": DriveState.OPERATION_ENABLED}, False),
        ({"state": DriveState.SWITCH_ON_DISABLED}, False),
    ],
)
def test_limits_of_a_motor_without_torque(motion: dict[str, float], found: bool) -> None:
    sunk = {"away": 1.0001 * SUNK, "torque": 0.0, "encoder_error": 0.0} | motion
    assert overload(HoldStability(), OVERLOADED - 1, **sunk) == ()  # type: ignore[arg-type]
    assert bool(overload(HoldStability(), OVERLOADED, **sunk)) is found  # type: ignore[arg-type]


def test_distance_of_a_motor_without_torque_is_at_least_its_bound() -> None:
    check, joints = HoldStability(), measured()
    joints.encoder_error[:] = 0.0
    check.check(joints, LIMIT)
    joints.position[KNEE] = SUNK
    assert [len(check.check(joints, LIMIT)) for _ in range(OVERLOADED)] == [0] * (OVERLOADED - 1) + [1]


def test_distance_from_the_start_of_the_hold_is_at_least_its_bound() -> None:
    check, joints = HoldStability(), measured()
    check.check(joints, LIMIT)
    joints.position[KNEE], joints.torque[KNEE] = AWAY, FULL
    assert [len(check.check(joints, LIMIT)) for _ in range(OVERLOADED)] == [0] * (OVERLOADED - 1) + [1]


def test_other_joints_with_old_values_or_drives_that_are_off_change_nothing() -> None:
    check, joints = HoldStability(), measured()
    joints.age[0], joints.drive_state[1] = AGE + 1, float(DriveState.SWITCH_ON_DISABLED)
    check.check(joints, LIMIT)
    joints.position[KNEE], joints.torque[KNEE] = FAR, FULL
    assert [len(check.check(joints, LIMIT)) for _ in range(OVERLOADED)] == [0] * (OVERLOADED - 1) + [1]


def test_decrease_of_the_speed_by_its_bound_is_not_slower() -> None:
    check, joints = overloaded()
    joints.velocity[KNEE] = 2.0
    check.check(joints, LIMIT)
    joints.velocity[KNEE] = 2.0 - SLOWER
    assert [len(check.check(joints, LIMIT)) for _ in range(OVERLOADED - 1)] == [0] * (OVERLOADED - 2) + [1]


@pytest.mark.parametrize(("slowing", "found"), [(0.9 * SLOWER, True), (1.1 * SLOWER, False)])
def test_joint_that_slows_down_shows_no_overload(slowing: float, found: bool) -> None:
    """`slowing` is the decrease of the speed in the time in which an overload is found [rad/s]."""
    (check, joints), counted = overloaded(), []
    for cycle in range(3 * OVERLOADED):
        joints.velocity[KNEE] = 2.0 - slowing * cycle / (OVERLOADED - 1)
        counted.append(bool(check.check(joints, LIMIT)))
    assert any(counted) is found


def test_joint_that_moves_back_restarts_the_count() -> None:
    check, joints = overloaded()
    for _ in range(OVERLOADED - 1):
        assert check.check(joints, LIMIT) == ()
    joints.velocity[KNEE] = -2.0 * SLOWER
    assert check.check(joints, LIMIT) == ()
    joints.velocity[KNEE] = 0.0
    for _ in range(OVERLOADED - 1):
        assert check.check(joints, LIMIT) == ()
    assert check.check(joints, LIMIT)


def test_old_values_keep_the_count() -> None:
    check, joints = overloaded()
    for _ in range(OVERLOADED - 1):
        assert check.check(joints, LIMIT) == ()
    joints.age[KNEE] = AGE + 1
    for _ in range(OVERLOADED):
        assert check.check(joints, LIMIT) == ()
    joints.age[KNEE] = 0
    assert check.check(joints, LIMIT)


@pytest.mark.parametrize("ends", ["drive off", "restart"])
def test_the_position_of_the_next_hold_counts(ends: str) -> None:
    check, joints = overloaded()
    for _ in range(OVERLOADED):
        found = check.check(joints, LIMIT)
    assert found
    if ends == "restart":
        check.restart()
    else:
        joints.drive_state[KNEE] = DriveState.SWITCH_ON_DISABLED
        assert check.check(joints, LIMIT) == ()
        joints.drive_state[KNEE] = DriveState.QUICK_STOP_ACTIVE
    for _ in range(2 * OVERLOADED):
        assert check.check(joints, LIMIT) == ()


def test_oscillation_and_overload_of_a_joint_are_one_finding() -> None:
    check, joints, found = HoldStability(), measured(), tuple[Finding, ...]()
    oscillate(check, REVERSALS)
    joints.position[KNEE], joints.torque[KNEE] = FAR, FULL
    for _ in range(OVERLOADED):
        found = check.check(joints, LIMIT)
    assert [finding.value for finding in found] == [REVERSALS]
