"""Chunk: consecutive frames of a log as arrays. The log readers return chunks, and the rules check them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames

#: Direction of a frame in its log; `NO_DIRECTION` if the log does not record it.
SENT, RECEIVED, NO_DIRECTION = 1, 0, -1


class LogError(ValueError):
    """Raised if a log cannot be opened. The message gives the reason and the remedy."""


@dataclass
class Chunk:
    """Consecutive frames of a log. Each array has shape (n,)."""

    frames: Frames  # `FRAME` records
    stamps: npt.NDArray[np.int64]  # ns
    channels: npt.NDArray[np.uint8]  # index of the channel of each frame in the channel list of the log
    sent: npt.NDArray[np.int8]  # direction: SENT, RECEIVED or NO_DIRECTION

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, indices: npt.NDArray[Any]) -> Chunk:
        """Return a chunk with the selected frames.

        Args:
            indices: indices of frames, or a mask of shape (n,).
        """
        return Chunk(self.frames[indices], self.stamps[indices], self.channels[indices], self.sent[indices])
