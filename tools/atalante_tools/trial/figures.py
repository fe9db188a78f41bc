"""Figures of the trials, similar to the figures of the paper: `results -> PNG images as bytes`."""

from __future__ import annotations

import io
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any, Final

import matplotlib
import numpy as np

from atalante_tools.trial.findings import Result, condition, normalised

matplotlib.use("Agg")
from matplotlib import pyplot as plt

_CONDITIONS: Final = ("passive full", "passive partial", "active full", "active partial")


def shapes(results: Sequence[Result]) -> bytes:
    """Draw the left hip angle over the phase, with one panel for each guide shape (figure "various shapes" of the paper).

    Args:
        results: results of `shape` trials.
    """
    columns = min(3, len(results))
    figure, axes = plt.subplots(
        math.ceil(len(results) / columns), columns, figsize=(4.4 * columns, 3.2 * math.ceil(len(results) / columns)),
        sharex=True, sharey=True, squeeze=False,
    )  # fmt: skip
    for axis, result in zip(axes.flat, results, strict=False):
        _steps(axis, result["curves"], [0, 1, 2, 3, 4])
        axis.set_title(f"{result['trial']['shape']}: {len(result['curves'])} right-stance steps", fontsize=9)
    for axis in axes.flat[len(results) :]:
        axis.set_visible(False)
    _label(axes, "phase t / T", "left hip [deg]")
    return _png(figure)


def robustness(results: Sequence[Result]) -> bytes:
    """Draw one marker for each walk, at its mass error (x) and its floor friction (y).

    The marker is a dot if the robot stood at the end, otherwise a cross. The mass error is a ratio: the true mass of the patient,
    divided by the mass in the model of the controller.

    Args:
        results: results of `robust` trials.
    """
    figure, axis = plt.subplots(figsize=(6.0, 4.2))
    kinds = [(sum(r["trial"]["delay"]), r["outcome"] == "stood") for r in results]
    for delay in sorted({delay for delay, _ in kinds}):
        for stood, marker in ((True, "o"), (False, "x")):
            of = [r["trial"] for r, kind in zip(results, kinds, strict=True) if kind == (delay, stood)]
            if of:
                label = f"{'stood' if stood else 'did not stand'}, control loop {delay} ms late"
                axis.scatter([t["mass_share"] for t in of], [t["friction"] for t in of], marker=marker, label=label)
    axis.set_xlabel("true mass / known mass of the patient")
    axis.set_ylabel("friction")
    axis.legend(fontsize=7)
    return _png(figure)


def pushes(results: Sequence[Result]) -> bytes:
    """Draw a polar figure: for each push direction, the largest push that the robot withstands.

    A thin line shows the pushes at one phase of the step. The thick line shows the smallest force of all phases.

    Args:
        results: results of `push` trials.
    """
    figure, axis = plt.subplots(figsize=(6.4, 6.0), subplot_kw={"projection": "polar"})
    forces = {(r["trial"]["direction"], r["trial"]["phase"]): r["largest_push_n"] for r in results}
    directions, phases = (sorted({where[k] for where in forces}) for k in (0, 1))
    angles = np.radians([*directions, directions[0]])
    for number, phase in enumerate(phases):
        line = [forces.get((direction, phase), math.nan) for direction in (*directions, directions[0])]
        colour = plt.get_cmap("viridis")(number / max(1, len(phases) - 1))
        axis.plot(angles, line, linewidth=0.9, color=colour, label=f"phase {phase:g}")
    worst = [
        min(force for (angle, _), force in forces.items() if angle == direction)
        for direction in (*directions, directions[0])
    ]
    axis.plot(angles, worst, linewidth=2.5, color="black", label="worst phase")
    axis.set(
        theta_zero_location="N",  # 0 degrees (forwards) is at the top of the plot, 90 degrees (left) is at its left edge
        ylim=(0.0, None),
        title="largest push withstood [N]\n0 deg forwards, 90 deg to the left, right leg is stance leg",
    )
    axis.legend(fontsize=7, loc="lower left", bbox_to_anchor=(-0.15, -0.1))
    return _png(figure)


