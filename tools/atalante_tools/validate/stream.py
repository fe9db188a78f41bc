"""The frames of a chunk that can be decoded, sorted by message: a message is a slice, and all of them are one array.

What belongs together over time (counters, intervals) is computed for all messages at once; the first frame of each slice is
compared with the state that the chunk before left behind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import FRAME, WORDS, Frames
from atalante_tools.validate.chunk import Chunk
from atalante_tools.validate.plan import Family, Rows

_Column = TypeVar("_Column", bound=npt.NDArray[Any])


@dataclass(frozen=True)
class Stream:
    """Frames sorted by row, in the order of the log within a row. Shapes (n,), and (m,) for the messages present."""

    rows: Rows  # of each frame
    stamps: npt.NDArray[np.int64]  # ns
    places: npt.NDArray[np.intp]  # in the chunk
    frames: Frames
    present: npt.NDArray[np.intp]  # rows that have frames, ascending
    starts: npt.NDArray[np.intp]  # first frame of each present row
    stops: npt.NDArray[np.intp]  # behind its last frame

    def __len__(self) -> int:
        return len(self.rows)

    def before(self, column: _Column, carried: npt.NDArray[Any]) -> _Column:
        """The value of the frame before, of the same message; `carried` has the last ones of the chunk before, by row."""
        shifted: Any = np.empty_like(column)
        shifted[1:] = column[:-1]
        shifted[self.starts] = carried[self.present]
        found: _Column = shifted
        return found

    def last(self, column: npt.NDArray[Any], carried: npt.NDArray[Any]) -> None:
        """Note the last value of each message in `carried`."""
        carried[self.present] = column[self.stops - 1]

    def span(self, rows: range) -> slice:
        """Frames of neighbouring rows."""
        first, behind = self.present.searchsorted((rows.start, rows.stop)).tolist()
        if first == behind:
            return slice(0, 0)
        return slice(int(self.starts[first]), int(self.stops[behind - 1]))

    def of(self, row: int) -> slice:
        """Frames of one row."""
        return self.span(range(row, row + 1))

    def bounds(self, family: Family) -> list[tuple[int, int, int]]:
        """(row, first, behind) of each present message of a family, counted within the family's frames."""
        first, behind = self.present.searchsorted((family.rows.start, family.rows.stop)).tolist()
        if first == behind:
            return []
        offset = int(self.starts[first])
        return [
            (row, start - offset, stop - offset)
            for row, start, stop in zip(
                self.present[first:behind].tolist(),
                self.starts[first:behind].tolist(),
                self.stops[first:behind].tolist(),
                strict=True,
            )
        ]

    def select(self, keep: npt.NDArray[np.bool_]) -> Stream:
        """Without the frames where the mask is False."""
        return _stream(self.rows[keep], self.stamps[keep], self.places[keep], self.frames[keep])


def sort(chunk: Chunk, rows: Rows, places: npt.NDArray[np.intp] | None) -> Stream:
    """Frames of a chunk by message; `places` are those that can be decoded, None: all. Shape of `rows` (len(chunk),)."""
    wanted = rows if places is None else rows[places]
    order = np.argsort(wanted, kind="stable")
    if places is not None:
        order = places[order]
    words = chunk.frames.view("<u8").reshape(-1, WORDS).take(order, axis=0)
    return _stream(rows[order], chunk.stamps[order], order, words.reshape(-1).view(FRAME))


def _stream(rows: Rows, stamps: npt.NDArray[np.int64], places: npt.NDArray[np.intp], frames: Frames) -> Stream:
    starts = np.flatnonzero(np.diff(rows, prepend=np.int16(-1)))
    stops = np.append(starts[1:], len(rows)) if len(rows) else starts
    return Stream(rows, stamps, places, frames, rows[starts].astype(np.intp), starts, stops)
