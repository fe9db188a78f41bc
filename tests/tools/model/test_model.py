"""Tests of `atalante model`: table, checks, URDF, picture and errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from atalante_control.model import ExoskeletonParameters, Link, Patient, exoskeleton, links, urdf
from atalante_hal.robot import load_robot
from atalante_tools.cli import cli
from atalante_tools.model import checks as checks_module


def model(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["model", *arguments])


def objects(result: Result) -> list[dict[str, Any]]:
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_link_masses_add_up_and_every_check_passes() -> None:
    output = objects(model("--mass", "75", "--height", "175", "--json"))
    bodies = [line for line in output if "link" in line]
    assert [body["link"] for body in bodies] == [link.name for link in links(ExoskeletonParameters())]
    assert sum(body["mass"] for body in bodies) == pytest.approx(82.5 + 75.0, abs=1e-12)
    assert {line["check"]: line["ok"] for line in output if "check" in line} == {
        "mass": True, "mirror": True, "inertias": True, "engines": True,
    }  # fmt: skip


def test_lengths_in_metres_and_centimetres_give_the_same_model() -> None:
    metres = model("--mass", "75", "--height", "1.75", "--thigh", "0.44", "--shank", "0.41")
    assert metres.exit_code == 0
    assert metres.stdout == model("--mass", "75", "--height", "175", "--thigh", "44", "--shank", "41").stdout
    assert "157.5 kg: exoskeleton 82.5, patient 75" in metres.stdout


def test_model_without_patient_has_the_mass_of_the_exoskeleton() -> None:
    assert "82.5 kg: exoskeleton 82.5, patient 0" in model().stdout


def test_urdf_and_picture_are_written(tmp_path: Path) -> None:
    text, picture = tmp_path / "worn.urdf", tmp_path / "worn.png"
    result = model("--mass", "60", "--height", "1.7", "--urdf", str(text), "--show", str(picture))
    assert result.exit_code == 0
    assert text.read_text() == urdf(ExoskeletonParameters(), load_robot(), Patient(60.0, 1.7))
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_show_without_file_writes_model_png(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "picture in model.png" in model("--show").stderr
    assert (tmp_path / "model.png").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--mass", "30", "--height", "175"], "mass of the patient must be 45 to 110 kg, got 30 kg"),
        (["--mass", "75", "--height", "1.2"], "height of the patient must be 1.5 to 2 m, got 1.2 m"),
        (["--mass", "75", "--height", "175", "--thigh", "80"], "thigh length of the patient must be 0.3 to 0.55 m"),
        (["--mass", "75"], "a patient requires both --mass and --height"),
        (["--thigh", "40"], "a patient requires both --mass and --height"),
    ],
)
def test_patient_out_of_range_is_rejected_with_the_range(arguments: list[str], sentence: str) -> None:
    result = model(*arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr


def test_asymmetric_model_fails_the_mirror_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def asymmetric(parameters: ExoskeletonParameters, patient: Patient | None = None) -> tuple[Link, ...]:
        bodies = exoskeleton.links(parameters, patient)
        heavier = replace(bodies[3].inertia, mass=bodies[3].inertia.mass + 1.0)
        return (*bodies[:3], replace(bodies[3], inertia=heavier), *bodies[4:])

    monkeypatch.setattr(checks_module, "links", asymmetric)
    result = model("--mass", "75", "--height", "175")
    assert result.exit_code == 1
    assert "FAIL  mirror: left_frontal_hip must mirror its right counterpart, but differs" in result.stdout
    assert "the model is inconsistent: mirror" in result.stderr


def test_disagreeing_dynamics_engines_fail_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks_module, "AGREEMENT", 1e-20)
    assert "FAIL  engines" in model().stdout
