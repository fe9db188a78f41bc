"""Tests of the additional checks of single scenarios: each check passes at its bound and fails just beyond the bound."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.safety.diagnostics import Dtc, Severity
from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults import checks
from atalante_tools.faults.observation import Observation

S, D = SupervisorState, DriveState
FIRST, PRESSED, CYCLES = 11, 21, 30
KNEE = JOINTS.index("left_SK")


class Commanded:
    """Commands with the given controlwords by cycle and the given torque limit of every joint."""

    def __init__(self, words: Mapping[int, Sequence[int]] | None = None, limit: np.ndarray | None = None) -> None:
        self._words = words or {}
        self._limit = np.zeros(CYCLES) if limit is None else limit

    def words(self, cycle: int) -> list[int]:
        return list(self._words.get(cycle, ()))

    def limit_of(self, _joint: int) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(1, CYCLES + 1), self._limit


@pytest.fixture
def make_observation(network: Network, robot: Robot) -> Any:
    def make(**changes: Any) -> Observation:
        """Return a run of 30 cycles with the fault from cycle 11 and START in cycle 21."""
        joints = np.zeros((CYCLES, 12))
        fields = {
            "over": None, "pressed": PRESSED, "states": (S.ACTIVE,) * CYCLES, "events": (), "commands": Commanded(),
            "drive_state": joints, "torque": joints, "position": joints, "velocity": joints, "temperature": joints,
            "age": np.zeros((CYCLES, 18), np.int64), "guide_exit": np.zeros(CYCLES), "messages": (),
        }  # fmt: skip
        return Observation(network=network, robot=robot, first=FIRST, **fields | changes)

    return make


def at(value: Any, *cycles: int, of: Any = 0.0) -> np.ndarray:
    """Return `value` in the given cycles and `of` in all others."""
    array = np.full(CYCLES, of)
    array[[cycle - 1 for cycle in cycles]] = value
    return array


def test_guide_exit_up_to_half_a_degree_passes(make_observation: Any) -> None:
    bound = math.radians(0.5)
    assert checks.guide_kept(make_observation(guide_exit=at(bound - 1e-9, FIRST, CYCLES))) is None
    for cycle in (FIRST, CYCLES):
        assert (
            checks.guide_kept(make_observation(guide_exit=at(bound + 1e-4, cycle)))
            == "a joint was 0.51 deg outside its guide"
        )


def test_guide_exit_fails_only_while_active_with_the_fault(make_observation: Any) -> None:
    assert checks.guide_kept(make_observation(guide_exit=at(1.0, FIRST - 1))) is None
    states = (S.ACTIVE,) * FIRST + (S.HOLD,) * (CYCLES - FIRST)
    assert checks.guide_kept(make_observation(states=states, guide_exit=at(1.0, FIRST + 1))) is None
    assert checks.guide_kept(make_observation(states=states, guide_exit=at(1.0, FIRST))) is not None


@pytest.mark.parametrize(
    ("outside", "message"),
    [
        ((), "no joint left its guide"),
        ((FIRST - 1,), "no joint left its guide"),
        ((FIRST, CYCLES - 1), None),
        ((FIRST, CYCLES), "a joint is still 0.1 deg outside its guide"),
    ],
)
def test_joint_must_leave_its_guide_and_return(
    make_observation: Any, outside: tuple[int, ...], message: str | None
) -> None:
    assert checks.guide_regained(make_observation(guide_exit=at(math.radians(0.1), *outside))) == message


def test_data_of_age_one_fails_only_during_the_fault(make_observation: Any) -> None:
    for cycle, message in ((FIRST - 1, None), (FIRST, "data must have age 0, got 1 cycles"), (PRESSED, None)):
        age = np.zeros((CYCLES, 18), np.int64)
        age[cycle - 1, 7] = 1
        assert checks.data_stays_fresh(make_observation(age=age, over=PRESSED - 1)) == message


def test_knee_enabled_between_fault_and_start_fails(make_observation: Any) -> None:
    for cycle, message in ((FIRST, None), (FIRST + 1, "cycle 12"), (PRESSED - 1, "cycle 20"), (PRESSED, None)):
        drives = np.full((CYCLES, 12), D.SWITCH_ON_DISABLED)
        drives[cycle - 1, KNEE] = D.OPERATION_ENABLED
        expected = message and f"the drive was enabled in {message}"
        assert checks.not_enabled_in_motion(make_observation(drive_state=drives)) == expected


@pytest.mark.parametrize(
    ("code", "node", "passes"),
    [
        (Dtc.HAL_DUPLICATE, "LEFT_SK", True),
        (Dtc.HAL_DUPLICATE, "HAL", False),
        (Dtc.HAL_DUPLICATE, "RIGHT_SK", False),
        (Dtc.NODE_TIMEOUT, "LEFT_SK", False),
    ],
)
def test_two_senders_must_be_reported_by_a_drive_of_the_left_leg(
    make_observation: Any, code: Dtc, node: str, passes: bool
) -> None:
    found = checks.drives_report_two_senders(make_observation(events=(Event(FIRST, code, "", node=node),)))
    assert (found is None) is passes


@pytest.mark.parametrize(
    ("code", "severity", "passes"),
    [
        (Dtc.BUS_TX_FULL, Dtc.BUS_TX_FULL.severity, True),
        (Dtc.BUS_TX_FULL, Severity.INFO, False),
        (Dtc.NODE_TIMEOUT, Dtc.BUS_TX_FULL.severity, False),
    ],
)
def test_full_queue_must_be_reported_with_its_severity(
    make_observation: Any, code: Dtc, severity: Severity, passes: bool
) -> None:
    found = checks.full_queue_is_confirmed(make_observation(events=(Event(FIRST, code, "", severity=severity),)))
    assert (found is None) is passes


def test_left_leg_must_hold_from_the_fifth_cycle_to_the_start(make_observation: Any) -> None:
    held = np.full((CYCLES, 12), D.OPERATION_ENABLED)
    held[FIRST + 3 : PRESSED - 1, :6] = D.QUICK_STOP_ACTIVE
    assert checks.left_leg_in_local_hold(make_observation(drive_state=held)) is None
    for cycle in (FIRST + 4, PRESSED - 1):
        for joint in range(6):
            drives = held.copy()
            drives[cycle - 1, joint] = D.OPERATION_ENABLED
            assert checks.left_leg_in_local_hold(make_observation(drive_state=drives)) == (
                f"a drive of the left leg did not hold in cycle {cycle}"
            )


def test_drive_enabled_after_a_rejected_start_fails(make_observation: Any) -> None:
    refused = (Event(PRESSED, "START_REFUSED", "LEFT_SK is out of range"),)
    enabled = [Controlword.SHUTDOWN] * 11 + [Controlword.ENABLE_OPERATION]
    assert checks.start_is_rejected(make_observation()) == "no START was rejected"
    assert (
        checks.start_is_rejected(make_observation(events=refused, commands=Commanded({PRESSED - 1: enabled}))) is None
    )
    for cycle in (PRESSED, CYCLES):
        found = checks.start_is_rejected(make_observation(events=refused, commands=Commanded({cycle: enabled})))
        assert found == f"a drive was enabled in cycle {cycle}, after LEFT_SK is out of range"


@pytest.mark.parametrize("temperature", [25.0, 100.0, 120.0])
def test_torque_limit_above_the_derating_curve_fails(make_observation: Any, robot: Robot, temperature: float) -> None:
    reported = np.full((CYCLES, 12), temperature)
    allowed = float(robot.torque_limit(reported[0])[KNEE])

    def found(limit: np.ndarray) -> str | None:
        return checks.limit_follows_temperature(make_observation(temperature=reported, commands=Commanded(limit=limit)))

    assert found(np.full(CYCLES, allowed + 0.019)) is None
    assert found(at(allowed + 1.0, FIRST - 1)) is None
    for cycle in (FIRST, CYCLES):
        assert str(found(at(allowed + 0.021, cycle))).startswith(f"the torque limit in cycle {cycle} must be at most")
