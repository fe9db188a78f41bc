"""Exhaustive search over all sequences of inputs: every property holds, and each property broken on purpose is found."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from atalante_emulator import drive as emulated
from atalante_emulator.pendant import Request
from atalante_hal.safety import safety_monitor
from atalante_hal.safety.safety_monitor import SafetyMonitor
from atalante_hal.safety.start import ENABLE_CYCLES
from atalante_hal.safety.state_machine import next_state
from atalante_hal.types import SupervisorState
from atalante_hal.wire import cia402
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.e2e import FULL, REQUALIFY, Qualification, qualify
from atalante_tools.faults.reachability import hal_steps, replay, report
from atalante_tools.faults.reachability.drive_steps import LATCH_PROPERTY, WATCHDOG_PROPERTY, DriveSteps
from atalante_tools.faults.reachability.explorations import (
    MOVE_PROPERTY,
    RESTART_PROPERTY,
    STOP_PROPERTY,
    OperatorPath,
)
from atalante_tools.faults.reachability.report import SEARCHES, search
from atalante_tools.faults.reachability.search import Exploration
from atalante_tools.faults.runner import observe
from atalante_tools.faults.verdict import automatic_improvements

S = SupervisorState
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "reachability.md"


@pytest.fixture(scope="module")
def path() -> OperatorPath:
    """Path of the unchanged HAL. A change of what the HAL decides does not change how it receives the frames of the pendant."""
    return OperatorPath()


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.long
def test_no_sequence_of_inputs_breaks_a_property(name: str, path: OperatorPath):
    found = search(name, path)
    assert found.broken == "", found.trace
    figures = re.search(rf"^\| {name} \| (\d+) \| (\d+) \|", PAGE.read_text(), re.MULTILINE)
    assert figures
    for stated, counted in zip(figures.groups(), (found.states, found.transitions), strict=True):
        assert counted / 2 < int(stated) < counted * 2  # the page is updated after a large change


def test_report_has_one_row_for_each_search(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(report, "search", lambda name, path: Exploration(2, 3, "", ()))
    report.main()
    rows = capsys.readouterr().out.splitlines()
    assert rows[0] == "| search | states | transitions | properties |"
    assert [row.split(" | ")[:3] for row in rows[2:]] == [[f"| {name}", "2", "3"] for name in SEARCHES]


def test_report_ends_with_the_trace_of_a_violation(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    violated = Exploration(2, 3, LATCH_PROPERTY, (("press", "READY"), ("release", "ACTIVE")))
    monkeypatch.setattr(report, "search", lambda name, path: violated)
    with pytest.raises(SystemExit, match="1"):
        report.main()
    printed = capsys.readouterr().out
    assert f"violated: {LATCH_PROPERTY}\ncycle 1: press\n  -> READY\ncycle 2: release\n  -> ACTIVE\n" in printed


# -- broken on purpose ------------------------------------------------------------------------------------------------


def test_restart_without_start_is_found_and_its_scenario_shows_it(path: OperatorPath, monkeypatch: pytest.MonkeyPatch):
    def restarts(state, conditions):
        if state is S.HOLD:
            conditions = replace(conditions, start_wanted=True, drives_enabled=True)
        return next_state(state, conditions)

    monkeypatch.setattr(safety_monitor, "next_state", restarts)
    found = OperatorPath(path).moves()
    assert found.broken == RESTART_PROPERTY
    run = observe(replay.case_of([cycle for cycle, _ in found.trace]), 5, recovery=False)
    assert automatic_improvements(run, run.last)


@pytest.mark.long
def test_ignored_dead_man_is_found_and_its_scenario_shows_it(path: OperatorPath, monkeypatch: pytest.MonkeyPatch):
    def ignores(state, conditions):
        return next_state(state, replace(conditions, dead_man=True, stop_requested=False))

    monkeypatch.setattr(safety_monitor, "next_state", ignores)
    found = OperatorPath(path).stops()
    assert found.broken == STOP_PROPERTY
    run = observe(replay.case_of([cycle for cycle, _ in found.trace]), 5, recovery=False)
    assert run.state(run.last) is S.ACTIVE
    assert (run.drive_state[-1] == DriveState.OPERATION_ENABLED).all()


@pytest.mark.long
def test_second_move_of_a_start_is_found(path: OperatorPath, monkeypatch: pytest.MonkeyPatch):
    enter = SafetyMonitor._enter

    def keeps(self, before, after, reasons):
        wanted = self.start_cycles_left
        enter(self, before, after, reasons)
        self.start_cycles_left = wanted

    monkeypatch.setattr(SafetyMonitor, "_enter", keeps)
    assert OperatorPath(path).moves().broken in (MOVE_PROPERTY, RESTART_PROPERTY)


@pytest.mark.long
def test_late_watchdog_is_found_and_its_scenario_shows_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(emulated, "WATCHDOG", 8)
    found = DriveSteps().search()
    assert found.broken == WATCHDOG_PROPERTY
    run = observe(replay.drive_case_of(found.trace), 5, recovery=False)
    row = run.first - 1 + 5  # the sixth cycle without command
    assert run.drive_state[row, 0] == DriveState.OPERATION_ENABLED


@pytest.mark.long
def test_released_latch_is_found(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(emulated, "next_state", lambda state, word, *, latched: cia402.next_state(state, word))
    assert DriveSteps().search().broken in (LATCH_PROPERTY, WATCHDOG_PROPERTY)


def test_a_decision_does_not_depend_on_earlier_pendant_frames():
    steps = hal_steps.HalSteps()
    before = hal_steps.Supervision(S.ACTIVE, hal_steps.NO_START, enabling=True)
    inputs, environment = hal_steps.Inputs(True, 0, False), hal_steps.Environment(walking=True)
    expected = list(steps.decide(before, inputs, environment))
    frame = hal_steps.PendantFrame(0, True, Request.START, False)
    for dead_man, request, rogue, stored in product((True, False), Request, (True, False), (True, False)):
        received = hal_steps.Reception(dead_man=dead_man, request=request, rogue=rogue, stored=stored)
        steps.receive(received, (frame, frame))  # each doubled frame fills the leaky bucket of the HAL
    assert list(steps.decide(before, inputs, environment)) == expected


# -- abstraction ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trusted", [False, True])
def test_two_qualifications_have_all_results_of_every_qualification(trusted: bool):
    every = [Qualification(bucket, good, trusted) for bucket in range(FULL) for good in range(REQUALIFY)]
    chosen = hal_steps.QUALIFICATIONS[trusted]
    for good, timed_out in product((False, True), repeat=2):
        results = {qualify(before, good=good, timed_out=timed_out).trusted for before in every}
        assert results == {qualify(before, good=good, timed_out=timed_out).trusted for before in chosen}


def test_every_number_of_cycles_left_has_the_result_of_the_chosen_one():
    steps, inputs = hal_steps.HalSteps(), hal_steps.Inputs(True, 0, False)
    for state, ready in product((S.READY, S.HOLD, S.LOWER, S.FAULT, S.FULL_ASSIST), (False, True)):
        before = hal_steps.Supervision(state, hal_steps.START)
        environment = hal_steps.Environment(enabled=False, nodes_ready=ready)
        expected = {decision.after.supervisor for decision in steps.decide(before, inputs, environment)}
        for left in (2, 3, 57, ENABLE_CYCLES - 1, ENABLE_CYCLES):
            with pytest.MonkeyPatch.context() as patch:
                patch.setitem(hal_steps.START_CYCLES, hal_steps.START, left)
                assert {d.after.supervisor for d in steps.decide(before, inputs, environment)} == expected
