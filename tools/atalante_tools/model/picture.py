"""Picture of the model with slightly bent knees: the boxes of every link, from behind and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np

from atalante_control.model import Box, Link
from atalante_hal.types import Vector

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Polygon

#: Joint angles in the picture [rad].
_POSE = {"SH": -0.25, "SK": 0.5, "SA": -0.25}
_MACHINE, _PATIENT, _SENSOR = "0.75", "tab:orange", "tab:red"


def draw(bodies: Sequence[Link], picture: Path) -> None:
    """Draw the links of the model to a file.

    Args:
        bodies: links, each after its parent.
        picture: file to write; the suffix sets the format.
    """
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 6.4), sharey=True)
    frames = _frames(bodies)
    for axis, (across, name) in zip(axes, ((1, "y (left) [m]"), (0, "x (forward) [m]")), strict=True):
        for body in bodies:
            rotation, origin = frames[body.name]
            for index, box in enumerate(body.boxes):
                corners = (_corners(box) @ rotation.T + origin)[:, [across, 2]]
                colour = _PATIENT if index else _MACHINE
                axis.add_patch(Polygon(_hull(corners), facecolor=colour, edgecolor="0.2", alpha=0.45, linewidth=0.8))
            if not body.boxes:
                axis.plot(origin[across], origin[2], ".", color=_SENSOR, markersize=5)
        axis.set_xlabel(name)
        axis.set_aspect("equal")
        axis.autoscale_view()
    axes[0].invert_xaxis()  # in a view from behind, the left leg is on the left
    axes[0].set_ylabel("z from the hips [m]")
    figure.suptitle("grey: exoskeleton, orange: patient, red: IMUs and force cells")
    figure.tight_layout()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _frames(bodies: Sequence[Link]) -> dict[str, tuple[Vector, Vector]]:
    """Return the rotation, shape (3, 3), and the origin, shape (3,) [m], of every link in the pelvis frame."""
    frames: dict[str, tuple[Vector, Vector]] = {"": (np.eye(3), np.zeros(3))}
    for body in bodies:
        rotation, origin = frames[body.parent]
        angle = _POSE.get(body.joint.split("_")[1], 0.0) if body.joint else 0.0
        own = rotation @ _turn((0.0, 0.0, 1.0), body.yaw) @ _turn(body.axis, angle)
        frames[body.name] = (own, origin + rotation @ np.array(body.origin))
    return frames


def _turn(axis: Sequence[float], angle: float) -> Vector:
    """Return the rotation matrix for an angle [rad] about a unit axis, by the formula of Rodrigues."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def _corners(box: Box) -> Vector:
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    return np.asarray(np.array(box.centre) + signs * np.array(box.size))


def _hull(points: Vector) -> Vector:
    """Return the convex hull of points, shape (n, 2), by Andrew's monotone chain algorithm."""
    ordered = sorted(map(tuple, points.tolist()))
    outline: list[tuple[float, ...]] = []
    for half in (ordered, ordered[::-1]):
        start = len(outline)
        for point in half:
            while len(outline) - start > 1 and _left_turn(outline[-2], outline[-1], point) <= 0.0:
                outline.pop()
            outline.append(point)
        outline.pop()
    return np.array(outline)


def _left_turn(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
