"""Requirements for sensors at rest: an IMU measures only gravity, a foot in the air measures no force, no signal is stuck."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from atalante_hal.types import GRAVITY, PERIOD, Vector
from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import Outcome, Requirement

#: Number of cycles in which a test measures a sensor.
_MEASURED: Final = 100
NORM: Final = 1e-3  # largest accepted difference between 1 and the length of a quaternion
#: Largest difference between the magnitude of the mean acceleration and `GRAVITY` [m/s2].
SPECIFIC_FORCE: Final = 0.3
#: For an IMU at rest: largest angle between the upward directions that accelerometer and quaternion give [rad].
TILT: Final = math.radians(3.0)
#: Largest difference between the rate of the gyro and the angular rate computed from the quaternions [rad/s].
RATE: Final = 0.05
UNLOADED: Final = 10.0  # largest accepted magnitude of the mean force on each axis of an unloaded force cell [N]

_VECTOR: Final = ("X", "Y", "Z")
_AT_REST: Final = f"mean of {_MEASURED} ms at rest"


def imu_requirements(_tester: NodeTester) -> list[Requirement]:
    """Return the requirements for an IMU at rest."""
    frames = "REP-103, DBC comment"
    return [
        Requirement(
            "IMU-01",
            f"Sends unit quaternions (within {NORM:g}).",
            f"every frame of {_MEASURED} ms",
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
            f"Reports an attitude that turns measured gravity upwards (within {math.degrees(TILT):g} degrees).",
            _AT_REST,
            frames,
            agrees_with_gravity,
        ),
        Requirement(
            "IMU-04",
            f"Measures the rate of its attitude, which is zero at rest (within {RATE:g} rad/s).",
            f"mean of {_MEASURED} ms",
            "DBC Gyro",
            agrees_with_attitude,
        ),
        Requirement(
            "IMU-05",
            "Reports changing rates and accelerations: no axis is stuck.",
            f"every axis over {_MEASURED} ms",
            "fault matrix F32",
            _changes("Gyro", "Accel"),
        ),
        Requirement("IMU-06", "Reports no error of its own.", "ImuState", "DBC ImuState", _has_no_error("ImuState")),
    ]


def foot_requirements(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for a foot in the air."""
    cells = sorted({s.name.partition("_")[0] for s in tester.state_message.signals if s.name.endswith("_ForceZ")})
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
            "Reports changing forces: no cell is stuck.",
            f"every axis over {_MEASURED} ms",
            "fault matrix F33",
            _changes(*(f"{cell}_Force" for cell in cells)),
        ),
        Requirement(
            "FOOT-03", "Reports no error of its own.", "FootState", "DBC FootState", _has_no_error("FootState")
        ),
    ]


