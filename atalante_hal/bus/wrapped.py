"""A bus around a bus: what passes is seen, changed or kept back on its way."""

from __future__ import annotations

from atalante_hal.bus import Bus, Stamps
from atalante_hal.wire.frame import Frames


class WrappedBus:
    """The bus it is given, see `Bus`; a subclass says what becomes of the frames. `stamps` and `dropped` stay the wire's own."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus

    @property
    def name(self) -> str:
        """The channel, as messages to the user name it."""
        return self.bus.name

    @property
    def stamps(self) -> Stamps:
        """Receive times of the frames as they came from the wire. Shape (capacity,) int64 [ns]."""
        return self.bus.stamps

    @property
    def dropped(self) -> int:
        """Frames the wire itself lost."""
        return self.bus.dropped

    def send(self, frames: Frames) -> None:
        """As `Bus.send`."""
        self.bus.send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """As `Bus.receive`."""
        return self.bus.receive(frames, timeout)

    def close(self) -> None:
        """Leave the wire."""
        self.bus.close()
