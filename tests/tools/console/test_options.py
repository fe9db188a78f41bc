"""Shared options: ranges, seeds, output files and steps of a patient."""

from __future__ import annotations

import errno
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from atalante_tools.cli import cli
from atalante_tools.console.options import OutputFile

PATIENT = ("--mass", "75", "--height", "175")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["demo", "--xi", "nan"], "'--xi': must be a number, got nan"),
        (["airwalk", "--xi", "nan"], "'--xi': must be a number, got nan"),
        (["emulator", "-i", "pcan", "-c", "x", "--xi", "nan"], "'--xi': must be a number, got nan"),
        (["vibrate", "left_thigh_front", "nan"], "'LEVEL': must be a number, got nan"),
        (["vibrate", "left_thigh_front", "0.3", "--for", "nan"], "'--for': must be a number, got nan"),
        (["pendant", "xi", "nan", "-i", "pcan", "-c", "x"], "'X': must be a number, got nan"),
        (["status", "-i", "pcan", "-c", "x", "--for", "nan"], "'--for': must be a number, got nan"),
        (["validate", "-i", "pcan", "-c", "x", "--for", "nan"], "'--for': must be a number, got nan"),
        (["conform", "LEFT_SK", "--torque", "nan"], "'--torque': must be a number, got nan"),
        (["dbc", "busload", "--limit", "nan"], "'--limit': must be a number, got nan"),
        (["demo", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["airwalk", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["jog", "left_SK", "--to", "5", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["emulator", "-i", "pcan", "-c", "x", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["doctor", "--for", "3"], "--for requires a measurement: add --bus"),
        (["dbc", "c-code", "-o", "none", "--images", "9"], "--images requires a comparison: add --check"),
        (["conform", "LEFT_SK", "--patience", "9"], "--patience requires a CAN bus"),
        (
            ["jog", "LEFT_SK", "--to", "5", "--engine", "mujoco", "-i", "socketcan", "-c", "x"],
            "--engine requires the emulated robot",
        ),
        (
            ["jog", "LEFT_SK", "--to", "5", "--seed", "1", "-i", "socketcan", "-c", "x"],
            "--seed requires the emulated robot",
        ),
        (["airwalk", "--seed", "1", "-i", "socketcan", "-c", "x"], "--seed requires the emulated robot"),
        (["gait", "check", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["dbc", "c-code", "-o", "never", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["demo", *PATIENT, "--step-length", "0"], "step length must be 0.05 to 0.4 m, got 0 m"),
        (["demo", *PATIENT, "--step-duration", "0"], "step duration must be"),
        (
            ["emulator", "-i", "virtual", "-c", "x"],
            "virtual works inside one process only: use a CAN FD adapter, or Linux vcan",
        ),
        (["status", "-i", "gs_usb", "-c", "0"], "gs_usb supports classic CAN only in python-can"),
        (
            ["airwalk", "-i", "udp_multicast", "-c", "239.74.163.2"],
            "udp_multicast returns every sent frame to its sender",
        ),
        (["model", "--show", "model.xyz"], "must end in .png or .svg or .pdf, got model.xyz"),
        (["gait", "solve", *PATIENT, "--plot", "gait.xyz"], "must end in .png or .svg or .pdf, got gait.xyz"),
        (["gait", "solve", *PATIENT, "--animate", "gait.png"], "must end in .gif, got gait.png"),
        (
            ["gait", "solve", *PATIENT, "--out", "no/gait.json"],
            "must be in an existing folder, got no/gait.json: create the folder no",
        ),
        (
            ["gait", "fit", "--library", ".", "--out", "no/network.npz"],
            "must be in an existing folder, got no/network.npz: create the folder no",
        ),
        (
            ["model", "--urdf", "no/model.urdf"],
            "must be in an existing folder, got no/model.urdf: create the folder no",
        ),
        (
            ["validate", "some.log", "--html", "no/some.html"],
            "must be in an existing folder, got no/some.html: create the folder no",
        ),
    ],
)
def test_an_invalid_option_value_is_rejected_before_any_work(arguments: list[str], sentence: str) -> None:
    result = CliRunner().invoke(cli, arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["gait", "solve", *PATIENT], "--out=/proc/gait.json"),
        (["gait", "solve", *PATIENT], "--plot=/proc/gait.png"),
        (["gait", "fit", "--library", "none"], "--out=/proc/network.npz"),
        (["guide", "check", "--quick"], "--table=/proc/table.md"),
        (["guide", "check", "--quick"], "--results=/proc/results.jsonl"),
        (["validate", "none.log"], "--html=/proc/report.html"),
    ],
)
def test_output_file_in_a_folder_that_cannot_be_written_is_rejected(arguments: list[str], option: str) -> None:
    result = CliRunner().invoke(cli, [*arguments, option])
    assert (result.exit_code, result.stdout) == (2, "")
    name, path = option.split("=")
    assert f"'{name}': must be in a writable folder, got {path}: No such file or directory" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["gait", "solve", *PATIENT, "--plot=gait.png"],
        ["gait", "solve", *PATIENT, "--animate=gait.gif"],
        ["guide", "check", "--quick", "--plot=guide.png"],
        ["model", "--show=model.png"],
    ],
)
def test_picture_without_matplotlib_is_rejected_before_any_work(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = CliRunner().invoke(cli, arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    remedy = "install it with `pip install 'atalante-hal[plot]'`"
    assert result.stderr == f"atalante: a picture needs the package matplotlib: {remedy}\n"


def test_existing_output_file_that_cannot_be_written_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "gait.json"
    file.write_text("old")
    monkeypatch.setattr("os.access", lambda path, mode, **options: str(path) != str(file))  # root may write any file
    result = CliRunner().invoke(cli, ["gait", "solve", *PATIENT, "--out", str(file)])
    assert result.exit_code == 2
    assert f"'--out': File '{file}' is not writable" in result.stderr
    assert file.read_text() == "old"


def test_accepted_output_file_is_not_created_by_the_check(tmp_path: Path) -> None:
    assert OutputFile(".json").convert(str(tmp_path / "gait.json"), None, None) == tmp_path / "gait.json"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments", [["faults", "campaign", "F56"], ["trial", "shapes", "--quick"], ["demo"]], ids=lambda words: words[0]
)
def test_output_folder_that_cannot_be_written_is_rejected_before_the_run(arguments: list[str]) -> None:
    result = CliRunner().invoke(cli, [*arguments, "--out", "/proc"])
    assert result.exit_code == 1
    assert result.stderr == "atalante: /proc cannot be read or written: No such file or directory\n"


def test_library_in_a_folder_that_cannot_be_written_starts_no_gait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr("atalante_tools.gait.require_writable", refuse)
    result = CliRunner().invoke(cli, ["gait", "library", "--out", str(tmp_path / "library")])
    assert result.exit_code == 1
    assert result.stderr == f"atalante: {tmp_path}/library cannot be read or written: Permission denied\n"


def test_a_campaign_rejects_an_invalid_report_folder_before_it_runs(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(cli, ["faults", "campaign", "F56", "--out", str(tmp_path / "file" / "report")])
    assert result.exit_code == 1
    assert result.stderr == f"atalante: {tmp_path}/file/report cannot be read or written: Not a directory\n"
