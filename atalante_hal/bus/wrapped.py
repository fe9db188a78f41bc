"""Base class for a bus that observes, changes or delays the frames of another bus."""

from __future__ import annotations

from atalante_hal.bus import Bus, Stamps
from atalante_hal.wire.frame import Frames


class WrappedBus:
    """Bus that passes every call to the wrapped bus; a subclass overrides `send` or `receive`.

    Args:
        bus: Wrapped bus. `close` closes it, too.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus

    @property
    def name(self) -> str:
        """Return the name of the wrapped bus."""
        return self.bus.name

    @property
    def stamps(self) -> Stamps:
        """Return the receive times that the wrapped bus recorded, see `Bus.stamps`."""
        return self.bus.stamps

    @property
    def dropped(self) -> int:
        """Return how many incoming frames of the wrapped bus were lost or invalid."""
        return self.bus.dropped

    def send(self, frames: Frames) -> None:
        """Send frames on the wrapped bus, see `Bus.send`."""
        self.bus.send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames from the wrapped bus, see `Bus.receive`."""
        return self.bus.receive(frames, timeout)

    def close(self) -> None:
        """Close the wrapped bus."""
        self.bus.close()
