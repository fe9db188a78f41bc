"""Tests of the fit of the gait network and its check, on synthetic gaits that are known for every subject."""

from __future__ import annotations

import math
import os
import signal
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from atalante_control.dynamics.gait_network import inputs_of, load_network, periodicity, subject_of
from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization import fit as fit_module
from atalante_control.gait_optimization import library as library_module
from atalante_control.gait_optimization.fit import FitError, fit, inputs
from atalante_control.gait_optimization.library import Grid, Library
from atalante_control.gait_optimization.network_error import Deviation, deviation, findings, random_subjects
from atalante_control.gait_optimization.result import SOLVED, SolvedGait
from atalante_control.gait_optimization.solve import code_version
from atalante_control.model import Patient
from atalante_hal.robot import load_robot
from atalante_tools.cli import cli

ROBOT = load_robot()
AIRWALK = load_gait(AIRWALK_GAIT, ROBOT)
GRID = Grid(size=160)
LOW, HIGH = (np.array([axis[end] for axis in GRID.axes()]) for end in (0, -1))
_, _, _RIGHT = np.linalg.svd(periodicity())
#: Periodic directions in which the synthetic gaits differ.
DIRECTIONS = np.random.default_rng(8).normal(size=(6, 72)) @ _RIGHT[24:] * 0.004


def synthetic(subject: Subject) -> SolvedGait:
    mass, height, length, duration, thigh, shank = (2.0 * (inputs_of(subject) - LOW) / (HIGH - LOW) - 1.0).tolist()
    share = np.array(
        [
            mass,
            height + 0.3 * height * length,
            length,
            duration + 0.2 * mass**2,
            math.sin(duration),
            thigh - shank + 0.2 * thigh * height,
        ]
    )
    coefficients = AIRWALK.coefficients + (share @ DIRECTIONS).reshape(12, 8)
    feedforward = stance_dynamics(ROBOT, subject.patient).feedforward(coefficients, subject.step_duration)
    gait = Gait(
        str(subject), subject.step_duration, coefficients, feedforward * 0.1, subject.parameters(),
        {"status": SOLVED, "version": code_version()},
    )  # fmt: skip
    return SolvedGait(gait, SOLVED, 1e-9, 0.01, 10)


@pytest.fixture(scope="module")
def gaits() -> list[Gait]:
    return [synthetic(GRID.subject(index)).gait for index in GRID.points()]


@pytest.mark.long
def test_fit_generalizes_to_subjects_off_the_grid(gaits: list[Gait]) -> None:
    fitted = fit(gaits, GRID, hidden=(16,), iterations=1500)
    assert fitted.directions <= len(DIRECTIONS) + 1
    assert np.degrees(fitted.rms) < 0.01
    assert fitted.worst >= fitted.rms
    for subject in random_subjects(LOW, HIGH, 30, seed=1):
        error = fitted.network.coefficients(inputs_of(subject)) - synthetic(subject).gait.coefficients
        assert np.degrees(np.abs(error).max()) < 0.2


def test_same_library_gives_the_same_network(gaits: list[Gait]) -> None:
    first = fit(gaits, GRID, hidden=(6,), iterations=40).network
    again = fit(gaits, GRID, hidden=(6,), iterations=40).network
    for one, other in zip(first.layers, again.layers, strict=True):
        np.testing.assert_array_equal(one.weights, other.weights)
        np.testing.assert_array_equal(one.bias, other.bias)
    np.testing.assert_array_equal(first.low, LOW)
    np.testing.assert_array_equal(first.high, HIGH)


def test_range_of_the_network_is_the_range_of_its_gaits() -> None:
    low, high = [58.0, 1.62, 0.1, 0.7, 0.94, 0.94], [65.0, 1.69, 0.12, 0.74, 1.0, 1.06]
    subjects = [Subject(Patient(58.0, 1.62), 0.1, 0.7), *map(subject_of, (low, high))]
    network = fit([synthetic(subject).gait for subject in subjects], GRID, hidden=(2,), iterations=1).network
    assert (network.low.tolist(), network.high.tolist()) == (low, high)


