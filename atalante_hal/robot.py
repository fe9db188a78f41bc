"""The robot as data: names, order and limits of its joints, sensors and motors, read once from `robot.toml`.

Limiter, plausibility checks, drives, model generator and controller all take their numbers from here.
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

#: Joints of one leg, hip to foot: frontal, transverse, sagittal hip; sagittal knee; sagittal, henke ankle.
LEG_JOINTS = ("FH", "TH", "SH", "SK", "SA", "HA")
SIDES = ("left", "right")
JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in LEG_JOINTS)
#: q_right = sign * q_left for the mirrored pose, per leg joint.
MIRROR_SIGN = (-1, -1, 1, 1, 1, -1)
IMUS = ("torso", "pelvis", "left_tibia", "right_tibia")
FEET = SIDES
#: Force cells of one foot: front/rear, left/right in the foot frame.
CELLS = ("FL", "FR", "RL", "RR")
#: Vibration motors: front and back of each thigh and shank.
MOTORS = tuple(
    f"{side}_{segment}_{face}" for side in SIDES for segment in ("thigh", "shank") for face in ("front", "back")
)

ROBOT_FILE = Path(__file__).with_name("robot.toml")

Vector = npt.NDArray[np.float64]


class RobotError(ValueError):
    """The robot file does not describe this robot; the message names the key and what is valid."""

    code = "CONFIG_INVALID"


@dataclass(frozen=True)
class Envelope:
    """How torque fades towards the limits of position and velocity, see `limiter`."""

    look_ahead: float  # s, at its velocity, in which a joint has to stay inside its position limits
    position_margin: float  # rad past a position limit where no torque drives it any further
    velocity_margin: float  # rad/s past a velocity limit where no torque drives it any faster


@dataclass(frozen=True)
class Derating:
    """Torque a hot drive may give."""

    start: float  # degC, up to here all of it
    end: float  # degC, from here `floor`
    floor: float  # share of torque_max


@dataclass(frozen=True)
class Sensors:
    """What healthy sensors agree within, see `plausibility`."""

    velocity_error: float  # rad/s at the joint, reported velocity against the encoder, on average
    attitude_error: float  # rad, tibia against pelvis IMU, each axis, against the encoders between them
    attitude_change: float  # rad, by which that changes within a fraction of a second
    misalignment: float  # rad more for each rad the leg turns meanwhile
    quaternion_error: float  # of its squared norm against 1
    cell_free: float  # N, vertical: a force cell under this carries nothing
    cell_loaded: float  # N, vertical, three cells together: over this the fourth carries something


@dataclass(frozen=True)
class Thresholds:
    """What the HAL bears before it reacts, and how fast it does."""

    supply_low: float  # V, of a drive: below it the battery is nearly empty
    supply_under: float  # V, below it drives cannot hold much longer
    derated_imbalance: float  # share of its twin's torque on the other leg below which a hot drive no longer walks
    full_assist_ramp: float  # s, in which FULL_ASSIST leads the assistance factor from 0 to 1
    position_tolerance: float  # rad past a position limit from where on a joint is out of its range
    idle_torque: float  # Nm a drive may report when it is off, and beyond its limit when it is on
    surplus_frames: float  # beyond one of each cyclic message that a cycle may bring


@dataclass(frozen=True)
class Robot:
    """Limits, transmission and sensors; arrays of shape (12,) in the order of `JOINTS`, read-only, joint side."""

    position_min: Vector  # rad
    position_max: Vector  # rad
    velocity_max: Vector  # rad/s
    torque_max: Vector  # Nm
    torque_rate_max: Vector  # Nm/s
    gear: Vector  # motor turns a joint turn
    polarity: Vector  # +1 or -1: encoder sign against the joint
    hold_kp: Vector  # Nm/rad, the drive's own position hold
    hold_kd: Vector  # Nm s/rad
    encoder_noise: Vector  # rad rms
    breakaway: Vector  # Nm, change of torque that moves a joint out of dry friction
    envelope: Envelope
    derating: Derating
    sensors: Sensors
    thresholds: Thresholds
    hash32: int  # CRC-32 of the file, as reported in HAL_STATUS

    def torque_limit(self, temperature: Vector) -> Vector:
        """What a drive may give when it is this hot: `torque_max` up to `derating.start`, linear to `floor` at `end`.

        Args:
            temperature: as the drives report it, shape (12,) [degC].

        Returns:
            Shape (12,) [Nm].
        """
        start, end, floor = self.derating.start, self.derating.end, self.derating.floor
        return self.torque_max * np.clip(1.0 - (temperature - start) / (end - start) * (1.0 - floor), floor, 1.0)


class _Key(NamedTuple):
    """What a key of a joint table holds; the range is wide: it catches another unit or a slipped digit, not a bold design."""

    size: int
    low: float
    high: float
    unit: str


_KEYS = {
    "position": _Key(2, -math.pi, math.pi, "rad"),
    "velocity_max": _Key(1, 0.01, 50.0, "rad/s"),
    "torque_max": _Key(1, 0.1, 400.0, "Nm"),  # the command frame carries 409 Nm
    "torque_rate_max": _Key(1, 10.0, 1e6, "Nm/s"),
    "gear": _Key(1, 1.0, 1000.0, "motor turns a joint turn"),
    "polarity": _Key(1, -1.0, 1.0, "1 or -1"),
    "hold": _Key(2, 0.01, 1e5, "Nm/rad and Nm s/rad"),
    "encoder_noise": _Key(1, 1e-9, 1e-2, "rad"),
    "breakaway": _Key(1, 0.01, 400.0, "Nm"),
}
#: Keys of the tables beside [joints].
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
        "attitude_error": _Key(1, 1e-3, 0.5, "rad"),
        "attitude_change": _Key(1, 1e-4, 0.5, "rad"),
        "misalignment": _Key(1, 0.0, 0.5, "rad a rad"),
        "quaternion_error": _Key(1, 1e-4, 0.5, "of 1"),
        "cell_free": _Key(1, 1.0, 1000.0, "N"),
        "cell_loaded": _Key(1, 1.0, 3000.0, "N"),
    },
    "thresholds": {
        "supply_low": _Key(1, 5.0, 100.0, "V"),
        "supply_under": _Key(1, 5.0, 100.0, "V"),
        "derated_imbalance": _Key(1, 0.01, 1.0, "share of the other leg's"),
        "full_assist_ramp": _Key(1, 0.01, 60.0, "s"),
        "position_tolerance": _Key(1, 1e-3, 0.5, "rad"),
        "idle_torque": _Key(1, 0.1, 50.0, "Nm"),
        "surplus_frames": _Key(1, 1, 100, "frames"),
    },
}


def load_robot(path: Path | None = None) -> Robot:
    """Read the robot file strictly.

    Raises:
        RobotError: unknown or missing key, a value that is no number or far from any such joint, an empty range.
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
        raise RobotError(f"{path}: the top-level tables are joints, {', '.join(_TABLES)}, found {sorted(document)}")
    tables = document["joints"]
    if not isinstance(tables, dict) or set(tables) != set(LEG_JOINTS):
        raise RobotError(f"{path}: [joints] needs exactly the tables {', '.join(LEG_JOINTS)}")
    joints = {joint: _table(f"{path}: joints.{joint}", tables[joint], _KEYS) for joint in LEG_JOINTS}
    left = {key: np.array([joints[joint][key] for joint in LEG_JOINTS]) for key in _KEYS}
    others = {
        name: {key: numbers[0] for key, numbers in _table(f"{path}: {name}", document[name], keys).items()}
        for name, keys in _TABLES.items()
    }
    if not others["derating"]["start"] < others["derating"]["end"]:
        raise RobotError(f"{path}: derating.start is below derating.end, not {others['derating']['start']!r}")
    if not others["thresholds"]["supply_under"] < others["thresholds"]["supply_low"]:
        raise RobotError(
            f"{path}: thresholds.supply_under is below thresholds.supply_low, not {others['thresholds']['supply_under']!r}"
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
        envelope=Envelope(**others["envelope"]),
        derating=Derating(**others["derating"]),
        sensors=Sensors(**others["sensors"]),
        thresholds=Thresholds(**others["thresholds"]),
        hash32=zlib.crc32(raw),
    )


