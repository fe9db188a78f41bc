"""Trials: plans, keys, stored results, resumption after a kill, equal numbers on one and two processes, and the command."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import atalante_tools.trial as trial_commands
from atalante_control.dynamics.gait_network import DEFAULT_NETWORK, load_network, save_network
from atalante_control.model import Patient
from atalante_emulator.metabolism import MetabolismParameters
from atalante_tools.cli import cli
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import Stopped
from atalante_tools.session.walk_options import Push
from atalante_tools.trial import lockstep, plan, store
from atalante_tools.trial.branch import Branch
from atalante_tools.trial.fault_plan import fault_trials
from atalante_tools.trial.plan import (
    PROTOCOL,
    PUSH_DIRECTIONS,
    PUSH_FORCES,
    PUSH_PHASES,
    STEP,
    SWEEP,
    PushTrial,
    RobustTrial,
    ShapeTrial,
    TreadmillTrial,
    Trial,
    WalkSetting,
    WalkTrial,
    assist_trials,
    key,
    network_of,
    protocol_trials,
    push_trials,
    robust_trials,
    source_hash,
    sweep_trials,
)
from atalante_tools.trial.pushes import largest_push
from atalante_tools.trial.robustness import bus_faults, robust_walk
from atalante_tools.trial.run import run_trial
from atalante_tools.trial.store import compute, path_of, stored

SETTING = WalkSetting((2, 1, 2), "constant", 1.0, 1.0, 3, "mujoco")
SUBJECT = Patient(75.0, 1.75)
#: Two short walks of the default subject, whose gaits are in a file.
TINY: list[Trial] = [
    SETTING.walk(SUBJECT, active, xi, index) for index, (active, xi) in enumerate([(True, 0.0), (False, 0.5)])
]
PROGRAM = """
import sys
from pathlib import Path
from atalante_control.model import Patient
from atalante_tools.trial.plan import WalkSetting
from atalante_tools.trial.store import compute
setting, subject = WalkSetting((2, 1, 2), "constant", 1.0, 1.0, 3, "mujoco"), Patient(75.0, 1.75)
trials = [setting.walk(subject, active, xi, i) for i, (active, xi) in enumerate([(True, 0.0), (False, 0.5)])]
for _ in compute(trials, Path(sys.argv[1])):
    pass
"""


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the results of `TINY`, computed in this process."""
    folder = tmp_path_factory.mktemp("reference")
    assert len(list(compute(TINY, folder))) == len(TINY)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.json")}


