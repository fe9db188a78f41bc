"""Drive state machines: every change of state is one CiA 402 has, and a controlword is followed in time.

Works on changes: a column of states is a handful of them, whatever the length of the log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.cia402 import TRANSITIONS, Controlword, DriveState, next_state
from atalante_tools.validate.e2e_rules import Steps
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import Family, Plan
from atalante_tools.validate.project import Project
from atalante_tools.validate.stream import Stream
from atalante_tools.validate.value_rules import Decoded

_S, _C = DriveState, Controlword
_STATES = {int(state) for state in DriveState}
#: What a drive may do by itself: fail, finish failing, finish booting.
_BY_ITSELF = {(s, f) for s in DriveState for f in (_S.FAULT_REACTION_ACTIVE, _S.FAULT)} | {
    (_S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED)
}
LEGAL = {(int(state), int(after)) for (state, _), after in TRANSITIONS.items()} | {
    (int(a), int(b)) for a, b in _BY_ITSELF
}
#: Commands that a drive need not follow: it stopped by itself and waits to be acknowledged, or its fault is still there.
EXEMPT = {(int(_S.QUICK_STOP_ACTIVE), int(_C.ENABLE_OPERATION)), (int(_S.FAULT), int(_C.FAULT_RESET))}
_NOTHING = -1


def must_follow(state: int, controlword: int) -> bool:
    """Whether a drive in this state has to change it for this controlword."""
    if state not in _STATES or (state, controlword) in EXEMPT:
        return False
    return next_state(DriveState(state), controlword) != state


@dataclass
class _Drive:
    """One drive: where it says its state and hears its command, and what it was doing when the last chunk ended."""

    row: int
    command_row: int  # -1: nobody commands it in this DBC
    command_place: int
    state: int = _NOTHING
    command: int = _NOTHING
    since: int = 0  # stamp [ns] from which on it has had this state and this command
    state_stamp: int = 0  # of the last state frame


class DriveRules:
    """Judges every message with a drive state."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._plan, self._findings = plan, findings
        self._limit_ns = project.number("cia402-response", "limit_ms") * 1e6
        state, command = project.text("cia402-transition", "state"), project.text("cia402-response", "command")
        self.drives: dict[int, list[_Drive]] = {}  # by first row of the family
        for family in plan.families:
            place = next((p for p, f in enumerate(family.codec.fields) if f.name == state), None)
            if place is not None:
                self.drives[family.rows.start] = [self._drive(plan, row, command) for row in family.rows]
        self.state, self.command = state, command

    @staticmethod
    def _drive(plan: Plan, row: int, command: str) -> _Drive:
        """The command of a drive is a signal it receives, named `Controlword` or `<end of the node's name>_Controlword`."""
        node = plan.sender(row)
        for family in plan.families:
            for command_row in family.rows:
                for field in plan.layouts[command_row].fields:
                    joint, _, quantity = field.name.rpartition("_")
                    if quantity == command and node in field.receivers and (not joint or node.endswith(f"_{joint}")):
                        return _Drive(row, command_row, family.codec.place(field.name))
        return _Drive(row, _NOTHING, _NOTHING)

    @property
    def command_rows(self) -> set[int]:
        """Rows whose decoded frames `judge` needs."""
        return {drive.command_row for drives in self.drives.values() for drive in drives} - {_NOTHING}

    def judge(self, decoded: dict[int, Decoded], family_of: dict[int, Family], stream: Stream, steps: Steps) -> None:
        """Judge a chunk.

        Args:
            decoded: families by their first row, those that have frames.
            family_of: family of each row.
            steps: of the alive counters, shape (n,).
        """
        for first, drives in self.drives.items():
            states = decoded.get(first)
            if states is None:
                continue
            place = states.family.codec.place(self.state)
            for drive in drives:
                self._judge_drive(drive, states, place, decoded, family_of, stream, steps)

    def _judge_drive(
        self,
        drive: _Drive,
        states: Decoded,
        place: int,
        decoded: dict[int, Decoded],
        family_of: dict[int, Family],
        stream: Stream,
        steps: Steps,
    ) -> None:
        of = stream.of(drive.row)
        if of.start == of.stop:
            return
        codes = states.codes[place, of.start - states.span.start : of.stop - states.span.start]
        self._judge_transitions(drive, codes, stream.stamps[of], steps[of])
        changes = _changes(codes, drive.state)
        events = [(int(stream.places[of][k]), int(stream.stamps[of][k]), True, int(codes[k])) for k in changes]
        if drive.command_row != _NOTHING:
            commands = decoded.get(family_of[drive.command_row].rows.start)
            span = stream.of(drive.command_row)
            if commands is not None and span.start != span.stop:
                words = commands.codes[
                    drive.command_place, span.start - commands.span.start : span.stop - commands.span.start
                ]
                changed = _changes(words, drive.command)
                events += [
                    (int(stream.places[span][k]), int(stream.stamps[span][k]), False, int(words[k])) for k in changed
                ]
                events.sort()
        self._follow(drive, events, stream.places[of], stream.stamps[of])

    def _judge_transitions(
        self, drive: _Drive, codes: npt.NDArray[np.int64], stamps: npt.NDArray[np.int64], steps: Steps
    ) -> None:
        before = np.concatenate([[drive.state], codes[:-1]])
        for k in np.flatnonzero((codes != before) & (steps <= 1)).tolist():
            was, now = int(before[k]), int(codes[k])
            if was in _STATES and now in _STATES and (was, now) not in LEGAL:
                self._findings.add(
                    "cia402-transition",
                    self._plan.name(drive.row),
                    stamps[k : k + 1],
                    node=self._plan.sender(drive.row),
                    signal=self.state,
                    shown=[f"{DriveState(was).name} to {DriveState(now).name}"],
                    badness=np.zeros(1),
                )

    def _follow(
        self,
        drive: _Drive,
        events: list[tuple[int, int, bool, int]],
        places: npt.NDArray[np.intp],
        stamps: npt.NDArray[np.int64],
    ) -> None:
        """Walk through the changes: how long was a command not followed, as far as the drive's own frames show it?"""
        for place, stamp, is_state, code in events:
            at = int(np.searchsorted(places, place)) - 1
            self._check(drive, int(stamps[at]) if at >= 0 else drive.state_stamp)
            if is_state:
                drive.state = code
            else:
                drive.command = code
            drive.since = stamp
        drive.state_stamp = int(stamps[-1])

    def _check(self, drive: _Drive, until: int) -> None:
        waited = until - drive.since
        if waited > self._limit_ns and must_follow(drive.state, drive.command):
            self._findings.add(
                "cia402-response",
                self._plan.name(drive.row),
                np.array([drive.since], np.int64),
                node=self._plan.sender(drive.row),
                shown=[waited * 1e-6],
            )

    def finish(self) -> None:
        """The log is over: commands that were still not followed."""
        for drives in self.drives.values():
            for drive in drives:
                if drive.state_stamp:
                    self._check(drive, drive.state_stamp)


def _changes(codes: npt.NDArray[np.int64], before: int) -> list[int]:
    """Places where a column differs from the value before. Shape (n,)."""
    changed = np.flatnonzero(codes[1:] != codes[:-1]) + 1
    return [*([0] if int(codes[0]) != before else []), *changed.tolist()]
