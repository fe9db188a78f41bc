"""Replacement for the CAN buses in the exhaustive searches. A search hands frames to the HAL without a network."""

from __future__ import annotations

import numpy as np

from atalante_hal.bus import Stamps
from atalante_hal.wire.frame import Frames, new_frames


class NoBus:
    """Bus without a network. The HAL receives the frames that a search has stored in `arriving`.

    Frames that the HAL sends are dropped.
    """

    name = "none"
    dropped = 0

    def __init__(self) -> None:
        self.arriving: Frames = new_frames(0)
        self.stamps: Stamps = np.zeros(256, np.int64)

    def send(self, frames: Frames) -> None:
        """Drop frames.

        Args:
            frames: sent frames, shape (n,).
        """

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Return the frames in `arriving`, and clear `arriving`.

        Args:
            frames: receive buffer, shape (m,).
            timeout: has no effect.

        Returns:
            Number of received frames.
        """
        count = len(self.arriving)
        frames[:count] = self.arriving
        self.arriving = self.arriving[:0]
        return count

    def close(self) -> None:
        """Do nothing; there is no resource to release."""
