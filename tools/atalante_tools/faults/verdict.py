"""Evaluation of a run with a fault. Each failed check adds a sentence to the verdict.

    observation + row of the fault matrix -> verdict

1. The expected state must be reached within the time limit for the reaction.
2. The expected diagnostic must be reported within the time limit for the diagnostic.
3. Commands, motors and joints must stay within their limits.
4. The state must not become less severe without the operator. START must lead to ACTIVE, unless the fault persists.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_hal.robot import JOINTS
from atalante_hal.safety.events import Event
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.types import SupervisorState, Vector
from atalante_hal.wire.cia402 import Controlword
from atalante_tools.faults.matrix import Row
from atalante_tools.faults.observation import RESTARTED, Observation, restarted
from atalante_tools.faults.scenario import Case

_S = SupervisorState
#: States in which the torques of the controller are sent to the drives.
WALKING: Final = (_S.ACTIVE, _S.FULL_ASSIST, _S.FINISH_STEP)
#: Accepted motion beyond the position limit while a drive stops its joint [rad].
_OVERSHOOT: Final = 0.05
#: Largest accepted ratio of joint velocity to velocity limit.
_VELOCITY_RATIO: Final = 1.2


@dataclass(frozen=True)
class Expectation:
    """Expected result of a test case. The row of the fault matrix gives the values that the case does not define."""

    state: SupervisorState
    dtc: str  # regular expression for the diagnostic code; "" if no code is expected
    detected: int  # time limit for the diagnostic [cycles]
    reacted: int  # time limit for the reaction [cycles]

    @classmethod
    def of(cls, case: Case, row: Row) -> Expectation:
        """Return the expected result of a test case.

        Args:
            case: case of the scenario.
            row: row of the fault matrix that the scenario tests.

        Raises:
            ValueError: If neither the case nor the row defines a time limit in cycles.
        """
        detected = row.detected if case.detected is None else case.detected
        reacted = row.reacted if case.reacted is None else case.reacted
        if detected is None or reacted is None:
            raise ValueError(
                f"{row.id} {case.name}: the time limit in the fault matrix must be a number of cycles, got {row.cycles!r}; "
                "define the time limits `detected` and `reacted` in the case"
            )
        state = row.state if case.state is None else case.state
        return cls(state, row.dtc if case.dtc is None else case.dtc, detected, reacted)

    @property
    def walk_continues(self) -> bool:
        """Return whether the walk must continue during the fault."""
        return self.state is _S.ACTIVE


@dataclass(frozen=True)
class Verdict:
    """Result of one case: measured values and failures."""

    id: str
    case: str
    state: str  # state of the HAL just before the operator presses START
    #: Number of cycles from the fault to the reaction. If the HAL did not react, number of cycles to the diagnostic.
    #: None if the HAL neither reacted nor reported the diagnostic.
    cycles: int | None
    bound: int  # time limit for `cycles`
    dtc: str  # first reported diagnostic code that matches the expected code
    failures: tuple[str, ...]  # failed checks, one sentence each

    @property
    def passed(self) -> bool:
        """Return whether all checks passed."""
        return not self.failures


def evaluate(row: Row, case: Case, run: Observation) -> Verdict:
    """Evaluate a run: state, diagnostic, limits, recovery, and the additional checks of the test case.

    Args:
        row: row of the fault matrix.
        case: case that was run.
        run: observation of the run.
    """
    expected = Expectation.of(case, row)
    reaction = reacted(run, expected.state)
    failures = [
        *_state(run, case, expected, reaction),
        *_diagnostic(run, case, expected),
        *limit_violations(run),
        *_recovery(run, case),
        *(sentence for check in case.checks if (sentence := check(run)) is not None),
    ]
    reported = _reported(run, expected)
    code = reported[0].code if reported else ""
    at, bound = (
        (reaction, expected.reacted) if reaction else (reported[0].cycle if reported else None, expected.detected)
    )
    cycles = None if at is None else run.latency(at)
    return Verdict(row.id, case.name, run.state(run.last_before_start).name, cycles, bound, code, tuple(failures))


def reacted(run: Observation, state: SupervisorState) -> int | None:
    """Return the first cycle with the expected reaction, or None.

    If ACTIVE is expected, only a more severe state is a reaction. If another state is expected, this state or a more severe
    state is a reaction. If HOLD or a more severe state is expected, a cycle in which no drive gets the command ENABLE
    OPERATION is also a reaction.

    Args:
        run: observation of the run.
        state: expected state.
    """
    for cycle in range(run.first, run.last + 1):
        now = run.state(cycle)
        if now > state or (now is state and state is not _S.ACTIVE):
            return cycle
        words = run.commands.words(cycle)
        if state >= _S.HOLD and words and Controlword.ENABLE_OPERATION not in words:
            return cycle
    return None


def limit_violations(
    run: Observation, unlimited: Sequence[tuple[range, slice]] = (), strength: Vector | float = 1.0
) -> list[str]:
    """Return a sentence for each limit that a command, a motor or a joint exceeded.

    Args:
        run: observation of the run.
        unlimited: for each element, the velocities of a slice of the joints are not checked in a range of cycles.
        strength: torque of each motor divided by the torque of a motor without fault, shape (12,), at least 1.
    """
    robot = run.robot
    found = run.commands.violations(robot, run.drive_state)
    fast = np.abs(run.velocity) > _VELOCITY_RATIO * robot.velocity_max
    for cycles, joints in unlimited:
        fast[max(cycles.start - 1, 0) : max(cycles.stop - 1, 0), joints] = False
    for sentence, wrong in (
        ("a motor's torque was above its limit", np.abs(run.torque) > strength * robot.torque_max * (1.0 + 1e-9)),
        ("a joint was outside its position range", run.position > robot.position_max + _OVERSHOOT),
        ("a joint was outside its position range", run.position < robot.position_min - _OVERSHOOT),
        ("a joint was above its velocity limit", fast),
        ("the motion of a joint was not a number", np.isnan(run.position + run.velocity + run.torque)),
    ):
        if wrong.any():
            row, joint = (int(index) for index in np.argwhere(wrong)[0])
            found.append(f"{sentence}: {JOINTS[joint]} in cycle {row + 1}")
    return found


def automatic_improvements(run: Observation, until: int, starts: Sequence[int] = ()) -> list[str]:
    """Return a sentence if the HAL, after the first faulty cycle, changed to a less severe state without the operator.

    Each START may change the state only once, and within `ENABLE_CYCLES` cycles. READY to OFF is always accepted, because
    nothing moves.

    Args:
        run: observation of the run.
        until: last cycle to check.
        starts: cycles before `until` in which the operator pressed START. No fault may delay the reception of a START by the
            HAL.
    """
    for cycle in range(run.first + 1, until + 1):
        now, last = run.state(cycle), run.state(cycle - 1)
        if now >= last or last is _S.READY:
            continue
        if not any(
            start <= cycle <= start + ENABLE_CYCLES and set(run.states[start - 2 : cycle - 1]) == {last}
            for start in starts
        ):
            return [f"the state must not improve without the operator, but it became {now.name} in cycle {cycle}"]
    return []


def exception_sentence(error: Exception) -> str:
    """Return a sentence for an exception that ended a run.

    Args:
        error: exception.
    """
    return f"exception in the run: {type(error).__name__}: {error}"


def _state(run: Observation, case: Case, expected: Expectation, reaction: int | None) -> list[str]:
    if case.phase is not None and run.state(run.first - 1) is not _S.ACTIVE:
        return [f"the robot must be ACTIVE before the fault, got {run.state(run.first - 1).name}"]
    if expected.walk_continues:
        if reaction is None:
            return []
        return [f"the robot must stay ACTIVE, got {run.state(reaction).name} after {run.latency(reaction)} cycles"]
    if reaction is None:
        return [f"no {expected.state.name} within {run.latency(run.last_before_start)} cycles"]
    found = []
    if run.latency(reaction) > expected.reacted:
        found.append(
            f"{expected.state.name} must come within {expected.reacted} cycles of the fault, got {run.latency(reaction)}"
        )
    if run.state(run.last_before_start) is not expected.state:
        found.append(f"the final state must be {expected.state.name}, got {run.state(run.last_before_start).name}")
    return found


def _diagnostic(run: Observation, case: Case, expected: Expectation) -> list[str]:
    if not expected.dtc:
        return []
    reported = _reported(run, expected)
    if not reported:
        return [f"no {expected.dtc}; reported codes: {', '.join(dict.fromkeys(run.codes())) or 'none'}"]
    nodes = sorted({event.node for event in reported})
    if case.node is not None and case.node not in nodes:
        return [f"{expected.dtc} must name {case.node}, got {', '.join(nodes)}"]
    latency = min(run.latency(event.cycle) for event in reported if case.node in (None, event.node))
    if latency > expected.detected:
        return [f"{expected.dtc} must come within {expected.detected} cycles of the fault, got {latency}"]
    return []


def _reported(run: Observation, expected: Expectation) -> list[Event]:
    """Return all events since the first faulty cycle that have the expected diagnostic code."""
    return [event for event in run.events if event.cycle >= run.first and re.fullmatch(expected.dtc, event.code)]


def _recovery(run: Observation, case: Case) -> list[str]:
    # Skip this check for a case that begins at power-on, because the HAL changes to less severe states by itself after power-on.
    found = [] if case.phase is None else automatic_improvements(run, run.last_before_start)
    if run.pressed is None:
        return found
    after = run.states[run.pressed - 1 :]
    if not case.recovers and _S.ACTIVE in after:
        found.append("the robot must not be ACTIVE after START, because the fault persists")
    if case.recovers and not restarted(after):
        active = after.count(_S.ACTIVE)
        found.append(
            f"the operator's START must lead to {RESTARTED} cycles in ACTIVE, got {active}, then {after[-1].name}"
        )
    return found
