"""Gait: twelve joint trajectories of one right-stance step as Bezier polynomials, read from a file.

`gait file -> Gait -> StepTables (one row per ms)`. The left-stance step is the right-stance step of the mirrored robot:
the legs are swapped and each joint angle is multiplied by its MIRROR_SIGN. A gait that is not continuous at the stance
change, or that exceeds the limits of the robot, is rejected when the file is read.
"""

from __future__ import annotations

import json
import math
import sys
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import comb
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from atalante_hal.robot import JOINTS, LEG_JOINTS, MIRROR_SIGN, SIDES, Robot
from atalante_hal.types import PERIOD, Vector

FORMAT = "atalante-gait/1"
DEGREE = 7
AIRWALK_GAIT = Path(__file__).parents[1] / "gaits" / "airwalk.json"

#: Index and sign for mirroring: the angle of joint i of the mirrored robot is SIGN[i] times the angle of joint SWAP[i].
SWAP = np.r_[len(LEG_JOINTS) : len(JOINTS), 0 : len(LEG_JOINTS)]
SIGN = np.array(MIRROR_SIGN * len(SIDES), dtype=np.float64)

#: rad, largest accepted jump of a joint angle from the end of one motion to the start of the next motion
POSITION_JUMP = math.radians(0.1)
#: rad/s, largest accepted jump of a joint speed from the end of one motion to the start of the next motion
VELOCITY_JUMP = 0.05
DURATION_RANGE = (0.3, 3.0)  # s, shortest and longest duration of a step
ROUNDING = 1e-9  # rad, rad/s or Nm, tolerance for rounding errors in the limit checks

