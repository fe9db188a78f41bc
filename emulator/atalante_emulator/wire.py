"""The time of the buses: who wins arbitration gets it, and what finds none waits for the next cycle or is overwritten.

Used while something babbles: without that every bus has more time than its cyclic set needs (`Network.bus_load`). A sender keeps
one frame an identifier ready; a newer one takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from atalante_dbc import Network
from atalante_dbc.network import wire_time
from atalante_emulator.body import PERIOD
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames


@dataclass
class Babble:
    """Somebody who sends one identifier as fast as a share of a bus allows."""

    bus: str
    can_id: int
    length: int  # bytes
    load: float  # share of the bus's time it asks for
    taken: float = 0.0  # s of wire time it takes of this cycle
    owed: float = 0.0  # s it took for a frame that is not over yet

    def frames(self, network: Network) -> int:
        """How many of its frames fit into a cycle: it yields to smaller identifiers alone."""
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
    """One cycle of every bus after the other."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._bus_of = {m.frame_id: m.bus for m in network.messages}
        self._used: dict[str, float] = {}  # s of this cycle, by those who do not babble
        self._babbles: Sequence[Babble] = ()
        self._from_hal: dict[int, Frames] = {}  # what waits, by identifier
        self._from_nodes: dict[int, Frames] = {}

    @property
    def idle(self) -> bool:
        """Nobody babbles, and nobody waits."""
        return not (self._babbles or self._from_hal or self._from_nodes)

    def load(self, bus: str) -> float:
        """Share of the cycle that is taken so far."""
        return (self._used.get(bus, 0.0) + sum(one.taken for one in self._babbles if one.bus == bus)) / PERIOD

    def begin(self, babbles: Sequence[Babble]) -> list[Frames]:
        """A new cycle: what those who babble bring onto the wire, shape (1,) each."""
        self._babbles = babbles
        self._used = {}
        return [_babbled(one) for one in babbles for _ in range(one.frames(self._network))]

    def carry(self, frames: Sequence[Frames], *, from_hal: bool) -> list[Frames]:
        """Frames that get through in this cycle, as arbitration orders them; the others wait.

        Args:
            frames: what is to be sent now, shape (1,) each.
            from_hal: by the HAL, or else by the nodes.
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
