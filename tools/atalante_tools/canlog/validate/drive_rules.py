"""Rules for drive states: only transitions of CiA 402 are legal, and a drive must respond to a controlword in time.

The drive state and the controlword change rarely. To save time, the rules check only frames in which the drive state or the
controlword changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.cia402 import TRANSITIONS, Controlword, DriveState, next_state
from atalante_tools.canlog.plan import Family, Plan
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.e2e_rules import Steps
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project
from atalante_tools.canlog.validate.value_rules import Decoded

_S, _C = DriveState, Controlword
_STATES = {int(state) for state in DriveState}
#: State changes (state, next state) that a drive makes without a command.
#: A fault leads from any state to FAULT_REACTION_ACTIVE or FAULT. The end of the boot leads to SWITCH_ON_DISABLED.
_SPONTANEOUS = {(s, f) for s in DriveState for f in (_S.FAULT_REACTION_ACTIVE, _S.FAULT)} | {
    (_S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED)
}
#: All state changes (state, next state) that a drive may make. Any other state change is a violation.
LEGAL = {(int(state), int(after)) for (state, _), after in TRANSITIONS.items()} | {
    (int(a), int(b)) for a, b in _SPONTANEOUS
}
#: Pairs (drive state, controlword) without a check of the response, because the drive may ignore the controlword.
#: ENABLE_OPERATION: if a drive stopped without a command, the drive may ignore ENABLE_OPERATION until QUICK_STOP arrives.
#: FAULT_RESET: while the cause of the fault persists, the drive may ignore FAULT_RESET.
EXEMPT = {(int(_S.QUICK_STOP_ACTIVE), int(_C.ENABLE_OPERATION)), (int(_S.FAULT), int(_C.FAULT_RESET))}
_NOTHING = -1


def must_respond(state: int, controlword: int) -> bool:
    """Return whether a drive in this state must change its state on receiving the controlword.

    Args:
        state: value of `DriveState`.
        controlword: received controlword.
    """
    if state not in _STATES or (state, controlword) in EXEMPT:
        return False
    return next_state(DriveState(state), controlword) != state


@dataclass
class _Drive:
    """Drive: its messages, its last reported state and the last controlword for it."""

    row: int  # message index (position in the arrays of `Plan`) of the state message
    command_row: int  # message index of the command message; -1 if the DBC has no controlword for the drive
    command_index: int  # position of the controlword among the signals of the command message; -1 if there is none
    state: int = _NOTHING
    command: int = _NOTHING
    since: int = 0  # time stamp of the last change of the drive state or of the controlword [ns]
    state_stamp: int = 0  # time stamp of the last frame of the state message [ns]


@dataclass(frozen=True)
class _CommandField:
    """Signal of a command message that contains a controlword."""

    row: int  # message index (position in the arrays of `Plan`) of the command message
    index: int  # position of the controlword among the signals of the command message
    joint: str  # joint in the signal name, such as FH in FH_Controlword; empty for the name Controlword
    receivers: tuple[str, ...]  # nodes that receive the controlword


class DriveRules:
    """Rules for the drive states and for the responses to controlwords."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._plan, self._findings = plan, findings
        self._limit_ns = project.number("cia402-response", "limit_ms") * 1e6
        state, command = project.text("cia402-transition", "state"), project.text("cia402-response", "command")
        commands = _command_fields(plan, command)
        #: Lists of drives. The state messages of all drives in one list have the same signal layout (a family).
        #: The key of a list is the smallest message index in the family.
        self.drives: dict[int, list[_Drive]] = {}
        for family in plan.families:
            index = next((p for p, f in enumerate(family.codec.fields) if f.name == state), None)
            if index is not None:
                self.drives[family.rows.start] = [_drive(row, plan.sender(row), commands) for row in family.rows]
        self.state, self.command = state, command

    @property
    def command_rows(self) -> set[int]:
        """Return the indices of the command messages of all drives."""
        return {drive.command_row for drives in self.drives.values() for drive in drives} - {_NOTHING}

    def check(self, decoded: dict[int, Decoded], family_of: dict[int, Family], stream: Stream, steps: Steps) -> None:
        """Check the drive states and the responses to controlwords in a chunk.

        Args:
            decoded: decoded frames of each message family in the chunk. Key: first message index of the family.
            family_of: message family of each message index.
            stream: frames of the chunk, sorted by message, shape (n,).
            steps: increment of the alive counter at each frame, shape (n,).
        """
        for first, drives in self.drives.items():
            states = decoded.get(first)
            if states is None:
                continue
            index = states.family.codec.index(self.state)
            for drive in drives:
                self._check_drive(drive, states, index, decoded, family_of, stream, steps)

    def _check_drive(
        self,
        drive: _Drive,
        states: Decoded,
        index: int,
        decoded: dict[int, Decoded],
        family_of: dict[int, Family],
        stream: Stream,
        steps: Steps,
    ) -> None:
        of = stream.of(drive.row)
        if of.start == of.stop:
            return
        codes = states.codes[index, of.start - states.span.start : of.stop - states.span.start]
        self._check_transitions(drive, codes, stream.stamps[of], steps[of])
        changes = _changes(codes, drive.state)
        events = [(int(stream.indices[of][k]), int(stream.stamps[of][k]), True, int(codes[k])) for k in changes]
        if drive.command_row != _NOTHING:
            commands = decoded.get(family_of[drive.command_row].rows.start)
            span = stream.of(drive.command_row)
            if commands is not None and span.start != span.stop:
                words = commands.codes[
                    drive.command_index, span.start - commands.span.start : span.stop - commands.span.start
                ]
                changed = _changes(words, drive.command)
                events += [
                    (int(stream.indices[span][k]), int(stream.stamps[span][k]), False, int(words[k])) for k in changed
                ]
                events.sort()
        self._replay_changes(drive, events, stream.indices[of], stream.stamps[of])

    def _check_transitions(
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

    def _replay_changes(
        self,
        drive: _Drive,
        events: list[tuple[int, int, bool, int]],
        indices: npt.NDArray[np.intp],
        stamps: npt.NDArray[np.int64],
    ) -> None:
        """Apply all changes of drive state and controlword in order of time. Before each change, check for an overdue response.

        Args:
            drive: drive that is updated with each change.
            events: (index in the chunk, time stamp [ns], True for a state and False for a command, code) of each change.
            indices: indices of the state frames in the chunk, shape (k,).
            stamps: stamps of the state frames [ns], shape (k,).
        """
        for index, stamp, is_state, code in events:
            at = int(np.searchsorted(indices, index)) - 1
            self._check(drive, int(stamps[at]) if at >= 0 else drive.state_stamp)
            if is_state:
                drive.state = code
            else:
                drive.command = code
            drive.since = stamp
        drive.state_stamp = int(stamps[-1])

    def _check(self, drive: _Drive, until: int) -> None:
        """Report the drive if its response to the last command is overdue at the time stamp `until` [ns]."""
        waited = until - drive.since
        if waited > self._limit_ns and must_respond(drive.state, drive.command):
            self._findings.add(
                "cia402-response",
                self._plan.name(drive.row),
                np.array([drive.since], np.int64),
                node=self._plan.sender(drive.row),
                shown=[waited * 1e-6],
            )

    def finish(self) -> None:
        """Check the response to the last command of each drive at the end of the log."""
        for drives in self.drives.values():
            for drive in drives:
                if drive.state_stamp:
                    self._check(drive, drive.state_stamp)


def _changes(codes: npt.NDArray[np.int64], before: int) -> list[int]:
    """Return the indices of all codes that differ from the previous code.

    Args:
        codes: codes of consecutive frames, shape (n,).
        before: code of the frame before these frames.
    """
    changed = np.flatnonzero(codes[1:] != codes[:-1]) + 1
    return [*([0] if int(codes[0]) != before else []), *changed.tolist()]


def _command_fields(plan: Plan, command: str) -> list[_CommandField]:
    """Return all fields with a controlword, in the order of the plan.

    The command signal has the name `Controlword`, or a name with the joint, such as `FH_Controlword` for the node LEFT_FH.

    Args:
        plan: compiled DBC.
        command: name of the command signal without the joint, such as `Controlword`.
    """
    found = []
    for family in plan.families:
        for row in family.rows:
            for field in plan.layouts[row].fields:
                joint, _, quantity = field.name.rpartition("_")
                if quantity == command:
                    found.append(_CommandField(row, family.codec.index(field.name), joint, field.receivers))
    return found


def _drive(row: int, node: str, commands: Sequence[_CommandField]) -> _Drive:
    """Create a drive, and find its controlword in the command fields.

    The node must receive the field. If the field belongs to a joint, the name of the node must end with this joint. For
    example, `FH_Controlword` is the controlword of the node LEFT_FH. The first matching field is used.

    Args:
        row: index of the state message in the plan.
        node: node of the drive.
        commands: result of `_command_fields`.
    """
    for field in commands:
        if node in field.receivers and (not field.joint or node.endswith(f"_{field.joint}")):
            return _Drive(row, field.row, field.index)
    return _Drive(row, _NOTHING, _NOTHING)
