"""Rules for the time of frames and for lost frames: cycle time, gaps, timeouts, inhibit time, alive counter.

The intervals and the alive counters are checked together, so that a lost frame (rule counter-lost) is not also reported
as a late frame. After a timeout, a node may restart its alive counter.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from atalante_hal.types import Vector
from atalante_tools.canlog.plan import Plan, Rows
from atalante_tools.canlog.stream import Stream
from atalante_tools.canlog.validate.e2e_rules import REPEATED, Steps
from atalante_tools.canlog.validate.findings import Findings
from atalante_tools.canlog.validate.project import Project

#: An interval histogram counts the intervals between the frames of a message. `BINS_A_CYCLE` bins cover one cycle time.
#: The last bin of an interval histogram counts all intervals of at least `CYCLES` cycle times.
BINS_A_CYCLE, CYCLES = 100, 4
BINS = BINS_A_CYCLE * CYCLES + 1
_NEVER = -(1 << 62)
#: Maximum number of gaps in the alive counters that are stored for the plot in the report.
_MAX_GAPS = 20_000


class TimingRules:
    """Rules for the intervals and alive counters of all messages."""

    def __init__(self, plan: Plan, findings: Findings, project: Project) -> None:
        self._plan, self._findings, self._project = plan, findings, project
        count = len(plan.layouts)
        self._cycle = plan.cycle_ns.copy()
        self._inhibit = plan.inhibit_ns * project.number("inhibit", "share")
        self._mean_intervals = project.number("cycle-mean", "min_intervals")
        self._mean_tolerance = project.number("cycle-mean", "tolerance")
        self._jitter_intervals = project.number("cycle-jitter", "min_intervals")
        self._jitter_limit = project.number("cycle-jitter", "p99")
        default = project.number("timeout", "default_cycles") * plan.cycle_ns
        self._timeout = np.where(plan.cycle_ns > 0, np.where(plan.timeout_ns > 0, plan.timeout_ns, default), 0.0)
        self._last = np.full(count, _NEVER, np.int64)  # for each message: time stamp of the last valid frame [ns]
        #: For each message: time stamp of the last frame, which may be valid or rejected [ns].
        self._arrived = np.full(count, _NEVER, np.int64)
        #: For each message: time stamp of the first frame, which may be valid or rejected [ns].
        self._first = np.full(count, -_NEVER, np.int64)
        self._last_share = np.full(count, np.inf)
        self._last_steps = np.zeros(count, np.int64)
        #: For each message: interval histogram, the number of intervals in each bin. Shape (messages, BINS).
        #: The histogram does not count every interval. `_count` leaves out, for example, an interval with a lost frame.
        self.histogram = np.zeros((count, BINS), np.int64)
        #: For each message: number of intervals in the interval histogram. Shape (messages,).
        self.intervals = np.zeros(count, np.int64)
        self._sum = np.zeros(count)  # for each message: sum of the intervals in the interval histogram [ns]
        #: Gaps in the alive counters: (time stamp of the frame after the gap [ns], message index, number of lost frames).
        self.gaps: list[tuple[int, int, int]] = []

    def exclude(self, row: int) -> None:
        """Exclude a message from the timing rules, because several senders send this message."""
        self._cycle[row] = self._timeout[row] = self._inhibit[row] = 0.0

    @property
    def checked(self) -> npt.NDArray[np.bool_]:
        """Return the mask of the messages with a cycle time or inhibit time. Shape (messages,)."""
        checked: npt.NDArray[np.bool_] = (self._cycle > 0) | (self._inhibit > 0)
        return checked

    def seen(self, row: int) -> bool:
        """Return whether at least one valid or rejected frame of the message was received."""
        return bool(self._arrived[row] != _NEVER)

    def arrived(self, rows: Rows, stamps: npt.NDArray[np.int64]) -> None:
        """Store the arrival times of rejected frames.

        Args:
            rows: index of the message of each frame in the plan, shape (k,).
            stamps: time stamp of each frame [ns], shape (k,).
        """
        np.maximum.at(self._arrived, rows, stamps)
        np.minimum.at(self._first, rows, stamps)

    def check(self, stream: Stream, steps: Steps, rejected_before: Steps | None) -> None:
        """Check the intervals and alive counters in a chunk.

        Args:
            stream: valid frames of the chunk, sorted by message, shape (n,).
            steps: result of `e2e_rules.Counters.steps`, shape (n,).
            rejected_before: number of rejected frames between each valid frame and the previous valid frame of the same
                message, shape (n,); None if no frame was rejected.
        """
        if not len(stream):
            return
        intervals = stream.stamps - stream.before(stream.stamps, self._last)
        new = stream.starts[self._last[stream.present] == _NEVER]
        np.minimum.at(self._first, stream.rows[new], stream.stamps[new])
        cycle = self._cycle[stream.present]
        per_row = np.divide(1.0, cycle, out=np.zeros_like(cycle), where=cycle > 0)
        counts = stream.stops - stream.starts
        share = intervals * per_row.repeat(counts)
        share[new] = np.inf
        odd = np.flatnonzero((steps != 1) if rejected_before is None else (steps != 1) | (rejected_before > 0))
        timed_out = self._check_timeouts(stream, intervals, share, rejected_before)
        self._check_counters(stream, steps, rejected_before, odd, timed_out)
        self._check_cycle(stream, intervals, share, steps, rejected_before, timed_out)
        self._count(stream, intervals, share, odd, timed_out, steps, rejected_before)
        self._check_events(stream, intervals, steps)
        stream.last(stream.stamps, self._last)
        stream.last(share, self._last_share)
        stream.last(steps, self._last_steps)
        self._arrived[stream.present] = np.maximum(self._arrived[stream.present], stream.stamps[stream.stops - 1])

    def _check_timeouts(
        self, stream: Stream, intervals: Steps, share: Vector, rejected_before: Steps | None
    ) -> npt.NDArray[np.intp]:
        """Report all timeouts that have ended, and return the index of the first frame after each timeout."""
        timeout = self._timeout[stream.present]
        shortest = float(timeout[timeout > 0].min(initial=np.inf))
        indices = np.flatnonzero(intervals > shortest)
        limit = self._timeout[stream.rows[indices]]
        timed_out = (limit > 0) & (intervals[indices] > limit) & np.isfinite(share[indices])
        if rejected_before is not None:
            timed_out &= rejected_before[indices] == 0
        indices = indices[timed_out]
        if len(indices):
            self._findings.add_rows(
                "recovered", stream.rows[indices], stream.stamps[indices], shown=intervals[indices] * 1e-6
            )
        return indices

    def _check_counters(
        self,
        stream: Stream,
        steps: Steps,
        rejected_before: Steps | None,
        odd: npt.NDArray[np.intp],
        timed_out: npt.NDArray[np.intp],
    ) -> None:
        indices = odd[steps[odd] >= REPEATED]
        indices = np.setdiff1d(indices, timed_out, assume_unique=True)
        if not len(indices):
            return
        moved = steps[indices]
        lost = moved - 1 if rejected_before is None else moved - 1 - rejected_before[indices]
        most = self._project.number("counter-lost", "max_lost")
        rows, stamps = stream.rows[indices], stream.stamps[indices]
        for rule, where, shown in (
            ("counter-repeated", moved == 0, np.ones(len(moved))),
            ("counter-lost", (lost >= 1) & (lost <= most), lost),
            ("counter-sequence", (moved > 0) & (lost > most), moved),
        ):
            if bool(where.any()):
                self._findings.add_rows(rule, rows[where], stamps[where], shown=shown[where])
        missing = np.flatnonzero((lost >= 1) & (moved > 0))[: _MAX_GAPS - len(self.gaps)]
        self.gaps += zip(stamps[missing].tolist(), rows[missing].tolist(), lost[missing].tolist(), strict=True)

    def _check_cycle(
        self,
        stream: Stream,
        intervals: Steps,
        share: Vector,
        steps: Steps,
        rejected_before: Steps | None,
        timed_out: npt.NDArray[np.intp],
    ) -> None:
        limit = self._project.number("cycle-gap", "cycles")
        indices = np.flatnonzero((share > limit) & np.isfinite(share))
        if len(indices):
            indices = np.setdiff1d(indices, timed_out, assume_unique=True)
            missing = np.maximum(steps[indices] - 1, 0)
            if rejected_before is not None:
                missing = np.maximum(missing, rejected_before[indices])
            late = indices[share[indices] - missing > limit]
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
        timed_out: npt.NDArray[np.intp],
        steps: Steps,
        rejected_before: Steps | None,
    ) -> None:
        """Add the intervals in a chunk to the interval histograms, and update the number and the sum of the counted intervals.

        Timeouts and intervals with lost, repeated or rejected frames are not added.
        """
        bins = np.minimum(np.maximum(share * BINS_A_CYCLE, 0.0), float(BINS - 1)).astype(np.int64)
        bins += (np.arange(len(stream.present)) * BINS).repeat(stream.stops - stream.starts)
        # Leave out the intervals with lost or rejected frames, and the intervals that begin or end at a repeated frame.
        # Without an alive counter (`NO_STEP`), lost frames cannot be detected. So all intervals are counted.
        incomplete = (
            odd[steps[odd] >= REPEATED]
            if rejected_before is None
            else odd[(steps[odd] >= REPEATED) | (rejected_before[odd] > 0)]
        )
        after_repeated = np.flatnonzero(stream.before(steps, self._last_steps) == REPEATED)
        left_out = np.unique(np.concatenate([incomplete, timed_out, np.flatnonzero(np.isinf(share)), after_repeated]))
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

    def _check_events(self, stream: Stream, intervals: Steps, steps: Steps) -> None:
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

    # -- rules about the whole log -----------------------------------------------------------------------------------

    def finish(self, begin: int, end: int, expected: npt.NDArray[np.bool_]) -> None:
        """Apply the rules about the whole log.

        Args:
            begin: first time stamp of the log [ns].
            end: last time stamp of the log [ns].
            expected: mask of the messages that must be in the log, shape (messages,).
        """
        for row in np.flatnonzero(self._cycle > 0).tolist():
            if self.seen(row):
                self._finish_seen(row, begin, end)
            elif expected[row] and end - begin > 2 * max(self._timeout[row], self._cycle[row]):
                self._findings.add_whole("never-seen", row, begin, end, shown=(end - begin) * 1e-6)
        for row in np.flatnonzero(self.intervals > 0).tolist():
            self._finish_statistics(row)

    def _finish_seen(self, row: int, begin: int, end: int) -> None:
        first, silence = int(self._first[row]), end - int(self._arrived[row])
        if 0 < self._timeout[row] < first - begin:
            self._findings.add_whole("late-start", row, begin, first, shown=(first - begin) * 1e-6)
        if 0 < self._timeout[row] < silence:
            self._findings.add_whole("timeout", row, int(self._arrived[row]), end, shown=silence * 1e-6)

    def _finish_statistics(self, row: int) -> None:
        cycle, count = float(self._cycle[row]), int(self.intervals[row])
        if not cycle:
            return
        first, last = int(self._first[row]), int(self._last[row])
        mean = self._sum[row] / count
        # Report a wrong cycle time only if the mean and the median of the intervals both differ from the cycle time.
        # A single long gap changes only the mean of the intervals. The rule cycle-gap reports such a gap.
        if (
            count >= self._mean_intervals
            and abs(mean / cycle - 1.0) > self._mean_tolerance
            and abs(median(self.histogram[row]) - 1.0) > 0.5 * self._mean_tolerance
        ):
            self._findings.add_whole("cycle-mean", row, first, last, shown=mean * 1e-6, count=count)
        if count >= self._jitter_intervals:
            jitter = jitter_p99(self.histogram[row])
            if jitter > self._jitter_limit:
                self._findings.add_whole("cycle-jitter", row, first, last, shown=jitter * cycle * 1e-6, count=count)

    def mean_ms(self, row: int) -> float:
        """Return the mean of all intervals in the interval histogram of a message [ms]."""
        return float(self._sum[row] / max(1, self.intervals[row]) * 1e-6)


def median(histogram: npt.NDArray[np.int64]) -> float:
    """Return the median of the intervals in an interval histogram of shape (BINS,), divided by the cycle time."""
    half = (int(histogram.sum()) + 1) // 2
    return (int(np.searchsorted(np.cumsum(histogram), half)) + 0.5) / BINS_A_CYCLE


def jitter_p99(histogram: npt.NDArray[np.int64]) -> float:
    """Return the jitter: the 99th percentile of the deviation of the intervals from the median interval.

    The deviation is an absolute value, divided by the cycle time. For example, 0.25 means a quarter of the cycle time.
    """
    total = int(histogram.sum())
    distance, order = _by_distance(len(histogram), int(median(histogram) * BINS_A_CYCLE))
    reached = np.cumsum(histogram[order])
    return float(distance[order[int(np.searchsorted(reached, 0.99 * total))]]) / BINS_A_CYCLE


@lru_cache(maxsize=64)  # cached, because most messages have the same median interval
def _by_distance(bins: int, middle: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.intp]]:
    """Return the distance of each bin to the bin `middle`, and the bin indices sorted by this distance. Shape (bins,)."""
    distance = np.abs(np.arange(bins) - middle)
    return distance, np.argsort(distance, kind="stable")