def joints(results: Sequence[Result], mass: float) -> bytes:
    """Draw hip and knee angles of the left leg in the four trials of one subject (figure "active and passive" of the paper).

    Args:
        results: results of `assist` trials.
        mass: mass of the subject [kg].
    """
    found = {condition(r): r for r in results if r["trial"]["mass"] == mass}
    shown = [c for c in _CONDITIONS if c in found]
    figure, axes = plt.subplots(
        2, len(shown), figsize=(3.4 * len(shown), 5.4), sharex=True, sharey="row", squeeze=False
    )
    for column, name in enumerate(shown):
        for row in range(2):
            curves = found[name]["curves"]
            bounded = [
                [[s[0], s[1 + row], s[3 + row], s[3 + row] + s[5 + row], s[3 + row] - s[5 + row]] for s in step]
                for step in curves
            ]
            _steps(axes[row][column], bounded, [0, 1, 2, *([3, 4] if name.endswith("partial") else [])])
        axes[0][column].set_title(f"{mass:g} kg, {name}", fontsize=9)
    _label(axes, "phase t / T", "left hip [deg]")
    axes[1][0].set_ylabel("left knee [deg]")
    return _png(figure)


def positions(results: Sequence[Result]) -> bytes:
    """Draw histograms of the angle errors of hip and knee, each divided by the half-width of the guide.

    At 1 and -1, the joint is at an edge of the guide. Passive and active subjects have separate curves.

    Args:
        results: results of `assist` trials.
    """
    from atalante_tools.trial.run import EDGES

    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.0), sharey=True)
    for name in ("passive partial", "active partial"):
        counts = [r["guide"]["histogram"] for r in results if condition(r) == name and r["guide"]]
        for k, axis in enumerate(axes):
            total = np.sum([c[k] for c in counts], axis=0) if counts else np.zeros(len(EDGES) - 1)
            axis.stairs(total / max(1, np.sum(total)), EDGES, label=name)
    for axis, joint in zip(axes, ("hip", "knee"), strict=True):
        axis.set(title=f"{joint} of the swing leg", xlabel="e / q_bound", xlim=(-1.0, 1.0))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("share of the time")
    return _png(figure)


