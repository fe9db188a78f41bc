"""Evaluation of a run by four checks; each failure is one sentence.

    observation + row of the matrix -> verdict

1. The state is reached within its bound.
2. The diagnostic is reported within its bound.
3. No command exceeded its limits, and no motor or joint did.
4. The state improved only by an action of the operator, and START led to ACTIVE if it may.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_hal.robot import JOINTS
from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword
from atalante_tools.faults.matrix import Row
from atalante_tools.faults.observation import Observation
from atalante_tools.faults.scenario import Case

_S = SupervisorState
#: States in which the controller drives the joints.
WALKING: Final = (_S.ACTIVE, _S.FULL_ASSIST, _S.FINISH_STEP)
#: Allowed overshoot past the position limit when a drive stops its joint [rad].
_OVERSHOOT: Final = 0.05
#: Allowed ratio of joint velocity to velocity limit.
_HASTE: Final = 1.2


@dataclass(frozen=True)
class Expectation:
    """Expected result of a case. A value that the case does not set is taken from its row of the fault matrix."""

    state: SupervisorState
    dtc: str  # regular expression of the diagnostic code; empty: none expected
    noticed: int  # cycles within which the diagnostic must be reported
    reacted: int  # cycles within which the HAL must react

    @classmethod
    def of(cls, case: Case, row: Row) -> Expectation:
        """Return the expectation of a case.

        Args:
            case: case of the scenario.
            row: row of the matrix that the scenario proves.

        Raises:
            ValueError: If neither case nor row has a bound in cycles.
        """
        noticed = row.noticed if case.noticed is None else case.noticed
        reacted = row.reacted if case.reacted is None else case.reacted
        if noticed is None or reacted is None:
            raise ValueError(
                f"{row.id} {case.name}: `noticed` and `reacted` must be given, because the bound of the row is "
                f"{row.cycles!r}, which is not a number of cycles"
            )
        state = row.state if case.state is None else case.state
        return cls(state, row.dtc if case.dtc is None else case.dtc, noticed, reacted)

    @property
    def walks_on(self) -> bool:
        """Whether the walk must continue during the fault."""
        return self.state is _S.ACTIVE


@dataclass(frozen=True)
class Verdict:
    """Result of one case."""

    id: str
    case: str
    state: str  # state of the HAL before the operator's START
    cycles: int | None  # cycles to the reaction, else to the diagnostic; None if there was neither
    bound: int  # largest allowed value of `cycles`
    dtc: str  # first matching diagnostic code that was reported
    failures: tuple[str, ...]  # one sentence each

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return not self.failures


def judge(row: Row, case: Case, seen: Observation) -> Verdict:
    """Run all four checks and the additional checks of the case.

    Args:
        row: row of the matrix.
        case: case that was run.
        seen: observation of the run.
    """
    wanted = Expectation.of(case, row)
    reaction = reacted(seen, wanted.state)
    failures = [
        *_state(seen, case, wanted, reaction),
        *_diagnostic(seen, case, wanted),
        *uncontrolled(seen),
        *_recovery(seen, case, wanted),
        *(sentence for check in case.checks if (sentence := check(seen)) is not None),
    ]
    noted = _noted(seen, wanted)
    code = noted[0].code if noted else ""
    at, bound = (reaction, wanted.reacted) if reaction else (noted[0].cycle if noted else None, wanted.noticed)
    cycles = None if at is None else seen.latency(at)
    return Verdict(row.id, case.name, seen.state(seen.quiet).name, cycles, bound, code, tuple(failures))


def reacted(seen: Observation, state: SupervisorState) -> int | None:
    """Return the first cycle with the reaction, None if there was none.

    The reaction is a command without ENABLE OPERATION for HOLD and worse, else the state itself. If ACTIVE is expected, the
    first cycle with any reaction is returned.

    Args:
        seen: observation of the run.
        state: expected state.
    """
    for cycle in range(seen.first, seen.last + 1):
        now = seen.state(cycle)
        if now > state or (now is state and state is not _S.ACTIVE):
            return cycle
        words = seen.commands.words(cycle)
        if state >= _S.HOLD and words and Controlword.ENABLE_OPERATION not in words:
            return cycle
    return None


def uncontrolled(seen: Observation) -> list[str]:
    """Return one sentence for each limit that a command, a motor or a joint exceeded.

    Args:
        seen: observation of the run.
    """
    robot = seen.robot
    found = seen.commands.outside(robot)
    for sentence, wrong in (
        ("a motor's torque was beyond its limit", np.abs(seen.torque) > robot.torque_max * (1.0 + 1e-9)),
        ("a joint was beyond its limit", seen.position > robot.position_max + _OVERSHOOT),
        ("a joint was beyond its limit", seen.position < robot.position_min - _OVERSHOOT),
        ("a joint was too fast", np.abs(seen.velocity) > _HASTE * robot.velocity_max),
    ):
        if wrong.any():
            row, joint = (int(index) for index in np.argwhere(wrong)[0])
            found.append(f"{sentence}: {JOINTS[joint]} in cycle {row + 1}")
    return found


def improved(seen: Observation, until: int) -> list[str]:
    """Return a sentence if the state improved without the operator after the first faulty cycle.

    Args:
        seen: observation of the run.
        until: last cycle to check.
    """
    for cycle in range(seen.first + 1, until + 1):
        if seen.state(cycle) < seen.state(cycle - 1):
            return [f"{seen.state(cycle).name} in cycle {cycle} without the operator"]
    return []


def _state(seen: Observation, case: Case, wanted: Expectation, reaction: int | None) -> list[str]:
    if case.phase is not None and seen.state(seen.first - 1) is not _S.ACTIVE:
        return [f"the robot must be ACTIVE before the fault, got {seen.state(seen.first - 1).name}"]
    if wanted.walks_on:
        if reaction is None:
            return []
        return [f"the robot must stay ACTIVE, got {seen.state(reaction).name} after {seen.latency(reaction)} cycles"]
    if reaction is None:
        return [f"no {wanted.state.name} within {seen.latency(seen.quiet)} cycles"]
    found = []
    if seen.latency(reaction) > wanted.reacted:
        found.append(f"{wanted.state.name} must come within {wanted.reacted} cycles, got {seen.latency(reaction)}")
    if seen.state(seen.quiet) is not wanted.state:
        found.append(f"the final state must be {wanted.state.name}, got {seen.state(seen.quiet).name}")
    return found


def _diagnostic(seen: Observation, case: Case, wanted: Expectation) -> list[str]:
    if not wanted.dtc:
        return []
    noted = _noted(seen, wanted)
    if not noted:
        return [f"no {wanted.dtc}; reported codes: {', '.join(dict.fromkeys(seen.codes())) or 'none'}"]
    nodes = sorted({event.node for event in noted})
    if case.node is not None and case.node not in nodes:
        return [f"{wanted.dtc} must name {case.node}, got {', '.join(nodes)}"]
    latency = min(seen.latency(event.cycle) for event in noted if case.node in (None, event.node))
    if latency > wanted.noticed:
        return [f"{wanted.dtc} must come within {wanted.noticed} cycles, got {latency}"]
    return []


def _noted(seen: Observation, wanted: Expectation) -> list[Event]:
    """Return the events with the expected diagnostic code since the fault began."""
    return [event for event in seen.events if event.cycle >= seen.first and re.fullmatch(wanted.dtc, event.code)]


def _recovery(seen: Observation, case: Case, wanted: Expectation) -> list[str]:
    found = (
        [] if case.phase is None else improved(seen, seen.quiet)
    )  # at power-on the state improves without the operator
    if seen.pressed is None:
        return found
    again = _S.ACTIVE in (seen.state(cycle) for cycle in range(seen.pressed, seen.last + 1))
    if again and not case.recovers:
        found.append("the robot must not be ACTIVE after START, because the fault persists")
    if not again and case.recovers:
        found.append(f"the operator's START must lead to ACTIVE, got {seen.state(seen.last).name}")
    return found