_REQUIRED = ("format", "name", "duration", "joints")
_OPTIONAL = ("kind", "feedforward", "parameters", "solver")
#: Kinds of steps: a periodic step, the start step from rest to walking, and the stop step from walking to rest.
Kind = Literal["periodic", "start", "stop"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_SIZE_MAX = 1_000_000  # byte, largest accepted size of a JSON file; a walk file has about 20,000 bytes


class GaitError(ValueError):
    """Invalid gait, or gait beyond a limit of the robot. The message states the key and the valid values."""

    code = "GAIT_INVALID"


@dataclass(frozen=True)
class StepTables:
    """Samples of a step, one per control cycle, both ends included. The arrays have shape (N + 1, 12) and are read-only."""

    q: Vector  # rad, joint angles
    qd: Vector  # rad/s, joint speeds
    qdd: Vector  # rad/s2, joint accelerations
    uf: Vector  # Nm, feedforward torque without gravity; zero for a gait without feedforward


@dataclass(frozen=True)
class Gait:
    """Gait, described by its right-stance step. `mirrored()` returns the left-stance step."""

    name: str
    duration: float  # s, duration T of the step
    coefficients: Vector  # (12, 8) rad, Bezier control points in the order of JOINTS
    feedforward: Vector | None = None  # (12, 8) Nm, Bezier control points of the feedforward u_f, without gravity
    parameters: Mapping[str, float] = field(default_factory=dict)  # name -> parameter of patient or step
    solver: Mapping[str, Any] = field(default_factory=dict)  # report of the solver, for information only
    kind: Kind = "periodic"

    @property
    def cycles(self) -> int:
        """Return N, the number of cycles in a step."""
        return round(self.duration / PERIOD)

    @property
    def hash32(self) -> int:
        """Return the identifier of the gait: CRC-32 of duration, trajectories and feedforward."""
        content = np.float64(self.duration).tobytes() + np.ascontiguousarray(self.coefficients).tobytes()
        if self.feedforward is not None:
            content += np.ascontiguousarray(self.feedforward).tobytes()
        return zlib.crc32(content)

    def mirrored(self) -> Gait:
        """Return the step with left and right exchanged: a right-stance step becomes a left-stance step."""
        feedforward = None if self.feedforward is None else _mirror(self.feedforward)
        return replace(self, coefficients=_mirror(self.coefficients), feedforward=feedforward)

    def tables(self) -> StepTables:
        """Return the trajectory of the step, with one row for each control cycle."""
        phase = _cycle_phases(self)
        uf = np.zeros_like(self.coefficients) if self.feedforward is None else self.feedforward
        tables = (*motion(self.coefficients, self.duration, phase), bezier(uf, phase))
        return StepTables(*map(_read_only, tables))


def bezier(coefficients: Vector, phase: Vector) -> Vector:
    """Evaluate Bezier polynomials.

    Args:
        coefficients: control points, shape (m, d + 1).
        phase: phases in [0, 1], shape (n,).

    Returns:
        Values, shape (n, m).
    """
    degree = coefficients.shape[1] - 1
    x = phase[:, None]
    k = np.arange(degree + 1)
    binomial = np.array([comb(degree, int(i)) for i in k], dtype=np.float64)
    basis: Vector = binomial * x**k * (1.0 - x) ** (degree - k)
    return basis @ coefficients.T


def derivative(coefficients: Vector) -> Vector:
    """Return the control points of the derivative with respect to the phase.

    Args:
        coefficients: control points, shape (m, d + 1).

    Returns:
        Control points of the derivative, shape (m, d).
    """
    return np.asarray((coefficients.shape[1] - 1) * np.diff(coefficients, axis=1))


def motion(coefficients: Vector, duration: float, phase: Vector) -> tuple[Vector, Vector, Vector]:
    """Evaluate angles, speeds and accelerations of a step.

    Args:
        coefficients: Bezier control points of m joints, shape (m, d + 1) [rad].
        duration: duration of the step [s].
        phase: phases in [0, 1], shape (n,).

    Returns:
        Angles [rad], speeds [rad/s] and accelerations [rad/s2], each of shape (n, m).
    """
    first = derivative(coefficients)
    return (
        bezier(coefficients, phase),
        bezier(first, phase) / duration,
        bezier(derivative(first), phase) / duration**2,
    )


def control_points(phase: Vector, values: Vector) -> Vector:
    """Fit polynomials of degree 7 to samples (least squares), and return their Bezier control points.

    Args:
        phase: phases in [0, 1], shape (n,).
        values: samples, shape (n, m).

    Returns:
        Control points, shape (m, 8), read-only.
    """
    basis = bezier(np.eye(DEGREE + 1), phase)
    return _read_only(np.linalg.lstsq(basis, values, rcond=None)[0].T.astype(np.float64))


def power_basis(coefficients: Vector) -> Vector:
    """Convert Bezier control points to the coefficients of the powers of the phase, lowest power first.

    Args:
        coefficients: control points, shape (m, d + 1).

    Returns:
        Coefficients, shape (m, d + 1).
    """
    degree = coefficients.shape[1] - 1
    change = np.zeros((degree + 1, degree + 1))
    for power in range(degree + 1):
        for k in range(power + 1):
            change[power, k] = comb(degree, power) * comb(power, k) * (-1) ** (power - k)
    return coefficients @ change.T


def load_gait(path: Path, robot: Robot) -> Gait:
    """Read a gait file (JSON) with a periodic step, and check it against the limits of the robot.

    Required keys: `format` ("atalante-gait/1"), `name`, `duration` [s], and `joints` with 8 Bezier control points [rad] of the
    right-stance step for each of JOINTS. Optional keys: `feedforward` (torque without gravity) with 8 control points
    [Nm] for each of JOINTS; `kind` ("periodic", "start" or "stop"; without this key the step is periodic); `parameters`, an
    object of numbers; `solver`, any object.

    Args:
        path: path of the gait file.
        robot: limits of the joints.

    Raises:
        GaitError: If a key is unknown, missing or malformed, if a value is not finite, if an angle jumps by more than
            0.1 degrees or a speed by more than 0.05 rad/s at the stance change, if a position, speed or feedforward
            exceeds a limit of the robot, or if the step is not periodic.
    """
    gait = gait_from(read_object(path), str(path))
    check_kind(gait, "periodic", str(path))
    check_gait(gait, robot, str(path))
    return gait


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that must contain an object.

    Args:
        path: path of the file.

    Raises:
        GaitError: If the file cannot be read, or if it is not a JSON object with unique keys and finite numbers.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_SIZE_MAX + 1)
    except OSError as error:
        raise GaitError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > _SIZE_MAX:
        raise GaitError(f"{path} is not a gait file: a gait file has at most {_SIZE_MAX} bytes")
    try:
        document = json.loads(content.decode("utf-8"), parse_constant=_reject_constant, object_pairs_hook=_unique_keys)
    except UnicodeDecodeError as error:
        raise GaitError(f"{path} is not a gait file: a gait file is text in JSON") from error
    except json.JSONDecodeError as error:
        raise GaitError(f"{path} is damaged or not a gait file: {error}") from error
    except (ValueError, RecursionError) as error:
        raise GaitError(f"{path}: {error}") from error
    if not isinstance(document, dict):
        raise GaitError(
            f"{path}: a gait file must be a JSON object with the keys {', '.join(_REQUIRED)}, "
            f"got {type(document).__name__}"
        )
    return document


