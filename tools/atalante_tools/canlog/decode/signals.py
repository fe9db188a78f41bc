"""Decoder from chunks of frames to columns of signals, which the sinks write to files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import ID_ERROR, ID_REMOTE
from atalante_tools.canlog.column_codec import BulkCodec, Column, Words, payload_words
from atalante_tools.canlog.validate.chunk import Chunk
from atalante_tools.canlog.validate.plan import UNKNOWN, Plan
from atalante_tools.canlog.validate.stream import sort


@dataclass(frozen=True)
class Piece:
    """Decoded frames of one message in one chunk."""

    row: int  # row of the message in the plan
    codec: BulkCodec
    raw: Words  # shape (fields, n)
    stamps: npt.NDArray[np.int64]  # ns
    channels: npt.NDArray[np.uint8]  # index in the channel names of the log
    indices: npt.NDArray[np.intp]  # index of each frame in the chunk

    def column(self, index: int) -> Column:
        """Return the physical values of field `index` of `codec.fields`."""
        return Column(self.codec.values(self.raw, index), self.codec.present(self.raw, index))


class Sink(Protocol):
    """Output file for decoded pieces."""

    values: int  # number of values so far

    def write(self, piece: Piece, channels: Sequence[str]) -> None:
        """Add the values of a piece.

        Args:
            piece: decoded frames of one message.
            channels: names of the channels of the log.
        """
        ...

    def flush(self) -> None:
        """Write the values of the chunk to the file."""
        ...

    def close(self) -> None:
        """Close the file; values since the last `flush` are not written."""
        ...


class Decoder:
    """Decoder of chunks; counts the skipped frames by reason."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._lengths = np.append(plan.lengths, np.full(len(plan.refused), 255))
        self.frames = self.decoded = 0
        self._left_out: Counter[str] = Counter()

    @property
    def left_out(self) -> str:
        """Return the numbers of skipped frames with their reasons, for a message; empty if none was skipped."""
        return ", ".join(f"{count} frames {why}" for why, count in self._left_out.items() if count)

    def decode(self, chunk: Chunk) -> Iterator[Piece]:
        """Yield the decoded pieces of a chunk, one per message."""
        plan, can_ids = self._plan, chunk.frames["can_id"]
        rows = plan.rows(can_ids & np.uint32(~ID_REMOTE & 0xFFFFFFFF))
        carries = (can_ids & np.uint32(ID_ERROR | ID_REMOTE)) == 0
        known = (rows != UNKNOWN) & carries
        supported = known & (rows < len(plan.layouts))
        long = chunk.frames["len"] >= self._lengths[np.where(supported, rows, 0)]
        good = supported & long
        self.frames += len(chunk)
        self._left_out["with an identifier that is not in the DBC"] += int((carries & ~known).sum())
        self._left_out["without data (remote or error)"] += int((~carries).sum())
        self._left_out["of messages with an unsupported layout"] += int((known & ~supported).sum())
        self._left_out["shorter than the message in the DBC"] += int((supported & ~long).sum())
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
                yield Piece(row, family.codec, raw[:, first:end], stream.stamps[of], chunk.channels[indices], indices)
