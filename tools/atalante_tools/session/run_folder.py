"""The folder of a run: kept for one run at a time, and what `atalante demo` and `airwalk` leave in it and say at the end.

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
    """One shape; the keys of `--json` and of summary.json."""

    shape: str
    certified: bool  # on the model, at every assistance factor that was walked
    bound_hip_nm: (
        float | None
    )  # real torque the filter is built for, together with that at the knee; None: not certified
    bound_knee_nm: float | None
    steps: int  # completed right-stance steps
    max_ratio: float  # largest |e| / q_bound from the first completed step on
    inside: float  # share of that time both assisted joints were in the guide
    filter_active: float  # share of that time the filter acted
    cycles: int
    real_time_factor: float
    frames: int
    crc_errors: int


@contextmanager
def run_folder(out: Path) -> Iterator[None]:
    """Make the folder and keep it for this process: two recordings in one file are none. Made for nothing, it goes again.

    Raises:
        Failed: another run is at work in it.
        OSError: it cannot be made.
    """
    found = out.exists()
    out.mkdir(parents=True, exist_ok=True)
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Failed(
                f"another run is writing into {out}: let it end, or give this one a folder with --out"
            ) from None
        yield
    finally:
        os.close(folder)
        if not found and not any(out.iterdir()):
            out.rmdir()


def leave(out: Path, asked: Mapping[str, Any], results: Sequence[Result], recording: Recording) -> None:
    """Write summary.json and the figure, and say where everything is.

    Args:
        asked: what the user asked for, first in the summary.
        recording: its files, and whether they have every cycle.
    """
    summary = {**asked, "recording": asdict(recording), "shapes": [asdict(result) for result in results]}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    figure = _figure(out)
    say(f"in {out}: {', '.join([*recording.files, 'summary.json', *([figure] if figure else [])])}")


def _figure(out: Path) -> str:
    """Name of the figure; empty, and the reason said, where there is none."""
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
        say(f"no figure: recording.mcap is not whole: {error}")
        return ""
    return name


def results_table(results: Sequence[Result]) -> str:
    """The results for a person."""
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
    """What became of the guide, from the first completed step on: of a single step there is nothing to say."""
    if result.steps < 2:
        return "-", "-", "-"
    return f"{result.max_ratio:.2f}", f"{100 * result.inside:.1f}", f"{100 * result.filter_active:.1f}"
