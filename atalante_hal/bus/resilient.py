"""Bus for a program that continues to run while its CAN link is lost.

A link is lost when an interface goes down or an adapter is unplugged. It is back when the interface is up again.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames

#: Longest wait of one `receive` on a lost link [s]. The next call tries the link again.
RETRY_PERIOD = 0.1


class ResilientBus(WrappedBus):
    """Bus that behaves like a disconnected cable while its link is lost: it drops sent frames and receives none.

    The first frame that is sent or received after a loss proves that the link is back.

    Args:
        bus: Wrapped bus. `close` closes it, too.
        report: Function called with the error message when the link is lost, and with a message when it is back.

    Attributes:
        down: Error message of the link while it is lost; empty otherwise.
        losses: Number of losses so far.
    """

    def __init__(self, bus: Bus, report: Callable[[str], None] = lambda message: None) -> None:
        super().__init__(bus)
        self._report = report
        self.down = ""
        self.losses = 0

    def send(self, frames: Frames) -> None:
        """Send frames as `Bus.send`, but drop them while the link is lost.

        Args:
            frames: Frames to send, shape (n,).
        """
        try:
            super().send(frames)
        except BusDown as error:
            self._lost(error)
        else:
            self._back()

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames as `Bus.receive`, but wait and return 0 while the link is lost.

        Args:
            frames: Receive buffer, shape (m,).
            timeout: Longest wait for the first frame [s]; at most `RETRY_PERIOD` while the link is lost.

        Returns:
            Number of received frames.
        """
        try:
            count = super().receive(frames, timeout)
        except BusDown as error:
            self._lost(error)
            time.sleep(min(timeout, RETRY_PERIOD))
            return 0
        if count:
            self._back()
        return count

    def _lost(self, error: BusDown) -> None:
        if not self.down:
            self.losses += 1
            self._report(f"{error}; waiting for it")
        self.down = str(error)

    def _back(self) -> None:
        if self.down:
            self.down = ""
            self._report(f"{self.name} is back")
