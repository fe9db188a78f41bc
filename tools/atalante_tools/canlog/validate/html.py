"""Report as one HTML file with tables and inline SVG plots. The file loads nothing from the network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
import numpy.typing as npt

from atalante_hal.types import Vector
from atalante_tools.canlog.validate.report import Report, Unread, verdict
from atalante_tools.canlog.validate.rules import RULES
from atalante_tools.canlog.validate.timing_rules import BINS, BINS_A_CYCLE
from atalante_tools.console.html import html_table, page

_WIDTH, _HEIGHT = 760, 200
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 28, 24, 36
_LETTER = 7.0  # width of a character in the legend [px]
_COLOURS = ("#1b6ca8", "#c8553d", "#4f772d", "#7b4b94", "#b08900", "#3d5a6c", "#8d5524", "#555555")
_POINTS = 720  # maximum number of points in a plotted curve, about one point per pixel of the plot width
_HISTOGRAMS = 12  # maximum number of interval histograms in the report of a log
_TIMING = ("cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered", "late-start", "state-late")


def write_html(results: Sequence[Report | Unread], path: Path) -> None:
    """Write the reports of all logs into one HTML file. For a log that was not read, write only the reason."""
    parts = [part for result in results for part in (_unread(result) if isinstance(result, Unread) else _log(result))]
    parts += ["<h2>Rules</h2>", _rules()]
    path.write_text(page("atalante validate", "CAN log against DBC", parts), encoding="utf-8")


def _log(result: Report) -> list[str]:
    validator, kind = result.validator, "bad" if result.findings or not result.validator.frames else "good"
    catalogue = validator.plan.catalogue
    parts = [
        f"<h2>{escape(result.name)}</h2><p>{validator.frames} frames in {result.duration_s:.3f} s on "
        f"{escape(', '.join(validator.channels) or 'no channel')}; DBC {escape(str(catalogue.path))}, "
        f"hash {catalogue.hash32:08X}. <span class='{kind}'>{escape(verdict(result))}</span></p>"
    ]
    if result.findings:
        head = ("Rule", "Message", "Signal", "Node", "Count", "First [s]", "Last [s]", "Worst")
        rows = [
            (f.rule, f.message, f.signal, f.node, f.count, f"{f.first_s:.6f}", f"{f.last_s:.6f}", f.worst)
            for f in result.findings
        ]
        parts += ["<h3>Findings</h3>", html_table(head, rows)]
    if result.silenced:
        rows_silenced = [(f.rule, f.message, f.signal, f.count, s.reason) for f, s in result.silenced]
        parts += ["<h3>Silenced</h3>", html_table(("Rule", "Message", "Signal", "Count", "Reason"), rows_silenced)]
    if result.unchecked:
        rows_unchecked = [
            (", ".join(u.rules) or "all", u.reason, len(u.items) or "-", ", ".join(u.items)) for u in result.unchecked
        ]
        parts += ["<h3>Not checked</h3>", html_table(("Rules", "Reason", "Count", "Items"), rows_unchecked)]
    if validator.frames:
        parts += ["<h3>Load of each bus over time</h3>", _load_plot(result)]
        parts += ["<h3>Counter gaps over time</h3>", _gap_plot(result)]
        parts += ["<h3>Cycle times</h3>", *_histograms(result)]
    return parts


def _unread(log: Unread) -> list[str]:
    return [f"<h2>{escape(log.name)}</h2><p><span class='bad'>{escape(log.reason)}</span></p>"]


def _rules() -> str:
    rows = [
        (r.id, r.meaning, r.source, ", ".join(f"{name} = {value}" for name, value in r.thresholds.items()))
        for r in RULES
    ]
    return html_table(("Rule", "Meaning", "Source", "Thresholds"), rows)


# -- plots -----------------------------------------------------------------------------------------------------------------


class _Axes:
    """Plot area. It converts data coordinates to pixels, and draws axes, labels and curves."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float], x_label: str, y_label: str) -> None:
        self._x, self._y = x, (y[0], y[1] if y[1] > y[0] else y[0] + 1.0)
        self._labels = x_label, y_label
        self._shapes: list[str] = []

    def at(self, x: float, y: float) -> str:
        """Return the pixel coordinates of a point as `x,y`."""
        span = (self._x[1] - self._x[0]) or 1.0
        across = _LEFT + (x - self._x[0]) / span * (_WIDTH - _LEFT - _RIGHT)
        up = _HEIGHT - _BOTTOM - (y - self._y[0]) / (self._y[1] - self._y[0]) * (_HEIGHT - _TOP - _BOTTOM)
        return f"{across:.1f},{up:.1f}"

    def line(self, x: Vector, y: Vector, colour: str, name: str) -> None:
        points = " ".join(self.at(a, b) for a, b in zip(x.tolist(), y.tolist(), strict=True))
        self._shapes.append(
            f"<polyline points='{points}' fill='none' stroke='{colour}' stroke-width='1.2'>"
            f"<title>{escape(name)}</title></polyline>"
        )

    def dot(self, x: float, y: float, colour: str, name: str) -> None:
        across, up = self.at(x, y).split(",")
        self._shapes.append(
            f"<circle cx='{across}' cy='{up}' r='2.4' fill='{colour}'><title>{escape(name)}</title></circle>"
        )

    def bar(self, x: float, width: float, y: float, colour: str) -> None:
        left, top = (float(c) for c in self.at(x, y).split(","))
        right, bottom = (float(c) for c in self.at(x + width, self._y[0]).split(","))
        self._shapes.append(
            f"<rect x='{left:.1f}' y='{top:.1f}' width='{max(right - left, 0.8):.1f}' height='{bottom - top:.1f}' "
            f"fill='{colour}'/>"
        )

    def mark(self, x: float, name: str) -> None:
        top, bottom = self.at(x, self._y[1]), self.at(x, self._y[0])
        (x1, y1), (x2, y2) = top.split(","), bottom.split(",")
        self._shapes.append(
            f"<line x1='{x1}' y1='{y1}' x2='{x2}' y2='{y2}' stroke='#888' stroke-dasharray='3 3'/>"
            f"<text x='{float(x1) + 3:.1f}' y='{float(y1) + 9:.1f}'>{escape(name)}</text>"
        )

    def legend(self, names: Sequence[str]) -> None:
        """Draw the legend. If the plot is too narrow for all names, an ellipsis replaces the last names."""
        across = float(_LEFT)
        for number, name in enumerate(names):
            width = 26 + _LETTER * len(name)
            if across + width > _WIDTH - 2 * _LETTER:
                self._shapes.append(f"<text x='{across:.0f}' y='11'>...</text>")
                return
            colour = _COLOURS[number % len(_COLOURS)]
            self._shapes.append(
                f"<rect x='{across:.0f}' y='2' width='9' height='9' fill='{colour}'/>"
                f"<text x='{across + 13:.0f}' y='11'>{escape(name)}</text>"
            )
            across += width

    def svg(self) -> str:
        (x0, y0), (x1, y1) = (self.at(self._x[0], self._y[0]).split(","), self.at(self._x[1], self._y[1]).split(","))
        parts = [
            f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' width='{_WIDTH}' height='{_HEIGHT}' role='img' font-size='11'>"
        ]
        parts.append(f"<path d='M{x0},{y1} L{x0},{y0} L{x1},{y0}' fill='none' stroke='#888'/>")
        for value in _ticks(*self._y, 4):
            across, up = self.at(self._x[0], value).split(",")
            parts.append(
                f"<text x='{float(across) - 6:.1f}' y='{float(up) + 4:.1f}' text-anchor='end'>{value:g}</text>"
            )
        for value in _ticks(*self._x, 8):
            across, up = self.at(value, self._y[0]).split(",")
            parts.append(f"<text x='{across}' y='{float(up) + 14:.1f}' text-anchor='middle'>{value:g}</text>")
        parts.append(
            f"<text x='{_WIDTH - _RIGHT}' y='{_HEIGHT - 4}' text-anchor='end'>{escape(self._labels[0])}</text>"
        )
        parts.append(f"<text x='4' y='{_HEIGHT - 4}'>{escape(self._labels[1])}</text>")
        return "".join([*parts, *self._shapes, "</svg>"])


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Return the values of about `most` axis ticks from `low` to `high`. Their spacing is 1, 2 or 5 times a power of ten."""
    rough = (high - low) / most or 1.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * unit for unit in (1.0, 2.0, 5.0, 10.0) if power * unit >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [round(number * step, 12) for number in range(first, math.floor(high / step + 1e-9) + 1)]


def _load_plot(result: Report) -> str:
    load, begins = result.validator.load.load, result.validator.load.begins
    if len(begins) < 3:
        return "<p class='small'>The log is too short for a plot of the load, or the DBC has no bit rate.</p>"
    load, begins = 100.0 * load[1:-1], begins[1:-1] - (result.validator.begin or 0) * 1e-9
    names = result.validator.load.names(result.validator.channels)
    used = [bus for bus in range(load.shape[1]) if load[:, bus].any()]
    axes = _Axes(
        (float(begins[0]), float(begins[-1])), (0.0, max(60.0, 1.1 * float(load.max()))), "time [s]", "load [%]"
    )
    for number, bus in enumerate(used):
        x, y = _thinned(begins, load[:, bus])
        axes.line(x, y, _COLOURS[number % len(_COLOURS)], names[bus])
    axes.legend([names[bus] or "bus" for bus in used])
    return axes.svg()


def _thinned(x: Vector, y: Vector) -> tuple[Vector, Vector]:
    """Reduce a curve to at most `_POINTS` points.

    The curve is divided into sections of consecutive points. Each section becomes one point: the first x and the largest y.
    """
    step = math.ceil(len(x) / _POINTS)
    if step == 1:
        return x, y
    starts = np.arange(0, len(x), step)
    return x[starts], np.maximum.reduceat(y, starts)


def _gap_plot(result: Report) -> str:
    gaps = result.validator.timing.gaps
    if not gaps:
        return "<p class='small'>No alive counter has a gap.</p>"
    begin = (result.validator.begin or 0) * 1e-9
    rows = sorted({row for _, row, _ in gaps})
    largest = max(lost for _, _, lost in gaps)
    axes = _Axes((0.0, result.duration_s or 1.0), (0.0, 1.1 * largest), "time [s]", "frames missing")
    for stamp, row, lost in gaps[:: max(1, len(gaps) // 4000)]:
        name = result.validator.plan.name(row)
        at = stamp * 1e-9 - begin
        axes.dot(at, float(lost), _COLOURS[rows.index(row) % len(_COLOURS)], f"{name}: {lost} at {at:.6f} s")
    axes.legend([result.validator.plan.name(row) for row in rows[: len(_COLOURS)]])
    return axes.svg()


def _histograms(result: Report) -> list[str]:
    """Plot the histogram of the frame intervals for at most `_HISTOGRAMS` messages.

    Messages with timing findings come before messages without. In both groups, the message with the largest spread of the
    intervals comes first.
    """
    validator = result.validator
    reported = {f.message for f in result.findings if f.rule in _TIMING}
    rows = [r for r in np.flatnonzero(validator.timing.intervals > 0).tolist() if validator.plan.cycle_ns[r] > 0]
    spread = {row: _spread(validator.timing.histogram[row]) for row in rows}
    rows.sort(key=lambda row: (validator.plan.name(row) not in reported, -spread[row]))
    parts = []
    for row in rows[:_HISTOGRAMS]:
        counts, cycle = validator.timing.histogram[row], validator.plan.cycle_ns[row] * 1e-6
        used = np.flatnonzero(counts)
        first, last = max(0, int(used[0]) - 5), min(BINS, int(used[-1]) + 6)
        width = cycle / BINS_A_CYCLE
        axes = _Axes(
            (first * width, last * width),
            (0.0, 1.1 * math.log10(1 + int(counts.max()))),
            "interval [ms]",
            "log10 (1 + count)",
        )
        for number in used.tolist():
            axes.bar(number * width, width, math.log10(1 + int(counts[number])), _COLOURS[0])
        axes.mark(cycle, f"{cycle:g} ms")
        more = " (the last bin also counts all longer intervals)" if int(counts[-1]) else ""
        timing = validator.timing
        title = (
            f"{validator.plan.name(row)}: {timing.intervals[row]} intervals, mean {timing.mean_ms(row):.4f} ms{more}"
        )
        parts += [f"<h4>{escape(title)}</h4>", axes.svg()]
    if len(rows) > _HISTOGRAMS:
        parts.append(f"<p class='small'>and {len(rows) - _HISTOGRAMS} messages with less spread</p>")
    return parts or ["<p class='small'>No message with a cycle time was received more than once.</p>"]


def _spread(histogram: npt.NDArray[np.int64]) -> int:
    used = np.flatnonzero(histogram)
    return int(used[-1] - used[0])
