"""Bus of each log channel, and expected channel of each message."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from atalante_tools.canlog.plan import UNKNOWN, Plan, Rows
from atalante_tools.canlog.reader.chunk import Chunk

#: A channel is assigned to a bus if the share of its frames that belong to the bus is at least `_MAJORITY` (0 to 1).
#: Frames of unknown messages and of messages with an unsupported layout do not count.
_MAJORITY = 0.9


class ChannelMap:
    """Bus of each channel and expected channel of each message, derived from the frames.

    A known frame is a frame of a message in the DBC. A channel with the name of a bus is assigned to this bus. Any other
    channel is assigned to a bus if at least `_MAJORITY` of the known frames on the channel belong to this bus. A channel
    with the frames of several buses (such as all four buses on one vcan0) is assigned to no bus. A message is expected on
    the channel of its bus. If this bus has no channel, the message is expected on the channel of its first frame.
    """

    def __init__(self, plan: Plan, named: Mapping[str, str]) -> None:
        """Create an empty map for a new log.

        Args:
            plan: compiled DBC.
            named: name of the bus for each channel that the rules file assigns.
        """
        self._plan = plan
        self._named = dict(named)
        #: Bus number of each channel of the log; `UNKNOWN` if the channel has messages of several buses or no known frame.
        self.bus_of_channel: list[int] = []
        #: Channels without a known frame so far. The bus of such a channel is derived from its first known frames.
        self._silent: set[int] = set()
        self._channel_of_row = np.full(len(plan.layouts) + len(plan.refused), UNKNOWN, np.int16)

    def update(self, chunk: Chunk, rows: Rows, names: list[str]) -> None:
        """Assign a bus to each new channel, and an expected channel to each new message.

        A channel is new until a chunk contains a known frame on the channel. A message is new until a chunk contains a frame of
        the message. If a channel does not have the name of a bus, the bus is derived from the known frames of that first chunk.

        Args:
            chunk: next frames of the log.
            rows: for each frame, index of the message in the plan, shape (n,).
            names: channels of the log so far.
        """
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        # The log reader reads ahead, and a live bus lists all channels from the start. So a channel may have no frame yet.
        self._silent.update(range(len(self.bus_of_channel), len(names)))
        self.bus_of_channel += [UNKNOWN] * (len(names) - len(self.bus_of_channel))
        for channel in sorted(self._silent):
            of_channel = rows[known & (chunk.channels == channel)]
            self.bus_of_channel[channel] = self._bus_of(names[channel], of_channel)
            if len(of_channel):
                self._silent.remove(channel)
        new = np.flatnonzero((rows >= 0) & (self._channel_of_row[rows] == UNKNOWN))
        seen, first = np.unique(rows[new], return_index=True)
        for row, index in zip(seen.tolist(), new[first].tolist(), strict=True):
            self._channel_of_row[row] = self._expected_channel(row, int(chunk.channels[index]))

    def on_wrong_channel(self, chunk: Chunk, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return True for each frame that was received on a wrong channel. Shape (n,).

        The right channel is the expected channel of the message. A frame with an unknown identifier is never wrong.
        """
        if len(self.bus_of_channel) < 2:
            return np.zeros(len(chunk), np.bool_)
        known = rows >= 0
        away: npt.NDArray[np.bool_] = chunk.channels != self._channel_of_row[np.where(known, rows, 0)]
        return away & known

    def _bus_of(self, name: str, rows: Rows) -> int:
        buses = self._plan.buses
        name = self._named.get(name, name)
        if name in buses:
            return buses.index(name)
        if not self._plan.has_buses or not len(rows):
            return UNKNOWN
        counts = np.bincount(self._plan.bus_of_row[rows], minlength=len(buses))
        bus = int(np.argmax(counts))
        return bus if counts[bus] >= _MAJORITY * len(rows) else UNKNOWN

    def _expected_channel(self, row: int, channel: int) -> int:
        if self._plan.has_buses and row < len(self._plan.layouts):
            bus = int(self._plan.bus_of_row[row])
            if bus in self.bus_of_channel:
                return self.bus_of_channel.index(bus)
        return channel
