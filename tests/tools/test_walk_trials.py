"""Trials of the walk: selection, options of each kind, resumption and table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from atalante_control.gait.subject import STUDY_PATIENTS
from atalante_tools import walk_trials
from atalante_tools.cli import cli
from atalante_tools.walk_trials import KINDS, main, table, trials

RESULT = {
    "outcome": "stood", "steps": 375, "certified": True, "max_ratio": 0.5, "outside_cycles": 3, "lateral_m": 0.1,
    "true_lateral_m": -0.2, "true_yaw_deg": 1.0, "attitude_rms_deg": 0.08,
}  # fmt: skip


def test_every_kind_has_a_trial_for_each_engine_and_patient() -> None:
    everything = list(trials((), (), ()))
    assert len({trial.name for trial in everything}) == len(everything) == len(KINDS) * 2 * 8
    masses = [patient.mass for patient in STUDY_PATIENTS]
    assert (min(masses), max(masses), len(set(masses))) == (58.0, 91.0, 8)
    assert [trial.name for trial in trials(["full"], ["mujoco"], [58.0])] == ["full_mujoco_58kg"]


@pytest.mark.parametrize("kind", KINDS)
def test_options_of_every_kind_are_accepted_by_the_command(kind: str) -> None:
    done = CliRunner().invoke(cli, ["walk", *KINDS[kind], "--mass", "300", "--height", "1.8", "-i", "embedded"])
    assert done.exit_code in (1, 2)
    assert "mass" in done.stderr  # the options are valid, only the patient is not


def test_trials_with_results_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run(trial: walk_trials.Trial, folder: Path) -> None:
        ran.append(trial.name)
        (folder / f"{trial.name}.json").write_text(json.dumps({"code": 0, "messages": [], "result": RESULT}))

    monkeypatch.setattr(walk_trials, "run", run)
    arguments = [str(tmp_path), "--kind", "full", "--mass", "58", "--mass", "91"]
    for _ in range(2):
        done = CliRunner().invoke(main, arguments)
        assert done.exit_code == 0, done.output
    assert ran == ["full_pybullet_58kg", "full_pybullet_91kg", "full_mujoco_58kg", "full_mujoco_91kg"]
    written = (tmp_path / "walks.md").read_text()
    assert written == table(tmp_path)
    assert len(written.splitlines()) == 2 + len(ran)
    row = "| full | 58 kg, 1.62 m | pybullet | stood | 375 | yes | 0.50 | 3 | +0.10 | -0.20 | +1.0 | 0.08 |"
    assert written.splitlines()[2] == row
