"""Bus that joins several channels, for a robot whose buses are on more than one CAN interface.

Identifiers are unique in the whole network. So the identifier of a sent frame determines its channel. Frames that are received on
different channels can be mixed, because the process image finds the row of a frame by its identifier.
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
from atalante_hal.wire.frame import Frames, as_words, joined, new_frames

#: Polling period of channels that have no file descriptor [s].
POLLING_PERIOD: Final = 100e-6


class Share(NamedTuple):
    """Frames of a batch that are sent on one channel."""

    channel: int  # index of the channel
    indices: list[int]  # indices of the channel's frames in the batch
    #: send buffer for the channel's frames; always the same array object, because a bus caches memory views of each array
    frames: Frames


class JoinedBus:
    """Bus that joins all buses of the robot.

    Each frame goes to the bus of its message. Frames on one channel keep their order, but frames on different channels
    do not. If one channel cannot send its frames, the other channels still send.

    Args:
        network: CAN network that assigns each message to a bus.
        buses: Open bus of each of `network.buses`.
        capacity: Largest number of frames that one `receive()` returns.

    Raises:
        ValueError: If `buses` lacks a bus of the network.
    """

    def __init__(self, network: Network, buses: Mapping[str, Bus], capacity: int = 256) -> None:
        if missing := [bus for bus in network.buses if bus not in buses]:
            raise ValueError(
                f"buses must have an entry for each of {', '.join(network.buses)}; {missing[0]} is missing"
            )
        self._links: list[Bus] = []
        for name in network.buses:
            if buses[name] not in self._links:
                self._links.append(buses[name])
        self._channel_of = {name: buses[name] for name in network.buses}
        self._link_of = {m.frame_id: self._links.index(buses[m.bus]) for m in network.messages}
        self.name = " + ".join(link.name for link in self._links)
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        self._capacity = capacity
        self._batches = Batches()
        self._shares: dict[bytes, list[Share]] = {}
        #: for each receive buffer `frames`: list of its slices `frames`, `frames[1:]`, `frames[2:]`, ...
        #: after i frames were received on some channels, the next channel writes into the slice `frames[i:]`
        self._tails: list[list[Frames]] = []
        #: index of the channel that is read first; it changes in each call, so a busy channel cannot block the others
        self._turn = 0
        self._closed = False
        self._failure: BusError | None = None  # error that a channel raised in the current call of `receive`
        self._down: dict[int, BusDown] = {}  # error of each lost channel, by index of the channel
        files = [_file_of(link) for link in self._links]
        self._files = [file for file in files if file is not None]
        self._all_have_files = len(self._files) == len(files)

    @property
    def dropped(self) -> int:
        """Return how many incoming frames were lost or invalid since the bus was opened: the sum over all channels."""
        return sum(link.dropped for link in self._links)

    @property
    def down(self) -> str:
        """Return the error message of a lost channel; empty if no channel is lost."""
        return str(self.loss or "")

    @property
    def loss(self) -> BusDown | None:
        """Return the error of a lost channel; None if no channel is lost.

        A lost channel is regarded as restored as soon as a frame was sent or received on it.
        """
        return next(iter(self._down.values()), None)

    def channel(self, bus: str) -> Bus:
        """Return the channel of a bus of the network. Use it for frames that are not messages of the network.

        Args:
            bus: Name of the bus.

        Raises:
            KeyError: If the network has no such bus.
        """
        return self._channel_of[bus]

    def send(self, frames: Frames) -> None:
        """Send each frame on the channel of its message.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusDown: If a channel is closed or down. If a transmit queue was full in the same call, `full` is its error.
            BusFull: If a transmit queue accepted only a part of its frames, and no channel is closed or down.
            BusError: If the kernel reports another error. `full` is set as for `BusDown`.
            ValueError: If a frame is not a valid CAN frame or not a message of the network.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        _, headers = self._batches.to_send(frames)
        words = as_words(frames)
        failures: dict[int, BusError] = {}  # error of each channel that failed, by index of the channel
        shares = self._shares.get(headers) or self._divide(headers, frames)
        for share in shares:
            as_words(share.frames)[:] = words[share.indices]
            try:
                self._links[share.channel].send(share.frames)
            except BusError as error:
                failures[share.channel] = error
                self._lost(share.channel, error)
            else:
                self._down.pop(share.channel, None)
        if failures:
            raise _combined(shares, failures)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive from all channels into `frames[:n]` and return n, see `Bus.receive`.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Longest wait for the first frame on any channel [s].

        Returns:
            Number of received frames n.

        Raises:
            BusDown: If a channel is closed or down, and no frame was received on the other channels within `timeout`.
            BusError: If the kernel reports another error, and no frame was received on the other channels within `timeout`.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        tails = self._tails_of(frames)
        self._failure = None
        count = self._gather(tails)
        deadline = time.monotonic() + timeout
        while not count and (left := deadline - time.monotonic()) > 0.0:
            if self._all_have_files:
                select.select(self._files, (), (), left)
            else:
                time.sleep(min(left, POLLING_PERIOD))
            count = self._gather(tails)
        if not count and self._failure is not None:
            raise self._failure
        return count

    def close(self) -> None:
        """Close every channel."""
        self._closed = True
        for link in self._links:
            link.close()

    def _lost(self, channel: int, error: BusError) -> None:
        if isinstance(error, BusDown):
            self._down[channel] = error

    def _gather(self, tails: list[Frames]) -> int:
        size = len(tails[0])
        room = min(size, self._capacity)
        count = 0
        channels, first = len(self._links), self._turn
        self._turn = (first + 1) % channels
        for turn in range(first, first + channels):
            if count == room:
                break
            channel = turn % channels
            link = self._links[channel]
            try:
                got = link.receive(tails[count] if room == size else tails[count][: room - count])
            except BusError as error:
                self._failure = error
                self._lost(channel, error)
                continue
            if got:
                self._down.pop(channel, None)
                self.stamps[count : count + got] = link.stamps[:got]
                count += got
        return count

    def _tails_of(self, frames: Frames) -> list[Frames]:
        """Return `frames` and its slices `frames[1:]`, `frames[2:]`, ..., cached for the next call.

        After i frames were received on some channels, the next channel writes into the slice `frames[i:]`. The slices are
        cached, because a bus caches memory views of each array object.
        """
        for tails in self._tails:
            if tails[0] is frames:
                return tails
        self._batches.to_fill(frames)  # `to_fill` raises TypeError if `frames` is not an array of frames
        if len(self._tails) >= REMEMBERED:
            self._tails.clear()
        self._tails.append([frames, *(frames[offset:] for offset in range(1, len(frames)))])
        return self._tails[-1]

    def _divide(self, headers: bytes, frames: Frames) -> list[Share]:
        """Divide a batch among the channels, and cache the result for batches with the same headers."""
        rows: dict[int, list[int]] = {}
        for index, frame_id in enumerate(frames["can_id"].tolist()):
            link = self._link_of.get(frame_id)
            if link is None:
                raise ValueError(
                    f"frame {index} (id 0x{frame_id:X}) is not a message of the network, so it has no channel"
                )
            rows.setdefault(link, []).append(index)
        shares = [Share(link, found, new_frames(len(found))) for link, found in rows.items()]
        if len(self._shares) >= REMEMBERED:
            self._shares.clear()
        self._shares[headers] = shares
        return shares


