"""Recorder of the frames of the embedded bus, for the tests of the commands that listen."""

from __future__ import annotations

import numpy as np

from atalante_hal.wire.frame import Frames


class Tap:
    """Recorder of all frames of the embedded bus, in their order."""

    def __init__(self) -> None:
        self.batches: list[Frames] = []

    def sent(self, frames: Frames) -> None:
        self.batches.append(frames.copy())

    def received(self, frames: Frames, count: int) -> None:
        self.batches.append(frames[:count].copy())

    def cycles(self, sync: int) -> list[Frames]:
        """Return one block of frames for each cycle. Each block begins with the frame that has the identifier `sync`."""
        frames = np.concatenate(self.batches)
        return np.split(frames, np.flatnonzero(frames["can_id"] == sync))[1:]
