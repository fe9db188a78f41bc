"""`atalante walk` through HAL, bus and emulator."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from atalante_emulator.pendant import Operator
from atalante_tools.cli import cli
from atalante_tools.session.dial import Dial


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(cli, ["walk", *arguments])
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.sample(2)
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_patient_walks_three_steps_and_stands(engine: str) -> None:
    code, out, errors = run("--steps", "3", "--engine", engine, "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"], result["fell"]) == (0, "stood", 3, False), errors
    assert result["engine"] == engine
    assert abs(result["lateral_m"]) < 0.1
    assert abs(result["yaw_deg"]) < 5.0


@pytest.mark.long
def test_walk_with_a_heading_reference_stands() -> None:
    code, out, errors = run("--steps", "2", "--engine", "mujoco", "--json", "--heading-reference")
    result = json.loads(out)
    assert (code, result["outcome"]) == (0, "stood"), errors
    assert result["yaw_deg"] == pytest.approx(result["true_yaw_deg"], abs=1.0)


@pytest.mark.long
@pytest.mark.parametrize(("turn", "xi"), [(3.0, 1.0), (-3.0, 0.5)])
def test_line_turns_before_each_step(turn: float, xi: float) -> None:
    code, out, errors = run("--steps", "8", "--turn", str(turn), "--xi", str(xi), "--engine", "mujoco", "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"]) == (0, "stood", 8), errors
    assert result["true_yaw_deg"] == pytest.approx(8 * turn, abs=3.0)
    assert abs(result["yaw_deg"]) < 4.0
    assert abs(result["lateral_m"]) < 0.1
    assert result["xi"] == 1.0 or result["inside"] == 1.0


@pytest.mark.long
@pytest.mark.parametrize("turn", ["3", "-3"])
def test_tall_and_heavy_patient_turns_in_a_wide_guide(turn: str) -> None:
    patient = "--mass", "91", "--height", "193", "--wearer", "passive"
    code, out, errors = run("--steps", "16", "--turn", turn, "--xi", "0", "--shape", "constant", *patient, "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"]) == (0, "stood", 16), errors


def test_turn_is_refused_without_steering() -> None:
    code, _, errors = run("--turn", "2", "--literal")
    assert code == 2
    assert "--turn has no effect with --literal, because --literal switches steering off" in errors


@pytest.mark.long
def test_step_length_and_duration_change_during_a_walk(tmp_path: Path) -> None:
    arguments = ("--steps", "3", "--step-length", "0.12", "--step-duration", "0.9", "--then", "3", "0.18", "0.8")
    options = ("--xi", "0.5", "--wearer", "passive", "--engine", "mujoco", "--json", "--out", str(tmp_path / "walk"))
    code, out, errors = run(*arguments, *options)
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"]) == (0, "stood", 6), errors
    assert (result["step_lengths_m"], result["step_durations_s"]) == ([0.12, 0.18], [0.9, 0.8])
    assert result["distance_m"] == pytest.approx(3.5 * (0.12 + 0.18), abs=0.12)
    assert result["inside"] == 1.0
    assert result["hand_overs_exceeded"] == 0
    # The certificates of both gaits are printed. The weaker certificate of the second gait is the result.
    assert "step 0.12 m in 0.9 s, then 75 kg, 1.75 m, step 0.18 m in 0.8 s" in errors
    assert errors.count("pinched: promise at Xi 0.5") == 2
    assert f"{result['promise_hip_nm']:.2f} Nm at the hip" in errors
    assert result["promise_hip_nm"] < 30.0
    given = json.loads((tmp_path / "walk" / "summary.json").read_text())["options"]
    assert given["then"] == [{"steps": 3, "subject": "75 kg, 1.75 m, step 0.18 m in 0.8 s"}]


def test_passive_wearer_walks_inside_the_certified_guide(tmp_path: Path) -> None:
    arguments = (
        "--steps",
        "3",
        "--xi",
        "0.5",
        "--wearer",
        "passive",
        "--engine",
        "mujoco",
        "--json",
        "--out",
        str(tmp_path / "walk"),
        "--can-log",
        str(tmp_path / "walk.log"),
    )
    code, out, errors = run(*arguments)
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"], result["shape"]) == (0, "stood", 3, "pinched"), errors
    assert result["certified"]
    assert result["inside"] == 1.0
    assert 0.0 < result["max_ratio"] < 1.0
    assert result["outside_cycles"] == result["hand_overs_exceeded"] == 0
    assert "pinched: promise at Xi 0.5" in errors
    summary = json.loads((tmp_path / "walk" / "summary.json").read_text())
    assert summary["result"] == result
    assert summary["recording"] == {"files": ["recording.mcap"], "complete": True, "missing_cycles": 0}
    files = {path.name for path in (tmp_path / "walk").iterdir()}
    assert files == {"recording.mcap", "summary.json", "trace.npz", "walk.png"}
    # The log contains at least the sixteen drive, IMU and foot messages of each cycle of the eight seconds and more.
    assert (tmp_path / "walk.log").read_bytes().count(b"\n") > 16 * 8000
    with (tmp_path / "walk" / "recording.mcap").open("rb") as recording:
        counts = make_reader(recording).get_summary().statistics.message_count
    assert counts > 8 * 100


@pytest.mark.long
def test_protocol_lowers_the_assistance_step_by_step() -> None:
    arguments = ("--protocol", "1,1,2", "--xi", "0.5", "--wearer", "passive", "--engine", "mujoco", "--json")
    code, out, errors = run(*arguments)
    result = json.loads(out)
    assert (code, result["outcome"], result["steps"], result["xi"]) == (0, "stood", 4, 0.5), errors
    assert 0.0 < result["max_ratio"] < 1.0
    assert result["certified"]
    assert result["attitude_rms_deg"] < 0.5
    assert abs(result["true_lateral_m"]) < 0.1
    assert abs(result["true_yaw_deg"]) < 5.0
    assert set(result["diagnostics"]) <= {"TORQUE_SATURATED", "OPERATOR_STOP"}
    assert 0.0 < result["cpu_per_second"] < 10.0


@pytest.mark.long
def test_walk_with_push_and_dial_has_the_same_result_and_frames_in_two_processes(tmp_path: Path) -> None:
    arguments = (
        "--protocol",
        "1,1,1",
        "--xi",
        "0.5",
        "--engine",
        "mujoco",
        "--push",
        "60",
        "--push-direction",
        "90",
        "--json",
    )
    results, frames = [], []
    for option in ("--robot-process", "--no-robot-process"):
        log = tmp_path / f"{option}.log"
        code, out, errors = run(*arguments, option, "--can-log", str(log))
        assert code == 0, errors
        result = json.loads(out)
        assert result.pop("robot_process") == (option == "--robot-process")
        del result["real_time_factor"], result["cpu_per_second"]
        results.append(result)
        frames.append(log.read_bytes())
    assert results[0] == results[1]
    assert frames[0] == frames[1]
    assert results[0]["max_dcm_error_m"] > 0.015  # of the push; 0.012 m without it
    assert results[0]["max_ratio"] > 0.0  # in the step after the dial was turned
    assert results[0]["true_lateral_m"] is not None


@pytest.mark.parametrize("full", [1, 2, 3])
def test_dial_falls_linearly_from_full_assistance(full: int) -> None:
    operator = Operator()
    dial = Dial(operator, (full, 3, 2), 0.2)
    dial.turn(0)  # in the start step
    factors = []
    for begun in range(1, 9):
        factors.append(operator.signals.assistance_factor)  # of the step that begins now
        dial.turn(begun)
    assert factors == ([1.0] * full + [0.8, 0.6, 0.4, 0.2, 0.2, 0.2, 0.2])[:8]


@pytest.mark.long
@pytest.mark.parametrize("xi", ["1", "0.5"])
def test_literal_law_of_the_paper_falls_without_an_operator(xi: str) -> None:
    code, out, _ = run("--literal", "--steps", "10", "--xi", xi, "--engine", "mujoco", "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["fell"]) == (1, "fell", True)
    assert result["steps"] < 10
    assert result["certified"] in ((None,) if xi == "1" else (False,))


@pytest.mark.long
def test_guide_without_a_promise_is_reported_as_not_certified() -> None:
    _, out, errors = run("--steps", "1", "--xi", "0.5", "--shape", "snap", "--engine", "mujoco", "--json")
    assert json.loads(out)["certified"] is False
    assert "snap: NOT CERTIFIED at Xi 0.5" in errors


@pytest.mark.long
def test_robot_that_is_pushed_over_ends_with_code_1() -> None:
    code, out, errors = run("--steps", "3", "--engine", "mujoco", "--push", "1000", "--push-direction", "90", "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["fell"]) == (1, "fell", True)
    # HOLD, if the HAL left ACTIVE before the fall was detected, is the only other reason. START of the operator is none.
    assert re.search(r"the robot fell in step \d(: .+)?$", errors, re.MULTILINE)
    assert "START" not in errors.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--shape", "snap"), "--shape requires a guide, but there is none at the assistance factor 1: add --xi"),
        (("--protocol", "1,2,3"), "the assistance factor at the end of --protocol must be below 1, got 1: add --xi"),
        (("--shape", "nonsense", "--xi", "0.5"), "guide shape (or a file that ends in .toml)"),
        (("--can-log", "walk.txt"), "walk.txt"),
        (("--turn", "5"), "5.0 is not in the range -3.0<=x<=3.0"),
        (("--record-rate", "3"), "must be a divisor of 1000"),
        (("--wearer", "passive", "-i", "socketcan", "-c", "vcan0"), "--wearer passive requires the emulated robot"),
        (("--mass", "75"), "a patient requires both --mass and --height"),
        (("--protocol", "1,2", "--xi", "0"), "must be three positive numbers of steps like 112,38,225, got '1,2'"),
        (("--protocol", "1,2,0"), "must be three positive numbers of steps"),
        (("--protocol", "1,2,3", "-i", "socketcan", "-c", "vcan0"), "--protocol requires the emulated robot"),
        (("--push", "50", "-i", "socketcan", "-c", "vcan0"), "--push requires the emulated robot"),
        (("--push-direction", "90"), "--push-direction requires a push: add --push"),
        (("--push", "50", "--push-direction", "nan"), "must be a number, got nan"),
        (("--record-rate", "1000"), "--record-rate requires a recording: add --out"),
        (("--robot-process", "-i", "socketcan", "-c", "vcan0"), "--robot-process requires the emulated robot"),
        (("--friction", "0.6", "-i", "socketcan", "-c", "vcan0"), "--friction requires the emulated robot"),
        (("--seed", "0", "-i", "socketcan", "-c", "vcan0"), "--seed requires the emulated robot"),
        (("--engine", "pybullet", "-i", "socketcan", "-c", "vcan0"), "--engine requires the emulated robot"),
        (("--then", "0", "0.18", "0.8"), "0 is not in the range x>=1"),
        (("--then", "3", "0.9", "0.8"), "step length must be 0.05 to 0.4 m, got 0.9 m"),
        (
            ("--then", "3", "0.18", "0.8", "--literal"),
            "--then requires the ankle stabiliser, but --literal switches it off",
        ),
        (("--then", "3", "0.18", "0.8", "--gait", "walk.json"), "--gait gives one gait: remove one of them"),
        (("--step-length", "0.9"), "step length must be 0.05 to 0.4 m, got 0.9 m"),
    ],
)
def test_bad_input_is_answered_with_one_sentence(arguments: tuple[str, ...], message: str) -> None:
    code, _, errors = run(*arguments)
    assert code == 2
    assert message in errors