@pytest.mark.parametrize(
    ("inputs", "sentence"),
    [
        ([], "a gait network must be fitted to at least two gaits, got 0"),
        (
            2 * [[58.0, 1.62, 0.1, 0.7, 1.0, 1.0]],
            "mass must have at least two values in the gaits, got 58 in all gaits",
        ),
        (
            [[58.0, 1.62, 0.1, 0.7, 0.95, 0.95], [65.0, 1.69, 0.12, 0.74, 1.0, 1.0]],
            "the gaits of different subjects must differ, got 2 equal gaits",
        ),
    ],
)
def test_fit_to_too_few_or_equal_gaits_is_rejected(inputs: list[list[float]], sentence: str) -> None:
    subjects = list(map(subject_of, inputs))
    with pytest.raises(FitError, match=f"^{sentence}$"):
        fit([replace(AIRWALK, parameters=subject.parameters()) for subject in subjects], GRID)


def test_inputs_are_the_parameters_of_the_subject() -> None:
    patient = Patient(70.0, 1.7, thigh_length=1.02 * 0.245 * 1.7)
    gait = synthetic(Subject(patient, 0.12, 0.9)).gait
    np.testing.assert_allclose(inputs(gait), [70.0, 1.7, 0.12, 0.9, 1.02, 1.0], rtol=1e-12)


def test_deviation_of_a_gait_from_itself_is_zero() -> None:
    subject = Subject(Patient(70.0, 1.7), 0.12, 0.9)
    gait = synthetic(subject).gait
    found = deviation(subject, gait, gait, ROBOT)
    assert found.angles.shape == (901, 12)
    assert not found.angles.any()
    assert (found.landing_position, found.feedforward) == (0.0, 0.0)
    assert found.landing_attitude < 1e-9
    assert found.speed_defect < 0.01
    assert found.within_limits


def test_deviation_equals_the_applied_change() -> None:
    """A change of the swing ankle only turns the landing foot. A change of the knee turns and moves the landing foot."""
    subject = Subject(Patient(70.0, 1.7), 0.12, 0.9)
    gait = synthetic(subject).gait
    for joint, attitude, position in ((4, 0.01, 0.0), (3, 0.01, 0.01 * subject.patient.length("shank"))):
        bent = gait.coefficients.copy()
        bent[joint] += 0.01
        found = deviation(subject, replace(gait, coefficients=bent), gait, ROBOT)
        assert found.angles.max() == pytest.approx(0.01)
        assert found.landing_attitude == pytest.approx(attitude, rel=1e-6)
        assert found.landing_position == pytest.approx(position, rel=0.1, abs=1e-12)
        assert found.position_defect == pytest.approx(0.01, rel=1e-6)
    assert not deviation(subject, replace(gait, coefficients=gait.coefficients + 0.5), gait, ROBOT).within_limits


def test_findings_are_the_largest_deviations_in_degrees_and_millimetres() -> None:
    good = Deviation(np.zeros((100, 12)), 0.0, 0.0, 0.0, 0.0, 0.0, True)
    bad = Deviation(
        np.full((100, 12), math.radians(2.0)), 0.004, math.radians(0.4), math.radians(0.2), 0.03, 0.06, False
    )
    assert all(finding.ok for finding in findings([good, good]))
    found = findings([good, bad])
    assert not any(finding.ok for finding in found)
    assert [finding.value for finding in found] == pytest.approx([2.0, 2.0, 4.0, 0.4, 0.2, 0.03, 6.0, 1.0])


def test_random_subjects_are_off_the_grid_and_repeatable() -> None:
    subjects = list(random_subjects(LOW, HIGH, 20, seed=3))
    assert subjects == list(random_subjects(LOW, HIGH, 20, seed=3))
    assert all(subject.patient.mass not in GRID.mass for subject in subjects)


#: Options of a library of 81 gaits: the corners of the grid and 17 other points.
SMALL = (
    "--mass",
    "60,70,80",
    "--height",
    "1.6,1.7,1.8",
    "--step-length",
    "0.1,0.15,0.2",
    "--step-duration",
    "0.8,0.9,1.0",
    "--size",
    "81",
)


