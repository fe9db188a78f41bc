"""CAN frames as records of a ring of their own: everything the HAL sends and receives, for a CAN log.

The HAL hands its arrays to a `RingTap`, which copies their bytes (one copy a batch) into a record of up to 64 frames; the
record goes into the ring when it is full, every second or third cycle. Which network bus a frame belongs to is not noted: ids are
unique network-wide, so the telemetry process looks it up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.wire.frame import FRAME, FRAME_BYTES, Frames

FRAMES_PER_RECORD = 64
#: Stamps are counted from `base_ns`.
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
    """Sees every frame the HAL sends and receives (`hal.FrameTap`) and puts it into a ring.

    Args:
        ring: of `FRAME_RECORD` records.
        now: time of a frame that is sent [ns]; the virtual time in lock-step.
        stamps: times of the frames last received [ns], e.g. `lambda: bus.stamps`; without it they get `now()`, too.
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
        """Stamps count from here on from `base_ns`: 0 for wall time, the start of the run for virtual time."""
        self.flush()
        self._base[0] = base_ns

    def sent(self, frames: Frames) -> None:
        """Frames just handed to the bus. Shape (n,)."""
        self._add(frames, len(frames), 1, None)

    def received(self, frames: Frames, count: int) -> None:
        """`frames[:count]` as they came from the bus."""
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
        """Put what has been gathered into the ring."""
        if self._used:
            self._count[0] = self._used
            self._ring.write(self._record)
            self._used = 0


def batches(records: npt.NDArray[np.uint8]) -> Iterator[tuple[Frames, Stamps, npt.NDArray[np.uint8]]]:
    """Frames, times [ns] and directions (1: sent) of each record that a reader of the ring got. Shapes (n,)."""
    for record in records:
        found = record.view(FRAME_RECORD)[0]
        count = int(found["count"])
        yield found["frames"][:count], found["stamps"][:count] + found["base_ns"], found["sent"][:count]
