"""Chunk: consecutive frames of a log as arrays. The log readers return chunks; the validator rules check chunks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames, as_words, new_frames

#: Direction of a frame according to the log; `NO_DIRECTION` if the log contains no directions.
SENT, RECEIVED, NO_DIRECTION = 1, 0, -1
MAX_CHANNELS = 256  # maximum number of channel names in a log


@dataclass
class Chunk:
    """Consecutive frames of a log. Each array has shape (n,)."""

    frames: Frames  # `FRAME` records
    stamps: npt.NDArray[np.int64]  # time stamp of each frame [ns]
    channels: npt.NDArray[np.uint8]  # for each frame: index of its channel in the channel list of the log
    sent: npt.NDArray[np.int8]  # direction of each frame: SENT, RECEIVED or NO_DIRECTION

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def headers(self) -> npt.NDArray[np.uint64]:
        """Return the header word of each frame (`header_word`) as a contiguous array. Shape (n,).

        Reading this array takes less time than reading every ninth word of `frames`.
        """
        return np.ascontiguousarray(as_words(self.frames)[:, 0])

    @property
    def can_ids(self) -> npt.NDArray[np.uint32]:
        """Return the identifier of each frame with its flag bits. Shape (n,)."""
        return self.headers.view("<u4")[::2]

    def select(self, indices: npt.NDArray[Any]) -> Chunk:
        """Return a chunk with the selected frames.

        Args:
            indices: indices of frames, or a mask of shape (n,).
        """
        return Chunk(self.frames[indices], self.stamps[indices], self.channels[indices], self.sent[indices])


def concatenated(chunks: Sequence[Chunk]) -> Chunk:
    """Return all frames of several chunks in one chunk."""
    if len(chunks) == 1:
        return chunks[0]
    frames = new_frames(sum(map(len, chunks)))
    np.concatenate([as_words(chunk.frames) for chunk in chunks], out=as_words(frames))
    return Chunk(
        frames,
        np.concatenate([chunk.stamps for chunk in chunks]),
        np.concatenate([chunk.channels for chunk in chunks]),
        np.concatenate([chunk.sent for chunk in chunks]),
    )


@dataclass
class Channels:
    """Channel names of a log, ordered by the first frame of each channel."""

    names: list[str] = field(default_factory=list)

    def index(self, name: str) -> int:
        """Return the index of a channel name, and append the name to the list if the name is new.

        The list has at most 256 names. All further names share the last index. Only a damaged log has so many names.

        Args:
            name: name of the channel in the log.
        """
        if name not in self.names:
            if len(self.names) == MAX_CHANNELS:
                return MAX_CHANNELS - 1
            self.names.append(name)
        return self.names.index(name)
