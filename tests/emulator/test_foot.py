from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest

from atalante_emulator.foot import Feet, FootParameters, into_frame

LEVEL = (0.0, 0.0, 0.0, 1.0)


def feet() -> tuple[Feet, np.ndarray]:
    force = np.full((2, 4, 3), 7.0)
    return Feet(FootParameters(), force), force


def test_in_the_air_every_cell_reads_zero() -> None:
    node, force = feet()
    node.sample((), [LEVEL, LEVEL])
    assert not force.any()


def test_forces_land_in_their_cell_and_add_up() -> None:
    node, force = feet()
    node.sample([(1, 2, (1.0, 2.0, 100.0)), (0, 0, (0.0, 0.0, 50.0)), (1, 2, (0.5, 0.0, 10.0))], [LEVEL, LEVEL])
    expected = np.zeros((2, 4, 3))
    expected[1, 2] = [1.5, 2.0, 110.0]
    expected[0, 0] = [0.0, 0.0, 50.0]
    np.testing.assert_allclose(force, expected)
    node.sample((), [LEVEL, LEVEL])
    assert not force.any()


def test_a_foot_that_toes_out_reads_in_its_own_axes() -> None:
    """Toes out by 8 degrees: a force straight ahead has a part to the foot's right."""
    half = math.radians(4.0)
    node, force = feet()
    node.sample([(0, 1, (10.0, 0.0, 0.0))], [(0.0, 0.0, math.sin(half), math.cos(half)), LEVEL])
    np.testing.assert_allclose(force[0, 1], [10 * math.cos(2 * half), -10 * math.sin(2 * half), 0.0])


@pytest.mark.parametrize("seed", range(10))
def test_rotation_is_the_transpose_of_the_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    x, y, z, w = rotation.tolist()
    vector = rng.normal(size=3)
    expected = pinocchio.Quaternion(w, x, y, z).matrix().T @ vector
    np.testing.assert_allclose(into_frame((x, y, z, w), tuple(vector.tolist())), expected, atol=1e-12)


def test_noise_is_seeded_and_of_the_stated_size() -> None:
    node, _ = feet()
    first, again, other = np.zeros((3, 2000, 24))
    node.draw_noise(np.random.default_rng(1), first)
    node.draw_noise(np.random.default_rng(1), again)
    node.draw_noise(np.random.default_rng(2), other)
    assert first.tobytes() == again.tobytes() != other.tobytes()
    np.testing.assert_allclose(first.std(axis=0), np.tile(FootParameters().noise, 8), rtol=0.1)
