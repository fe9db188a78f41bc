"""Flat foot, compared with rotation matrices: the normal of the sole must be vertical."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from atalante_control.gait.recentering import Deadbeat
from atalante_control.joint.flat_foot import FlatFoot, LevelFeet, Tibiae, flat_feet, level, write_level_ankle
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot
from atalante_hal.types import State, SupervisorState

ANGLES = st.floats(-0.6, 0.6)
STILL = (0.0, 0.0, 0.0)
HEADING = st.floats(-math.pi, math.pi)
LEFT, RIGHT = flat_feet(ExoskeletonParameters())
ROBOT = load_robot()
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
TIBIAE = Tibiae(MODEL)
DEADBEAT = Deadbeat(0.8, 0.4)
OFFSET = math.radians(1.0)


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    a = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def rotation_vector(v: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(v))
    return rotation(tuple(v), angle) if angle else np.eye(3)


def quaternion(r: np.ndarray) -> tuple[float, float, float, float]:
    w = 0.5 * math.sqrt(max(0.0, 1.0 + np.trace(r)))
    return w, (r[2, 1] - r[1, 2]) / (4 * w), (r[0, 2] - r[2, 0]) / (4 * w), (r[1, 0] - r[0, 1]) / (4 * w)


def tibia(heading: float, roll: float, pitch: float) -> np.ndarray:
    return rotation((0, 0, 1), heading) @ rotation((1, 0, 0), roll) @ rotation((0, 1, 0), pitch)


def sole_normal(foot: FlatFoot, shank: np.ndarray, sagittal: float, henke: float) -> np.ndarray:
    r = shank @ rotation((0, 0, 1), foot.toe_out) @ rotation((0, 1, 0), sagittal) @ rotation(foot.axis, henke)
    return r @ np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("foot", [LEFT, RIGHT], ids=["left", "right"])
@given(heading=HEADING, roll=ANGLES, pitch=ANGLES)
def test_sole_is_level_for_any_tibia_attitude(foot: FlatFoot, heading: float, roll: float, pitch: float):
    r = tibia(heading, roll, pitch)
    assume(np.trace(r) > -0.9)
    angles = level(foot.geometry, quaternion(r), STILL)[0]
    np.testing.assert_allclose(sole_normal(foot, r, *angles), [0.0, 0.0, 1.0], atol=1e-9)


@given(HEADING, ANGLES)
def test_ankle_angles_do_not_depend_on_heading(heading: float, pitch: float):
    assume(abs(heading) < 3.0)
    turned, ahead = (level(LEFT.geometry, quaternion(tibia(h, 0.1, pitch)), STILL)[0] for h in (heading, 0.0))
    np.testing.assert_allclose(turned, ahead, atol=1e-9)


def test_ankle_compensates_the_pitch_of_the_tibia():
    np.testing.assert_allclose(level(LEFT.geometry, (1.0, 0.0, 0.0, 0.0), STILL)[0], (0.0, 0.0), atol=1e-15)
    straight = FlatFoot(0.0, (0.788, 0.0, 0.616))
    np.testing.assert_allclose(
        level(straight.geometry, quaternion(tibia(0.0, 0.0, 0.3)), STILL)[0], (-0.3, 0.0), atol=1e-12
    )


def test_left_and_right_ankle_angles_are_mirror_images():
    left = level(LEFT.geometry, quaternion(tibia(0.0, 0.1, 0.2)), STILL)[0]
    right = level(RIGHT.geometry, quaternion(tibia(0.0, -0.1, 0.2)), STILL)[0]
    np.testing.assert_allclose(right, (left[0], -left[1]), atol=1e-12)


def test_ankle_angle_is_limited_for_a_strongly_tilted_tibia():
    angles = level(LEFT.geometry, quaternion(tibia(0.0, 1.3, 0.0)), (1.0, 2.0, 3.0))[0]
    assert all(math.isfinite(a) for a in angles)
    assert abs(angles[1]) == pytest.approx(math.pi / 2)


@given(HEADING, ANGLES, ANGLES, *[st.floats(-3.0, 3.0)] * 3)
def test_ankle_rates_are_the_derivatives_of_the_angles(
    heading: float, roll: float, pitch: float, p: float, q: float, r: float
):
    assume(abs(heading) < 3.0)
    gyro, shank, step = (p, q, r), tibia(heading, 0.5 * roll, 0.5 * pitch), 1e-6
    later, before = (shank @ rotation_vector(np.array(gyro) * s) for s in (step, -step))
    for foot in (LEFT, RIGHT):
        ahead, behind = (np.array(level(foot.geometry, quaternion(m), STILL)[0]) for m in (later, before))
        np.testing.assert_allclose(
            level(foot.geometry, quaternion(shank), gyro)[1], (ahead - behind) / (2 * step), atol=1e-6
        )


def test_unsupported_henke_axis_is_rejected():
    for axis in ((0.7, 0.1, 0.7), (0.0, 0.0, 1.0)):
        with pytest.raises(ValueError, match="henke axis"):
            FlatFoot(0.0, axis)


@pytest.mark.parametrize(("side", "foot"), [(0, LEFT), (1, RIGHT)])
@given(
    position=arrays(float, 12, elements=st.floats(-0.5, 0.5)),
    velocity=arrays(float, 12, elements=st.floats(-2.0, 2.0)),
    roll=ANGLES,
    pitch=ANGLES,
)
def test_tibia_attitude_from_joints_matches_its_imu(
    side: int, foot: FlatFoot, position: np.ndarray, velocity: np.ndarray, roll: float, pitch: float
):
    pelvis, turning = tibia(0.3, roll, pitch), np.array([0.1, -0.2, 0.3])

    def shank(q: np.ndarray, world: np.ndarray) -> np.ndarray:
        fh, th, sh, sk = q[6 * side : 6 * side + 4]
        leg = rotation((1, 0, 0), fh) @ rotation((0, 0, 1), th) @ rotation((0, 1, 0), sh) @ rotation((0, 1, 0), sk)
        return world @ leg

    attitude, gyro = TIBIAE.attitude(side, position, velocity, quaternion(pelvis), turning.tolist())
    r = shank(position, pelvis)
    assume(np.trace(r) > -0.9)
    np.testing.assert_allclose(np.abs(np.dot(attitude, quaternion(r))), 1.0, atol=1e-9)
    dt = 1e-6
    later = shank(position + velocity * dt, pelvis @ rotation_vector(turning * dt))
    np.testing.assert_allclose(rotation_vector(np.array(gyro) * dt), r.T @ later, atol=1e-9)


# -- targets of the swing ankle ------------------------------------------------------------------------------------------------


def feet() -> LevelFeet:
    return LevelFeet(ROBOT, ExoskeletonParameters(), MODEL, DEADBEAT, [np.zeros((801, 24))] * 2, OFFSET)


def written_row(
    f: LevelFeet, side: int, cycle: int, r: np.ndarray, gyro: tuple[float, float, float] = STILL
) -> np.ndarray:
    row = np.arange(24.0)
    write_level_ankle(f.ankles[side], f.cubics, cycle, np.array(quaternion(r)), np.array(gyro), row)
    return row


@pytest.mark.parametrize(("side", "foot"), [(0, LEFT), (1, RIGHT)])
def test_level_targets_replace_only_the_swing_ankle_targets(side: int, foot: FlatFoot):
    r, gyro, sa = tibia(0.4, 0.02, 0.1), (0.1, -0.2, 0.3), 6 * side + 4
    row = written_row(feet(), side, 500, r, gyro)
    angles, rates = level(foot.geometry, quaternion(r), gyro)
    np.testing.assert_allclose(row[[sa, sa + 1]], (angles[0] + OFFSET, angles[1]), atol=1e-15)
    np.testing.assert_allclose(row[[sa + 12, sa + 13]], rates, atol=1e-15)
    others = [i for i in range(24) if i % 12 not in (sa, sa + 1)]
    np.testing.assert_array_equal(row[others], others)


@pytest.mark.parametrize("pitch", [-1.2, 1.2])
def test_ankle_target_slows_down_and_stops_before_its_limit(pitch: float):
    row = written_row(feet(), 0, 500, tibia(0.0, 0.0, pitch), (0.0, 1.0, 0.0))
    margin = math.radians(1.0)
    limit = ROBOT.position_max[4] - margin if pitch < 0.0 else ROBOT.position_min[4] + margin
    assert row[4] == pytest.approx(limit)
    assert row[16] == 0.0
    near = -(limit - OFFSET - math.copysign(math.radians(1.5), limit))  # middle of the fade
    row = written_row(feet(), 0, 500, tibia(0.0, 0.0, near), (0.0, 1.0, 0.0))
    rate = level(LEFT.geometry, quaternion(tibia(0.0, 0.0, near)), (0.0, 1.0, 0.0))[1][0]
    assert row[16] == pytest.approx(0.5 * rate, rel=0.1)


def test_ankle_target_moves_from_measured_to_level_during_re_centring():
    f, r = feet(), tibia(0.0, 0.02, 0.1)
    attitudes = np.tile(quaternion(r), (4, 1))
    state = State(
        0, 0.0, SupervisorState.ACTIVE, 0.5, np.full(12, 0.05), np.full(12, 0.2), *np.zeros((3, 12)), attitudes,
        np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((2, 4, 3)), np.zeros(8), np.ones(24, bool), np.zeros(24, int), True,
    )  # fmt: skip
    target = written_row(f, 0, 0, r)
    f.start_step(state, 0)
    first, late = written_row(f, 0, 0, r), written_row(f, 0, 321, r)
    np.testing.assert_allclose(first[[4, 5, 16, 17]], (0.05, 0.05, 0.2, 0.2), atol=1e-12)
    np.testing.assert_array_equal(late, target)