def gait_from(document: Mapping[str, Any], where: str) -> Gait:
    """Return the gait of a JSON object. Limits and continuity are not checked here.

    Args:
        document: object with the keys of a gait file, see `load_gait`.
        where: start of the error message, for example the name of the file.

    Raises:
        GaitError: If a key is unknown, missing or malformed, or if a value is not finite.
    """
    if unknown := sorted(set(document) - {*_REQUIRED, *_OPTIONAL}):
        raise GaitError(f"{where}: {unknown[0]} is unknown; valid keys are {', '.join(_REQUIRED + _OPTIONAL)}")
    if missing := [key for key in _REQUIRED if key not in document]:
        raise GaitError(f"{where}: {missing[0]} is missing; required keys are {', '.join(_REQUIRED)}")
    if document["format"] != FORMAT:
        raise GaitError(f"{where}: format must be {FORMAT!r}, got {document['format']!r}")
    name, kind = document["name"], document.get("kind", "periodic")
    parameters, solver = document.get("parameters", {}), document.get("solver", {})
    if not (isinstance(name, str) and name):
        raise GaitError(f"{where}: name must be a non-empty text, got {name!r}")
    if kind not in KINDS:
        raise GaitError(f"{where}: kind must be {', '.join(KINDS[:-1])} or {KINDS[-1]}, got {kind!r:.80}")
    if not isinstance(parameters, dict) or not all(_is_number(value) for value in parameters.values()):
        raise GaitError(f"{where}: parameters must be an object of finite numbers, got {parameters!r}")
    if not isinstance(solver, dict):
        raise GaitError(f"{where}: solver must be an object, got {solver!r}")
    return Gait(
        name,
        _check_duration(document["duration"], where),
        _control_points(where, "joints", document["joints"]),
        _control_points(where, "feedforward", document["feedforward"]) if "feedforward" in document else None,
        {key: float(value) for key, value in parameters.items()},
        solver,
        kind,
    )


def check_kind(gait: Gait, kind: Kind, where: str) -> None:
    """Raise `GaitError` if a gait is not of the required kind.

    Args:
        gait: gait to check.
        kind: required kind.
        where: start of the error message, for example the name of the file.

    Raises:
        GaitError: If the gait is of another kind.
    """
    if gait.kind != kind:
        raise GaitError(f"{where}: kind must be {kind}, got {gait.kind}")


def write_gait(gait: Gait, path: Path) -> None:
    """Write a gait file atomically. `load_gait` returns the same numbers bit for bit.

    Args:
        gait: gait to write.
        path: path of the file, replaced if it exists.
    """
    write_object(gait_object(gait), path)


def gait_object(gait: Gait) -> dict[str, Any]:
    """Return a gait as a JSON object for `gait_from`.

    Args:
        gait: gait to convert.
    """
    document: dict[str, Any] = {
        "format": FORMAT,
        "name": gait.name,
        "kind": gait.kind,
        "duration": gait.duration,
    }
    document["joints"] = dict(zip(JOINTS, gait.coefficients.tolist(), strict=True))
    if gait.feedforward is not None:
        document["feedforward"] = dict(zip(JOINTS, gait.feedforward.tolist(), strict=True))
    return document | {"parameters": dict(gait.parameters), "solver": dict(gait.solver)}


def write_object(document: Mapping[str, Any], path: Path) -> None:
    """Write a JSON file atomically.

    Args:
        document: object to write; its numbers must be finite.
        path: path of the file, replaced if it exists.
    """
    unfinished = path.with_name(f"{path.name}.new")
    unfinished.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    unfinished.replace(path)


