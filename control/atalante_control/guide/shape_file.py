"""Guide shapes from a file: `shape file (TOML) -> GuideShape`.

The file lists phases of the step. For each phase the file lists the distances from the desired trajectory to the guide, for the
sagittal hip (SH) and the sagittal knee (SK). These distances are valid at the assistance factor 0. The key `scaling` of the file
selects how the distances change with the assistance factor.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from atalante_control.guide.shapes import JOINTS, SHAPES, GuideShape, half_width
from atalante_hal.types import Vector

FORMAT = "atalante-guide-shape/1"
LARGEST = 90.0  # deg, largest accepted distance between desired trajectory and guide

_REQUIRED = ("format", "name", "phase", *JOINTS)
_OPTIONAL = ("summary", "interpolation", "scaling")
_SIDES = ("upper", "lower")
_INTERPOLATIONS = ("linear", "cosine")
_SCALINGS = ("proportional", "cap")
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}", re.ASCII)


class ShapeError(ValueError):
    """Invalid shape file. The message states the file, the key or line, and the valid values."""

    code = "CONFIG_INVALID"


def load_shape(path: Path) -> GuideShape:
    """Read a shape file.

    Required keys: `format` ("atalante-guide-shape/1"), `name`, `phase` (ascending from 0 to 1), and tables `SH` and `SK`, each
    with the lists `upper` and `lower` of distances [deg] at these phases, for the assistance factor 0. Optional keys: `summary`;
    `interpolation` between the knots, "linear" (default) or "cosine"; `scaling`, "proportional" (default: all distances are
    multiplied by the half-width at Xi divided by the half-width at 0) or "cap" (distances are limited to the half-width at Xi).

    Args:
        path: path of the shape file.

    Raises:
        ShapeError: If the file cannot be read, a key is unknown, missing or malformed, or a distance is not positive and finite.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ShapeError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # the message of a TOML syntax error contains line and column
        raise ShapeError(f"{path}: {error}") from error
    try:
        return _shape(document)
    except ValueError as error:
        raise ShapeError(f"{path}: {error}") from error


def _shape(document: Mapping[str, Any]) -> GuideShape:
    _check_keys(document, _REQUIRED, _OPTIONAL, "")
    if document["format"] != FORMAT:
        raise ValueError(f"format must be {FORMAT!r}, got {document['format']!r}")
    name, summary = document["name"], document.get("summary", "")
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError(
            f"name must start with a lower-case letter, and have at most 32 characters (a-z, 0-9, - and _), got {name!r}"
        )
    if name in SHAPES:
        raise ValueError(
            f"name must differ from the names of this package's shapes ({', '.join(SHAPES)}), got {name!r}"
        )
    if not isinstance(summary, str):
        raise ValueError(f"summary must be a text, got {summary!r}")
    cosine = _choice(document, "interpolation", _INTERPOLATIONS) == "cosine"
    capped = _choice(document, "scaling", _SCALINGS) == "cap"
    phases = _phases(document["phase"])
    distances = np.radians([_distances(document[joint], joint, len(phases)) for joint in JOINTS])

    def fractions(phase: Vector, width: float) -> tuple[Vector, Vector]:
        phase = _warped(phase, phases) if cosine else phase
        upper, lower = (
            np.stack([np.interp(phase, phases, distances[joint, side]) for joint in range(len(JOINTS))])
            for side in range(len(_SIDES))
        )
        if capped:
            return np.minimum(upper / width, 1.0), np.minimum(lower / width, 1.0)
        return upper / half_width(0.0), lower / half_width(0.0)

    return GuideShape(name, summary, fractions)


def _warped(phase: Vector, knots: Vector) -> Vector:
    """Convert phases so that a linear interpolation (`np.interp`) at the new phases gives half-cosine transitions.

    Between two knots, a half-cosine interpolation follows half a period of a cosine in place of a straight line. Example: the
    phase at one quarter of the way between two knots becomes the phase at 15 % of this way.

    Args:
        phase: phases of the step, shape (n,).
        knots: phases of the shape file, ascending from 0 to 1.
    """
    at = np.clip(np.searchsorted(knots, phase, side="right") - 1, 0, len(knots) - 2)
    length = knots[at + 1] - knots[at]
    return np.asarray(knots[at] + length * (0.5 - 0.5 * np.cos(math.pi * (phase - knots[at]) / length)))


def _check_keys(table: Mapping[str, Any], required: tuple[str, ...], optional: tuple[str, ...], prefix: str) -> None:
    if unknown := [key for key in table if key not in required + optional]:
        raise ValueError(f"{prefix}{unknown[0]} is unknown; valid keys are {', '.join(required + optional)}")
    if missing := [key for key in required if key not in table]:
        raise ValueError(f"{prefix}{missing[0]} is missing; required keys are {', '.join(required)}")


def _choice(document: Mapping[str, Any], key: str, valid: tuple[str, ...]) -> str:
    """Return the value of an optional key. The default is the first of the valid values."""
    value = document.get(key, valid[0])
    if value not in valid:
        raise ValueError(f"{key} must be one of {', '.join(valid)}, got {value!r}")
    return str(value)


def _phases(values: Any) -> Vector:
    if not isinstance(values, list) or len(values) < 2 or not all(map(_is_number, values)):
        raise ValueError(f"phase must be a list of at least 2 numbers, got {values!r}")
    if values[0] != 0.0 or values[-1] != 1.0:
        raise ValueError(f"phase must start at 0 and end at 1, got {values[0]!r} and {values[-1]!r}")
    for position, (before, after) in enumerate(pairwise(values), start=1):
        if not before < after:
            raise ValueError(f"phase[{position}] must be above phase[{position - 1}] ({before!r}), got {after!r}")
    return np.array(values, dtype=np.float64)


def _distances(table: Any, joint: str, count: int) -> Vector:
    """Return the angles from the desired trajectory to the guide bounds of a joint, shape (2, count) [deg].

    Row 0: upper bound. Row 1: lower bound. Columns: the phases of the file; `count` is the number of phases.
    """
    if not isinstance(table, dict):
        raise ValueError(f"{joint} must be a table with the lists {' and '.join(_SIDES)}, got {table!r}")
    _check_keys(table, _SIDES, (), f"{joint}.")
    for side in _SIDES:
        values = table[side]
        if not isinstance(values, list) or len(values) != count:
            raise ValueError(f"{joint}.{side} must be a list of {count} numbers, one for each phase, got {values!r}")
        for position, value in enumerate(values):
            if not (_is_number(value) and 0.0 < value <= LARGEST):
                raise ValueError(
                    f"{joint}.{side}[{position}] must be a number of degrees above 0 and at most {LARGEST:g}, got {value!r}"
                )
    return np.array([table[side] for side in _SIDES], dtype=np.float64)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and -math.inf < value < math.inf
