"""Several channels as one bus: what the HAL holds when the robot's buses are on more than one interface.

Identifiers are unique in the whole network, so a frame's identifier says which channel it goes to, and what is received can
be poured together: the process image finds its rows by identifier.
"""

from __future__ import annotations

import select
import time
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusDown, BusError, BusFull, Stamps
from atalante_hal.bus.batch import REMEMBERED, Batches
from atalante_hal.wire.frame import Frames, as_words, new_frames

#: How often a channel without a file descriptor is looked at while waiting [s].
LOOK_AGAIN: Final = 100e-6


class Share(NamedTuple):
    """What one channel gets of a batch."""

    link: Bus
    places: list[int]  # in the batch
    frames: Frames  # the same array every time, as a bus likes it


class JoinedBus:
    """The robot's buses behind one `Bus`: `buses` gives the channel of each of `network.buses`.

    Frames keep their order on a channel, not between channels. A frame goes to the bus of its message; a `ValueError`
    says when the network has no such message. A channel that refuses its frames does not keep the others from theirs.
    """

    def __init__(self, network: Network, buses: Mapping[str, Bus], capacity: int = 256) -> None:
        if missing := [bus for bus in network.buses if bus not in buses]:
            raise ValueError(f"no channel given for {missing[0]}; the buses are {', '.join(network.buses)}")
        self._links = list({id(buses[name]): buses[name] for name in network.buses}.values())
        self._link_of = {m.frame_id: self._links.index(buses[m.bus]) for m in network.messages}
        self.name = " + ".join(link.name for link in self._links)
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        self._capacity = capacity
        self._batches = Batches()
        self._shares: dict[bytes, list[Share]] = {}
        self._tails: dict[int, list[Frames]] = {}
        self._turn = 0  # channel that is read first, so that a busy one cannot starve the others
        self._closed = False
        files = [_file_of(link) for link in self._links]
        self._files = [file for file in files if file is not None]
        self._all_have_files = len(self._files) == len(files)

    @property
    def dropped(self) -> int:
        """Frames lost on any of the channels."""
        return sum(link.dropped for link in self._links)

    def send(self, frames: Frames) -> None:
        """Send each frame on its message's channel; raises `BusFull`, `BusDown`, `ValueError`. Shape (n,)."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        _, headers = self._batches.to_send(frames)
        words = as_words(frames)
        sent = 0
        failure: BusError | None = None
        for share in self._shares.get(headers) or self._divide(headers, frames):
            as_words(share.frames)[:] = words[share.places]
            try:
                share.link.send(share.frames)
            except BusFull as error:
                sent += error.sent
                failure = failure or error
            except BusError as error:
                failure = failure or error
            else:
                sent += len(share.places)
        if isinstance(failure, BusFull):
            raise BusFull(str(failure), sent)
        if failure is not None:
            raise failure

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]` with what any channel has; waits on all together. Raises `BusDown`. Shape (m,), n <= m."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        tails = self._tails_of(frames)
        count = self._gather(tails)
        if count or timeout <= 0.0:
            return count
        deadline = time.monotonic() + timeout
        while not count and (left := deadline - time.monotonic()) > 0.0:
            if self._all_have_files:
                select.select(self._files, (), (), left)
            else:
                time.sleep(min(left, LOOK_AGAIN))
            count = self._gather(tails)
        return count

    def close(self) -> None:
        """Close every channel."""
        self._closed = True
        for link in self._links:
            link.close()

    def _gather(self, tails: list[Frames]) -> int:
        size = len(tails[0])
        room = min(size, self._capacity)
        count = 0
        links, first = self._links, self._turn
        self._turn = (first + 1) % len(links)
        for link in links[first:] + links[:first]:
            if count == room:
                break
            got = link.receive(tails[count] if room == size else tails[count][: room - count])
            if got:
                self.stamps[count : count + got] = link.stamps[:got]
                count += got
        return count

    def _tails_of(self, frames: Frames) -> list[Frames]:
        """`frames` from each place on; kept, because a bus remembers the arrays it has seen."""
        tails = self._tails.get(id(frames))
        if tails is None:
            self._batches.to_fill(frames)  # refuses what is no array of frames
            if len(self._tails) >= REMEMBERED:
                self._tails.clear()
            tails = [frames, *(frames[place:] for place in range(1, len(frames)))]
            self._tails[id(frames)] = tails
        return tails

    def _divide(self, headers: bytes, frames: Frames) -> list[Share]:
        """Which frames of a batch with these identifiers go where."""
        places: dict[int, list[int]] = {}
        for place, frame_id in enumerate(frames["can_id"].tolist()):
            link = self._link_of.get(frame_id)
            if link is None:
                raise ValueError(
                    f"frame {place} (id 0x{frame_id:X}) is no message of the network: which bus is it for?"
                )
            places.setdefault(link, []).append(place)
        shares = [Share(self._links[link], found, new_frames(len(found))) for link, found in places.items()]
        if len(self._shares) >= REMEMBERED:
            self._shares.clear()
        self._shares[headers] = shares
        return shares


def _file_of(link: Bus) -> int | None:
    """File descriptor to wait on, of a bus that has one."""
    fileno = getattr(link, "fileno", None)
    return None if fileno is None else fileno()
