"""Bus wrapper of `atalante emulator`, between the bus and the emulated nodes.

HAL <-> bus <-> Line <-> emulated nodes
"""

from __future__ import annotations

import time

from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames


class Line(WrappedBus):
    """Bus of the emulated robot. It counts frames, and drops the emulated pendant's frames if another pendant sends.

    While the interface is down, sent frames are dropped and no frames are received, as with a disconnected cable.

    Attributes:
        sent: Number of sent frames.
        received: Number of received frames.
        down: Error message of the interface while it is down. Empty while it is up.
        pendant_displaced: Whether another pendant sent a frame.
    """

    def __init__(self, bus: Bus, pendant_id: int) -> None:
        super().__init__(bus)
        self._pendant_id = pendant_id
        self.sent = 0
        self.received = 0
        self.down = ""
        self.pendant_displaced = False

    def send(self, frames: Frames) -> None:
        """Send frames like `Bus.send`. While the interface is down, drop them.

        Args:
            frames: Frames to send.
        """
        if self.pendant_displaced:
            frames = self._without_pendant(frames)
        try:
            super().send(frames)
        except BusDown as error:
            self.down = str(error)
        else:
            self.down = ""
            self.sent += len(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames like `Bus.receive`. While the interface is down, wait for the timeout and return 0.

        Args:
            frames: Buffer for the received frames.
            timeout: Longest wait for the first frame [s].
        """
        try:
            count = super().receive(frames, timeout)
        except BusDown as error:
            self.down = str(error)
            time.sleep(timeout)
            return 0
        self.received += count
        if not self.pendant_displaced and (frames["can_id"][:count] == self._pendant_id).any():
            self.pendant_displaced = True
        return count

    def _without_pendant(self, frames: Frames) -> Frames:
        """Return all frames except the frames of the pendant."""
        kept = frames["can_id"] != self._pendant_id
        return frames if kept.all() else frames[kept]
