"""What the options of several commands take: numbers that are numbers, seeds, pictures, a patient's own step."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from atalante_tools.cli import cli

PATIENT = ("--mass", "75", "--height", "175")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["demo", "--xi", "nan"], "'--xi': nan is not a number"),
        (["airwalk", "--xi", "nan"], "'--xi': nan is not a number"),
        (["emulator", "-i", "pcan", "-c", "x", "--xi", "nan"], "'--xi': nan is not a number"),
        (["vibrate", "left_thigh_front", "nan"], "'LEVEL': nan is not a number"),
        (["vibrate", "left_thigh_front", "0.3", "--for", "nan"], "'--for': nan is not a number"),
        (["pendant", "xi", "nan", "-i", "pcan", "-c", "x"], "'X': nan is not a number"),
        (["status", "-i", "pcan", "-c", "x", "--for", "nan"], "'--for': nan is not a number"),
        (["validate", "-i", "pcan", "-c", "x", "--for", "nan"], "'--for': nan is not a number"),
        (["conform", "LEFT_SK", "--torque", "nan"], "'--torque': nan is not a number"),
        (["dbc", "busload", "--limit", "nan"], "'--limit': nan is not a number"),
        (["demo", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["airwalk", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["jog", "left_SK", "--to", "5", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["emulator", "-i", "pcan", "-c", "x", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["gait", "check", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["dbc", "c-code", "-o", "never", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["demo", *PATIENT, "--step-length", "0"], "a step length is from 0.05 to 0.4 m, not 0 m"),
        (["demo", *PATIENT, "--step-duration", "0"], "a step duration is from"),
        (["emulator", "-i", "virtual", "-c", "x"], "virtual stays inside one process: use an adapter, or a vcan"),
        (["airwalk", "-i", "udp_multicast", "-c", "239.74.163.2"], "udp_multicast hands every sender its own frames"),
        (["model", "--show", "model.xyz"], "model.xyz must end in .png or .svg or .pdf"),
        (["gait", "solve", *PATIENT, "--plot", "gait.xyz"], "gait.xyz must end in .png or .svg or .pdf"),
        (["gait", "solve", *PATIENT, "--animate", "gait.png"], "gait.png must end in .gif"),
        (["gait", "solve", *PATIENT, "--out", "no/gait.json"], "there is no folder no for gait.json"),
        (["gait", "fit", "--library", ".", "--out", "no/network.npz"], "there is no folder no for network.npz"),
        (["model", "--urdf", "no/model.urdf"], "there is no folder no for model.urdf"),
        (["validate", "some.log", "--html", "no/some.html"], "there is no folder no for some.html"),
    ],
)
def test_what_no_command_can_use_is_told_before_any_work(arguments: list[str], sentence: str) -> None:
    result = CliRunner().invoke(cli, arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_campaign_finds_out_that_its_report_has_no_place_before_it_runs(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(cli, ["faults", "campaign", "F56", "--out", str(tmp_path / "file" / "report")])
    assert result.exit_code == 1
    assert result.stderr == f"atalante: {tmp_path}/file/report cannot be used: Not a directory\n"
