"""Tests of `atalante bench`: output format, and the error of an invalid benchmark. No time is asserted."""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import replace
from typing import Any

import pytest
from click.testing import CliRunner

from atalante_tools import bench
from atalante_tools.bench import catalogue, wire
from atalante_tools.bench.catalogue import BENCHMARKS, Benchmark
from atalante_tools.bench.measure import BenchmarkError, Effort, Measurement, median, require, timed
from atalante_tools.cli import cli

KEYS = ["name", "value", "unit", "baseline", "baseline_value", "ratio", "ratios"]
#: Target ratio of each benchmark.
TARGETS = {
    "hal_cycle": 1 / 7,
    "decode_cycle": 8.0,
    "ring_write": 0.02,
    "filter_tick": 1 / 20,
    "emulator_tick": 2.3,
    "lockstep": 1 / 10,
    "lockstep_walk_pybullet": 1 / 6,
    "lockstep_walk_mujoco": 1 / 12,
    "validate_log": 1 / 20,
    "validate_against_mdf": 1.0,
    "network_evaluation": 1.0,
    "gait_solve_cold": 1.0,
    "gait_solve_warm": 1.0,
    "library_one_process": 1.0,
    "library_two_processes": 1.0,
}


@pytest.fixture(scope="module")
def lines() -> dict[str, dict[str, Any]]:
    result = CliRunner().invoke(cli, ["bench", "--quick", "--json"])
    assert result.exit_code == 0, result.output
    return {line["name"]: line for line in map(json.loads, result.stdout.splitlines())}


@pytest.mark.long
def test_json_has_one_line_per_benchmark_in_order(lines: dict[str, dict[str, Any]]) -> None:
    names = [benchmark.name for benchmark in BENCHMARKS]
    assert list(lines) == names
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda b: b.name)
@pytest.mark.long
def test_json_line_has_the_documented_keys(benchmark: Benchmark, lines: dict[str, dict[str, Any]]) -> None:
    line = lines[benchmark.name]
    assert list(line) == KEYS
    assert (line["unit"], line["baseline"]) == (benchmark.unit, benchmark.baseline)
    for key in ("value", "baseline_value", "ratio"):
        assert math.isfinite(line[key])
        assert line[key] > 0.0
    assert line["ratio"] == pytest.approx(line["value"] / line["baseline_value"], rel=1e-12)
    assert line["ratios"] == [line["ratio"]]


def test_targets_have_the_specified_values() -> None:
    assert {b.name: b.target for b in BENCHMARKS if b.target is not None} == TARGETS


def test_selected_benchmarks_are_printed_as_a_table() -> None:
    result = CliRunner().invoke(cli, ["bench", "--quick", "ring_write", "E2E_CHECK"])
    assert result.exit_code == 0
    head, *rows = result.stdout.splitlines()
    assert head.split()[:7] == ["benchmark", "value", "baseline", "unit", "ratio", "spread", "target"]
    assert [row.split()[0] for row in rows] == ["ring_write", "e2e_check"]
    assert "0.0200" in rows[0]
    assert "ring_write (1 of 2)" in result.stderr


def test_unknown_name_is_a_usage_error_that_lists_the_names() -> None:
    result = CliRunner().invoke(cli, ["bench", "hal_cykle"])
    assert result.exit_code == 2
    assert "hal_cycle" in result.stderr
    assert "start_up" in result.stderr


def test_missed_target_is_shown_in_the_table() -> None:
    benchmark = replace(BENCHMARKS[0], target=0.5)
    assert "MISSED" in bench.row(benchmark, Measurement(0.6, 1.0))
    assert "met" in bench.row(benchmark, Measurement(0.5, 1.0))


def test_without_a_compiler_the_values_are_null(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "available", lambda: False)
    result = CliRunner().invoke(cli, ["bench", "--quick", "--json", "decode_cycle"])
    assert result.exit_code == 0
    line = json.loads(result.stdout)
    assert [line[key] for key in KEYS if key != "baseline"] == ["decode_cycle", None, "us", None, None, [None]]
    assert "not measured: install gcc" in result.stderr
    (decode,) = (b for b in BENCHMARKS if b.name == "decode_cycle")
    assert "not measured" in bench.row(decode, decode.run(Effort(quick=True)))


