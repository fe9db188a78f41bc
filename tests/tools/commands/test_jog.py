"""`atalante jog`: motion profile, invalid arguments, a move of the embedded robot, exit codes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_hal.robot import JOINTS, Robot
from atalante_hal.wire.cia402 import DriveState
from atalante_tools.cli import cli
from atalante_tools.session import rig as rig_module
from atalante_tools.session.pose_hold import PEAK, minimum_jerk
from atalante_tools.session.rig import Rig


def jog(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["jog", *arguments])


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Rig], None]], list[Rig]]:
    """Return a function that changes the rig of a command before its run and keeps it for inspection."""
    opened: list[Rig] = []
    original = rig_module.open_hal

    def prepare(change: Callable[[Rig], None]) -> list[Rig]:
        @contextmanager
        def open_hal(*arguments: Any, **options: Any) -> Iterator[Rig]:
            with original(*arguments, **options) as rig:
                change(rig)
                opened.append(rig)
                yield rig

        monkeypatch.setattr(rig_module, "open_hal", open_hal)
        return opened

    return prepare


# -- the profile -----------------------------------------------------------------------------------------------------


def test_the_profile_is_monotonic_and_starts_and_ends_at_rest() -> None:
    phase = np.linspace(0.0, 1.0, 1001)
    share, rate = np.array([minimum_jerk(float(x)) for x in phase]).T
    assert (share[0], share[-1], rate[0], rate[-1]) == (0.0, 1.0, 0.0, 0.0)
    assert (np.diff(share) >= 0.0).all()
    assert np.gradient(share, phase, edge_order=2) == pytest.approx(rate, abs=1e-4)
    assert share + share[::-1] == pytest.approx(1.0)
    assert rate.max() == pytest.approx(PEAK)
    assert minimum_jerk(-1.0) == (0.0, 0.0)
    assert minimum_jerk(2.0) == (1.0, 0.0)


# -- rejected arguments ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", range(len(JOINTS)))
def test_a_target_outside_the_limits_is_rejected_with_the_range(robot: Robot, index: int) -> None:
    name = JOINTS[index]
    low, high = math.degrees(robot.position_min[index]), math.degrees(robot.position_max[index])
    for target in (low - 0.1, high + 0.1):
        result = jog(name, "--to", repr(target))
        assert result.exit_code == 2
        assert f"{name} must be from {low:.1f} to {high:.1f} degrees, got {target:g}" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["left_KS", "--to", "1"], "got 'left_KS'. Did you mean left_SK"),
        (["elbow", "--to", "1"], "joint must be one of left_FH, left_TH,"),
        (["left_SK", "--to", "nan"], "left_SK must be from 0.0 to 110.0 degrees, got nan"),
        (["left_SK", "--to", "5", "--speed", "0"], "the speed of left_SK must be above 0 and at most 229 deg/s, got 0"),
        (["left_SK", "--to", "5", "--speed", "500"], "at most 229 deg/s, got 500"),
        (["left_SK", "--to", "5", "--speed", "nan"], "at most 229 deg/s, got nan"),
        (["left_SK"], "Missing option '--to'"),
        (["left_SK", "--to", "5", "-c", "vcan0"], "to use vcan0, type -i socketcan -c vcan0"),
    ],
)
def test_invalid_command_line_prints_one_sentence_and_exits_with_2(arguments: list[str], sentence: str) -> None:
    result = jog(*arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


# -- the move --------------------------------------------------------------------------------------------------------


def test_one_joint_moves_and_all_others_hold_their_pose(prepared: Callable[[Callable[[Rig], None]], list[Rig]]) -> None:
    track: list[np.ndarray] = []

    def follow(rig: Rig) -> None:
        assert rig.emulator is not None
        rig.emulator.before_send.append(lambda now, values: track.append(rig.hal.state.position.copy()))

    rigs = prepared(follow)
    result = jog("LEFT_sk", "--to", "20", "--speed", "60", "--json")
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert printed["joint"] == "left_SK"
    assert printed["to_deg"] == 20.0
    assert abs(printed["error_deg"]) < 0.1
    assert printed["reached_deg"] == pytest.approx(20.0, abs=0.1)
    assert rigs[0].hal.state.supervisor.name == "HOLD"
    positions = np.degrees(track[-1000:])
    speed = np.abs(np.diff(positions[:, JOINTS.index("left_SK")])).max() * 1e3
    assert speed < 1.2 * 60.0
    others = np.delete(positions, JOINTS.index("left_SK"), axis=1)
    assert np.ptp(others[-500:], axis=0).max() < 1.0


def test_the_output_contains_the_reached_angle() -> None:
    result = jog("right_SH", "--to", "-5", "--speed", "60")
    assert result.exit_code == 0
    assert result.stdout.startswith("right_SH: ")
    assert ", error " in result.stdout
    assert result.stderr.splitlines() == ["ACTIVE on embedded; Ctrl-C ends in HOLD", "the robot is in HOLD"]


def test_a_joint_that_misses_its_target_fails(prepared: Callable[[Callable[[Rig], None]], list[Rig]]) -> None:
    def push_against_the_motion(rig: Rig) -> None:
        assert rig.emulator is not None
        rig.emulator.drives.motors.push(JOINTS.index("left_SK"), -150.0)

    prepared(push_against_the_motion)
    result = jog("left_SK", "--to", "20", "--speed", "60", "--json")
    assert result.exit_code == 1
    assert "left_SK must reach 20 degrees, got 1" in result.stderr
    assert 10.0 < json.loads(result.stdout)["reached_deg"] < 19.0


def test_a_drive_fault_ends_jog_with_code_4(prepared: Callable[[Callable[[Rig], None]], list[Rig]]) -> None:
    def fail(rig: Rig) -> None:
        assert rig.emulator is not None
        column = rig.emulator.signals.index("RIGHT_HA_STATE", "DriveState")

        def rewrite(now: int, values: Any) -> None:
            if now > 500:
                values[column] = DriveState.FAULT

        rig.emulator.before_send.append(rewrite)

    prepared(fail)
    result = jog("left_SK", "--to", "60", "--json")
    assert result.exit_code == 4
    assert "the robot is in FAULT: RIGHT_HA: a drive is in FAULT" in result.stderr
    assert result.stdout == ""


def test_stop_of_the_operator_ends_jog_with_code_1(prepared: Callable[[Callable[[Rig], None]], list[Rig]]) -> None:
    def stop(rig: Rig) -> None:
        assert rig.emulator is not None
        rig.emulator.before_send.append(lambda now, values: rig.operator.stop() if now == 500 else None)  # type: ignore[union-attr]

    prepared(stop)
    result = jog("left_SK", "--to", "60")
    assert result.exit_code == 1
    assert "the robot went to HOLD: the operator asked to stop" in result.stderr
