"""Tests of campaigns: their plan, equal results in processes or a cluster, their report and the exit code of the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from distributed import LocalCluster

from atalante_tools.cli import cli
from atalante_tools.console.outcome import Failed
from atalante_tools.faults import campaign, tasks
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.moments import Moment, MomentTask
from atalante_tools.faults.report import Summary
from atalante_tools.faults.scenario import Case, HostFault, Scenario
from atalante_tools.faults.tasks import HORIZON, CaseTask, Endurance, EnduranceTask, PairTask, PairVerdict, Scope, plan
from atalante_tools.faults.verdict import Verdict

OVERRUN = [CaseTask("F44", index) for index in range(len(SCENARIOS["F44"].cases))]


def atalante(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["faults", *arguments])


def by_case(results: Sequence[object]) -> list[object]:
    return sorted(results, key=str)


def test_plan_contains_every_case_and_every_pair_once() -> None:
    planned = plan(list(SCENARIOS), Scope(endurance=True, pairs=True, moments=True, random_pairs=200, seed=0))
    cases = [task for task in planned if isinstance(task, CaseTask)]
    assert len(cases) == len(set(cases)) == sum(len(scenario.cases) for scenario in SCENARIOS.values())
    pairs = {frozenset((task.first, task.second)) for task in planned if isinstance(task, PairTask)}
    count = len(tasks.REPRESENTATIVES)
    assert len(pairs) == count * (count - 1) // 2
    moments = [task for task in planned if isinstance(task, MomentTask)]
    single = {(task.moment, *task.cases) for task in moments if len(task.cases) == 1}
    assert len(single) == len(Moment) * len(cases)
    assert len([task for task in moments if len(task.cases) == 2]) == 200
    assert {task.id for task in planned if isinstance(task, EnduranceTask)} == {
        s.id for s in SCENARIOS.values() if s.permanent
    }


@pytest.mark.long
def test_results_in_subprocesses_equal_those_in_process() -> None:
    here = list(campaign.results(OVERRUN))
    assert by_case(list(campaign.results(OVERRUN, jobs=2))) == by_case(here)
    assert all(isinstance(verdict, Verdict) and verdict.passed for verdict in here)


@pytest.mark.filterwarnings("ignore")  # dask's own
@pytest.mark.long
def test_results_in_a_cluster_equal_those_in_process() -> None:
    with LocalCluster(n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address=None) as cluster:
        there = list(campaign.results(OVERRUN, dask=cluster.scheduler_address))
    assert by_case(there) == by_case(list(campaign.results(OVERRUN)))


def test_missing_scheduler_or_library_fails_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Failed, match="start one with `dask scheduler`"):
        list(campaign.results(OVERRUN, dask="not an address"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(Failed, match=r"pip install 'atalante-hal\[dask\]'"):
        list(campaign.results(OVERRUN, dask="tcp://127.0.0.1:1"))
    monkeypatch.setitem(sys.modules, "joblib", None)
    with pytest.raises(Failed, match=r"pip install 'atalante-hal\[campaign\]'"):
        list(campaign.results(OVERRUN, jobs=2))


def test_exception_in_a_run_fails_its_case(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(case: Case, bound: int, *, recovery: bool) -> None:
        raise RuntimeError("the run failed")

    monkeypatch.setattr(tasks, "observe", crash)
    verdict = tasks.run_case("F44", SCENARIOS["F44"].cases[0])
    assert verdict.failures == ("exception in the run: RuntimeError: the run failed",)
    pair = PairTask(("F44", SCENARIOS["F44"].cases[0].name), ("F44", SCENARIOS["F44"].cases[1].name))()
    assert pair.failures == ("exception in the run: RuntimeError: the run failed",)


def test_endurance_is_the_longest_duration_that_stays_active() -> None:
    assert EnduranceTask("F44")() == Endurance("F44", SCENARIOS["F44"].permanent.name, 2)


def test_endurance_is_none_for_a_fault_that_never_ends_the_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    harmless = Scenario("F44", (), permanent=Case("in time", (HostFault("late", 0, None, 0.0),)))
    monkeypatch.setitem(tasks.SCENARIOS, "F44", harmless)
    assert EnduranceTask("F44")() == Endurance("F44", "in time", None)


def test_pair_of_faults_ends_in_the_worse_state() -> None:
    late, raised = (("F44", "3 cycles"), ("F45", "ValueError"))
    assert PairTask(late, raised)() == PairVerdict("F44 3 cycles", "F45 ValueError", "HOLD", ())


GOOD = Verdict("F44", "3 cycles", "HOLD", 2, 3, "OVERRUN", ())
BAD = replace(GOOD, case="4 cycles", cycles=9, failures=("HOLD after 9 cycles, and 3 are allowed",))
PAIR = PairVerdict("F03 4 frames", "F04 LEFT_SK", "HOLD", ("exception in the run: X: y",))


def test_summary_line_shows_the_worst_case_of_its_fault() -> None:
    near, far = replace(GOOD, case="b", cycles=3), replace(GOOD, case="a", cycles=1)
    assert Summary.of([far, near]).lines[0].cycles == 3
    line = Summary.of([near, BAD]).lines[0]
    assert (line.passed, line.cycles, line.cases) == (False, 9, 2)
    assert line.failures == ("4 cycles: HOLD after 9 cycles, and 3 are allowed",)


def test_report_lists_failures_endurance_and_pairs(tmp_path: Path) -> None:
    summary = Summary.of([PAIR, Endurance("F03", "for good", 4), Endurance("F11", "for good", None), BAD], 12.0)
    assert not summary.passed
    summary.write(tmp_path / "new")
    text = (tmp_path / "new" / "report.md").read_text()
    for piece in (
        "| F44 |",
        "**NO**",
        "- F44 4 cycles: HOLD after 9",
        "| 4 |",
        f"| {HORIZON} and more |",
        "and F04 LEFT_SK: exception in the run",
    ):
        assert piece in text
    data = json.loads((tmp_path / "new" / "report.json").read_text())
    assert not data["passed"]
    assert data["lines"][0]["id"] == "F44"
    assert data["endurance"][1]["survived"] is None
    assert Summary.of([GOOD]).passed


def test_list_prints_every_row_of_the_matrix() -> None:
    shown = [json.loads(line) for line in atalante("list", "--json").stdout.splitlines()]
    assert [line["id"] for line in shown] == list(load_matrix())
    assert "F44" in atalante("list").stdout


def test_run_prints_a_table_or_one_json_object() -> None:
    result = atalante("run", "f44")
    assert result.exit_code == 0
    assert "3 cycles" in result.stdout
    shown = json.loads(atalante("run", "F44", "--case", "3 cycles", "--json").stdout)
    keys = ("id", "passed", "state", "cycles", "bound", "dtc")
    assert [shown[key] for key in keys] == ["F44", True, "HOLD", 3, 3, "OVERRUN"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "F99"), "got 'F99'"),
        (("run", "F52"), "run `pytest tests/faults/test_refusals.py"),
        (
            ("run", "F44", "--case", "nothing like it"),
            "name that contains 'nothing like it'; valid cases: 2 cycles; 3 cycles",
        ),
        (("campaign", "F52"), "F52 has only tests and no scenario"),
        (("campaign", "--jobs", "0"), "--jobs"),
    ],
)
def test_invalid_arguments_end_with_exit_code_two(arguments: tuple[str, ...], message: str) -> None:
    result = atalante(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.mark.parametrize(
    "arguments", [("run", "F28"), ("campaign", "F28", "--no-endurance", "--no-moments", "--jobs=1")]
)
def test_missing_pybullet_fails_before_any_case(
    arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    refused = atalante(*arguments)
    assert refused.exit_code == 1
    assert "the emulated robot needs PyBullet; type: pip install 'atalante-hal[emulator]'" in refused.stderr
    assert "crashed" not in refused.output


def test_campaign_writes_its_report_and_fails_when_a_fault_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("campaign", "F44", "--jobs", "1", "--no-moments", "--out", str(tmp_path), "--json")
    result = atalante(*arguments)
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["passed"]
    assert "| F44 |" in (tmp_path / "report.md").read_text()
    monkeypatch.setattr(campaign, "run_task", lambda task: BAD)
    result = atalante(*arguments[:-1], "--no-endurance")
    assert result.exit_code == 1
    assert "1 of 1 faults, 0 of 0 pairs and 0 of 0 runs at other moments failed" in result.stderr


def test_ctrl_c_ends_a_campaign_and_its_subprocesses(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from atalante_tools.cli import main; main()", "faults", "campaign", "--jobs", "2"]
    command += ["--out", str(tmp_path)]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stderr is not None
    process.stderr.readline()
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    deadline = time.monotonic() + 10.0
    while group_alive(process.pid):
        assert time.monotonic() < deadline, "a subprocess of the campaign is still running"
        time.sleep(0.05)


def group_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
