"""Experiment `faults`: trials, moments of a walk, durations by bisection, findings, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from atalante_hal.safety.events import Event
from atalante_tools.cli import cli
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.trial import command as trial_command
from atalante_tools.trial import fault_run
from atalante_tools.trial.fault_findings import NO_FALL, NO_FALL_IN_DOUBLE_SUPPORT, fault_findings
from atalante_tools.trial.fault_plan import (
    DOUBLE_SUPPORT,
    FURTHER_MOMENTS,
    MOMENTS,
    NO_FRAMES,
    PERMANENT,
    QUICK_MOMENTS,
    fault_trials,
)
from atalante_tools.trial.fault_run import diagnosed, longest_without, run_fault
from atalante_tools.trial.report import EXPERIMENTS

#: Fault whose cases all begin at power-on.
POWER_ON = "F53"


def result(id_: str, case: str = "a case", **run: Any) -> dict[str, Any]:
    given = {
        "moment": "phase 0.5",
        "outcome": "fell",
        "state": "HOLD",
        "codes": ["NODE_TIMEOUT"],
        "detected": 5,
        "reason": "lost",
    }
    return {"trial": {"id": id_, "case": case}, "runs": [{**given, **run}], "longest": []}


def test_trials_have_unique_names_and_a_permanent_case_per_scenario_with_one() -> None:
    trials = fault_trials((), False, 0, "mujoco")
    assert len({trial.name for trial in trials}) == len(trials)
    left_out = set(SCENARIOS) - {trial.id for trial in trials}
    assert POWER_ON in left_out
    assert all(case.phase is None for id_ in left_out for case in SCENARIOS[id_].cases)
    permanent = {trial.id for trial in trials if trial.index == PERMANENT}
    assert permanent == {id_ for id_, scenario in SCENARIOS.items() if scenario.permanent is not None}


@pytest.mark.parametrize("limit", [0, 1, 9, 10, 437, 999])
def test_bisection_finds_the_longest_duration_without_a_fall(limit: int) -> None:
    found = longest_without(lambda cycles: cycles > limit, 1000, 10)
    assert found <= limit < found + 10


def test_bisection_returns_the_horizon_if_the_robot_never_falls() -> None:
    assert longest_without(lambda _: False, 1000, 10) == 1000


@pytest.mark.parametrize(
    ("id_", "run", "passed"),
    [
        ("F05", {}, False),
        ("F05", {"outcome": "hold"}, True),
        ("F05", {"outcome": "unfinished"}, True),
        ("F56", {"case": "dead-man released"}, False),
        ("F56", {"case": "HOLD"}, True),
        ("F44", {"case": "3 cycles"}, False),
        ("F44", {"case": "1.5 ms late in every cycle"}, True),
        ("F56", {"case": "HOLD", "codes": []}, False),
        ("F16", {}, True),
        ("F16", {"moment": "weight shift"}, False),
        ("F41", {"moment": "standing"}, False),
        ("F41", {"moment": "phase 0"}, True),
        ("F22", {}, True),
        ("F22", {"codes": []}, False),
        ("F22", {"state": "ACTIVE"}, False),
        ("F22", {"state": "FULL_ASSIST"}, False),
        ("F22", {"outcome": "exception"}, False),
    ],
)
def test_verdict_of_a_fault(id_: str, run: dict[str, Any], passed: bool) -> None:
    (finding,) = fault_findings([result(id_, **run)])
    assert (finding.id, finding.passed) == (id_, passed)


def test_finding_states_moment_state_diagnostic_and_reason_of_a_fall() -> None:
    (finding,) = fault_findings([result("F22") | {"longest": [120]}])
    assert finding.statistic == (
        "1 of 1 walks fell; a case: at phase 0.5 (HOLD; NODE_TIMEOUT; lost); "
        "longest duration without a fall 120 cycles (at phase 0.5)"
    )


def test_finding_counts_unfinished_walks() -> None:
    (finding,) = fault_findings([result("F22", outcome="unfinished")])
    assert finding.statistic == "0 of 1 walks fell; 1 unfinished"


@pytest.mark.long
def test_walk_that_lasts_too_long_is_unfinished(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fault_run, "_LONGEST", 2000)
    monkeypatch.setattr(fault_run, "_branches", fault_run._branches.__wrapped__)  # the cache must not keep this walk
    (trial, *_) = fault_trials(("F05",), True, 0, "mujoco")
    with pytest.raises(RuntimeError, match="must reach its end, got the outcome unfinished"):
        run_fault(trial)


def test_expected_diagnostic_is_found_among_information() -> None:
    events = [
        Event(10, "START", "", "info"),
        Event(11, "TORQUE_SATURATED", "", "warning"),
        Event(12, "EMCY_8130", "", "info"),
        Event(14, "EMCY_8130", "", "info"),
    ]
    assert diagnosed(events, "EMCY_xxxx", 10) == (("TORQUE_SATURATED", "EMCY_8130"), 3)
    assert diagnosed(events, "", 10) == (("TORQUE_SATURATED",), None)


def test_faults_without_fall_are_in_the_matrix() -> None:
    assert set(load_matrix()) >= NO_FALL.keys() | NO_FALL_IN_DOUBLE_SUPPORT


def test_fault_at_power_on_is_refused(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(cli, ["trial", "faults", POWER_ON, "--out", str(tmp_path)])
    assert outcome.exit_code == 2
    assert (
        "a fault must be one that can begin during a walk, got F53, which is injected only at power-on"
        in outcome.output
    )


@pytest.mark.long
def test_f41_robot_with_both_feet_on_the_ground_stands_when_the_hal_is_killed() -> None:
    (trial,) = fault_trials(("F41",), False, 0, "mujoco")
    moments = tuple(moment for moment in trial.moments if moment in DOUBLE_SUPPORT)
    runs = run_fault(replace(trial, moments=moments))["runs"]
    assert [run["moment"] for run in runs] == list(moments)
    assert {run["outcome"] for run in runs} == {"hold"}
    (swing,) = run_fault(replace(trial, moments=("phase 0.5",)))["runs"]
    # The fall overloads the drive of an ankle, so this drive is switched off (F84).
    assert (swing["outcome"], swing["state"], swing["codes"][0]) == ("fell", "LOWER", "CYCLE_GAP")


@pytest.mark.long
def test_force_cell_of_the_swing_foot_that_is_stuck_at_400_n_causes_no_fall() -> None:
    trial = next(trial for trial in fault_trials(("F33",), False, 0, "mujoco") if trial.case == "FOOT_LEFT FL at 400 N")
    (run,) = run_fault(replace(trial, moments=("phase 0.5",)))["runs"]
    assert (run["outcome"], run["codes"][0]) == ("walked", "FOOT_CELL")


def test_cases_for_a_suspended_robot_are_left_out() -> None:
    cases = {trial.case for trial in fault_trials(("F04", "F34"), False, 0, "mujoco")}
    suspended = {case.name for id_ in ("F04", "F34") for case in SCENARIOS[id_].cases if case.suspended}
    assert suspended
    assert not cases & suspended
    assert "FOOT_LEFT reports no load" in cases


def test_help_and_report_state_the_number_of_moments() -> None:
    _, explanation = EXPERIMENTS["faults"]
    for text in (trial_command.commands["faults"].help or "", explanation):
        words = " ".join(text.split())
        assert (len(MOMENTS), len(MOMENTS | FURTHER_MOMENTS), len(QUICK_MOMENTS)) == (10, 13, 2)
        assert "begins at ten moments" in words
        ids = f"{', '.join(sorted(NO_FRAMES)[:-1])} and {max(NO_FRAMES)}"
        assert f"{ids}, after which the HAL sends no more frames, begin at 13 moments" in words
        assert "With --quick, there are two moments" in words


@pytest.mark.long
def test_command_injects_a_fault_and_writes_the_report(tmp_path: Path) -> None:
    arguments = ["trial", "faults", "F05", "--quick", "--jobs", "1", "--out", str(tmp_path), "--json"]
    outcome = CliRunner().invoke(cli, arguments)
    assert outcome.exit_code == 0, outcome.output
    trial, finding = (json.loads(line) for line in outcome.stdout.splitlines())
    assert [run["outcome"] for run in trial["runs"]] == ["walked", "walked"]
    assert all("E2E_REPEATED" in run["codes"] for run in trial["runs"])
    assert (finding["id"], finding["passed"]) == ("F05", True)
    assert "weight shift" in (tmp_path / "report.html").read_text()