class TestCommand:
    """Tests of `atalante gait library`, `fit` and `check`."""

    @staticmethod
    def run(*arguments: str) -> Any:
        return CliRunner().invoke(cli, ["gait", *arguments])

    @pytest.mark.long
    def test_library_fit_and_check_run_in_sequence(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
        monkeypatch.setattr(library_module, "solve_subject", synthetic)
        monkeypatch.setattr(fit_module, "fit", partial(fit, hidden=(8,), iterations=800))
        folder, file = tmp_path / "library", tmp_path / "network.npz"
        levels = [
            f"--{name.replace('_', '-')}={','.join(map(str, axis))}"
            for name, axis in zip(GRID.names(), GRID.axes(), strict=True)
        ]
        levels.append(f"--size={GRID.size}")
        made = self.run("library", "--out", str(folder), "--json", *levels)
        assert made.exit_code == 0, made.output
        assert len(made.stdout.splitlines()) == 160
        assert "160 of 160 gaits solved" in made.stderr
        again = self.run("library", "--out", str(folder), *levels)
        assert "160 of them already solved" in again.stderr
        next(folder.glob("gaits/*.json")).write_text("{")
        assert "1 gait files are rejected" in self.run("fit", "--library", str(folder), "--out", str(file)).stderr
        repaired = self.run("library", "--out", str(folder), *levels)
        assert "159 of them already solved" in repaired.stderr
        assert "1 gait files are rejected, for example" in repaired.stderr
        fitted = self.run("fit", "--library", str(folder), "--out", str(file), "--json")
        assert fitted.exit_code == 0, fitted.output
        assert load_network(file).low.tolist() == LOW.tolist()
        checked = self.run("check", "--network", str(file), "--count", "5")
        # The synthetic gaits ignore the ground: their feedforward is scaled, and the true feedforward exceeds the limits.
        assert checked.exit_code == 1
        assert [line.split()[-1] for line in checked.stdout.splitlines()[1:]] == ["ok"] * 6 + ["FAIL"] * 2

    def test_failures_are_listed_and_exit_with_1(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
        def fails(subject: Subject) -> SolvedGait:
            done = synthetic(subject)
            return replace(done, status="the swing clearance cannot hold") if subject.step_length == 0.2 else done

        monkeypatch.setattr(library_module, "solve_subject", fails)
        result = self.run("library", "--out", str(tmp_path), *SMALL)
        assert result.exit_code == 1
        failures = Library(tmp_path).failures()
        assert 20 < len(failures) < 81
        assert result.stderr.count("failed: ") == len(failures)
        assert "the swing clearance cannot hold" in result.stderr

    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
    def test_interrupted_library_reports_its_progress_and_resumes(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Any, number: int, code: int
    ) -> None:
        def signalled(subject: Subject) -> SolvedGait:
            """Turn an exception into a failed gait, as CasADi does."""
            try:
                os.kill(os.getpid(), number)
            except (KeyboardInterrupt, SystemExit):
                return replace(synthetic(subject), status="the impact map cannot hold")
            return synthetic(subject)

        monkeypatch.setattr(library_module, "solve_subject", signalled)
        small = ("library", "--out", str(tmp_path), *SMALL)
        result = self.run(*small)
        assert result.exit_code == code
        assert result.stderr.splitlines()[-1] == "interrupted, 1 of 81 gaits solved; repeat the command to resume"
        assert Library(tmp_path).failures() == {}
        fit = self.run("fit", "--library", str(tmp_path), "--out", str(tmp_path / "network.npz"))
        assert fit.exit_code == 1
        assert f"{tmp_path} must contain at least two solved gaits, got 1" in fit.stderr
        monkeypatch.setattr(library_module, "solve_subject", synthetic)
        assert self.run(*small).exit_code == 0
        assert len(list(tmp_path.glob("gaits/*.json"))) == 81

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["library", "--out", "x", "--mass", "60,70"], "mass must have at least 3 levels, got"),
            (
                ["library", "--out", "x", "--mass", "60,a"],
                "levels must be numbers separated by commas (58,75,91), got '60,a'",
            ),
            (["library", "--out", "x", "--height", "1.62,175"], "height must have at least 3 levels, got [1.62, 1.75]"),
            (["library", "--out", "x", "--step-length", "10,0.2"], "levels, got [0.1, 0.2]"),
            (["fit", "--library", "nowhere", "--out", "x.npz"], "nowhere contains no library"),
            (["check", "--network", "nowhere.npz"], "nowhere.npz"),
        ],
    )
    def test_invalid_input_gives_one_sentence(
        self, arguments: list[str], sentence: str, tmp_path: Any, monkeypatch: Any
    ) -> None:
        monkeypatch.chdir(tmp_path)
        result = self.run(*arguments)
        assert result.exit_code in (1, 2)
        assert sentence in result.stderr
        assert "Traceback" not in result.stderr
