"""What a sensor at rest must say: an IMU gravity and no motion, a foot in the air no force, and both that they are alive."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_hal.hal import PERIOD
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.requirement import Outcome, Requirement

Vector = npt.NDArray[np.float64]

GRAVITY: Final = 9.81  # m/s2
#: Cycles a sensor is looked at.
_LOOK: Final = 100
#: Tolerances at rest.
NORM: Final = 1e-3  # of a unit quaternion
SPECIFIC_FORCE: Final = 0.3  # m/s2, of the mean
TILT: Final = math.radians(3.0)  # between measured gravity and attitude
RATE: Final = 0.05  # rad/s, of the mean against the attitude
UNLOADED: Final = 10.0  # N, of the mean of a cell's axis

_VECTOR: Final = ("X", "Y", "Z")
_AT_REST: Final = f"mean of {_LOOK} ms at rest"


def imu_requirements(_bench: Bench) -> list[Requirement]:
    """Of an IMU that lies still."""
    frames = "REP-103, DBC comment"
    return [
        Requirement(
            "IMU-01",
            f"Sends unit quaternions (within {NORM:g}).",
            f"every frame of {_LOOK} ms",
            frames,
            sends_unit_quaternions,
        ),
        Requirement(
            "IMU-02",
            f"Measures gravity at rest ({GRAVITY} m/s2 within {SPECIFIC_FORCE:g}).",
            _AT_REST,
            "DBC Accel",
            measures_gravity,
        ),
        Requirement(
            "IMU-03",
            f"Turns measured gravity upwards with its attitude (within {math.degrees(TILT):g} degrees).",
            _AT_REST,
            frames,
            agrees_with_gravity,
        ),
        Requirement(
            "IMU-04",
            f"Measures the rate at which its attitude changes, none at rest (within {RATE:g} rad/s).",
            f"mean of {_LOOK} ms",
            "DBC Gyro",
            agrees_with_attitude,
        ),
        Requirement(
            "IMU-05",
            "Never repeats the same rates and accelerations: no axis is stuck.",
            f"every axis over {_LOOK} ms",
            "fault matrix F32",
            _is_alive("Gyro", "Accel"),
        ),
        Requirement("IMU-06", "Says that it is well.", "ImuState", "DBC ImuState", _is_well("ImuState")),
    ]


def foot_requirements(bench: Bench) -> list[Requirement]:
    """Of a foot in the air."""
    cells = sorted({s.name.partition("_")[0] for s in bench.state_message.signals if s.name.endswith("_ForceZ")})
    return [
        Requirement(
            "FOOT-01",
            f"Measures no force in the air (each axis of each cell within {UNLOADED:g} N).",
            _AT_REST,
            "DBC Force",
            _is_unloaded(cells),
        ),
        Requirement(
            "FOOT-02",
            "Has no cell that is stuck.",
            f"every axis over {_LOOK} ms",
            "fault matrix F33",
            _is_alive(*(f"{cell}_Force" for cell in cells)),
        ),
        Requirement("FOOT-03", "Says that it is well.", "FootState", "DBC FootState", _is_well("FootState")),
    ]


def sends_unit_quaternions(bench: Bench) -> Outcome:
    """IMU-01."""
    norms = np.linalg.norm(_look(bench, "Quaternion", ("W", *_VECTOR)), axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    return Outcome(abs(worst - 1.0) <= NORM, f"norm {worst:.4f} at the worst")


def measures_gravity(bench: Bench) -> Outcome:
    """IMU-02."""
    measured = float(np.linalg.norm(_look(bench, "Accel", _VECTOR).mean(axis=0)))
    return Outcome(abs(measured - GRAVITY) <= SPECIFIC_FORCE, f"{measured:.2f} m/s2")


def agrees_with_gravity(bench: Bench) -> Outcome:
    """IMU-03."""
    look = _look_at(bench, [f"Quaternion{axis}" for axis in ("W", *_VECTOR)] + [f"Accel{axis}" for axis in _VECTOR])
    mean = look.mean(axis=0)
    w, x, y, z = mean[:4] / np.linalg.norm(mean[:4])
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])  # world z in the sensor
    cosine = float(up @ mean[4:] / np.linalg.norm(mean[4:]))
    tilt = math.acos(max(-1.0, min(1.0, cosine)))
    return Outcome(tilt <= TILT, f"{math.degrees(tilt):.2f} degrees apart")


def agrees_with_attitude(bench: Bench) -> Outcome:
    """IMU-04: an emulated robot without power sinks slowly, a node on a desk lies still."""
    look = _look_at(bench, [f"Quaternion{axis}" for axis in ("W", *_VECTOR)] + [f"Gyro{axis}" for axis in _VECTOR])
    (w0, *v0), (w1, *v1) = look[0, :4].tolist(), look[-1, :4].tolist()
    first, last = np.array(v0), np.array(v1)
    # Vector part of q0* q1: half the rotation between, in the sensor, while it is small.
    turned = 2.0 * (w0 * last - w1 * first - np.cross(first, last))
    off = np.abs(look[:, 4:].mean(axis=0) - turned / max(1, len(look) - 1) / PERIOD).max()
    return Outcome(bool(off <= RATE), f"{off:.4f} rad/s off at the worst")


def _is_alive(*vectors: str) -> Callable[[Bench], Outcome]:
    """Every axis of some vectors changes."""
    names = [f"{vector}{axis}" for vector in vectors for axis in _VECTOR]

    def test(bench: Bench) -> Outcome:
        look = _look_at(bench, names)
        stuck = [name for name, column in zip(names, look.T, strict=True) if np.ptp(column) == 0.0]
        return Outcome(not stuck, f"stuck: {', '.join(stuck)}" if stuck else f"all {len(names)} axes move")

    return test


def _is_well(name: str) -> Callable[[Bench], Outcome]:
    """The node's own state is 0."""

    def test(bench: Bench) -> Outcome:
        signal = bench.state_message.signal(name)
        said = {int(value) for value in _look_at(bench, [name])[:, 0]}
        return Outcome(said == {0}, ", ".join(signal.choices.get(value, str(value)) for value in sorted(said)))

    return test


def _is_unloaded(cells: Sequence[str]) -> Callable[[Bench], Outcome]:
    """No force on any cell."""
    names = [f"{cell}_Force{axis}" for cell in cells for axis in _VECTOR]

    def test(bench: Bench) -> Outcome:
        mean = _look_at(bench, names).mean(axis=0)
        worst = int(np.argmax(np.abs(mean)))
        return Outcome(bool(abs(mean[worst]) <= UNLOADED), f"{names[worst]} {mean[worst]:+.1f} N at the worst")

    return test


def _look(bench: Bench, vector: str, axes: Sequence[str]) -> Vector:
    return _look_at(bench, [f"{vector}{axis}" for axis in axes])


def _look_at(bench: Bench, names: Sequence[str]) -> Vector:
    """Signals of the state over some time. Shape (frames, names)."""
    heard = bench.states(bench.idle(_LOOK))
    if not heard:
        raise NotTested("no state frame was heard")
    return np.array([[h.values[name] for name in names] for h in heard])
