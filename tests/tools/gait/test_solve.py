"""Tests of `atalante gait solve`: output, files and errors."""

from __future__ import annotations

import builtins
import json
import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from PIL import Image

from atalante_control.dynamics.gait_network import DEFAULT_NETWORK
from atalante_control.gait.gait import load_gait
from atalante_control.gait.walk import load_walk
from atalante_control.gait_optimization import solve
from atalante_hal.robot import JOINTS, load_robot
from atalante_tools.cli import cli
from atalante_tools.gait.figures import draw_animation

PATIENT = ["--mass", "75", "--height", "175"]


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["gait", "solve", *arguments])


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    folder = tmp_path_factory.mktemp("gait")
    files = ["--out", str(folder / "gait.json"), "--plot", str(folder / "gait.png")]
    return run(*PATIENT, "--step-length", "0.16", "--step-duration", "0.8", "--json", *files), folder


def test_json_is_one_object_with_the_documented_keys(result: tuple[Result, Path]) -> None:
    outcome, _ = result
    assert outcome.exit_code == 0, outcome.output
    [line] = map(json.loads, outcome.stdout.splitlines())
    assert list(line)[:6] == ["status", "solve_s", "max_residual", "step_length", "step_duration", "peak_torque"]
    assert line["status"] == "solved"
    assert 0.0 <= line["max_residual"] < 1e-6
    assert (line["step_length"], line["step_duration"]) == (0.16, 0.8)
    assert line["peak_torque"] == max(line["peak_torques"].values())
    assert list(line["peak_torques"]) == list(JOINTS)
    assert "iterations" in outcome.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_during_optimisation_exits_with_its_code(
    monkeypatch: pytest.MonkeyPatch, number: int, code: int
) -> None:
    class Unsolved:
        solved, status, iterations = False, "no such gait: the impact map cannot hold", 0

    def optimise(*_: object, **__: object) -> Unsolved:
        """Discard the exception that the signal raises and return no solution, as CasADi does."""
        with suppress(KeyboardInterrupt, SystemExit):
            os.kill(os.getpid(), number)
        return Unsolved()

    monkeypatch.setattr("atalante_control.gait_optimization.solve.solve", optimise)
    outcome = run(*PATIENT)
    assert outcome.exit_code == code
    assert "no such gait" not in outcome.stderr


def test_controller_loads_the_written_gait(result: tuple[Result, Path]) -> None:
    gait = load_gait(result[1] / "gait.json", load_robot())
    assert gait.duration == 0.8
    assert gait.parameters["patient_mass"] == 75.0
    assert gait.feedforward is not None


@pytest.mark.long
def test_plot_and_animation_are_written(result: tuple[Result, Path], tmp_path: Path) -> None:
    from atalante_control.model import Patient

    with Image.open(result[1] / "gait.png") as picture:
        assert picture.width > 800
    gait = load_gait(result[1] / "gait.json", load_robot())
    draw_animation(gait, Patient(75.0, 1.75), tmp_path / "gait.gif")
    with Image.open(tmp_path / "gait.gif") as animation:
        assert animation.n_frames == 21  # 25 frames per second over 0.8 s, with the first and the last frame


@pytest.mark.long
def test_text_output_has_torques_residuals_and_verification() -> None:
    outcome = run(*PATIENT, "--kind", "stop")
    assert outcome.exit_code == 0, outcome.output
    for text in ("stance Nm", "centre of pressure across the sole", "by Pinocchio", "speed at rest"):
        assert text in outcome.stdout
    assert "FAIL" not in outcome.stdout


@pytest.mark.sample(2)
@pytest.mark.parametrize("network", [[], ["--network", str(DEFAULT_NETWORK)]], ids=["solver", "network"])
def test_walk_is_one_file_with_three_verified_steps(tmp_path: Path, network: list[str]) -> None:
    outcome = run(*PATIENT, "--kind", "walk", *network, "--out", str(tmp_path / "walk.json"), "--json")
    assert outcome.exit_code == 0, outcome.output
    kinds = [json.loads(line)["kind"] for line in outcome.stdout.splitlines()]
    assert kinds == (["start", "stop"] if network else ["periodic", "start", "stop"])
    walk = load_walk(tmp_path / "walk.json", load_robot())
    assert [gait.kind for gait in walk] == ["start", "periodic", "stop"]
    assert walk.step.solver["method"] == ("gait network" if network else "periodic step, IPOPT: Solve_Succeeded")


def test_infeasible_gait_gives_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    # Fewer iterations than the default of 150 end the infeasible problem sooner.
    monkeypatch.setitem(solve._OPTIONS, "ipopt.max_iter", 15)
    outcome = run(*PATIENT, "--step-length", "0.4", "--step-duration", "0.4", "--json")
    assert outcome.exit_code == 1
    assert json.loads(outcome.stdout)["status"] != "solved"
    assert outcome.stderr.strip().splitlines()[-1].startswith("atalante: no such gait for 75 kg, 1.75 m")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "--mass and --height"),
        (["--mass", "75"], "--mass and --height"),
        ([*PATIENT, "--step-length", "3"], "step length must be 0.05 to 0.4 m, got 3 m"),
        ([*PATIENT, "--step-duration", "0.8005"], "whole number of milliseconds"),
        ([*PATIENT, "--kind", "hop"], "periodic"),
        ([*PATIENT, "--network", str(DEFAULT_NETWORK)], "--network requires --kind walk"),
        ([*PATIENT, "--kind", "walk", "--plot", "walk.png"], "--plot and --animate show a single step"),
    ],
)
def test_invalid_options_are_usage_errors(arguments: list[str], sentence: str) -> None:
    outcome = run(*arguments)
    assert outcome.exit_code == 2
    assert sentence in outcome.stderr


def test_missing_casadi_gives_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def absent(name: str, *arguments: Any, **keywords: Any) -> Any:
        if name.startswith("atalante_control.gait_optimization.solve"):
            raise ModuleNotFoundError("No module named 'casadi'", name="casadi")
        return real(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", absent)
    outcome = run(*PATIENT)
    assert outcome.exit_code == 1
    assert "pip install 'atalante-hal[gaits]'" in outcome.stderr
