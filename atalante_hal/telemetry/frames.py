"""Records of the ring buffer that passes the CAN frames of the HAL to a CAN log.

The HAL passes its frame arrays to a `RingTap`. The tap collects the frames in a record of up to 64 frames. The record is
full after two or three cycles, and then the tap writes it to the ring. The record does not contain the bus of a frame.
The telemetry process derives the bus from the frame identifier, which is unique in the network.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.wire.frame import FRAME, FRAME_BYTES, Frames

FRAMES_PER_RECORD = 64
#: Record of CAN frames. Only the first `count` frames are used. The time of a frame is `base_ns` plus its stamp [ns].
#: The flag `sent` is 1 for a frame that the HAL sent and 0 for a received frame.
FRAME_RECORD = np.dtype(
    [
        ("count", "<i8"),
        ("base_ns", "<i8"),
        ("stamps", "<i8", FRAMES_PER_RECORD),
        ("sent", "u1", FRAMES_PER_RECORD),
        ("frames", FRAME, FRAMES_PER_RECORD),
    ]
)

Stamps = npt.NDArray[np.int64]


class RingTap:
    """Frame tap (`transceiver.FrameTap`) that copies each sent and each received frame of the HAL to a ring.

    Args:
        ring: Ring of `FRAME_RECORD` records.
        now: Function that returns the time of a sent frame [ns]; virtual time in lock-step.
        stamps: Function that returns the times of the frames received last [ns], e.g. `lambda: bus.stamps`. If None,
            received frames also get the time `now()`.
    """

    def __init__(
        self, ring: RingWriter, now: Callable[[], int] = time.time_ns, stamps: Callable[[], Stamps] | None = None
    ) -> None:
        self._ring, self._now, self._stamps_of_batch = ring, now, stamps
        record = np.zeros(1, FRAME_RECORD)
        self._record = record.view(np.uint8).data
        self._count, self._base = record["count"], record["base_ns"]
        self._stamps, self._sent = record["stamps"][0], record["sent"][0]
        self._frames = record["frames"].view(np.uint8)[0]
        self._used = 0

    def begin_run(self, base_ns: int) -> None:
        """Set the time that is added to the stamps of all following frames.

        Args:
            base_ns: Time of stamp 0 [ns]. On the wall clock this is 0. In virtual time it is the start of the run.
        """
        self.flush()
        self._base[0] = base_ns

    def sent(self, frames: Frames) -> None:
        """Store frames that were just passed to the bus.

        Args:
            frames: Sent frames, shape (n,).
        """
        self._add(frames, len(frames), 1, None)

    def received(self, frames: Frames, count: int) -> None:
        """Store frames that were just received.

        Args:
            frames: Receive buffer, shape (m,).
            count: Number of received frames at the start of the buffer.
        """
        self._add(frames, count, 0, self._stamps_of_batch() if self._stamps_of_batch is not None else None)

    def _add(self, frames: Frames, count: int, sent: int, stamps: Stamps | None) -> None:
        source, done = frames.view(np.uint8), 0
        now = self._now() if stamps is None else 0
        while done < count:
            at = self._used
            if at == FRAMES_PER_RECORD:
                self.flush()
                at = 0
            fit = min(count - done, FRAMES_PER_RECORD - at)
            end = at + fit
            self._frames[at * FRAME_BYTES : end * FRAME_BYTES] = source[done * FRAME_BYTES : (done + fit) * FRAME_BYTES]
            self._sent[at:end] = sent
            self._stamps[at:end] = now if stamps is None else stamps[done : done + fit]
            self._used = end
            done += fit

    def flush(self) -> None:
        """Write the collected frames to the ring buffer."""
        if self._used:
            self._count[0] = self._used
            self._ring.write(self._record)
            self._used = 0


def batches(records: npt.NDArray[np.uint8]) -> Iterator[tuple[Frames, Stamps, npt.NDArray[np.uint8]]]:
    """Yield the frames of each record of the ring buffer.

    Args:
        records: Records as `RingReader.read` returns them, shape (k, record size) bytes.

    Yields:
        Frames, times [ns] and directions (1: sent, 0: received) of one record, each of shape (n,).
    """
    for record in records:
        found = record.view(FRAME_RECORD)[0]
        count = int(found["count"])
        yield found["frames"][:count], found["stamps"][:count] + found["base_ns"], found["sent"][:count]
