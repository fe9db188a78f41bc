"""Names of the links that a body needs, and their lookup in a physics engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from atalante_hal.robot import CELLS, FEET, IMUS

#: Links with an IMU, in the order of IMUS.
IMU_LINKS: Final = tuple(f"imu_{imu}" for imu in IMUS)
#: Links of the feet, in the order of FEET.
FOOT_LINKS: Final = tuple(f"{foot}_foot" for foot in FEET)
#: Contact pads at the force cells: the pads of the first foot, then the pads of the second foot.
PAD_LINKS: Final = tuple(f"{foot}_foot_{cell}" for foot in FEET for cell in CELLS)


def find(names: Sequence[str], available: dict[str, int], noun: str) -> list[int]:
    """Return the engine's indices of joints or links.

    Args:
        names: required names.
        available: index of each name in the engine.
        noun: `joint` or `link`, for the error message.

    Raises:
        ValueError: If a name is missing.
    """
    if missing := [name for name in names if name not in available]:
        raise ValueError(f"the URDF must contain the {noun}s {', '.join(names)}, got no {noun} {missing[0]}")
    return [available[name] for name in names]