def power_and_error(results: Sequence[Result]) -> bytes:
    """Draw tracking error and metabolic rate of the four conditions (figure "tracking accuracy and power" of the paper).

    Args:
        results: results of `assist` trials that ended standing.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4))
    for axis, label, value in (
        (left, "exercise minus baseline [W/kg]", lambda r: r["metabolic_w_kg"]["target"] - r["metabolic_w_kg"]["full"]),
        (right, "RMS tracking error [deg]", lambda r: r["error_deg"]["target"]),
    ):
        _bars(axis, results, value)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    return _png(figure)


def scenario(result: Result) -> bytes:
    """Draw the metabolic rate over time in one trial (figure "testing procedure" of the paper).

    Args:
        result: result of a walk.
    """
    rate, segment = result["respirometer"]["rate_w_kg"], np.array(result["respirometer"]["segment"])
    figure, axis = plt.subplots(figsize=(9.0, 2.8))
    axis.plot(np.arange(1, len(rate) + 1), rate, linewidth=0.7, color="tab:gray", label="measured (Brockway)")
    for k, name in enumerate(("full assistance", "transition", f"Xi = {result['trial']['xi']:g}")):
        inside = np.flatnonzero(segment == k)
        if len(inside):
            mean = statistics.fmean(rate[i] for i in inside)
            axis.hlines(
                mean, inside[0], inside[-1] + 1, colors=f"C{k}", linewidth=2.5, label=f"{name}: {mean:.3f} W/kg"
            )
    axis.set(xlabel="time of the walk [s]", ylabel="metabolic rate [W/kg]", title=result["trial"]["name"])
    axis.legend(fontsize=7)
    axis.grid(alpha=0.3)
    return _png(figure)


def time_of(order: str) -> tuple[int, int]:
    """Return day and position of a trial of the sweep, as a key to sort trials by time. A treadmill trial has the position 0.

    Args:
        order: field `order` of the trial, for example "day2-03", or "day2" of a treadmill trial.
    """
    day, _, position = order.partition("-")
    return int(day.removeprefix("day")), int(position or 0)


def sweep_in_time(results: Sequence[Result]) -> bytes:
    """Draw metabolic rates and tracking errors in the order of the trials (figure "up and down" of the paper).

    Args:
        results: results of the sweep trials that ended, including the treadmill trials.
    """
    ordered = sorted(results, key=lambda r: time_of(r["trial"]["order"]))
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(11.0, 5.6), sharex=True)
    names = []
    for i, result in enumerate(ordered):
        walk = result["trial"]["kind"] == "walk"
        names.append(f"{result['trial']['xi']:g}" if walk else "treadmill")
        rates = result["metabolic_w_kg"]
        if walk:
            upper.bar(i - 0.2, rates["full"], 0.4, color="tab:blue", label="baseline")
            lower.bar(i - 0.2, result["error_deg"]["full"], 0.4, color="tab:blue")
            lower.bar(i + 0.2, result["error_deg"]["target"], 0.4, color="tab:orange")
        upper.bar(i + 0.2 * walk, rates["target"], 0.4, color="tab:orange" if walk else "tab:green",
                  label="exercise" if walk else "treadmill (equation)")  # fmt: skip
    handles = dict(zip(*reversed(upper.get_legend_handles_labels()), strict=True))
    upper.legend(handles.values(), handles.keys(), fontsize=7)
    upper.set_ylabel("metabolic rate [W/kg]")
    lower.set_ylabel("RMS tracking error [deg]")
    lower.set_xticks(range(len(names)), names, rotation=60, fontsize=7)
    lower.set_xlabel("assistance factor, in the order of the trials")
    for axis in (upper, lower):
        axis.grid(alpha=0.3)
    return _png(figure)


def sweep_trend(results: Sequence[Result]) -> bytes:
    """Draw normalised metabolic rate and tracking error over the assistance factor (figure "assistance factor" of the paper).

    Args:
        results: results of walks of the sweep that ended standing.
    """
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4))
    for axis, label, value in (
        (axes[0], "exercise / baseline", normalised),
        (axes[1], "RMS tracking error [deg]", lambda r: r["error_deg"]["target"]),
    ):
        factors = sorted({r["trial"]["xi"] for r in results}, reverse=True)
        means = [statistics.fmean(value(r) for r in results if r["trial"]["xi"] == xi) for xi in factors]
        axis.plot([r["trial"]["xi"] for r in results], [value(r) for r in results], "o", alpha=0.5)
        axis.plot(factors, means, color="black")
        axis.invert_xaxis()
        axis.set(xlabel="assistance factor Xi", ylabel=label)
        axis.grid(alpha=0.3)
    return _png(figure)


def _steps(axis: Any, steps: Sequence[Sequence[Sequence[float]]], columns: Sequence[int]) -> None:
    """Draw the angle curves of several steps in one panel.

    A sample is (phase, measured angle, desired angle, upper edge of the guide, lower edge of the guide). `columns` begins with 0,
    1, 2. If the edges must be drawn, 3 and 4 follow.
    """
    for number, step in enumerate(steps):
        data, last = np.array(step), number == len(steps) - 1
        axis.plot(
            data[:, 0], data[:, 1], color="tab:blue", linewidth=0.7, alpha=0.7, label="measured" if last else None
        )
        if last:
            axis.plot(data[:, 0], data[:, 2], color="black", linewidth=1.0, linestyle="--", label="desired")
            for edge in columns[3:]:
                axis.plot(
                    data[:, 0], data[:, edge], color="tab:red", linewidth=1.2, label="guide" if edge == 3 else None
                )
    axis.grid(alpha=0.3)


def _bars(axis: Any, results: Sequence[Result], value: Callable[[Result], float]) -> None:
    """Draw mean and standard deviation of a value in each condition, and a dot for each subject."""
    for i, name in enumerate(_CONDITIONS):
        values = [value(r) for r in results if condition(r) == name]
        if values:
            deviation = statistics.stdev(values) if len(values) > 1 else 0.0
            axis.bar(i, statistics.fmean(values), yerr=deviation, color=f"C{i}", alpha=0.6, capsize=3)
            axis.plot([i] * len(values), values, "k.", markersize=4)
    axis.set_xticks(range(len(_CONDITIONS)), [name.replace(" ", "\n") for name in _CONDITIONS], fontsize=8)


def _label(axes: Any, x: str, y: str) -> None:
    for axis in axes[-1]:
        axis.set_xlabel(x)
    for row in axes:
        row[0].set_ylabel(y)
    axes[0][-1].legend(fontsize=7)


def _png(figure: Any) -> bytes:
    figure.tight_layout()
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=90, metadata={"Software": None})
    plt.close(figure)
    return file.getvalue()
