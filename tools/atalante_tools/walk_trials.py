"""Trials of the walk on the ground: eight patients, two engines -> one JSON file per trial -> table of all trials.

    python -m atalante_tools.walk_trials FOLDER [--kind full] [--engine mujoco] [--mass 58]

Each trial is one run of `atalante walk` in lock-step, with seed 0. A trial whose file is in the folder is not run again, so an
interrupted call can be resumed, and the trials can be divided over several calls. The file `walks.md` in the folder is the table
of all trials in the folder.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from atalante_tools.console.options import ENGINES
from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_control.model import Patient

#: Numbers of steps of 0.8 s: 112 with full assistance (90 s), 38 in the transition (30 s), 225 with partial assistance (180 s).
PROTOCOL: Final = "112,38,225"
_PASSIVE: Final = ("--protocol", PROTOCOL, "--wearer", "passive")
#: Options of `atalante walk` for each kind of trial.
KINDS: Final = {
    "full": ("--steps", "375", "--xi", "1"),
    "pinched-0.5": ("--xi", "0.5", "--shape", "pinched", *_PASSIVE),
    "pinched-0": ("--xi", "0", "--shape", "pinched", *_PASSIVE),
    "constant-0.5": ("--xi", "0.5", "--shape", "constant", *_PASSIVE),
    "constant-0": ("--xi", "0", "--shape", "constant", *_PASSIVE),
    "literal": ("--xi", "0.5", "--literal", *_PASSIVE),
}
_WALK: Final = "from atalante_tools.entry import main; main()"
_COLUMNS: Final = (
    "trial", "patient", "engine", "outcome", "steps", "certified", "largest ratio", "cycles outside", "sideways [m]",
    "true sideways [m]", "true heading [deg]", "attitude error RMS [deg]",
)  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """One walk of one patient in one engine."""

    kind: str  # key of `KINDS`
    engine: str
    patient: Patient

    @property
    def name(self) -> str:
        """Return the name of the file of the trial, without its suffix."""
        return f"{self.kind}_{self.engine}_{self.patient.mass:g}kg"


def trials(kinds: Sequence[str], engines: Sequence[str], masses: Sequence[float]) -> Iterator[Trial]:
    """Yield the trials of a selection. An empty sequence selects everything.

    Args:
        kinds: keys of `KINDS`.
        engines: names of engines.
        masses: masses of patients [kg].
    """
    from atalante_control.gait.subject import STUDY_PATIENTS

    for kind in kinds or KINDS:
        for engine in engines or ENGINES:
            for patient in STUDY_PATIENTS:
                if not masses or patient.mass in masses:
                    yield Trial(kind, engine, patient)


def run(trial: Trial, folder: Path) -> None:
    """Run a trial, and write its result.

    Args:
        trial: trial to run.
        folder: folder of the results.

    Raises:
        RuntimeError: If the walk printed no result.
    """
    patient, file = trial.patient, folder / f"{trial.name}.json"
    person = ("--mass", f"{patient.mass:g}", "--height", f"{patient.height:g}")
    walk = [sys.executable, "-c", _WALK, "walk", "--json", "--engine", trial.engine, *KINDS[trial.kind]]
    walk += [*person, "--gait", str(_gait(trial, folder))]
    done = subprocess.run(walk, capture_output=True, text=True, check=False)
    messages = [line for line in done.stderr.splitlines() if "/q_bound" not in line and "sideways" not in line]
    try:
        result = json.loads(done.stdout)
    except ValueError:
        raise RuntimeError(f"{trial.name}: expected a result, got exit code {done.returncode}: {done.stderr}") from None
    file.write_text(json.dumps({"code": done.returncode, "messages": messages, "result": result}, indent=1) + "\n")


def _gait(trial: Trial, folder: Path) -> Path:
    """Return the walk file of the patient. The start step and the stop step are solved once per patient."""
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import write_walk
    from atalante_control.gait_optimization.walk import solve_walk
    from atalante_hal.robot import load_robot
    from atalante_tools.session.walk_options import DEFAULT_STEP

    file = folder / f"gait_{trial.patient.mass:g}kg.json"
    if not file.exists():
        subject = Subject(trial.patient, *DEFAULT_STEP)
        write_walk(solve_walk(subject, load_network().gait(subject, load_robot())), file)
    return file


def table(folder: Path) -> str:
    """Return the table of all trials in a folder, in Markdown.

    Args:
        folder: folder of the results.
    """
    lines = [f"| {' | '.join(_COLUMNS)} |", "|" + "---|" * len(_COLUMNS)]
    for trial in trials((), (), ()):
        file = folder / f"{trial.name}.json"
        if file.exists():
            lines.append(f"| {' | '.join(_row(trial, json.loads(file.read_text())['result']))} |")
    return "\n".join(lines) + "\n"


def _row(trial: Trial, result: dict[str, Any]) -> list[str]:
    def number(name: str, form: str) -> str:
        return "-" if result[name] is None else format(result[name], form)

    guided = result["max_ratio"] is not None
    certified = {True: "yes", False: "no", None: "-"}[result["certified"]]
    return [
        trial.kind,
        f"{trial.patient.mass:g} kg, {trial.patient.height:g} m",
        trial.engine,
        result["outcome"],
        str(result["steps"]),
        certified,
        number("max_ratio", ".2f"),
        str(result["outside_cycles"]) if guided else "-",
        number("lateral_m", "+.2f"),
        number("true_lateral_m", "+.2f"),
        number("true_yaw_deg", "+.1f"),
        number("attitude_rms_deg", ".2f"),
    ]


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(KINDS)), help="Kind of trial.  [default: all]")
@click.option("--engine", "engines", multiple=True, type=click.Choice(ENGINES), help="Engine.  [default: all]")
@click.option("--mass", "masses", multiple=True, type=float, metavar="KG", help="Mass of a patient.  [default: all]")
def main(folder: Path, kinds: tuple[str, ...], engines: tuple[str, ...], masses: tuple[float, ...]) -> None:
    """Run the trials of the selection whose results are not in FOLDER, and write the table of all results in FOLDER."""
    folder.mkdir(parents=True, exist_ok=True)
    for trial in trials(kinds, engines, masses):
        if not (folder / f"{trial.name}.json").exists():
            run(trial, folder)
            print_message(
                f"{trial.name}: {json.loads((folder / f'{trial.name}.json').read_text())['result']['outcome']}"
            )
    (folder / "walks.md").write_text(table(folder))


if __name__ == "__main__":
    main()
