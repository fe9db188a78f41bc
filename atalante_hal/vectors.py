"""Products of vectors with three elements, for compiled kernels. The results are tuples, so no array is allocated."""

from __future__ import annotations

from atalante_hal.types import Vector

Vector3 = tuple[float, float, float]


def rotated(matrix: Vector, v: Vector | Vector3) -> Vector3:
    """Return the product of a matrix and a vector.

    Args:
        matrix: matrix, shape (3, 3).
        v: vector of three elements.
    """
    a, b, c = v[0], v[1], v[2]
    return (
        matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c,
        matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c,
        matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c,
    )


def cross(a: Vector | Vector3, b: Vector | Vector3) -> Vector3:
    """Return the cross product of two vectors of three elements."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Vector | Vector3, b: Vector | Vector3) -> float:
    """Return the scalar product of two vectors of three elements."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
