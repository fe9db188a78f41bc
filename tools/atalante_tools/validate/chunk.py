"""A piece of a log as arrays: what every reader delivers and every rule is judged on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import Frames

#: Direction of a frame as its log says it.
SENT, RECEIVED, NOT_SAID = 1, 0, -1


class LogError(ValueError):
    """The log cannot be opened at all; the message says why, and what would be right."""


@dataclass
class Chunk:
    """Frames in the order of the log. Shapes (n,)."""

    frames: Frames  # `FRAME` records
    stamps: npt.NDArray[np.int64]  # ns
    channels: npt.NDArray[np.uint8]  # number of the log's channel
    sent: npt.NDArray[np.int8]  # SENT, RECEIVED or NOT_SAID

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, places: npt.NDArray[Any]) -> Chunk:
        """The frames at these places, or where a mask is True."""
        return Chunk(self.frames[places], self.stamps[places], self.channels[places], self.sent[places])
