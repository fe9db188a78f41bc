"""Gaits of a walk from standing to standing: start step, periodic step and stop step, in one object and in one file.

`walk file -> WalkGaits`. The walking controller follows these gaits. The start step begins at rest, with the weight on the
right foot, and ends with the angles and speeds at the end of the periodic step. The stop step begins with the angles and
speeds at the start of the periodic step, and ends at rest, with the weight on the stance foot.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from atalante_control.gait.gait import FORMAT as GAIT_FORMAT
from atalante_control.gait.gait import (
    Gait,
    GaitError,
    Kind,
    check_gait,
    check_jump,
    check_kind,
    check_step,
    gait_from,
    gait_object,
    motion,
    read_object,
    write_object,
)
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import Vector

FORMAT = "atalante-walk/1"
#: Walk of the default subject: 75 kg, 1.75 m, steps of 0.16 m in 0.8 s.
DEFAULT_WALK = Path(__file__).parents[1] / "gaits" / "walk.json"


#: Kind of each step of `WalkGaits`, in the same order.
WALK_KINDS: tuple[Kind, ...] = ("start", "periodic", "stop")


class WalkGaits(NamedTuple):
    """Right-stance steps of a walk. The mirrored steps are the left-stance steps."""

    start: Gait  # start step: begins at rest with the weight on the right foot; ends with the last angles and speeds of `step`
    step: Gait  # periodic step
    stop: Gait  # stop step: begins with the first angles and speeds of `step`; ends at rest with the weight on the stance foot

    @property
    def hash32(self) -> int:
        """Return the identifier of the walk, equal to the identifier of the periodic step."""
        return self.step.hash32


def load_walk(path: Path, robot: Robot) -> WalkGaits:
    """Read a walk file (JSON) and check it against the limits of the robot.

    Required keys: `format` ("atalante-walk/1"), and `start`, `step` and `stop`, each an object with the keys of a gait file. The
    `kind` of these objects is `start`, `periodic` and `stop`.

    Args:
        path: path of the walk file.
        robot: limits of the joints.

    Raises:
        GaitError: If a key is unknown, missing or malformed, if the steps do not fit together, or if a step is beyond a limit of
            the robot.
    """
    return walk_from(read_object(path), robot, str(path))


def load_gaits(path: Path, robot: Robot) -> Gait | WalkGaits:
    """Read a gait file with a periodic step, or a walk file. The key `format` distinguishes the two files.

    Args:
        path: path of the file.
        robot: limits of the joints.

    Raises:
        GaitError: If the file is neither a gait file nor a walk file, or if it is rejected as in `load_gait` or `load_walk`.
    """
    document = read_object(path)
    found = document.get("format")
    if found == FORMAT:
        return walk_from(document, robot, str(path))
    if found != GAIT_FORMAT:
        raise GaitError(f"{path}: format must be {GAIT_FORMAT!r} or {FORMAT!r}, got {found!r:.80}")
    gait = gait_from(document, str(path))
    check_kind(gait, "periodic", str(path))
    check_gait(gait, robot, str(path))
    return gait


def walk_from(document: Mapping[str, Any], robot: Robot, where: str) -> WalkGaits:
    """Return the walk of a JSON object, and check it against the limits of the robot.

    Args:
        document: object with the keys of a walk file, see `load_walk`.
        robot: limits of the joints.
        where: start of the error message, for example the name of the file.

    Raises:
        GaitError: If the walk is rejected, as in `load_walk`.
    """
    keys = {"format", *WalkGaits._fields}
    if set(document) != keys:
        raise GaitError(f"{where}: the keys of a walk file must be {', '.join(sorted(keys))}, got {sorted(document)}")
    if document["format"] != FORMAT:
        raise GaitError(f"{where}: format must be {FORMAT!r}, got {document['format']!r:.80}")
    gaits = []
    for kind in WalkGaits._fields:
        if not isinstance(document[kind], dict):
            raise GaitError(f"{where}: {kind} must be an object, got {type(document[kind]).__name__}")
        gaits.append(gait_from(document[kind], f"{where}: {kind}"))
    walk = WalkGaits(*gaits)
    check_walk(walk, robot, where)
    return walk


def write_walk(walk: WalkGaits, path: Path) -> None:
    """Write a walk file atomically. `load_walk` returns the same numbers bit for bit.

    Args:
        walk: walk to write.
        path: path of the file, replaced if it exists.
    """
    write_object({"format": FORMAT, **{kind: gait_object(gait) for kind, gait in walk._asdict().items()}}, path)


def check_walk(walk: WalkGaits, robot: Robot, where: str = "walk") -> None:
    """Raise `GaitError` if a step is invalid, or if the steps of a walk do not fit together.

    Args:
        walk: walk to check.
        robot: limits of the joints.
        where: start of the error message, for example the name of the file.

    Raises:
        GaitError: If the walk is rejected. The message states the step and the joint.
    """
    for key, kind in zip(WalkGaits._fields, WALK_KINDS, strict=True):
        check_kind(getattr(walk, key), kind, f"{where}: {key}")
    check_gait(walk.step, robot, f"{where}: step")
    check_step(walk.start, robot, f"{where}: start")
    check_step(walk.stop, robot, f"{where}: stop")
    at_rest = np.zeros(len(JOINTS))
    ends: dict[str, tuple[Gait, float]] = {"start": (walk.start, 1.0), "stop": (walk.stop, 0.0)}
    for name, (gait, phase) in ends.items():
        check_jump(_at(gait, phase), _at(walk.step, phase), where, f"between {name} and step")
        resting, speed = _at(gait, 1.0 - phase)
        check_jump((resting, speed), (resting, at_rest), where, f"between {name} and standing")


def _at(gait: Gait, phase: float) -> tuple[Vector, Vector]:
    q, qd, _ = motion(gait.coefficients, gait.duration, np.array([phase]))
    return q[0], qd[0]
