"""Which channel of a log is which bus of the network, and where each message is at home."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from atalante_tools.validate.chunk import Chunk
from atalante_tools.validate.plan import UNKNOWN, Plan, Rows

#: Share of a channel's known frames that must belong to one bus for the channel to be that bus.
_MOSTLY = 0.9


class Homes:
    """Learns from the frames: a channel named like a bus, or carrying one bus's messages, is that bus.

    A channel with a mixture (all four buses on one vcan0) is none. A message's home is the channel of its bus, otherwise the
    channel on which it came first.
    """

    def __init__(self, plan: Plan, named: Mapping[str, str]) -> None:
        """`named` says for channels by name which bus they are."""
        self._plan = plan
        self._named = dict(named)
        #: Bus number of each channel seen, `UNKNOWN` for a mixture.
        self.bus_of_channel: list[int] = []
        self._home = np.full(len(plan.layouts) + len(plan.refused), UNKNOWN, np.int16)

    def learn(self, chunk: Chunk, rows: Rows, names: list[str]) -> None:
        """Take in a chunk; `names` are the channels of the log so far."""
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        for channel in range(len(self.bus_of_channel), len(names)):
            self.bus_of_channel.append(self._bus_of(names[channel], rows[known & (chunk.channels == channel)]))
        if bool((self._home[: len(self._plan.layouts)] != UNKNOWN).all()):
            return
        seen, first = np.unique(rows, return_index=True)
        for row, place in zip(seen.tolist(), first.tolist(), strict=True):
            if row >= 0 and self._home[row] == UNKNOWN:
                self._home[row] = self._home_of(row, int(chunk.channels[place]))

    def strangers(self, chunk: Chunk, rows: Rows) -> npt.NDArray[np.bool_]:
        """Frames that are not where their message is at home. Shape (n,)."""
        if len(self.bus_of_channel) < 2:
            return np.zeros(len(chunk), np.bool_)
        known = rows >= 0
        away: npt.NDArray[np.bool_] = chunk.channels != self._home[np.where(known, rows, 0)]
        return away & known

    def _bus_of(self, name: str, rows: Rows) -> int:
        buses = self._plan.buses
        name = self._named.get(name, name)
        if name in buses:
            return buses.index(name)
        if not self._plan.is_ours or not len(rows):
            return UNKNOWN
        counts = np.bincount(self._plan.bus_of_row[rows], minlength=len(buses))
        bus = int(np.argmax(counts))
        return bus if counts[bus] >= _MOSTLY * len(rows) else UNKNOWN

    def _home_of(self, row: int, channel: int) -> int:
        if self._plan.is_ours and row < len(self._plan.layouts):
            bus = int(self._plan.bus_of_row[row])
            if bus in self.bus_of_channel:
                return self.bus_of_channel.index(bus)
        return channel
