"""Robot file: mirrored legs, read-only arrays and strict validation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_hal.robot import JOINTS, MIRROR_SIGN, MOTORS, ROBOT_FILE, RobotError, load_robot

TEXT = ROBOT_FILE.read_text()


def test_robot_has_twelve_joints_and_eight_motors():
    assert len(JOINTS) == 12
    assert JOINTS[2] == "left_SH"
    assert JOINTS[9] == "right_SK"
    assert len(MOTORS) == len(set(MOTORS)) == 8


def test_right_leg_mirrors_the_left_leg():
    robot = load_robot()
    sign = np.array(MIRROR_SIGN)
    low, high = robot.position_min, robot.position_max
    mirrored = np.sort(np.stack([sign * low[:6], sign * high[:6]]), axis=0)
    assert np.array_equal(mirrored[0], low[6:])
    assert np.array_equal(mirrored[1], high[6:])
    for name in ("velocity_max", "torque_max", "torque_rate_max", "gear", "hold_kp", "hold_kd"):
        column = getattr(robot, name)
        assert np.array_equal(column[:6], column[6:])
        assert (column > 0).all()
        assert not column.flags.writeable


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("velocity_max = 4.0", "speed_max = 4.0", "speed_max"),
        ("velocity_max = 4.0", "", "velocity_max"),
        ("velocity_max = 4.0", "velocity_max = -4.0", "velocity_max"),
        ("velocity_max = 4.0", "velocity_max = nan", "velocity_max"),
        ("velocity_max = 4.0", "velocity_max = inf", "velocity_max"),
        ("velocity_max = 4.0", 'velocity_max = "4 rad/s"', "velocity_max"),
        ("velocity_max = 4.0", "velocity_max = true", "velocity_max"),
        ("position = [-0.175, 0.297]", "position = [0.297, -0.175]", "position"),
        ("position = [-0.175, 0.297]", "position = [0.297]", "position"),
        ("polarity = 1", "polarity = 0", "polarity"),
        ("[joints.FH]", "[joints.XX]", "FH"),
        ("[joints.FH]", "[patient]\nmass = 70\n[joints.FH]", "patient"),
        ("[joints.FH]", "[joints.FH", "robot.toml"),
        ("[derating]", "[patient]", "patient"),
        ("look_ahead = 0.02", "", r"envelope\.look_ahead is missing"),
        ("look_ahead = 0.02", "look_ahead = 20.0", r"look_ahead must be 1 number from 0\.001 to 1 \(s\)"),
        ("floor = 0.3", "flor = 0.3", r"derating\.flor is unknown; valid keys are start, end, floor"),
        ("end = 115.0", "end = 90.0", r"derating\.start must be below derating\.end \(90\.0\), got 90\.0"),
        ("[thresholds]", "[limits]", "limits"),
        (
            "supply_under = 36.0",
            "supply_under = 42.0",
            r"supply_under must be below thresholds\.supply_low \(42\.0\), got 42\.0",
        ),
        ("supply_low = 42.0", "supply_low = 42000", r"thresholds\.supply_low must be 1 number from 5 to 100 \(V\)"),
        ("derated_imbalance = 0.5", "", r"thresholds\.derated_imbalance is missing"),
        (
            "full_assist_ramp = 1.0",
            "full_assist_ramp = 0.0",
            r"full_assist_ramp must be 1 number from 0\.01 to 60 \(s\)",
        ),
        ("surplus_frames = 12", "surplus_frames = -1", r"surplus_frames must be 1 number from 1 to 100 \(frames\)"),
    ],
)
def test_invalid_robot_file_is_rejected_with_its_key(old: str, new: str, key: str, tmp_path: Path):
    assert old in TEXT
    path = tmp_path / "robot.toml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(RobotError, match=key):
        load_robot(path)


@given(st.floats(max_value=0.0) | st.sampled_from([float("nan"), float("inf"), float("-inf")]))
def test_limits_must_be_positive_and_finite(value: float):
    path = ROBOT_FILE.with_name("robot.toml")
    text = TEXT.replace("torque_max = 350.0", f"torque_max = {value!r}", 1)
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(text)
        with pytest.raises(RobotError, match=r"joints\.FH\.torque_max"):
            load_robot(path)


def test_missing_robot_file_is_named(tmp_path: Path):
    with pytest.raises(RobotError, match="nowhere"):
        load_robot(tmp_path / "nowhere.toml")


def test_torque_limit_falls_with_drive_temperature():
    robot = load_robot()
    cold, hot = np.full(12, robot.derating.start), np.full(12, robot.derating.end)
    assert robot.torque_limit(cold).tobytes() == robot.torque_max.tobytes()
    assert np.allclose(robot.torque_limit(hot), robot.derating.floor * robot.torque_max)
    assert np.allclose(robot.torque_limit(hot + 50.0), robot.derating.floor * robot.torque_max)
    half = (1.0 + robot.derating.floor) / 2.0
    assert np.allclose(robot.torque_limit((cold + hot) / 2.0), half * robot.torque_max)
    one = cold.copy()
    one[3] += 5.0
    assert np.flatnonzero(robot.torque_limit(one) < robot.torque_max).tolist() == [3]
