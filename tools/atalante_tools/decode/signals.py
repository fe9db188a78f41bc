"""Frames to columns: the decoded signals of one message in one chunk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from atalante_hal.bulk import BulkCodec, Column, Words, payload_words
from atalante_hal.frame import ID_ERROR, ID_REMOTE
from atalante_tools.validate.chunk import Chunk
from atalante_tools.validate.plan import UNKNOWN, Plan
from atalante_tools.validate.stream import sort


@dataclass(frozen=True)
class Piece:
    """The frames of one message in one chunk, decoded."""

    row: int  # of the plan
    codec: BulkCodec
    raw: Words  # shape (fields, n)
    stamps: npt.NDArray[np.int64]  # ns
    channels: npt.NDArray[np.uint8]
    places: npt.NDArray[np.intp]  # in the chunk

    def column(self, place: int) -> Column:
        """Physical values of a field of `codec.fields`."""
        return Column(self.codec.values(self.raw, place), self.codec.present(self.raw, place))


class Sink(Protocol):
    """A file that takes decoded pieces."""

    values: int  # written so far

    def write(self, piece: Piece, channels: Sequence[str]) -> None:
        """Add the values of a piece."""
        ...

    def flush(self) -> None:
        """A chunk is complete."""
        ...

    def close(self) -> None:
        """Finish the file; what was not flushed is left out."""
        ...


class Decoder:
    """Decodes chunks; counts what was left out, and why."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._lengths = np.append(plan.lengths, np.full(len(plan.refused), 255))
        self.frames = self.decoded = 0
        self._left_out: Counter[str] = Counter()

    @property
    def left_out(self) -> str:
        """Frames that were not decoded, as a phrase."""
        return ", ".join(f"{count} frames {why}" for why, count in self._left_out.items() if count)

    def decode(self, chunk: Chunk) -> Iterator[Piece]:
        """The pieces of a chunk, by message."""
        plan, can_ids = self._plan, chunk.frames["can_id"]
        rows = plan.rows(can_ids & np.uint32(~ID_REMOTE & 0xFFFFFFFF))
        carries = (can_ids & np.uint32(ID_ERROR | ID_REMOTE)) == 0
        known = (rows != UNKNOWN) & carries
        supported = known & (rows < len(plan.layouts))
        long = chunk.frames["len"] >= self._lengths[np.where(supported, rows, 0)]
        good = supported & long
        self.frames += len(chunk)
        self._left_out["of identifiers that the DBC does not have"] += int((carries & ~known).sum())
        self._left_out["that carry no data (remote or error)"] += int((~carries).sum())
        self._left_out["of messages that are not supported"] += int((known & ~supported).sum())
        self._left_out["shorter than their message"] += int((supported & ~long).sum())
        stream = sort(chunk, rows, np.flatnonzero(good))
        self.decoded += len(stream)
        for family in plan.families:
            span = stream.span(family.rows)
            if span.start == span.stop or not family.codec.fields:
                continue
            raw = family.codec.extract(payload_words(stream.frames[span], family.length))
            for row, first, behind in stream.bounds(family):
                of = slice(span.start + first, span.start + behind)
                places = stream.places[of]
                yield Piece(row, family.codec, raw[:, first:behind], stream.stamps[of], chunk.channels[places], places)
