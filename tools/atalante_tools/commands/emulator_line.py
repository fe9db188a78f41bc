"""The bus of `atalante emulator`: HAL -> bus -> Line -> nodes, and back."""

from __future__ import annotations

import time

from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames


class Line(WrappedBus):
    """The emulated robot's bus: counts frames, and gives the pendant away.

    When somebody else speaks as the pendant, the emulated operator's own frames are kept back from then on, as a pendant
    process falls silent for a newer one.

    An interface that goes down is silence, as a pulled plug is to a robot: what the nodes say reaches nobody until it is up.

    Attributes:
        sent, received: frames so far.
        down: what the interface says while it is down; empty: nothing is wrong.
        pendant_given_away: somebody else speaks as the pendant.
    """

    def __init__(self, bus: Bus, pendant_id: int) -> None:
        super().__init__(bus)
        self._pendant_id = pendant_id
        self.sent = 0
        self.received = 0
        self.down = ""
        self.pendant_given_away = False

    def send(self, frames: Frames) -> None:
        """As `Bus.send`, without `BusDown`."""
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
        """As `Bus.receive`, without `BusDown`: after `timeout` [s] nothing has come."""
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
        """The batch less the pendant's frame; a batch without it is itself."""
        kept = frames["can_id"] != self._pendant_id
        return frames if kept.all() else frames[kept]
