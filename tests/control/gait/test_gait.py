"""Gaits: Bezier polynomials, the mirrored step, and errors of the loader."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from atalante_control.gait.gait import (
    AIRWALK_GAIT,
    PERIOD,
    SIGN,
    SWAP,
    Gait,
    GaitError,
    bezier,
    check_gait,
    derivative,
    load_gait,
    power_basis,
    write_gait,
)
from atalante_hal.robot import JOINTS, load_robot

ROBOT = load_robot()
AIRWALK = load_gait(AIRWALK_GAIT, ROBOT)


def document() -> dict[str, Any]:
    return json.loads(AIRWALK_GAIT.read_text())


def rejection(tmp_path: Path, content: Any) -> str:
    """Return the error message of a gait file with this content."""
    path = tmp_path / "gait.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(GaitError) as error:
        load_gait(path, ROBOT)
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def test_bezier_derivative_and_power_basis_agree():
    rng = np.random.default_rng(1)
    control_points = rng.normal(size=(5, 8))
    phase = np.linspace(0.0, 1.0, 37)
    values = bezier(control_points, phase)
    np.testing.assert_allclose(values[[0, -1]], control_points[:, [0, -1]].T, atol=1e-14)
    powers = np.array([np.polynomial.polynomial.polyval(phase, c) for c in power_basis(control_points)]).T
    np.testing.assert_allclose(powers, values, atol=1e-11)
    slope = np.array(
        [
            np.polynomial.polynomial.polyval(phase, np.polynomial.polynomial.polyder(c))
            for c in power_basis(control_points)
        ]
    ).T
    np.testing.assert_allclose(bezier(derivative(control_points), phase), slope, atol=1e-10)


def test_velocity_and_acceleration_tables_match_finite_differences():
    tables = AIRWALK.tables()
    assert tables.q.shape == (AIRWALK.cycles + 1, len(JOINTS))
    np.testing.assert_allclose(np.gradient(tables.q, PERIOD, axis=0)[1:-1], tables.qd[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(tables.qd, PERIOD, axis=0)[1:-1], tables.qdd[1:-1], atol=2e-2)
    assert not tables.uf.any()
    with pytest.raises(ValueError, match="read-only"):
        tables.q[0, 0] = 1.0


def test_mirroring_swaps_legs_and_signs_and_is_its_own_inverse():
    left = AIRWALK.mirrored()
    np.testing.assert_array_equal(left.tables().q, AIRWALK.tables().q[:, SWAP] * SIGN)
    np.testing.assert_array_equal(left.mirrored().coefficients, AIRWALK.coefficients)


def test_airwalk_gait_is_periodic_and_within_angle_and_speed_limits():
    right, left = AIRWALK.tables(), AIRWALK.mirrored().tables()
    assert AIRWALK.duration == 0.8
    np.testing.assert_allclose(right.q[-1], left.q[0], atol=1e-12)
    np.testing.assert_allclose(right.qd[-1], left.qd[0], atol=1e-10)
    assert np.abs(right.qd).max() < 3.0
    margin = math.radians(1.0)
    assert (right.q > ROBOT.position_min + margin).all()
    assert (right.q < ROBOT.position_max - margin).all()
    knee = np.degrees(right.q[:, JOINTS.index("left_SK")])
    assert 45.0 < knee.max() < 55.0
    assert knee[0] < 25.0
    assert knee[-1] < 25.0


def test_hash_depends_only_on_trajectory_and_duration():
    other = AIRWALK.coefficients.copy()
    other[3, 4] += 1e-6
    assert Gait("renamed", AIRWALK.duration, AIRWALK.coefficients).hash32 == AIRWALK.hash32
    assert Gait("airwalk", AIRWALK.duration, other).hash32 != AIRWALK.hash32
    assert Gait("airwalk", 0.81, AIRWALK.coefficients).hash32 != AIRWALK.hash32


def test_loader_keeps_feedforward_parameters_and_solver_record(tmp_path: Path):
    raw = document()
    raw["feedforward"] = {joint: [1.0 * i] * 8 for i, joint in enumerate(JOINTS)}
    raw["parameters"] = {"patient_mass": 75.0, "step_length": 0.16}
    raw["solver"] = {"name": "IPOPT", "iterations": 42, "history": [1, 2]}
    path = tmp_path / "gait.json"
    path.write_text(json.dumps(raw))
    gait = load_gait(path, ROBOT)
    assert gait.parameters["patient_mass"] == 75.0
    assert gait.solver["history"] == [1, 2]
    np.testing.assert_allclose(gait.tables().uf[17], np.arange(12.0), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: d.update(speed=1), "speed is unknown; valid keys are format, name, duration, joints"),
        (lambda d: d.pop("duration"), "duration is missing"),
        (lambda d: d.update(format="atalante-gait/9"), "format must be 'atalante-gait/1'"),
        (lambda d: d.update(duration="0.8"), "duration must be a number from 0.3 to 3.0 [s], got"),
        (lambda d: d.update(duration=True), "duration must be a number from 0.3 to 3.0 [s], got"),
        (lambda d: d.update(duration=30.0), "duration must be a number from 0.3 to 3.0 [s], got 30.0"),
        (lambda d: d.update(duration=0.8004), "whole number of milliseconds"),
        (lambda d: d.update(name=""), "name must be a non-empty text, got ''"),
        (lambda d: d.update(parameters={"mass": "75"}), "parameters must be an object of finite numbers"),
        (lambda d: d.update(solver=3), "solver must be an object"),
        (lambda d: d.update(joints=[1]), "joints must be an object with one list for each of left_FH"),
        (lambda d: d["joints"].update(left_XX=[0] * 8), "joints.left_XX is unknown; valid joints are left_FH"),
        (lambda d: d["joints"].pop("right_SA"), "joints.right_SA must be a list of 8 finite numbers, got None"),
        (lambda d: d["joints"].update(left_SK=[0.3] * 7), "joints.left_SK must be a list of 8 finite numbers"),
        (lambda d: d["joints"].update(left_SK=[0.3] * 7 + ["x"]), "joints.left_SK must be a list of 8 finite numbers"),
        (
            lambda d: d.update(feedforward={"left_FH": [0] * 8}),
            "feedforward.left_TH must be a list of 8 finite numbers",
        ),
    ],
)
def test_invalid_gait_file_is_rejected_with_its_key(tmp_path: Path, change: Any, reason: str):
    raw = document()
    change(raw)
    assert reason in rejection(tmp_path, raw)


def test_gait_file_with_nan_or_infinity_is_rejected(tmp_path: Path):
    text = AIRWALK_GAIT.read_text()
    assert "must be finite, got NaN" in rejection(tmp_path, text.replace("0.384", "NaN", 1))
    assert "must be finite, got Infinity" in rejection(tmp_path, text.replace("0.384", "Infinity", 1))
    assert "finite" in rejection(tmp_path, text.replace("0.384", "1e999", 1))


def test_file_without_a_gait_is_rejected(tmp_path: Path):
    rejection(tmp_path, "{")
    rejection(tmp_path, "[]")
    with pytest.raises(GaitError):
        load_gait(tmp_path / "missing.json", ROBOT)


def shift(raw: dict[str, Any], joint: str, points: tuple[int, ...], by: float) -> dict[str, Any]:
    for point in points:
        raw["joints"][joint][point] += by
    return raw


def test_gait_with_a_jump_at_the_step_change_is_rejected(tmp_path: Path):
    reason = rejection(tmp_path, shift(document(), "left_SK", (6, 7), math.radians(0.11)))
    assert "jump of joints.left_SK at the stance change must be" in reason
    assert " 0.1 deg, got 0.11 deg" in reason
    path = tmp_path / "gait.json"
    path.write_text(json.dumps(shift(document(), "left_SK", (6, 7), math.radians(0.09))))
    load_gait(path, ROBOT)
    reason = rejection(tmp_path, shift(document(), "left_SH", (6,), 0.01))
    assert "jump of joints.left_SH at the stance change must be" in reason
    assert " rad/s, got " in reason


def test_gait_beyond_angle_or_speed_limit_is_rejected(tmp_path: Path):
    reason = rejection(tmp_path, shift(document(), "left_SA", (3, 4), -0.2))
    assert re.search(
        r"angle of joints\.left_SA must be -15\.986 to 8\.9954 deg, got -1[67]\.\d+ deg "
        r"at phase 0\.\d+ of the right-stance step, [01]\.\d+ deg beyond the limit$",
        reason,
    )
    fast = document()
    fast["duration"] = 0.3  # the same motion in less than half the time
    assert "speed of joints.left_SK must be -4 to 4 rad/s, got " in rejection(tmp_path, fast)


def knees_bent_by(angle: float) -> Gait:
    points = AIRWALK.coefficients.copy()
    points[[JOINTS.index("left_SK"), JOINTS.index("right_SK")]] += angle
    return replace(AIRWALK, coefficients=points)


def test_limit_exceeded_between_two_cycles_is_found():
    knee = JOINTS.index("left_SK")
    phase = np.linspace(0.0, 1.0, 2_000_001)
    most, sampled = bezier(AIRWALK.coefficients[[knee]], phase).max(), AIRWALK.tables().q[:, knee].max()
    assert most - sampled > 1e-7
    limit = ROBOT.position_max[knee]
    gait = knees_bent_by(limit - (most + sampled) / 2.0)
    assert gait.tables().q[:, knee].max() < limit
    with pytest.raises(
        GaitError, match=r"angle of joints\.left_SK must be 0 to 110\.01 deg, got 110\.01 deg at phase 0\.\d+"
    ):
        check_gait(gait, ROBOT)
    check_gait(knees_bent_by(limit - most), ROBOT)  # exactly at the limit


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"coefficients": AIRWALK.coefficients[:11]},
            r"joints must be 64-bit floats of shape \(12, 8\), got float64 of shape \(11",
        ),
        ({"coefficients": AIRWALK.coefficients.astype(np.float32)}, "joints must be 64-bit floats .*, got float32"),
        ({"coefficients": AIRWALK.coefficients.tolist()}, "joints must be 64-bit floats .*, got list"),
        ({"coefficients": None}, "joints must be 64-bit floats .*, got NoneType"),
        ({"feedforward": np.zeros((12, 7))}, "feedforward must be 64-bit floats"),
        ({"feedforward": np.full((12, 8), np.nan)}, r"feedforward\.left_FH\[0\] must be a finite number, got nan"),
        ({"coefficients": np.where(np.arange(8) == 3, np.inf, AIRWALK.coefficients)}, r"FH\[3\] must be a finite"),
        ({"coefficients": np.full((12, 8), 1.7e308) * (-1.0) ** np.arange(8)}, "must be .* deg|jump of joints"),
        ({"duration": math.nan}, r"duration must be a number from 0.3 to 3.0 \[s\], got nan"),
        ({"duration": 0.2}, r"duration must be a number from 0.3 to 3.0 \[s\], got 0.2"),
        ({"duration": 0.8005}, "duration must be a whole number of milliseconds, got 0.8005 s"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_gait_with_invalid_arrays_is_rejected(change: dict[str, Any], reason: str):
    with pytest.raises(GaitError, match=reason):
        check_gait(replace(AIRWALK, **change), ROBOT)


def test_numpy_float_is_accepted_as_duration():
    check_gait(replace(AIRWALK, duration=np.float64(0.8)), ROBOT)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sum_of_feedforward_and_gravity_must_be_within_torque_limit(sign: float):
    hip = JOINTS.index("right_SH")
    most = ROBOT.torque_max[hip]
    feedforward = np.zeros((12, 8))
    feedforward[hip] = sign * 0.6 * most
    gait = replace(AIRWALK, feedforward=feedforward)

    def gravity(share: float) -> Any:
        return lambda pose: share * most * (np.arange(12) == hip)

    check_gait(gait, ROBOT, gravity=gravity(0.4 * sign))
    check_gait(gait, ROBOT, gravity=gravity(-0.9 * sign))
    with pytest.raises(GaitError, match=r"feedforward and gravity of joints\.right_SH must be -219 to 219 Nm, got "):
        check_gait(gait, ROBOT, gravity=gravity(0.401 * sign))


def test_written_gait_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    feedforward = rng.normal(size=(12, 8)) * 10.0
    gait = Gait(
        "walk", 0.8, AIRWALK.coefficients, feedforward, {"patient_mass": 0.1 + 0.2}, {"status": "solved", "log": [1]}
    )
    path = tmp_path / "walk.json"
    write_gait(gait, path)
    back = load_gait(path, ROBOT)
    assert back.hash32 == gait.hash32
    assert (back.name, back.parameters, back.solver) == (gait.name, gait.parameters, gait.solver)
    write_gait(AIRWALK, path)
    assert load_gait(path, ROBOT).feedforward is None
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk.json"]
