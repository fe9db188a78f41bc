"""Trace of a walk on the ground: `telemetry of the controller -> trace.npz, walk.png`. The figure needs the extra `plot`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_control.walking.controller import WalkController
    from atalante_hal.types import Vector

#: Number of cycles from one sample of the telemetry to the next.
PERIOD_CYCLES: Final = 10
_COLOURS: Final = ("tab:blue", "tab:orange")


class WalkTrace:
    """Samples of the telemetry of a walk."""

    def __init__(self, controller: WalkController) -> None:
        """Create an empty trace.

        Args:
            controller: Controller of the walk.
        """
        self._controller = controller
        self._cycles: list[int] = []
        self._rows: list[Vector] = []

    def sample(self, cycle: int) -> None:
        """Store the telemetry of a cycle if a sample is due.

        Args:
            cycle: Cycle number.
        """
        if cycle % PERIOD_CYCLES == 0:
            self._cycles.append(cycle)
            self._rows.append(self._controller.telemetry.copy())

    def columns(self) -> dict[str, Vector]:
        """Return the samples as a mapping from the name of each telemetry field to an array of shape (n, width).

        The key `time` contains the times of the samples [s], shape (n,).
        """
        from atalante_hal.types import PERIOD

        fields = self._controller.telemetry_fields
        rows = np.array(self._rows).reshape(len(self._rows), sum(width for _, width in fields))
        ends = np.cumsum([width for _, width in fields])
        columns = {name: rows[:, end - width : end] for (name, width), end in zip(fields, ends, strict=True)}
        return {"time": PERIOD * np.array(self._cycles, dtype=np.float64), **columns}

    def write(self, out: Path) -> list[str]:
        """Write `trace.npz`, and `walk.png` if Matplotlib is installed. Return the names of the files.

        Args:
            out: Existing folder.
        """
        columns = self.columns()
        np.savez_compressed(out / "trace.npz", **columns)  # type: ignore[arg-type]
        try:
            draw(columns, out / "walk.png")
        except ModuleNotFoundError as error:
            print_message(f"no figure: {error.name} is not installed; type `pip install 'atalante-hal[plot]'`")
            return ["trace.npz"]
        return ["trace.npz", "walk.png"]


def foot_prints(columns: Mapping[str, Vector]) -> list[tuple[int, float, float, float]]:
    """Return foot (0 left, 1 right), position [m] and heading [rad] of each landing, in the order of the landings.

    Args:
        columns: Samples of `WalkTrace.columns`.
    """
    prints: list[tuple[int, float, float, float]] = []
    last = np.full((2, 2), math.nan)
    walking = columns["feet"].any(axis=1)  # False for the samples before the walk: their foot positions are all zero
    for feet, yaw in zip(columns["feet"][walking].reshape(-1, 2, 2), columns["yaw"][walking, 0], strict=True):
        landed = [side for side in (0, 1) if not np.array_equal(feet[side], last[side])]
        prints.extend((side, float(feet[side, 0]), float(feet[side, 1]), float(yaw)) for side in landed)
        last = feet
    return prints


def draw(columns: Mapping[str, Vector], picture: Path) -> None:
    """Draw the foot prints on the ground, and the angle errors of the swing leg over time.

    The upper panel also shows the path of the divergent component of motion (DCM). The lower panel shows the angle errors of hip
    (SH) and knee (SK), each divided by the half-width of the guide. At 1 and -1, the joint is at an edge of the guide.

    Args:
        columns: Samples of `WalkTrace.columns`.
        picture: File to write.

    Raises:
        ModuleNotFoundError: If Matplotlib is not installed.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (ground, guide) = plt.subplots(2, 1, figsize=(10.0, 6.0))
    _draw_ground(ground, columns)
    _draw_guide(guide, columns)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _draw_ground(axis: Any, columns: Mapping[str, Vector]) -> None:
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    from atalante_control.model import ExoskeletonParameters

    length, width = ExoskeletonParameters.sole_size
    for side, x, y, yaw in foot_prints(columns):
        sole = Rectangle((-0.5 * length, -0.5 * width), length, width, fill=False, color=_COLOURS[side], linewidth=0.8)
        sole.set_transform(Affine2D().rotate(yaw).translate(x, y) + axis.transData)
        axis.add_patch(sole)
    dcm = _dcm_on_ground(columns)
    axis.plot(dcm[:, 0], dcm[:, 1], color="black", linewidth=0.8, label="divergent component of motion")
    axis.set_xlabel("along the walking line [m]")
    axis.set_ylabel("to the left [m]")
    axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, loc="upper right")


def _dcm_on_ground(columns: Mapping[str, Vector]) -> Vector:
    """Return the path of the divergent component of motion (DCM) on the ground [m], shape (n, 2).

    The columns are the distances along the walking line, and to the left of this line. A row is NaN if no foot swings.
    """
    from atalante_control.walking.phases import STEPPING

    stance = columns["stance"][:, 0].astype(int)
    feet = columns["feet"].reshape(-1, 2, 2)[np.arange(len(stance)), stance]
    c, s = np.cos(columns["yaw"][:, 0]), np.sin(columns["yaw"][:, 0])
    x, y = columns["dcm"].T
    dcm = feet + np.column_stack([c * x - s * y, s * x + c * y])
    dcm[~np.isin(columns["phase"][:, 0], list(STEPPING))] = math.nan
    return np.asarray(dcm)


def _draw_guide(axis: Any, columns: Mapping[str, Vector]) -> None:
    guided = columns["q_bound"].min(axis=1) > 0.0
    ratio = np.full_like(columns["error"], math.nan)
    ratio[guided] = columns["error"][guided] / columns["q_bound"][guided]
    for joint, name in enumerate(("SH", "SK")):
        axis.plot(columns["time"], ratio[:, joint], linewidth=0.8, label=f"{name} of the swing leg")
    for edge in (-1.0, 1.0):
        axis.axhline(edge, color="tab:red", linewidth=1.2, label="guide" if edge > 0.0 else None)
    axis.plot(columns["time"], columns["lambda"], color="gray", linewidth=0.5, label="weight of the backup torque")
    axis.set_xlabel("time [s]")
    axis.set_ylabel("e / q_bound")
    axis.legend(fontsize=7, loc="upper left")
    axis.grid(alpha=0.3)
