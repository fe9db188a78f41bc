"""Output folder of `atalante demo` and `atalante airwalk`. The folder is locked during a run.

results -> table, summary.json; recording -> figure
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from atalante_tools.console.options import require_writable
from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import print_message, table

if TYPE_CHECKING:
    from atalante_hal.telemetry.process import Recording


@dataclass(frozen=True)
class Result:
    """Result of the walk inside one guide shape. The field names are the JSON keys of `--json` and of summary.json.

    `max_ratio`, `inside` and `filter_active` are measured after the first completed step. These fields are None if fewer than
    two steps were completed.
    """

    shape: str
    certified: bool  # whether the guide has a certificate at every assistance factor of the run
    #: Certified disturbance torque at the hip [Nm]; None if the guide is not certified.
    #: Both joints stay in the guide under disturbances up to `promise_hip_nm` at the hip and `promise_knee_nm` at the knee.
    promise_hip_nm: float | None
    promise_knee_nm: float | None  # certified torque at the knee [Nm], see `promise_hip_nm`
    steps: int  # number of completed right-stance steps (the left leg swings)
    #: largest |e| / q_bound: angle error, divided by the distance from the desired angle to the guide edge
    max_ratio: float | None
    inside: float | None  # share of the time with both assisted joints inside the guide, 0 to 1
    #: share of the time in which the backup torque of the guide (spring and damper) acts, 0 to 1
    filter_active: float | None
    cycles: int
    real_time_factor: float
    frames: int
    crc_errors: int
    #: Number of steps whose start deviation was compared with its certified range (hand-over box).
    #: The start deviation is compared only in steps with a certified guide.
    hand_overs: int
    #: Number of steps whose start deviation was outside the hand-over box. The certificate does not apply to these steps.
    hand_overs_exceeded: int


@contextmanager
def run_folder(out: Path) -> Iterator[None]:
    """Create the folder of a run and lock it during the block. The lock prevents a second run in the same folder.

    If the folder is new and still empty after the block, it is removed.

    Args:
        out: Path of the folder.

    Raises:
        Failed: If another run uses the folder.
        OSError: If the folder cannot be created, or no file can be created in it.
    """
    existed = out.exists()
    out.mkdir(parents=True, exist_ok=True)
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Failed(
                f"another run writes into {out}: wait for its end, or choose another folder with --out"
            ) from None
        require_writable(out)
        yield
    finally:
        os.close(folder)
        if not existed and not any(out.iterdir()):
            out.rmdir()


def write_summary(out: Path, options: Mapping[str, Any], results: Sequence[Result], recording: Recording) -> None:
    """Write summary.json and the figure, and print the names of all files in the folder of the run.

    Args:
        out: Folder of the run.
        options: Options of the user. They are the first keys of the summary.
        results: One result per guide shape.
        recording: Recording files, and whether they contain every cycle.
    """
    summary = {**options, "recording": asdict(recording), "shapes": [asdict(result) for result in results]}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    figure = _figure(out, recording)
    print_message(f"in {out}: {', '.join([*recording.files, 'summary.json', *([figure] if figure else [])])}")


def _figure(out: Path, recording: Recording) -> str:
    """Draw the figure and return its file name. If drawing fails, print the reason and return an empty string."""
    name = "guide_shapes.png"
    if "recording.mcap" not in recording.files:
        print_message("no figure: recording.mcap was not written")
        return ""
    try:
        from mcap.exceptions import McapError

        from atalante_tools.session.figures import guide_shapes
    except ModuleNotFoundError as error:
        print_message(f"no figure: {error.name} is not installed; type `pip install 'atalante-hal[plot]'`")
        return ""
    try:
        guide_shapes(out / "recording.mcap", out / name)
    except McapError as error:
        print_message(f"no figure: recording.mcap is incomplete: {error}")
        return ""
    return name


def results_table(results: Sequence[Result]) -> str:
    """Return the results as a table for the terminal.

    Args:
        results: One result per guide shape.
    """
    head = ["shape", "certified", "promise hip Nm", "promise knee Nm", "steps", "max |e|/q_bound", "inside %", "filter active %",
            "cycles", "x real time", "frames", "CRC errors", "steps outside box"]  # fmt: skip
    rows = [
        [
            r.shape,
            "yes" if r.certified else "NO",
            *("-" if torque is None else f"{torque:.2f}" for torque in (r.promise_hip_nm, r.promise_knee_nm)),
            str(r.steps),
            *_tracking_cells(r),
            str(r.cycles),
            f"{r.real_time_factor:.1f}",
            str(r.frames),
            str(r.crc_errors),
            str(r.hand_overs_exceeded) if r.hand_overs else "-",
        ]
        for r in results
    ]
    return table([head, *rows])


def _tracking_cells(result: Result) -> tuple[str, str, str]:
    """Return the three table cells of the tracking error. A cell is "-" if its value was not measured."""
    if result.max_ratio is None or result.inside is None or result.filter_active is None:
        return "-", "-", "-"
    return f"{result.max_ratio:.2f}", f"{100 * result.inside:.1f}", f"{100 * result.filter_active:.1f}"