def sends_unit_quaternions(tester: NodeTester) -> Outcome:
    """Test IMU-01: the quaternions have unit length."""
    norms = np.linalg.norm(_vectors(tester, "Quaternion", ("W", *_VECTOR)), axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    return Outcome(abs(worst - 1.0) <= NORM, f"worst norm {worst:.4f}")


def measures_gravity(tester: NodeTester) -> Outcome:
    """Test IMU-02: the magnitude of the mean acceleration equals gravity."""
    measured = float(np.linalg.norm(_vectors(tester, "Accel", _VECTOR).mean(axis=0)))
    return Outcome(abs(measured - GRAVITY) <= SPECIFIC_FORCE, f"{measured:.2f} m/s2")


def agrees_with_gravity(tester: NodeTester) -> Outcome:
    """Test IMU-03: accelerometer and quaternion give the same upward direction."""
    _, quaternions, acceleration = _attitudes(tester, "Accel")
    mean, force = quaternions.mean(axis=0), acceleration.mean(axis=0)
    if not (mean.any() and force.any()):  # a zero vector has no direction
        raise NotTested("the mean quaternion and the mean acceleration must not be 0; see IMU-01 and IMU-02")
    w, x, y, z = mean / np.linalg.norm(mean)
    # `up` is the world z axis in the sensor frame.
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
    cosine = float(up @ force / np.linalg.norm(force))
    tilt = math.acos(max(-1.0, min(1.0, cosine)))
    return Outcome(tilt <= TILT, f"{math.degrees(tilt):.2f} degrees between gravity and vertical")


def agrees_with_attitude(tester: NodeTester) -> Outcome:
    """Test IMU-04: the mean gyro rate equals the angular rate computed from the quaternions.

    An emulated robot without power sinks slowly, so the expected gyro rate is not zero.
    """
    cycles, quaternions, rate = _attitudes(tester, "Gyro")
    (w0, *v0), (w1, *v1) = quaternions[0].tolist(), quaternions[-1].tolist()
    first, last = np.array(v0), np.array(v1)
    # `turned` is the rotation between the first and the last frame, as a rotation vector in the sensor frame [rad].
    # For a small angle, `turned` is twice the vector part of the quaternion product conj(q0) q1.
    turned = 2.0 * (w0 * last - w1 * first - np.cross(first, last))
    duration = max(1, cycles[-1] - cycles[0]) * PERIOD
    deviation = np.abs(rate.mean(axis=0) - turned / duration).max()
    return Outcome(bool(deviation <= RATE), f"deviation at most {deviation:.4f} rad/s")


def _changes(*vectors: str) -> Callable[[NodeTester], Outcome]:
    """Return a test which requires that every axis of the named vectors changes."""
    names = [f"{vector}{axis}" for vector in vectors for axis in _VECTOR]

    def test(tester: NodeTester) -> Outcome:
        measured = _signals(tester, names)
        stuck = [name for name, column in zip(names, measured.T, strict=True) if np.ptp(column) == 0.0]
        return Outcome(not stuck, f"stuck: {', '.join(stuck)}" if stuck else f"all {len(names)} axes change")

    return test


def _has_no_error(name: str) -> Callable[[NodeTester], Outcome]:
    """Return a test which requires that the state signal `name` is 0 in every frame."""

    def test(tester: NodeTester) -> Outcome:
        signal = tester.state_message.signal(name)
        reported = {int(value) for value in _signals(tester, [name])[:, 0]}
        return Outcome(reported == {0}, ", ".join(signal.choices.get(value, str(value)) for value in sorted(reported)))

    return test


def _is_unloaded(cells: Sequence[str]) -> Callable[[NodeTester], Outcome]:
    """Return a test of the mean force on each axis of each cell. The magnitude of the mean must be at most `UNLOADED`."""
    names = [f"{cell}_Force{axis}" for cell in cells for axis in _VECTOR]

    def test(tester: NodeTester) -> Outcome:
        mean = _signals(tester, names).mean(axis=0)
        worst = int(np.argmax(np.abs(mean)))
        return Outcome(bool(abs(mean[worst]) <= UNLOADED), f"{names[worst]} {mean[worst]:+.1f} N is the largest mean")

    return test


def _attitudes(tester: NodeTester, vector: str) -> tuple[list[int], Vector, Vector]:
    """Run `_MEASURED` cycles and return the values of all n received state frames.

    A quaternion and its negative are the same attitude. So all quaternions are returned with the sign of the first one.

    Returns:
        Numbers of the cycles in which the frames arrived, quaternions wxyz, shape (n, 4), and the named vectors, shape (n, 3).
    """
    frames = _frames(tester)
    quaternions = _values(frames, [f"Quaternion{axis}" for axis in ("W", *_VECTOR)])
    signs = np.where(quaternions @ quaternions[0] < 0.0, -1.0, 1.0)
    values = _values(frames, [f"{vector}{axis}" for axis in _VECTOR])
    return [frame.cycle for frame in frames], signs[:, np.newaxis] * quaternions, values


def _vectors(tester: NodeTester, vector: str, axes: Sequence[str]) -> Vector:
    return _signals(tester, [f"{vector}{axis}" for axis in axes])


def _signals(tester: NodeTester, names: Sequence[str]) -> Vector:
    """Run `_MEASURED` cycles and return the named signals of all received state frames. Shape (frames, names)."""
    return _values(_frames(tester), names)


def _frames(tester: NodeTester) -> list[ReceivedFrame]:
    received = tester.states(tester.idle(_MEASURED))
    if not received:
        raise NotTested("no state frame of the DBC length received; see NODE-04 and NODE-13")
    return received


def _values(frames: Sequence[ReceivedFrame], names: Sequence[str]) -> Vector:
    return np.array([[frame.values[name] for name in names] for frame in frames])
