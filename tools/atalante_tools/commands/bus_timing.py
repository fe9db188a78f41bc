"""Measurement of the time from a SYNC to the frames that answer this SYNC. Each time is a difference of two receive timestamps.

frames, stamps -> BusTiming -> Latency of states and commands, per bus
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_dbc import Message, Network, wire_time
from atalante_hal.bus import Stamps
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import Frames
from atalante_tools.session.rig import PATIENCE

#: Longest accepted time from a SYNC to the state frame of a node [us]: half a cycle.
#: After a SYNC, the HAL waits half a cycle for the state frames, except in lock-step.
STATE_BUDGET: Final = PATIENCE * 1e6
#: Longest accepted time from a SYNC to a command frame of the HAL [us]: one cycle.
#: The HAL answers each SYNC with a command. A drive applies the command at the next SYNC, one cycle after the answered SYNC.
#: If the command frame arrives after the next SYNC, the drive applies the command one cycle too late.
COMMAND_BUDGET: Final = PERIOD * 1e6
#: Node kinds that answer every SYNC with a state frame.
_ANSWERING: Final = ("drive", "imu", "foot")
_NS_PER_US: Final = 1e3


@dataclass(frozen=True)
class Latency:
    """Distribution of the time from a SYNC to the states or commands on one bus. `--json` prints these fields."""

    bus: str
    kind: str  # "state" or "command"
    samples: int
    min_us: float
    median_us: float
    p99_us: float
    max_us: float
    wire_us: float  # longest time to transmit all frames of this kind in one cycle, computed from the DBC
    budget_us: float

    @property
    def fits(self) -> bool:
        """Return whether 99 % of the samples are within the budget."""
        return self.p99_us <= self.budget_us


class BusTiming:
    """Measurement of the time from each SYNC to the states and commands on the same bus.

    Both timestamps of a sample come from the same channel. Clocks of several adapters are never compared. The time of each
    frame is measured from the last SYNC before the frame, even if the frame answers an earlier SYNC.

    Attributes:
        skipped: Number of frames that give no sample. Such a frame was received before the first SYNC, or its timestamp is
            earlier than the timestamp of the SYNC.
    """

    def __init__(self, network: Network) -> None:
        """Start the measurement.

        Args:
            network: Nodes and messages of the DBC.
        """
        self.skipped = 0
        answering = {node.name for node in network.nodes if node.kind in _ANSWERING}
        masters = {node.name for node in network.nodes if node.kind == "master"}
        self._wire: dict[tuple[str, str], float] = {}
        self._syncs: dict[int, str] = {}  # identifier of a SYNC -> bus
        self._answers: dict[int, tuple[str, str]] = {}  # identifier -> bus, kind
        for message in network.messages:
            if message.cycle_ms != 1:
                continue
            if message.name.startswith("SYNC_"):
                self._syncs[message.frame_id] = message.bus
            elif message.sender in answering | masters:
                self._add(network, message, "command" if message.sender in masters else "state")
        self._since: dict[str, int] = {}  # bus -> timestamp of its last SYNC [ns]
        self._samples: dict[tuple[str, str], list[int]] = {key: [] for key in self._wire}

    def _add(self, network: Network, message: Message, kind: str) -> None:
        key = (message.bus, kind)
        self._answers[message.frame_id] = key
        wire = wire_time(message.length, network.nominal_bitrate, network.data_bitrate)
        self._wire[key] = self._wire.get(key, 0.0) + wire * 1e6

    def accept(self, frames: Frames, stamps: Stamps, count: int) -> None:
        """Add the samples of received frames.

        Args:
            frames: Buffer with the new frames in its first `count` elements.
            stamps: Receive timestamps of these frames [ns].
            count: Number of new frames.
        """
        for frame_id, stamp in zip(frames["can_id"][:count].tolist(), stamps[:count].tolist(), strict=True):
            if (bus := self._syncs.get(frame_id)) is not None:
                self._since[bus] = stamp
            elif (key := self._answers.get(frame_id)) is not None:
                since = self._since.get(key[0])
                if since is None or stamp < since:
                    self.skipped += 1
                else:
                    self._samples[key].append(stamp - since)

    def report(self) -> list[Latency]:
        """Return one time distribution for each bus and kind of frame (state or command), in the order of the DBC.

        A bus and kind of frame without samples is left out.
        """
        return [self._latency(bus, kind) for bus, kind in self._wire if self._samples[bus, kind]]

    def _latency(self, bus: str, kind: str) -> Latency:
        samples = np.array(self._samples[bus, kind]) / _NS_PER_US
        low, median, p99, high = np.percentile(samples, [0, 50, 99, 100]).tolist()
        budget = STATE_BUDGET if kind == "state" else COMMAND_BUDGET
        return Latency(bus, kind, len(samples), low, median, p99, high, self._wire[bus, kind], budget)


def rows(latencies: Sequence[Latency]) -> list[tuple[str, ...]]:
    """Return the time distributions as rows of a table. The first row is the header.

    Args:
        latencies: Distributions to print.
    """
    header = ("bus", "SYNC to", "samples", "min us", "median us", "99 % us", "max us", "wire us", "budget us", "fits")
    found: list[tuple[str, ...]] = [header]
    for x in latencies:
        times = (x.min_us, x.median_us, x.p99_us, x.max_us, x.wire_us, x.budget_us)
        found.append((x.bus, x.kind, str(x.samples), *(f"{time:.0f}" for time in times), "yes" if x.fits else "NO"))
    return found