def _table(where: str, table: Any, keys: dict[str, _Key]) -> dict[str, list[float]]:
    """The numbers of each key of a table, which has exactly these."""
    if not isinstance(table, dict):
        raise RobotError(f"{where} is a table with the keys {', '.join(keys)}")
    if unknown := sorted(set(table) - set(keys)):
        raise RobotError(f"{where}.{unknown[0]} is unknown; valid keys are {', '.join(keys)}")
    if missing := [key for key in keys if key not in table]:
        raise RobotError(f"{where}.{missing[0]} is missing")
    return {key: _numbers(f"{where}.{key}", table[key], valid) for key, valid in keys.items()}


def _numbers(where: str, value: Any, valid: _Key) -> list[float]:
    numbers = value if isinstance(value, list) else [value]
    # The comparison is false for NaN too.
    if len(numbers) != valid.size or not all(type(n) in (int, float) and valid.low <= n <= valid.high for n in numbers):
        what = "1 number" if valid.size == 1 else f"{valid.size} numbers"
        raise RobotError(f"{where} is {what} from {valid.low:.6g} to {valid.high:.6g} ({valid.unit}), not {value!r}")
    if where.endswith(".position") and not numbers[0] < numbers[1]:
        raise RobotError(f"{where} is [min, max] with min < max, not {value!r}")
    if where.endswith(".polarity") and numbers[0] not in (-1, 1):
        raise RobotError(f"{where} is 1 or -1, not {value!r}")
    return [float(n) for n in numbers]


def _frozen(array: npt.NDArray[Any]) -> Vector:
    array = np.ascontiguousarray(array, dtype=np.float64)
    array.setflags(write=False)
    return array
