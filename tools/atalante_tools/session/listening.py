"""Reception of frames for some seconds, for commands that send nothing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from atalante_hal.bus import Bus
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.console.stop_request import StopRequest

#: Longest wait for a frame [s]. After each wait, clock, stop request and keyboard are checked.
POLL_TIMEOUT: Final = 0.02


def received(bus: Bus, seconds: float, stop: StopRequest) -> Iterator[tuple[Frames, int]]:
    """Listen to a bus, and yield the receive buffer together with the number of new frames in the buffer.

    Each call of `Bus.receive` yields one pair. A call ends after `POLL_TIMEOUT`, even if no frame was received.

    Args:
        bus: Bus to listen to.
        seconds: Listening time [s].
        stop: Stop request, which ends the listening early.
    """
    frames = new_frames(256)
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end and not stop.wanted:
        yield frames, bus.receive(frames, min(POLL_TIMEOUT, end - now))
