"""Bus wrapper of `atalante emulator`, between the bus and the emulated nodes.

HAL <-> bus <-> Line <-> emulated nodes
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from atalante_dbc import Network
from atalante_emulator.collision import intact_payloads
from atalante_hal.bus import Bus
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.wire.e2e import COUNTER_BYTE, check_counter
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.session.takeover import PendantReader, Takeover

#: The emulated pendant stops sending when another pendant sends.
#: It resumes sending after `PENDANT_QUIET` cycles without a frame of another pendant, unless it has given up
#: (`takeover.LOST_FRAMES`).
#: If both pendants are silent, the other pendant resumes first, because its waiting time is only 3 cycles
#: (`takeover.QUIET_CYCLES`).
PENDANT_QUIET: Final = 12
#: A second robot is reported if a message of an emulated node, such as LEFT_SH_STATE, is received 3 times in a row.
#: The alive counters of these 3 frames must increase. Messages of a pendant do not count.
ROBOT_FRAMES: Final = 3


class Line(ResilientBus):
    """Bus of the emulated robot, which also counts frames and detects a second robot.

    A HAL sends no messages of drives, sensors or the vibration node. So such a message is received only from a second robot.
    `send` drops the frames of the emulated pendant during and after a takeover by another pendant, see `takeover`.

    Attributes:
        sent: Number of frames sent so far.
        received: Number of frames received so far.
        other_robot: Name of a message received from a second robot, such as "LEFT_SH_STATE". Empty without a second robot.
    """

    def __init__(self, bus: Bus, network: Network) -> None:
        """Wrap the bus of the emulated robot.

        Args:
            bus: Open bus that carries the frames of all buses. `close` also closes this bus.
            network: Nodes and messages of the DBC.
        """
        super().__init__(bus)
        self._takeover = Takeover(established=True, quiet=PENDANT_QUIET)
        self._pendant = PendantReader(network, self._takeover)
        self._pendant_ids = [m.frame_id for m in network.sent_by("PENDANT")]
        nodes = [node.name for node in network.nodes if node.kind not in ("master", "pendant")]
        self._own = {m.frame_id: m for name in nodes for m in network.sent_by(name)}
        #: CAN identifier -> (alive counter of the last frame, number of consecutive frames with increasing alive counters)
        self._in_row: dict[int, tuple[int, int]] = {}
        self.sent = 0
        self.received = 0
        self.other_robot = ""

    @property
    def pendant_displaced(self) -> bool:
        """Return whether another pendant has taken over from the emulated pendant."""
        return self._takeover.lost

    def listen(self, seconds: float) -> str:
        """Listen for another robot before the emulated nodes send their first frame. Discard all received frames.

        Args:
            seconds: Longest time to listen [s].

        Returns:
            Name of the first message received from another robot. Empty if there is none.
        """
        block, deadline = new_frames(256), time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            count = super().receive(block, left)
            if found := self._from_another_robot(block[:count]):
                return self._own[found[0][0]].name
        return ""

    def send(self, frames: Frames) -> None:
        """Send frames with `ResilientBus.send`. Drop the frames of the emulated pendant if another pendant takes over.

        Args:
            frames: Frames to send.
        """
        if not self._takeover.sends:
            frames = self._without_pendant(frames)
        super().send(frames)
        if not self.down:
            self.sent += len(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Receive frames with `ResilientBus.receive`. Detect another pendant and a second robot.

        Args:
            frames: Buffer for the received frames.
            timeout: Longest wait for the first frame [s].
        """
        count = super().receive(frames, timeout)
        self.received += count
        if not self._takeover.lost:
            self._pendant.read(frames, count)
        if not self.other_robot:
            for can_id, counter in self._from_another_robot(frames[:count]):
                last, in_row = self._in_row.get(can_id, (None, 0))
                in_row = in_row + 1 if check_counter(last, counter).fresh else 1
                self._in_row[can_id] = counter, in_row
                if in_row >= ROBOT_FRAMES:
                    self.other_robot = self._own[can_id].name
        return count

    def _from_another_robot(self, frames: Frames) -> list[tuple[int, int]]:
        """Return (CAN identifier, alive counter) of each intact frame of a drive, a sensor or the vibration node."""
        ids = frames["can_id"].tolist()
        if self._own.keys().isdisjoint(ids):
            return []
        return [
            (can_id, payload[COUNTER_BYTE])
            for index, can_id in enumerate(ids)
            if can_id in self._own
            for payload in intact_payloads(self._own[can_id], frames[index : index + 1])
        ]

    def _without_pendant(self, frames: Frames) -> Frames:
        """Return all frames except the frames of the pendant."""
        kept = np.isin(frames["can_id"], self._pendant_ids, invert=True)
        return frames if kept.all() else frames[kept]
