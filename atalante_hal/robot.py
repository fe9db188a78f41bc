"""The robot as data: names, order and limits of its joints, sensors and motors, read once from `robot.toml`.

Limiter, drives, model generator and controller all take their numbers from here.
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
class Robot:
    """Joint limits and transmission, arrays of shape (12,) in the order of `JOINTS`, read-only, joint side."""

    position_min: Vector  # rad
    position_max: Vector  # rad
    velocity_max: Vector  # rad/s
    torque_max: Vector  # Nm
    torque_rate_max: Vector  # Nm/s
    gear: Vector  # motor turns a joint turn
    polarity: Vector  # +1 or -1: encoder sign against the joint
    hold_kp: Vector  # Nm/rad, the drive's own position hold
    hold_kd: Vector  # Nm s/rad
    hash32: int  # CRC-32 of the file, as reported in HAL_STATUS


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
    except (OSError, ValueError, RecursionError) as error:
        raise RobotError(f"{path}: {error}") from error
    if set(document) != {"joints"}:
        raise RobotError(f"{path}: the only top-level table is 'joints', found {sorted(document)}")
    tables = document["joints"]
    if not isinstance(tables, dict) or set(tables) != set(LEG_JOINTS):
        raise RobotError(f"{path}: [joints] needs exactly the tables {', '.join(LEG_JOINTS)}")
    left = {key: np.array([_numbers(path, joint, tables[joint], key) for joint in LEG_JOINTS]) for key in _KEYS}

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
        hash32=zlib.crc32(raw),
    )


def _numbers(path: Path, joint: str, table: Any, key: str) -> list[float]:
    where = f"{path}: joints.{joint}"
    if not isinstance(table, dict):
        raise RobotError(f"{where} is a table with the keys {', '.join(_KEYS)}")
    if unknown := set(table) - set(_KEYS):
        raise RobotError(f"{where}.{sorted(unknown)[0]} is unknown; valid keys are {', '.join(_KEYS)}")
    if key not in table:
        raise RobotError(f"{where}.{key} is missing")
    value, valid = table[key], _KEYS[key]
    numbers = value if isinstance(value, list) else [value]
    # The comparison is false for NaN too.
    if len(numbers) != valid.size or not all(type(n) in (int, float) and valid.low <= n <= valid.high for n in numbers):
        what = "1 number" if valid.size == 1 else f"{valid.size} numbers"
        raise RobotError(
            f"{where}.{key} is {what} from {valid.low:.6g} to {valid.high:.6g} ({valid.unit}), not {value!r}"
        )
    if key == "position" and not numbers[0] < numbers[1]:
        raise RobotError(f"{where}.position is [min, max] with min < max, not {value!r}")
    if key == "polarity" and numbers[0] not in (-1, 1):
        raise RobotError(f"{where}.polarity is 1 or -1, not {value!r}")
    return [float(n) for n in numbers]


def _frozen(array: npt.NDArray[Any]) -> Vector:
    array = np.ascontiguousarray(array, dtype=np.float64)
    array.setflags(write=False)
    return array
