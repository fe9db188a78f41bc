"""Stream: valid frames of a chunk, sorted by message. The frames of each message are contiguous.

Differences between consecutive frames (counter increments, intervals) are computed for all messages in one operation.
The first frame of each message is compared with the last frame of this message in the previous chunks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import FRAME, WORDS, Frames
from atalante_tools.canlog.plan import Family, Rows
from atalante_tools.canlog.reader.chunk import Chunk

_Column = TypeVar("_Column", bound=npt.NDArray[Any])


@dataclass(frozen=True)
class Stream:
    """Frames of a chunk: n frames of m messages, sorted by message. Frames of the same message keep the order of the log.

    A message index is the position of a message in the arrays of `Plan` (the compiled DBC).
    """

    rows: Rows  # message index (position in the arrays of `Plan`) of each frame, shape (n,)
    stamps: npt.NDArray[np.int64]  # time stamp of each frame [ns], shape (n,)
    indices: npt.NDArray[np.intp]  # position of each frame in the chunk, shape (n,)
    frames: Frames
    present: npt.NDArray[np.intp]  # message indices of the m messages with frames in the chunk, ascending, shape (m,)
    starts: npt.NDArray[np.intp]  # for each message, position of its first frame in the stream, shape (m,)
    stops: npt.NDArray[np.intp]  # for each message, 1 + position of its last frame in the stream, shape (m,)

    def __len__(self) -> int:
        return len(self.rows)

    def before(self, column: _Column, carried: npt.NDArray[Any]) -> _Column:
        """Return for each frame the value of the previous frame of the same message. Shape (n,).

        Args:
            column: value of each frame, shape (n,).
            carried: last value of each message in the previous chunks, shape (messages,).
        """
        shifted: Any = np.empty_like(column)
        shifted[1:] = column[:-1]
        shifted[self.starts] = carried[self.present]
        found: _Column = shifted
        return found

    def last(self, column: npt.NDArray[Any], carried: npt.NDArray[Any]) -> None:
        """Copy the value of the last frame of each message in the chunk to `carried`.

        Args:
            column: value of each frame, shape (n,).
            carried: last value of each message, shape (messages,), updated for the messages in the chunk.
        """
        carried[self.present] = column[self.stops - 1]

    def span(self, rows: range) -> slice:
        """Return the slice of the stream that contains all frames of several messages.

        Args:
            rows: message indices. The frames of these messages are contiguous, because the stream is sorted by message.
        """
        first, end = self.present.searchsorted((rows.start, rows.stop)).tolist()
        if first == end:
            return slice(0, 0)
        return slice(int(self.starts[first]), int(self.stops[end - 1]))

    def of(self, row: int) -> slice:
        """Return the slice that selects the frames of one message."""
        return self.span(range(row, row + 1))

    def bounds(self, family: Family) -> list[tuple[int, int, int]]:
        """Return a tuple (message index, first, end) for each message of a family that has frames in the stream.

        A family contains all messages with the same signal layout, and its frames are contiguous in the stream. If `x` is
        an array with one element per frame of the family, `x[first:end]` selects the frames of the message.
        """
        first, end = self.present.searchsorted((family.rows.start, family.rows.stop)).tolist()
        if first == end:
            return []
        offset = int(self.starts[first])
        return [
            (row, start - offset, stop - offset)
            for row, start, stop in zip(
                self.present[first:end].tolist(),
                self.starts[first:end].tolist(),
                self.stops[first:end].tolist(),
                strict=True,
            )
        ]

    def select(self, keep: npt.NDArray[np.bool_]) -> Stream:
        """Return a stream with the selected frames.

        Args:
            keep: mask of the frames, shape (n,).
        """
        return _stream(self.rows[keep], self.stamps[keep], self.indices[keep], self.frames[keep])


def sort(chunk: Chunk, rows: Rows, indices: npt.NDArray[np.intp] | None) -> Stream:
    """Sort the frames of a chunk by message.

    Args:
        chunk: n frames of the log.
        rows: message index (position in the arrays of `Plan`) of each frame, shape (n,).
        indices: indices of the frames to keep, shape (k,); None means all frames.
    """
    wanted = rows if indices is None else rows[indices]
    order = np.argsort(wanted, kind="stable")
    if indices is not None:
        order = indices[order]
    words = chunk.frames.view("<u8").reshape(-1, WORDS).take(order, axis=0)
    return _stream(rows[order], chunk.stamps[order], order, words.reshape(-1).view(FRAME))


def _stream(rows: Rows, stamps: npt.NDArray[np.int64], indices: npt.NDArray[np.intp], frames: Frames) -> Stream:
    starts = np.flatnonzero(np.diff(rows, prepend=np.int16(-1)))
    stops = np.append(starts[1:], len(rows)) if len(rows) else starts
    return Stream(rows, stamps, indices, frames, rows[starts].astype(np.intp), starts, stops)
