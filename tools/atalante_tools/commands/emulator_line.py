"""Bus wrapper of `atalante emulator`, between the bus and the emulated nodes.

HAL <-> bus <-> Line <-> emulated nodes
"""

from __future__ import annotations

from atalante_hal.bus import Bus
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.wire.frame import Frames


class Line(ResilientBus):
    """Bus of the emulated robot. It counts frames, and drops the emulated pendant's frames if another pendant sends.

    Attributes:
        sent: Number of frames sent so far.
        received: Number of frames received so far.
        pendant_displaced: Whether another pendant has sent a frame.
    """

    def __init__(self, bus: Bus, pendant_id: int) -> None:
        super().__init__(bus)
        self._pendant_id = pendant_id
        self.sent = 0
        self.received = 0
        self.pendant_displaced = False

    def send(self, frames: Frames) -> None:
        """Send frames as `ResilientBus.send`, without those of the emulated pendant after a takeover.

        Args:
            frames: Frames to send.
        """
        if self.pendant_displaced:
            frames = self._without_pendant(frames)
        super().send(frames)
        if not self.down:
            self.sent += len(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames as `ResilientBus.receive`, and recognise another pendant.

        Args:
            frames: Buffer for the received frames.
            timeout: Longest wait for the first frame [s].
        """
        count = super().receive(frames, timeout)
        self.received += count
        if not self.pendant_displaced and (frames["can_id"][:count] == self._pendant_id).any():
            self.pendant_displaced = True
        return count

    def _without_pendant(self, frames: Frames) -> Frames:
        """Return all frames except the frames of the pendant."""
        kept = frames["can_id"] != self._pendant_id
        return frames if kept.all() else frames[kept]
