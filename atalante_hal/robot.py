"""Description of the robot: names, order and limits of its joints, sensors and motors, read from `robot.toml`.

The limiter, the plausibility checks, the emulated drives, the model generator and the controller use these values.
"""

from __future__ import annotations

import math
import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.types import Vector

#: Joints of one leg: frontal, transverse and sagittal hip, sagittal knee, sagittal and Henke ankle.
LEG_JOINTS = ("FH", "TH", "SH", "SK", "SA", "HA")
SIDES = ("left", "right")
JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in LEG_JOINTS)
#: Sign of each leg joint for a mirrored pose: q_right = sign * q_left.
MIRROR_SIGN = (-1, -1, 1, 1, 1, -1)
IMUS = ("torso", "pelvis", "left_tibia", "right_tibia")
FEET = SIDES
#: Names of the four force cells of a foot: front or rear, then left or right, in the foot frame.
CELLS = ("FL", "FR", "RL", "RR")
#: Vibration motors: front and back of each thigh and shank.
MOTORS = tuple(
    f"{side}_{segment}_{face}" for side in SIDES for segment in ("thigh", "shank") for face in ("front", "back")
)

ROBOT_FILE = Path(__file__).with_name("robot.toml")
#: Distance between a joint and its position limit below which the joint is regarded as being at its end stop [rad].
AT_STOP = 0.005


class RobotError(ValueError):
    """Error in the robot file; the message names the key and its valid values."""

    code = "CONFIG_INVALID"


@dataclass(frozen=True)
class Envelope:
    """Reduction of the torque near the limits of position and velocity, see `limiter`."""

    look_ahead: float  # time over which the limiter predicts the joint position, at constant velocity [s]
    #: The outward torque is 0 if the predicted position is outside a position limit by `position_margin` [rad] or more.
    position_margin: float
    velocity_margin: float  # excess over the velocity limit at which the accelerating torque has fallen to 0 [rad/s]


@dataclass(frozen=True)
class Derating:
    """Torque limit of a hot drive as a function of its temperature."""

    start: float  # temperature above which the torque limit is reduced [degC]
    end: float  # temperature from which the torque limit has its smallest value, `floor` times `torque_max` [degC]
    floor: float  # share of torque_max, 0 to 1


@dataclass(frozen=True)
class Sensors:
    """Largest errors of sensors without a fault, and load thresholds of the force cells, see `plausibility`."""

    #: Largest mean difference [rad/s at the joint] between reported velocity and encoder velocity of a drive.
    #: The encoder velocity is computed from the encoder positions, and passes the same low-pass as the reported velocity.
    velocity_error: float
    velocity_bandwidth: float  # Hz, cut-off frequency of the low-pass with which a drive filters its reported velocity
    #: Largest difference [rad] about each axis between the tibia attitude from the encoders and the tibia attitude from the IMUs.
    attitude_error: float
    #: Largest change of (encoder angle - IMU angle) while the encoder reading is constant [rad].
    #: A larger change shows that the joint moves although its encoder reading is constant. So the encoder is stuck.
    attitude_change: float
    #: Factor for IMUs mounted askew: `misalignment` times the leg rotation [rad] is added to the limit `attitude_change`.
    #: Example: with a factor of 0.02, a leg rotation of 0.5 rad increases the limit by 0.01 rad.
    misalignment: float
    quaternion_error: float  # largest difference between the squared norm of a quaternion and 1
    cell_free: float  # N, largest vertical force at which a cell is regarded as unloaded
    cell_twist: float  # N, largest difference between the vertical forces FL + RR and FR + RL of a foot's cells
    sole_tilt: float  # rad, largest tilt of a sole on the floor, computed from the ankle encoders and the tibia IMU


@dataclass(frozen=True)
class Thresholds:
    """Thresholds and ramps of the HAL's fault reactions."""

    supply_low: float  # supply voltage at a drive below which the battery is nearly empty [V]
    supply_under: float  # supply voltage at a drive below which the drives may soon be unable to hold [V]
    #: Smallest torque limit of a hot drive with which walking is permitted, as a share of the limit of the other leg's drive.
    #: Example: with 0.5, a hot drive needs a torque limit of at least 100 Nm if the same drive of the other leg has 200 Nm.
    derated_imbalance: float
    full_assist_ramp: float  # s, time for the ramp of the assistance factor from 0 to 1 in FULL_ASSIST
    #: Largest accepted distance [rad] of a joint angle beyond its position limit. A joint with a larger distance is out of range.
    position_tolerance: float
    #: Largest plausible torque [Nm] that a drive reports while it is off.
    #: While a drive is on, a reported torque of up to `torque_max + idle_torque` is plausible.
    idle_torque: float
    #: Largest number of additional frames in a cycle, besides one frame of each cyclic message. More frames raise BUS_FLOOD.
    surplus_frames: float