def check_gait(
    gait: Gait, robot: Robot, where: str = "gait", gravity: Callable[[Vector], Vector] | None = None
) -> None:
    """Raise `GaitError` if a gait is malformed, discontinuous at the stance change or beyond a limit of the robot.

    Angles, speeds and torques are compared with their limits in every cycle and at every extremum between cycles.

    Args:
        gait: gait to check; the left-stance step of the gait is checked too.
        robot: limits of the joints.
        where: start of the error message, for example the name of the file.
        gravity: function from a pose (12,) [rad] to the torque (12,) [Nm] that the controller adds to the feedforward. The torque
            limits apply to the sum of both torques. If None, the torque limits apply to the feedforward alone.

    Raises:
        GaitError: If the gait is rejected. The message states the joint, the limit, the value and the phase.
    """
    _check_form(gait, where)
    right, left = gait.tables(), gait.mirrored().tables()
    check_jump((right.q[-1], right.qd[-1]), (left.q[0], left.qd[0]), where, "at the stance change")
    check_step(gait, robot, where, gravity)


def check_jump(end: tuple[Vector, Vector], start: tuple[Vector, Vector], where: str, instant: str) -> None:
    """Raise `GaitError` if a joint angle or a joint speed jumps between the end of a motion and the start of the next motion.

    Args:
        end: angles [rad] and speeds [rad/s] of the joints at the end of the first motion, each of shape (12,).
        start: angles [rad] and speeds [rad/s] of the joints at the start of the second motion, each of shape (12,).
        where: start of the error message, for example the name of the file.
        instant: part of the error message that states where the motions meet, such as "at the stance change".

    Raises:
        GaitError: If a jump exceeds `POSITION_JUMP` or `VELOCITY_JUMP`. The message states the joint with the largest jump.
    """
    for before, after, limit, unit, scale in (
        (end[0], start[0], POSITION_JUMP, "deg", math.degrees(1.0)),
        (end[1], start[1], VELOCITY_JUMP, "rad/s", 1.0),
    ):
        jump = np.abs(before - after)
        worst = int(jump.argmax())
        if not jump[worst] <= limit:
            raise GaitError(
                f"{where}: jump of joints.{JOINTS[worst]} {instant} must be at most {scale * limit:.4g} {unit}, "
                f"got {scale * jump[worst]:.4g} {unit}"
            )


def check_step(
    gait: Gait, robot: Robot, where: str = "gait", gravity: Callable[[Vector], Vector] | None = None
) -> None:
    """Raise `GaitError` if a step is malformed or beyond a limit of the robot. Continuity is not checked.

    Args:
        gait: step to check; the mirrored step is checked too.
        robot: limits of the joints.
        where: start of the error message, as in `check_gait`.
        gravity: gravity torques, as in `check_gait`.

    Raises:
        GaitError: If the step is rejected, as in `check_gait`.
    """
    _check_form(gait, where)
    # The limits of left and right joints can differ, so both steps are checked.
    for stance, step in (("right", gait), ("left", gait.mirrored())):
        for phases in (_cycle_phases, _turning_points):
            _check_limits(step, phases(step), robot, gravity, where, stance)


def _check_form(gait: Gait, where: str) -> None:
    """Raise `GaitError` if an array has a wrong shape or type, a number is not finite, or the duration is not valid."""
    shape = len(JOINTS), DEGREE + 1
    for key, array in (("joints", gait.coefficients), ("feedforward", gait.feedforward)):
        if array is None and key == "feedforward":
            continue
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
            got = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            raise GaitError(f"{where}: {key} must be 64-bit floats of shape {shape}, got {got}")
        wrong = np.argwhere(~np.isfinite(array))
        if len(wrong):
            joint, point = wrong[0]
            raise GaitError(
                f"{where}: {key}.{JOINTS[joint]}[{point}] must be a finite number, got {array[joint, point]}"
            )
    # `np.float64` is a subclass of float, but `_check_duration` accepts only built-in numbers.
    _check_duration(float(gait.duration) if isinstance(gait.duration, float) else gait.duration, where)


