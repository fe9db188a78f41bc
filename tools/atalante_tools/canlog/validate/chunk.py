"""Frames of a piece of a log as arrays: output of every log reader, input of every rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames

#: Direction of a frame in its log; `NO_DIRECTION` if the log does not record it.
SENT, RECEIVED, NO_DIRECTION = 1, 0, -1


class LogError(ValueError):
    """Error for a log that cannot be opened; the message gives the reason and what to do."""


@dataclass
class Chunk:
    """Frames of a piece of a log, in the order of the log. Shapes (n,)."""

    frames: Frames  # `FRAME` records
    stamps: npt.NDArray[np.int64]  # ns
    channels: npt.NDArray[np.uint8]  # index in the channel names of the log
    sent: npt.NDArray[np.int8]  # direction: SENT, RECEIVED or NO_DIRECTION

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, indices: npt.NDArray[Any]) -> Chunk:
        """Return part of the frames.

        Args:
            indices: indices of frames, or a mask of shape (n,).
        """
        return Chunk(self.frames[indices], self.stamps[indices], self.channels[indices], self.sent[indices])
