"""Bus for a program that continues to run while its CAN link is lost.

A link is lost when an interface goes down or an adapter is unplugged.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames

#: Longest wait of a call of `receive` while the link is lost [s]. Each of these calls tries the link once.
RETRY_PERIOD = 0.1
#: The error message of a lost link is reported when it has been the same for `SETTLE_TIME` [s].
#: A removed interface causes the error "down" and soon afterwards the error "removed". So only "removed" is reported.
SETTLE_TIME = 0.1


class ResilientBus(WrappedBus):
    """Bus that drops sent frames and receives no frames while its link is lost, as with a disconnected cable.

    A lost link is regarded as restored as soon as a frame was sent or received. `PythonCanBus.send` raises `BusDown` until a
    frame was received. If one channel of a `JoinedBus` is lost, the other channels continue.

    Args:
        bus: Wrapped bus. `close` closes it, too.
        report: Function called with the error message when the link is lost, and with a message when the link is back.

    Attributes:
        down: Error message of the link while it is lost; empty otherwise.
        losses: Number of losses so far.
        reopens: Whether the bus opens the link again after the last loss. If False, the program must be restarted.
    """

    def __init__(self, bus: Bus, report: Callable[[str], None] = lambda message: None) -> None:
        super().__init__(bus)
        self._report = report
        self.down = ""
        self.losses = 0
        self.reopens = True
        self._reported = ""  # error message that was reported for the current loss; empty if none was reported
        self._changed_at = 0.0  # time of the last change of `down` [s]

    def send(self, frames: Frames) -> None:
        """Send frames like `Bus.send`, but drop the frames while the link is lost.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If a transmit queue accepted only a part of the frames, also if another channel is lost.
        """
        try:
            super().send(frames)
        except BusDown as error:
            self._lost(error)
            if error.full is not None:
                raise error.full from error
        else:
            self._update_down(proven=True)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames like `Bus.receive`; while the link is lost, wait and return 0.

        Args:
            frames: Receive buffer, shape (m,).
            timeout: Longest wait for the first frame [s]; at most `RETRY_PERIOD` while the link is lost.

        Returns:
            Number of received frames.
        """
        if self.down:
            timeout = min(timeout, RETRY_PERIOD)
        begin = time.monotonic()
        try:
            count = super().receive(frames, timeout)
        except BusDown as error:
            self._lost(error)
            # `JoinedBus.receive` waits for frames before it raises `BusDown`. So subtract the time `waited` [s] from the sleep.
            waited = time.monotonic() - begin
            time.sleep(max(min(timeout, RETRY_PERIOD) - waited, 0.0))
            return 0
        self._update_down(proven=count > 0)
        return count

    def _update_down(self, *, proven: bool) -> None:
        """Update the error message `down` after the wrapped bus has sent or received without an error.

        `JoinedBus.receive` raises no error while one of its channels works, so check the attribute `loss` of the `JoinedBus`.

        Args:
            proven: True if a frame was sent or received, which proves that the link works.
        """
        if isinstance(self.bus, JoinedBus) and self.bus.loss:
            self._lost(self.bus.loss)
        elif proven and self.down:
            self._report(f"{self.name} is back" if self._reported else f"{self.name} was lost and is back")
            self.down = self._reported = ""
        elif self.down:
            self._report_settled()

    def _lost(self, error: BusDown) -> None:
        self.losses += not self.down
        self.reopens, message = error.reopens, str(error)
        if message != self.down:
            self.down, self._changed_at = message, time.monotonic()
        self._report_settled()

    def _report_settled(self) -> None:
        """Report the error message if it was not reported yet and has not changed for `SETTLE_TIME`."""
        if self.down != self._reported and time.monotonic() - self._changed_at >= SETTLE_TIME:
            self._reported = self.down
            self._report(f"{self.down}; waiting for the link" if self.reopens else self.down)