@dataclass(frozen=True)
class Robot:
    """Limits, gear ratios and sensor tolerances of the robot.

    Arrays have shape (12,), in the order of `JOINTS`, on the joint side, and are read-only.
    """

    position_min: Vector  # rad
    position_max: Vector  # rad
    velocity_max: Vector  # rad/s
    torque_max: Vector  # Nm
    torque_rate_max: Vector  # Nm/s
    gear: Vector  # motor turns for each joint turn
    polarity: Vector  # +1 or -1: sign of the encoder direction relative to the joint
    hold_kp: Vector  # Nm/rad, stiffness of the position control in the drive
    hold_kd: Vector  # Nm s/rad, damping of the position control in the drive
    encoder_noise: Vector  # rad rms
    breakaway: Vector  # Nm, change of the drive torque that overcomes the dry friction and moves a joint at rest
    torque_error: Vector  # Nm rms, error of the torque that is computed from the motion of the leg
    envelope: Envelope
    derating: Derating
    sensors: Sensors
    thresholds: Thresholds
    hash32: int  # CRC-32 of the robot file, as reported in HAL_STATUS

    @property
    def top_speed(self) -> Vector:
        """Return the speed above which the limiter permits only braking torques, shape (12,) [rad/s]."""
        return self.velocity_max + self.envelope.velocity_margin

    def torque_limit(self, temperature: Vector) -> Vector:
        """Return the torque limit of each drive at its temperature.

        The limit is `torque_max` up to `derating.start` and falls linearly to `derating.floor * torque_max` at `derating.end`.

        Args:
            temperature: Temperatures that the drives report, shape (12,) [degC].

        Returns:
            Torque limits, shape (12,) [Nm].
        """
        start, end, floor = self.derating.start, self.derating.end, self.derating.floor
        return self.torque_max * np.clip(1.0 - (temperature - start) / (end - start) * (1.0 - floor), floor, 1.0)


class _Key(NamedTuple):
    """Rule for the value of one key: how many numbers, their range and their unit.

    The range is wide. It rejects wrong units and misplaced decimal points.
    """

    size: int
    low: float
    high: float
    unit: str


_KEYS = {
    "position": _Key(2, -math.pi, math.pi, "rad"),
    "velocity_max": _Key(1, 0.01, 50.0, "rad/s"),
    "torque_max": _Key(1, 0.1, 400.0, "Nm"),  # the command frame can encode at most 409 Nm
    "torque_rate_max": _Key(1, 10.0, 1e6, "Nm/s"),
    "gear": _Key(1, 1.0, 1000.0, "motor turns for each joint turn"),
    "polarity": _Key(1, -1.0, 1.0, "1 or -1"),
    "hold": _Key(2, 0.01, 1e5, "Nm/rad and Nm s/rad"),
    "encoder_noise": _Key(1, 1e-9, 1e-2, "rad"),
    "breakaway": _Key(1, 0.01, 400.0, "Nm"),
    "torque_error": _Key(1, 0.01, 100.0, "Nm"),
}
#: Table of the robot file -> its keys, each with the rule for its value. The keys of the table [joints] are in `_KEYS`.
_TABLES = {
    "envelope": {
        "look_ahead": _Key(1, 1e-3, 1.0, "s"),
        "position_margin": _Key(1, 1e-4, 0.2, "rad"),
        "velocity_margin": _Key(1, 0.01, 10.0, "rad/s"),
    },
    "derating": {
        "start": _Key(1, 40.0, 200.0, "degC"),
        "end": _Key(1, 40.0, 200.0, "degC"),
        "floor": _Key(1, 0.01, 1.0, "share of torque_max"),
    },
    "sensors": {
        "velocity_error": _Key(1, 0.01, 10.0, "rad/s"),
        "velocity_bandwidth": _Key(1, 1.0, 1000.0, "Hz"),
        "attitude_error": _Key(1, 1e-3, 0.5, "rad"),
        "attitude_change": _Key(1, 1e-4, 0.5, "rad"),
        "misalignment": _Key(1, 0.0, 0.5, "rad for each rad"),
        "quaternion_error": _Key(1, 1e-4, 0.5, "without unit"),
        "cell_free": _Key(1, 1.0, 1000.0, "N"),
        "cell_twist": _Key(1, 1.0, 1000.0, "N"),
        "sole_tilt": _Key(1, 0.001, 1.0, "rad"),
    },
    "thresholds": {
        "supply_low": _Key(1, 5.0, 100.0, "V"),
        "supply_under": _Key(1, 5.0, 100.0, "V"),
        "derated_imbalance": _Key(1, 0.01, 1.0, "share of the other leg's torque limit"),
        "full_assist_ramp": _Key(1, 0.01, 60.0, "s"),
        "position_tolerance": _Key(1, 1e-3, 0.5, "rad"),
        "idle_torque": _Key(1, 0.1, 50.0, "Nm"),
        "surplus_frames": _Key(1, 1, 100, "frames"),
    },
}