def await_result(folder: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 240.0
    while not list(folder.glob("*.json")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_study_has_four_trials_of_eight_subjects() -> None:
    trials = assist_trials(replace(SETTING, protocol=PROTOCOL))
    assert len({trial.name for trial in trials}) == len({trial.seed for trial in trials}) == len(trials) == 32
    walks = [trial for trial in trials if isinstance(trial, WalkTrial)]
    assert {(t.active, t.xi) for t in walks} == {(False, 1.0), (False, 0.5), (True, 1.0), (True, 0.5)}
    assert {t.protocol for t in walks} == {(112, 38, 225)}
    assert [t.mass for t in assist_trials(SETTING, [91.0])] == [91.0] * 4  # type: ignore[union-attr]


def test_sweep_goes_down_and_up_again_on_each_day() -> None:
    trials = sweep_trials(SETTING, SWEEP, 2)
    assert len({trial.name for trial in trials}) == len({trial.seed for trial in trials}) == len(trials) == 20
    assert [t.kind for t in trials[:2]] == ["treadmill", "walk"]
    factors = [t.xi for t in trials[1:10] if isinstance(t, WalkTrial)]
    assert factors == factors[::-1] == [1.0, 0.75, 0.5, 0.25, 0.0, 0.25, 0.5, 0.75, 1.0]


def test_key_depends_on_every_parameter_and_on_the_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = SETTING.walk(SUBJECT, True, 0.5, 0)
    changes: list[dict[str, Any]] = [
        {"mass": 76.0}, {"height": 1.76}, {"active": False}, {"xi": 0.4}, {"protocol": (1, 1, 3)}, {"shape": "pinched"},
        {"idealization": 0.9}, {"feedforward": 0.9}, {"seed": 1}, {"engine": "pybullet"}, {"order": "day1-01"},
        {"literal": True}, {"heading_reference": True}, {"network": ("network.npz", "1a")}, {"haptics": True},
    ]  # fmt: skip
    keys = {key(trial), *(key(replace(trial, **change)) for change in changes)}
    assert len(keys) == 1 + len(changes)
    assert {name for change in changes for name in change} == {field.name for field in dataclasses.fields(trial)}
    monkeypatch.setattr(plan, "versions", lambda: {"atalante-hal": "9.9"})
    assert key(trial) not in keys


def test_source_hash_changes_with_every_file_that_computes(tmp_path: Path) -> None:
    code, report = tmp_path / "code.py", tmp_path / "report.py"
    for file in (code, report, tmp_path / "README.md"):
        file.write_text("1")
    before = source_hash([tmp_path], [report])
    report.write_text("2")
    (tmp_path / "README.md").write_text("2")
    assert source_hash([tmp_path], [report]) == before
    code.write_text('"""Return a number."""\n\n1  # one\n')
    assert source_hash([tmp_path], [report]) == before
    code.write_text("2")
    assert source_hash([tmp_path], [report]) != before
    code.write_text("1")
    (tmp_path / "data.toml").write_text("# one")
    assert source_hash([tmp_path], [report]) != before


@pytest.mark.long
def test_results_contain_what_the_findings_need(reference: Path) -> None:
    active, passive = (stored(trial, reference) for trial in TINY)
    assert active is not None
    assert passive is not None
    for result in (active, passive):
        assert (result["outcome"], result["steps"]) == ("stood", 5)
        assert 0.1 < result["error_deg"]["full"] < 2.0
        assert result["curves"]
    assert passive["muscle_w_kg"] == 0.0
    assert active["muscle_w_kg"] > 0.0
    assert active["error_deg"]["target"] > active["error_deg"]["full"]
    assert 0.0 < passive["max_ratio"] <= 1.0
    assert sum(passive["guide"]["histogram"][0]) > 50
    rate = passive["respirometer"]["rate_w_kg"]
    assert sum(rate) / len(rate) == pytest.approx(MetabolismParameters().standing, rel=0.15)


@pytest.mark.long
def test_two_processes_give_the_same_files_as_one(reference: Path, tmp_path: Path) -> None:
    assert len(list(compute(TINY, tmp_path, jobs=2))) == len(TINY)
    assert content(tmp_path) == content(reference)


@pytest.mark.filterwarnings("ignore")  # dask's own
@pytest.mark.long
def test_a_dask_cluster_on_loopback_gives_the_same_files(reference: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        assert len(list(compute(TINY, tmp_path, cluster=cluster.scheduler_address))) == len(TINY)
    assert content(tmp_path) == content(reference)


@pytest.mark.long
def test_a_killed_run_is_resumed_with_the_same_files(reference: Path, tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", PROGRAM, str(tmp_path)], stderr=subprocess.PIPE, text=True) as process:
        await_result(tmp_path, process)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json")}
    missing = [trial for trial in TINY if stored(trial, tmp_path) is None]
    assert 0 < len(missing) < len(TINY)
    assert len(list(compute(missing, tmp_path))) == len(missing)
    assert content(tmp_path) == content(reference)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


def test_a_partly_written_file_is_no_result(tmp_path: Path) -> None:
    path = path_of(TINY[0], tmp_path)
    path.with_suffix(".123.part").write_text('{"trial"')
    assert stored(TINY[0], tmp_path) is None


def test_result_of_a_worker_with_other_versions_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_run", lambda trial: {"trial": plan.fields(trial), "versions": {"numpy": "1"}})
    with pytest.raises(store.Failed, match="versions"):
        list(compute(TINY[:1], tmp_path))
    assert not content(tmp_path)


def test_result_is_serialised_once_and_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = {"trial": plan.fields(TINY[0]), "versions": plan.versions(), "curves": {10: [0.1, 1e300], 9: "\u00b0"}}
    expected, written = json.loads(json.dumps(result)), []

    def once(value: Any, *arguments: Any, **options: Any) -> str:
        written.append(value)
        return dumps(value, *arguments, **options)

    dumps = json.dumps
    monkeypatch.setattr(store, "_run", lambda trial: result)
    monkeypatch.setattr(json, "dumps", once)
    monkeypatch.setattr(json, "dump", lambda value, file: file.write(once(value)))
    list(compute(TINY[:1], tmp_path))
    assert sum("curves" in value for value in written) == 1
    assert stored(TINY[0], tmp_path) == expected


def test_treadmill_is_computed_without_a_robot() -> None:
    trial = sweep_trials(SETTING, SWEEP, 1)[0]
    result = run_trial(trial)
    assert result["outcome"] == "computed"
    assert result["metabolic_w_kg"]["target"] == pytest.approx(2.411, rel=0.02)


# -- command ---------------------------------------------------------------------------------------------------------------


def test_command_interrupted_by_ctrl_c_keeps_its_results(tmp_path: Path) -> None:
    program = [sys.executable, "-c", "from atalante_tools.entry import main; main()"]
    line = [*program, "trial", "sweep", "--quick", "--jobs", "1", "--out", str(tmp_path)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        await_result(tmp_path / "trials", process)  # the treadmill
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert "repeat the command" in err
    assert "Traceback" not in err
    assert len(content(tmp_path / "trials")) >= 1
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(("arguments", "days"), [((), 3), (("--quick",), 1), (("--quick", "--days", "2"), 2)])
def test_sweep_has_the_typed_number_of_days(
    arguments: tuple[str, ...], days: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned: list[Trial] = []
    monkeypatch.setattr("atalante_tools.trial._conduct", lambda _name, trials, *_: planned.extend(trials))
    done = CliRunner().invoke(cli, ["trial", "sweep", *arguments, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert sum(isinstance(trial, plan.TreadmillTrial) for trial in planned) == days


def test_command_uses_stored_results_and_writes_the_report(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []

    def run(trial: Trial) -> dict[str, Any]:
        ran.append(trial.name)
        like = stored(TINY[0], reference)
        assert like is not None
        return {**like, "trial": plan.fields(trial)}

    monkeypatch.setattr(store, "_run", run)
    arguments = ["trial", "assist", "--mass", "75", "--jobs", "1", "--json", "--out", str(tmp_path)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    assert len(ran) == 4
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["outcome"] for line in lines[:4]] == ["stood"] * 4
    assert [line["id"] for line in lines[4:]][:2] == ["assist-contained", "passive-gather"]
    assert "data:image/png" in (tmp_path / "report.html").read_text()
    (tmp_path / "report.html").unlink()
    os.remove(next((tmp_path / "trials").glob("*active-xi0.5*.json")))
    again = CliRunner().invoke(cli, [word for word in arguments if word != "--json"])
    assert again.exit_code == 0, again.output
    assert len(ran) == 5  # only the trial whose result was removed was run again
    assert "passive-flat" in again.stdout
    assert (tmp_path / "report.html").exists()


def test_a_fall_fails_the_command_and_is_reported(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    like = stored(TINY[0], reference)
    assert like is not None
    monkeypatch.setattr(store, "_run", lambda trial: {**like, "trial": plan.fields(trial), "outcome": "fell"})
    done = CliRunner().invoke(
        cli, ["trial", "assist", "--quick", "--mass", "75", "--jobs", "1", "--out", str(tmp_path)]
    )
    assert done.exit_code == 1
    assert "4 of 4 trials did not end as planned" in done.stderr
    assert "fell" in (tmp_path / "report.html").read_text()


def test_unknown_subject_is_a_usage_error(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["trial", "assist", "--mass", "99", "--out", str(tmp_path / "x")])
    assert done.exit_code == 2
    assert "58, 62" in done.stderr
    assert not (tmp_path / "x").exists()


@pytest.mark.long
def test_trial_walks_with_the_gaits_of_the_given_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "network.npz"
    file.write_bytes(DEFAULT_NETWORK.read_bytes())
    monkeypatch.setattr(plan, "QUICK_PROTOCOL", (1, 1, 1))
    arguments = ["trial", "protocol", "--quick", "--mass", "75", "--xi", "1", "--jobs", "1", "--network", str(file)]
    done = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    walks = [json.loads(path.read_text()) for path in (tmp_path / "out" / "trials").glob("*.json")]
    assert [walk["outcome"] for walk in walks] == ["stood"] * 2
    assert {walk["trial"]["network"][0] for walk in walks} == {str(file)}
    setting = replace(SETTING, network=network_of(file))
    file.write_bytes(b"another network")
    with pytest.raises(Failed, match=r"network\.npz must be unchanged until the end of the trials"):
        run_trial(setting.walk(SUBJECT, False, 1.0, 0))


def test_network_that_does_not_cover_a_subject_starts_no_trial(tmp_path: Path) -> None:
    network, file = load_network(), tmp_path / "network.npz"
    save_network(replace(network, low=np.maximum(network.low, [61.0, 0.0, 0.0, 0.0, 0.0, 0.0])), file)
    for arguments, message in (
        ([str(file)], "mass for the gait network must be 61 to 91 kg, got 58 kg"),
        ([str(tmp_path / "none.npz")], "none.npz cannot be read: No such file or directory"),
        ([__file__], "is not a valid gait network"),
    ):
        done = CliRunner().invoke(cli, ["trial", "protocol", "--out", str(tmp_path / "x"), "--network", *arguments])
        assert done.exit_code == 1, done.output
        assert message in done.stderr
        assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("experiment", ["robustness", "pushes", "faults"])
def test_experiments_without_subjects_of_the_paper_take_a_network(experiment: str, tmp_path: Path) -> None:
    network, file = load_network(), tmp_path / "network.npz"
    save_network(replace(network, low=np.maximum(network.low, [90.0, 0.0, 0.0, 0.0, 0.0, 0.0])), file)
    arguments = ["trial", experiment, "--quick", "--out", str(tmp_path / "x"), "--network", str(file)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 1, done.output
    assert "mass for the gait network must be 90 to 91 kg" in done.stderr
    assert not (tmp_path / "x").exists()


def test_trials_without_subjects_of_the_paper_load_their_network(tmp_path: Path) -> None:
    file = tmp_path / "network.npz"
    file.write_bytes(DEFAULT_NETWORK.read_bytes())
    network = network_of(file)
    trials = [
        *robust_trials(1, 1, 0, "mujoco", network),
        *push_trials((0.0,), (0.0,), (50.0,), 0, "mujoco", network),
        *fault_trials(("F05",), True, 0, "mujoco", network),
    ]
    assert all(trial.network == network for trial in trials if not isinstance(trial, ShapeTrial | TreadmillTrial))
    file.write_bytes(b"another network")
    for trial in trials:
        with pytest.raises(Failed, match=r"network\.npz must be unchanged until the end of the trials"):
            store._run(trial)


@pytest.mark.parametrize("damaged", ["", "{", "[]", "1", '{"outcome": "stood"}', "another trial", "\0"])
def test_damaged_result_is_computed_again(damaged: str, tmp_path: Path) -> None:
    """The trials on the treadmill take no time, because no body is simulated."""
    trial, other = (t for t in sweep_trials(SETTING, (), 2))
    (result, different) = compute([trial, other], tmp_path)
    path = path_of(trial, tmp_path)
    assert stored(trial, tmp_path) == json.loads(json.dumps(result))
    path.write_text(json.dumps(different) if damaged == "another trial" else damaged)
    assert stored(trial, tmp_path) is None
    assert list(compute([trial], tmp_path)) == [result]
    assert stored(trial, tmp_path) is not None


@pytest.mark.parametrize("edit", [{"metabolic_w_kg": None}, {"outcome": "stood"}, {"remark": "checked"}])
def test_edited_result_is_reported_and_computed_again(
    edit: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, a missing or changed value ended the command with a traceback or was reported as a result."""
    monkeypatch.setattr(plan, "QUICK_SWEEP", ())
    arguments = ["trial", "sweep", "--quick", "--jobs", "2", "--out", str(tmp_path)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    assert "1 of 1 trials to run on 1 process\n" in done.stderr
    (path,) = (tmp_path / "trials").glob("*.json")
    text = path.read_text()
    result = {**json.loads(text), **edit}
    path.write_text(json.dumps({name: value for name, value in result.items() if value is not None}))
    again = CliRunner().invoke(cli, arguments)
    assert again.exit_code == 0, again.output
    assert f"{path} is damaged or was edited: its trial is run again\n" in again.stderr
    assert path.read_text() == text


def test_protocol_has_a_trial_per_subject_condition_and_factor() -> None:
    trials = protocol_trials(replace(SETTING, literal=True), (0.5, 0.0))
    assert len({trial.name for trial in trials}) == len({trial.seed for trial in trials}) == len(trials) == 32
    assert all(isinstance(trial, WalkTrial) and trial.literal for trial in trials)
    passive = protocol_trials(replace(SETTING, literal=True), (0.5, 0.0), kinds=("passive",))
    assert passive == [trial for trial in trials if isinstance(trial, WalkTrial) and not trial.active]
    assert len(passive) == 16


@pytest.mark.parametrize(
    ("options", "law"),
    [
        ([], (False, 1.0, 1.0)),
        (["--literal"], (True, 1.0, 0.0)),
        (["--literal", "--feedforward", "0.5", "--idealization", "0.25"], (True, 0.25, 0.5)),
    ],
)
def test_protocol_has_the_law_of_a_walk_with_the_same_options(
    options: list[str], law: tuple[bool, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    conducted: list[WalkTrial] = []
    monkeypatch.setattr(trial_commands, "_conduct", lambda experiment, trials, *others: conducted.extend(trials))
    assert CliRunner().invoke(cli, ["trial", "protocol", *options]).exit_code == 0
    assert {(trial.literal, trial.idealization, trial.feedforward) for trial in conducted} == {law}


def test_protocol_rejects_factors_that_give_two_trials_the_same_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    monkeypatch.setattr(
        trial_commands, "_conduct", lambda experiment, trials, *others: names.extend(t.name for t in trials)
    )
    protocol = ["trial", "protocol", "--mass", "75", "--subject", "passive", "--out", str(tmp_path / "x")]
    done = CliRunner().invoke(cli, [*protocol, "--xi", "0.5", "--xi", "0.50000001"])
    assert done.exit_code == 2
    assert "factors of --xi must differ in their first six digits, got 0.5 and 0.50000001" in done.stderr
    assert names == []
    assert CliRunner().invoke(cli, [*protocol, "--xi", "0.5", "--xi", "0.50", "--xi", "0.500001"]).exit_code == 0
    assert names == ["walk-75kg-passive-xi0.5", "walk-75kg-passive-xi0.500001"]


def test_robust_trials_are_drawn_from_the_seed_within_their_ranges() -> None:
    trials = [t for t in robust_trials(100, 60, 0, "mujoco") if isinstance(t, RobustTrial)]
    assert trials == robust_trials(100, 60, 0, "mujoco") != robust_trials(100, 60, 1, "mujoco")
    assert trials[:10] == robust_trials(10, 60, 0, "mujoco")
    assert {sum(trial.delay) for trial in trials} == {0, 1, 2, 3}
    assert all(set(trial.delay) <= {0, 1} for trial in trials)
    assert all(0.9 <= t.mass_share <= 1.1 and 0.25 <= t.friction <= 0.8 for t in trials)
    assert all(len(t.pushes) == 6 and all(0.0 <= time < 48.0 for time, _ in t.pushes) for t in trials)
    assert len({trial.seed for trial in trials}) == 100
    for trial in robust_trials(20, 4, 0, "mujoco"):
        assert isinstance(trial, RobustTrial)
        ((time, _),) = trial.pushes
        assert time < 0.7 * 4 * STEP[1]  # also the push of a short walk begins


def robust_trial(steps: int) -> RobustTrial:
    """Return a trial of the default subject, whose gaits are in a file, with a push in the first step."""
    trial = robust_trials(1, steps, 0, "mujoco")[0]
    assert isinstance(trial, RobustTrial)
    return replace(trial, mass=SUBJECT.mass, height=SUBJECT.height, pushes=((0.4, 90.0),), delay=(1, 1, 1), loss=0.001)


@pytest.mark.long
def test_robust_walk_is_pushed_and_its_recording_is_readable(tmp_path: Path) -> None:
    trial = robust_trial(1)
    result = robust_walk(trial, tmp_path / "walk.mcap")
    assert (result["outcome"], result["steps"], result["safe"], result["pushes"]) == ("stood", 1, True, 1)
    assert result["max_dcm_error_m"] > 1.5 * robust_walk(replace(trial, force=0.0))["max_dcm_error_m"]
    assert (tmp_path / "walk.mcap").stat().st_size > 10_000


def test_failed_robust_walk_is_recorded_again_after_an_interruption_or_with_another_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The walks are replaced by stubs. The first recording is interrupted."""
    recorded: list[Path] = []
    fallen = {"outcome": "fell", "steps": 0, "safe": True}
    monkeypatch.setattr("atalante_tools.trial.run.robust_walk", lambda trial: fallen)

    def record(trial: RobustTrial, file: Path) -> None:
        recorded.append(file)
        file.write_bytes(b"begun")
        if len(recorded) == 1:
            raise Stopped(signal.SIGINT)
        file.write_bytes(b"complete")

    monkeypatch.setattr("atalante_tools.trial.robustness.robust_walk", record)
    arguments = ["trial", "robustness", "--quick", "--seeds", "1", "--jobs", "1", "--out", str(tmp_path)]
    for _ in range(3):
        CliRunner().invoke(cli, arguments)
    CliRunner().invoke(cli, [*arguments, "--seed", "1"])
    assert len(recorded) == 3
    recordings = sorted((tmp_path / "recordings").iterdir())
    assert [path.read_bytes() for path in recordings] == [b"complete"] * 2
    assert {path.stem for path in recordings} == {path.stem for path in (tmp_path / "trials").iterdir()}


def test_delay_of_a_robust_walk_applies_to_cyclic_states_and_commands() -> None:
    trial = robust_trials(1, 3, 0, "mujoco")[0]
    assert isinstance(trial, RobustTrial)
    faults = bus_faults(replace(trial, delay=(1, 2, 0)))
    late = {fault.target: fault["by"] for fault in faults if fault.kind == "delay"}
    assert late["LEFT_SK_STATE"] == late["IMU_PELVIS_STATE"] == late["PENDANT_STATE"] == 1
    assert late["COMMAND_LEFT_LEG"] == late["COMMAND_RIGHT_LEG"] == 2
    assert not any(name.startswith(("SYNC", "HAPTICS_COMMAND")) or name.endswith("STATUS") for name in late)
    assert not [fault for fault in bus_faults(replace(trial, delay=(0, 0, 1))) if fault.kind == "delay"]


def test_robot_that_cannot_start_ends_the_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lockstep, "_START", 200)
    result = robust_walk(robust_trial(1))
    assert (result["outcome"], result["steps"], result["safe"]) == ("no start", 0, True)


@pytest.mark.long
def test_robust_walk_that_falls_ends_in_a_safe_state() -> None:
    result = robust_walk(replace(robust_trial(1), force=2000.0))
    assert (result["outcome"], result["safe"]) == ("fell", True)
    assert result["state"] in ("HOLD", "LOWER", "FAULT")
    assert result["diagnostics"]


def test_pushes_have_16_directions_and_8_phases() -> None:
    trials = push_trials(PUSH_DIRECTIONS, PUSH_PHASES, PUSH_FORCES, 0, "mujoco")
    assert len({trial.name for trial in trials}) == len(trials) == 16 * 8
    assert all(isinstance(trial, PushTrial) and trial.forces == PUSH_FORCES for trial in trials)
    assert list(PUSH_FORCES) == sorted(PUSH_FORCES)


@pytest.mark.long
def test_largest_push_is_the_last_one_before_the_robot_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    # Walks with the same push are equal, so each is walked once. `forces` of the trial does not affect a walk.
    walks: dict[Push, tuple[str, dict[str, int]]] = {}
    ask = Branch.ask

    def ask_once(walk: Branch, push: Push) -> tuple[str, dict[str, int]]:
        walks[push] = walks.get(push) or ask(walk, push)
        return walks[push]

    monkeypatch.setattr(Branch, "ask", ask_once)
    trial = PushTrial(270.0, 0.25, (50.0, 1000.0, 2000.0), 75.0, 1.75, 0, "mujoco")
    result = largest_push(trial)
    assert (result["largest_push_n"], result["end"], result["outcome"]) == (50.0, "fell", "computed")
    assert result["diagnostics"]
    assert [push.force for push in walks] == [50.0, 1000.0]
    assert largest_push(replace(trial, forces=(1000.0,)))["largest_push_n"] == 0.0
    assert largest_push(replace(trial, forces=(50.0,)))["end"] == "stood"


@pytest.mark.long
def test_robot_withstands_a_push_at_the_landing_that_moves_the_dcm_over_the_new_stance_foot() -> None:
    trial = PushTrial(90.0, 0.875, (200.0,), 75.0, 1.75, 0, "mujoco")
    assert largest_push(trial)["end"] == "stood"


def test_figure_of_the_sweep_has_its_trials_in_time() -> None:
    from atalante_tools.trial.figures import time_of

    orders = [trial.order for trial in sweep_trials(SETTING, SWEEP, 11)]  # type: ignore[union-attr]
    assert sorted(orders, key=time_of) == orders
