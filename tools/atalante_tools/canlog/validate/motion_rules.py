"""Plausibility rules for signals: velocity, quaternion norm, change of slow values, and measured values without noise.

The velocity is compared with the change of the position. The signals are selected by name (`codec.group_of`). The rules
file of a project may set other names.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_hal.types import Vector
from atalante_hal.wire.codec import group_of
from atalante_tools.canlog.plan import Family, Plan
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.e2e_rules import REPEATED, Steps
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project
from atalante_tools.canlog.validate.value_rules import Decoded

_ELEMENTS = 4  # elements of a quaternion


class MotionRules:
    """Plausibility rules, applied to the signals of all messages."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._plan = plan
        self._families = {
            family.rows.start: [
                rule
                for rule in (
                    _Velocity.of(family, findings, project),
                    _Quaternion.of(family, findings, project),
                    _Steps.of(family, findings, project),
                    _Stuck.of(family, findings, project),
                )
                if rule is not None
            ]
            for family in plan.families
        }

    def check(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        """Check the frames of a message family.

        Args:
            decoded: decoded frames of the message family.
            stream: frames of the chunk, sorted by message, shape (n,).
            steps: increment of the alive counter at each frame of the stream, shape (n,).
        """
        for rule in self._families[decoded.family.rows.start]:
            rule.check(decoded, stream, steps)

    def finish(self, end: int) -> None:
        """Report the values that are stuck at the end of the log.

        Args:
            end: last time stamp of the log [ns].
        """
        for rules in self._families.values():
            for rule in rules:
                if isinstance(rule, _Stuck):
                    rule.finish(end)

    def checked(self, family: Family) -> dict[str, list[str]]:
        """Return the names of the checked signals in a message family, by rule identifier."""
        return {
            rule.id: [family.codec.fields[p].name for p in rule.indices] for rule in self._families[family.rows.start]
        }

    def too_short(self, counts: npt.NDArray[np.int64]) -> dict[tuple[str, int], list[int]]:
        """Return the messages with too few frames for a rule.

        Args:
            counts: number of frames of each message in the log, shape (messages,).

        Returns:
            For each rule and the number of frames that it requires: the indices of the messages in the plan.
        """
        found: dict[tuple[str, int], list[int]] = {}
        for family in self._plan.families:
            for rule in self._families[family.rows.start]:
                if isinstance(rule, (_Velocity, _Stuck)):
                    rows = [row for row in family.rows if 0 < counts[row] < rule.required]
                    found.setdefault((rule.id, rule.required), []).extend(rows)
        return {key: rows for key, rows in found.items() if rows}


class _Velocity:
    """Rule that compares the velocity signal with the change of the position signal.

    In a window of frames, the mean velocity must equal the change of the position, divided by the duration of the window.
    The tolerance allows for the lag of the velocity filter in the drive.
    """

    id = "velocity"

    def __init__(self, indices: Sequence[int], findings: Findings, project: Project) -> None:
        self.indices = indices
        self._findings = findings
        number = project.number
        self._window = max(2, int(number(self.id, "window")))
        self.required = self._window + 1  # smallest number of frames of a message that the rule can check
        self._lag, self._relative = number(self.id, "lag_s"), number(self.id, "relative")
        self._absolute = number(self.id, "absolute")
        self._left: dict[int, tuple[npt.NDArray[np.int64], Vector, Vector, npt.NDArray[np.bool_]]] = {}

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Velocity | None:
        names = [project.text(cls.id, "position"), project.text(cls.id, "velocity")]
        indices = [p for name in names for p, f in enumerate(family.codec.fields) if f.name == name]
        return cls(indices, findings, project) if len(indices) == len(names) else None

    def check(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        fields = [decoded.family.codec.fields[p] for p in self.indices]
        position, velocity = (
            decoded.codes[p] * float(f.factor) + float(f.offset) for p, f in zip(self.indices, fields, strict=True)
        )
        good = steps[decoded.span] <= 1
        for index in self.indices:
            if index in decoded.bad:
                good &= ~decoded.bad[index]
        stamps = stream.stamps[decoded.span]
        for row, first, end in stream.bounds(decoded.family):
            part = slice(first, end)
            self._check_row(row, stamps[part], position[part], velocity[part], good[part])

    def _check_row(
        self, row: int, stamps: npt.NDArray[np.int64], position: Vector, velocity: Vector, good: npt.NDArray[np.bool_]
    ) -> None:
        if row in self._left:
            before = self._left[row]
            stamps, position = np.concatenate([before[0], stamps]), np.concatenate([before[1], position])
            velocity, good = np.concatenate([before[2], velocity]), np.concatenate([before[3], good])
        width = self._window
        windows = (len(stamps) - 1) // width
        whole = windows * width
        self._left[row] = tuple(column[whole:].copy() for column in (stamps, position, velocity, good))  # type: ignore[assignment]
        if not windows:
            return
        ends = np.arange(windows + 1) * width
        duration = np.diff(stamps[ends]) * 1e-9
        # The velocity in the first frame of a window describes the motion before the window, so the mean omits this frame.
        inside = velocity[1 : whole + 1].reshape(windows, width)
        mean = inside.mean(axis=1)
        moved = np.diff(position[ends]) / np.where(duration > 0, duration, np.inf)
        lag = self._lag * np.abs(np.diff(velocity[ends])) / np.where(duration > 0, duration, np.inf)
        wrong = np.abs(moved - mean) > self._absolute + lag + self._relative * np.abs(inside).mean(axis=1)
        wrong &= good[1 : whole + 1].reshape(windows, width).all(axis=1) & (duration > 0)
        if bool(wrong.any()):
            at = np.flatnonzero(wrong)
            self._findings.add_rows(self.id, np.full(len(at), row), stamps[ends[at]], shown=np.abs(moved - mean)[at])


class _Quaternion:
    """Rule that checks whether the norm of each quaternion is 1."""

    id = "quaternion-norm"

    def __init__(self, indices: Sequence[int], findings: Findings, project: Project) -> None:
        self.indices = indices
        self._findings = findings
        self._tolerance = project.number(self.id, "tolerance")

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Quaternion | None:
        wanted = project.text(cls.id, "group")
        indices = [p for p, f in enumerate(family.codec.fields) if group_of(f.name) == wanted and f.kind != "float"]
        return cls(indices, findings, project) if len(indices) == _ELEMENTS else None

    def check(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        squares: Vector = np.zeros(decoded.raw.shape[1])
        for index in self.indices:
            element = decoded.codes[index] * float(decoded.family.codec.fields[index].factor)
            element *= element
            squares += element
        low, high = max(0.0, 1.0 - self._tolerance) ** 2, (1.0 + self._tolerance) ** 2
        if float(squares.min()) >= low and float(squares.max()) <= high:
            return
        wrong = (squares < low) | (squares > high)
        for index in self.indices:
            if index in decoded.bad:
                wrong &= ~decoded.bad[index]
        if bool(wrong.any()):
            norm = np.sqrt(squares[wrong])
            rows, stamps = stream.rows[decoded.span][wrong], stream.stamps[decoded.span][wrong]
            self._findings.add_rows(self.id, rows, stamps, shown=norm, badness=np.abs(norm - 1.0))


class _Columns:
    """Memory of the last raw codes, so that each frame can be compared with the previous frame of the same message."""

    def __init__(self, family: Family, indices: Sequence[int]) -> None:
        self._indices = np.array(indices, np.intp)
        self._last = np.zeros((len(indices), len(family.rows)), np.int64)
        self._seen = np.zeros(len(family.rows), np.bool_)
        self._first_row = family.rows.start

    def with_before(
        self, decoded: Decoded, stream: Stream
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], list[int]]:
        """Return the raw codes of each frame, and of the previous frame of the same message.

        The previous frame may be in an earlier chunk.

        Returns:
            The codes of each frame, shape (fields, n); the codes of its previous frame, shape (fields, n); the indices of
            the frames without a previous frame.
        """
        codes = decoded.codes[self._indices]
        before = np.empty_like(codes)
        before[:, 1:] = codes[:, :-1]
        new = []
        for row, first, end in stream.bounds(decoded.family):
            number = row - self._first_row
            if self._seen[number]:
                before[:, first] = self._last[:, number]
            else:
                before[:, first] = codes[:, first]
                new.append(first)
            self._last[:, number] = codes[:, end - 1]
            self._seen[number] = True
        return codes, before, new


class _Steps:
    """Rule that limits how much a slowly varying value may change from one frame to the next."""

    id = "step"

    def __init__(self, family: Family, limits: dict[int, float], findings: Findings) -> None:
        self.indices = list(limits)
        self._findings = findings
        self._columns = _Columns(family, self.indices)
        fields = [family.codec.fields[p] for p in self.indices]
        self._limits = np.array([limit / abs(f.factor) for limit, f in zip(limits.values(), fields, strict=True)])
        self._first_row = family.rows.start
        #: True if the last frame of a message had an invalid value in a field, shape (fields, messages).
        #: The change from an invalid value to the value in the next frame is not checked.
        self._was_bad = np.zeros((len(self.indices), len(family.rows)), np.bool_)

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Steps | None:
        known = project.quantities(cls.id)
        limits = {
            p: known[group_of(f.name)]
            for p, f in enumerate(family.codec.fields)
            if group_of(f.name) in known and f.kind != "float" and f.length < 64 and f.factor and not f.selectors
        }
        return cls(family, limits, findings) if limits else None

    def check(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        codes, before, _ = self._columns.with_before(decoded, stream)
        moved = np.abs(codes - before)
        for row, first, end in stream.bounds(decoded.family):
            moved[self._was_bad[:, row - self._first_row], first] = 0
            for at, index in enumerate(self.indices):
                bad = decoded.bad.get(index)
                self._was_bad[at, row - self._first_row] = bad is not None and bool(bad[end - 1])
        for at in np.flatnonzero(moved.max(axis=1) > self._limits).tolist():
            self._check_column(decoded, stream, steps, at, moved[at])

    def _check_column(
        self, decoded: Decoded, stream: Stream, steps: Steps, at: int, moved: npt.NDArray[np.int64]
    ) -> None:
        """Check the changes of one field.

        The change from one frame to the next is not checked if frames between them were lost, or if one of the two
        values is invalid.
        """
        index = self.indices[at]
        wrong = (moved > self._limits[at]) & (steps[decoded.span] <= 1)
        if (bad := decoded.bad.get(index)) is not None:
            wrong &= ~bad
            wrong[1:] &= ~bad[:-1]
        if bool(wrong.any()):
            limits = decoded.family.codec.fields[index]
            self._findings.add_rows(
                self.id,
                stream.rows[decoded.span][wrong],
                stream.stamps[decoded.span][wrong],
                signal=limits.name,
                shown=moved[wrong] * abs(float(limits.factor)),
                unit=limits.unit,
            )


class _Stuck:
    """Rule that reports a measured value as stuck if its raw code stays constant. A healthy sensor has noise."""

    id = "stuck"

    def __init__(self, family: Family, indices: Sequence[int], findings: Findings, frames: int) -> None:
        self.indices = list(indices)
        self._family, self._findings, self._frames = family, findings, frames
        self.required = frames  # smallest number of frames of a message that the rule can check
        self._columns = _Columns(family, indices)
        #: Number of consecutive frames with an unchanged raw code, shape (fields, messages).
        self._run = np.zeros((len(self.indices), len(family.rows)), np.int64)
        #: Time stamp of the last frame of each message [ns], shape (messages,).
        self._stamp = np.zeros(len(family.rows), np.int64)

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Stuck | None:
        groups = project.names(cls.id, "groups")
        indices = [p for p, f in enumerate(family.codec.fields) if group_of(f.name) in groups and not f.selectors]
        return cls(family, indices, findings, int(project.number(cls.id, "frames"))) if indices else None

    def check(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        codes, before, _ = self._columns.with_before(decoded, stream)
        repeated = steps[decoded.span] == REPEATED  # a repeated frame contains no new value
        still = codes == before
        for row, first, end in stream.bounds(decoded.family):
            number = row - self._family.rows.start
            stamps = stream.stamps[decoded.span][first:end]
            fresh = slice(None) if not bool(repeated[first:end].any()) else ~repeated[first:end]
            for at in range(len(self.indices)):
                self._check_column(at, number, still[at, first:end][fresh], stamps[fresh])
            self._stamp[number] = stamps[-1]

    def _check_column(self, at: int, number: int, still: npt.NDArray[np.bool_], stamps: npt.NDArray[np.int64]) -> None:
        moves = np.flatnonzero(~still)
        if not len(moves):
            self._run[at, number] += len(still)
            return
        runs = moves.copy()
        runs[1:] -= moves[:-1] + 1
        runs[0] += int(self._run[at, number])
        long = runs >= self._frames
        if bool(long.any()):
            self._report(at, number, stamps[moves[long]], runs[long])
        self._run[at, number] = len(still) - 1 - int(moves[-1])

    def finish(self, end: int) -> None:
        """Report the values that are stuck at the end of the log.

        Args:
            end: last time stamp of the log [ns].
        """
        for at, number in np.argwhere(self._run >= self._frames).tolist():
            stamp = min(end, int(self._stamp[number]))
            self._report(at, number, np.array([stamp], np.int64), self._run[at, number : number + 1])

    def _report(self, at: int, number: int, stamps: npt.NDArray[np.int64], runs: npt.NDArray[np.int64]) -> None:
        self._findings.add_rows(
            self.id,
            np.full(len(stamps), self._family.rows.start + number),
            stamps,
            signal=self._family.codec.fields[self.indices[at]].name,
            shown=runs,
        )
