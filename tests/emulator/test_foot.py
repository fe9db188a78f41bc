from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from atalante_control.model import ExoskeletonParameters, urdf
from atalante_emulator.bodies.soles import into_frame, read_soles
from atalante_emulator.foot import Feet, FootParameters
from atalante_hal.robot import load_robot

SOLES = read_soles(urdf(ExoskeletonParameters(), load_robot()))
X0 = 0.057  # m, centre of the cells along x of the foot
A, B = 0.121, 0.027  # m, half the distance of the cells along x and along y


def feet() -> tuple[Feet, np.ndarray]:
    force = np.full((2, 4, 3), 7.0)
    return Feet(FootParameters(), SOLES, force), force


def test_every_cell_reads_zero_in_the_air() -> None:
    node, force = feet()
    node.sample(np.zeros((2, 4, 3)), False)
    assert not force.any()


@pytest.mark.parametrize("seed", range(5))
def test_cell_forces_are_those_under_a_rigid_plate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.zeros((2, 4, 3))
    corners[:, :, 2] = rng.uniform(0.0, 400.0, (2, 4))
    node, force = feet()
    node.sample(corners, True)
    for foot in range(2):
        vertical = corners[foot, :, 2]
        x, y, _ = vertical @ SOLES.corner[foot] / vertical.sum()
        xi, eta = (x - X0) / A, y / B
        expected = [0.25 * vertical.sum() * (1 + i * xi + k * eta) for i in (1, -1) for k in (1, -1)]
        np.testing.assert_allclose(force[foot, :, 2], expected, rtol=1e-9)


def test_load_on_one_corner_pulls_the_opposite_cell() -> None:
    corners = np.zeros((2, 4, 3))
    corners[0, 0, 2] = 400.0  # front left
    node, force = feet()
    node.sample(corners, True)
    assert force[0, 3, 2] < -100.0
    assert force[0, :, 2].sum() == pytest.approx(400.0)
    assert not force[1].any()


@pytest.mark.parametrize("seed", range(5))
def test_cells_have_the_same_total_force_and_moment_as_the_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(2, 4, 3)) * 100.0
    node, force = feet()
    node.sample(corners, True)
    for foot in range(2):
        np.testing.assert_allclose(force[foot].sum(axis=0), corners[foot].sum(axis=0), atol=1e-9)
        by_cells, by_corners = (
            np.cross(points[foot] * [1.0, 1.0, 0.0], forces[foot]).sum(axis=0)
            for points, forces in ((SOLES.cell, force), (SOLES.corner, corners))
        )
        np.testing.assert_allclose(by_cells, by_corners, atol=1e-9)


def test_foot_reads_zero_after_leaving_the_floor() -> None:
    node, force = feet()
    node.sample(np.full((2, 4, 3), 10.0), True)
    assert force.any()
    node.sample(np.zeros((2, 4, 3)), False)
    assert not force.any()


def test_lowest_corner_of_a_tilted_sole_is_at_its_low_edge() -> None:
    half = 0.1
    pitched = np.array([0.0, np.sin(half), 0.0, np.cos(half)])  # toes down
    height = SOLES.lowest(0, np.array([0.0, 0.0, 0.5]), pitched)
    toe = SOLES.corner[0, 0]
    assert height == pytest.approx(0.5 - np.sin(2 * half) * toe[0] + np.cos(2 * half) * toe[2])


@pytest.mark.parametrize("pad", ["left_foot_FL", "right_foot_RR"])
@pytest.mark.parametrize(
    ("reference", "sentence"),
    [
        ("child link=", "must be attached by a joint with an origin, got no such joint"),
        ("link name=", "must be a link with a collision sphere, got no such link"),
    ],
)
def test_contact_pad_without_a_joint_or_a_sphere_is_rejected(pad: str, reference: str, sentence: str) -> None:
    text = urdf(ExoskeletonParameters(), load_robot()).replace(f'{reference}"{pad}"', f'{reference}"spare"')
    with pytest.raises(ValueError, match=f"contact pad {pad} {sentence}"):
        read_soles(text)


@pytest.mark.parametrize("seed", range(10))
def test_vector_is_rotated_by_the_transposed_rotation_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    x, y, z, w = rotation.tolist()
    vector = rng.normal(size=3)
    expected = pinocchio.Quaternion(w, x, y, z).matrix().T @ vector
    np.testing.assert_allclose(into_frame(rotation, *vector.tolist()), expected, atol=1e-12)


def test_noise_is_reproducible_and_has_the_configured_deviation() -> None:
    node, _ = feet()
    first, again, other = np.zeros((3, 2000, 24))
    node.draw_noise(np.random.default_rng(1), first)
    node.draw_noise(np.random.default_rng(1), again)
    node.draw_noise(np.random.default_rng(2), other)
    assert first.tobytes() == again.tobytes() != other.tobytes()
    np.testing.assert_allclose(first.std(axis=0), np.tile(FootParameters().noise, 8), rtol=0.1)
