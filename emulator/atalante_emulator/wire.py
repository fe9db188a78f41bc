"""Wire time of the buses: frames are sent in the order of arbitration, and the others wait for the next cycle.

It is computed only during a flood, because each bus has enough time for its cyclic messages otherwise (`Network.bus_load`). A
sender keeps one waiting frame per identifier; a newer frame replaces it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from atalante_dbc import Network
from atalante_dbc.network import wire_time
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames


@dataclass
class Babble:
    """Defective sender that floods a bus with frames of one identifier."""

    bus: str
    can_id: int
    length: int  # bytes
    load: float  # share of the bus time that the sender requests, 0 to 1
    taken: float = 0.0  # s, wire time that the sender gets in this cycle
    owed: float = 0.0  # s, wire time that the sender got but that is too short for a whole frame

    def frames(self, network: Network) -> int:
        """Return how many frames of the sender fit into a cycle. Only smaller identifiers have priority over the sender.

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
        self.owed += self.taken
        count = int(self.owed / one + 1e-9)
        self.owed -= count * one
        return count


class Wire:
    """Arbitration of all buses, cycle by cycle."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._bus_of = {m.frame_id: m.bus for m in network.messages}
        self._used: dict[str, float] = {}  # s, wire time that regular frames used in this cycle, by bus
        self._babbles: Sequence[Babble] = ()
        self._from_hal: dict[int, Frames] = {}  # waiting frames of the HAL, by identifier
        self._from_nodes: dict[int, Frames] = {}  # waiting frames of the nodes, by identifier

    @property
    def idle(self) -> bool:
        """Whether there is no flood and no waiting frame."""
        return not (self._babbles or self._from_hal or self._from_nodes)

    def load(self, bus: str) -> float:
        """Return the share of the cycle in which a bus is busy so far.

        Args:
            bus: name of the bus.
        """
        return (self._used.get(bus, 0.0) + sum(one.taken for one in self._babbles if one.bus == bus)) / PERIOD

    def begin(self, babbles: Sequence[Babble]) -> list[Frames]:
        """Begin a cycle and return the flood frames that get on the wire, shape (1,) each.

        Args:
            babbles: floods that are active in this cycle.
        """
        self._babbles = babbles
        self._used = {}
        return [_babbled(one) for one in babbles for _ in range(one.frames(self._network))]

    def carry(self, frames: Sequence[Frames], *, from_hal: bool) -> list[Frames]:
        """Return the frames that get on the wire in this cycle, in the order of arbitration; the others wait.

        Args:
            frames: frames to send now, shape (1,) each.
            from_hal: whether the HAL sends them. False for frames of the nodes.
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
