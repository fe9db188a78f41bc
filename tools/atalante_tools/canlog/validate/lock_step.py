"""Time base of a lock-step bus: time stamps computed from the cycle number in SYNC instead of the wall clock.

    chunk with wall-clock stamps -> lock-step clock -> chunk with stamps in robot time -> rules

In lock-step, a cycle takes as long as the slowest program needs, so the period of a message on the wall clock is
meaningless.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_tools.canlog.column_codec import ColumnCodec, payload_words
from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.reader.chunk import Chunk
from atalante_tools.canlog.validate.order_rules import SYNC

Stamps = npt.NDArray[np.int64]

#: Name of the signal in a SYNC message that contains the cycle number.
CYCLE: Final = "Cycle"
#: Longest time after a SYNC [ns] in which the time stamps follow the cycle number. Without a new SYNC in this time, the HAL has
#: probably stopped, and the time stamps follow the wall clock.
PAUSE_NS: Final = 200_000_000
#: Largest plausible increase of the cycle number from one SYNC to the next. A larger increase or a decrease counts as 1.
#: A restart of the HAL or a damaged SYNC frame makes the cycle number jump, so the increase is then not plausible.
MOST_STEPS: Final = 1000
#: `_SPACING_NS` is the interval between the new time stamps of consecutive frames in a cycle [ns].
#: `_LAST` is the largest time from SYNC to the new time stamp of a frame in the cycle, as a fraction of the cycle time.
_SPACING_NS, _LAST = 1000, 0.7


@dataclass
class _Channel:
    """Last SYNC and last frame on one channel, which the lock-step clock needs for the next chunk."""

    #: Message index (position in the arrays of `Plan`) of the first SYNC on this channel; -1 until a SYNC is received.
    #: The clock reads the cycle number only from the message with the index `sync`.
    sync: int = -1
    cycle: int = 0  # cycle number in the last SYNC
    begin: int = 0  # robot time of the last SYNC [ns]
    wall: int = 0  # wall-clock stamp of the last SYNC [ns]
    count: int = 0  # number of frames from the last SYNC to the last frame, both included
    last: int = -(1 << 62)  # robot time of the last frame [ns]


class LockStepClock:
    """Clock that replaces the wall-clock stamps of frames by stamps in robot time.

    In robot time, each cycle takes exactly the cycle time that the DBC gives for SYNC. The new stamp of a frame is the
    start time of the cycle plus a small offset, which grows in the order of arrival. The first SYNC has the same stamp in
    robot time and on the wall clock. Before the first SYNC on a channel, and during a pause without SYNC, the stamps
    follow the wall clock.

    Args:
        plan: compiled DBC.

    Raises:
        ValueError: If the DBC has no SYNC message with a cycle number.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._codecs: dict[int, ColumnCodec] = {}
        for row, layout in enumerate(plan.layouts):
            named = any(field.name == CYCLE for field in layout.fields)
            if named and layout.name.upper().startswith(SYNC) and plan.cycle_ns[row]:
                self._codecs[row] = ColumnCodec(layout)
        if not self._codecs:
            raise ValueError(
                f"lock-step time needs a cyclic message {SYNC}* with the signal {CYCLE} in the DBC, got none"
            )
        self._channels: dict[int, _Channel] = {}
        self._origin: int | None = None  # stamp of cycle 0 [ns]

    def restamp(self, chunk: Chunk) -> Chunk:
        """Return the chunk with stamps in robot time.

        Args:
            chunk: next frames of all channels. The frames of the same channel are in the order of arrival.
        """
        rows = self._plan.rows(chunk.can_ids)
        stamps = chunk.stamps.copy()
        for number in np.unique(chunk.channels).tolist():
            at = np.flatnonzero(chunk.channels == number)
            stamps[at] = self._of_channel(self._channels.setdefault(number, _Channel()), chunk.select(at), rows[at])
        return Chunk(chunk.frames, stamps, chunk.channels, chunk.sent)

    def _of_channel(self, channel: _Channel, chunk: Chunk, rows: npt.NDArray[np.int16]) -> Stamps:
        """Compute the new stamps (robot time) of the frames on one channel [ns]. Shape (n,)."""
        wall = chunk.stamps
        if channel.sync < 0:
            known = np.flatnonzero(np.isin(rows, list(self._codecs)))
            if not len(known):
                return wall
            channel.sync = int(rows[known[0]])
        syncs = np.flatnonzero(rows == channel.sync)
        begins, walls = [channel.begin], [channel.wall]
        for index, cycle in zip(syncs.tolist(), self._cycles(channel.sync, chunk, syncs), strict=True):
            begins.append(self._next_begin(channel, cycle, int(wall[index]), int(wall[max(0, index - 1)])))
            walls.append(channel.wall)
        number = np.searchsorted(syncs, np.arange(len(wall)), side="right")
        offset = np.arange(len(wall)) - np.concatenate([[-channel.count], syncs])[number]
        limit = int(_LAST * self._plan.cycle_ns[channel.sync])
        since = wall - np.array(walls)[number]
        stamps = np.array(begins)[number] + np.where(since > PAUSE_NS, since, np.minimum(_SPACING_NS * offset, limit))
        if not walls[0]:  # no earlier chunk had a SYNC
            stamps[: syncs[0]] = np.minimum(wall[: syncs[0]], begins[1])
        stamps = np.maximum.accumulate(np.maximum(stamps, channel.last))
        channel.last, channel.count = int(stamps[-1]), int(offset[-1]) + 1
        return stamps

    def _cycles(self, row: int, chunk: Chunk, syncs: npt.NDArray[np.intp]) -> list[int]:
        """Return the cycle number of each SYNC.

        Args:
            row: index of the SYNC message in the plan.
            chunk: frames of the channel.
            syncs: indices of the SYNC frames in the chunk, shape (k,).
        """
        codec = self._codecs[row]
        words = payload_words(chunk.frames[syncs], codec.layout.length)
        numbers: list[int] = codec.extract(words)[codec.index(CYCLE)].tolist()
        return numbers

    def _next_begin(self, channel: _Channel, cycle: int, wall: int, wall_before: int) -> int:
        """Compute the new stamp (robot time) of a SYNC [ns], and store it in the clock state of the channel.

        Args:
            channel: clock state of the channel, which is updated.
            cycle: cycle number in the SYNC.
            wall: wall-clock time stamp of the SYNC [ns].
            wall_before: wall-clock time stamp of the frame before the SYNC [ns].
        """
        period = int(self._plan.cycle_ns[channel.sync])
        if self._origin is None:
            self._origin = wall - cycle * period
        if not channel.wall:
            begin = self._origin + cycle * period
        else:
            steps = cycle - channel.cycle
            begin = channel.begin + (steps if 0 <= steps <= MOST_STEPS else 1) * period
            if (paused := wall_before - channel.wall) > PAUSE_NS:
                begin = max(begin, channel.begin + paused + period)
        channel.cycle, channel.begin, channel.wall = cycle, begin, wall
        return begin
