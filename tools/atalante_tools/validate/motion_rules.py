"""Plausibility: does the velocity fit the position, has a quaternion length 1, does a value jump, or stand still entirely?

Signals are found by their names (`codec.group_of`); a project's rules file may name others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from atalante_hal.codec import group_of
from atalante_tools.validate.e2e_rules import NO_STEPS, Steps
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import Family, Plan
from atalante_tools.validate.project import Project
from atalante_tools.validate.stream import Stream
from atalante_tools.validate.value_rules import Decoded

Vector = npt.NDArray[np.float64]
_ELEMENTS = 4  # of a quaternion


class MotionRules:
    """Plausibility of the values of all families."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
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

    def judge(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        """Judge the frames of a family. `steps` of the whole stream, shape (n,)."""
        for rule in self._families[decoded.family.rows.start]:
            rule.judge(decoded, stream, steps)

    def finish(self, end: int) -> None:
        """The log is over at `end` [ns]."""
        for rules in self._families.values():
            for rule in rules:
                if isinstance(rule, _Stuck):
                    rule.finish(end)

    def judged(self, family: Family) -> dict[str, list[str]]:
        """Rule -> signals of the family that it looks at."""
        return {
            rule.id: [family.codec.fields[p].name for p in rule.places] for rule in self._families[family.rows.start]
        }


class _Velocity:
    """Mean velocity over a window against the change of position in it; the lag of the velocity's filter is allowed for."""

    id = "velocity"

    def __init__(self, places: Sequence[int], findings: Findings, project: Project) -> None:
        self.places = places
        self._findings = findings
        number = project.number
        self._window = max(2, int(number(self.id, "window")))
        self._lag, self._relative = number(self.id, "lag_s"), number(self.id, "relative")
        self._absolute = number(self.id, "absolute")
        self._left: dict[int, tuple[npt.NDArray[np.int64], Vector, Vector, npt.NDArray[np.bool_]]] = {}

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Velocity | None:
        names = [project.text(cls.id, "position"), project.text(cls.id, "velocity")]
        places = [p for name in names for p, f in enumerate(family.codec.fields) if f.name == name]
        return cls(places, findings, project) if len(places) == len(names) else None

    def judge(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        fields = [decoded.family.codec.fields[p] for p in self.places]
        position, velocity = (
            decoded.codes[p] * float(f.factor) + float(f.offset) for p, f in zip(self.places, fields, strict=True)
        )
        good = steps[decoded.span] <= 1
        for place in self.places:
            if place in decoded.bad:
                good &= ~decoded.bad[place]
        stamps = stream.stamps[decoded.span]
        for row, first, behind in stream.bounds(decoded.family):
            part = slice(first, behind)
            self._judge_row(row, stamps[part], position[part], velocity[part], good[part])

    def _judge_row(
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
        # The velocity of a frame says how it moved since the one before: the window's first frame belongs to the last window.
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
    """Length of each quaternion."""

    id = "quaternion-norm"

    def __init__(self, places: Sequence[int], findings: Findings, project: Project) -> None:
        self.places = places
        self._findings = findings
        self._tolerance = project.number(self.id, "tolerance")

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Quaternion | None:
        wanted = project.text(cls.id, "group")
        places = [p for p, f in enumerate(family.codec.fields) if group_of(f.name) == wanted and f.kind != "float"]
        return cls(places, findings, project) if len(places) == _ELEMENTS else None

    def judge(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        squares: Vector = np.zeros(decoded.raw.shape[1])
        for place in self.places:
            element = decoded.codes[place] * float(decoded.family.codec.fields[place].factor)
            element *= element
            squares += element
        low, high = max(0.0, 1.0 - self._tolerance) ** 2, (1.0 + self._tolerance) ** 2
        if float(squares.min()) >= low and float(squares.max()) <= high:
            return
        wrong = (squares < low) | (squares > high)
        for place in self.places:
            if place in decoded.bad:
                wrong &= ~decoded.bad[place]
        if bool(wrong.any()):
            norm = np.sqrt(squares[wrong])
            rows, stamps = stream.rows[decoded.span][wrong], stream.stamps[decoded.span][wrong]
            self._findings.add_rows(self.id, rows, stamps, shown=norm, badness=np.abs(norm - 1.0))


class _Columns:
    """Columns of a family beside the same columns one frame earlier, over the boundaries of messages and chunks."""

    def __init__(self, family: Family, places: Sequence[int]) -> None:
        self._places = np.array(places, np.intp)
        self._last = np.zeros((len(places), len(family.rows)), np.int64)
        self._seen = np.zeros(len(family.rows), np.bool_)
        self._first_row = family.rows.start

    def with_before(
        self, decoded: Decoded, stream: Stream
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], list[int]]:
        """The codes, those of the frame before, shape (fields, n) each, and the frames that have none before them."""
        codes = decoded.codes[self._places]
        before = np.empty_like(codes)
        before[:, 1:] = codes[:, :-1]
        new = []
        for row, first, behind in stream.bounds(decoded.family):
            number = row - self._first_row
            if self._seen[number]:
                before[:, first] = self._last[:, number]
            else:
                before[:, first] = codes[:, first]
                new.append(first)
            self._last[:, number] = codes[:, behind - 1]
            self._seen[number] = True
        return codes, before, new


class _Steps:
    """Values that move slowly, and then jump."""

    id = "step"

    def __init__(self, family: Family, limits: dict[int, float], findings: Findings) -> None:
        self.places = list(limits)
        self._findings = findings
        self._columns = _Columns(family, self.places)
        fields = [family.codec.fields[p] for p in self.places]
        self._limits = np.array([limit / abs(f.factor) for limit, f in zip(limits.values(), fields, strict=True)])
        self._first_row = family.rows.start
        #: Whether the last value was found wrong, by (field, row): then the next one may jump back.
        self._was_bad = np.zeros((len(self.places), len(family.rows)), np.bool_)

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Steps | None:
        known = project.quantities(cls.id)
        limits = {
            p: known[group_of(f.name)]
            for p, f in enumerate(family.codec.fields)
            if group_of(f.name) in known and f.kind != "float" and f.length < 64 and f.factor and not f.selectors
        }
        return cls(family, limits, findings) if limits else None

    def judge(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        codes, before, _ = self._columns.with_before(decoded, stream)
        moved = np.abs(codes - before)
        for row, first, behind in stream.bounds(decoded.family):
            moved[self._was_bad[:, row - self._first_row], first] = 0
            for at, place in enumerate(self.places):
                bad = decoded.bad.get(place)
                self._was_bad[at, row - self._first_row] = bad is not None and bool(bad[behind - 1])
        for at in np.flatnonzero(moved.max(axis=1) > self._limits).tolist():
            self._judge_column(decoded, stream, steps, at, moved[at])

    def _judge_column(
        self, decoded: Decoded, stream: Stream, steps: Steps, at: int, moved: npt.NDArray[np.int64]
    ) -> None:
        """Nothing is said about the frame behind a gap, nor about a value found wrong and the one that follows it."""
        place = self.places[at]
        wrong = (moved > self._limits[at]) & (steps[decoded.span] <= 1)
        if (bad := decoded.bad.get(place)) is not None:
            wrong &= ~bad
            wrong[1:] &= ~bad[:-1]
        if bool(wrong.any()):
            limits = decoded.family.codec.fields[place]
            self._findings.add_rows(
                self.id,
                stream.rows[decoded.span][wrong],
                stream.stamps[decoded.span][wrong],
                signal=limits.name,
                shown=moved[wrong] * abs(float(limits.factor)),
                unit=limits.unit,
            )


class _Stuck:
    """Measured values have noise: one that is the same to the last bit for long is not measured any more."""

    id = "stuck"

    def __init__(self, family: Family, places: Sequence[int], findings: Findings, frames: int) -> None:
        self.places = list(places)
        self._family, self._findings, self._frames = family, findings, frames
        self._columns = _Columns(family, places)
        #: Frames in a row without a change so far, by (field, row); and the last stamp.
        self._run = np.zeros((len(self.places), len(family.rows)), np.int64)
        self._stamp = np.zeros(len(family.rows), np.int64)

    @classmethod
    def of(cls, family: Family, findings: Findings, project: Project) -> _Stuck | None:
        groups = project.names(cls.id, "groups")
        places = [p for p, f in enumerate(family.codec.fields) if group_of(f.name) in groups and not f.selectors]
        return cls(family, places, findings, int(project.number(cls.id, "frames"))) if places else None

    def judge(self, decoded: Decoded, stream: Stream, steps: Steps) -> None:
        codes, before, _ = self._columns.with_before(decoded, stream)
        repeated = steps[decoded.span] == NO_STEPS  # a repeated frame says nothing new
        still = codes == before
        for row, first, behind in stream.bounds(decoded.family):
            number = row - self._family.rows.start
            stamps = stream.stamps[decoded.span][first:behind]
            fresh = np.flatnonzero(~repeated[first:behind]) if bool(repeated[first:behind].any()) else None
            for at in range(len(self.places)):
                part = still[at, first:behind]
                self._judge_column(at, number, part if fresh is None else part[fresh], stamps)
            self._stamp[number] = stamps[-1]

    def _judge_column(self, at: int, number: int, still: npt.NDArray[np.bool_], stamps: npt.NDArray[np.int64]) -> None:
        moves = np.flatnonzero(~still)
        if not len(moves):
            self._run[at, number] += len(still)
            return
        runs = np.diff(moves, prepend=-1 - int(self._run[at, number])) - 1
        long = runs >= self._frames
        if bool(long.any()):
            self._report(at, number, stamps[np.minimum(moves[long], len(stamps) - 1)], runs[long])
        self._run[at, number] = len(still) - 1 - int(moves[-1])

    def finish(self, end: int) -> None:
        """Values that were still not moving when the log ended."""
        for at, number in np.argwhere(self._run >= self._frames).tolist():
            stamp = min(end, int(self._stamp[number]))
            self._report(at, number, np.array([stamp], np.int64), self._run[at, number : number + 1])

    def _report(self, at: int, number: int, stamps: npt.NDArray[np.int64], runs: npt.NDArray[np.int64]) -> None:
        self._findings.add_rows(
            self.id,
            np.full(len(stamps), self._family.rows.start + number),
            stamps,
            signal=self._family.codec.fields[self.places[at]].name,
            shown=runs,
        )
