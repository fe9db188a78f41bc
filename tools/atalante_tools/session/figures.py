"""Figure of a run, drawn from its recording.

recording.mcap -> guide_shapes.png
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from mcap.reader import make_reader

from atalante_hal.telemetry.schema import message_class

matplotlib.use("Agg")
from matplotlib import pyplot as plt

_LEFT_HIP = "left_SH"
_RIGHT_STANCE = 1
#: Phase that the last step of a run must reach to count as complete, 0 to 1.
_WHOLE = 0.9
#: Samples of one walking step: phase (0 to 1), then four angles [deg]: measured, desired, upper edge, lower edge of the guide.
_Step = list[tuple[float, ...]]


def guide_shapes(recording: Path, picture: Path) -> None:
    """Draw the left hip angle over the phase for all right-stance steps. Each guide shape has its own panel.

    An incomplete last step is not drawn, unless it is the only step.

    Args:
        recording: MCAP recording of the run.
        picture: File to write.
    """
    steps: dict[str, dict[int, _Step]] = defaultdict(lambda: defaultdict(list))
    last: dict[str, tuple[int, int]] = {}  # run name -> number and stance leg of the last step in this run
    for run, guide, upper, lower in _guide_samples(recording):
        last[run] = guide.step, guide.stance
        if guide.stance == _RIGHT_STANCE and guide.name and guide.name[0] == _LEFT_HIP:
            desired = guide.desired_position[2]
            degrees = np.degrees([desired + guide.error[0], desired, desired + upper, desired - lower])
            steps[run][guide.step].append((guide.phase, *degrees.tolist()))
    columns = min(3, max(1, len(steps)))
    rows = math.ceil(len(steps) / columns) or 1
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.4 * columns, 3.2 * rows), sharex=True, sharey=True, squeeze=False
    )
    for axis, (run, walked) in zip(axes.flat, steps.items(), strict=False):
        _panel(axis, run, _whole(walked, last[run]))
    for axis in axes.flat[len(steps) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("phase t / T")
    for row in axes:
        row[0].set_ylabel("left hip [deg]")
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _whole(walked: dict[int, _Step], last: tuple[int, int]) -> dict[int, _Step]:
    """Return all complete steps of a run. If no step is complete, return all steps."""
    number, stance = last
    whole = {
        step: samples
        for step, samples in walked.items()
        if (step, _RIGHT_STANCE) != (number, stance) or max(samples)[0] >= _WHOLE
    }
    return whole or walked


def _panel(axis: Any, run: str, walked: dict[int, _Step]) -> None:
    for number, samples in sorted(walked.items()):
        phase, actual, desired, upper, lower = np.array(sorted(samples)).T
        last = number == max(walked)
        axis.plot(phase, actual, color="tab:blue", linewidth=0.7, alpha=0.7, label="measured" if last else None)
        if last:
            axis.plot(phase, desired, color="black", linewidth=1.0, linestyle="--", label="desired")
            axis.plot(phase, upper, color="tab:red", linewidth=1.2, label="guide")
            axis.plot(phase, lower, color="tab:red", linewidth=1.2)
    axis.set_title(f"{run}: {len(walked)} right-stance step{'s'[: len(walked) != 1]}", fontsize=9)
    axis.legend(fontsize=7, loc="best")
    axis.grid(alpha=0.3)


def _guide_samples(recording: Path) -> Iterator[tuple[str, Any, float, float]]:
    """Yield run name, `Guide` message and guide width of each recorded cycle.

    The width is a pair [rad]: distances from the desired hip angle to the upper and to the lower edge of the guide. Cycles
    without a guide are left out.
    """
    classes = {name: message_class(name) for name in ("SystemState", "Guide", "Controller")}
    run, edges = "", (0.0, 0.0)
    pending: Any = None
    with recording.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=["/system", "/guide", "/controller"]):
            del channel
            kind = schema.name.rsplit(".", 1)[-1] if schema else ""
            decoded = classes[kind].FromString(message.data)
            if kind == "SystemState":
                run = decoded.run_name
            elif kind == "Guide":
                pending = decoded
            else:
                values = {field.name: field.value for field in decoded.field}
                edges = tuple(values.get("guide", edges))
            if pending is not None and kind == "Controller" and pending.cycle == decoded.cycle:
                if max(edges) > 0.0:
                    yield run, pending, edges[0], edges[1]
                pending = None