def load_robot(path: Path | None = None) -> Robot:
    """Read the robot file and check every key.

    Args:
        path: Robot file (TOML). With None, the `robot.toml` of this package is read.

    Returns:
        Limits, gear ratios and sensor tolerances of the robot.

    Raises:
        RobotError: If the file cannot be read, or if a key is unknown, missing or outside its valid range.
    """
    path = path or ROBOT_FILE
    try:
        raw = path.read_bytes()
        document = tomllib.loads(raw.decode())
    except OSError as error:
        raise RobotError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RobotError(f"{path}: {error}") from error
    if set(document) != {"joints", *_TABLES}:
        raise RobotError(f"{path} must have exactly the tables joints, {', '.join(_TABLES)}, got {sorted(document)}")
    tables = document["joints"]
    if not isinstance(tables, dict) or set(tables) != set(LEG_JOINTS):
        found = sorted(tables) if isinstance(tables, dict) else tables
        raise RobotError(f"{path}: [joints] must have exactly the tables {', '.join(LEG_JOINTS)}, got {found}")
    joints = {joint: _table(f"{path}: joints.{joint}", tables[joint], _KEYS) for joint in LEG_JOINTS}
    left = {key: np.array([joints[joint][key] for joint in LEG_JOINTS]) for key in _KEYS}
    scalars = {
        name: {key: numbers[0] for key, numbers in _table(f"{path}: {name}", document[name], keys).items()}
        for name, keys in _TABLES.items()
    }
    start, end = scalars["derating"]["start"], scalars["derating"]["end"]
    if not start < end:
        raise RobotError(f"{path}: derating.start must be below derating.end ({end!r}), got {start!r}")
    under, low_supply = scalars["thresholds"]["supply_under"], scalars["thresholds"]["supply_low"]
    if not under < low_supply:
        raise RobotError(
            f"{path}: thresholds.supply_under must be below thresholds.supply_low ({low_supply!r}), got {under!r}"
        )

    def both(column: Vector) -> Vector:
        return _frozen(np.concatenate([column, column]))

    low, high = left["position"].T
    mirrored = np.array(MIRROR_SIGN) < 0
    return Robot(
        position_min=_frozen(np.concatenate([low, np.where(mirrored, -high, low)])),
        position_max=_frozen(np.concatenate([high, np.where(mirrored, -low, high)])),
        velocity_max=both(left["velocity_max"][:, 0]),
        torque_max=both(left["torque_max"][:, 0]),
        torque_rate_max=both(left["torque_rate_max"][:, 0]),
        gear=both(left["gear"][:, 0]),
        polarity=both(left["polarity"][:, 0]),
        hold_kp=both(left["hold"][:, 0]),
        hold_kd=both(left["hold"][:, 1]),
        encoder_noise=both(left["encoder_noise"][:, 0]),
        breakaway=both(left["breakaway"][:, 0]),
        torque_error=both(left["torque_error"][:, 0]),
        envelope=Envelope(**scalars["envelope"]),
        derating=Derating(**scalars["derating"]),
        sensors=Sensors(**scalars["sensors"]),
        thresholds=Thresholds(**scalars["thresholds"]),
        hash32=zlib.crc32(raw),
    )


def _table(where: str, table: Any, keys: dict[str, _Key]) -> dict[str, list[float]]:
    """Return the numbers in a table, by key. The table must have exactly the given keys."""
    if not isinstance(table, dict):
        raise RobotError(f"{where} must be a table with the keys {', '.join(keys)}, got {table!r}")
    if unknown := sorted(set(table) - set(keys)):
        raise RobotError(f"{where}.{unknown[0]} is unknown; valid keys are {', '.join(keys)}")
    if missing := [key for key in keys if key not in table]:
        raise RobotError(f"{where}.{missing[0]} is missing; required keys are {', '.join(keys)}")
    return {key: _numbers(f"{where}.{key}", table[key], valid) for key, valid in keys.items()}


def _numbers(where: str, value: Any, valid: _Key) -> list[float]:
    numbers = value if isinstance(value, list) else [value]
    # The range comparison is false for NaN, so this check also rejects NaN.
    if len(numbers) != valid.size or not all(type(n) in (int, float) and valid.low <= n <= valid.high for n in numbers):
        count = "1 number" if valid.size == 1 else f"{valid.size} numbers"
        valid_range = f"from {valid.low:.6g} to {valid.high:.6g} ({valid.unit})"
        raise RobotError(f"{where} must be {count} {valid_range}, got {value!r}")
    if where.endswith(".position") and not numbers[0] < numbers[1]:
        raise RobotError(f"{where} must be [min, max] with min < max, got {value!r}")
    if where.endswith(".polarity") and numbers[0] not in (-1, 1):
        raise RobotError(f"{where} must be 1 or -1, got {value!r}")
    return [float(n) for n in numbers]


def _frozen(array: npt.NDArray[Any]) -> Vector:
    array = np.ascontiguousarray(array, dtype=np.float64)
    array.setflags(write=False)
    return array