def test_median_of_the_processes_counts_and_the_table_shows_their_spread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    benchmark = replace(BENCHMARKS[0], processes=3)
    measured = iter([Measurement(3e-6, 20e-6), Measurement(1e-6, 10e-6), Measurement(2e-6, 10e-6)])
    monkeypatch.setattr(catalogue, "BENCHMARKS", (benchmark,))
    monkeypatch.setattr(bench, "in_new_process", lambda _: next(measured))
    result = CliRunner().invoke(cli, ["bench", "--json", benchmark.name])
    line = json.loads(result.stdout)
    assert (line["value"], line["baseline_value"]) == pytest.approx((3.0, 20.0))
    assert line["ratios"] == pytest.approx([0.1, 0.15, 0.2])
    measured = iter([Measurement(2e-6, 10e-6)] * 2 + [Measurement(1e-6, 10e-6)])
    result = CliRunner().invoke(cli, ["bench", benchmark.name])
    assert "0.2000  0.1000 to 0.2000  0.1429  MISSED" in result.stdout


def test_one_missing_time_gives_no_ratio() -> None:
    assert median([Measurement(None, 1.0), Measurement(2.0, 1.0)]).ratio is None


def test_benchmark_in_a_new_process_has_a_value_and_a_baseline(monkeypatch: pytest.MonkeyPatch) -> None:
    (e2e_check,) = (b for b in BENCHMARKS if b.name == "e2e_check")
    run, commands = subprocess.run, list[list[str]]()

    def quick(command: list[str], **options: Any) -> Any:
        commands.append(command)
        return run([*command, "--quick"], **options)

    monkeypatch.setattr(subprocess, "run", quick)
    measured = bench.in_new_process(e2e_check)
    assert commands[0][-3:] == ["--one-process", "--json", "e2e_check"]
    assert measured.ratio is not None
    assert 1e-7 < measured.value < 1e-3  # type: ignore[operator]


def test_failure_in_a_new_process_makes_the_benchmark_invalid() -> None:
    with pytest.raises(BenchmarkError, match="code 2"):
        bench.in_new_process(replace(BENCHMARKS[0], name="no such benchmark"))


def test_every_number_of_processes_is_odd() -> None:
    assert all(benchmark.processes % 2 == 1 for benchmark in BENCHMARKS)
    assert BENCHMARKS[0].processes > 1


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(_effort: Effort) -> Measurement:
        raise BenchmarkError("nothing was done")

    monkeypatch.setattr(catalogue, "BENCHMARKS", (replace(BENCHMARKS[0], run=run),))


@pytest.mark.usefixtures("idle")
def test_invalid_benchmark_exits_with_1() -> None:
    result = CliRunner().invoke(cli, ["bench", "--one-process", "hal_cycle"])
    assert result.exit_code == 1
    assert "the benchmark hal_cycle is invalid: nothing was done" in result.stderr
    assert result.stdout == ""


def test_blocks_alternate_and_the_medians_are_returned() -> None:
    order: list[str] = []
    figures = {"a": iter([9.0, 1.0, 2.0, 50.0, 3.0, 4.0]), "b": iter([9.0, 10.0, 10.0, 10.0, 99.0, 10.0])}

    def block(name: str) -> float:
        order.append(name)
        return next(figures[name])

    measured = Effort(quick=True).interleave(lambda: block("a"), lambda: block("b"))
    assert "".join(order) == "ab" * 6
    assert (measured.value, measured.baseline, measured.ratio) == (3.0, 10.0, 0.3)


def test_timed_block_runs_the_given_number_of_times() -> None:
    ran: list[int] = []
    assert timed(lambda: ran.append(1), 7)() >= 0.0
    assert len(ran) == 7


def test_failed_requirement_raises_its_message() -> None:
    require(True, "fine")
    with pytest.raises(BenchmarkError, match="the robot fell"):
        require(False, "the robot fell")