def _combined(shares: list[Share], failures: dict[int, BusError]) -> BusError:
    """Choose the error that `send` raises if at least one channel failed.

    A lost channel is worse than any other error, and a full transmit queue is the mildest one. So the first `BusDown` is
    chosen, or else the first error other than `BusFull`, and its attribute `full` is set to the first `BusFull`. If all errors
    are `BusFull`, the first one is chosen. `accepted` of the chosen error contains the accepted frames of all channels.

    Args:
        shares: Frames of each channel.
        failures: Error of each channel that raised one, by index of the channel.
    """
    accepted = [
        share.frames if (error := failures.get(share.channel)) is None else error.accepted_of(share.frames)
        for share in shares
    ]
    frames = joined(accepted)
    errors = list(failures.values())
    for error in errors:
        error.accepted, error.sent = frames, len(frames)
    others = [error for error in errors if not isinstance(error, BusFull)]
    if not others:
        return errors[0]
    worst = next((error for error in others if isinstance(error, BusDown)), others[0])
    worst.full = next((error for error in errors if isinstance(error, BusFull)), None)
    return worst


def _file_of(link: Bus) -> int | None:
    """Return the file descriptor of a bus; None if it has none."""
    fileno = getattr(link, "fileno", None)
    return None if fileno is None else fileno()
