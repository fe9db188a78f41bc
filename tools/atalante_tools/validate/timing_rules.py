"""When frames come, and what the alive counter says about those that do not: cycle time, gaps, timeouts, events too often.

Interval and counter are judged together, because one explains the other: a frame that is missing (counter-lost) is not late as
well, and a node that was silent beyond its timeout may begin its counter anew.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from atalante_tools.validate.e2e_rules import NO_STEPS, Steps
from atalante_tools.validate.findings import Findings
from atalante_tools.validate.plan import Plan, Rows
from atalante_tools.validate.project import Project
from atalante_tools.validate.stream import Stream

Vector = npt.NDArray[np.float64]

#: Histogram of intervals: bins a cycle, and cycles it reaches; the last bin takes what is longer.
BINS_A_CYCLE, CYCLES = 100, 4
BINS = BINS_A_CYCLE * CYCLES + 1
_NEVER = -(1 << 62)
#: Gaps kept for the plot of the report.
_MOST_GAPS = 20_000


class TimingRules:
    """Intervals and counters of all messages; remembers the last frame of each."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._plan, self._findings, self._project = plan, findings, project
        count = len(plan.layouts)
        self._cycle = plan.cycle_ns.copy()
        self._inhibit = plan.inhibit_ns * project.number("inhibit", "share")
        default = project.number("timeout", "default_cycles") * plan.cycle_ns
        self._timeout = np.where(plan.cycle_ns > 0, np.where(plan.timeout_ns > 0, plan.timeout_ns, default), 0.0)
        self._last = np.full(count, _NEVER, np.int64)  # stamp of the last frame that could be decoded
        self._arrived = np.full(count, _NEVER, np.int64)  # of the last frame at all, damaged or not
        self._first = np.full(count, _NEVER, np.int64)
        self._last_share = np.full(count, np.inf)
        self._last_steps = np.zeros(count, np.int64)
        #: Intervals without anything missing: histogram, number and sum [ns] by row.
        self.histogram = np.zeros((count, BINS), np.int64)
        self.intervals = np.zeros(count, np.int64)
        self._sum = np.zeros(count)
        #: Frames missing before a frame, for the plot: stamp, row, number.
        self.gaps: list[tuple[int, int, int]] = []

    def exclude(self, row: int) -> None:
        """Never judge this message's time: it comes from several senders."""
        self._cycle[row] = self._timeout[row] = self._inhibit[row] = 0.0

    @property
    def judged(self) -> npt.NDArray[np.bool_]:
        """Messages whose time is judged at all. Shape (rows,)."""
        judged: npt.NDArray[np.bool_] = (self._cycle > 0) | (self._inhibit > 0)
        return judged

    def seen(self, row: int) -> bool:
        """Whether any frame of the message came, damaged or not."""
        return bool(self._arrived[row] != _NEVER)

    def arrived(self, rows: Rows, stamps: npt.NDArray[np.int64]) -> None:
        """Frames that came and could not be decoded."""
        np.maximum.at(self._arrived, rows, stamps)

    def judge(self, stream: Stream, steps: Steps, explained: Steps | None) -> None:
        """Judge a chunk.

        Args:
            steps: of `e2e_rules.Counters.steps`, shape (n,).
            explained: frames before each that came and were refused, shape (n,); None: there were none.
        """
        if not len(stream):
            return
        intervals = stream.stamps - stream.before(stream.stamps, self._last)
        new = stream.starts[self._last[stream.present] == _NEVER]
        self._first[stream.rows[new]] = stream.stamps[new]
        cycle = self._cycle[stream.present]
        per_row = np.divide(1.0, cycle, out=np.zeros_like(cycle), where=cycle > 0)
        counts = stream.stops - stream.starts
        share = intervals * per_row.repeat(counts)
        share[new] = np.inf
        odd = np.flatnonzero((steps != 1) if explained is None else (steps != 1) | (explained > 0))
        silent = self._silences(stream, intervals, share, explained)
        self._judge_counters(stream, steps, explained, odd, silent)
        self._judge_cycle(stream, intervals, share, steps, explained, silent)
        self._count(stream, intervals, share, odd, silent, steps, explained)
        self._judge_events(stream, intervals, steps)
        stream.last(stream.stamps, self._last)
        stream.last(share, self._last_share)
        stream.last(steps, self._last_steps)
        self._arrived[stream.present] = np.maximum(self._arrived[stream.present], stream.stamps[stream.stops - 1])

    def _silences(
        self, stream: Stream, intervals: Steps, share: Vector, explained: Steps | None
    ) -> npt.NDArray[np.intp]:
        """Frames that came after their message had timed out."""
        timeout = self._timeout[stream.present]
        shortest = float(timeout[timeout > 0].min(initial=np.inf))
        places = np.flatnonzero(intervals > shortest)
        limit = self._timeout[stream.rows[places]]
        silent = (limit > 0) & (intervals[places] > limit) & np.isfinite(share[places])
        if explained is not None:
            silent &= explained[places] == 0
        places = places[silent]
        if len(places):
            self._findings.add_rows(
                "recovered", stream.rows[places], stream.stamps[places], shown=intervals[places] * 1e-6
            )
        return places

    def _judge_counters(
        self,
        stream: Stream,
        steps: Steps,
        explained: Steps | None,
        odd: npt.NDArray[np.intp],
        silent: npt.NDArray[np.intp],
    ) -> None:
        places = odd[steps[odd] >= NO_STEPS]
        places = np.setdiff1d(places, silent, assume_unique=True)
        if not len(places):
            return
        moved = steps[places]
        lost = moved - 1 if explained is None else moved - 1 - explained[places]
        most = self._project.number("counter-lost", "max_lost")
        rows, stamps = stream.rows[places], stream.stamps[places]
        for rule, where, shown in (
            ("counter-repeated", moved == 0, np.ones(len(moved))),
            ("counter-lost", (lost >= 1) & (lost <= most), lost),
            ("counter-sequence", (moved > 0) & (lost > most), moved),
        ):
            if bool(where.any()):
                self._findings.add_rows(rule, rows[where], stamps[where], shown=shown[where])
        missing = np.flatnonzero((lost >= 1) & (moved > 0))[: _MOST_GAPS - len(self.gaps)]
        self.gaps += zip(stamps[missing].tolist(), rows[missing].tolist(), lost[missing].tolist(), strict=True)

    def _judge_cycle(
        self,
        stream: Stream,
        intervals: Steps,
        share: Vector,
        steps: Steps,
        explained: Steps | None,
        silent: npt.NDArray[np.intp],
    ) -> None:
        limit = self._project.number("cycle-gap", "cycles")
        places = np.flatnonzero((share > limit) & np.isfinite(share))
        if len(places):
            places = np.setdiff1d(places, silent, assume_unique=True)
            missing = np.maximum(steps[places] - 1, 0)
            if explained is not None:
                missing = np.maximum(missing, explained[places])
            late = places[share[places] - missing > limit]
            if len(late):
                self._findings.add_rows(
                    "cycle-gap", stream.rows[late], stream.stamps[late], shown=intervals[late] * 1e-6
                )
        both = share + stream.before(share, self._last_share)
        fast = np.flatnonzero(both < self._project.number("cycle-fast", "cycles"))
        if len(fast):
            moved_before = stream.before(steps, self._last_steps)[fast]
            cycle = self._cycle[stream.rows[fast]]
            real = (steps[fast] != 0) & (moved_before != 0) & (cycle > 0)
            fast, cycle = fast[real], cycle[real]
            if len(fast):
                shown = both[fast] * cycle * 1e-6
                self._findings.add_rows(
                    "cycle-fast", stream.rows[fast], stream.stamps[fast], shown=shown, badness=-shown
                )

    def _count(
        self,
        stream: Stream,
        intervals: Steps,
        share: Vector,
        odd: npt.NDArray[np.intp],
        silent: npt.NDArray[np.intp],
        steps: Steps,
        explained: Steps | None,
    ) -> None:
        """Add the intervals between which nothing is missing to histogram and mean."""
        bins = np.minimum(np.maximum(share * BINS_A_CYCLE, 0.0), float(BINS - 1)).astype(np.int64)
        bins += (np.arange(len(stream.present)) * BINS).repeat(stream.stops - stream.starts)
        # A message without a counter has no steps (-1) and counts all the same, unless nothing came before it.
        incomplete = (
            odd[steps[odd] >= NO_STEPS] if explained is None else odd[(steps[odd] >= NO_STEPS) | (explained[odd] > 0)]
        )
        left_out = np.unique(np.concatenate([incomplete, silent, np.flatnonzero(np.isinf(share))]))
        dump = len(stream.present) * BINS
        sums = np.add.reduceat(intervals, stream.starts)
        numbers = stream.stops - stream.starts
        if len(left_out):
            bins[left_out] = dump
            of = np.searchsorted(stream.starts, left_out, side="right") - 1
            np.subtract.at(sums, of, intervals[left_out])
            np.subtract.at(numbers, of, 1)
        counts = np.bincount(bins, minlength=dump + 1)[:dump].reshape(-1, BINS)
        self.histogram[stream.present] += counts
        self.intervals[stream.present] += numbers
        self._sum[stream.present] += sums

    def _judge_events(self, stream: Stream, intervals: Steps, steps: Steps) -> None:
        limits = self._inhibit[stream.present]
        for at in np.flatnonzero(limits > 0).tolist():
            span = slice(int(stream.starts[at]), int(stream.stops[at]))
            soon = (intervals[span] < limits[at]) & (intervals[span] >= 0) & (steps[span] != 0)
            if self._last[stream.present[at]] == _NEVER:
                soon[0] = False
            if bool(soon.any()):
                shown = intervals[span][soon] * 1e-6
                self._findings.add_rows(
                    "inhibit", stream.rows[span][soon], stream.stamps[span][soon], shown=shown, badness=-shown
                )

    # -- the end of the log ------------------------------------------------------------------------------------------

    def finish(self, begin: int, end: int, wanted: npt.NDArray[np.bool_]) -> None:
        """What can be said about the whole log.

        Args:
            begin: first stamp of the log [ns]; `end`: the last.
            wanted: messages that should be in the log, shape (rows,).
        """
        for row in np.flatnonzero(self._cycle > 0).tolist():
            if self.seen(row):
                self._finish_seen(row, end)
            elif wanted[row] and end - begin > 2 * max(self._timeout[row], self._cycle[row]):
                self._findings.add_whole("never-seen", row, begin, end, shown=(end - begin) * 1e-6)
        for row in np.flatnonzero(self.intervals > 0).tolist():
            self._finish_statistics(row)

    def _finish_seen(self, row: int, end: int) -> None:
        silence = end - int(self._arrived[row])
        if 0 < self._timeout[row] < silence:
            self._findings.add_whole("timeout", row, int(self._arrived[row]), end, shown=silence * 1e-6)

    def _finish_statistics(self, row: int) -> None:
        cycle, count = float(self._cycle[row]), int(self.intervals[row])
        if not cycle:
            return
        first, last = int(self._first[row]), int(self._last[row])
        mean = self._sum[row] / count
        if count >= self._project.number("cycle-mean", "min_intervals"):
            tolerance = self._project.number("cycle-mean", "tolerance")
            # One long gap moves the mean and is reported as what it is; a wrong cycle moves the median as well.
            if abs(mean / cycle - 1.0) > tolerance and abs(median(self.histogram[row]) - 1.0) > 0.5 * tolerance:
                self._findings.add_whole("cycle-mean", row, first, last, shown=mean * 1e-6, count=count)
        if count >= self._project.number("cycle-jitter", "min_intervals"):
            jitter = jitter_p99(self.histogram[row])
            if jitter > self._project.number("cycle-jitter", "p99"):
                self._findings.add_whole("cycle-jitter", row, first, last, shown=jitter * cycle * 1e-6, count=count)

    def mean_ms(self, row: int) -> float:
        """Mean interval of a message [ms]."""
        return float(self._sum[row] / max(1, self.intervals[row]) * 1e-6)


def median(histogram: npt.NDArray[np.int64]) -> float:
    """Median interval, in cycles. Shape (BINS,)."""
    half = (int(histogram.sum()) + 1) // 2
    return (int(np.searchsorted(np.cumsum(histogram), half)) + 0.5) / BINS_A_CYCLE


def jitter_p99(histogram: npt.NDArray[np.int64]) -> float:
    """Distance from the median that 99 % of the intervals keep, in cycles. Shape (BINS,)."""
    total = int(histogram.sum())
    distance = np.abs(np.arange(len(histogram)) - int(median(histogram) * BINS_A_CYCLE))
    order = np.argsort(distance, kind="stable")
    reached = np.cumsum(histogram[order])
    return float(distance[order][int(np.searchsorted(reached, 0.99 * total))]) / BINS_A_CYCLE