def _check_limits(
    gait: Gait, phase: Vector, robot: Robot, gravity: Callable[[Vector], Vector] | None, where: str, stance: str
) -> None:
    """Raise `GaitError` if an angle, speed or torque of a step is beyond its limit at one of the given phases."""
    q, qd, _ = motion(gait.coefficients, gait.duration, phase)
    torque = np.zeros_like(q) if gait.feedforward is None else bezier(gait.feedforward, phase)
    if gravity is not None:
        torque = torque + np.array([gravity(pose) for pose in q]).reshape(q.shape)
    source = "feedforward" if gravity is None else "feedforward and gravity"
    for quantity, values, low, high, unit, scale in (
        ("angle", q, robot.position_min, robot.position_max, "deg", math.degrees(1.0)),
        ("speed", qd, -robot.velocity_max, robot.velocity_max, "rad/s", 1.0),
        (source, torque, -robot.torque_max, robot.torque_max, "Nm", 1.0),
    ):
        beyond = np.maximum(values - high, low - values)
        if not beyond.max(initial=0.0) <= ROUNDING:
            row, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
            found, least, most = (scale * x for x in (values[row, joint], low[joint], high[joint]))
            raise GaitError(
                f"{where}: {quantity} of joints.{JOINTS[joint]} must be {least:.5g} to {most:.5g} {unit}, got "
                f"{found:.5g} {unit} at phase {phase[row]:.3f} of the {stance}-stance step, "
                f"{scale * beyond[row, joint]:.2g} {unit} beyond the limit"
            )


def _cycle_phases(gait: Gait) -> Vector:
    """Return the phase of each control cycle of a step, both ends included, shape (N + 1,)."""
    return np.arange(gait.cycles + 1) / gait.cycles


def _turning_points(gait: Gait) -> Vector:
    """Return the phases in [0, 1] at which the angle, speed or feedforward of a joint has an extremum, shape (n,).

    Rounding can turn a double root into a complex pair, so the real part of every root is used. The result can therefore contain
    phases without an extremum. These phases do no harm.
    """
    slope = derivative(gait.coefficients)
    slopes = [slope, derivative(slope)]
    if gait.feedforward is not None:
        slopes.append(derivative(gait.feedforward))
    roots = [np.roots(row[::-1]).real for rows in slopes for row in power_basis(rows)]
    phases = np.concatenate(roots)
    return phases[(phases >= 0.0) & (phases <= 1.0)]


def _check_duration(value: Any, where: str) -> float:
    """Check that a duration [s] is in `DURATION_RANGE` and is a whole number of cycles, and return the duration."""
    low, high = DURATION_RANGE
    if not (_is_number(value) and low <= value <= high):
        raise GaitError(f"{where}: duration must be a number from {low} to {high} [s], got {value!r}")
    cycles = value / PERIOD
    if abs(cycles - round(cycles)) > 1e-6:
        raise GaitError(f"{where}: duration must be a whole number of milliseconds, got {value!r} s")
    return float(value)


def _control_points(where: str, key: str, table: Any) -> Vector:
    if not isinstance(table, dict):
        raise GaitError(
            f"{where}: {key} must be an object with one list for each of {', '.join(JOINTS)}, got {type(table).__name__}"
        )
    if unknown := sorted(set(table) - set(JOINTS)):
        raise GaitError(f"{where}: {key}.{unknown[0]} is unknown; valid joints are {', '.join(JOINTS)}")
    for joint in JOINTS:
        points = table.get(joint)
        if not isinstance(points, list) or len(points) != DEGREE + 1 or not all(_is_number(p) for p in points):
            raise GaitError(f"{where}: {key}.{joint} must be a list of {DEGREE + 1} finite numbers, got {points!r}")
    return _read_only(np.array([table[joint] for joint in JOINTS], dtype=np.float64))


def _is_number(value: Any) -> bool:
    # math.isfinite raises an exception for an integer above the largest float. The comparison works for every integer.
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def _reject_constant(text: str) -> float:
    raise ValueError(f"every number in a gait file must be finite, got {text}")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"key {repeated!r} must occur once, got it {names.count(repeated)} times")
    return found


def _mirror(rows: Vector) -> Vector:
    return _read_only(rows[SWAP] * SIGN[:, None])


def _read_only(array: Vector) -> Vector:
    array.setflags(write=False)
    return array


def step_over(cycle: int, cycles: int) -> bool:
    """Return whether the nominal duration of a step has passed.

    Args:
        cycle: number of cycles since the stance change.
        cycles: nominal duration of the step in cycles.
    """
    return cycle >= cycles
