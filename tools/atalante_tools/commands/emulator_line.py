"""Bus of `atalante emulator`: HAL <-> bus <-> Line <-> emulated nodes."""

from __future__ import annotations

import time

from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames


class Line(WrappedBus):
    """Bus of the emulated robot: counts frames, and yields to another pendant.

    After a frame of another pendant the frames of the emulated pendant are dropped, as a pendant process stops sending when a
    newer one starts.

    While the interface is down, sent frames are dropped and no frames are received, as with a disconnected cable.

    Attributes:
        sent: Number of frames sent so far.
        received: Number of frames received so far.
        down: Error message of the interface while it is down; empty while it is up.
        pendant_given_away: Whether another pendant has sent a frame.
    """

    def __init__(self, bus: Bus, pendant_id: int) -> None:
        super().__init__(bus)
        self._pendant_id = pendant_id
        self.sent = 0
        self.received = 0
        self.down = ""
        self.pendant_given_away = False

    def send(self, frames: Frames) -> None:
        """Send frames as `Bus.send`, but drop them while the interface is down.

        Args:
            frames: Frames to send.
        """
        if self.pendant_given_away:
            frames = self._without_pendant(frames)
        try:
            super().send(frames)
        except BusDown as error:
            self.down = str(error)
        else:
            self.down = ""
            self.sent += len(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames as `Bus.receive`, but return 0 after the timeout while the interface is down.

        Args:
            frames: Buffer that takes the received frames.
            timeout: Longest wait for the first frame [s].
        """
        try:
            count = super().receive(frames, timeout)
        except BusDown as error:
            self.down = str(error)
            time.sleep(timeout)
            return 0
        self.received += count
        if not self.pendant_given_away and (frames["can_id"][:count] == self._pendant_id).any():
            self.pendant_given_away = True
        return count

    def _without_pendant(self, frames: Frames) -> Frames:
        """Return the frames without those of the pendant; the same array if there are none."""
        kept = frames["can_id"] != self._pendant_id
        return frames if kept.all() else frames[kept]
