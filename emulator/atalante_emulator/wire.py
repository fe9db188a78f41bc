"""CAN arbitration of the emulated buses during a flood: decides which frames are transmitted in each cycle.

Frames that are not transmitted wait for the next cycle. A sender keeps only the newest waiting frame of each identifier.
Without a flood there is no need for arbitration, because each bus has enough time for all its messages (`Network.bus_load`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from atalante_dbc import Network
from atalante_dbc.network import wire_time
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames


class AddedFrame(NamedTuple):
    """Frame that a fault adds to a bus, and the name of the bus."""

    bus: str
    frame: Frames  # shape (1,)


@dataclass
class Babble:
    """Defective node that floods a bus with frames of one identifier."""

    bus: str
    can_id: int
    length: int  # payload length [bytes]
    load: float  # share of the bus time that the node tries to use, 0 to 1
    taken: float = 0.0  # wire time that the node takes in this cycle [s]
    rest: float = 0.0  # wire time left over in this cycle, shorter than one frame, for use in the next cycle [s]

    def frames(self, network: Network) -> int:
        """Return how many flood frames fit into this cycle. Messages with smaller identifiers have priority over the flood.

        Args:
            network: messages and bit rates of the buses.
        """
        before = sum(
            _time_of(network, m.length) * 1e3 / m.cycle_ms
            for m in network.messages
            if m.bus == self.bus and m.cycle_ms and m.frame_id < self.can_id
        )
        one = _time_of(network, self.length)
        self.taken = min(self.load, max(0.0, 1.0 - before)) * PERIOD
        self.rest += self.taken
        count = int(self.rest / one + 1e-9)
        self.rest -= count * one
        return count


class Wire:
    """Arbitration of the frames on all buses."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._bus_of = {m.frame_id: m.bus for m in network.messages}
        self._used: dict[str, float] = {}  # bus -> wire time of the regular frames in this cycle [s]
        self._babbles: Sequence[Babble] = ()
        self._from_hal: dict[int, Frames] = {}  # identifier -> waiting frame of the HAL
        self._from_nodes: dict[int, Frames] = {}  # identifier -> waiting frame of a node

    @property
    def idle(self) -> bool:
        """True if no flood is active and no frame waits for the bus."""
        return not (self._babbles or self._from_hal or self._from_nodes)

    def load(self, bus: str) -> float:
        """Return the load of a bus in this cycle, as a share of the cycle time.

        Args:
            bus: name of the bus.
        """
        return (self._used.get(bus, 0.0) + sum(one.taken for one in self._babbles if one.bus == bus)) / PERIOD

    def begin(self, babbles: Sequence[Babble]) -> list[AddedFrame]:
        """Begin a cycle. Return the flood frames that are transmitted in this cycle.

        Args:
            babbles: floods that are active in this cycle.
        """
        self._babbles = babbles
        self._used = {}
        return [AddedFrame(one.bus, _babbled(one)) for one in babbles for _ in range(one.frames(self._network))]

    def carry(self, frames: Sequence[Frames], *, from_hal: bool) -> list[Frames]:
        """Return the frames that are transmitted in this cycle, in the order of arbitration. All other frames wait.

        Args:
            frames: frames to send now, shape (1,) each.
            from_hal: True if the HAL sends the frames, False if the nodes send the frames.
        """
        waiting = self._from_hal if from_hal else self._from_nodes
        newer = {_id(frame) for frame in frames}
        ready = [frame for can_id, frame in waiting.items() if can_id not in newer]
        waiting.clear()
        through = []
        for frame in sorted([*ready, *frames], key=_id):
            if self._finds_time(frame):
                through.append(frame)
            else:
                waiting[_id(frame)] = frame
        return through

    def _finds_time(self, frame: Frames) -> bool:
        can_id = _id(frame)
        bus = self._bus_of.get(can_id)
        if bus is None:
            return True
        used = self._used.get(bus, 0.0) + _time_of(self._network, int(frame["len"][0]))
        taken = sum(one.taken for one in self._babbles if one.bus == bus and one.can_id <= can_id)
        if used + taken > PERIOD + 1e-9:
            return False
        self._used[bus] = used
        return True


def _id(frame: Frames) -> int:
    return int(frame["can_id"][0])


def _time_of(network: Network, length: int) -> float:
    return wire_time(length, network.nominal_bitrate, network.data_bitrate)


def _babbled(babble: Babble) -> Frames:
    frame = new_frames(1)
    frame["can_id"], frame["len"], frame["flags"] = babble.can_id, babble.length, FLAG_FDF | FLAG_BRS
    return frame
