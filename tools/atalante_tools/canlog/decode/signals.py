"""Decoder that converts chunks of frames to columns of signal values for the output file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import ID_ERROR, ID_REMOTE
from atalante_tools.canlog.column_codec import Column, ColumnCodec, Words, payload_words
from atalante_tools.canlog.plan import UNKNOWN, Plan
from atalante_tools.canlog.reader.chunk import Chunk
from atalante_tools.canlog.stream import sort


@dataclass(frozen=True)
class DecodedFrames:
    """Decoded frames of one message in one chunk."""

    row: int  # index of the message in the plan
    codec: ColumnCodec
    raw: Words  # raw code of each field in each frame, shape (fields, n)
    stamps: npt.NDArray[np.int64]  # time stamp of each frame [ns], shape (n,)
    channels: npt.NDArray[np.uint8]  # for each frame: index of its channel in the channel list of the log
    indices: npt.NDArray[np.intp]  # for each frame: index in the chunk

    def column(self, index: int) -> Column:
        """Return the physical values of the field with the given index in `codec.fields`."""
        return Column(self.codec.values(self.raw, index), self.codec.present(self.raw, index))


class Sink(Protocol):
    """Output file for decoded signals."""

    values: int  # number of values so far

    def write(self, decoded: DecodedFrames, channels: Sequence[str]) -> None:
        """Add the signal values of the decoded frames of one message.

        Args:
            decoded: decoded frames of one message.
            channels: names of the channels of the log.
        """
        ...

    def flush(self) -> None:
        """Write the added values to the file."""
        ...

    def close(self) -> None:
        """Close the file. Values added after the last `flush` are lost."""
        ...


class Decoder:
    """Decoder of a log. It decodes one chunk at a time, and counts the skipped frames for each reason."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._lengths = np.append(plan.lengths, np.full(len(plan.refused), 255))
        self.frames = self.decoded = 0
        self._skipped: Counter[str] = Counter()

    @property
    def skipped(self) -> str:
        """Return the number of skipped frames for each reason, as text; empty if no frame was skipped."""
        return ", ".join(f"{count} frames {reason}" for reason, count in self._skipped.items() if count)

    def decode(self, chunk: Chunk) -> Iterator[DecodedFrames]:
        """Decode a chunk. Each yielded item contains all frames of one message."""
        plan, can_ids = self._plan, chunk.can_ids
        rows = plan.rows(can_ids & np.uint32(~ID_REMOTE & 0xFFFFFFFF))
        carries = (can_ids & np.uint32(ID_ERROR | ID_REMOTE)) == 0
        known = (rows != UNKNOWN) & carries
        supported = known & (rows < len(plan.layouts))
        long = chunk.frames["len"] >= self._lengths[np.where(supported, rows, 0)]
        good = supported & long
        self.frames += len(chunk)
        self._skipped["with an identifier that is not in the DBC"] += int((carries & ~known).sum())
        self._skipped["without data (remote or error)"] += int((~carries).sum())
        self._skipped["of messages with an unsupported layout"] += int((known & ~supported).sum())
        self._skipped["shorter than the message in the DBC"] += int((supported & ~long).sum())
        stream = sort(chunk, rows, np.flatnonzero(good))
        self.decoded += len(stream)
        for family in plan.families:
            span = stream.span(family.rows)
            if span.start == span.stop or not family.codec.fields:
                continue
            raw = family.codec.extract(payload_words(stream.frames[span], family.length))
            for row, first, end in stream.bounds(family):
                of = slice(span.start + first, span.start + end)
                indices = stream.indices[of]
                yield DecodedFrames(
                    row, family.codec, raw[:, first:end], stream.stamps[of], chunk.channels[indices], indices
                )
