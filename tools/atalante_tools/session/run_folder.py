"""Folder of a run of `atalante demo` or `airwalk`: locked during the run, summary and figure written at its end.

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

from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import say, table

if TYPE_CHECKING:
    from atalante_hal.telemetry.process import Recording


@dataclass(frozen=True)
class Result:
    """Result of one guide shape. The field names are the keys of `--json` and of summary.json."""

    shape: str
    certified: bool  # whether the guide is certified on the model at every assistance factor of the run
    bound_hip_nm: float | None  # torque tolerated at the hip together with bound_knee_nm; None: not certified
    bound_knee_nm: float | None  # the same at the knee
    steps: int  # number of completed right-stance steps
    max_ratio: float  # largest |e| / q_bound after the first completed step
    inside: float  # share of that time with both assisted joints inside the guide, 0 to 1
    filter_active: float  # share of that time with an active filter, 0 to 1
    cycles: int
    real_time_factor: float
    frames: int
    crc_errors: int


@contextmanager
def run_folder(out: Path) -> Iterator[None]:
    """Create the folder and lock it, because two runs must not write the same files.

    A new folder that is still empty after the block is removed.

    Args:
        out: Path of the folder.

    Raises:
        Failed: If another run uses the folder.
        OSError: If the folder cannot be created.
    """
    existed = out.exists()
    out.mkdir(parents=True, exist_ok=True)
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Failed(
                f"another run is writing into {out}: wait for its end, or choose another folder with --out"
            ) from None
        yield
    finally:
        os.close(folder)
        if not existed and not any(out.iterdir()):
            out.rmdir()


def leave(out: Path, asked: Mapping[str, Any], results: Sequence[Result], recording: Recording) -> None:
    """Write summary.json and the figure, and print the names of all files.

    Args:
        out: Folder of the run.
        asked: Options of the user; the first keys of the summary.
        results: Results, one per shape.
        recording: Recording files, and whether they contain every cycle.
    """
    summary = {**asked, "recording": asdict(recording), "shapes": [asdict(result) for result in results]}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    figure = _figure(out)
    say(f"in {out}: {', '.join([*recording.files, 'summary.json', *([figure] if figure else [])])}")


def _figure(out: Path) -> str:
    """Draw the figure and return its name, or print why there is none and return an empty string."""
    name = "guide_shapes.png"
    try:
        from mcap.exceptions import McapError

        from atalante_tools.session.figures import guide_shapes
    except ModuleNotFoundError as error:
        say(f"no figure: {error.name} is not installed; type `pip install 'atalante-hal[plot]'`")
        return ""
    try:
        guide_shapes(out / "recording.mcap", out / name)
    except McapError as error:
        say(f"no figure: recording.mcap is incomplete: {error}")
        return ""
    return name


def results_table(results: Sequence[Result]) -> str:
    """Return the results as a table for the terminal.

    Args:
        results: Results, one per shape.
    """
    head = ["shape", "certified", "bound hip Nm", "bound knee Nm", "steps", "max |e|/q_bound", "inside %", "filter active %",
            "cycles", "x real time", "frames", "CRC errors"]  # fmt: skip
    rows = [
        [
            r.shape,
            "yes" if r.certified else "NO",
            *("-" if bound is None else f"{bound:.2f}" for bound in (r.bound_hip_nm, r.bound_knee_nm)),
            str(r.steps),
            *_judged(r),
            str(r.cycles),
            f"{r.real_time_factor:.1f}",
            str(r.frames),
            str(r.crc_errors),
        ]
        for r in results
    ]
    return table([head, *rows])


def _judged(result: Result) -> tuple[str, str, str]:
    """Return the three cells of the tracking error, which is measured after the first completed step."""
    if result.steps < 2:
        return "-", "-", "-"
    return f"{result.max_ratio:.2f}", f"{100 * result.inside:.1f}", f"{100 * result.filter_active:.1f}"
