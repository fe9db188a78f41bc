"""Judging a run: the four things every fault is asked, each failed one told in a sentence.

    observation + row of the matrix -> verdict

1. the state is right, by the bound; 2. the diagnostic is there, by the bound; 3. no command outside the limits left, and no drive
or joint went where it must not; 4. nothing got better by itself, and after the operator's START the walk goes on if it may.
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
#: How far past its limit a joint may swing when its drive stops it [rad], and how fast it may be against its limit.
_OVERSHOOT: Final = 0.05
_HASTE: Final = 1.2


@dataclass(frozen=True)
class Expectation:
    """What has to come of a case: its own words, and its row's where it says nothing."""

    state: SupervisorState
    dtc: str  # a regular expression: one code, or several
    noticed: int
    reacted: int

    @classmethod
    def of(cls, case: Case, row: Row) -> Expectation:
        """Of a case of the scenario of a row.

        Raises:
            ValueError: neither says within how many cycles.
        """
        noticed = row.noticed if case.noticed is None else case.noticed
        reacted = row.reacted if case.reacted is None else case.reacted
        if noticed is None or reacted is None:
            raise ValueError(
                f"{row.id} {case.name}: its row says {row.cycles!r}, so the case has to say how many cycles"
            )
        state = row.state if case.state is None else case.state
        return cls(state, row.dtc if case.dtc is None else case.dtc, noticed, reacted)

    @property
    def walks_on(self) -> bool:
        """The fault is ridden through."""
        return self.state is _S.ACTIVE


@dataclass(frozen=True)
class Verdict:
    """One case, judged."""

    id: str
    case: str
    state: str  # the supervisor's before the operator's START
    cycles: (
        int | None
    )  # from the first faulty one to the reaction or, ridden through, to the diagnostic; None: neither came
    bound: int  # for them
    dtc: str  # the code that was noted, of those asked for
    failures: tuple[str, ...]  # one sentence each

    @property
    def passed(self) -> bool:
        """Nothing failed."""
        return not self.failures


def judge(row: Row, case: Case, seen: Observation) -> Verdict:
    """All four."""
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
    """First cycle in which what was commanded is the reaction: the HOLD frame for HOLD and worse, else the supervisor's state.

    For ACTIVE, where no reaction is wanted, the first cycle in which there was one.
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
    """What must never be, whatever happens: on the wire, at the drives, at the joints."""
    robot = seen.robot
    found = seen.commands.outside(robot)
    for what, wrong in (
        ("a motor's torque was beyond its limit", np.abs(seen.torque) > robot.torque_max * (1.0 + 1e-9)),
        ("a joint was beyond its limit", seen.position > robot.position_max + _OVERSHOOT),
        ("a joint was beyond its limit", seen.position < robot.position_min - _OVERSHOOT),
        ("a joint was too fast", np.abs(seen.velocity) > _HASTE * robot.velocity_max),
    ):
        if wrong.any():
            row, joint = (int(index) for index in np.argwhere(wrong)[0])
            found.append(f"{what}: {JOINTS[joint]} in cycle {row + 1}")
    return found


def improved(seen: Observation, until: int) -> list[str]:
    """A sentence if the supervisor's state got better between the first faulty cycle and `until`."""
    for cycle in range(seen.first + 1, until + 1):
        if seen.state(cycle) < seen.state(cycle - 1):
            return [f"{seen.state(cycle).name} in cycle {cycle} without the operator"]
    return []


def _state(seen: Observation, case: Case, wanted: Expectation, reaction: int | None) -> list[str]:
    if case.phase is not None and seen.state(seen.first - 1) is not _S.ACTIVE:
        return [f"the robot was {seen.state(seen.first - 1).name} and did not walk when it began"]
    if wanted.walks_on:
        if reaction is None:
            return []
        return [f"{seen.state(reaction).name} after {seen.latency(reaction)} cycles, where it should walk on"]
    if reaction is None:
        return [f"no {wanted.state.name} within {seen.latency(seen.quiet)} cycles"]
    found = []
    if seen.latency(reaction) > wanted.reacted:
        found.append(f"{wanted.state.name} after {seen.latency(reaction)} cycles, and {wanted.reacted} are allowed")
    if seen.state(seen.quiet) is not wanted.state:
        found.append(f"the robot ended in {seen.state(seen.quiet).name}, not in {wanted.state.name}")
    return found


def _diagnostic(seen: Observation, case: Case, wanted: Expectation) -> list[str]:
    if not wanted.dtc:
        return []
    noted = _noted(seen, wanted)
    if not noted:
        return [f"no {wanted.dtc}; noted were {', '.join(dict.fromkeys(seen.codes())) or 'none'}"]
    nodes = sorted({event.node for event in noted})
    if case.node is not None and case.node not in nodes:
        return [f"{wanted.dtc} names {', '.join(nodes)}, not {case.node}"]
    latency = min(seen.latency(event.cycle) for event in noted if case.node in (None, event.node))
    if latency > wanted.noticed:
        return [f"{wanted.dtc} after {latency} cycles, and {wanted.noticed} are allowed"]
    return []


def _noted(seen: Observation, wanted: Expectation) -> list[Event]:
    """The diagnostics that were asked for."""
    return [event for event in seen.events if event.cycle >= seen.first and re.fullmatch(wanted.dtc, event.code)]


def _recovery(seen: Observation, case: Case, wanted: Expectation) -> list[str]:
    found = [] if case.phase is None else improved(seen, seen.quiet)  # switching on is an improvement
    if seen.pressed is None:
        return found
    again = _S.ACTIVE in (seen.state(cycle) for cycle in range(seen.pressed, seen.last + 1))
    if again and not case.recovers:
        found.append("ACTIVE again after START, while the fault lasts")
    if not again and case.recovers:
        found.append(f"the operator's START led to {seen.state(seen.last).name}, not to ACTIVE")
    return found
