"""Adversary of the virtual guides: its pushes stay within their limits, and it finds guides that break their promise."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.subject import Subject
from atalante_control.guide.shapes import SHAPES
from atalante_hal.robot import load_robot
from atalante_tools.cli import cli
from atalante_tools.guide import CONDITION_NAMES, promise_check
from atalante_tools.guide.episode import FEATURES, IdealLeg, Push, Setup, noise_of
from atalante_tools.guide.plant import Condition
from atalante_tools.guide.promise_check import (
    CONDITIONS,
    QUICK,
    Effort,
    Task,
    conditions_of,
    patients,
    setup_of,
    starts_of,
)
from atalante_tools.guide.results import Results
from atalante_tools.guide.robot import PushedRobot

NONE = np.zeros((2, FEATURES))


@cache
def setup() -> Setup:
    return setup_of(None, load_robot())


@cache
def controller(shape: str) -> AirwalkController:
    return setup().controller(SHAPES[shape])


def test_names_in_the_help_are_those_of_the_check():
    assert tuple(CONDITIONS) == CONDITION_NAMES


@pytest.mark.long
def test_step_without_a_push_stays_in_the_guide_and_is_repeatable():
    leg, start = IdealLeg(setup(), controller("constant"), 0.5), starts_of(setup().config, 0)[0]
    push, numbers = (
        Push(np.ones((leg.cycles + 1, 2)), NONE),
        noise_of(leg.cycles, Condition(), np.random.default_rng(0)),
    )
    plant = setup().plant(Condition())
    first, second = (leg.walk(plant, start, push, (0.0, 0.0), numbers) for _ in range(2))
    assert first.ratio < 1.0
    np.testing.assert_array_equal(first.log, second.log)


@pytest.mark.long
def test_push_stays_in_its_box_and_follows_its_feedback():
    leg, start = IdealLeg(setup(), controller("constant"), 0.5), starts_of(setup().config, 0)[3]
    feedback = np.zeros((2, FEATURES))
    feedback[0, 2], feedback[1, 1] = 1.0, 1.0  # hip along its own rate, knee along its own error
    numbers = noise_of(leg.cycles, Condition(), np.random.default_rng(0))
    walked = leg.walk(
        setup().plant(Condition()), start, Push(np.zeros((leg.cycles + 1, 2)), feedback), (1.0, 0.5), numbers
    )
    cycles = slice(1, walked.cycle)
    np.testing.assert_array_equal(np.abs(walked.log[cycles, 4:6]), np.tile([1.0, 0.5], (walked.cycle - 1, 1)))
    assert (walked.log[cycles, 4] == np.where(walked.log[cycles, 8] >= 0.0, 1.0, -1.0)).all()
    assert (walked.log[cycles, 5] == np.where(walked.log[cycles, 1] >= 0.0, 0.5, -0.5)).all()


@pytest.mark.parametrize(("shape", "xi"), [("constant", 0.0), ("constant", 0.5), ("pinched", 0.5), ("narrowing", 0.9)])
@pytest.mark.long
def test_certified_guide_keeps_its_promise_on_every_plant(shape: str, xi: float):
    verdict = promise_check.check(setup(), controller(shape), xi, Task(conditions_of(()), QUICK, seed=0)).verdict
    assert verdict.certified
    assert verdict.steps == QUICK.steps
    assert verdict.worst_ratio is not None
    assert 0.5 < verdict.worst_ratio <= 1.0
    assert not verdict.broken


@pytest.mark.parametrize("intensity", [0.0, 1.0])
@pytest.mark.parametrize(("shape", "xi"), [("constant", 0.9), ("narrowing", 0.5)])
@pytest.mark.long
def test_promise_does_not_depend_on_idealization_and_feedforward(shape: str, xi: float, intensity: float):
    one = setup_of(None, load_robot(), AirwalkConfig(idealization=intensity, feedforward=intensity))
    task = Task(conditions_of(["both"]), replace(QUICK, steps=30), seed=0)
    verdict = promise_check.check(one, one.controller(SHAPES[shape]), xi, task).verdict
    promise = controller(shape).certificate(xi).promise
    assert promise is not None
    assert (verdict.promise_hip_nm, verdict.promise_knee_nm) == (promise.hip, promise.knee)
    assert verdict.worst_ratio is not None
    assert 0.5 < verdict.worst_ratio <= 1.0


@pytest.mark.long
def test_adversary_leaves_a_guide_with_a_push_far_beyond_its_promise():
    task = Task([Condition()], QUICK, seed=0, push=(200.0, 120.0))
    verdict = promise_check.check(setup(), controller("constant"), 0.5, task).verdict
    assert verdict.worst_ratio is not None
    assert verdict.worst_ratio > 1.5
    assert verdict.broken


def test_guide_that_is_never_certified_has_no_promise():
    verdict = promise_check.check(setup(), controller("snap"), 0.5, Task([Condition()], QUICK, seed=0)).verdict
    assert not verdict.certified
    assert verdict.promise_hip_nm is None
    assert verdict.worst_ratio is None
    assert verdict.steps == 0


@pytest.mark.long
@pytest.mark.parametrize("condition", [Condition(), Condition(1.2, 1.1, noise=1e-5, loss=0.01, delay=1)], ids=str)
def test_robot_walks_under_pushes_in_every_condition(condition: Condition):
    push = Push(np.ones((setup().gait.cycles + 1, 2)), NONE)
    walk = PushedRobot(setup(), controller("constant"), 0.5).walk((1.0, 0.5), [push], condition, 3, seed=0)
    assert walk.stopped == ""
    assert len(walk.steps) == 3
    for step in walk.steps:
        assert step.log[:, 4:6].tolist() == [[1.0, 0.5]] * len(step.log)
        assert setup().gait.cycles - 2 <= len(step.log) <= setup().gait.cycles + 1


@pytest.mark.long
def test_strong_push_on_the_robot_leaves_the_guide():
    push = Push(np.ones((setup().gait.cycles + 1, 2)), NONE)
    walk = PushedRobot(setup(), controller("constant"), 0.5).walk((150.0, 0.0), [push], Condition(), 2, seed=0)
    assert walk.stopped or (walk.worst is not None and walk.worst.ratio > 1.0)


def test_patients_cover_58_to_91_kg():
    masses = [subject.patient.mass for subject in patients()]
    assert len(masses) == 12
    assert (min(masses), max(masses)) == (58.0, 91.0)


@pytest.mark.parametrize("subject", patients(), ids=str)
def test_network_has_a_gait_for_every_patient(subject: Subject):
    gait = setup_of(subject, load_robot()).gait
    assert gait.duration == subject.step_duration
    assert gait.feedforward is not None


@pytest.mark.long
def test_effort_of_a_check_adds_robot_steps_and_tightness():
    task = Task(conditions_of(["model"]), Effort(steps=20, robot_steps=2, tightness=True), seed=0)
    verdict = promise_check.check(setup(), controller("constant"), 0.5, task).verdict
    assert verdict.robot_ratio is not None
    assert verdict.left_at is None or verdict.left_at > 1.0
    assert verdict.steps > 22


# -- command ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_command_prints_the_promise_beside_the_worst_ratio(tmp_path: Path):
    picture = tmp_path / "worst.png"
    arguments = [
        "guide",
        "check",
        "--shape",
        "constant",
        "--xi",
        "0.5",
        "--condition",
        "model",
        "--quick",
        "--steps",
        "20",
    ]
    results = tmp_path / "results.md"
    done = CliRunner().invoke(cli, [*arguments, "--json", "--plot", str(picture), "--table", str(results)])
    assert done.exit_code == 0, done.stderr
    (line,) = done.stdout.splitlines()
    verdict = json.loads(line)
    assert (verdict["shape"], verdict["xi"], verdict["certified"]) == ("constant", 0.5, True)
    assert verdict["promise_hip_nm"] > 1.0
    assert verdict["promise_knee_nm"] > 0.5
    assert 0.0 < verdict["worst_ratio"] <= 1.0
    assert verdict["steps"] == 20
    assert picture.read_bytes().startswith(b"\x89PNG")
    row = results.read_text().splitlines()[-1]
    assert row.startswith(
        f"| airwalk | constant | 0.5 | {verdict['promise_hip_nm']:.1f}, {verdict['promise_knee_nm']:.1f} |"
    )


@pytest.mark.long
def test_command_states_that_the_literal_law_has_no_promise():
    arguments = ["guide", "check", "--shape", "constant", "--xi", "0.5", "--literal", "--quick", "--steps", "20"]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.stderr
    assert "no promise: the paper's literal law" in done.stderr
    assert "no push was searched, because there are no certified torques: add --push HIP KNEE" in done.stderr
    pushed = CliRunner().invoke(cli, [*arguments, "--push", "6", "3.6", "--json"])
    verdict = json.loads(pushed.stdout)
    assert not verdict["certified"]
    assert verdict["worst_ratio"] > 1.0


def test_command_with_a_push_prints_a_table():
    arguments = [
        "guide",
        "check",
        "--shape",
        "constant",
        "--xi",
        "0.95",
        "--push",
        "100",
        "60",
        "--quick",
        "--steps",
        "5",
    ]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.stderr
    head, row = done.stdout.splitlines()
    assert "left at" in head
    assert "100.00" in row


def checked_in_turn(tmp_path: Path, *more: str) -> list[str]:
    results = tmp_path / "results.jsonl"
    arguments = ["guide", "check", "--shape", "constant", "--condition", "model", "--quick", "--json"]
    done = CliRunner().invoke(cli, [*arguments, "--results", str(results), *more])
    assert done.exit_code == 0, done.stderr
    return done.stdout.splitlines()


def test_interrupted_check_is_resumed_from_its_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = checked_in_turn(tmp_path, "--steps", "5", "--xi", "0.5")
    results = tmp_path / "results.jsonl"
    assert [json.loads(line) for line in results.read_text().splitlines()[1:]] == [json.loads(line) for line in first]
    real, factors = promise_check.check, []

    def counted(setup: Setup, controller: AirwalkController, xi: float, task: Task) -> promise_check.Checked:
        factors.append(xi)
        return real(setup, controller, xi, task)

    monkeypatch.setattr(promise_check, "check", counted)
    both = checked_in_turn(tmp_path, "--steps", "5", "--xi", "0.5", "--xi", "0.75")
    assert both[:1] == first
    assert factors == [0.75]
    assert len(results.read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("{}\n", "must contain results of the task"),
        ("[", "must be a JSON object"),
        ("TASK\n{}\n", "line 2 of .* must be the verdict"),
    ],
)
@pytest.mark.long
def test_results_of_another_task_are_not_mixed_in(tmp_path: Path, content: str, error: str):
    checked_in_turn(tmp_path, "--steps", "5", "--xi", "0.5")
    results = tmp_path / "results.jsonl"
    task = results.read_text().splitlines()[0]
    results.write_text(content.replace("TASK", task))
    with pytest.raises(ValueError, match=error):
        Results(results, json.loads(task))
    arguments = ["guide", "check", "--shape", "constant", "--xi", "0.5", "--quick", "--results", str(results)]
    done = CliRunner().invoke(cli, [*arguments, "--steps", "6"])
    assert done.exit_code == 1
    assert "results.jsonl" in done.stderr


@pytest.mark.parametrize("end", [0, 9, -20, -1])
@pytest.mark.long
def test_line_that_a_killed_check_cut_off_is_checked_again(end: int, tmp_path: Path):
    first = checked_in_turn(tmp_path, "--steps", "5", "--xi", "0.5")
    results = tmp_path / "results.jsonl"
    whole = results.read_text()
    task = json.loads(whole.splitlines()[0])
    cut = whole[:end]
    results.write_text(cut)
    kept = Results(results, task)
    assert results.read_text() == cut[: cut.rfind("\n") + 1]
    for line in first:
        verdict = promise_check.Verdict(**json.loads(line))
        if kept.find((verdict.gait, verdict.shape, verdict.xi)) is None:
            kept.add(verdict)
    assert results.read_text() == whole


def test_results_file_without_text_is_named_in_the_error(tmp_path: Path):
    results = tmp_path / "a.jsonl"
    results.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"a\.jsonl must be text in UTF-8"):
        Results(results, {})


def test_picture_cannot_be_drawn_from_results(tmp_path: Path):
    arguments = ["guide", "check", "--results", str(tmp_path / "a.jsonl"), "--plot", str(tmp_path / "a.png")]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 2
    assert "--plot" in done.stderr
